"""The sections on matrices and on outcomes: elements, entries over their seeds, proven bounds, every run."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence

from omnibench.compare.report import view as views
from omnibench.compare.result import BoxCertificate, EntryStatistics, RunRecord
from omnibench.fit.span import driven_span
from omnibench.registry import calibrators
from omnibench.report.blocks import Block, Cell, Code, Column, Details, Paragraph, Row, Section, Table
from omnibench.report.numbers import NOTHING, count, decimals_for, fixed, listing, percent, seconds, significant
from omnibench.robot.kinematics import Array, relative_deviations
from omnibench.robot.physical import PhysicalParameter


def matrix_section(view: views.DatasetView) -> Section:
    """Matrices, their differences from the design values and from the reference entry, parameters, all digits."""
    about = "All elements, their differences from the design values, and the wheels that they stand for."
    return Section("matrices", "Matrices", _blocks(view), about=about, folded=True)


def _blocks(view: views.DatasetView) -> tuple[Block, ...]:
    if not view.calibrated:
        return (Paragraph("No run gave a matrix.", "note"),)
    blocks: list[Block] = [_element_table(view), _difference_table(view, None)]
    if view.reference_entry is not None and len(view.calibrated) > 1:
        blocks.append(_difference_table(view, view.reference_entry[0].label))
    blocks += _published_differences(view)
    parameters = parameter_table(view)
    if parameters is not None:
        blocks.append(parameters)
    # Every matrix as YAML, with so many digits that reading it gives exactly the same numbers
    named = [("theoretical", view.design_matrix)]
    named += [(entry.label, run.matrix) for entry, run in view.calibrated if run.matrix is not None]
    parts = []
    for label, matrix in named:
        rows = ",\n  ".join(f"[{', '.join(repr(float(value)) for value in row)}]" for row in matrix)
        parts.append(f"{json.dumps(label)}: [\n  {rows}]")
    blocks.append(Code("\n".join(parts), "Matrices with all digits (YAML): rows x and y in m/rad, heading in rad/rad"))
    return tuple(blocks)


def parameter_table(view: views.DatasetView) -> Table | None:
    """Physical parameters and their deviation from the design values, as in section 4.2; None without any."""
    fitted = [(entry, run.record) for entry, run in view.calibrated if run.record.parameters]
    if not fitted:
        return None
    names = list(dict.fromkeys(p.name for _, record in fitted for p in record.parameters or ()))
    rows = []
    for name in names:
        kind, _, wheel = name.partition("_")
        cells = [Cell(f"{kind}, wheel {wheel}" if wheel else name)]
        values = [next((p for p in record.parameters or () if p.name == name), None) for _, record in fitted]
        known = next(parameter for parameter in values if parameter is not None)
        cells.append(Cell(_shown(known.design, known.unit)))
        for parameter, (_, record) in zip(values, fitted, strict=True):
            cells.append(_parameter_cell(parameter, _marks(record).get(name, "")))
        rows.append(Row.of(*cells))
    columns = (Column("Parameter", numeric=False), Column("design"), *(Column(entry.label) for entry, _ in fitted))
    return Table(
        "Physical parameters and their deviation from the design values",
        columns,
        tuple(rows),
        ("As section 4.2 of the paper. " if view.of_the_paper else "")
        + "Each matrix has one such geometry, but it takes up whatever else is wrong "
        "with the model, so a parameter by itself is not a measurement of the robot. † on a bound of its limits."
        + (" ‡ held by limits without width." if any(record.held for _, record in fitted) else ""),
    )


def _element_table(view: views.DatasetView) -> Table:
    rows = [Row.of(views.entry_cell(view, None), *(fixed(float(v), 6) for v in view.design_matrix.ravel()))]
    for entry, run in view.calibrated:
        if run.matrix is None:
            continue
        marks = _marks(run.record) if entry.parameterisation == "matrix" else {}
        cells = [
            fixed(float(value), 6) + marks.get(name, "")
            for name, value in zip(_element_names(view), run.matrix.ravel(), strict=True)
        ]
        rows.append(Row.of(views.entry_cell(view, entry), *cells, role="best" if entry.is_best else "plain"))
    drive = view.dataset.robot.drive
    held = any(run.record.held for entry, run in view.calibrated if entry.parameterisation == "matrix")
    return Table(
        "Inverse kinematic matrices M⁻¹",
        (Column("Entry", numeric=False), *map(Column, _element_names(view), _element_units(view))),
        tuple(rows),
        f"Columns of each row in the order of the {'wheels' if drive.direct else 'drive signals'}: "
        f"{', '.join(drive.names)}. "
        f"† on a bound of its box.{' ‡ held by the box, which has no width there.' if held else ''}",
    )


def _published_differences(view: views.DatasetView) -> list[Table]:
    """Eq. (11) of the paper with its methods here: the parametric matrix over the non-parametric one."""
    labels = {entry.parameterisation: entry.label for _, entry, _ in view.published_entries}
    if not {"geometry", "matrix"} <= labels.keys():
        return []
    return [_difference_table(view, labels["matrix"], labels["geometry"])]


def _difference_table(view: views.DatasetView, against: str | None, only: str | None = None) -> Table:
    """Differences from the design values or the entry called ``against``: of all entries, or of one ``only``."""
    matrices = {entry.label: run.matrix for entry, run in view.calibrated if run.matrix is not None}
    reference = view.design_matrix if against is None else matrices[against]
    project = _span_projector(view)
    rows = []
    for entry, run in view.calibrated:
        if run.matrix is None or entry.label == against or only not in (None, entry.label):
            continue
        matrix = run.matrix if project is None else reference + (run.matrix - reference) @ project
        share = relative_deviations(matrix, reference).ravel()  # D of Eq. (10), (11)
        moved = (matrix - reference).ravel()
        columns = zip(share, moved, _element_units(view), strict=True)
        cells = [_difference_cell(float(s), float(d), unit) for s, d, unit in columns]
        rows.append(Row.of(views.entry_cell(view, entry), *cells))
    name = "the design values" if against is None else against
    note = "Element by element, as a share of the value compared with; where that is 0, the change itself is given."
    note += " Eq. (10) and (11) of the paper." if view.of_the_paper else ""
    if project is not None:
        what = "wheel rates" if view.dataset.robot.drive.direct else "drive signals"
        note += f" Compared on the span of {what} that the data drive; across it the matrix is not determined."
    return Table(
        f"Differences from {name}" if only is None else f"{only} over {name}: Eq. (11) with the paper's methods here",
        (Column("Entry", numeric=False), *map(Column, _element_names(view))),
        tuple(rows),
        note,
    )


def _difference_cell(share: float, moved: float, unit: str) -> Cell:
    if math.isnan(share):
        return Cell("0" if abs(moved) < 1e-15 else significant(moved, 2, signed=True), unit)
    return Cell(f"{fixed(100 * share, 3, signed=True)} %")


def _span_projector(view: views.DatasetView) -> Array | None:
    robot, training = view.dataset.robot, view.dataset.split("train")
    if len(robot.drive.names) == len(robot.motions) or not training:
        return None
    driven = driven_span(training).driven
    projector: Array = driven.T @ driven
    return projector


def _element_names(view: views.DatasetView) -> list[str]:
    return [f"m{row}{column}" for row in (1, 2, 3) for column in range(1, len(view.dataset.robot.drive.names) + 1)]


def _element_units(view: views.DatasetView) -> list[str]:
    return ["rad/rad" if name.startswith("m3") else "m/rad" for name in _element_names(view)]


def _shown(value: float, unit: str) -> str:
    """A parameter's value with its unit; angles in degrees."""
    return f"{fixed(math.degrees(value), 3)}°" if unit == "rad" else f"{fixed(value, 5)} {unit}"


