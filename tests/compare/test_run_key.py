"""The key of a stored run: what changes it, and what does not."""

from __future__ import annotations

import ast
import shutil
from pathlib import Path
from typing import Any

import pytest
from commands import flower, search, small, write_plugin

import omnibench
from omnibench.compare.config import CompareConfig, effective_config, load_calibrators
from omnibench.compare.plan import load_datasets, make_plan, shared_code

PACKAGE = Path(omnibench.__file__).parent
# Imported by the code of runs, without a say in their results. What has one belongs to the key's files instead.
NEUTRAL = {
    "config", "errors", "registry", "files", "environment", "processes", "progress", "words", "views",
    "data.scans", "data.splits", "data.domain_check", "jobs.job_process", "jobs.job",
}  # fmt: skip


def keys(**changes: Any) -> list[str]:
    """The keys of a small comparison's runs."""
    config = CompareConfig.model_validate(small(**changes))
    load_calibrators(config.plugins, [entry.name for entry in config.calibrators])
    config = effective_config(config)
    return [run.key for run in make_plan(config, load_datasets(config))]


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A copy of the package's tree."""
    return Path(shutil.copytree(PACKAGE, tmp_path / "omnibench", ignore=shutil.ignore_patterns("__pycache__")))


@pytest.mark.parametrize(
    "file",
    [
        "fit/problem.py",
        "fit/noise.py",
        "fit/information.py",
        "fit/evaluator.py",
        "fit/certify.py",
        "robot/odometry.py",
        "robot/effects/effect.py",
        "robot/export/formats.py",
        "data/dataset.py",
        "data/stored_rows.py",
        "compare/plan.py",
    ],
)
def test_a_change_of_code_that_all_runs_share_changes_every_key_in_subfolders_too(file: str, package: Path) -> None:
    before = shared_code(package)
    (package / file).write_text((package / file).read_text(encoding="utf-8") + "# changed\n", encoding="utf-8")
    assert shared_code(package) != before


def test_a_new_file_changes_every_key_and_another_calibrator_none(package: Path) -> None:
    before = shared_code(package)
    folder = package / "fit" / "calibrators"
    (folder / "newcomer.py").write_text("# a calibrator\n")
    (folder / "nlopt_searches.py").write_text("# changed\n")
    assert shared_code(package) == before
    (package / "fit" / "new" / "deep").mkdir(parents=True)
    (package / "fit" / "new" / "deep" / "module.py").write_text("")
    assert shared_code(package) != before


def test_no_calibrator_of_the_package_imports_another() -> None:
    for file in (PACKAGE / "fit" / "calibrators").glob("*.py"):
        assert not [name for name in imported(file) if name.startswith("fit.calibrators")], file


def test_everything_that_the_code_of_runs_imports_is_in_the_key_or_has_no_say_in_the_result() -> None:
    hashed = ("robot", "fit", "data.dataset", "data.references", "data.stored")
    for file in (file for room in ("robot", "fit") for file in (PACKAGE / room).rglob("*.py")):
        if file.parent.name == "check":
            continue  # judges recordings, and is not in the key
        for name in imported(file):
            assert name in NEUTRAL or name.startswith(hashed), f"{file} imports {name}"


def imported(file: Path) -> set[str]:
    """Modules of the package that a file imports, anywhere in it, without the package's name."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return {name.removeprefix("omnibench.") for name in names if name.startswith("omnibench.")}


@pytest.mark.parametrize(
    "changes",
    [
        {"unidentified": "fit"},
        {"integration": "euler"},
        {"box": "paper"},
        {"cost": "final_position"},
        {"budget": {"evaluations": 1234}},
        {"seeds": [9]},
        {"datasets": {"flower": {"simulate": flower(train={"seed": 9, "distance": 1.2})}}},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_whatever_a_run_is_given_is_in_its_key(changes: dict[str, Any]) -> None:
    assert not {*keys(**changes)} & {*keys()}


def test_runs_of_the_same_work_share_a_key_whatever_they_are_called() -> None:
    first, second = keys(calibrators=[search("one"), search("two")])
    assert first == second


def test_the_key_of_a_run_changes_with_the_plugin_that_does_the_search(tmp_path: Path) -> None:
    body = '@calibrators.register("inner")\nclass Inner(Calibrator):\n    def calibrate(self, problem): ...\n'
    plugins = write_plugin(tmp_path / "plugins", "inner", body)
    entry = {"name": "parametric", "options": {"search": "inner"}}
    before = keys(plugins=[str(plugins)], calibrators=[entry])
    write_plugin(plugins, "inner", body + "# changed\n")
    assert keys(plugins=[str(plugins)], calibrators=[entry]) != before
