"""Files: checked before they are read, written whole or not at all; folders that hold nothing else."""

from __future__ import annotations

import os
import shutil
import stat
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from errno import EACCES, EISDIR, ENOSPC, EROFS
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from omnibench.errors import ConfigError, DataError, not_written

if TYPE_CHECKING:
    import polars as pl

TableFormat = Literal["parquet", "csv"]
# The bytes of a file, or a function that writes it to a path and raises OSError when the disk refuses.
FileContent = bytes | Callable[[Path], None]

RESULTS = Path("results")  # the folder of results, where the user names none
MOST_TEXT = 1 << 30  # bytes of a text that is read whole, as tables are; chosen

_LEAST_SPACE = 1 << 16  # bytes: a calibration or the tables of a small comparison
_SPECIAL = {stat.S_IFIFO: "pipe", stat.S_IFCHR: "device", stat.S_IFBLK: "device", stat.S_IFSOCK: "socket"}
_NO_TEXT = "cannot be read: it is not a text file in UTF-8; save it so (CSV UTF-8), or leave it out"
_FORMULA = r"^'*[=+\-@\t\r]"


def check_file(path: Path, most: int | None = None, *, text: bool = False) -> None:
    """DataError in one line unless a path is a file that may be read, of at most ``most`` bytes; links are followed.

    Pipes and devices may have no end, and nobody may write to them. text: refuse one with holes, which are zero bytes.
    """
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise DataError(f"{path}: is a folder; name the file in it")
        if not stat.S_ISREG(status.st_mode):
            kind = _SPECIAL.get(stat.S_IFMT(status.st_mode), "special file")
            raise DataError(f"{path}: is a {kind}; write its content to a file, and name that")
        if status.st_size == 0 and path.resolve().is_relative_to("/proc"):
            raise DataError(f"{path}: has no size, as the system makes it; write its content to a file, and name that")
        if most is not None and status.st_size > most:
            raise DataError(f"{path}: has {status.st_size:,} bytes, more than the {most:,} that such a file may have")
        with path.open("rb") as file:
            looked_for = text and status.st_size > 0 and hasattr(os, "SEEK_HOLE")
            if looked_for and os.lseek(file.fileno(), 0, os.SEEK_HOLE) < status.st_size:
                raise DataError(f"{path}: {_NO_TEXT}")
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the path
        raise DataError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def check_source(path: Path) -> None:
    """DataError in one line unless a path is a folder, or a file that may be read."""
    if not path.exists():
        raise DataError(f"{path}: no such file or folder")
    if not path.is_dir():
        check_file(path)


def read_bytes(path: Path, most: int = MOST_TEXT, *, text: bool = False) -> bytes:
    """The content of a file of at most ``most`` bytes. DataError as for ``check_file``."""
    check_file(path, most, text=text)
    try:
        with path.open("rb") as file:
            content = file.read(most + 1)  # it may grow
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
    if len(content) > most:
        raise DataError(f"{path}: has more than the {most:,} bytes that such a file may have")
    return content


def read_text(path: Path, most: int = MOST_TEXT) -> str:
    """The text of a file of at most ``most`` bytes, in UTF-8. DataError as for ``check_file``; it is no such text."""
    try:
        return read_bytes(path, most, text=True).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DataError(f"{path}: {_NO_TEXT}") from None


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its place when the block ends well.

    Where it replaces a file, it is on the disk before, so that a machine that loses its power has the one or the other.
    DataError names the path when its folder cannot be made or the disk refuses (full, read-only, no permission).
    """
    path = resolved(path)  # a link goes on pointing to the file
    special = path.exists() and not path.is_file()  # a device or a pipe is written to, never replaced
    partial = path if special else path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with _folder_made(path.parent, None if special else partial):
            yield partial
            if special:
                return
            replaced = path.exists()
            if replaced:
                _to_disk(partial)
            partial.replace(path)
            if replaced:
                with suppress(OSError):  # a file system that cannot, or a folder that cannot be read
                    _to_disk(path.parent)
    except OSError as error:
        raise not_written(path, error) from None


@contextmanager
def _folder_made(folder: Path, leftover: Path | None = None) -> Iterator[None]:
    """Make a folder and those above it that are missing; when the block ends, those that are still empty go again.

    leftover: a file that is removed before, if it is there.
    """
    missing = [parent for parent in (folder, *folder.parents) if not parent.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        with suppress(OSError):
            if leftover is not None:
                leftover.unlink(missing_ok=True)
            for parent in missing:
                parent.rmdir()


def _to_disk(path: Path) -> None:
    """Wait until a file's content, or the names in a folder, are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def results_locked(folder: Path) -> Iterator[None]:
    """Make a folder, if it is missing, and keep other processes from writing results there.

    The lock is the system's, and gone with this process, however it dies. DataError: another process has it.
    """
    if sys.platform == "win32":  # which has no locks of folders
        yield
        return
    import fcntl

    check_place(folder)
    with ExitStack() as lock, ExitStack() as made:  # an empty folder goes while it is locked
        try:
            made.enter_context(_folder_made(folder))
            descriptor = os.open(folder, os.O_RDONLY)
        except OSError as error:
            raise not_written(folder, error) from None
        lock.callback(os.close, descriptor)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DataError(
                f"{folder}: another omnibench is writing results there; name another folder (--output), or wait for it"
            ) from None
        except OSError:
            pass  # a file system without locks
        yield


