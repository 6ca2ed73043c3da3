"""Many independent jobs: a picklable specification in, a result in a store out.

A backend runs jobs and gives the encoded results back to the process that asked, which alone writes the store. So a job
whose result is stored is not run again, whatever ended the work, and workers need no folder in common.
"""

from __future__ import annotations

import hashlib
import json
import pickle
import platform
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache
from importlib.metadata import entry_points, version
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from pydantic import BaseModel, TypeAdapter

from omnibench.config import Model, RelativePath
from omnibench.errors import DataError, OmnibenchError, one_line
from omnibench.files import remove, write_text
from omnibench.progress import Progress, Reporter, expect_reading, no_progress, tell_reading
from omnibench.registry import REGISTRIES

T = TypeVar("T")
Encode = Callable[[Any], Any]  # see Store

_PACKAGE = Path(__file__).parents[1]
_NUMERICAL = ("numpy", "scipy", "cvxpy", "clarabel", "nlopt", "cma", "polars", "numba", "pydantic", "shapely")
TRIES = 3  # how often a job whose process or worker is killed is begun: two chances that memory is free again; chosen


class TlsFiles(Model):
    """Files in PEM for a scheduler at tls://: the authority's certificate, and this client's with its key."""

    ca: RelativePath
    cert: RelativePath
    key: RelativePath


def content_key(facts: Mapping[str, Any]) -> str:
    """The key (20 hexadecimal digits) of all that a result depends on: values, documents, dataclasses and arrays."""
    return hashlib.sha256(json.dumps(facts, sort_keys=True, default=_plain).encode()).hexdigest()[:20]


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if callable(contents := getattr(value, "contents", None)):  # a handle, of a run's samples
        return contents()
    if is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in fields(value)}
    return [value.dtype.str, value.shape, hashlib.sha256(value.tobytes()).hexdigest()]  # an array


def code_digest(package: Path, files: Iterable[Path]) -> str:
    """Hash of code: paths of the files in ``package`` and their contents."""
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(file.relative_to(package).as_posix().encode())
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


@cache
def software() -> dict[str, str]:
    """Versions of Python and of packages, omnibench's code by its hash, and installed packages of plug-ins."""
    points = {point for registry in REGISTRIES for point in entry_points(group=registry.group)}
    return {
        "Python": platform.python_version(),
        "omnibench's code": code_digest(_PACKAGE, _PACKAGE.rglob("*.py"))[:10],
        **{package: version(package) for package in (*_NUMERICAL, "dask", "distributed")},
        **{point.dist.name: point.dist.version for point in points if point.dist is not None},
    }


class Store(Protocol[T]):
    """Results of jobs, by key."""

    def get(self, key: str) -> T | None:
        """The stored result; None where there is none."""

    def encode(self, result: T) -> Any:
        """What ``put_encoded`` takes; called where the result was made. ValueError for a wrong type."""

    def put_encoded(self, key: str, encoded: Any) -> None:
        """Store a result that ``encode`` has encoded. DataError when it cannot be written."""


@dataclass(frozen=True)
class ResultStore(Store[T]):
    """Results by key, each in a JSON file in ``folder``.

    kind: their class, a dataclass or a document whose fields pydantic can write and read (arrays: ``JsonArray``).
    """

    folder: Path
    kind: type[T]

    def get(self, key: str) -> T | None:
        """The stored result; None where there is none, or its file is damaged."""
        try:
            return _adapter(self).validate_json(self.file(key).read_bytes())
        except (OSError, ValueError):  # ValueError: pydantic's and Unicode's errors, too
            return None

    def put(self, key: str, result: T) -> None:
        """Store a result, whole or not at all. DataError when it cannot be written, ValueError for a wrong type."""
        self.put_encoded(key, self.encode(result))

    def encode(self, result: T) -> str:
        """What the result's file will hold. ValueError for a wrong type."""
        return json.dumps(_adapter(self).dump_python(result, mode="json", warnings="error"))

    def put_encoded(self, key: str, encoded: str) -> None:
        """Write a result's file. DataError when it cannot be written."""
        write_text(self.file(key), encoded)

    def file(self, key: str) -> Path:
        """The result's file."""
        return self.folder / f"{key}.json"

    def remove(self) -> None:
        """Remove all results, half-written ones too, and the folder if it is then empty. DataError: disk refuses."""
        for file in (*self.folder.glob("*.json"), *self.folder.glob(".*.json.*.partial")):
            remove(file)
        with suppress(OSError):
            self.folder.rmdir()


@cache
def _adapter(store: ResultStore[T]) -> TypeAdapter[T]:
    return TypeAdapter(store.kind)


@dataclass(frozen=True)
class Job(Generic[T]):
    """Specification of a job, which can be pickled.

    key: names everything that the result depends on, see ``content_key``. function: from the top of a module; called
    with the argument and a function that reports progress. seconds, memory_mb: limits of its wall time and of its
    process's memory (10^6 bytes), None for no limit. A job with a limit has a process of its own; those without share
    processes, so that they must leave nothing behind. timed: its seconds are compared, so that on another machine it
    has the worker to itself. shared: objects within the argument that other jobs hold, too, and none of them changes;
    to another process each travels once.
    """

    key: str
    function: Callable[[Any, Reporter], T]
    argument: Any
    seconds: float | None = None
    memory_mb: float | None = None
    timed: bool = False
    shared: tuple[Any, ...] = ()


class BackendError(OmnibenchError):
    """The machines that run jobs are lost, or one of them is unfit; results so far are in the store."""


