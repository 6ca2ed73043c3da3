"""A comparison that was interrupted or killed goes on where it was, and keeps what had ended."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from commands import (
    COMMAND,
    ENVIRONMENT,
    Command,
    assert_refused,
    compared,
    compared_here,
    files_of,
    flower,
    omnibench,
    search,
    summary,
    without_seconds,
    write_config,
    write_plugin,
)
from timing import PATIENCE

from omnibench.data.storage import save_dataset
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


class Stopped(NamedTuple):
    """A comparison that Ctrl-C ended: what it printed, and the files that were there then."""

    folder: Path
    output: Path
    returncode: int
    stderr: str
    group: int
    files: dict[str, tuple[int, bytes]]


def started(config: Path, output: Path, ended: int = 1) -> subprocess.Popen[str]:
    """A comparison in a process group of its own, of which so many runs have ended."""
    process = subprocess.Popen(
        [*COMMAND, "compare", str(config), "--output", str(output)],
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stderr is not None
    runs = len(yaml.safe_load(config.read_text())["calibrators"])
    assert process.stderr.readline() == f"comparing: {runs} runs\n"
    assert next(line for line in process.stderr if line.startswith(f"[{ended}/{runs}] flower "))
    return process


def alive(group: int) -> list[str]:
    """Commands of the processes of a session that have not ended."""
    listed = subprocess.run(["ps", "-o", "stat=,args=", "-s", str(group)], capture_output=True, text=True, check=False)
    return [line for line in listed.stdout.splitlines() if not line.startswith("Z")]


def wait_until_gone(group: int) -> list[str]:
    deadline = time.monotonic() + PATIENCE
    while (left := alive(group)) and time.monotonic() < deadline:
        time.sleep(0.05)
    return left


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Stopped:
    folder = tmp_path_factory.mktemp("stopped")
    process = started(write_config(folder, **waiting(folder), workers=1), folder / "out")
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=PATIENCE)
    return Stopped(folder, folder / "out", process.returncode, stderr, process.pid, files_of(folder / "out"))


def test_ctrl_c_exits_with_130(stopped: Stopped) -> None:
    assert stopped.returncode == 130


def test_ctrl_c_says_in_one_line_what_is_kept_and_how_to_go_on(stopped: Stopped) -> None:
    line = f"interrupted; 1 of 4 runs are kept in {stopped.output}: run again with -o {stopped.output}"
    assert [text for text in stopped.stderr.splitlines() if text] == [line]


def test_ctrl_c_leaves_no_process_behind(stopped: Stopped) -> None:
    assert wait_until_gone(stopped.group) == []


def test_ctrl_c_leaves_whole_files_only(stopped: Stopped) -> None:
    assert {Path(name).suffix for name in stopped.files} == {".yaml", ".json"}
    assert sum(name.startswith("runs/") for name in stopped.files) == 1


def test_going_on_keeps_what_had_ended_and_gives_what_an_uninterrupted_comparison_gives(
    stopped: Stopped, tmp_path: Path
) -> None:
    (stopped.folder / "go").touch()
    run = compared(stopped.folder / "small.yaml", stopped.output)
    (line,) = (line for line in run.stderr.splitlines() if "kept from an earlier run" in line)
    assert "theoretical seed 1: converged, cost 0.138732, 1 evaluation, " in line
    after = files_of(stopped.output)
    kept = {name: content for name, content in stopped.files.items() if name.startswith("runs/")}
    assert kept == {name: after[name] for name in kept}
    data = {"flower": {"path": str(whole_data(tmp_path))}}
    compared_here(tmp_path / "whole", **waiting(stopped.folder), datasets=data)
    assert without_seconds(stopped.output) == without_seconds(tmp_path / "whole")


def whole_data(folder: Path) -> Path:
    """The small config's data as a folder: read from a disk, they are the same."""
    save_dataset(simulate_dataset(FlowerConfig.model_validate(flower()), "flower").dataset, folder / "data")
    return folder / "data"


def test_ctrl_c_before_the_first_run_ends_in_one_line(tmp_path: Path) -> None:
    plugins = write_plugin(tmp_path / "plugins", "impatient", "import signal\nsignal.raise_signal(signal.SIGINT)\n")
    config = write_config(tmp_path, plugins=[str(plugins)])
    run = omnibench("compare", config, "--output", tmp_path / "out")
    assert run.returncode == 130
    assert [line.split(";")[0] for line in run.stderr.splitlines() if line] == ["interrupted"]


def test_ctrl_c_while_the_workers_start_is_one_line(tmp_path: Path) -> None:
    config = write_config(tmp_path, **waiting(tmp_path), workers=4)
    for attempt in range(3):
        process = subprocess.Popen(
            [*COMMAND, "compare", str(config), "--output", str(tmp_path / f"out{attempt}")],
            env=ENVIRONMENT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        assert process.stderr is not None
        assert process.stderr.readline() == "comparing: 4 runs\n"
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=PATIENCE)
        assert next(line for line in said.splitlines() if not line.startswith("[")).startswith("interrupted; ")
        assert "Traceback" not in said
        assert wait_until_gone(process.pid) == []


def test_sigterm_says_what_is_kept_as_ctrl_c_does(tmp_path: Path) -> None:
    process = started(write_config(tmp_path, **waiting(tmp_path), workers=1), tmp_path / "out")
    process.terminate()
    _, said = process.communicate(timeout=PATIENCE)
    assert process.returncode == 128 + signal.SIGTERM
    assert said.splitlines()[-1] == (
        f"interrupted; 1 of 4 runs are kept in {tmp_path / 'out'}: run again with -o {tmp_path / 'out'}"
    )


