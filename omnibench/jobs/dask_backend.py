"""Backend of a Dask cluster. Results come back to the client, which alone writes the store.

A job's begin, its reports and its end are events from its worker; the future only tells that it is lost. A worker that
is killed takes its jobs with it: the scheduler gives them to another, and the begins of each are counted here, since
the scheduler also counts jobs that only waited there.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from errno import EDQUOT, ENOSPC
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any, TypeVar
from uuid import uuid4

from distributed import KilledWorker

from omnibench.errors import DataError
from omnibench.jobs.dask_worker import Order, Told, carry_out, content
from omnibench.jobs.job import TRIES, BackendError, Ended, Failure, Job, JobWatch
from omnibench.jobs.job_process import in_job
from omnibench.jobs.local_backends import InPlace
from omnibench.jobs.packing import Packer, run_packed
from omnibench.jobs.result_store import ResultStore

T = TypeVar("T")

_AHEAD = 2  # jobs a slot that are with the cluster: one at work, one that waits for it (chosen)
_FULL = (ENOSPC, EDQUOT)
_LOOK = 1.0  # s between two looks at the scheduler and its workers; chosen
_SUBMISSIONS = 10  # of a job whose workers died before it began, at most: chosen, as it is no fault of its own


class SchedulerLostError(BackendError):
    """The scheduler does not answer any more."""

    exit_code = 1


@dataclass(eq=False)
class _Pending:
    """A job that is with the cluster."""

    number: int
    job: Job[Any]
    future: Any
    submissions: int = 1
    begins: int = 0
    worker: str = ""


@dataclass
class DaskBackend:
    """Runs jobs on the workers of a cluster. requirements: see ``checked_requirements``."""

    client: Any
    requirements: bytes
    _packer: Packer = field(default_factory=Packer)
    _data: dict[str, Any] = field(default_factory=dict)

    def run(self, jobs: Iterable[tuple[int, Job[T]]], store: ResultStore[T], watch: JobWatch[T]) -> Iterator[Ended]:
        """Run the jobs, see Backend. SchedulerLostError, or UnfitWorkerError of a worker that joined later."""
        if in_job():
            yield from InPlace().run(jobs, store, watch)
            return
        run = _Run(self, store, watch)
        waiting = iter(jobs)
        try:
            while True:
                while len(run.pending) < _AHEAD * run.slots and (item := next(waiting, None)) is not None:
                    run.submit(_Pending(*item, future=None))
                if not run.pending:
                    return
                yield from run.ends()
        finally:
            run.close()

    def order(self, topic: str, number: int, job: Job[Any], store: ResultStore[Any]) -> tuple[Order, list[Any]]:
        """A job as it travels, and the futures of data that it shares with others, the requirements first."""
        packed, shared = self._packer.pack(job)
        plain = replace(job, function=run_packed, argument=None, shared=())
        data = {"requirements": self.requirements} | shared
        return Order(topic, number, plain, store, packed, tuple(shared)), [
            self._future(name, value) for name, value in data.items()
        ]

    def _future(self, name: str, value: bytes) -> Any:
        if name not in self._data:
            self._data[name] = self.client.submit(content, value, key=f"omnibench-data-{name}-{uuid4().hex[:8]}")
        return self._data[name]


class _Run:
    """The jobs of one call of ``run``."""

    def __init__(self, backend: DaskBackend, store: ResultStore[Any], watch: JobWatch[Any]) -> None:
        self.pending: dict[int, _Pending] = {}
        self._backend, self._client, self._store, self._watch = backend, backend.client, store, watch
        self._topic = f"omnibench-{uuid4().hex[:12]}"
        self._events: SimpleQueue[bytes | Any] = SimpleQueue()  # of Told, pickled, or futures that are done
        self._client.subscribe_topic(self._topic, lambda event: self._events.put(event[1]))
        self.slots = self._count_slots()

    def submit(self, item: _Pending) -> None:
        """Give a job to the cluster."""
        order, data = self._backend.order(self._topic, item.number, item.job, self._store)
        key = f"{self._topic}-{item.number}-{item.submissions}"
        item.future = self._client.submit(carry_out, order, *data, key=key, pure=False)
        self.pending[item.number] = item
        item.future.add_done_callback(partial(_put_done, self._events, item.number))

    def ends(self) -> Iterator[Ended]:
        """Wait a moment for events, which are passed on; the jobs that have ended."""
        try:
            events = [self._events.get(timeout=_LOOK)]
        except Empty:
            events = []
            self.slots = self._count_slots()
        while not self._events.empty():
            events.append(self._events.get())
        for event in events:
            ended = self._told(pickle.loads(event)) if isinstance(event, bytes) else self._done(*event)
            if ended is not None:
                yield ended

    def close(self) -> None:
        """Cancel what is left."""
        if self._client.status == "running":
            self._client.unsubscribe_topic(self._topic)
            self._client.cancel([item.future for item in self.pending.values()], force=True)

    def _told(self, event: Told) -> Ended | None:
        item = self.pending.get(event.number)
        if item is None:
            return None
        if event.progress is not None:
            self._watch.moved(item.number, event.progress)
        if event.end is None:
            if event.progress is None:
                return self._began(item, event.worker)
            return None
        del self.pending[item.number]
        failure = event.end.failure(item.job)
        if isinstance(event.end.answer, str):
            self._store.put_content(item.job.key, event.end.answer)
        elif failure is not None and isinstance(failure.error, OSError) and failure.error.errno in _FULL:
            raise DataError(f"worker {event.worker}: {failure.error}; free space there")
        return Ended(item.number, item.job, failure)

    def _began(self, item: _Pending, worker: str) -> Ended | None:
        """A job has begun on a worker, perhaps since another one was killed."""
        item.begins += 1
        if item.begins > TRIES:
            return self._given_up(item)
        item.worker = worker
        self._watch.began(item.number)
        return None

    def _given_up(self, item: _Pending) -> Ended:
        del self.pending[item.number]
        self._client.cancel([item.future], force=True)
        tries = f"in each of {TRIES} tries" if item.begins else "before it began"
        return Ended(item.number, item.job, Failure(f"the worker was killed {tries} (the last: {item.worker or '-'})"))

    def _done(self, number: int, future: Any) -> Ended | None:
        """A job's future is done: its end was told, or is its result, or its workers or the scheduler are lost."""
        item = self.pending.get(number)
        if item is None or item.future is not future:
            return None
        if future.status == "finished":
            told = future.result()
            return None if told is None else self._told(told)
        if future.status != "error":
            raise SchedulerLostError(f"the Dask scheduler {self._client.scheduler.address} is lost")
        error = future.exception()
        if isinstance(error, BackendError):  # a worker that joined later is unfit
            raise error
        if not isinstance(error, KilledWorker):
            raise error
        if item.begins >= TRIES or item.submissions >= _SUBMISSIONS:
            return self._given_up(item)
        item.submissions += 1
        self.submit(item)
        return None

    def _count_slots(self) -> int:
        """Threads of all workers, at least one. SchedulerLostError."""
        if self._client.status != "running":
            raise SchedulerLostError(f"the Dask scheduler {self._client.scheduler.address} is lost")
        return max(sum(self._client.nthreads().values()), 1)


def _put_done(events: SimpleQueue[Any], number: int, future: Any) -> None:
    events.put((number, future))
