"""The protocol of many independent jobs: a picklable specification in, a result file out.

A job's result is what stands in the store, and nothing else: the file that its worker wrote, or that the client wrote
for a worker on another machine. So a job whose file is there is not run again, whatever became of the parent, and a
worker that dies after writing has done its work. A backend only runs jobs and says which ended how.
"""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Generic, NamedTuple, Protocol, Self, TypeVar

from pydantic import BaseModel, TypeAdapter

from omnibench.config import Model, RelativePath
from omnibench.errors import DataError, OmnibenchError
from omnibench.files import remove, write_text
from omnibench.progress import Progress, Reporter, expect_reading, no_progress, tell_reading

T = TypeVar("T")

TRIES = 3  # how often a job whose worker is killed is begun: two chances that memory is free again; chosen


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


class Store(Protocol[T]):
    """Where results of jobs are kept, by key."""

    def anchored(self) -> Self:
        """The store, to be found by a job that changes its working folder, too."""
        return self

    def get(self, key: str) -> T | None:
        """The stored result; None where there is none."""

    def keep(self, key: str, result: T) -> Any:
        """Keep a result where it was made; what this returns, if anything, is then given to ``put_content`` at home."""

    def content(self, key: str, result: T) -> Any:
        """The result as ``put_content`` takes it from a machine that does not reach the store."""

    def put(self, key: str, result: T) -> None:
        """Store a result, whole or not at all. DataError when it cannot be written, ValueError for a wrong type."""
        self.put_content(key, self.content(key, result))

    def put_content(self, key: str, content: Any) -> None:
        """Store a result that another process made the content of."""

    def file(self, key: str) -> Path:
        """Where the result stands, in words of a message."""


@dataclass(frozen=True)
class ResultStore(Store[T]):
    """Results by key, each in a JSON file in ``folder``.

    kind: their class, a dataclass or a document whose fields pydantic can write and read (arrays: ``JsonArray``).
    """

    folder: Path
    kind: type[T]

    def anchored(self) -> Self:
        """The store by its folder's absolute path."""
        return replace(self, folder=self.folder.absolute())

    def get(self, key: str) -> T | None:
        """The stored result; None where there is none, or its file is damaged."""
        try:
            return _adapter(self).validate_json(self.file(key).read_bytes())
        except (OSError, ValueError):  # ValueError: pydantic's and Unicode's errors, too
            return None

    def keep(self, key: str, result: T) -> None:
        """Store a result, as ``put``: a job whose file is there has done its work, whatever becomes of its parent."""
        self.put(key, result)

    def content(self, key: str, result: T) -> str:  # noqa: ARG002 (as ``put``)
        """What the result's file will hold. ValueError for a wrong type."""
        return json.dumps(_adapter(self).dump_python(result, mode="json", warnings="error"))

    def put_content(self, key: str, content: str) -> None:
        """Store a result that another process made the content of. DataError when it cannot be written."""
        write_text(self.file(key), content)

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
    process's memory (10^6 bytes), None for no limit. timed: its seconds are compared, so that on another machine it has
    the worker to itself. shared: objects within the argument that other jobs hold, too; to another machine each travels
    once. own: it runs omnibench's own code alone, which leaves nothing behind: such jobs have a process together for
    longer, and within it what they share.
    """

    key: str
    function: Callable[[Any, Reporter], T]
    argument: Any
    seconds: float | None = None
    memory_mb: float | None = None
    timed: bool = False
    shared: tuple[Any, ...] = ()
    own: bool = False

    @property
    def limited(self) -> bool:
        """True for a job with a limit, which needs a process of its own."""
        return self.seconds is not None or self.memory_mb is not None

    def run(self, store: Store[T], report: Reporter) -> None:
        """Do the work here and write the result's file."""
        store.put(self.key, self.function(self.argument, report))


class BackendError(OmnibenchError):
    """The machines that run jobs are lost, or one of them is unfit; results so far are in the store."""


