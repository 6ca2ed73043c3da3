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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from io import BytesIO
from itertools import islice
from multiprocessing.connection import Connection, wait
from pathlib import Path
from signal import SIG_DFL, SIG_IGN, SIGABRT, SIGHUP, SIGINT, SIGKILL, SIGSEGV, SIGTERM, Signals
from typing import Any, TypeVar

from omnibench import processes
from omnibench.errors import one_line
from omnibench.jobs.job import Backend, Ended, Failure, Job, JobWatch, Store
from omnibench.progress import Progress, Reporter
from omnibench.registry import import_copies

T = TypeVar("T")

_MEGABYTE = 1_000_000  # bytes
# s after its start in which a process takes further jobs: to start one costs 20 ms (tests/studies/job_overhead.py),
# 2 % of that; what jobs leave behind in it (memory, caches) is that of a second. What unpacking jobs takes and changes
# does not count: the first imports their modules, as it would in every new process, too. The working folder does: by
# it later jobs find their files.
_YOUNG = 1.0
_OWN = 60.0  # s, for jobs of our own code, which leave nothing behind but what they share: data need not go again
# What every process of jobs needs; pydantic imports these when a result is first written, which takes 60 ms.
PRELOAD = (__name__, "pydantic.fields", "pydantic.dataclasses")
_AT_ONCE = 100  # events of a process that are heard before those of others; chosen
_CLOSED = 1.0  # s in which a process dies whose end of the connection is closed; chosen
_FROM_OUTSIDE = (SIGKILL, SIGTERM, SIGHUP, SIGINT)  # signals by which people and the system end processes

_KEPT: dict[str, Any] = {}  # objects that the last job of this process shared, by their names
_in_job = False  # True in a process of jobs
# When the last job of this process had been unpacked (s, by time.monotonic), and what its condition was then.
_unpacked: tuple[float, tuple[Any, ...]] = (0.0, ())


@contextmanager
def limited_memory(megabytes: float | None) -> Iterator[None]:
    """Limit the process's private memory, beyond which allocations raise MemoryError; None: no limit.

    RLIMIT_DATA counts memory that can be written to (anonymous mappings, since Linux 4.7). RLIMIT_AS also counts
    address space that is only reserved: with 700 MB of it before a run begins, Numba and polars then cannot be loaded.
    """
    if megabytes is None:
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = int(megabytes * _MEGABYTE)
    resource.setrlimit(resource.RLIMIT_DATA, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))  # there is room for reporting the error


def memory_limit() -> float | None:
    """The limit of this process's private memory in 10^6 bytes; None without one."""
    soft, _ = resource.getrlimit(resource.RLIMIT_DATA)
    return None if soft == resource.RLIM_INFINITY else soft / _MEGABYTE


def oom_kills() -> int:
    """Number of processes that the system has killed for lack of memory; 0 where it does not say (not Linux)."""
    try:
        counts = Path("/proc/vmstat").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) for line in counts if line.startswith("oom_kill "))


@dataclass(frozen=True)
class PackedJob:
    """A job's function and argument as bytes, without the objects that it shares with other jobs.

    shared: those objects as bytes, by their names; names: all of them, also those that its process has kept already.
    kept: the process keeps them for the next job. plugins: copies of plug-in files here, by their paths at home.
    """

    content: bytes
    shared: Mapping[str, bytes]
    names: tuple[str, ...]
    kept: bool
    plugins: Mapping[Path, Path] = field(default_factory=dict)


class Packer:
    """Pickles jobs. Objects that they share are pickled once, and named by the hash of their content."""

    def __init__(self) -> None:
        self._pickled: dict[int, tuple[Any, str, bytes]] = {}  # by id: the object, its name and its content

    def pack(self, job: Job[Any]) -> tuple[bytes, dict[str, bytes]]:
        """The job's function and argument without what it shares, and that by its names."""
        for value in job.shared:
            if id(value) not in self._pickled:
                content = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
                self._pickled[id(value)] = value, hashlib.sha256(content).hexdigest()[:20], content
        shared = {id(value): self._pickled[id(value)] for value in job.shared}
        names = {key: name for key, (_, name, _) in shared.items()}
        stream = BytesIO()
        pickler = pickle.Pickler(stream, pickle.HIGHEST_PROTOCOL)
        pickler.persistent_id = lambda value: names.get(id(value))  # type: ignore[method-assign]
        pickler.dump((job.function, job.argument))
        return stream.getvalue(), {name: content for _, name, content in shared.values()}

    def portable(self, job: Job[Any]) -> Job[Any]:
        """The job as another process unpacks it: its argument is a PackedJob."""
        content, shared = self.pack(job)
        return replace(job, function=run_packed, argument=PackedJob(content, shared, tuple(shared), job.own), shared=())


