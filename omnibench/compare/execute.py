"""The runs of a plan, each in a process. One that raises, hangs or dies is a failed run; Ctrl-C keeps those done."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from typing import Any

from omnibench.compare.effective_config import load_calibrators
from omnibench.compare.plan import PlannedRun, RunTask
from omnibench.compare.run_progress import RunProgress
from omnibench.compare.store import RunStore, StoredRun
from omnibench.fit.calibrator import Outcome, RunResult, describe_error, run_calibrator
from omnibench.processes import end_with_parent, main_module_hidden, one_thread_processes
from omnibench.progress import Reporter
from omnibench.registry import calibrators

_GRACE = 10.0  # s after the budget's time: a run that has not stopped by then is killed (chosen)
_PATIENCE = 2.0  # s that a process may take to exit after its answer (chosen)
# Modules that the processes share, so that they need not be imported for every run.
PRELOAD = ("omnibench.compare.execute", "omnibench.fit.sum_of_norms", "nlopt")


@dataclass
class _Active:
    run: PlannedRun
    process: ForkServerProcess
    connection: Connection
    began: float
    evaluations: int = 0

    def end(self, patience: float = _PATIENCE) -> str:
        """Kill the process if it does not exit within ``patience`` s; how it ended, in words."""
        self.process.join(patience)
        self.process.kill()
        self.process.join()
        self.connection.close()
        code = self.process.exitcode or 0
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"

    def without_answer(self, outcome: Outcome, reason: str) -> RunResult:
        """The result of a run whose process gave none."""
        seconds = time.monotonic() - self.began
        return RunResult(outcome, reason, None, None, None, self.evaluations, seconds, ())


def execute(plan: Sequence[PlannedRun], store: RunStore, report: Reporter, workers: int) -> list[RunResult]:
    """Execute the runs, except those whose results are stored: the result of every run, in the plan's order.

    Failed runs are not stored: what made them fail (a missing package, too little memory) may be gone next time.
    KeyboardInterrupt passes through after the running processes are ended; what had ended is in the store.
    """
    results: dict[int, RunResult] = {}
    waiting: list[int] = []
    progress = RunProgress(report, len(plan))
    for index, run in enumerate(plan):
        stored = store.get(run.key)
        if stored is None:
            waiting.append(index)
        else:
            results[index] = stored
            progress.ended(run, stored, reused=True)
    active: dict[int, _Active] = {}
    waiting.reverse()
    with one_thread_processes(PRELOAD) as context:
        try:
            while waiting or active:
                while waiting and len(active) < workers:
                    index = waiting.pop()
                    active[index] = _start(context, plan[index])
                    progress.began(plan[index])
                for index, result in _collect(active, progress):
                    results[index] = result
                    run = active.pop(index).run
                    if result.outcome is not Outcome.FAILED:
                        store.put(run.key, result)
                    progress.ended(run, result, reused=False)
        finally:
            for item in active.values():
                item.end(patience=0.0)
    return [results[index] for index in range(len(plan))]


def _start(context: Any, run: PlannedRun) -> _Active:
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(sender, run.task), daemon=True)
    with main_module_hidden():
        process.start()
    sender.close()
    return _Active(run, process, receiver, time.monotonic())


def _work(connection: Connection, task: RunTask) -> None:
    """Solve one run's problem in a worker process and send the result."""
    threading.Thread(target=end_with_parent, daemon=True).start()
    try:
        answer = StoredRun.of(_solve(task, lambda event: connection.send((event.done, event.best))))
    except BaseException as error:  # whatever a plug-in raises, wherever, is this run's outcome
        answer = StoredRun.of(RunResult(Outcome.FAILED, describe_error(error), None, None, None, 0, 0.0, ()))
    with suppress(OSError):  # a plug-in may have closed it
        connection.send(answer)


def _solve(task: RunTask, watch: Reporter) -> RunResult:
    load_calibrators(task.config)
    calibrator = calibrators.create(task.entry.name, task.entry.options)
    return run_calibrator(calibrator, task.problem(watch))


def _collect(active: dict[int, _Active], progress: RunProgress) -> Iterator[tuple[int, RunResult]]:
    """Wait up to 0.2 s; yield the runs that have ended, and those that are killed because their time is over."""
    ready = wait([item.connection for item in active.values()], timeout=0.2)
    for index, item in list(active.items()):
        seconds = item.run.config.budget.seconds
        result = _receive(item, progress) if item.connection in ready else None
        if result is not None:
            yield index, result
        elif time.monotonic() - item.began > seconds + _GRACE:
            item.end(patience=0.0)
            yield index, item.without_answer(Outcome.TIME, f"ended by force: {seconds:g} s spent without an answer")


def _receive(item: _Active, progress: RunProgress) -> RunResult | None:
    try:
        message = item.connection.recv()
    except (EOFError, OSError):
        return item.without_answer(Outcome.FAILED, f"the process died without an answer ({item.end()})")
    if isinstance(message, StoredRun):
        item.end()
        return message.result()
    item.evaluations, best = message
    progress.moved(item.run, item.evaluations, best)
    return None