def _marks(record: RunRecord) -> dict[str, str]:
    return {**dict.fromkeys(views.on_bounds(record), "†"), **dict.fromkeys(record.held, "‡")}


def _parameter_cell(parameter: PhysicalParameter | None, mark: str) -> Cell:
    if parameter is None:
        return Cell(NOTHING)
    percent = parameter.deviation_percent
    deviation = "design is 0" if percent is None else f"{fixed(percent, 2, signed=True)} %"
    if parameter.unit == "rad":  # an angle's zero is a convention, so that no share of it means anything
        deviation = f"{fixed(math.degrees(parameter.deviation), 3, signed=True)}°"
    return Cell(_shown(parameter.value, parameter.unit) + (mark and f" {mark}"), deviation)


_FOLDED_ABOVE = 20  # runs: a longer table of runs is folded away (chosen)


def outcome_section(view: views.DatasetView) -> Section:
    """The section "Outcomes": tables of the entries, of the proven bounds if there are any, and of all runs."""
    proofs = (certificate_table(view.certificates),) if view.certificates else ()
    runs: Block = run_table(view)
    if len(view.runs) > _FOLDED_ABOVE:
        runs = Details(f"Every run ({len(view.runs)})", (runs,))
    about = "Every entry over its seeds, beside the best; what no optimiser can beat; every run."
    return Section("outcomes", "Outcomes", (entry_table(view), *proofs, runs), about=about, folded=True)