def run_packed(packed: PackedJob, report: Reporter) -> Any:
    """Unpack a job in its process and run it."""
    global _unpacked
    import_copies(packed.plugins)
    shared = {name: pickle.loads(content) for name, content in packed.shared.items()}
    if packed.kept:
        shared |= {name: _KEPT[name] for name in packed.names if name not in shared}
        _KEPT.clear()
        _KEPT.update(shared)
    unpickler = pickle.Unpickler(BytesIO(packed.content))
    unpickler.persistent_load = shared.__getitem__  # type: ignore[method-assign]
    function, argument = unpickler.load()
    _unpacked = time.monotonic(), _condition()
    return function(argument, report)


@dataclass(frozen=True)
class JobEnd:
    """The end of a job, in parts that any process can read.

    answer: what ``keep`` returned. error: what the job raised, pickled. lost: why it has neither, as its process died
    or was ended. reusable: the process is as it was when the job had been unpacked, which took ``unpacking`` s, and in
    the working folder in which it began.
    """

    answer: Any = None
    error: bytes | None = None
    lost: Failure | None = None
    reusable: bool = False
    unpacking: float = 0.0

    def failure(self, job: Job[Any]) -> Failure | None:
        """Why the job has no result; None where it has ended well."""
        return self.lost if self.error is None else raised(job, pickle.loads(self.error))


class JobProcess:
    """The near end of a process that does jobs. context: of multiprocessing.

    Quick jobs share a process, see ``takes``. Ended, it takes with it all that its jobs started.
    """

    def __init__(self, context: Any) -> None:
        self.connection, far = context.Pipe()
        self._process = context.Process(target=_serve, args=(far,), daemon=True)
        with processes.interrupts_deferred(), processes.main_module_hidden():
            self._process.start()
        far.close()
        self.young_since = time.monotonic()
        self._kills = 0
        self._sent: set[str] = set()
        self._job: Job[Any] | None = None  # the last one, without its argument
        self.deadline: float | None = None  # of the job, by time.monotonic

    @property
    def signs(self) -> tuple[Connection, int]:
        """What multiprocessing's ``wait`` takes: ready when ``receive`` has something to tell."""
        return self.connection, self._process.sentinel

    def takes(self, job: Job[Any]) -> bool:
        """True if it may do the job: a job with a limit gets a fresh process, others one that is young."""
        if self._job is None:
            return True
        young = time.monotonic() - self.young_since <= (_OWN if job.own else _YOUNG)
        return young and not job.limited and self._process.is_alive()

    def give(self, job: Job[Any], keep: Callable[[str, Any], Any]) -> None:
        """Begin a job. keep: called there with the key and the result; what it returns is the end's ``answer``."""
        self._job, self._kills = replace(job, argument=None, shared=()), oom_kills()
        if isinstance(packed := job.argument, PackedJob) and packed.kept:
            missing = {name: content for name, content in packed.shared.items() if name not in self._sent}
            job, self._sent = replace(job, argument=replace(packed, shared=missing)), {*packed.names}
        self.deadline = None if job.seconds is None else time.monotonic() + job.seconds
        with suppress(BrokenPipeError, ConnectionResetError):  # it died: ``receive`` tells how
            self.connection.send((job, keep))

    def events(self) -> Iterator[Progress | JobEnd]:
        """Reports of the job that have come, and its end; of one that reports without pause some: others wait, too."""
        return islice(iter(self.receive, None), _AT_ONCE)

    def receive(self) -> Progress | JobEnd | None:
        """A report or the end of the job, None if there is none yet. After an end by force the process is gone."""
        over = self.deadline is not None and time.monotonic() >= self.deadline
        dead = not self._process.is_alive()  # asked before what it sent is read, so that nothing is left when it died
        try:
            if self.connection.poll():
                message: Progress | JobEnd = self.connection.recv()
                if isinstance(message, JobEnd) or dead or not over:
                    return message
        except (EOFError, OSError):  # it is about to die, or a plug-in has closed its end
            self._process.join(_CLOSED)
            dead = True
        if dead:
            return self._death()
        if over:
            assert self._job is not None
            self.end()
            return JobEnd(lost=Failure(f"over time (limit {self._job.seconds:g} s)", over_time=True))
        return None

    def _death(self) -> JobEnd:
        """The end of a job whose process has died; of one that cannot be heard any more, too, which is ended."""
        code = 1 if self._process.is_alive() else self._process.exitcode or 0
        self.end()
        how = f"exit code {code}" if code >= 0 else f"killed by {Signals(-code).name}"
        if code == -SIGKILL and oom_kills() > self._kills:
            how += ": the system was out of memory"
        elif code in (-SIGABRT, -SIGSEGV) and self._job is not None and self._job.memory_mb is not None:
            how += f"; its memory was limited to {self._job.memory_mb:g} MB"  # compiled code may end so without memory
        reason = f"the process died without an answer ({how})"
        return JobEnd(lost=Failure(reason, killed=-code in _FROM_OUTSIDE))

    def end(self) -> None:
        """End the process and all that its jobs started."""
        with suppress(OSError):  # there is none
            os.killpg(self._process.pid, SIGKILL)
        self._process.kill()
        self._process.join()
        self.connection.close()


