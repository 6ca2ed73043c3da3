"""Writing files so that each is complete or not there, with a disk's refusal as one line."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from errno import EACCES, EPERM, EROFS
from io import BytesIO
from pathlib import Path
from typing import Literal

import polars as pl

from omnibench.errors import DataError

TableFormat = Literal["parquet", "csv"]
# What a file will hold, or what writes it to a path and raises OSError when the disk refuses.
FileContent = bytes | Callable[[Path], None]


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its place when the block ends well.

    DataError names the path when its folder cannot be made or the disk refuses (full, read-only, no permission).
    """
    path = path.resolve()  # a link goes on pointing to the file
    if path.exists() and not path.is_file():  # a device or a pipe is written to, never replaced
        try:
            yield path
        except OSError as error:
            raise _refused(path, error) from None
        return
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    made = [folder for folder in path.parents if not folder.exists()]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise DataError(f"{path}: cannot be written: {path.parent} is not a folder; choose another place") from None
    except OSError as error:
        raise _refused(path, error) from None
    try:
        yield partial
        partial.replace(path)
    except OSError as error:
        raise _refused(path, error) from None
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
            for folder in made:  # they stay unless empty
                folder.rmdir()


def _refused(path: Path, error: OSError) -> DataError:
    way_out = "choose another place" if error.errno in (EACCES, EPERM, EROFS) else "free space or choose another place"
    return DataError(f"{path}: cannot be written: {error.strerror or error}; {way_out}")


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all. DataError when the disk refuses."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_table(path: Path, table: pl.DataFrame) -> None:
    """Write a table, whole or not at all: CSV if ``path`` says so, else Parquet. DataError when the disk refuses."""
    write_files({path: encode_table(table, "csv" if path.suffix == ".csv" else "parquet")})


def encode_table(table: pl.DataFrame, table_format: TableFormat) -> bytes:
    """The content of a table's file; polars itself would tell of a full disk in errors of its own."""
    content = BytesIO()
    if table_format == "parquet":
        table.write_parquet(content)
    else:
        table.write_csv(content)
    return content.getvalue()


def write_files(contents: Mapping[Path, FileContent]) -> None:
    """Write files that belong together: when the disk refuses one (DataError), all are as they were."""
    with ExitStack() as files:
        for path, content in contents.items():
            partial = files.enter_context(replacing(path))
            if isinstance(content, bytes):
                partial.write_bytes(content)
            else:
                content(partial)


def remove(path: Path) -> None:
    """Remove a file, if it is there. DataError when the disk refuses."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise DataError(f"{path}: cannot be removed: {error.strerror or error}; remove it by hand") from None
