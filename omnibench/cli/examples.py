"""Files that ``omnibench example`` writes: configs and plug-ins to begin with, and a small simulated recording.

An example is laid out as the repository is, ``configs`` beside ``plugins``, so that the paths in a config hold.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omnibench.errors import ConfigError, UnknownNameError
from omnibench.files import write_files


@dataclass(frozen=True)
class Example:
    """Something to begin with.

    summary: what it is, in one line. files: its files; ``plugins/*`` stands for all plug-ins. commands: what to type
    next, in the folder it was written to. note: what a user must know beforehand. recording: the folder of a data set
    that is simulated from the first file.
    """

    name: str
    summary: str
    files: tuple[str, ...]
    commands: tuple[str, ...]
    note: str = ""
    recording: str = ""


EXAMPLES = (
    Example(
        "small",
        "a comparison that is over in seconds (simulated)",
        ("configs/small.yaml",),
        ("omnibench compare configs/small.yaml",),
    ),
    Example(
        "apr02",
        "the paper's comparison: all calibrators, 360 runs (simulated)",
        ("configs/apr02.yaml", "plugins/*"),
        ("omnibench compare configs/apr02.yaml",),
    ),
    Example(
        "apr02_robot",
        "the paper's robot from motion command to SLAM (simulated)",
        ("configs/apr02_robot.yaml", "plugins/*"),
        (
            "omnibench simulate configs/apr02_robot.yaml -o data/chain --truth data/chain_truth --report chain.html",
            "omnibench compare configs/apr02_robot.yaml",
        ),
    ),
    Example(
        "hidden_effect",
        "recordings with a hidden effect, for discover (simulated)",
        ("configs/hidden_effect.yaml",),
        (
            "omnibench simulate configs/hidden_effect.yaml -o data/hidden --truth data/truth",
            "omnibench discover data/hidden -o found",
        ),
    ),
    Example(
        "mecanum",
        "a comparison on four mecanum wheels (simulated)",
        ("configs/mecanum.yaml", "plugins/*"),
        ("omnibench compare configs/mecanum.yaml",),
    ),
    Example(
        "design",
        "which commands are worth driving, without any recording",
        ("configs/design.yaml",),
        ("omnibench design configs/design.yaml -o design",),
    ),
    Example(
        "live",
        "the live node, with a simulated recording played to it",
        ("configs/live.yaml", "configs/apr02_calibration.yaml", "configs/apr02.yaml"),
        ("omnibench live configs/live.yaml --replay",),
    ),
    Example(
        "live_fleet",
        "a node for two robots that connect with certificates",
        ("configs/live_fleet.yaml", "configs/live_fleet_client.yaml", "configs/apr02_calibration.yaml"),
        (
            "omnibench keys configs/keys node apr02 apr03 screen lab --host base.local",
            "omnibench live configs/live_fleet.yaml",
        ),
        "base.local stands for the computer that the node runs on; write its name in live_fleet_client.yaml, too",
    ),
    Example(
        "omni3",
        "a comparison on a real robot; its recordings are on GitHub",
        ("configs/omni3.yaml", "plugins/*"),
        (
            "git clone https://github.com/sousarbarb/optiodom",
            "omnibench compare configs/omni3.yaml --data optiodom/data/omni3",
        ),
        "the recordings are not part of omnibench: Sousa et al., OptiOdom, 2022",
    ),
    Example(
        "plugins",
        "calibrators and an importer, each in a file of its own",
        ("plugins/*",),
        ("omnibench list", "omnibench plugin check plugins/cmaes.py"),
    ),
    Example(
        "recording",
        "a small recording, a data set in CSV files (simulated)",
        ("configs/small.yaml",),
        ("omnibench inspect data/small", "omnibench calibrate data/small -o calibration.yaml"),
        recording="data/small",
    ),
)


def find_example(name: str) -> Example:
    """The example called ``name``. UnknownNameError names the nearest one and lists all."""
    known = {example.name: example for example in EXAMPLES}
    if name not in known:
        raise UnknownNameError("example", name, known)
    return known[name]


def write_example(example: Example, folder: Path) -> list[Path]:
    """Write the example into ``folder`` and return what was written; a file that is there and equal is left as it is.

    ConfigError in one line: a file that differs is there, or all of the example is. DataError: the disk refuses.
    """
    wanted = {folder / file: content for file, content in _contents(example)}
    for path, content in wanted.items():
        if path.exists() and (not path.is_file() or path.read_bytes() != content):
            raise ConfigError(f"{path} is there already and is not overwritten; choose another folder")
    missing = {path: content for path, content in wanted.items() if not path.exists()}
    recording = folder / example.recording if example.recording else None
    if recording is not None and recording.exists():
        raise ConfigError(f"{recording} is there already and is not overwritten; choose another folder")
    if not missing and recording is None:
        raise ConfigError(f"{folder}: all of the example {example.name!r} is there already; choose another folder")
    write_files(missing)
    if recording is None:
        return list(missing)
    _simulate(folder / example.files[0], recording)
    return [*missing, recording]


def bundled_folder() -> Path:
    """The folder with ``configs`` and ``plugins``: their copy in an installed package, or else the clone itself."""
    installed = Path(__file__).with_name("example_files")
    return installed if installed.is_dir() else Path(__file__).parents[2]


def _contents(example: Example) -> list[tuple[str, bytes]]:
    """The example's files by their path in the folder that it is written to."""
    bundled = bundled_folder()
    files = [file for pattern in example.files for file in sorted(bundled.glob(pattern)) if file.is_file()]
    return [(file.relative_to(bundled).as_posix(), file.read_bytes()) for file in files]


def _simulate(config: Path, output: Path) -> None:
    from omnibench.simulate.simulation_request import SimulationRequest

    SimulationRequest(output, config).write("csv")