def entry_table(view: views.DatasetView) -> Table:
    """A table of the entries: costs over their seeds, and the difference from the best."""
    rows = []
    for entry in view.statistics:
        digits = decimals_for(entry.train_median, 5)
        rows.append(
            Row.of(
                views.entry_cell(view, entry),
                f"{entry.answers} of {entry.runs}",
                Cell(fixed(entry.train_median, digits), _spread(entry)),
                Cell(gap(entry.gap_median), proven(entry.proven_gap_median)),
                Cell(
                    count(entry.evaluations_median),
                    view.time_in_words(entry.seconds_median, entry.reference_evaluations_median),
                ),
                _difference(entry),
                _verdict(view, entry),
                role="best" if entry.is_best else "plain" if entry.answers else "failed",
            )
        )
    return Table(
        caption="Entries over their seeds",
        columns=(
            Column("Entry", numeric=False),
            Column("Answers of runs", priority=1),
            Column("Cost, training, median"),
            Column(gap_title(view), "relative", priority=2),
            Column("Evaluations and time, median", priority=3),
            Column(f"Difference from the best in {views.SPLIT_NAMES[view.scored]} cost"),
            Column("Verdict", numeric=False),
        ),
        rows=tuple(rows),
        note="Spread: interquartile range over seeds. Gap: training cost relative to that of closed_form in the same "
        f"box, minus one; {NOTHING} where it has no answer or leaves no error. Proven: what share of the "
        "cost any optimiser could still save in that box, at most. "
        f"Difference: paired by {view.units[view.scored].name}, with its 95 % interval, "
        f"{views.interval_basis(view, view.scored)}. Not told apart: that interval contains zero, "
        "or the difference is below a tenth of the standard error of the best entry's cost; undecided: there is no "
        "interval. Best: the lowest training cost of the entries that are not known to differ from the one of lowest "
        f"{views.SPLIT_NAMES[view.scored]} cost.{_held_in_words(view)}{_time_in_words(view)}",
    )


def gap_title(view: views.DatasetView) -> str:
    """Heading of gaps above closed_form, with how near the optimum that is, if this is proven for all boxes."""
    exact = [run.record for entry, run in view.calibrated if calibrators.entry(entry.calibrator).cls.exact]
    proofs = [record.proven_gap for record in exact if record.proven_gap is not None]
    if not proofs or len(proofs) < len(exact):
        return "Gap above closed_form, not proven optimal"
    return f"Gap above closed_form, proven within {percent(max(*proofs, 0.0), 2)} of the optimum"


def run_table(view: views.DatasetView, typical: bool = False) -> Table:
    """A table of every run, or of each entry's ``typical`` one, including those without an answer."""
    runs = view.typical_runs if typical else view.runs
    return Table(
        caption="The run of each entry with the median training cost" if typical else "Every run",
        columns=(
            Column("Entry", numeric=False),
            Column("Seed", priority=2),
            Column("Outcome", numeric=False),
            Column("Cost, training"),
            Column("Cost, held-out"),
            Column("Gap", priority=1),
            Column("Evaluations and time", priority=2),
            Column("On a bound", numeric=False, priority=3),
        ),
        rows=tuple(_run_row(view, run.record) for run in runs),
    )


