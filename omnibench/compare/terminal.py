"""A comparison on a terminal: progress while it runs, the paper's Tables 2 and 3 when it has."""

from __future__ import annotations

import math

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from omnibench.compare.plan import PlannedRun
from omnibench.compare.results import ComparisonResult, EntryStatistics, Interval
from omnibench.fit.calibrator import RunResult


class Bars:
    """A bar for the whole comparison and one for every run that is under way."""

    def __init__(self, console: Console) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=console,
        )
        self._all = self._progress.add_task("[bold]runs", total=None, note="")
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> Bars:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def planned(self, runs: int) -> None:
        """How many runs there will be."""
        self._progress.update(self._all, total=runs)

    def began(self, run: PlannedRun) -> None:
        """A bar of evaluations for the run."""
        total = run.config.budget.evaluations
        self._tasks[run.key] = self._progress.add_task(run_title(run), total=total, note="")

    def moved(self, run: PlannedRun, evaluations: int, best: float) -> None:
        """Evaluations so far and the best cost."""
        self._progress.update(self._tasks[run.key], completed=evaluations, note=f"best {best:.6f}")

    def ended(self, run: PlannedRun, result: RunResult, reused: bool) -> None:
        """The bar gives way to a line."""
        task = self._tasks.pop(run.key, None)
        if task is not None:
            self._progress.remove_task(task)
        self._progress.console.print(run_line(run, result, reused), highlight=False, markup=False)
        self._progress.advance(self._all)


class Lines:
    """Plain lines, for pipes and logs."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._runs = 0
        self._ended = 0

    def __enter__(self) -> Lines:
        return self

    def __exit__(self, *_: object) -> None: ...

    def planned(self, runs: int) -> None:
        """How many runs there will be."""
        self._runs = runs

    def began(self, run: PlannedRun) -> None: ...

    def moved(self, run: PlannedRun, evaluations: int, best: float) -> None: ...

    def ended(self, run: PlannedRun, result: RunResult, reused: bool) -> None:
        """One line for every run."""
        self._ended += 1
        line = f"[{self._ended}/{self._runs}] {run_line(run, result, reused)}"
        self._console.print(line, highlight=False, markup=False, soft_wrap=True)


def run_title(run: PlannedRun) -> str:
    """Data set, entry and seed of a run."""
    return f"{run.dataset_name} {run.label} seed {run.seed}"


def run_line(run: PlannedRun, result: RunResult, reused: bool) -> str:
    """How a run ended, in one line."""
    cost = "no answer" if result.cost is None else f"cost {result.cost:.6f}"
    kept = ", kept from an earlier run" if reused else ""
    figures = f"{cost}, {result.evaluations} evaluations, {result.seconds:.1f} s{kept}"
    return f"{run_title(run)}: {result.outcome}, {figures} ({result.reason})"


def print_result(console: Console, result: ComparisonResult) -> None:
    """The tables of every data set, and where the report is."""
    for name, dataset in result.datasets.items():
        entries = [entry for entry in result.statistics if entry.dataset == name]
        kind = " (simulated data)" if dataset.simulated else ""
        for title, split in (("Training", "train"), ("Validation", "validation")):
            if split == "validation" and not dataset.split("validation"):
                continue
            count = len(dataset.split("train" if split == "train" else "validation"))
            console.print(
                _table(f"{title}: {name}{kind}, {count} trajectories, cost {result.config.cost.name}", entries, split)
            )
    console.print(_search_table(result.statistics))
    console.print(
        "intervals: 95 % bootstrap over trajectories;  = : practically equal to the best;  gap: above the "
        "exact optimum in the same box",
        soft_wrap=True,
        highlight=False,
    )


def _table(title: str, entries: list[EntryStatistics], split: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column("M^-1")
    for heading in (
        "CF theoretical",
        f"CF {'training' if split == 'train' else 'validation'}",
        "95 % interval",
        "Improvement",
        "95 % interval",
    ):
        table.add_column(heading, justify="right")
    if split == "validation":
        for heading in ("position", "heading", "against best"):
            table.add_column(heading, justify="right")
    for entry in entries:
        table.add_row(*_cells(entry, split), style="bold" if entry.is_best else None)
    return table


def _cells(entry: EntryStatistics, split: str) -> list[str]:
    if entry.typical is None:
        return [entry.label, "no answer"]
    record = entry.typical.record
    train = split == "train"
    theoretical = record.theoretical_train_cost if train else record.theoretical_validation_cost
    cost = entry.train if train else entry.validation
    improvement = entry.train_improvement if train else entry.validation_improvement
    cells = [entry.label, _number(theoretical), *_interval(cost, "{:.4f}"), *_interval(improvement, "{:.2%}")]
    if not train:
        position, heading = record.validation_position_m, record.validation_heading_rad
        cells.append("" if position is None else f"{1000 * position:.1f} mm")
        cells.append("" if heading is None else f"{math.degrees(heading):.2f} deg")
        cells.append(_against_best(entry))
    return cells


def _search_table(entries: tuple[EntryStatistics, ...]) -> Table:
    table = Table(title="How each was found", title_justify="left", title_style="bold")
    for heading in ("data set", "M^-1", "box", "outcome"):
        table.add_column(heading)
    for heading in ("runs", "evaluations", "time", "gap", "on a bound"):
        table.add_column(heading, justify="right")
    for entry in entries:
        record = entry.typical.record if entry.typical else None
        table.add_row(
            entry.dataset,
            entry.label,
            entry.box,
            str(record.outcome) if record else "no answer",
            f"{entry.answers}/{entry.runs}",
            f"{entry.evaluations_median:.0f}" if entry.evaluations_median is not None else "",
            f"{entry.seconds_median:.2f} s" if entry.seconds_median is not None else "",
            f"{entry.gap_median:.1e}" if entry.gap_median is not None else "",
            ", ".join(record.at_bounds) if record else "",
        )
    return table


def _against_best(entry: EntryStatistics) -> str:
    if entry.is_best:
        return "best"
    if entry.difference is None:
        return ""
    return f"{'= ' if entry.practically_equal else ''}{entry.difference.value:+.5f}"


def _interval(interval: Interval | None, form: str) -> list[str]:
    if interval is None:
        return ["", ""]
    return [form.format(interval.value), f"{form.format(interval.low)} .. {form.format(interval.high)}"]


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"
