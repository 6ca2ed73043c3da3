"""The section on matrices: elements, their differences by Eq. (10)-(11), physical parameters."""

from __future__ import annotations

import json
import math

from omnibench.compare.report.view import DatasetView
from omnibench.compare.report.wording import entry_cell, on_bounds
from omnibench.compare.result import RunRecord
from omnibench.fit.geometry import FittedParameter
from omnibench.fit.span import driven_span
from omnibench.report.blocks import Block, Cell, Code, Column, Paragraph, Row, Section, Table
from omnibench.report.numbers import NOTHING, fixed, significant
from omnibench.robot.kinematics import Array, relative_deviations


def matrix_section(view: DatasetView) -> Section:
    """Matrices, their differences from the design values and from the reference entry, parameters, all digits."""
    about = "All elements, their differences from the design values, and the wheels that they stand for."
    return Section("matrices", "Matrices", _blocks(view), about=about, folded=True)


def _blocks(view: DatasetView) -> tuple[Block, ...]:
    if not view.calibrated:
        return (Paragraph("No run gave a matrix.", "note"),)
    blocks: list[Block] = [_element_table(view), _difference_table(view, None)]
    if view.reference_entry is not None and len(view.calibrated) > 1:
        blocks.append(_difference_table(view, view.reference_entry[0].label))
    blocks += _published_differences(view)
    parameters = parameter_table(view)
    if parameters is not None:
        blocks.append(parameters)
    blocks.append(
        Code(matrices_as_text(view), "Matrices with all digits (YAML): rows x and y in m/rad, heading in rad/rad")
    )
    return tuple(blocks)


def matrices_as_text(view: DatasetView) -> str:
    """Every matrix as YAML, with so many digits that reading it gives exactly the same numbers."""
    named = [("theoretical", view.design_matrix)]
    named += [(entry.label, run.matrix) for entry, run in view.calibrated if run.matrix is not None]
    parts = []
    for label, matrix in named:
        rows = ",\n  ".join(f"[{', '.join(repr(float(value)) for value in row)}]" for row in matrix)
        parts.append(f"{json.dumps(label)}: [\n  {rows}]")
    return "\n".join(parts)


def parameter_table(view: DatasetView) -> Table | None:
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


def _element_table(view: DatasetView) -> Table:
    rows = [Row.of(entry_cell(view, None), *(fixed(float(v), 6) for v in view.design_matrix.ravel()))]
    for entry, run in view.calibrated:
        if run.matrix is None:
            continue
        marks = _marks(run.record) if entry.parameterisation == "matrix" else {}
        cells = [
            fixed(float(value), 6) + marks.get(name, "")
            for name, value in zip(_element_names(view), run.matrix.ravel(), strict=True)
        ]
        rows.append(Row.of(entry_cell(view, entry), *cells, role="best" if entry.is_best else "plain"))
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


def _published_differences(view: DatasetView) -> list[Table]:
    """Eq. (11) of the paper with its methods here: the parametric matrix over the non-parametric one."""
    labels = {entry.parameterisation: entry.label for _, entry, _ in view.published_entries}
    if not {"geometry", "matrix"} <= labels.keys():
        return []
    return [_difference_table(view, labels["matrix"], labels["geometry"])]


def _difference_table(view: DatasetView, against: str | None, only: str | None = None) -> Table:
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
        rows.append(Row.of(entry_cell(view, entry), *cells))
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


def _span_projector(view: DatasetView) -> Array | None:
    robot, training = view.dataset.robot, view.dataset.split("train")
    if len(robot.drive.names) == len(robot.motions) or not training:
        return None
    driven = driven_span(training).driven
    projector: Array = driven.T @ driven
    return projector


def _element_names(view: DatasetView) -> list[str]:
    return [f"m{row}{column}" for row in (1, 2, 3) for column in range(1, len(view.dataset.robot.drive.names) + 1)]


def _element_units(view: DatasetView) -> list[str]:
    return ["rad/rad" if name.startswith("m3") else "m/rad" for name in _element_names(view)]


def _shown(value: float, unit: str) -> str:
    """A parameter's value with its unit; angles in degrees."""
    return f"{fixed(math.degrees(value), 3)}°" if unit == "rad" else f"{fixed(value, 5)} {unit}"


def _marks(record: RunRecord) -> dict[str, str]:
    return {**dict.fromkeys(on_bounds(record), "†"), **dict.fromkeys(record.held, "‡")}


def _parameter_cell(parameter: FittedParameter | None, mark: str) -> Cell:
    if parameter is None:
        return Cell(NOTHING)
    percent = parameter.deviation_percent
    deviation = "design is 0" if percent is None else f"{fixed(percent, 2, signed=True)} %"
    if parameter.unit == "rad":  # an angle's zero is a convention, so that no share of it means anything
        deviation = f"{fixed(math.degrees(parameter.deviation), 3, signed=True)}°"
    return Cell(_shown(parameter.value, parameter.unit) + (mark and f" {mark}"), deviation)