def certificate_table(certificates: Sequence[BoxCertificate]) -> Table:
    """Lower bounds on the training cost, one for each box for which one is proven."""
    rows = [
        Row.of(
            certificate.box,
            significant(certificate.best_cost, 6),
            significant(certificate.lower_bound, 6),
            Cell(percent(certificate.gap, 2), "" if certificate.finished else "time or parts ran out"),
            Cell(count(certificate.parts), seconds(certificate.seconds)),
        )
        for certificate in certificates
    ]
    return Table(
        caption="What no optimiser can beat",
        columns=(
            Column("Box", numeric=False),
            Column("Lowest training cost found"),
            Column("No matrix of the box is below"),
            Column("Left to gain, at most"),
            Column("Parts of the box, time"),
        ),
        rows=tuple(rows),
        note="Proven by branch and bound on row 3 of the matrix, with rounding counted in: whichever search is used, "
        "and however long it runs, the training cost cannot fall below the bound while the matrix stays in the box.",
    )


def gap(value: float | None) -> str:
    """A relative gap; 0 where it is smaller than rounding."""
    if value is not None and abs(value) < 5e-13:
        return "0"
    return significant(value, 2)


def proven(value: float | None) -> str:
    """The share of the cost that could be saved at most, as a note; empty where no bound is proven."""
    return "" if value is None else f"proven: ≤ {percent(max(value, 0.0), 2)}"


def _spread(entry: EntryStatistics) -> str:
    if entry.train_spread is None or entry.answers < 2:
        return "one seed" if entry.answers == 1 else ""
    return f"spread {significant(entry.train_spread, 2)}"


def _difference(entry: EntryStatistics) -> Cell:
    if entry.difference is None or entry.is_best:
        return Cell(NOTHING)
    return Cell(*views.difference_in_words(entry.difference))


def _verdict(view: views.DatasetView, entry: EntryStatistics) -> Cell:
    if entry.typical is None:
        return Cell("no answer")
    if entry.is_best:
        return Cell("lowest training cost" if view.undecided else "best", views.rivals_in_words(view))
    if entry.practically_equal is None or entry.difference is None:
        return Cell("undecided", views.interval_basis(view, view.scored))
    if entry in view.not_told_apart:
        return Cell("not told apart")
    if entry.practically_equal:  # the design values, as the headline has them
        return Cell("worse", "by its share of the cost")
    if entry.difference.value > 0:
        return Cell("worse")
    return Cell("lower cost here", "higher training cost")


def _time_in_words(view: views.DatasetView) -> str:
    """A sentence on times that are no seconds; empty where they are."""
    if not view.config.timing:
        return " The runs were not timed."
    if view.times_compare:
        return ""
    return (
        " Time: wall time of a run divided by that of one evaluation of the start's cost beside it, since the machines "
        "differ."
    )


def _held_in_words(view: views.DatasetView) -> str:
    """A sentence on elements that a box holds, and on the entries concerned; empty where there are none."""
    held: dict[tuple[str, ...], list[str]] = {}
    for entry, run in view.calibrated:
        if run.record.held:
            held.setdefault(run.record.held, []).append(entry.label)
    parts = [f"{listing(list(names), 12)} ({listing(labels, 20)})" for names, labels in held.items()]
    return f" Held at the design value by a box without width there: {'; '.join(parts)}." if parts else ""


def _run_row(view: views.DatasetView, record: RunRecord) -> Row:
    answered = record.matrix is not None
    return Row.of(
        Cell(record.label, colour=view.styles[record.label].colour),
        str(record.seed),
        Cell(record.outcome.value, record.reason),
        fixed(record.train_cost, 6),
        fixed(record.validation_cost, 6),
        Cell(gap(record.gap), proven(record.proven_gap)),
        Cell(
            count(record.evaluations),
            view.time_in_words(
                record.seconds, record.seconds / record.reference_seconds if record.reference_seconds else None
            ),
        ),
        ", ".join(views.on_bounds(record)) if answered and views.on_bounds(record) else NOTHING,
        role="plain" if answered else "failed",
    )