def test_a_reader_that_leaves_early_gets_no_more_and_the_report_is_written(tmp_path: Path) -> None:
    config = write_config(tmp_path)
    shell = f"{' '.join(COMMAND)} compare {config} -o {tmp_path / 'out'} 2>&1 | head -n 1"
    run = subprocess.run(
        ["bash", "-c", shell], env=ENVIRONMENT, capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert len(run.stdout.splitlines()) == 1
    assert run.stderr == ""
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.parametrize("name", ["SIGTERM", "SIGKILL"])
def test_the_runs_end_with_a_comparison_that_is_killed_which_then_goes_on(name: str, tmp_path: Path) -> None:
    config = write_config(tmp_path, **waiting(tmp_path), workers=4)  # none starts later
    process = started(config, tmp_path / "out")
    process.send_signal(signal.Signals[name])
    _, stderr = process.communicate(timeout=PATIENCE)
    assert "Traceback" not in stderr
    assert wait_until_gone(process.pid) == []
    before = files_of(tmp_path / "out" / "runs", WHOLE)
    (tmp_path / "go").touch()
    run = compared(config, tmp_path / "out")
    assert run.stderr.count("kept from an earlier run") == len(before) > 0
    assert before.items() <= files_of(tmp_path / "out" / "runs").items()
    outcomes = {run["label"]: run["outcome"] for run in summary(tmp_path / "out")["runs"]}
    assert outcomes == {"theoretical": "converged", "waiting": "budget", "second": "budget", "third": "budget"}


def test_a_comparison_in_a_folder_in_which_another_writes_is_refused(tmp_path: Path) -> None:
    process = started(write_config(tmp_path, **waiting(tmp_path)), tmp_path / "out")
    second = omnibench("compare", write_config(tmp_path / "second"), "--output", tmp_path / "out")
    (tmp_path / "go").touch()
    process.communicate(timeout=PATIENCE)
    assert process.returncode == 0
    assert_refused(second, f"{tmp_path / 'out'}: another omnibench is writing results there", "--output")
    entries = yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())["calibrators"]
    labels = [entry["label"] or entry["name"] for entry in entries]
    assert labels == [run["label"] for run in summary(tmp_path / "out")["runs"]]


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

@calibrators.register("wants_memory")
class wants_memory(Misbehaving):
    def misbehave(self):
        held = [bytes(10**5) for _ in range(10**9)]

@calibrators.register("hangs")
class hangs(Misbehaving):
    def misbehave(self):
        time.sleep(3600)
"""


def test_a_killed_comparison_of_runs_that_are_killed_hang_or_want_memory_goes_on_and_has_all_rows(
    command: Command, tmp_path: Path
) -> None:
    plugins = write_plugin(tmp_path / "plugins", "misbehaving", MISBEHAVING.format(folder=str(tmp_path)))
    entries = ["theoretical", "is_killed", "wants_memory", "hangs"]
    budget = {"evaluations": 500, "seconds": 0.5}
    limits = {"budget": budget, "memory_mb": 1000, "workers": 2}
    config = write_config(tmp_path, plugins=[str(plugins)], calibrators=entries, **limits)
    process = started(config, tmp_path / "out", ended=2)  # what was killed is tried again when all others have ended
    process.kill()
    process.communicate(timeout=PATIENCE)
    assert wait_until_gone(process.pid) == []
    before, began = files_of(tmp_path / "out" / "runs", WHOLE), tries(tmp_path)
    assert 0 < len(before) < len(entries)

    run = omnibench("compare", config, "--output", tmp_path / "out")
    assert (run.returncode, run.stderr.count("kept from an earlier run")) == (1, len(before)), run.stderr
    assert "every search failed, the first: flower " in run.stderr
    assert "flower hangs seed 1: time, no answer" in run.stderr
    after = files_of(tmp_path / "out" / "runs")
    assert before.items() <= after.items()
    rows = {run["label"]: run for run in summary(tmp_path / "out")["runs"]}
    assert rows.pop("theoretical")["outcome"] == "converged"
    # Of other tests' processes some are killed for lack of memory, which the system counts for all.
    reasons = {label: row["reason"].replace(": the system was out of memory", "") for label, row in rows.items()}
    assert {label: (row["outcome"], reasons[label]) for label, row in rows.items()} == {
        "is_killed": ("failed", "the process died without an answer (killed by SIGKILL) in each of 3 tries"),
        "wants_memory": ("failed", "out of memory (limit 1000 MB)"),
        "hangs": ("time", "ended by force: 0.5 s spent without an answer"),
    }
    assert {(row["train_cost"], row["matrix"]) for row in rows.values()} == {(None, None)}
    now = tries(tmp_path)
    assert {name: now[name] - began[name] for name in ("is_killed", "wants_memory")} == {
        "is_killed": 3,
        "wants_memory": 1,
    }

    again = command("compare", config, "--output", tmp_path / "out")
    assert again.returncode == 1
    assert again.stderr.count("kept from an earlier run") == 2  # who hung for all its time would do so again
    assert files_of(tmp_path / "out" / "runs") == after


def tries(folder: Path) -> Counter[str]:
    """How many times each misbehaving run has begun."""
    return Counter({file.stem: file.stat().st_size for file in folder.glob("*.tries")})
