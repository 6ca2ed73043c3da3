"""Backend of a Dask cluster. Results come back to the client, which alone writes the store.

A job's begin, its reports and its end are events from its worker, in JSON; the future tells that it is lost, and holds
what is pickled, errors and results that are no text, or too large for an event. A worker that is killed takes its jobs
with it, and they are given to another. Their begins are counted here, since the scheduler also counts jobs that only
waited there. (A scheduler that was not started here tries again by itself, by its own setting ``allowed-failures``: it
may begin a job a fourth time before this hears of it.)
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from errno import EDQUOT, ENOSPC
from itertools import count, islice
from queue import Empty, SimpleQueue
from typing import Any, TypeVar
from uuid import uuid4

from distributed import KilledWorker
from distributed.client import FutureCancelledError

from omnibench.errors import DataError, OmnibenchError, one_line
from omnibench.jobs.dask_cluster import WAIT, ClusterLostError, count_slots, lost, lost_if_closed
from omnibench.jobs.dask_worker import JobEvent, JobOutcome, Parcel, carry_out, content, read_events
from omnibench.jobs.job import TRIES, BackendError, Ended, Failure, Job, JobWatch, Store
from omnibench.jobs.job_process import JobEnd, Packer
from omnibench.progress import Progress, Reporter, no_progress

T = TypeVar("T")

_AHEAD = 2  # jobs a slot that are with the cluster: one at work, one that waits for it (chosen)
_FULL = (ENOSPC, EDQUOT)
_LOOK = 1.0  # s between two looks at the scheduler and its workers; chosen
_PARCEL = 0.2  # s of work that travel together: a task costs scheduler, client and worker 5 ms in all, 3 % of that
_LARGEST_PARCEL = 50  # jobs; chosen
_WEIGHT = 0.1  # weight of the latest job's time in the running mean; chosen
_WAITING = "waiting for a worker"
_SUBMISSIONS = 10  # times that a job is sent whose workers die before it begins: chosen, as it is no fault of its own


@dataclass(eq=False)
class _Pending:
    """A job that is with the cluster, in a parcel: the key of its task."""

    number: int
    job: Job[Any]
    parcel: str = ""
    submissions: int = 0
    begins: int = 0
    worker: str = "-"


@dataclass
class DaskBackend:
    """Runs jobs on the workers of a cluster. requirements: see ``checked_requirements``. report: told of waiting."""

    client: Any
    requirements: bytes
    report: Reporter = no_progress
    packer: Packer = field(default_factory=Packer)
    topic: str = field(default_factory=lambda: f"omnibench-{uuid4().hex[:12]}")
    events: SimpleQueue[object] = field(default_factory=SimpleQueue)
    _data: dict[str, Any] = field(default_factory=dict)
    _runs: Iterator[int] = field(default_factory=count)

    def __post_init__(self) -> None:
        put = self.events.put  # the client keeps what handles a topic, even when it is heard no more
        self.client.subscribe_topic(self.topic, lambda event: put(event[1]))

    def run(self, jobs: Iterable[tuple[int, Job[T]]], store: Store[T], watch: JobWatch[T]) -> Iterator[Ended]:
        """Run the jobs, see Backend. ClusterLostError, or UnfitWorkerError of a worker that joined later."""
        waiting = iter(jobs)
        with lost_if_closed(self.client):
            run = _Run(self, next(self._runs), store, watch)
            try:
                while True:
                    while run.room and (items := [_Pending(*item) for item in islice(waiting, run.parcel_size)]):
                        run.submit(items)
                    if not run.pending:
                        return
                    yield from run.ends()
            finally:
                run.close()

    def data(self, name: str, value: bytes) -> Any:
        """The future of data, which go to the scheduler once, and from there to each worker that needs them."""
        if name not in self._data or self._data[name].status == "error":  # workers were killed that were to hold them
            self._data[name] = self.client.submit(content, value, key=f"omnibench-data-{name}-{uuid4().hex[:8]}")
        return self._data[name]


class _Run:
    """The jobs of one call of ``run``. number: of the call. pending: those with the cluster, by their numbers."""

    def __init__(self, backend: DaskBackend, number: int, store: Store[Any], watch: JobWatch[Any]) -> None:
        self.pending: dict[int, _Pending] = {}
        self._number = number
        self._backend, self._client, self._store, self._watch = backend, backend.client, store, watch
        self._futures: dict[str, Any] = {}
        self._numbers: dict[str, set[int]] = {}  # jobs of each parcel that have not ended
        self._seconds = _PARCEL  # a job takes about so long
        self._slots = max(count_slots(self._client), 1)
        self._without: float | None = None  # time since which there has been no worker
        self._looked = time.monotonic()

    @property
    def room(self) -> bool:
        """True if the cluster is to be given more."""
        return len(self._futures) < _AHEAD * self._slots

    @property
    def parcel_size(self) -> int:
        """Number of jobs that travel together, by the time that those before took."""
        return min(max(int(_PARCEL / max(self._seconds, 1e-6)), 1), _LARGEST_PARCEL)

    def submit(self, items: Sequence[_Pending]) -> None:
        """Give jobs to the cluster, in one parcel."""
        jobs: list[tuple[int, Job[Any]]] = []
        shared: dict[str, bytes] = {}
        key = f"{self._backend.topic}-{uuid4().hex[:12]}"
        for item in items:
            job = self._backend.packer.portable(item.job)
            shared |= job.argument.shared
            jobs.append((item.number, replace(job, argument=replace(job.argument, shared={}))))
            item.parcel = key
            item.submissions += 1
            self.pending[item.number] = item
        self._numbers[key] = {item.number for item in items}
        self._futures[key] = self._client.submit(
            carry_out,
            Parcel(self._backend.topic, self._number, self._store, tuple(jobs), tuple(shared)),
            self._backend.data("requirements", self._backend.requirements),
            *(self._backend.data(name, value) for name, value in shared.items()),
            key=key,
            pure=False,
        )

    def ends(self) -> Iterator[Ended]:
        """Wait a moment for events, which are passed on; the jobs that have ended."""
        texts: list[object] = []
        with suppress(Empty):
            texts.append(self._backend.events.get(timeout=_LOOK))
            while True:
                texts.append(self._backend.events.get_nowait())
        for text in texts:
            number, events = read_events(text)
            for event in events if number == self._number else ():  # others are of a call that was interrupted
                if (item := self.pending.get(event.number)) is not None:
                    yield from self._heard(item, event)
        if time.monotonic() - self._looked >= _LOOK:
            self._look()
            for key in [*self._futures]:
                yield from self._lost(key)

    def close(self) -> None:
        """Cancel what is left."""
        if self._client.status == "running" and self._futures:
            with suppress(OSError):  # a scheduler that does not answer in time
                self._client.cancel([*self._futures.values()], force=True)

    def _heard(self, item: _Pending, event: JobEvent) -> Iterator[Ended]:
        if event.progress is not None:
            self._watch.moved(item.number, event.progress)
        if event.fetch:
            with suppress(KilledWorker):  # ``_lost`` tells of such jobs
                try:
                    outcomes = self._futures[item.parcel].result()
                except FutureCancelledError:
                    raise lost(self._client) from None
                for outcome in outcomes:
                    if (fetched := self.pending.get(outcome.number)) is not None:
                        yield self._ended(fetched, outcome)
        elif event.answer is not None:
            yield self._ended(item, JobOutcome(item.number, JobEnd(event.answer), event.seconds))
        elif event.progress is None:
            item.begins += 1
            if item.begins > TRIES:
                yield self._given_up(item)
            else:
                item.worker = event.worker
                self._watch.began(item.number)

    def _ended(self, item: _Pending, outcome: JobOutcome) -> Ended:
        self._forget(item)
        self._seconds += _WEIGHT * (outcome.seconds - self._seconds)
        failure = outcome.end.failure(item.job)
        if failure is None:
            self._store.put_content(item.job.key, outcome.end.answer)
        elif isinstance(failure.error, OSError) and failure.error.errno in _FULL:
            raise DataError(f"worker {item.worker}: {failure.error}; free space there")
        elif item.job.own and isinstance(failure.error, DataError):
            raise DataError(f"worker {item.worker}: {failure.error} (workers must see the files of a large data set)")
        return Ended(item.number, item.job, failure)

    def _given_up(self, item: _Pending) -> Ended:
        """The end of a job whose workers were killed too often."""
        self._forget(item)
        tries = f"in each of {TRIES} tries" if item.begins >= TRIES else "each time before it began"
        return Ended(item.number, item.job, Failure(f"its worker was killed {tries} (the last: {item.worker})"))

    def _forget(self, item: _Pending) -> None:
        """The job is with the cluster no more; nor is its parcel, if it was the last."""
        del self.pending[item.number]
        numbers = self._numbers.get(item.parcel, set())  # none: the parcel is lost
        numbers.discard(item.number)
        if not numbers:
            self._close_parcel(item.parcel)

    def _close_parcel(self, key: str) -> None:
        self._numbers.pop(key, None)
        future = self._futures.pop(key, None)
        if future is not None and not future.done():  # it would go on with what was given up
            future.cancel()

    def _lost(self, key: str) -> Iterator[Ended]:
        """Look whether a parcel's workers were killed so often that the scheduler gave up; its jobs then go alone."""
        future = self._futures.get(key)
        if future is None or future.status in ("pending", "finished"):  # whose ends are under way
            return
        if future.status != "error":
            raise lost(self._client)
        error = future.exception()
        if isinstance(error, OmnibenchError):
            raise error  # a worker joined later and is unfit
        if not isinstance(error, KilledWorker):
            raise BackendError(f"a Dask worker failed ({one_line(f'{type(error).__name__}: {error}')}); start it again")
        items = [self.pending[number] for number in sorted(self._numbers[key])]
        self._close_parcel(key)
        for item in items:
            if item.begins >= TRIES or item.submissions >= _SUBMISSIONS:
                yield self._given_up(item)
            else:
                self.submit([item])

    def _look(self) -> None:
        """Count the slots. ClusterLostError: the scheduler is lost, or there has been no worker for long."""
        slots, self._looked = count_slots(self._client), time.monotonic()
        self._slots = max(slots, 1)
        if slots:
            if self._without is not None:
                self._backend.report(Progress(_WAITING, result=""))
            self._without = None
        elif self._without is None:
            self._without = self._looked
            self._backend.report(Progress(_WAITING))
        elif self._looked - self._without > WAIT:
            address = self._client.scheduler.address
            raise ClusterLostError(
                f"no worker has been left at the Dask scheduler {address} for {WAIT:g} s; start some "
                f"(dask worker {address}), then the same command"
            )
