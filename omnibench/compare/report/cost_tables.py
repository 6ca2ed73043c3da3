"""The section on costs: Tables 2 and 3 of the paper with intervals, and published results beside them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.compare.config import THEORETICAL_NAME, PublishedResult
from omnibench.compare.report import view as views
from omnibench.compare.result import EntryStatistics
from omnibench.data.dataset import SPLITS, Split, Trajectory
from omnibench.fit.intervals import Interval
from omnibench.fit.noise import grouped
from omnibench.registry import calibrators
from omnibench.report.blocks import Block, Callout, Cell, Column, Details, Row, Section, Table
from omnibench.report.numbers import NOTHING, count, fixed, listing, percent, seconds, span
from omnibench.robot.kinematics import Array
from omnibench.words import plural

_PUBLISHED_COST = "final_pose"  # published costs are those of Eq. (6)
_UNKNOWN = "not known"
_MET = 1e-4  # share of the lowest cost: searches that end nearer to it are in one minimum (chosen)


def published_blocks(view: views.DatasetView) -> tuple[Block, ...]:
    """Our figures beside the published ones, and the circumstances of both; nothing where none are published."""
    if not view.config.published_results:
        return ()
    if view.config.cost_name != _PUBLISHED_COST:
        remark = f"They are of the cost {_PUBLISHED_COST}, Eq. (6); this comparison's is {view.config.cost_name}."
        return (Callout("The published costs cannot be set beside these", (remark,), "warning"),)
    remarks = tuple(dict.fromkeys(remark for result in view.config.published_results for remark in result.remarks))
    about = (Callout("About the published figures", remarks),) if remarks else ()
    lines = _claims(view)
    claims = (Callout("What the paper claims, and what is seen here", lines),) if lines else ()
    return (_figure_table(view), _circumstance_table(view), *_effort_tables(view), *claims, *about)


def _claims(view: views.DatasetView) -> tuple[str, ...]:
    """Two claims of the paper: curves show systematic errors best, and a genetic algorithm avoids local minima."""
    lines, split, turns = [], view.scored, [run.omega for run in view.dataset.split(view.scored)]
    turning = np.array([bool(turn) for turn in turns])
    if view.runs and None not in turns and 0 < turning.sum() < len(turning):
        costs = view.runs[0].design[split].costs
        curved, straight = float(costs[turning].mean()), float(costs[~turning].mean())
        seen = "so here" if curved > straight else "not here"
        lines.append(
            f"Curves show systematic errors best (section 4.1): {seen}, Eq. (6) of the design values is "
            f"{fixed(curved, 3)} on the {views.SPLIT_NAMES[split]} runs in curves and {fixed(straight, 3)} on straight "
            "ones."
        )
    genetic = next((run for _, entry, run in view.published_entries if entry.parameterisation == "matrix"), None)
    costs_of: dict[str, list[float]] = {}
    for run in view.runs:
        record = run.record
        rival = (
            genetic is not None and record.label != genetic.record.label and run.search_space == genetic.search_space
        )
        if rival and calibrators.entry(record.calibrator).cls.stochastic and record.train_cost is not None:
            costs_of.setdefault(record.label, []).append(record.train_cost)
    if genetic is not None and costs_of:
        box, lowest = genetic.record.box, min(min(costs) for costs in costs_of.values())
        met = [
            f"{sum(cost <= (1 + _MET) * lowest for cost in costs)} of {plural(len(costs), 'run')} of {label}"
            for label, costs in costs_of.items()
        ]
        proven = [
            f"; by proof no matrix of the box is more than {percent(certificate.gap, 2)} below it"
            for certificate in view.certificates
            if certificate.box == box
        ]
        lines.append(
            f"Local minima (section 5): from random starts in the box {box}, {listing(met)} ended within "
            f"{percent(_MET, 2)} of one cost, {fixed(lowest, views.cost_decimals(view))}{''.join(proven)}."
        )
    return tuple(lines)


@dataclass(frozen=True)
class ComparedFigure:
    """One of our figures with its 95 % interval, and the published ones: costs, or shares where ``is_share``.

    decimals: of the published figures, as printed (shares in per cent). methods: labels of the published results.
    """

    name: str
    ours: Interval
    published: tuple[float, ...]
    is_share: bool
    decimals: int
    methods: tuple[str, ...] = ()

    @property
    def alike(self) -> bool:
        """True if our interval contains a published figure."""
        return self.ours.known is not None and any(map(self.ours.holds, self.published))

    @property
    def difference(self) -> str:
        """Our figure relative to the nearest published one, or for shares the percentage points between them."""
        nearest = min(self.published, key=lambda value: abs(value - self.ours.value))
        if self.is_share:
            return f"{fixed(100 * (self.ours.value - nearest), 1, signed=True)} points"
        return percent(self.ours.value / nearest - 1, signed=True)


def compared_figures(view: views.DatasetView) -> list[ComparedFigure]:
    """The design values beside all published results, then each published method beside the entry that is the same.

    Costs and improvements on each split, and the change of the cost from training to validation. A result that names no
    entry with an answer stands beside the best one.
    """
    published, best = view.config.published_results, view.best
    own = {result.label: entry for result, entry, _ in view.published_entries}
    if best is not None and best.calibrator != THEORETICAL_NAME:
        own = {result.label: best for result in published} | own
    entries = {entry.label: entry for entry in own.values()}
    figures = list(_compared(published, None, view.design_costs, {}))
    for label, entry in entries.items():
        same = [result for result in published if result.label in own and own[result.label].label == label]
        costs = {split: cost for split in view.splits if (cost := entry.cost(split)) is not None}
        fell = {split: share for split in view.splits if (share := entry.improvement(split)) is not None}
        figures += _compared(same, label, costs, fell)
    return figures


def _compared(
    published: Sequence[PublishedResult],
    label: str | None,
    costs: Mapping[Split, Interval],
    improvements: Mapping[Split, Interval],
) -> Iterator[ComparedFigure]:
    """Figures of the entry called ``label``, or of the design values, beside those of published results."""
    name, kind, entry = ("theoretical", 0, "") if label is None else ("calibrated", 1, f" ({label})")
    methods = tuple(dict.fromkeys(result.label for result in published)) if kind else ()
    printed = {split: [pair for result in published if (pair := result.costs(split))] for split in SPLITS}
    for split, pairs in printed.items():
        if pairs and split in costs:
            words = f"{name.capitalize()} cost, {views.SPLIT_NAMES[split]}{entry}"
            yield ComparedFigure(words, costs[split], tuple(pair[kind] for pair in pairs), False, 4, methods)
        shares = tuple(share for result in published if (share := result.improvement(split)) is not None)
        if shares and split in improvements:
            words = f"Improvement, {views.SPLIT_NAMES[split]}{entry}"
            yield ComparedFigure(words, improvements[split], shares, True, 2, methods)
    known = [(costs[split].value, ends) for split in SPLITS if split in costs and (ends := costs[split].known)]
    splits = [(result.costs("train"), result.costs("validation")) for result in published]
    both = [(before, after) for before, after in splits if before and after]
    if len(known) < len(SPLITS) or not both:
        return
    change = known[1][0] / known[0][0] - 1
    # Both splits are samples, so that the interval of the change is about that of the two together.
    spread = math.hypot(*((high - low) / 2 / value for value, (low, high) in known))
    ours = Interval(value=change, low=change - spread, high=change + spread)
    changes = tuple(later[kind] / earlier[kind] - 1 for earlier, later in both)
    yield ComparedFigure(f"Change of the {name} cost to validation{entry}", ours, changes, True, 1, methods)


def _figure_table(view: views.DatasetView) -> Table:
    columns: tuple[Column, ...] = (
        Column("Figure", numeric=False),
        Column("Here"),
        Column("Published"),
        Column("From the nearest"),
        Column("Verdict", numeric=False),
    )
    note = "As published: the 95 % interval (small print) contains a published figure."
    if view.dataset.simulated:  # whoever simulates chooses wheels, floor and noise, so agreement would prove nothing
        columns = columns[:-1]
        note = (
            "No verdict: the recordings here are simulated, and what was chosen so that they give the published "
            "figures agrees with them by construction. Small print: 95 % intervals."
        )
    rows = []
    for figure in compared_figures(view):
        ours, decimals = figure.ours, 1 if figure.is_share else views.cost_decimals(view)
        factor, unit = (100.0, " %") if figure.is_share else (1.0, "")
        interval = views.NO_INTERVAL
        if ours.known is not None:
            interval = f"{span(factor * ours.known[0], factor * ours.known[1], decimals)}{unit}"
        theirs = (f"{fixed(factor * value, figure.decimals)}{unit}" for value in figure.published)
        cells = (
            Cell(figure.name),
            Cell(f"{fixed(factor * ours.value, decimals)}{unit}", interval),
            Cell(listing(list(dict.fromkeys(theirs))), listing(list(figure.methods))),
            Cell(figure.difference),
            Cell("as published" if figure.alike else "not as published"),
        )
        rows.append(Row(cells[: len(columns)]))
    sources = listing(list(dict.fromkeys(result.source for result in view.config.published_results)))
    return Table(
        f"Beside the published figures ({sources})",
        columns,
        tuple(rows),
        note,
    )


def _effort_tables(view: views.DatasetView) -> tuple[Table, ...]:
    """Published computing times beside the evaluations and times of the entries that are the same methods."""
    pairs = [
        (result, entry, result.seconds)
        for result, entry, _ in view.published_entries
        if result.seconds is not None and entry.evaluations_median is not None
    ]
    if not (pairs and view.times_compare):
        return ()
    rows = [
        Row.of(
            Cell(result.label, f"here {entry.label}", view.styles[entry.label].colour),
            seconds(published),
            count(entry.evaluations_median),
            seconds(entry.seconds_median),
            fixed(entry.train_median, views.cost_decimals(view)),
        )
        for result, entry, published in pairs
    ]
    slowest, base, longest = max(pairs, key=lambda pair: pair[2])
    rows += [
        Row.of(
            f"{result.label} against {slowest.label}",
            percent(published / longest - 1, 0, signed=True),
            _change(entry.evaluations_median, base.evaluations_median),
            _change(entry.seconds_median, base.seconds_median),
            _change(entry.train_median, base.train_median),
        )
        for result, entry, published in pairs
        if result is not slowest
    ]
    return (
        Table(
            "Effort of the searches",
            (
                Column("Method", numeric=False),
                Column("Time, published"),
                Column("Evaluations here", "median"),
                Column("Time here", "median"),
                Column("CF training here", "median"),
            ),
            tuple(rows),
            "Hardware and program differ, so times compare within a column only; the publication gives no numbers of "
            "evaluations. A search that evaluates less has converged faster only if its cost is not higher.",
        ),
    )


def _change(value: float | None, base: float | None) -> str:
    """Relative change in per cent; a dash where one of the values is not known."""
    return percent(value / base - 1, 1, signed=True) if value is not None and base else NOTHING


def _circumstance_table(view: views.DatasetView) -> Table:
    config, dataset, split = view.config, view.dataset, view.scored
    runs = dataset.split(split)
    origin = "simulated" if dataset.simulated else "recorded by another robot, or at another time"
    systematic, _ = _parts(view.design_errors[split], runs)
    boxes = {entry.box for entry, _ in view.calibrated if entry.parameterisation == "matrix"}
    rows = [
        Row.of("Data", Cell(origin, plural(len(runs), f"{views.SPLIT_NAMES[split]} run")), NOTHING),
        Row.of("Distance of a run, mean", f"{fixed(float(np.mean([_length(run) for run in runs])), 2)} m", _UNKNOWN),
        Row.of("Miss of a command's mean end by the design values", fixed(systematic, 4), _UNKNOWN),
        *_scatter_rows(view, runs),
        Row.of("Odometry", "exact arcs" if config.integration == "arc" else "Euler steps", "Euler steps, Eq. (1)"),
        Row.of("Box of the matrix", listing(sorted(boxes)) or NOTHING, "±10 % of each element"),
    ]
    return Table(
        "In which circumstances",
        (Column("Circumstance", numeric=False), Column("Here", numeric=False), Column("Published", numeric=False)),
        tuple(rows),
        "The theoretical cost comes from deviations of the wheels from their design values, and grows with the "
        "distance driven. Scatter of repetitions can come from the reference, from slip and from the encoders; no "
        f"matrix can remove it.{' See also the notes of the config above.' if config.notes else ''}",
    )


def _scatter_rows(view: views.DatasetView, runs: Sequence[Trajectory]) -> Iterator[Row]:
    """The share of the calibrated cost that no matrix could remove: the scatter of repetitions of one command."""
    best = view.best
    if best is None or best.typical is None or best.calibrator == THEORETICAL_NAME:
        return
    errors, reached = view.errors(best.typical, view.scored), best.cost(view.scored)
    if errors is None or reached is None:
        return
    _, scatter = _parts(errors, runs)
    here = Cell("no command was repeated")
    if scatter is not None:
        here = Cell(fixed(scatter, 4), f"{percent(scatter / reached.value, 0)} of the cost")
    floors = (costs[1] for result in view.config.published_results if (costs := result.costs(view.scored)))
    floor = min(floors, default=None)
    yield Row.of("Scatter of a command's repetitions", here, Cell(_UNKNOWN, "" if floor is None else f"of {floor:.4f}"))


def _parts(errors: Array, runs: Sequence[Trajectory]) -> tuple[float | None, float | None]:
    """Systematic part and scatter of final errors (Z, 3), m, m, rad; None where no command was repeated.

    The systematic part is the norm of a command's mean error, the scatter the norm of a run's deviation from it,
    each on average. sqrt(n / (n - 1)) corrects for a mean that is itself estimated from the n runs.
    """
    repeated = [rows for rows in grouped([run.command for run in runs]) if len(rows) > 1]
    groups = [errors[list(rows)] for rows in repeated if runs[rows[0]].command is not None]
    if not groups:
        return None, None
    means = [float(np.linalg.norm(group.mean(axis=0))) for group in groups]
    deviations = [
        np.linalg.norm(group - group.mean(axis=0), axis=1) * np.sqrt(len(group) / (len(group) - 1)) for group in groups
    ]
    return float(np.mean(means)), float(np.mean(np.concatenate(deviations)))


def _length(run: Trajectory) -> float:
    """The length of a run, m: as commanded, or else along the reference poses."""
    if run.distance is not None:
        return run.distance
    return float(np.hypot(*np.diff(run.poses[:, :2], axis=0).T).sum())


def cost_section(view: views.DatasetView) -> Section:
    """A table of costs for each split, then what is like the published results and what is not."""
    scored = cost_table(view, view.scored)
    others = (
        Details(f"Costs of the {views.SPLIT_NAMES[split]} runs", (cost_table(view, split),))
        for split in view.splits
        if split != view.scored
    )
    published = published_blocks(view)
    beside = (Details("Beside the published figures", published),) if published else ()
    about = "Every entry's cost, and how far it lies below that of the design values."
    return Section("costs", "Costs", (scored, *others, *beside), about=about, folded=True)


def cost_table(view: views.DatasetView, split: Split) -> Table:
    """Table 2 (training) or 3 (validation) of the paper, with intervals."""
    theoretical = view.theoretical_cost(split)
    decimals = views.cost_decimals(view)
    before = fixed(theoretical, decimals)
    design = Cell(before, views.interval_in_words(view.design_costs.get(split), decimals))
    rows = [Row.of(views.entry_cell(view, None), design, NOTHING, NOTHING)]
    searched = [entry for entry in view.statistics if entry.calibrator != THEORETICAL_NAME]
    rows += [_cost_row(view, entry, split, before) for entry in searched]
    rows += _published_rows(view, split)
    number = len(view.dataset.split(split))
    paper = f"As Table {2 if split == 'train' else 3} of the paper. " if view.of_the_paper else ""
    return Table(
        caption=f"Cost of {plural(number, f'{views.SPLIT_NAMES[split]} run')}",
        columns=(
            Column("Entry", numeric=False),
            Column("Cost, design values", priority=1),
            Column(f"Cost, {views.SPLIT_NAMES[split]}"),
            Column("Improvement"),
        ),
        rows=tuple(rows),
        note=f"{paper}The cost is {views.cost_in_words(view)} "
        f"Small print: 95 % intervals, {views.interval_basis(view, split)}, of the run with the median training cost.",
    )


def _cost_row(view: views.DatasetView, entry: EntryStatistics, split: Split, before: str) -> Row:
    reached = entry.cost(split)
    if reached is None:
        failed = [run.record for run in view.runs if run.record.label == entry.label]
        outcome = failed[0].outcome.value if failed else "no run"
        return Row.of(views.entry_cell(view, entry), before, Cell("no answer", outcome), NOTHING, role="failed")
    return Row.of(
        views.entry_cell(view, entry),
        before,
        Cell(
            fixed(reached.value, views.cost_decimals(view)), views.interval_in_words(reached, views.cost_decimals(view))
        ),
        Cell(*views.improvement_in_words(entry, split, 2)),
        role="best" if entry.is_best else "plain",
    )


def _published_rows(view: views.DatasetView, split: Split) -> list[Row]:
    rows = []
    for result in view.config.published_results:
        published = result.costs(split)
        if published is None:
            continue
        before, after = published
        costs = (fixed(before, 4), fixed(after, 4), percent(result.improvement(split), 2))
        rows.append(Row.of(Cell(result.label, result.source), *costs, role="muted"))
    if rows:
        rows.insert(0, Row.of("Published, on other data: not comparable row by row", role="group"))
    return rows
