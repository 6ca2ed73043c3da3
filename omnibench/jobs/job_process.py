"""A process that does jobs, one at a time, and the backends of this machine: this process, and processes of its own."""

from __future__ import annotations

import hashlib
import os
import pickle
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from io import BytesIO, TextIOWrapper
from multiprocessing.connection import Connection, wait
from pathlib import Path
from signal import SIG_DFL, SIG_IGN, SIGABRT, SIGHUP, SIGINT, SIGKILL, SIGSEGV, SIGTERM, Signals
from typing import Any, TypeVar, cast

from omnibench import processes
from omnibench.jobs.job import Backend, Encode, Ends, Failure, Job, JobEnd, JobWatch, Numbered, failure_of
from omnibench.progress import Progress
from omnibench.registry import import_copies

T = TypeVar("T")
J = TypeVar("J", bound="Job[Any] | PackedJob")

_MEGABYTE = 1_000_000  # bytes
_LIFE = 60.0  # s in which a process takes further jobs without limits, so that memory and caches end with it; chosen
# What every process of jobs needs; pydantic imports these when a result is first written, which takes 60 ms.
PRELOAD = (__name__, "pydantic.fields", "pydantic.dataclasses")
_PERIOD = 0.2  # s between two reports of a job's task, and two looks at limits of time; chosen
_CLOSED = 1.0  # s in which a process dies whose end of the connection is closed; chosen
_FROM_OUTSIDE = (SIGKILL, SIGTERM, SIGHUP, SIGINT)  # signals by which people and the system end processes

_in_job = False  # True in a process of jobs


def limit_memory(megabytes: float | None) -> None:
    """Limit the process's private memory, beyond which allocations raise MemoryError; None: as far as is allowed.

    RLIMIT_DATA counts memory that can be written to (anonymous mappings, since Linux 4.7). RLIMIT_AS also counts
    address space that is only reserved: with 700 MB of it before a run begins, Numba and polars then cannot be loaded.
    """
    _, most = resource.getrlimit(resource.RLIMIT_DATA)
    limit = most if megabytes is None else int(megabytes * _MEGABYTE)
    resource.setrlimit(resource.RLIMIT_DATA, (limit if most == resource.RLIM_INFINITY else min(limit, most), most))


def memory_limit() -> float | None:
    """The limit of this process's private memory in 10^6 bytes; None without one."""
    soft, _ = resource.getrlimit(resource.RLIMIT_DATA)
    return None if soft == resource.RLIM_INFINITY else soft / _MEGABYTE


def _oom_kills() -> int:
    """Number of processes that the system has killed for lack of memory; 0 where it does not say (not Linux)."""
    with suppress(OSError):
        counts = Path("/proc/vmstat").read_text(encoding="ascii").splitlines()
        return sum(int(line.split()[1]) for line in counts if line.startswith("oom_kill "))
    return 0


@dataclass(frozen=True)
class PackedJob:
    """A job as it travels. content: its function and argument, pickled without what is in ``shared``, by its hash."""

    content: bytes
    shared: Mapping[str, bytes]
    seconds: float | None
    memory_mb: float | None

    @property
    def limited(self) -> bool:
        """True for a job with a limit, which needs a process of its own."""
        return self.seconds is not None or self.memory_mb is not None


class Packer:
    """Pickles jobs, and once what they share."""

    def __init__(self) -> None:
        self._shared: dict[int, tuple[Any, str, bytes]] = {}  # by id: the object, kept alive, its hash and content

    def pack(self, job: Job[Any]) -> PackedJob:
        """The job as it travels."""
        for value in job.shared:
            if id(value) not in self._shared:
                content = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
                self._shared[id(value)] = value, hashlib.sha256(content).hexdigest()[:20], content
        shared = {id(value): self._shared[id(value)][1:] for value in job.shared}
        stream = BytesIO()
        pickler = pickle.Pickler(stream, pickle.HIGHEST_PROTOCOL)
        pickler.persistent_id = lambda value: shared.get(id(value), (None,))[0]  # type: ignore[method-assign]
        pickler.dump((job.function, job.argument))
        return PackedJob(stream.getvalue(), dict(shared.values()), job.seconds, job.memory_mb)