def process_for(job: Job[Any], idle: list[JobProcess], context: Any) -> JobProcess:
    """An idle process that may take the job, or a new one; in place of an idle one that may not, which is ended."""
    with suppress(IndexError):  # another thread has taken the last
        process = idle.pop()
        if process.takes(job):
            return process
        process.end()
    return JobProcess(context)


def release(process: JobProcess, end: JobEnd, idle: list[JobProcess]) -> None:
    """Keep a process whose job has ended for the next one, or end it if the job has left something behind."""
    if end.reusable:
        process.young_since += end.unpacking
        idle.append(process)
    else:
        process.end()


def _serve(connection: Connection) -> None:
    """Do the jobs that come through the connection."""
    global _in_job, _unpacked
    _in_job = True
    signal.signal(SIGINT, SIG_IGN)  # the parent ends it
    signal.signal(SIGTERM, SIG_DFL)  # end at once: Python's handlers would wait for compiled code
    os.setpgid(0, 0)  # all that a plug-in starts can be ended with the process
    threading.Thread(target=processes.end_with_parent, daemon=True).start()
    process, home = os.getpid(), _folder()
    with processes.one_thread():
        while True:
            try:
                if not connection.poll(2 * _OWN):  # nobody gives it a job so late
                    return
                came = time.monotonic()
                job, keep = connection.recv()
                _unpacked = time.monotonic(), _condition()
            except EOFError:
                return
            except Exception as error:  # whatever unpickling raises: a module that is missing here
                connection.send(JobEnd(error=_sendable(error)))
                return
            end = _do(job, keep, connection, process)
            unpacked_at, condition = _unpacked
            unchanged = _condition() == condition and _folder() == home
            reusable = end.error is None and not job.limited and unchanged
            for stream in (sys.stdout, sys.stderr):
                with suppress(OSError, ValueError):  # closed by a plug-in
                    stream.flush()
            try:
                connection.send(replace(end, reusable=reusable, unpacking=unpacked_at - came))
            except OSError:  # a plug-in has closed it
                os._exit(1)


def _do(job: Job[Any], keep: Callable[[str, Any], Any], connection: Connection, process: int) -> JobEnd:
    """Run a job: its answer, or the error that it raised. process: the id of this one."""

    def report(event: Progress) -> None:
        with suppress(OSError):  # a plug-in may have closed it
            connection.send(event)

    try:
        with limited_memory(job.memory_mb):
            result = job.function(job.argument, report)
            if os.getpid() != process:  # a plug-in forked: its copy of this process has no answer to give
                os._exit(0)
            return JobEnd(keep(job.key, result))
    except BaseException as error:
        if os.getpid() != process:
            os._exit(1)
        return JobEnd(error=_sendable(error))


def _folder() -> str:
    """The working folder, empty if it has been removed."""
    try:
        return os.getcwd()
    except OSError:
        return ""


def _condition() -> tuple[Any, ...]:
    """What a job may change in its process for those that follow, beside the working folder."""
    try:
        os.waitpid(-1, os.WNOHANG)
        has_children = True
    except ChildProcessError:
        has_children = False
    handlers = [signal.getsignal(number) for number in signal.valid_signals()]
    return has_children, dict(os.environ), handlers, threading.active_count(), list(sys.path)