def refuse_existing(*paths: Path | None, force: bool, folders: bool = False) -> None:
    """Check the files (or ``folders``) that a user named for output, before the work; None: none is named.

    ConfigError in one line: one is there with content and is not to be replaced (``force``). DataError: it is a folder
    where a file is wanted, a link that leads to itself, or in a place where nobody may write or no space is left.
    """
    for path in paths:
        if path is None:
            continue
        if resolved(path).is_dir() and not folders:
            raise not_written(path, OSError(EISDIR, ""))
        if _holds_something(path) and not force:
            other = "folder" if folders else "file"
            raise ConfigError(f"{path} is there already; choose another {other}, or --force to replace it")
        check_place(path)


def check_place(path: Path) -> None:
    """DataError in one line when a file or a folder cannot be made there; devices and pipes are not made."""
    target = resolved(path)
    if target.exists() and not target.is_file() and not target.is_dir():
        return
    existing = target if target.is_dir() else next(folder for folder in target.parents if folder.exists())
    if not existing.is_dir():
        raise DataError(f"{path}: cannot be written: {existing} is not a folder; choose another place")
    if not os.access(existing, os.W_OK | os.X_OK):
        code = EROFS if os.statvfs(existing).f_flag & os.ST_RDONLY else EACCES
        raise not_written(path, OSError(code, os.strerror(code)))
    disk = shutil.disk_usage(existing)
    if disk.total and disk.free < _LEAST_SPACE:  # a total of 0: a file system that does not count
        raise not_written(path, OSError(ENOSPC, os.strerror(ENOSPC)))


def resolved(path: Path) -> Path:
    """The path without links. DataError: it is a link that leads to itself."""
    try:
        return path.resolve()
    except (OSError, RuntimeError):
        raise DataError(f"{path}: cannot be written: it is a link that leads to itself; choose another place") from None


def _holds_something(path: Path) -> bool:
    """True for a file or a folder with content; devices and pipes hold nothing that writing would destroy."""
    try:
        return any(path.iterdir()) if path.is_dir() else path.is_file() and path.stat().st_size > 0
    except OSError:
        return False  # whoever writes there says what is wrong


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all. DataError when the disk refuses."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_table(path: Path, table: pl.DataFrame) -> None:
    """Write a table, whole or not at all: CSV if ``path`` says so, else Parquet. DataError when the disk refuses."""
    write_files({path: encode_table(table, "csv" if path.suffix == ".csv" else "parquet")})


def encode_table(table: pl.DataFrame, table_format: TableFormat) -> bytes:
    """The content of a table's file, in memory: polars would report a full disk in errors of its own."""
    content = BytesIO()
    if table_format == "parquet":
        table.write_parquet(content)
    else:
        quoted_formulas(table).write_csv(content)
    return content.getvalue()


def quoted_formulas(table: pl.DataFrame) -> pl.DataFrame:
    """A table for CSV with ' before the texts that spreadsheets run as formulas (OWASP, CSV injection)."""
    import polars as pl

    def quoted(text: pl.Expr) -> pl.Expr:
        formula = text.str.contains(_FORMULA) & text.cast(pl.Float64, strict=False).is_null()  # -1.5 stays a number
        return pl.when(formula).then("'" + text).otherwise(text)

    texts = [name for name, kind in table.schema.items() if kind == pl.String]
    return table.with_columns(quoted(pl.col(name)).alias(name) for name in texts)


def unquoted_formulas(table: pl.DataFrame) -> pl.DataFrame:
    """A table as it was before ``quoted_formulas``."""
    import polars as pl

    return table.with_columns(pl.col(pl.String).str.replace(f"^'({_FORMULA[1:]})", "${1}"))


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


def check_results_folder(folder: Path, mark: str, kind: str, *, force: bool = False) -> None:
    """DataError unless ``folder`` is new, empty, or holds earlier results of the same ``kind`` (comparison, discovery).

    mark: how the config.yaml in such results begins, which tells it from somebody else's config.yaml. force: write
    beside other files and replace those of the same names.
    """
    if resolved(folder).is_file():
        raise DataError(f"{folder}: is a file; name a folder for the results")
    if force or not _holds_something(folder):
        return
    try:
        ours = read_text(folder / "config.yaml").startswith(mark)
    except DataError:
        ours = False
    if not ours:
        raise DataError(f"{folder}: holds other files; name a new folder, or one of an earlier {kind}, or add --force")


def new_results_folder(parent: Path) -> Path:
    """Make a folder in ``parent`` that is named by the time; runs of the same second get folders of their own."""
    name = datetime.now().strftime("%Y-%m-%dT%H-%M-%S")
    number = 1
    while True:
        folder = parent / (name if number == 1 else f"{name}-{number}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            number += 1
            continue
        except OSError:
            pass  # the first file that is written there reports what is wrong
        return folder


def link_latest(folder: Path) -> None:
    """Make the link ``latest`` beside ``folder`` point to it; left out where the file system has no links."""
    link = folder.parent / "latest"
    temporary = link.with_name(f".{link.name}.{folder.name}")
    try:
        temporary.symlink_to(folder.name, target_is_directory=True)
        temporary.replace(link)
    except OSError:
        temporary.unlink(missing_ok=True)
