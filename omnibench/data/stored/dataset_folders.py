"""The folders of a data set that is spread over several, named one by one or by a glob."""

from __future__ import annotations

import glob
import os
import shlex
from collections.abc import Sequence
from pathlib import Path

from omnibench.data.tables.table import table_file
from omnibench.errors import DataError

_MAGIC = "*?["


def dataset_folders(places: Path | str | Sequence[Path | str]) -> list[Path]:
    """The folders that places name: each a data set folder or a glob, whose folders come in the order of their names.

    A folder that is named twice counts once. DataError: a glob matches no data set folder, or one without dataset.yaml
    that has wheel samples; or nothing is named.
    """
    if isinstance(places, Path | str):
        places = [places]
    folders = {folder.resolve(): folder for place in places for folder in _named(Path(place))}
    if not folders:
        raise DataError("no data set folder is named")
    return list(folders.values())


def is_glob(place: Path) -> bool:
    """True for a pattern, which no file or folder has as its name."""
    return any(sign in str(place) for sign in _MAGIC) and not place.exists()


def in_few_words(folders: Sequence[Path]) -> str:
    """The folders as words of a shell: a glob that names just these, where there is one, else one by one."""
    begin = os.path.commonprefix([str(folder) for folder in folders])  # noqa: RUF071 (a glob's begin is no path)
    in_one_folder = len(folders) > 2 and begin.startswith(f"{folders[0].parent}/")
    if in_one_folder and _found(f"{glob.escape(begin)}*") == list(folders):
        return f"{shlex.quote(begin)}*"
    return shlex.join(map(str, folders))


def _named(place: Path) -> list[Path]:
    if not is_glob(place):
        return [place]
    pattern = str(place)
    if not (folders := _found(pattern)):
        matching = sorted(glob.glob(pattern, recursive=True))
        seen = f"; {matching[0]} has no dataset.yaml" if matching else ""
        raise DataError(f"{place}: no data set folder matches{seen}")
    return folders


def _found(pattern: str) -> list[Path]:
    matching = [Path(match) for match in sorted(glob.glob(pattern, recursive=True))]
    for match in matching:
        if table_file(match, "wheels") is not None and not (match / "dataset.yaml").is_file():
            raise DataError(f"{match}: it has wheel samples, but no dataset.yaml; write one there, or name the others")
    return [match for match in matching if (match / "dataset.yaml").is_file()]