class _JobProcess:
    """The near end of a process that does jobs. Ended, it takes with it all that its jobs started."""

    def __init__(self, context: Any) -> None:
        self.connection, far = context.Pipe()
        self._process = context.Process(target=_serve, args=(far,), daemon=True)
        with processes.interrupts_deferred(), processes.main_module_hidden():
            self._process.start()
        far.close()
        self.signs = self.connection, self._process.sentinel  # for ``wait``: ready when ``receive`` has more to tell
        self._began = time.monotonic()
        self._sent: Mapping[str, bytes] = {}  # shared objects that are there

    @property
    def usable(self) -> bool:
        """True if it may do a further job."""
        return time.monotonic() - self._began <= _LIFE and self._process.is_alive()

    def give(self, job: PackedJob, *given: Any) -> None:
        """Begin a job. given: ``encode`` and ``plugins`` of ``Processes.run``."""
        self.job, self._kills = job, _oom_kills()
        self._deadline = None if job.seconds is None else time.monotonic() + job.seconds
        missing = {name: content for name, content in job.shared.items() if name not in self._sent}
        self._sent = job.shared
        with suppress(BrokenPipeError, ConnectionResetError):  # it died: ``receive`` tells how
            self.connection.send((job.content, [*job.shared], missing, job.memory_mb, *given))

    def receive(self) -> Progress | JobEnd | None:
        """A report or the end of the job, None if there is none yet. After an end by force the process is gone."""
        dead = not self._process.is_alive()  # asked before what it sent is read, so that nothing is left when it died
        try:
            if self.connection.poll():
                return cast(Progress | JobEnd, self.connection.recv())
        except (EOFError, OSError):  # it is about to die, or a plug-in has closed its end
            self._process.join(_CLOSED)
            dead = True
        if dead:
            code = 1 if self._process.is_alive() else self._process.exitcode or 0
            how = f"exit code {code}" if code >= 0 else f"killed by {Signals(-code).name}"
            if code == -SIGKILL and _oom_kills() > self._kills:
                how += ": the system was out of memory"
            elif code in (-SIGABRT, -SIGSEGV) and self.job.memory_mb is not None:
                how += f"; its memory was limited to {self.job.memory_mb:g} MB"  # compiled code may end so without
            reason = f"the process died without an answer ({how})"
            return JobEnd(failure=Failure(reason, killed=-code in _FROM_OUTSIDE))
        if self._deadline is not None and time.monotonic() >= self._deadline:
            return JobEnd(failure=Failure(f"over time (limit {self.job.seconds:g} s)", over_time=True))
        return None

    def end(self) -> None:
        """End the process and all that its jobs started."""
        with suppress(OSError):  # there is none
            os.killpg(self._process.pid, SIGKILL)
        self._process.kill()
        self._process.join()
        self.connection.close()


def _serve(connection: Connection) -> None:
    """Do the jobs that come through the connection; end when none comes for long."""
    global _in_job
    _in_job = True
    signal.signal(SIGINT, SIG_IGN)  # the parent ends it
    signal.signal(SIGTERM, SIG_DFL)  # end at once: Python's handlers would wait for compiled code
    cast(TextIOWrapper, sys.stdout).reconfigure(line_buffering=True)  # what it prints does not end with it
    os.setpgid(0, 0)  # all that a plug-in starts can be ended with the process
    threading.Thread(target=processes.end_with_parent, daemon=True).start()
    shared: dict[str, Any] = {}
    with processes.one_thread():
        while connection.poll(2 * _LIFE):
            end = _do(connection, shared)
            try:
                connection.send(end)
            except OSError:  # a plug-in has closed it
                os._exit(1)