@dataclass(frozen=True)
class Failure:
    """Reason, in words, why a job has no result.

    error: what its function raised. over_time: it was ended at its time limit. killed: its worker was killed, not by
    a fault of its own as far as can be known.
    """

    reason: str
    error: BaseException | None = None
    over_time: bool = False
    killed: bool = False


class Ended(NamedTuple):
    """A job that a backend has run, by its number; failure: None where it ended by itself without an error."""

    number: int
    job: Job[Any]
    failure: Failure | None


class JobWatch(Generic[T]):
    """Callbacks about jobs, by their numbers in the order in which they were given; these do nothing."""

    def began(self, number: int) -> None:
        """A worker has begun the job, perhaps not for the first time."""

    def moved(self, number: int, event: Progress) -> None:
        """The job reports progress."""

    def ended(self, number: int, ending: T | Failure, reused: bool) -> None:
        """The job has ended, or its result was there already (``reused``)."""


class Backend(Protocol):
    """Place where jobs are run: this process, processes of this machine, or other machines."""

    def run(self, jobs: Iterable[tuple[int, Job[T]]], store: Store[T], watch: JobWatch[T]) -> Iterator[Ended]:
        """Run jobs, which are taken as workers become free, and yield them as they end.

        When the iterator is closed or interrupted, workers are ended at once.
        """


def run_jobs(jobs: Iterable[Job[T]], store: Store[T], backend: Backend, watch: JobWatch[T]) -> None:
    """Run the jobs whose results are not in the store; ``watch`` hears of every end, results come from the store.

    A job whose worker was killed is tried again after all others, at most three times in all: what killed it (the
    system, which lacked memory; a person) may be gone by then. A job that raised, was over its time or memory limit, or
    crashed would do so again. Whatever ``watch`` raises ends the work.
    """
    store = store.anchored()
    waiting = _not_stored(jobs, store, watch)
    for tried in range(1, TRIES + 1):
        killed: list[tuple[int, Job[T]]] = []
        for number, job, failure in backend.run(waiting, store, watch):
            result = store.get(job.key)
            if result is not None:
                watch.ended(number, result, reused=False)
            elif failure is None:
                watch.ended(number, Failure(f"its result cannot be read: {store.file(job.key)}"), reused=False)
            elif failure.killed and tried < TRIES:
                killed.append((number, job))
            else:
                if tried > 1:
                    failure = replace(failure, reason=f"{failure.reason} in each of {tried} tries")
                watch.ended(number, failure, reused=False)
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
            watch.ended(number, result, reused=True)


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
    results: _Results[T] = _Results()
    expect_reading(len(arguments), "part")
    jobs = (Job(str(number), function, argument, shared=shared, own=True) for number, argument in enumerate(arguments))
    run_jobs(jobs, _InMemory[T](), backend, results)
    return [results.by_number[number] for number in range(len(arguments))]


class _InMemory(Store[T]):
    """Results in memory, pickled until they are asked for, which is once."""

    def __init__(self) -> None:
        self._contents: dict[str, bytes] = {}

    def __reduce__(self) -> tuple[type[Self], tuple[()]]:
        return type(self), ()  # where results are made nobody needs the others

    def get(self, key: str) -> T | None:
        content = self._contents.pop(key, None)
        return pickle.loads(content) if isinstance(content, bytes) else None  # no text, which events may bring

    def keep(self, key: str, result: T) -> bytes:
        return self.content(key, result)

    def content(self, _: str, result: T) -> bytes:
        return pickle.dumps(result, pickle.HIGHEST_PROTOCOL)

    def put_content(self, key: str, content: bytes) -> None:
        self._contents[key] = content

    def file(self, key: str) -> Path:
        return Path(key)


class _Results(JobWatch[T]):
    """The results, by number. The first failure ends the work."""

    def __init__(self) -> None:
        self.by_number: dict[int, T] = {}

    def ended(self, number: int, ending: T | Failure, reused: bool) -> None:  # noqa: ARG002
        if not isinstance(ending, Failure):
            self.by_number[number] = ending
            tell_reading(1, "part")
        elif ending.error is not None:
            raise ending.error
        else:
            raise DataError(f"one of many jobs has no result: {ending.reason}; run again")
