"""Running a plan in processes: a run that raises, hangs or dies becomes a row, Ctrl-C loses nothing that had ended."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from typing import Any, Protocol

from omnibench.compare.config import CalibratorEntry, CompareConfig
from omnibench.compare.plan import PlannedRun, load_calibrators
from omnibench.compare.store import RunStore
from omnibench.data.dataset import Trajectory
from omnibench.fit.calibrator import Outcome, RunResult, run_calibrator
from omnibench.fit.parameterisation import ParameterisationName
from omnibench.fit.problem import CalibrationProblem, make_parameterisation
from omnibench.registry import calibrators, costs
from omnibench.robot.kinematics import Robot

# A run that does not look at its budget is ended this long after its seconds are spent.
_GRACE = 10.0
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS")


class Progress(Protocol):
    """Told how a comparison gets on."""

    def planned(self, runs: int) -> None: ...
    def began(self, run: PlannedRun) -> None: ...
    def moved(self, run: PlannedRun, evaluations: int, best: float) -> None: ...
    def ended(self, run: PlannedRun, result: RunResult, reused: bool) -> None: ...


@dataclass
class _Active:
    run: PlannedRun
    process: ForkServerProcess
    connection: Connection
    began: float


def execute(plan: Sequence[PlannedRun], store: RunStore, progress: Progress, workers: int) -> list[RunResult]:
    """The result of every run, in the plan's order; results that the store has are taken from there.

    KeyboardInterrupt passes through after the running processes are ended; what had ended is in the store.
    """
    results: dict[int, RunResult] = {}
    waiting: list[int] = []
    progress.planned(len(plan))
    for index, run in enumerate(plan):
        stored = store.get(run.key)
        if stored is None:
            waiting.append(index)
        else:
            results[index] = stored
            progress.ended(run, stored, reused=True)
    active: dict[int, _Active] = {}
    waiting.reverse()
    with _processes() as context:
        try:
            while waiting or active:
                while waiting and len(active) < workers:
                    index = waiting.pop()
                    active[index] = _start(context, plan[index])
                    progress.began(plan[index])
                for index, result in _collect(active, progress):
                    results[index] = result
                    run = active.pop(index).run
                    if not _died(result):
                        store.put(run.key, result)
                    progress.ended(run, result, reused=False)
        finally:
            for item in active.values():
                item.process.kill()
                item.process.join()
    return [results[index] for index in range(len(plan))]


@contextmanager
def _processes() -> Iterator[Any]:
    """Processes that start fast, with one thread each: two runs at a time should not fight for the cores."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["omnibench.compare.execute", "omnibench.fit.sum_of_norms", "nlopt"])
    try:
        yield context
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _start(context: Any, run: PlannedRun) -> _Active:
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(sender, run.config, _Job.of(run)), daemon=True)
    process.start()
    sender.close()
    return _Active(run, process, receiver, time.monotonic())


@dataclass(frozen=True)
class _Job:
    """What the worker needs of a run: the training data and nothing of the validation data."""

    robot: Robot
    trajectories: tuple[Trajectory, ...]
    entry: CalibratorEntry
    parameterisation: ParameterisationName
    seed: int

    @classmethod
    def of(cls, run: PlannedRun) -> _Job:
        return cls(
            robot=run.dataset.robot,
            trajectories=run.dataset.split("train"),
            entry=run.entry,
            parameterisation=run.parameterisation,
            seed=run.seed,
        )


def _work(connection: Connection, config: CompareConfig, job: _Job) -> None:
    """The worker process: solve one problem and send the result."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what Ctrl-C ends
    load_calibrators(config)
    calibrator = calibrators.create(job.entry.name, job.entry.options)
    cost = costs.create(config.cost.name, config.cost.options)
    box = job.entry.box or config.box
    searched = make_parameterisation(
        job.parameterisation, job.robot, job.trajectories, box=box, limits=job.entry.limits
    )
    problem = CalibrationProblem(
        job.robot,
        job.trajectories,
        cost,
        searched,
        integration=config.integration,
        budget=config.budget,
        seed=job.seed,
        watch=lambda evaluations, best: connection.send((evaluations, best)),
    )
    connection.send(run_calibrator(calibrator, problem))


def _collect(active: dict[int, _Active], progress: Progress) -> Iterator[tuple[int, RunResult]]:
    """The runs that have ended, after a moment's wait."""
    ready = wait([item.connection for item in active.values()], timeout=0.2)
    for index, item in list(active.items()):
        if item.connection in ready:
            result = _receive(item, progress)
            if result is not None:
                item.process.join()
                yield index, result
        elif time.monotonic() - item.began > item.run.config.budget.seconds + _GRACE:
            item.process.kill()
            seconds = item.run.config.budget.seconds
            yield index, _without_answer(item, Outcome.TIME, f"ended by force: {seconds:g} s spent without an answer")


def _receive(item: _Active, progress: Progress) -> RunResult | None:
    try:
        message = item.connection.recv()
    except (EOFError, OSError):
        item.process.join()
        return _without_answer(item, Outcome.FAILED, f"{_DIED} (exit code {item.process.exitcode})")
    if isinstance(message, RunResult):
        return message
    progress.moved(item.run, *message)
    return None


_DIED = "the process died without an answer"


def _died(result: RunResult) -> bool:
    return result.outcome is Outcome.FAILED and result.reason.startswith(_DIED)


def _without_answer(item: _Active, outcome: Outcome, reason: str) -> RunResult:
    return RunResult(outcome, reason, None, None, None, 0, time.monotonic() - item.began, ())
