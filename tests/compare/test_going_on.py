"""A comparison that was interrupted or killed goes on where it was, and keeps what had ended."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest
from commands import (
    COMMAND,
    ENVIRONMENT,
    Command,
    alive,
    assert_refused,
    compared_here,
    files_of,
    flower,
    omnibench,
    run_here,
    search,
    summary,
    without_seconds,
    write_config,
    write_plugin,
)
from timing import PATIENCE, until

from omnibench.data.storage import save_dataset
from omnibench.files import results_locked
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset

WHOLE = "[!.]*"  # files; one that a killed process was writing begins with a dot

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
    assert process.stderr is not None
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
    before = files_of(tmp_path / "out" / "runs", WHOLE)
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
def test_what_was_killed_is_tried_again_when_a_comparison_goes_on_and_what_hung_is_not(
    command: Command, tmp_path: Path
) -> None:
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
