"""Only runs that are new, changed or damaged are run, by their keys; all others are read from the results there."""

from __future__ import annotations

import ast
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import (
    compared_once,
    files_of,
    flower,
    registries_restored,
    search,
    small,
    summary,
    without_seconds,
    write_plugin,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import omnibench
from omnibench.compare.config import CompareConfig, effective_config, load_calibrators, read_compare_config
from omnibench.compare.plan import PlannedRun, load_datasets, make_plan, shared_code
from omnibench.compare.run import run_comparison
from omnibench.errors import DataError
from omnibench.fit.calibrator import Outcome, RunResult
from omnibench.fit.problem import Improvement
from omnibench.jobs.job import ResultStore
from omnibench.progress import Progress

ALL = {"theoretical 1", "closed_form 1", "search 1"}
PACKAGE = Path(omnibench.__file__).parent
# Imported by the code of runs, without a say in their results. What has one belongs to the key's files instead.
NEUTRAL = {
    "config", "errors", "registry", "files", "environment", "processes", "progress", "words", "views",
    "data.scans", "data.splits", "data.domain_check", "jobs.job_process", "jobs.job",
}  # fmt: skip


def ran_and_kept(output: Path, config: CompareConfig | None = None, **changes: Any) -> tuple[set[str], set[str]]:
    """Compare a config, by default a small one, and say which runs were run and which were there."""
    ran, kept = set(), set()

    def watch(event: Progress) -> None:
        if event.result:
            run = event.task.removeprefix("flower ").replace(" seed", "")
            (kept if "kept from an earlier run" in event.result else ran).add(run)

    run_comparison(config or CompareConfig.model_validate(small(**changes)), output, watch)
    return ran, kept


def planned(**changes: Any) -> list[PlannedRun]:
    """The runs of a small comparison."""
    config = CompareConfig.model_validate(small(**changes))
    load_calibrators(config.plugins, [entry.name for entry in config.calibrators])
    config = effective_config(config)
    return make_plan(config, load_datasets(config))


@pytest.fixture
def output(tmp_path: Path) -> Path:
    """A copy of results of the small comparison."""
    shutil.copytree(compared_once().output, tmp_path / "out")
    return tmp_path / "out"


def test_nothing_is_run_again_when_nothing_changed(output: Path) -> None:
    before, rows = files_of(output / "runs"), summary(output)["runs"]
    ran, kept = ran_and_kept(output, read_compare_config(output / "config.yaml"))
    assert ran == set()
    assert kept == {f"{row['label']} {row['seed']}" for row in rows}
    assert files_of(output / "runs") == before
    assert summary(output)["runs"] == rows


def test_only_what_is_new_or_damaged_is_run(output: Path) -> None:
    entries = ["theoretical", {"name": "closed_form", "label": "another name"}, search(candidates=301)]
    assert ran_and_kept(output, calibrators=entries) == ({"search 1"}, {"theoretical 1", "another name 1"})
    files = sorted((output / "runs").iterdir())
    for number, file in enumerate(files):
        file.write_bytes((b"", b"\xff\xfe", b'{"outcome": "converged"}')[number % 3])
    assert ran_and_kept(output) == (ALL, set())
    assert sorted((output / "runs").iterdir()) == files
    assert sum(len(file.read_bytes()) > 100 for file in files) == 3


@pytest.mark.parametrize(
    ("changes", "new"),
    [
        ({"calibrators": ["theoretical", "closed_form", search(candidates=301)]}, {"search 1"}),
        ({"calibrators": ["theoretical", {"name": "closed_form", "box": "paper", "label": "c"}, search()]}, {"c 1"}),
        ({"calibrators": ["theoretical", "closed_form", search("another name")]}, set()),
        ({"seeds": [1, 3]}, {"search 3"}),
        ({"budget": {"evaluations": 2001, "seconds": 60}}, ALL),
        ({"cost": "final_position"}, ALL),
        ({"integration": "euler"}, ALL),
        ({"unidentified": "fit"}, ALL),
        ({"box": "paper"}, ALL),
        ({"seeds": [9]}, {"theoretical 9", "closed_form 9", "search 9"}),
        ({"datasets": {"flower": {"simulate": flower(sample_period=0.1)}}}, ALL),
        ({"datasets": {"flower": {"simulate": flower(train={"seed": 9, "distance": 1.2})}}}, ALL),
        ({"workers": 1, "bootstrap": {"resamples": 300}, "description": "other words"}, set()),
    ],
    ids=lambda value: ", ".join(sorted(value)) or "nothing",
)
def test_only_runs_that_a_change_touches_are_new(changes: dict[str, Any], new: set[str]) -> None:
    stored = compared_once().output / "runs"
    new_runs = [run for run in planned(**changes) if not (stored / f"{run.key}.json").exists()]
    assert {f"{run.label} {run.settings.seed}" for run in new_runs} == new


PLUGIN = """
@calibrators.register("mine")
class Mine(Calibrator):
    "Scales the start."

    def calibrate(self, problem):
        return Solution(problem.start * {factor}, "scaled")
"""


def test_a_plugin_that_is_repaired_or_changed_is_run_again_and_the_others_are_not(tmp_path: Path) -> None:
    costs = []
    for factor, outcome in (("a_name_that_is_not_there", "failed"), ("1.0", "converged"), ("1.01", "converged")):
        plugins = write_plugin(tmp_path / "plugins", "mine", PLUGIN.format(factor=factor))
        with registries_restored():
            ran, _ = ran_and_kept(tmp_path / "out", plugins=[str(plugins)], calibrators=["theoretical", "mine"])
        assert ran == ({"mine 1"} if costs else {"mine 1", "theoretical 1"})
        theoretical, mine = summary(tmp_path / "out")["runs"]
        assert (theoretical["outcome"], mine["outcome"]) == ("converged", outcome)
        costs.append(mine["train_cost"])
    assert costs[0] is None
    assert costs[1] != costs[2]


def test_the_same_seed_gives_the_same_results_with_any_number_of_workers(tmp_path: Path) -> None:
    entries = ["theoretical", "closed_form", search(), {"name": "genetic", "options": {"generations": 4}}]
    for workers in (1, 3):
        ran_and_kept(tmp_path / str(workers), calibrators=entries, seeds=[1, 7], workers=workers)
    assert without_seconds(tmp_path / "1") == without_seconds(tmp_path / "3")
    assert len(without_seconds(tmp_path / "1")) == 6


FINITE = st.floats(allow_nan=False, allow_infinity=False)
WORDS = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)), max_size=20)
ANSWERS = st.lists(FINITE, min_size=9, max_size=9).map(np.array)