def _do(connection: Connection, shared: dict[str, Any]) -> JobEnd:
    """Take a job and run it. shared: objects of the job before, and then of this one, by name."""
    last: Progress | None = None
    task, sent_at, process, memory_mb = "", -_PERIOD, os.getpid(), None

    def report(event: Progress) -> None:
        nonlocal last, task, sent_at
        last = event
        if event.task != task or time.monotonic() - sent_at >= _PERIOD:
            with suppress(OSError):  # a plug-in may have closed it
                connection.send(event)
            task, sent_at = event.task, time.monotonic()

    try:
        content, names, missing, memory_mb, encode, plugins = connection.recv()
        import_copies(plugins)
        shared.update({name: pickle.loads(content) for name, content in missing.items()})
        missing.clear()
        for name in shared.keys() - set(names):
            del shared[name]
        unpickler = pickle.Unpickler(BytesIO(content))
        unpickler.persistent_load = shared.__getitem__  # type: ignore[method-assign]
        function, argument = unpickler.load()
        try:
            if memory_mb is not None:
                limit_memory(memory_mb)
            result = function(argument, report)
        finally:
            limit_memory(None)  # there is room for reporting an error
            if os.getpid() != process:  # a plug-in forked: its copy of this process has no answer to give
                os._exit(0)
        return JobEnd(encode(result), last=last)
    except BaseException as error:  # whatever a plug-in raises
        return JobEnd(failure=failure_of(error, memory_mb), last=last)


def local_backend(workers: int, preload: Sequence[str] = ()) -> Backend:
    """This process for one worker, else that many processes; for jobs of our own code, which needs no isolation."""
    return InPlace() if workers <= 1 else Processes(workers, preload)


class InPlace:
    """Runs jobs one after the other in this process. Their limits are not enforced."""

    def run(self, jobs: Iterable[Numbered[T]], encode: Encode, watch: JobWatch[T]) -> Ends[T]:
        """Run the jobs, see Backend."""
        for number, job in jobs:
            watch.began(number)
            try:
                with processes.one_thread():
                    end = JobEnd(encode(job.function(job.argument, partial(watch.moved, number))))
            except (Exception, SystemExit) as error:
                end = JobEnd(failure=failure_of(error, None))
            yield number, job, end


@dataclass(frozen=True)
class Processes:
    """Runs jobs in processes of one thread, up to ``workers`` of them at a time.

    A job with a limit of time or memory has a process of its own; others share processes, each for a minute or until a
    job fails. Within a job there are no further processes: it runs its jobs itself. preload: modules that the processes
    share, so that they need not be imported for every job. lasting: processes that have nothing to do wait for the next
    run, until ``close``.
    """

    workers: int
    preload: Sequence[str] = ()
    lasting: bool = False
    _idle: list[_JobProcess] = field(default_factory=list, init=False, repr=False, compare=False)

    def run(
        self,
        jobs: Iterable[tuple[int, J]],
        encode: Encode,
        watch: JobWatch[Any],
        plugins: Mapping[Path, Path] | None = None,
        wanted: Callable[[], bool] = lambda: True,
    ) -> Generator[tuple[int, J, JobEnd], None, None]:
        """Run the jobs, packed or not, see Backend; all stop once ``wanted`` is false.

        plugins: copies of plug-in files here, by their paths at home.
        """
        if _in_job:
            yield from cast(Any, InPlace().run)(jobs, encode, watch)
            return
        waiting, packer = iter(jobs), Packer()
        active: dict[_JobProcess, tuple[int, J]] = {}
        with processes.one_thread_processes((*PRELOAD, *self.preload)) as context:
            try:
                while True:
                    while len(active) < self.workers and (item := next(waiting, None)) is not None:
                        watch.began(item[0])
                        packed = item[1] if isinstance(item[1], PackedJob) else packer.pack(item[1])
                        while self._idle and not self._idle[-1].usable:
                            self._idle.pop().end()
                        process = self._idle.pop() if self._idle and not packed.limited else _JobProcess(context)
                        active[process] = item
                        process.give(packed, encode, plugins or {})
                    if not active or not wanted():
                        return
                    wait([sign for process in active for sign in process.signs], timeout=_PERIOD)
                    for process, (number, job) in [*active.items()]:
                        event = process.receive()
                        if isinstance(event, Progress):
                            watch.moved(number, event)
                        elif event is not None:
                            del active[process]
                            if event.failure is None and not process.job.limited:
                                self._idle.append(process)
                            else:
                                process.end()
                            yield number, job, event
            finally:
                for process in active:
                    process.end()
                if not self.lasting:
                    self.close()

    def close(self) -> None:
        """End the processes that wait."""
        while self._idle:
            self._idle.pop().end()
