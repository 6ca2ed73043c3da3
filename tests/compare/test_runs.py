"""Runs of a comparison: stored, gone on with, failing, in workers and on backends."""

import ast
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from commands import (
    COMMAND,
    ENVIRONMENT,
    Command,
    Prepared,
    Printed,
    alive,
    assert_refused,
    compared_here,
    compared_once,
    files_of,
    flower,
    omnibench,
    refused,
    registries_restored,
    rows,
    run_here,
    search,
    small,
    summary,
    without_seconds,
    write_config,
    write_plugin,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from report_page import on_terminal
from timing import PATIENCE, until

import omnibench as installed
from omnibench.compare.config import CompareConfig, effective_config, load_calibrators, read_compare_config
from omnibench.compare.plan import PlannedFit, load_robots, plan_fits, shared_code
from omnibench.compare.report.comparison_view import ComparisonView
from omnibench.compare.run import run_comparison
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError, OmnibenchError
from omnibench.files import results_locked
from omnibench.fit.calibrate import calibrate
from omnibench.fit.calibrator import Outcome, RunResult
from omnibench.fit.certify import certify_optimum
from omnibench.fit.problem import Improvement
from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import Backend, ResultStore
from omnibench.jobs.job_process import InPlace, Processes
from omnibench.progress import Progress
from omnibench.report.terminal import print_result
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import simulate_dataset

ALL = {"theoretical 1", "closed_form 1", "search 1"}
PACKAGE = Path(installed.__file__).parent
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


def planned(**changes: Any) -> list[PlannedFit]:
    """The runs of a small comparison."""
    config = CompareConfig.model_validate(small(**changes))
    load_calibrators(config.plugins, [entry.name for entry in config.calibrators])
    config = effective_config(config)
    return plan_fits(config, load_robots(config)[0])


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


def test_what_is_damaged_is_run_again(output: Path) -> None:
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
            ran, _ = ran_and_kept(tmp_path / "out", plugins=[plugins], calibrators=["theoretical", "mine"])
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
    for name in ("outcome", "reason", "cost", "evaluations", "seconds", "history", "at_bounds", "held"):
        assert getattr(got, name) == getattr(put, name)
    for name in ("vector", "matrix"):
        before, after = getattr(put, name), getattr(got, name)
        assert (before is None and after is None) or np.array_equal(before, after)


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


CHANGED = ("fit/problem.py", "robot/effects/effect.py", "data/dataset.py", "data/stored.py", "compare/plan.py")


@pytest.mark.parametrize("file", CHANGED)
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
    before = planned(plugins=[plugins], calibrators=[entry])[0].key
    write_plugin(plugins, "inner", body + "# changed\n")
    assert planned(plugins=[plugins], calibrators=[entry])[0].key != before


# A comparison that was interrupted or killed goes on where it was, and keeps what had ended.


# Ends soon after its file is there, and not before: what Ctrl-C finds under way.
WAITING = """
@calibrators.register("waiting")
class Waiting(Calibrator):
    "Waits for a file, then scales the start by random numbers."

    class Options(Options):
        number: int = 1

    def calibrate(self, problem):
        while not os.path.exists({file!r}):
            time.sleep(0.01)
        return Solution(problem.start * (1 + 0.001 * problem.rng.random(problem.size)), "scaled", converged=False)
"""
ENTRIES = [
    "theoretical",
    "waiting",
    {"name": "waiting", "label": "second", "options": {"number": 2}},
    search("third", 400),
]


def waiting(folder: Path) -> dict[str, Any]:
    """Changes of the small comparison that let it wait for the file ``go`` of the folder in its second run."""
    plugins = write_plugin(folder / "plugins", "waiting", WAITING.format(file=str(folder / "go")))
    return {"plugins": [str(plugins)], "calibrators": ENTRIES}


def started(folder: Path, ended: int = 1, **changes: Any) -> subprocess.Popen[str]:
    """A comparison in a process group of its own, of which so many of the four runs have ended."""
    config = write_config(folder, **waiting(folder), **changes)
    process = subprocess.Popen(
        [*COMMAND, "compare", str(config), "--output", str(folder / "out")],
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stderr.readline() == "comparing: 4 runs\n"
    if ended:
        assert next(line for line in process.stderr if line.startswith(f"[{ended}/4] flower "))
    return process


def test_ctrl_c_keeps_what_had_ended_and_going_on_gives_what_an_uninterrupted_comparison_gives(tmp_path: Path) -> None:
    output = tmp_path / "out"
    process = started(tmp_path, workers=1)
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    line = f"interrupted; 1 of 4 runs are kept in {output}: run again with -o {output}"
    assert [text for text in stderr.splitlines() if text] == [line]
    until(lambda: not alive(process.pid), "its processes to end")
    files = files_of(output)
    assert {Path(name).suffix for name in files} == {".yaml", ".json"}
    kept = {name: content for name, content in files.items() if name.startswith("runs/")}
    assert len(kept) == 1

    (tmp_path / "go").touch()
    run = run_here("compare", tmp_path / "small.yaml", "--output", output, cwd=tmp_path)
    (line,) = (line for line in run.stderr.splitlines() if "kept from an earlier run" in line)
    assert "theoretical seed 1: converged" in line
    after = files_of(output)
    assert kept == {name: after[name] for name in kept}
    save_dataset(simulate_dataset(FlowerConfig.model_validate(flower()), "flower").dataset, tmp_path / "data")
    data = {"flower": {"path": str(tmp_path / "data")}}
    compared_here(tmp_path / "whole", **waiting(tmp_path), datasets=data)
    assert without_seconds(output) == without_seconds(tmp_path / "whole")


@pytest.mark.slow
def test_ctrl_c_before_the_first_run_ends_in_one_line(tmp_path: Path) -> None:
    plugins = write_plugin(tmp_path / "plugins", "impatient", "import signal\nsignal.raise_signal(signal.SIGINT)\n")
    config = write_config(tmp_path, plugins=[str(plugins)])
    run = omnibench("compare", config, "--output", tmp_path / "out")
    assert run.returncode == 130
    assert [line.split(";")[0] for line in run.stderr.splitlines() if line] == ["interrupted"]


@pytest.mark.slow
def test_ctrl_c_while_the_workers_start_is_one_line(tmp_path: Path) -> None:
    for attempt in range(3):
        process = started(tmp_path / str(attempt), ended=0, workers=4)
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=PATIENCE)
        assert next(line for line in said.splitlines() if not line.startswith("[")).startswith("interrupted; ")
        assert "Traceback" not in said
        until(lambda session=process.pid: not alive(session), "its processes to end")


@pytest.mark.slow
def test_a_reader_that_leaves_early_gets_no_more_and_the_report_is_written(tmp_path: Path) -> None:
    config = write_config(tmp_path)
    shell = f"{' '.join(COMMAND)} compare {config} -o {tmp_path / 'out'} 2>&1 | head -n 1"
    run = subprocess.run(
        ["bash", "-c", shell], env=ENVIRONMENT, capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert len(run.stdout.splitlines()) == 1
    assert run.stderr == ""
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGTERM", "SIGKILL"])
def test_the_runs_end_with_a_comparison_that_is_killed_which_then_goes_on(
    name: str, command: Command, tmp_path: Path
) -> None:
    process = started(tmp_path, workers=4)  # none starts later
    process.send_signal(signal.Signals[name])
    _, stderr = process.communicate(timeout=PATIENCE)
    assert "Traceback" not in stderr
    if name == "SIGTERM":
        assert process.returncode == 128 + signal.SIGTERM
        assert stderr.splitlines()[-1].endswith(f"run again with -o {tmp_path / 'out'}")
    until(lambda: not alive(process.pid), "its processes to end")
    before = files_of(tmp_path / "out" / "runs", "[!.]*")  # not the one that a killed process was writing
    (tmp_path / "go").touch()
    run = command("compare", tmp_path / "small.yaml", "--output", tmp_path / "out")
    assert run.stderr.count("kept from an earlier run") == len(before) > 0
    assert before.items() <= files_of(tmp_path / "out" / "runs").items()
    outcomes = {run["label"]: run["outcome"] for run in summary(tmp_path / "out")["runs"]}
    assert outcomes == {"theoretical": "converged", "waiting": "budget", "second": "budget", "third": "budget"}


def test_a_comparison_in_a_folder_in_which_another_writes_is_refused(command: Command, tmp_path: Path) -> None:
    config = write_config(tmp_path)
    with results_locked(tmp_path / "out"):
        assert_refused(command("compare", config, "--output", tmp_path / "out"), str(tmp_path / "out"), "--output")


MISBEHAVING = """
class Misbehaving(Calibrator):
    "Never answers."

    def calibrate(self, problem):
        with open(os.path.join({folder!r}, type(self).__name__ + ".tries"), "a") as file:
            file.write(".")
        self.misbehave()

@calibrators.register("is_killed")
class is_killed(Misbehaving):
    def misbehave(self):
        os.kill(os.getpid(), 9)

@calibrators.register("hangs")
class hangs(Misbehaving):
    def misbehave(self):
        time.sleep(3600)
"""


@pytest.mark.slow
def test_going_on_tries_again_what_was_killed_and_not_what_hung(command: Command, tmp_path: Path) -> None:
    plugins = write_plugin(tmp_path / "plugins", "misbehaving", MISBEHAVING.format(folder=str(tmp_path)))
    entries, budget = ["theoretical", "is_killed", "hangs"], {"evaluations": 500, "seconds": 0.5}
    config = write_config(tmp_path, plugins=[str(plugins)], calibrators=entries, budget=budget)
    for kept in (0, 2):
        run = command("compare", config, "--output", tmp_path / "out")
        assert (run.returncode, run.stderr.count("kept from an earlier run")) == (1, kept)
        rows = {run["label"]: (run["outcome"], run["reason"]) for run in summary(tmp_path / "out")["runs"]}
        assert rows["hangs"][0] == "time"
        assert rows["is_killed"][0] == "failed"
        assert rows["is_killed"][1].endswith("in each of 3 tries")
    assert {file.stem: file.stat().st_size for file in tmp_path.glob("*.tries")} == {"is_killed": 6, "hangs": 1}


# Calibrators that misbehave: each is a row with its outcome and reason, and the others run.

CALIBRATOR = """
@calibrators.register("{name}")
class Misbehaving(Calibrator):
    "Misbehaves."

    def calibrate(self, problem):
        {body}
"""
UNMAKEABLE = """
@calibrators.register("unmakeable")
class Unmakeable(Calibrator):
    "Cannot be made."

    def __init__(self, options):
        raise RuntimeError("not today")

    def calibrate(self, problem): ...
"""
BROKEN = """
import a_package_that_nobody_has

@calibrators.register("of_another_name")
class Broken(Calibrator): ...
"""
NO_CALIBRATOR = """
@calibrators.register("no_calibrator")
class NoCalibrator: ...
"""
WELL_BEHAVED = {"theoretical": ("", "converged", ""), "closed_form": ("", "converged", "")}
# What calibrate does or the whole plug-in, the outcome, and a part of the reason.
WRONG = {
    "raises": ("raise ValueError('first line\\n second line')", "failed", "ValueError: first line second line"),
    "quits": ("sys.exit('enough')", "failed", "SystemExit: enough"),
    "interrupts": ("raise KeyboardInterrupt", "failed", "KeyboardInterrupt"),
    "leaves_the_box": ("return Solution(problem.upper + 1.0, 'here')", "invalid", "outside the box (m11, m12, "),
    "gives_odd_reasons": ("return Solution(problem.start, {'two': 'lines\\nhere'})", "converged", "{'two': 'lines"),
    "spoils_the_history": (
        "problem.history[:] = [1, 2]; return Solution(problem.start, 'here')",
        "failed",
        "Expected `Improvement`",
    ),
    "dies": ("os._exit(3)", "failed", "(exit code 3)"),
    "unmakeable": (UNMAKEABLE, "failed", "RuntimeError: not today"),
    "broken": (BROKEN, "failed", "ModuleNotFoundError: No module named 'a_package_that_nobody_has'"),
    "of_another_name": ("", "failed", "broken.py cannot be imported: ModuleNotFoundError"),
    "no_calibrator": (NO_CALIBRATOR, "failed", "derive from Calibrator"),
}
DEADLY = {
    "is_killed": ("os.kill(os.getpid(), 9)", "failed", "(killed by SIGKILL"),
    "closes_everything": ("os.closerange(3, 256); time.sleep(60)", "failed", "died without an answer"),
    "leaves_a_thread": (
        "threading.Timer(60, print).start(); return Solution(problem.start, 'here')",
        "converged",
        "here",
    ),
    "wants_memory": ("np.ones(10**9)", "failed", "(limit 1000 MB)"),
    "wants_memory_bit_by_bit": ("held = [bytes(10**5) for _ in range(10**9)]", "failed", "(limit 1000 MB)"),
    "hangs": ("time.sleep(3600)", "time", "ended by force: 5 s"),
}


class Compared(NamedTuple):
    output: Path
    run: Printed
    rows: dict[str, dict[str, Any]]
    expected: dict[str, tuple[str, str, str]]


@pytest.fixture(scope="module", params=[WRONG, pytest.param(DEADLY, marks=pytest.mark.slow)], ids=["wrong", "deadly"])
def comparison(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Compared:
    """One comparison of everything that can go wrong, and of two calibrators with which nothing does."""
    folder = tmp_path_factory.mktemp("failing")
    for name, (body, _, _) in request.param.items():
        if body:
            plugin = body if "@calibrators" in body else CALIBRATOR.format(name=name, body=body)
            write_plugin(folder / "plugins", name, plugin)
    entries = [*WELL_BEHAVED, *request.param]
    limits = {"budget": {"evaluations": 500, "seconds": 5}, "memory_mb": 1000, "workers": 4}
    config = write_config(folder, plugins=["plugins"], calibrators=entries, **limits)
    run = run_here("compare", config, "--output", folder / "out", "--all", cwd=folder)
    assert run.returncode == 0
    return Compared(folder / "out", run, rows(folder / "out"), WELL_BEHAVED | request.param)


def test_every_entry_is_a_row_with_its_outcome_and_reason(comparison: Compared) -> None:
    assert {*comparison.rows} == {*comparison.expected}
    for label, (_, outcome, reason) in comparison.expected.items():
        assert comparison.rows[label]["outcome"] == outcome, label
        assert reason in comparison.rows[label]["reason"], label
        assert "\n" not in comparison.rows[label]["reason"]


def test_a_row_without_an_answer_has_no_costs_and_no_matrix_and_is_shown_with_its_reason(comparison: Compared) -> None:
    for label, row in comparison.rows.items():
        if row["outcome"] == "converged":
            continue
        assert {row[name] for name in ("train_cost", "validation_cost", "train_improvement", "gap")} == {None}
        assert row["matrix"] is None
        assert row["theoretical_train_cost"] == comparison.rows["theoretical"]["train_cost"]
        assert f"no answer: flower {label} seed 1: {row['outcome']}: {row['reason']}" in comparison.run.stdout
        assert f"flower {label} seed 1: {row['outcome']}, no answer" in comparison.run.stderr


def test_a_plugin_that_cannot_be_imported_is_named_with_its_error(comparison: Compared) -> None:
    warning = f"{comparison.output.parent / 'plugins' / 'broken.py'} cannot be imported: ModuleNotFoundError: No module"
    broken = "broken" in comparison.expected
    assert (f"warning: plug-in {warning}" in comparison.run.stderr) == broken
    assert any(warning in text for text in summary(comparison.output)["warnings"]) == broken


def test_failed_runs_are_not_kept_and_the_others_are(comparison: Compared) -> None:
    kept = sum(row["outcome"] != "failed" for row in comparison.rows.values())
    assert len(list((comparison.output / "runs").iterdir())) == kept


@pytest.mark.parametrize("others", [[], ["theoretical"]])
def test_when_every_search_fails_there_are_results_and_exit_code_1_and_a_long_message_is_cut(
    others: list[str], command: Command, tmp_path: Path
) -> None:
    body = "raise ValueError(5_000_000 * 'x')"
    plugins = write_plugin(tmp_path / "plugins", "shouts", CALIBRATOR.format(name="shouts", body=body))
    config = write_config(tmp_path, plugins=[str(plugins)], calibrators=[*others, "shouts"])
    run = command("compare", config, "--output", tmp_path / "out")
    assert run.returncode == 1
    assert "flower shouts seed 1: failed: ValueError: xxx" in run.stdout + run.stderr
    assert "more characters)" in rows(tmp_path / "out")["shouts"]["reason"]
    assert max(map(len, (run.stdout + run.stderr).splitlines())) < 3000
    assert (tmp_path / "out" / "report.html").stat().st_size < 8_000_000


@pytest.mark.parametrize(
    "changes",
    [
        {"calibrators": ["of_a_third_name"]},
        {"cost": "of_a_third_name"},
        {"datasets": {"x": {"import": {"format": "of_a_third_name", "source": "."}}}},
    ],
    ids=["calibrator", "cost", "importer"],
)
def test_an_unknown_name_beside_a_broken_plugin_names_both(changes: dict[str, Any], tmp_path: Path) -> None:
    plugins = write_plugin(tmp_path / "plugins", "broken", BROKEN)
    with refused(OmnibenchError, "'of_a_third_name'", "broken.py cannot be imported: ModuleNotFoundError"):
        compared_here(tmp_path / "out", plugins=[plugins], **changes)


# The processes that runs are run in: what reaches them, what they inherit, and that scripts need no guard.

# Looks through all that can be reached from the problem, from every frame and from every module, for arrays that hold
# given bytes and for texts that hold a given word.
SPY = """
import gc
from pathlib import Path

NEEDLES = {needles!r}
WORD = {word!r}

@calibrators.register("spy")
class Spy(Calibrator):
    "Looks for data that it should not see."

    def calibrate(self, problem):
        found = set()
        frame, frames = sys._getframe(), []
        while frame is not None:
            frames.append(dict(frame.f_locals))
            frame = frame.f_back
        waiting, seen = [problem, list(sys.modules.values()), frames], {{id(NEEDLES), id(globals())}}
        while waiting:
            item = waiting.pop()
            if id(item) in seen:
                continue
            seen.add(id(item))
            if isinstance(item, np.ndarray):
                content = np.ndarray.tobytes(item)
                found |= {{name for name, needle in NEEDLES.items() if bytes.fromhex(needle) in content}}
            elif isinstance(item, (str, Path)) and item is not WORD and WORD in str(item):
                found.add(f"a text about {{WORD}}: {{item}}")
            else:
                waiting.extend(gc.get_referents(item))
        return Solution(problem.start, f"looked at {{len(seen)}}, found {{', '.join(sorted(found))}}")
"""


def test_validation_data_are_out_of_a_calibrators_reach(tmp_path: Path) -> None:
    dataset = load_robots(read_compare_config(write_config(tmp_path)))[0][0].dataset
    save_dataset(dataset, tmp_path / "hideaway")
    needles = {
        f"{kind} {split}": array.tobytes().hex()
        for split in ("train", "validation")
        for kind, array in (("rates", dataset.split(split)[2].rates[:4]), ("poses", dataset.split(split)[2].poses[1:4]))
    }
    plugins = write_plugin(tmp_path / "plugins", "spy", SPY.format(needles=needles, word="hide" + "away"))
    config = {
        "datasets": {"flower": {"path": str(tmp_path / "hideaway")}},
        "plugins": [str(plugins)],
        "calibrators": ["spy"],
    }
    compared_here(tmp_path / "out", **config)
    row = rows(tmp_path / "out")["spy"]
    assert row["outcome"] == "converged", row["reason"]
    looked_at, found = row["reason"].removeprefix("looked at ").split(", found ")
    assert int(looked_at) > 50_000
    assert found == "poses train, rates train"


@pytest.mark.slow
def test_a_script_needs_no_guard(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "from pathlib import Path\nimport omnibench\nprint('once')\n"
        f"config = omnibench.read_compare_config(Path({str(write_config(tmp_path))!r}))\n"
        f"result = omnibench.run_comparison(config, Path({str(tmp_path / 'out')!r}))\n"
        "print(sorted(run.record.outcome for run in result.runs))\n"
    )
    run = subprocess.run(
        [COMMAND[0], str(script)], env=ENVIRONMENT, capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert run.stderr == ""
    assert run.stdout.splitlines()[0] == "once"
    assert run.stdout.count("once") == 1
    assert [run["outcome"] for run in summary(tmp_path / "out")["runs"]] == ["converged", "converged", "budget"]


def test_a_comparison_runs_in_another_thread_than_the_main_one_and_leaves_the_process_as_it_was(tmp_path: Path) -> None:
    def state() -> tuple[Any, ...]:
        threads = {name: os.environ.get(name) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
        return threads, signal.getsignal(signal.SIGINT), sys.modules["__main__"], multiprocessing.active_children()

    before = state()
    thread = threading.Thread(target=compared_here, args=(tmp_path / "out",))
    thread.start()
    thread.join(timeout=PATIENCE)
    assert [run["outcome"] for run in summary(tmp_path / "out")["runs"]] == ["converged", "converged", "budget"]
    assert state() == before


@pytest.mark.parametrize("workers", [1, 2])
def test_no_more_runs_are_under_way_than_there_are_workers(workers: int, tmp_path: Path) -> None:
    class Count:
        most = 0

        def __init__(self) -> None:
            self.now: set[str] = set()

        def __call__(self, event: Progress) -> None:
            if event.unit == "evaluation":
                (self.now.discard if event.over else self.now.add)(event.task)
                self.most = max(self.most, len(self.now))

    count = Count()
    entries = [search(str(number), 300 + number) for number in range(4)]
    config = CompareConfig.model_validate(small(calibrators=entries, workers=workers))
    run_comparison(config, tmp_path / "out", count)
    assert (count.most, count.now) == (workers, set())


def test_progress_tells_evaluations_and_the_best_cost(tmp_path: Path) -> None:
    events: list[Progress] = []
    entries = [search(candidates=20_000, batch=20)]
    config = CompareConfig.model_validate(small(calibrators=entries, budget={"evaluations": 20_000}))
    result = run_comparison(config, tmp_path / "out", events.append)
    counts, bests = zip(
        *((event.done, event.best) for event in events if event.best is not None and not event.over), strict=True
    )
    assert list(counts) == sorted(counts)
    assert list(bests) == sorted(bests, reverse=True)
    assert bests[-1] >= (result.runs[0].record.train_cost or 0.0) - 1e-11  # the verdict is by direct integration


# Fits by jobs of any backend: comparisons, resamples and proofs are equal to the bit, and times are fair.


def test_a_comparison_on_dask_is_equal_to_the_bit_and_goes_on_with_another_backend(tmp_path: Path) -> None:
    compared_here(tmp_path, backend="dask", workers=1)
    assert "backend: dask\n" in (tmp_path / "config.yaml").read_text()
    by_processes = without_seconds(compared_once().output)
    assert all(run in by_processes for run in without_seconds(tmp_path))
    times = {file.name: file.stat().st_mtime_ns for file in (tmp_path / "runs").iterdir()}
    compared_here(tmp_path)
    assert {file.name: file.stat().st_mtime_ns for file in (tmp_path / "runs").iterdir()} == times


@pytest.mark.slow
class TestFits:
    @pytest.fixture(scope="class")
    @classmethod
    def dask(cls) -> Iterator[Backend]:
        with open_backend(BackendChoice(name="dask", workers=2)) as backend:
            yield backend

    def test_a_proof_by_jobs_is_the_same_by_any_backend(self, prepared: Prepared, dask: Backend) -> None:
        flower = load_dataset(prepared.data)
        calibration = calibrate(flower).calibration
        one, *others = (
            certify_optimum(calibration, flower, seconds=600, parts=60, backend=backend).proof
            for backend in (InPlace(), Processes(2), dask)
        )
        assert one.boxes >= 60
        assert 0 < one.lower_bound <= one.best_cost
        assert {(each.lower_bound, each.boxes) for each in others} == {(one.lower_bound, one.boxes)}


def test_machines_that_differ_are_compared_by_the_ratio_to_their_reference() -> None:
    result = compared_once()
    for run in summary(result.output)["runs"]:
        assert 0 < run["reference_seconds"] < 1
        assert run["machine"]
    first, *rest = result.runs
    other = replace(first, result=replace(first.result, timing=replace(first.result.timing, machine="another")))
    shown = ComparisonView(replace(result, runs=(other, *rest)), everything=True)
    printed = " ".join(on_terminal(print_result, shown, width=200).split())
    assert "of the start" in printed
    assert "on machines of different speed" in printed


def test_runs_that_are_not_timed_show_no_seconds(tmp_path: Path) -> None:
    result = compared_here(tmp_path, timing=False, calibrators=["theoretical"])
    assert {run["reference_seconds"] for run in summary(tmp_path)["runs"]} == {None}
    printed = " ".join(on_terminal(print_result, ComparisonView(result, everything=True), width=200).split())
    assert "The runs were not timed." in printed
    assert " ms " not in printed
