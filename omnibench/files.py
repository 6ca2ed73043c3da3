"""Writing files so that each is complete or not there, with a disk's refusal as one line."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import polars as pl

from omnibench.errors import DataError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its place when the block ends well.

    DataError names the path when its folder cannot be made or the disk refuses (full, read-only, no permission).
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.replace(path)
    except OSError as error:
        raise DataError(
            f"{path}: cannot be written: {error.strerror or error}; free space or choose another place"
        ) from None
    finally:
        if partial.parent.is_dir():
            partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all. DataError when the disk refuses."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_table(path: Path, table: pl.DataFrame) -> None:
    """Write a table as CSV or, for any other suffix, as Parquet, whole or not at all. DataError when the disk refuses."""
    content = BytesIO()  # not straight to the disk: of that, polars tells in errors of its own
    table.write_csv(content) if path.suffix == ".csv" else table.write_parquet(content)
    with replacing(path) as partial:
        partial.write_bytes(content.getvalue())


def remove(path: Path) -> None:
    """Remove a file, if it is there. DataError when the disk refuses."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise DataError(f"{path}: cannot be removed: {error.strerror or error}; remove it by hand") from None