class _InWordsError(Exception):
    """An error in words, in the place of one that cannot be pickled."""


def _sendable(error: BaseException) -> bytes:
    try:
        content = pickle.dumps(error)
        pickle.loads(content)
    except Exception:  # whatever the error's class raises
        return pickle.dumps(_InWordsError(_in_words(error)))
    return content


def raised(job: Job[Any], error: BaseException) -> Failure:
    """The failure of a job that raised an error."""
    if isinstance(error, MemoryError):
        return Failure(
            "out of memory" if job.memory_mb is None else f"out of memory (limit {job.memory_mb:g} MB)", error
        )
    return Failure(str(error) if isinstance(error, _InWordsError) else _in_words(error), error)


def _in_words(error: BaseException) -> str:
    return one_line(f"{type(error).__name__}: {error}")


_LONGEST = 3600.0  # s of one wait: the system takes no infinite time


def local_backend(workers: int, preload: Sequence[str] = ()) -> Backend:
    """This process for one worker, else that many processes; for jobs of our own code, which needs no isolation."""
    return InPlace() if workers <= 1 else Processes(workers, preload)


class InPlace:
    """Runs jobs one after the other in this process. Their limits are not enforced."""

    def run(self, jobs: Iterable[tuple[int, Job[T]]], store: Store[T], watch: JobWatch[T]) -> Iterator[Ended]:
        """Run the jobs, see Backend."""
        for number, job in jobs:
            watch.began(number)
            failure = None
            try:
                with processes.one_thread():
                    job.run(store, partial(watch.moved, number))
            except (Exception, SystemExit) as error:
                failure = raised(job, error)
            yield Ended(number, job, failure)


@dataclass(frozen=True)
class Processes:
    """Runs jobs in processes of one thread, up to ``workers`` of them at a time.

    A job with a limit of time or memory, one that begins when a process is a second old (imports do not count), and one
    after a job that raised or left something behind (a working folder, threads, children) has a fresh process; quick
    jobs share one, and those of our own code share it for a minute.
    preload: modules that the processes share, so that they need not be imported for every job. Within a job there are
    no further processes: it runs its jobs itself. lasting: processes that have nothing to do wait for the next run,
    until ``close``.
    """

    workers: int
    preload: Sequence[str] = ()
    lasting: bool = False
    _idle: list[JobProcess] = field(default_factory=list, init=False, repr=False, compare=False)

    def run(self, jobs: Iterable[tuple[int, Job[T]]], store: Store[T], watch: JobWatch[T]) -> Iterator[Ended]:
        """Run the jobs, see Backend."""
        # A process that does a job starts no further ones
        if _in_job:
            yield from InPlace().run(jobs, store, watch)
            return
        waiting = iter(jobs)
        active: dict[JobProcess, tuple[int, Job[Any]]] = {}
        idle, packer = self._idle, Packer()
        with processes.one_thread_processes((*PRELOAD, *self.preload)) as context:
            try:
                while True:
                    while len(active) < self.workers and (item := next(waiting, None)) is not None:
                        number, job = item
                        process = process_for(job, idle, context)
                        active[process] = item
                        process.give(packer.portable(job) if job.own and job.shared else job, store.keep)
                        watch.began(number)
                    if not active:
                        return
                    for process, end in _ends(active, watch):
                        number, job = active.pop(process)
                        if end.answer is not None:
                            store.put_content(job.key, end.answer)
                        release(process, end, idle)
                        yield Ended(number, job, end.failure(job))
            finally:
                for process in active:
                    process.end()
                if not self.lasting:
                    self.close()

    def close(self) -> None:
        """End the processes that wait."""
        while self._idle:
            self._idle.pop().end()


def _ends(active: dict[JobProcess, tuple[int, Job[Any]]], watch: JobWatch[Any]) -> list[tuple[JobProcess, JobEnd]]:
    """Wait until a job reports, ends or is over its time; reports are passed on. The jobs that have ended."""
    deadlines = [process.deadline for process in active if process.deadline is not None]
    wait(
        [sign for process in active for sign in process.signs],
        timeout=min(max(min(deadlines) - time.monotonic(), 0.0), _LONGEST) if deadlines else None,
    )
    ended = []
    for process, (number, _) in active.items():
        for event in process.events():
            if isinstance(event, JobEnd):
                ended.append((process, event))
                break
            watch.moved(number, event)
    return ended
