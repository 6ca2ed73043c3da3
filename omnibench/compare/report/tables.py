"""Tables of a comparison: costs and errors, how fits ended, ratios of methods in cells, matrices, data."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from omnibench.compare.config import AS_RECORDED, THEORETICAL_NAME
from omnibench.compare.plan import ComparedRobot
from omnibench.compare.report import view as views
from omnibench.compare.result import Cell as MethodCell
from omnibench.compare.result import ComparisonResult, EntryStatistics, RunRecord, ScoredFit, mean_ratio
from omnibench.data.dataset import SPLITS, Split
from omnibench.fit.evaluate import positions_and_headings
from omnibench.fit.intervals import Interval
from omnibench.fit.span import driven_span
from omnibench.registry import costs
from omnibench.report import blocks, numbers
from omnibench.report.blocks import Block, Cell, Code, Column, Row, RowRole, Table
from omnibench.report.calibration_report import parameter_cells
from omnibench.report.numbers import NOTHING, count, decimals_for, fixed, listing, percent, seconds, significant
from omnibench.robot.kinematics import Array, relative_deviations
from omnibench.words import plural

_BROKEN = 1.5  # times the method's own error as recorded, from which on it counts as broken; chosen


def cost_table(view: views.DatasetView, split: Split, *, brief: bool = False) -> Table:
    """Cost, improvement, final errors and verdict of every entry on a split, the design values first.

    brief: a line an entry, without worst errors, differences and the rows of Table 2 or 3 of the paper.
    """
    design = next((entry for entry in view.statistics if entry.calibrator == THEORETICAL_NAME), None)
    asked = [entry for entry in view.statistics if entry is not design]
    asked.sort(key=lambda entry: entry.costs[split].value if split in entry.costs else math.inf)
    lines: list[tuple[EntryStatistics | None, Interval | None, Array | None]] = []
    lines.append((design, view.design_costs.get(split), view.design_errors[split]))
    lines += [(entry, entry.cost(split), view.errors(entry, split)) for entry in asked]
    means = [np.nan if of is None else views.mean_and_worst(positions_and_headings(of)[0])[0] for *_, of in lines]
    factor, unit, digits = views.position_unit(*means)
    rows, decimals = [], view.cost_decimals
    for entry, cost, errors in lines:
        improvement = None if entry is design or entry is None else entry.improvement(split)
        positions, headings = (np.array([]),) * 2 if errors is None else positions_and_headings(errors)
        position, worst = (fixed(factor * value, digits) for value in views.mean_and_worst(positions))
        heading, most = (fixed(np.degrees(value), 2) for value in views.mean_and_worst(headings))
        difference = ("", "")
        if entry is not None and entry.difference is not None and not entry.is_best:
            difference = views.difference_cells(entry.difference)
        label, role = THEORETICAL_NAME if entry is None else entry.label, row_role(entry)
        colour = views.THEORETICAL_STYLE if entry is design else view.styles[label]
        reached = fixed(None if cost is None else cost.value, decimals), views.interval_cell(cost, decimals)
        fell = views.improvement_cells(improvement, 1 if brief else 2)
        said = "" if entry is None else verdict(view, entry)
        finals = ((position, worst), (heading, most))
        ends = [Cell(mean, "" if mean == NOTHING else f"worst {largest}") for mean, largest in finals]
        judged: list[Cell | str] = [Cell(*difference), said] if split == view.scored else []
        shown: list[Cell | str] = [Cell(*reached), Cell(*fell), *ends, *judged]
        if brief:
            shown = [*reached, fell[0], position, heading, said]
        rows.append(Row.of(Cell(label, "", colour.colour), *shown, role=role))
    of_paper = [(result, pair) for result in view.config.published_results if (pair := result.costs(split))]
    if of_paper and not brief:
        rows.append(Row.of("Published, on other data: not comparable row by row", role="group"))
        for result, (before, after) in of_paper:
            theirs = Cell(fixed(after, 4), f"from {fixed(before, 4)}"), percent(result.improvement(split), 2)
            blank = [""] * (len(rows[0].cells) - 3)
            rows.append(Row.of(Cell(result.label, result.source), *theirs, *blank, role="muted"))
    columns = [Column("Entry", numeric=False), Column("Cost"), Column("Improved", priority=1)]
    columns += [Column("Position", unit, priority=2), Column("Heading", "°", priority=3)]
    columns += [Column("Difference from the best")] if split == view.scored and not brief else []
    columns += [Column("Against the best", numeric=False)] if split == view.scored else []
    columns[2:2] = [Column("95 % interval", priority=4)] if brief else []
    name = f"{view.name}{' (simulated)' if view.dataset.simulated else ''}"
    title = f"{name}: {view.runs_in_words(split)}, cost {view.config.objective}"
    return Table(title, tuple(columns), tuple(rows))


def row_role(entry: EntryStatistics | None) -> RowRole:
    """The role of an entry's row; None stands for the design values."""
    return "plain" if entry is None else "best" if entry.is_best else "plain" if entry.answers else "failed"


