"""Tables of an inspection, for the terminal and its report: content, motions that determine the matrix, parameters."""

from __future__ import annotations

import math

from omnibench.fit.identifiability import ROWS, UNTOLD
from omnibench.fit.inspect import Inspection
from omnibench.report.blocks import Column, Row, Table
from omnibench.report.numbers import NOTHING, fixed, significant, with_unit


def driven_by(inspection: Inspection) -> str:
    """What the columns of the matrix are: wheel rates, or drive signals."""
    return "wheel rates" if len(inspection.driven_shares) == len(inspection.wheels) else "drive signals"


def split_table(inspection: Inspection) -> Table:
    """The content of each split: runs, commands, repetitions, sessions, time, distance, turns."""
    rows = []
    for name, split in inspection.splits.items():
        repetitions = f"{split.repetitions_min}"
        if split.repetitions_max != split.repetitions_min:
            repetitions += f" to {split.repetitions_max}"
        counts = (str(split.trajectories), str(split.commands), repetitions, str(split.sessions))
        amounts = (f"{split.duration_s:.0f}", f"{split.distance_m:.1f}", f"{math.degrees(split.turned_rad):.0f}")
        rows.append(Row.of(name, *counts, *amounts))
    columns = (
        Column("split", numeric=False),
        Column("runs"),
        Column("commands"),
        Column("repetitions", priority=1),
        Column("sessions"),
        *(Column(*quantity) for quantity in (("duration", "s"), ("distance", "m"), ("turned", "°"))),
    )
    return Table("", columns, tuple(rows))


def identifiability_table(inspection: Inspection) -> Table:
    """The precision of a calibration along each direction of wheel rates."""
    what, identifiability = driven_by(inspection), inspection.identifiability
    rows = []
    for direction in identifiability.directions:
        deviations = ["open"] * len(ROWS)
        if direction.state == "driven" and direction.deviations is not None:
            deviations = ["open" if value > UNTOLD else f"{100 * value:.2g} %" for value in direction.deviations]
        motion = direction.motion or "slip of the wheels"
        rows.append(Row.of(direction.direction, motion, f"{100 * direction.share:.3g} %", *deviations))
    columns = (
        Column(f"{what} along", numeric=False),
        Column("motion", numeric=False),
        Column("driven"),
        *(Column(f"row {row}") for row in ROWS),
    )
    caption = "Precision of a calibration from these data, ± % of the row's largest element"
    return Table(caption, columns, tuple(rows))


def parameter_table(inspection: Inspection) -> Table:
    """How precisely the runs tell each physical parameter."""
    rows = []
    for parameter in inspection.identifiability.parameters:
        factor, unit, digits = (math.degrees(1.0), "°", 2) if parameter.unit == "rad" else (1e3, "mm", 1)
        kind, _, wheel = parameter.name.partition("_")
        known = (
            NOTHING
            if parameter.deviation is None
            else f"± {with_unit(significant(factor * parameter.deviation, 2), unit)}"
        )
        design = with_unit(fixed(factor * parameter.design, digits), unit)
        known_now = "determined" if parameter.told else "not determined"
        rows.append(Row.of(f"{kind} of {wheel}" if wheel else kind, design, known, known_now))
    columns = (
        Column("Parameter", numeric=False),
        Column("Design"),
        Column("Could be known to"),
        Column("By these runs", numeric=False),
    )
    note = "One standard deviation of the best that any calibration from these runs could do (the Cramér-Rao bound)."
    return Table("Wheels, as these runs determine them", columns, tuple(rows), note)
