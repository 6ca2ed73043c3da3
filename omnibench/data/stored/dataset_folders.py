"""The folders of a data set that is spread over several, named one by one or by a glob."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from pathlib import Path

from omnibench.errors import DataError

_MAGIC = "*?["


def dataset_folders(places: Path | str | Sequence[Path | str]) -> list[Path]:
    """The folders that places name: each a data set folder or a glob, whose folders come in the order of their names.

    DataError: a glob matches no data set folder, or nothing is named.
    """
    if isinstance(places, Path | str):
        places = [places]
    folders = {folder.resolve(): folder for place in places for folder in _named(Path(place))}
    if not folders:
        raise DataError("no data set folder is named")
    return list(folders.values())


def _named(place: Path) -> list[Path]:
    pattern = str(place)
    if place.exists() or not any(sign in pattern for sign in _MAGIC):
        return [place]
    matching = [Path(match) for match in sorted(glob.glob(pattern, recursive=True))]
    folders = [match for match in matching if (match / "dataset.yaml").is_file()]
    if not folders:
        seen = f"; {matching[0]} has no dataset.yaml" if matching else ""
        raise DataError(f"{place}: no data set folder matches{seen}")
    return folders