def cost_note(view: views.DatasetView) -> str:
    """What costs, differences and verdicts mean."""
    name, units = view.config.cost_name, view.units(view.scored)
    loss = f" It was fitted with the loss {view.config.loss}; figures here are without it."
    loss = "" if view.config.loss == "squares" else loss
    paper = "As Tables 2 and 3 of the paper. " if view.config.published_results else ""
    return (
        f"{paper}The cost is {name}: {costs.entry(name).summary.rstrip('.')}."
        f"{loss} Intervals: {units.ratio_words}, of the run of median training cost; differences are paired by "
        f"{units.name}. Not told apart: the difference may be chance, or is below a tenth of the standard "
        "error of the best entry's cost. Best: the lowest training cost of the entries that are not known "
        "to differ from the one of lowest cost on the runs that judge."
    )


def verdict(view: views.DatasetView, entry: EntryStatistics) -> str:
    """The verdict on an entry in a few words."""
    if entry.typical is None:
        return "no answer"
    if entry.is_best:
        return "lowest training cost" if view.undecided else "best"
    if entry.practically_equal is None or entry.difference is None:
        return "undecided"
    if entry in view.rivals:
        return "not told apart"
    # The design values may be practically equal, and yet the best one's improvement on them more than chance
    return "worse" if entry.practically_equal or entry.difference.value > 0 else "lower cost here"