@settings(max_examples=40)
@given(
    outcome=st.sampled_from(Outcome),
    reason=WORDS,
    vector=st.none() | ANSWERS,
    history=st.lists(st.tuples(st.integers(1, 10**9), FINITE, FINITE), max_size=4),
    at_bounds=st.lists(WORDS, max_size=3),
)
def test_a_result_comes_back_to_the_last_bit(
    outcome: Outcome,
    reason: str,
    vector: np.ndarray | None,
    history: list[tuple[int, float, float]],
    at_bounds: list[str],
) -> None:
    matrix = None if vector is None else vector.reshape(3, 3)
    cost = None if vector is None else float(vector[0])
    steps = tuple(Improvement(*step) for step in history)
    put = RunResult(outcome, reason, vector, matrix, cost, 17, 0.1, steps, tuple(at_bounds), ("m12",))
    with tempfile.TemporaryDirectory() as folder:
        ResultStore(Path(folder), RunResult).put("key", put)
        got = ResultStore(Path(folder), RunResult).get("key")
    assert got is not None
    for name in ("outcome", "reason", "cost", "evaluations", "seconds", "history", "at_bounds", "held"):
        assert getattr(got, name) == getattr(put, name)
    for name in ("vector", "matrix"):
        before, after = getattr(put, name), getattr(got, name)
        assert (before is None and after is None) or np.array_equal(before, after)


def test_a_run_that_is_not_there_is_none(tmp_path: Path) -> None:
    assert ResultStore(tmp_path / "runs", RunResult).get("key") is None


@pytest.mark.parametrize(
    ("freedom", "stored"), [("33", 33.0), ("null", None), (None, None), ("[8.5, 9.0]", [8.5, 9.0])]
)
def test_results_are_read_whether_they_hold_one_number_of_degrees_of_freedom_several_or_none(
    freedom: str | None, stored: float | list[float] | None, tmp_path: Path
) -> None:
    store = ResultStore(tmp_path, RunResult)
    store.put("key", RunResult(Outcome.TIME, "", None, None, None, 0, 0.0, ()))
    fields = json.loads(store.file("key").read_text())
    del fields["degrees_of_freedom"]
    if freedom is not None:
        fields["degrees_of_freedom"] = json.loads(freedom)
    store.file("key").write_text(json.dumps(fields))
    result = store.get("key")
    assert result is not None
    assert (None if result.degrees_of_freedom is None else result.degrees_of_freedom.tolist()) == stored


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("a file")
    with pytest.raises(DataError, match=r"runs/key\.json: cannot be written: .*runs is not a folder"):
        ResultStore(tmp_path / "runs", RunResult).put("key", RunResult(Outcome.TIME, "", None, None, None, 0, 0.0, ()))


# What is in a key


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package's tree, which the tests change."""
    copy = tmp_path_factory.mktemp("package") / "omnibench"
    return Path(shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__")))


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
        "data/stored.py",
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


def test_the_key_of_a_run_changes_with_the_plugin_that_does_the_search(tmp_path: Path) -> None:
    body = '@calibrators.register("inner")\nclass Inner(Calibrator):\n    def calibrate(self, problem): ...\n'
    plugins = write_plugin(tmp_path / "plugins", "inner", body)
    entry = {"name": "parametric", "options": {"search": "inner"}}
    before = planned(plugins=[str(plugins)], calibrators=[entry])[0].key
    write_plugin(plugins, "inner", body + "# changed\n")
    assert planned(plugins=[str(plugins)], calibrators=[entry])[0].key != before