@dataclass(frozen=True)
class Failure:
    """Reason, in words, why a job has no result.

    pickled: the error that its function raised, see ``error``. over_time: it was ended at its time limit. killed: its
    process was killed, not by a fault of its own as far as can be known. worker: address of the Dask worker, if any.
    """

    reason: str
    pickled: bytes | None = field(default=None, repr=False)
    over_time: bool = False
    killed: bool = False
    worker: str = field(default="", compare=False)

    @property
    def error(self) -> BaseException | None:
        """What the job's function raised; None if it did not, or if the error cannot be pickled."""
        return None if self.pickled is None else pickle.loads(self.pickled)


def failure_of(error: BaseException, memory_mb: float | None) -> Failure:
    """The failure of a job that raised an error. memory_mb: the job's limit."""
    reason = one_line(f"{type(error).__name__}: {error}")
    if isinstance(error, MemoryError):
        reason = "out of memory" if memory_mb is None else f"out of memory (limit {memory_mb:g} MB)"
    try:
        pickled = pickle.dumps(error)
        pickle.loads(pickled)
    except Exception:  # whatever the error's class raises
        return Failure(reason)
    return Failure(reason, pickled)


@dataclass(frozen=True)
class JobEnd:
    """The end of a job: its encoded result, or why it has none. last: its last progress."""

    encoded: Any = None
    failure: Failure | None = None
    last: Progress | None = None


class JobWatch(Generic[T]):
    """Callbacks about jobs, by their numbers in the order in which they were given; these do nothing."""

    def began(self, number: int) -> None:
        """A worker has begun the job, perhaps not for the first time."""

    def moved(self, number: int, event: Progress) -> None:
        """The job reports progress, at most five times a second."""

    def ended(self, number: int, ending: T | Failure, reused: bool) -> None:
        """The job has ended, or its result was there already (``reused``)."""


Numbered = tuple[int, Job[T]]
Ends = Generator[tuple[int, Job[T], JobEnd], None, None]


class Backend(Protocol):
    """Place where jobs are run: this process, processes of this machine, or other machines."""

    def run(self, jobs: Iterable[Numbered[T]], encode: Encode, watch: JobWatch[T]) -> Ends[T]:
        """Run numbered jobs, which are taken as workers become free, and yield them as they end.

        encode: see Store; called by the worker. When the iterator is closed or interrupted, workers are ended at once.
        """


def run_jobs(jobs: Iterable[Job[T]], store: Store[T], backend: Backend, watch: JobWatch[T]) -> None:
    """Run the jobs whose results are not in the store; ``watch`` hears of every end, results come from the store.

    A job whose process was killed is tried again after all others, at most three times in all: what killed it (the
    system, which lacked memory; a person) may be gone by then. A job that raised, was over its time or memory limit, or
    crashed would do so again. Whatever ``watch`` raises ends the work.
    """
    waiting = _not_stored(jobs, store, watch)
    for tried in range(1, TRIES + 1):
        killed: list[tuple[int, Job[T]]] = []
        with closing(backend.run(waiting, store.encode, watch)) as ends:
            for number, job, end in ends:
                failure = end.failure
                if end.last is not None:
                    watch.moved(number, end.last)
                if failure is None:
                    store.put_encoded(job.key, end.encoded)
                    result = store.get(job.key)
                    watch.ended(number, Failure("its result cannot be read") if result is None else result, False)
                elif failure.killed and tried < TRIES:
                    killed.append((number, job))
                else:
                    tries = f" in each of {tried} tries" if failure.killed else ""
                    watch.ended(number, replace(failure, reason=failure.reason + tries), False)
        if not killed:
            return
        waiting = iter(killed)


def _not_stored(jobs: Iterable[Job[T]], store: Store[T], watch: JobWatch[T]) -> Iterator[tuple[int, Job[T]]]:
    """The jobs that have to be run, with their numbers."""
    for number, job in enumerate(jobs):
        result = store.get(job.key)
        if result is None:
            yield number, job
        else:
            watch.ended(number, result, True)


def gathered(
    backend: Backend | None,
    function: Callable[[Any, Reporter], T],
    arguments: Sequence[Any],
    shared: tuple[Any, ...] = (),
) -> list[T]:
    """Results of ``function`` (from the top of a module) for every argument, in their order; None: without jobs.

    Its results are not None. shared: see Job. DataError, or what the function raised: one of them has no result.
    """
    if backend is None:
        return [function(argument, no_progress) for argument in arguments]
    results = _Results[T]()
    expect_reading(len(arguments), "part")
    jobs = (Job(str(number), function, argument, shared=shared) for number, argument in enumerate(arguments))
    run_jobs(jobs, results, backend, results)
    return [results.by_key[str(number)] for number in range(len(arguments))]


class _Results(Store[T], JobWatch[T]):
    """Results in memory. The first failure ends the work."""

    def __init__(self) -> None:
        self.by_key: dict[str, T] = {}

    def get(self, key: str) -> T | None:
        return self.by_key.get(key)

    @staticmethod
    def encode(result: T) -> bytes:
        return pickle.dumps(result, pickle.HIGHEST_PROTOCOL)

    def put_encoded(self, key: str, encoded: bytes) -> None:
        self.by_key[key] = pickle.loads(encoded)

    def ended(self, number: int, ending: T | Failure, reused: bool) -> None:  # noqa: ARG002
        if not isinstance(ending, Failure):
            tell_reading(1, "part")
            return
        error = ending.error or DataError(f"one of many jobs has no result: {ending.reason}; run again")
        if ending.worker and isinstance(error, DataError):
            raise DataError(f"worker {ending.worker}: {error} (workers must see the files of a large data set)")
        raise error