def outcome_table(result: ComparisonResult, fits: Sequence[ScoredFit], *, every: bool = False) -> Table:
    """How fits ended, what they took, and of data sets costs, gaps and bounds: an entry in a line, or ``every`` fit."""
    groups: dict[tuple[str, str, int], list[ScoredFit]] = {}
    for number, run in enumerate(fits):
        groups.setdefault((run.fit.robot.name, run.fit.label, number if every else 0), []).append(run)
    machines = {run.result.timing.machine for run in fits if run.result.timing}
    rows, last, of_sets = [], "", bool(result.config.datasets)
    for (robot, label, _), group in groups.items():
        if robot != last and len(result.robots) > 1 and not of_sets:
            rows.append(Row.of(robot, role="group"))
        last, answered = robot, [run for run in group if run.errors is not None]
        outcomes = Counter(run.result.outcome.replace("_", " ") for run in group)
        spent = [run.result.seconds for run in (group if of_sets else answered)]
        timings = [run.result.seconds / t.reference_seconds for run in group if (t := run.result.timing)]
        time = seconds(float(np.median(spent))) if spent else NOTHING
        if len(machines) > 1:
            time = f"{count(float(np.median(timings)))} of the start" if timings else NOTHING
        cells: list[Cell | str] = [
            Cell(label, f"seed {group[0].record.seed}" if every else f"{len(answered)} of {len(group)} answered"),
            Cell(", ".join(f"{n} {each}" if len(group) > 1 else each for each, n in outcomes.items())),
            count(float(np.median([run.result.evaluations for run in group]))),
            time if result.config.timing else NOTHING,
        ]
        if of_sets:
            cells += _costs_of([run.record for run in group])
        reasons = list(dict.fromkeys(run.result.reason for run in (group if of_sets else (answered or group)[:1])))
        rows.append(Row.of(*cells, listing(reasons, 2), role="plain" if answered else "failed"))
    names = {run.fit.robot.name for run in fits}
    proofs = [proof for proof in result.certificates if proof.dataset in names and not every]
    if proofs:
        rows.append(Row.of("What no optimiser can beat", role="group"))
    for proof in proofs:
        how = "proven" if proof.finished else "time or parts ran out"
        bound, left = significant(proof.lower_bound, 6), f"≤ {percent(proof.gap, 2)}"
        least = Cell(bound, f"{significant(proof.best_cost, 6)} was found")
        parts = f"{count(proof.parts)} parts of the box"
        ends = ("", Cell(left, "of the cost is left"), "", "no matrix of the box has a lower training cost")
        rows.append(Row.of(f"box {proof.box}", Cell(how, parts), "", seconds(proof.seconds), least, *ends))
    note = "Medians over fits." if not every else ""
    if of_sets:
        note += f" Gap: above closed_form in the same box; {NOTHING} where that has no answer or leaves no error."
        note += " Proven: the share of the cost that any optimiser could still save in that box, at most."
    note += "" if result.config.timing else " The runs were not timed."
    if len(machines) > 1 and result.config.timing:
        note += " Runs were made on machines of different speed: times are in evaluations of the start's cost there."
    columns = [Column("Entry", numeric=False), Column("Outcome", numeric=False), Column("Evaluations", priority=2)]
    columns.append(Column("Time", priority=3))
    if of_sets:
        columns += [Column("Cost, training"), Column("Cost, held-out", priority=1), Column("Gap", priority=1)]
        columns.append(Column("On a bound", numeric=False, priority=4))
    columns.append(Column("What it says", numeric=False, priority=2))
    return Table("Every run" if every else "Outcomes and time", tuple(columns), tuple(rows), note.strip())


def _costs_of(records: Sequence[RunRecord]) -> Iterator[Cell | str]:
    """Median costs and gaps of some runs with their spread, and the elements that searches moved to a bound."""

    def known(name: str) -> list[float]:
        return [value for record in records if (value := getattr(record, name)) is not None]

    train, held_out, gaps, proofs = map(known, ("train_cost", "validation_cost", "gap", "proven_gap"))
    digits = decimals_for(float(np.median(train)) if train else None, 5)
    spread = significant(float(np.subtract(*np.percentile(train, [75, 25]))), 2) if len(train) > 1 else ""
    yield Cell(fixed(float(np.median(train)), digits) if train else NOTHING, spread and f"spread {spread}")
    yield fixed(float(np.median(held_out)), digits) if held_out else NOTHING
    gap = float(np.median(gaps)) if gaps else None
    left = f"proven: ≤ {percent(max(float(np.median(proofs)), 0.0), 2)}" if proofs else ""
    yield Cell("0" if gap is not None and abs(gap) < 5e-13 else significant(gap, 2), left)  # below it: rounding
    bounds = dict.fromkeys(name for record in records for name in record.at_bounds if name not in record.held)
    yield ", ".join(bounds) or NOTHING


