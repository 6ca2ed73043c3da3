"""Progress of a command while it works: bars on a terminal, plain lines in a pipe."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)

from omnibench.cli.terminal.console import make_console
from omnibench.words import plural

if TYPE_CHECKING:
    from omnibench.compare.plan import PlannedRun
    from omnibench.fit.calibrator import RunResult
    from omnibench.fit.certify import Proof
    from omnibench.live.estimation.health import Health
    from omnibench.live.replay.replay_player import Progress as Played


class EvaluationsBar:
    """A bar of evaluations for one calibrator, on a terminal."""

    def __init__(self, title: str, evaluations: int) -> None:
        console = make_console(error=True)
        self._progress = Progress(
            TextColumn(title),
            BarColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("", total=evaluations, note="")

    def __enter__(self) -> EvaluationsBar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def __call__(self, evaluations: int, best: float) -> None:
        self._progress.update(
            self._task, completed=evaluations, note=f"{plural(evaluations, 'evaluation')}, best {best:.6f}"
        )


class ProofLine:
    """Progress of a proof, on a terminal."""

    def __init__(self) -> None:
        console = make_console(error=True)
        self._progress = Progress(
            TextColumn("proving"),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("", total=None, note="")

    def __enter__(self) -> ProofLine:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def __call__(self, proof: Proof) -> None:
        note = f"{plural(proof.boxes, 'part')} of the box, bound {proof.lower_bound:.6f}, best {proof.best_cost:.6f}"
        self._progress.update(self._task, note=note)


class Steps:
    """Progress of the stages of a command: a bar for each on a terminal, a line for each in a pipe."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> Steps:
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def __call__(self, what: str, done: int, total: int) -> None:
        if what not in self._tasks:
            self._progress.start()  # only now is there something to show
            self._tasks[what] = self._progress.add_task(what, total=total)
            if not self._console.is_terminal:
                self._console.print(f"{what}: {total}", soft_wrap=True)
        self._progress.update(self._tasks[what], completed=done)


class Stages:
    """Names of the stages of a command: a line that changes on a terminal, a line for each stage in a pipe."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("reading", total=None)

    def __enter__(self) -> Stages:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def stage(self, text: str) -> None:
        """Show that this stage begins."""
        if self._console.is_terminal:
            self._progress.update(self._task, description=text)
        else:
            self._console.print(text, soft_wrap=True)


class Bars:
    """A bar for the whole comparison and one for every run that is under way."""

    def __init__(self, console: Console) -> None:
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=console,
        )
        self._all = self._progress.add_task("runs", total=None, note="")
        self._tasks: dict[str, TaskID] = {}
        self._preparation = Steps(console)

    def __enter__(self) -> Bars:
        return self

    def __exit__(self, *_: object) -> None:
        self._preparation.__exit__()
        self._progress.stop()

    def prepared(self, what: str, done: int, total: int) -> None:
        """A bar for each stage in which data sets are made."""
        self._preparation(what, done, total)

    def planned(self, runs: int) -> None:
        """Set the number of runs; only now is there something to show."""
        self._preparation.__exit__()
        self._progress.update(self._all, total=runs)
        self._progress.start()

    def began(self, run: PlannedRun) -> None:
        """A bar of evaluations for the run."""
        total = run.config.budget.evaluations
        self._tasks[run_title(run)] = self._progress.add_task(run_title(run), total=total, note="")

    def moved(self, run: PlannedRun, evaluations: int, best: float) -> None:
        """Evaluations so far and the best cost."""
        self._progress.update(self._tasks[run_title(run)], completed=evaluations, note=f"best {best:.6f}")

    def ended(self, run: PlannedRun, result: RunResult, reused: bool) -> None:
        """The bar gives way to a line."""
        task = self._tasks.pop(run_title(run), None)
        if task is not None:
            self._progress.remove_task(task)
        self._progress.console.print(run_line(run, result, reused))
        self._progress.advance(self._all)


class Lines:
    """Plain lines, for pipes and logs."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._preparation = Steps(console)
        self._runs = 0
        self._ended = 0

    def __enter__(self) -> Lines:
        return self

    def __exit__(self, *_: object) -> None: ...

    def prepared(self, what: str, done: int, total: int) -> None:
        """A line for each stage in which data sets are made."""
        self._preparation(what, done, total)

    def planned(self, runs: int) -> None:
        """Set the number of runs."""
        self._runs = runs

    def began(self, run: PlannedRun) -> None: ...

    def moved(self, run: PlannedRun, evaluations: int, best: float) -> None: ...

    def ended(self, run: PlannedRun, result: RunResult, reused: bool) -> None:
        """One line for every run."""
        self._ended += 1
        line = f"[{self._ended}/{self._runs}] {run_line(run, result, reused)}"
        self._console.print(line, soft_wrap=True)


def run_title(run: PlannedRun) -> str:
    """Data set, entry and seed of a run."""
    return f"{run.dataset_name} {run.label} seed {run.seed}"


def run_line(run: PlannedRun, result: RunResult, reused: bool) -> str:
    """Outcome of a run, in one line."""
    cost = "no answer" if result.cost is None else f"cost {result.cost:.6f}"
    kept = ", kept from an earlier run" if reused else ""
    figures = f"{cost}, {plural(result.evaluations, 'evaluation')}, {result.seconds:.1f} s{kept}"
    return f"{run_title(run)}: {result.outcome}, {figures} ({result.reason})"


class ReplayBar:
    """Progress of a replay, on a terminal; a line every ten seconds when piped."""

    _PERIOD = 10.0  # s

    def __init__(self, title: str) -> None:
        self.console = make_console(error=True)
        self._progress = Progress(
            TextColumn(title),
            BarColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=self.console,
            transient=True,
            disable=not self.console.is_terminal,
        )
        self._task = self._progress.add_task("", total=None, note="")
        self._title = title
        self._told = 0.0

    def __enter__(self) -> ReplayBar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def __call__(self, played: Played, health: Health | None = None) -> None:
        note = f"{played.data_seconds:.0f} s of the drive"
        if health is not None:
            note += f", {health.rate_hz:.0f} samples/s, {plural(health.counts['poses'], 'pose')} fused"
        self._progress.update(self._task, total=played.total, completed=played.done, note=note)
        if not self.console.is_terminal and played.wall_seconds - self._told >= self._PERIOD:
            self._told = played.wall_seconds
            self.console.print(f"{self._title}: {played.done} of {plural(played.total, 'message')}, {note}")
