"""Helpers that run omnibench as a user does: in processes of its own, with small configs."""

import io
import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from sample_robots import APR02
from shared_results import made_once, shared_folder
from timing import PATIENCE

from omnibench import registry
from omnibench.__main__ import main
from omnibench.compare.config import CompareConfig, read_compare_config
from omnibench.compare.result import ComparisonResult
from omnibench.compare.run import run_comparison

ROOT = Path(__file__).resolve().parents[1]
CONFIGS = ROOT / "configs"
RECORDINGS = ROOT.parent / "shared" / "data"
COMMAND = (sys.executable, "-m", "omnibench")
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}

# What every plug-in file of the tests begins with.
PLUGIN_IMPORTS = """
import os, sys, threading, time
import numpy as np
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.registry import Options, calibrators
"""


PLUGIN_EFFECT = """
import numpy as np
from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter

@effects.register("{name}")
class Mine(MotionEffect):
    "An effect of the tests."

    stage, physics, source, shows_in = "{stage}", "Tyres grow.", "first principles", "command"
    fixed_parameters = (Parameter({parameter}),)

    def correction(self, signals, values):
        return {correction}
"""


def omnibench(
    *arguments: object, cwd: Path | None = None, timeout: float = 300, **others: Any
) -> subprocess.CompletedProcess[str]:
    """Run one command to its end; what it printed. Without a folder, plug-ins of the tests' own are not loaded."""
    return subprocess.run(
        [*COMMAND, *map(str, arguments)],
        cwd=cwd,
        env=ENVIRONMENT | ({"OMNIBENCH_PLUGINS": "none"} if cwd is None else {}),
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
        **others,
    )


def python(program: str, *arguments: object, **others: Any) -> subprocess.CompletedProcess[str]:
    """Run a Python program to its end; what it printed."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False, **others)


def alive(session: int) -> list[str]:
    """Commands of the processes of a session that have not ended."""
    listing = ["ps", "-o", "stat=,args=", "-s", str(session)]
    listed = subprocess.run(listing, capture_output=True, text=True, check=False).stdout.splitlines()
    return [line for line in listed if not line.startswith("Z")]


def compared(config: Path, output: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a comparison that must succeed."""
    run = omnibench("compare", config, "--output", output, *arguments)
    assert run.returncode == 0, run.stderr
    assert "Traceback" not in run.stderr
    return run


def compared_here(output: Path, **changes: Any) -> ComparisonResult:
    """Run the small comparison with ``changes``, in this process, which is faster; plug-ins are loaded for it only."""
    with registries_restored():
        return run_comparison(CompareConfig.model_validate(small(**changes)), output)


class Printed(NamedTuple):
    """How a command ended and what it printed."""

    returncode: int
    stdout: str
    stderr: str


def assert_refused(run: Printed | subprocess.CompletedProcess[str], *parts: str) -> None:
    """Assert one line on standard error with all ``parts``, nothing on standard output, and exit code 2."""
    assert run.returncode == 2, run.stdout + run.stderr
    assert run.stdout == ""
    assert run.stderr.startswith("error: ")
    assert run.stderr.count("\n") == 1, run.stderr
    for part in parts:
        assert part in run.stderr


@contextmanager
def refused(error: Any, *parts: str, start: str = "", match: str | None = None) -> Iterator[None]:
    """What is done inside must be refused in one line with all ``parts``."""
    with pytest.raises(error, match=match) as refusal:
        yield
    told = str(refusal.value)
    assert told.startswith(start)
    assert "\n" not in told
    for part in parts:
        assert part in told


def succeeded(run: Any) -> Any:
    """What a command printed that must have ended well."""
    assert run.returncode == 0, run.stderr
    return run


def flower(**changes: Any) -> dict[str, Any]:
    """Six short simulated runs to train and six to validate: what a config says under ``simulate``."""
    return {
        "robot": APR02,
        "sample_period": 0.05,
        "commands": {"speeds": [0.2], "directions_deg": [0, 120, 240], "turn_rates": [-0.35, 0.35]},
        "repetitions": 1,
        "truth": {"published": "palacin2023_eq8"},
        "noise": {"encoder": 0.02, "pose_position": 0.005, "pose_heading": 0.005},
        "train": {"seed": 1, "distance": 1.0},
        "validation": {"seed": 2, "distance": 1.0},
        **changes,
    }


def search(label: str = "search", candidates: int = 300, **options: Any) -> dict[str, Any]:
    """A config's entry for a random search."""
    return {"name": "random_search", "label": label, "options": {"candidates": candidates, **options}}