def matrix_table(view: views.DatasetView, against: str | None = None, labels: Sequence[str] = ()) -> Table:
    """Matrices of typical answers, below each element its difference from the design's, or from the entry ``against``.

    Eq. (10) and (11) of the paper. labels: of the entries that are shown; default: all.
    """
    matrices = {entry.label: run.matrix for entry, run in view.calibrated if run.matrix is not None}
    robot = view.dataset.robot
    reference = robot.inverse_kinematic_matrix if against is None else matrices[against]
    projector: Array | None = None
    if len(robot.drive.names) > len(robot.motions):  # across the span of what is driven a matrix is not determined
        driven = driven_span(view.dataset.split("train")).driven
        projector = driven.T @ driven
    names = [f"m{row}{column}" for row in (1, 2, 3) for column in range(1, reference.shape[1] + 1)]
    first = Cell(against or THEORETICAL_NAME, "", "" if against else views.THEORETICAL_STYLE.colour)
    rows = [Row.of(first, *(fixed(float(value), 6) for value in reference.ravel()))]
    for entry, run in view.calibrated:
        if entry.label not in matrices or entry.label == against or (labels and entry.label not in labels):
            continue
        matrix, marks = matrices[entry.label], bound_marks(run.record) if entry.parameterisation == "matrix" else {}
        moved = matrix - reference if projector is None else (matrix - reference) @ projector
        shares = relative_deviations(reference + moved, reference).ravel()
        cells = []
        for name, value, share, change in zip(names, matrix.ravel(), shares, moved.ravel(), strict=True):
            absolute = "0" if abs(change) < 1e-15 else significant(float(change), 2, signed=True)
            note = absolute if math.isnan(share) else f"{fixed(100 * float(share), 3, signed=True)} %"
            cells.append(Cell(fixed(float(value), 6) + marks.get(name, ""), note))
        named = Cell(entry.label, entry.parameterisation, view.styles[entry.label].colour)
        rows.append(Row.of(named, *cells, role=row_role(entry)))
    return Table(
        f"Matrices M⁻¹ and their differences from {'the design values' if against is None else against}",
        (Column("Entry", numeric=False), *(Column(n, "rad/rad" if n[1] == "3" else "m/rad") for n in names)),
        tuple(rows),
        f"Columns of each row: {', '.join(robot.drive.names)}. Small print: the change as a share, or the change "
        "itself where there is nothing to divide by. † on a bound of its box; ‡ held by a box without width there."
        + ("" if projector is None else " Compared on the span of drive signals that the data drive."),
    )


def parameter_table(view: views.DatasetView) -> Iterator[Table]:
    """Physical parameters of searched geometries and their deviation from the design values, as in section 4.2."""
    fitted = {entry.label: run.record for entry, run in view.calibrated if run.record.parameters}
    by_name: dict[str, dict[str, Cell]] = {}
    for label, record in fitted.items():
        for each in record.parameters or ():
            design, value, unit, change, _ = parameter_cells(each)
            shown = numbers.typeset(f"{value} {unit}"), bound_marks(record).get(each.name, "")
            of_labels = by_name.setdefault(each.name, {"": Cell(numbers.typeset(f"{design} {unit}"))})
            of_labels[label] = Cell(" ".join(shown).strip(), numbers.typeset(change))
    rows = [Row.of(name, *(of.get(label, NOTHING) for label in ("", *fitted))) for name, of in by_name.items()]
    if rows:
        yield Table(
            "Physical parameters and their deviation from the design values",
            (Column("Parameter", numeric=False), Column("design"), *map(Column, fitted)),
            tuple(rows),
            "A geometry takes up whatever else is wrong with the model, so that a parameter by itself is no "
            "measurement of the robot. † on a bound of its limits; ‡ held by limits without width.",
        )


def bound_marks(record: RunRecord) -> dict[str, str]:
    """† for what a search moved to a bound, ‡ for what its box holds."""
    return {**dict.fromkeys(record.at_bounds, "†"), **dict.fromkeys(record.held, "‡")}


