"""Results that several tests look at, made once a run of the suite by whichever worker needs them first."""

import fcntl
import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from pathlib import Path
from typing import TypeVar

Result = TypeVar("Result")

FOLDER = "OMNIBENCH_TESTS_SHARED_FOLDER"  # environment variable; conftest.py makes the folder and removes it


def shared_folder() -> Path:
    """The folder that all workers of a run of the suite share."""
    return Path(os.environ[FOLDER])


def made_once(make: Callable[[], Result]) -> Callable[[], Result]:
    """Decorate ``make``, at the top of a module, to run once in a run of the suite; its result must be picklable.

    Later calls in the process return the same object, other workers read their copy from a file.
    """

    @cache
    @wraps(make)
    def made() -> Result:
        file = shared_folder() / f"{make.__module__}.{make.__qualname__}.pickle"
        with only_worker(file):
            if not file.exists():
                result = make()
                part = file.with_suffix(".part")
                part.write_bytes(pickle.dumps(result))
                part.rename(file)  # a worker that is killed leaves no half a file
                return result
            found: Result = pickle.loads(file.read_bytes())
            return found

    return made


@contextmanager
def only_worker(file: Path) -> Iterator[None]:
    """Wait until no other worker is in a block with this file. The lock ends with its process, however that ends."""
    with file.with_name(f"{file.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