def small(**changes: Any) -> dict[str, Any]:
    """A comparison of three calibrators that takes a second: a config's content."""
    return {
        "name": "small",
        "datasets": {"flower": {"simulate": flower()}},
        "budget": {"evaluations": 2000, "seconds": 60},
        "calibrators": ["theoretical", "closed_form", search()],
        "workers": 2,
        "bootstrap": {"resamples": 200},
        "certificate": None,
        **changes,
    }


def write_config(folder: Path, **changes: Any) -> Path:
    """Write the config of the small comparison into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "small.yaml"
    file.write_text(yaml.safe_dump(small(**changes)), encoding="utf-8")
    return file


def write_plugin(folder: Path, name: str, body: str) -> Path:
    """Write a plug-in file, ``body`` after the imports that calibrators need; the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.py").write_text(PLUGIN_IMPORTS + body, encoding="utf-8")
    return folder


def write_effect(file: Path, stage: str, parameter: str, correction: str) -> None:
    """Write a plug-in file whose effect of motion has the file's name."""
    file.parent.mkdir(parents=True, exist_ok=True)
    text = PLUGIN_EFFECT.format(name=file.stem, stage=stage, parameter=parameter, correction=correction)
    file.write_text(text, encoding="utf-8")


@contextmanager
def registries_restored() -> Iterator[None]:
    """Forget after the block what was registered or loaded in it: a plug-in file that changed is loaded again."""
    for each in registry.REGISTRIES:
        each.entries()  # what is built in stays
    entries, loaded = [dict(each._entries) for each in registry.REGISTRIES], dict(registry._loaded)
    try:
        yield
    finally:
        for each, kept in zip(registry.REGISTRIES, entries, strict=True):
            each._entries = kept
        registry._loaded.clear()
        registry._loaded.update(loaded)


def summary(output: Path) -> dict[str, Any]:
    """The content of a comparison's summary.json."""
    content: dict[str, Any] = json.loads((output / "summary.json").read_text(encoding="utf-8"))
    return content


def without_seconds(output: Path) -> list[dict[str, Any]]:
    timed = ("seconds", "reference_seconds")
    return [{name: value for name, value in run.items() if name not in timed} for run in summary(output)["runs"]]


@made_once
def compared_once() -> ComparisonResult:
    """A comparison of four calibrators with two seeds, its config beside it: all tests share it, change a copy."""
    entries = ["theoretical", "closed_form", search(), {"name": "parametric", "label": "Eq. (3) [°]"}]
    config = write_config(shared_folder() / "compared", calibrators=entries, seeds=[1, 2])
    return run_comparison(read_compare_config(config), config.parent / "out")


def files_of(folder: Path, pattern: str = "*") -> dict[str, tuple[int, bytes]]:
    """Time of change and content of every file."""
    files = (file for file in folder.rglob(pattern) if file.is_file())
    return {str(file.relative_to(folder)): (file.stat().st_mtime_ns, file.read_bytes()) for file in files}


def rows(output: Path) -> dict[str, dict[str, Any]]:
    """The runs of a comparison by label; of several seeds the last one."""
    return {run["label"]: run for run in summary(output)["runs"]}


Command = Callable[..., Printed]


def commands_of_this_process(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    """A function that runs commands in this process: the code of the installed command, a second faster."""

    def command(*arguments: object) -> Printed:
        monkeypatch.setattr(sys, "argv", ["omnibench", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended, registries_restored():
            main()
        printed = capfd.readouterr()
        assert "Traceback" not in printed.err
        return Printed(int(ended.value.code or 0), printed.out, printed.err)

    return command


def run_here(*arguments: object, cwd: Path) -> Printed:
    """Run one command in this process and the folder ``cwd``: for results that the tests of a module share."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.chdir(cwd)
        patch.setattr(sys, "argv", ["omnibench", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended, registries_restored():
            main()
    return Printed(int(ended.value.code or 0), out.getvalue(), err.getvalue())


@contextmanager
def disk_that_takes(size: int) -> Iterator[None]:
    """A disk that takes no file of this process larger than ``size`` bytes, captured output among them."""
    _, hard = limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


class Prepared(NamedTuple):
    """A small config, its data set and truth, and a calibration."""

    config: Path
    data: Path
    truth: Path
    calibration: Path


@made_once
def prepare() -> Prepared:
    """Make a config, a data set, its truth and a calibration, by the commands themselves."""
    folder = shared_folder() / "prepared"
    config = write_config(folder)
    data, truth, calibration = folder / "data", folder / "truth", folder / "calibration.yaml"
    for arguments in (
        ("simulate", config, "-o", data, "--truth", truth),
        ("calibrate", data, "--calibrator", "closed_form", "-o", calibration),
    ):
        run = run_here(*arguments, cwd=folder)
        assert run.returncode == 0, run.stderr
    return Prepared(config, data, truth, calibration)