def methods_table(result: ComparisonResult) -> Table:
    """Every method on every robot: geometric mean over cells of its error as a share of the design's, or why none."""

    def on_robot(robot: str, method: str) -> Cell:
        mine = [cell for cell in result.judged_cells if cell.key.robot == robot and method in cell.methods]
        ratios = [share for cell in mine if (share := cell.share(method)) is not None]
        if (mean := mean_ratio(ratios)) is not None:
            return Cell(fixed(mean, 2), plural(len(ratios), "cell"))
        return Cell(mine[0].methods[method].status if mine else NOTHING)

    caption = "Mean error of runs that did not train, Eq. (6), as a share of the design's, geometric mean over cells"
    return _by_method(result, caption, {robot.name: partial(on_robot, robot.name) for robot in result.robots})


def _by_method(
    result: ComparisonResult, caption: str, columns: Mapping[str, Callable[[str], Cell]], note: str = ""
) -> Table:
    """A row for each method."""
    methods = [entry.shown for entry in result.config.entries]
    rows = tuple(Row.of(method, *(make(method) for make in columns.values())) for method in methods)
    return Table(caption, (Column("Method", numeric=False), *map(Column, columns)), rows, note)


def cell_table(result: ComparisonResult, cell: MethodCell) -> Table:
    """Every method in one cell, the least error first, those without an answer last."""
    robot, judged = result.datasets[cell.key.robot].robot, len(result.judged_cells)
    in_order = sorted(cell.methods.values(), key=lambda each: (each.errors is None, each.mean("cost") or 0.0))
    rows, unit = [], ""
    for number, each in enumerate(in_order):
        name = Cell(each.method, "" if each.family == "other" else each.family)
        ratio = cell.ratio(each.method, cells=judged)
        if ratio is None:
            rows.append(Row.of(name, *[NOTHING] * 4, each.status, NOTHING, each.reason, role="failed"))
            continue
        found, unit = "", f"; intervals by {ratio.units}"
        if each.matrix is not None:
            shares = 100 * (each.matrix - robot.inverse_kinematic_matrix) / robot.row_scales[:, None]
            changed = zip(("x", "y", "turn"), shares, strict=True)
            found = "; ".join(f"{row} {', '.join(f'{v:+.1f}' for v in of_row)}" for row, of_row in changed)
        partly = "" if each.answers == each.fits else f"{each.status}; else the design"
        rows.append(
            Row.of(
                name,
                fixed(each.mean("cost"), 4),
                Cell(fixed(ratio.value, 3), views.interval_cell(ratio.alone, 2)),
                fixed(1e3 * (each.mean("position") or 0.0), 1),
                fixed(math.degrees(each.mean("heading") or 0.0), 2),
                Cell("" if cell.key.fitted or ratio.equal else ratio.verdict, partly),
                seconds(each.seconds if result.config.timing else None),
                Cell(each.numbers, found and f"matrix: {found} % of the row"),
                role="plain" if number else "best",
            )
        )
    numbers = (("run", cell.pairs.runs), ("calibration", cell.pairs.folds))
    runs, folds = (plural(len(set(each.tolist())), word) for word, each in numbers)
    errors = (Column("Position", "mm", priority=1), Column("Heading", "°", priority=1))
    ends = (Column("Verdict", numeric=False), Column("Time", priority=2))
    found_column = Column("What it found", numeric=False, priority=3)
    columns = blocks.columns("Method", "Cost", "of the design's", *errors, *ends, found_column)
    note = (
        f"Mean final errors, Eq. (6); {runs} of {plural(cell.pairs.sessions, 'session')} judge {folds}{unit}. "
        f"Intervals are of this cell; verdicts hold for each method in {plural(judged, 'cell')} together."
    )
    return Table(f"{cell.key.robot}: {cell.key.within_robot}", columns, tuple(rows), note)


