"""The folder that a command writes results to: its default name, whose it is, the link to the newest."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from omnibench.errors import DataError

RESULTS = Path("results")


def check_folder(folder: Path, mark: str, kind: str) -> None:
    """DataError unless ``folder`` is new, empty, or holds an earlier ``kind`` of result.

    mark: the first line of the config.yaml that such results have; it tells them from a folder that happens to hold
    a file of that name.
    """
    if folder.is_file():
        raise DataError(f"{folder}: is a file; name a folder for the results")
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    try:
        ours = (folder / "config.yaml").read_text(encoding="utf-8").startswith(mark)
    except (OSError, UnicodeDecodeError):
        ours = False
    if not ours:
        raise DataError(f"{folder}: holds other files; name a new folder, or one of an earlier {kind}")


def new_folder(parent: Path) -> Path:
    """A folder called by the time, that no other run takes in the same second."""
    name = datetime.now().strftime("%Y-%m-%dT%H-%M-%S")
    count = 1
    while True:
        folder = parent / (name if count == 1 else f"{name}-{count}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            count += 1
        except OSError:
            return folder  # what is wrong is told when the first file is written
        else:
            return folder


def link_latest(folder: Path) -> None:
    """Point ``latest`` beside ``folder`` at it; without links in the file system it is left out."""
    link = folder.parent / "latest"
    temporary = link.with_name(f".{link.name}.{folder.name}")
    try:
        temporary.symlink_to(folder.name, target_is_directory=True)
        temporary.replace(link)
    except OSError:
        temporary.unlink(missing_ok=True)
