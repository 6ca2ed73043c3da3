"""Files that ``omnibench example`` writes: configs and plug-ins to begin with, and small recordings.

An example is laid out as the repository is, ``configs`` beside ``plugins``, so that the paths in a config hold;
a sample recording is laid out as its folder in ``samples``. Notebooks are the handbook's.
"""

from __future__ import annotations

from pathlib import Path

from omnibench.cli.handbook_topics import HANDBOOK
from omnibench.config import Model, read_model
from omnibench.errors import ConfigError, require_choice
from omnibench.files import refuse_existing, write_files


class Example(Model):
    """Something to begin with.

    summary: what it is, in one line. files: its files; ``plugins/*`` stands for all plug-ins. commands: what to type
    next, in the folder it was written to. note: what a user must know beforehand. recording: the folder of a data set
    that is simulated from the first file. sample: the folder in ``samples`` of a real recording.
    """

    name: str
    summary: str
    files: tuple[str, ...] = ()
    commands: tuple[str, ...]
    note: str = ""
    recording: str = ""
    sample: str = ""


class _Catalogue(Model):
    examples: tuple[Example, ...]


SAMPLES = Path(__file__).with_name("samples")
EXAMPLES = read_model(_Catalogue, Path(__file__).with_name("examples.yaml")).examples


def find_example(name: str) -> Example:
    """The example called ``name``. UnknownNameError names the nearest one and lists all."""
    known = {example.name: example for example in EXAMPLES}
    require_choice("example", name, known)
    return known[name]


def write_example(example: Example, folder: Path, *, force: bool = False) -> list[Path]:
    """Write the example into ``folder`` and return what was written; a file that is there and equal is left as it is.

    force: replace what is there. ConfigError in one line: a file that differs is there, or the recording is.
    DataError: the disk refuses.
    """
    places = [(place, pattern) for pattern in example.files for place in (bundled_folder(), HANDBOOK)]
    places += [(SAMPLES / example.sample, "**/*")] if example.sample else []
    contents = {
        folder / file.relative_to(place): file.read_bytes()
        for place, pattern in places
        for file in sorted(place.glob(pattern))
        if file.is_file()
    }
    for path, content in contents.items():
        if path.exists() and (not path.is_file() or path.read_bytes() != content) and not force:
            raise ConfigError(f"{path} is there already; choose another folder, or --force to replace it")
    missing = {path: content for path, content in contents.items() if force or not path.exists()}
    recording = folder / example.recording if example.recording else None
    refuse_existing(recording, force=force, folders=True)
    write_files(missing)
    if recording is None:
        return list(missing)
    from omnibench.simulate.source import SimulationRequest

    SimulationRequest(output=recording, config=folder / example.files[0], force=force).write("csv")
    return [*missing, recording]


def bundled_folder() -> Path:
    """The folder with ``configs`` and ``plugins``: their copy in an installed package, or else the clone itself."""
    installed = Path(__file__).with_name("example_files")
    return installed if installed.is_dir() else Path(__file__).parents[2]