def regime_table(result: ComparisonResult) -> Table:
    """Which method breaks where: its error in each regime as a multiple of its own as recorded."""
    places: dict[tuple[str, ...], dict[str, MethodCell]] = {}
    for cell in result.cells:
        if not cell.key.fitted:
            places.setdefault((cell.key.robot, cell.key.training, cell.key.judged), {})[cell.key.regime] = cell

    def in_regime(regime: str, method: str) -> Cell:
        pairs = [(of[AS_RECORDED], of[regime]) for of in places.values() if {AS_RECORDED, regime} <= of.keys()]
        means = [(a, b, worse) for usual, worse in pairs if (a := usual.mean(method)) and (b := worse.mean(method))]
        mean = mean_ratio([b / a for a, b, _ in means])
        broken = sum(b > _BROKEN * a for a, b, _ in means)
        beyond = sum(b > float(cell.design["cost"].mean()) * (1 + 1e-9) for _, b, cell in means)
        note = f"{broken} of {len(means)} break; {beyond} worse"
        return Cell(NOTHING) if mean is None else Cell(fixed(mean, 2), note)

    note = (
        f"Eq. (6), geometric mean over cells. Break: cells with more than {_BROKEN:g} times its own error as recorded; "
        "worse: with more error than the design."
    )
    columns = {regime: partial(in_regime, regime) for regime in result.config.regimes}
    return _by_method(result, "Error as a multiple of the method's own as recorded", columns, note)


def data_table(robots: Sequence[ComparedRobot], broken: Mapping[str, str]) -> Table:
    """Data sets, or robots, with their runs, sessions and trainings, and those whose recordings cannot be read."""
    rows = []
    for robot in robots:
        dataset, runs = robot.dataset, robot.dataset.trajectories
        sessions, commands = {run.session for run in runs} - {None}, {run.command for run in runs} - {None}
        sizes = [f"{count(len(dataset.split(split)))} {views.SPLIT_NAMES[split]}" for split in SPLITS]
        lasting = f"{significant(min(run.end for run in runs), 3)} to {significant(max(run.end for run in runs), 3)} s"
        rows.append(
            Row.of(
                Cell(robot.name, "simulated" if dataset.simulated else "recorded"),
                Cell(count(len(runs)), listing(sizes)),
                Cell(lasting, f"samples every {significant(1e3 * dataset.sample_period, 3)} ms"),
                count(len(commands)) if commands else "not known",
                count(len(sessions)) if sessions else "not known",
                listing([training.name for training in robot.trainings], 20),
                Cell(dataset.source, dataset.licence),
                dataset.hash[:8],
            )
        )
    for name, reason in broken.items():
        rows.append(Row.of(name, *[""] * 4, Cell("cannot be read", reason), "", "", role="failed"))
    numbers = map(Column, ("Runs", "Duration of a run", "Commands", "Sessions"))
    words = [Column(title, numeric=False) for title in ("Trainings", "Source", "SHA-256")]
    described = [f"{robot.name}: {robot.dataset.description}" for robot in robots if robot.dataset.description]
    return Table("Recordings", (Column("Name", numeric=False), *numbers, *words), tuple(rows), " ".join(described))


def matrix_blocks(view: views.DatasetView) -> Iterator[Block]:
    """Matrices beside the design's, Eq. (11) where the paper's two methods are here, parameters, all digits."""
    yield matrix_table(view)
    of_paper = {entry.parameterisation: entry.label for _, entry, _ in view.published_entries}
    if {"geometry", "matrix"} <= of_paper.keys():
        yield matrix_table(view, of_paper["matrix"], [of_paper["geometry"]])
    yield from parameter_table(view)
    # So many digits that reading them gives exactly the same numbers
    named = [("theoretical", view.dataset.robot.inverse_kinematic_matrix)]
    named += [(entry.label, run.matrix) for entry, run in view.calibrated if run.matrix is not None]
    lines = (f"{json.dumps(label)}: {json.dumps(matrix.tolist())}" for label, matrix in named)
    yield Code("\n".join(lines), "Matrices with all digits (YAML): rows x and y in m/rad, heading in rad/rad")
