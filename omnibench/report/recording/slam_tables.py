"""Tables of the errors of reference poses against the truth: final and overall errors, drift, bias, NEES."""

from __future__ import annotations

import math

from omnibench.report.blocks import Block, Cell, Column, Fact, Facts, Row, Table
from omnibench.report.numbers import NOTHING, significant
from omnibench.slam.accuracy import ErrorSummary, SlamAccuracy
from omnibench.words import plural


def accuracy_blocks(accuracy: SlamAccuracy) -> tuple[Block, ...]:
    """The errors of reference poses against the truth, as tiles and as tables."""
    return (_tiles(accuracy), _errors(accuracy), _biases(accuracy))


def _tiles(accuracy: SlamAccuracy) -> Facts:
    final = accuracy.final
    position, heading = _mm(final.position_mean_m), _degrees(final.heading_mean_rad)
    drift, turn = _mm(accuracy.drift_position), _degrees(accuracy.drift_heading)
    return Facts(
        (
            Fact("Final position error, mean", f"{position} mm", f"95 % below {_mm(final.position_p95_m)} mm"),
            Fact("Final heading error, mean", f"{heading}°", f"95 % below {_degrees(final.heading_p95_rad)}°"),
            Fact("Drift", f"{drift} mm per metre", f"heading {turn}° per metre"),
            Fact("NEES, mean of all poses", _nees(accuracy.every), "3 where covariances are right"),
        ),
        "tiles",
    )


def _errors(accuracy: SlamAccuracy) -> Table:
    rows = []
    for name, summary in _summaries(accuracy):
        values = [
            *(_mm(v) for v in (summary.position_mean_m, summary.position_p95_m, summary.position_max_m)),
            *(_degrees(v) for v in (summary.heading_mean_rad, summary.heading_p95_rad, summary.heading_max_rad)),
            _nees(summary),
        ]
        rows.append(Row((Cell(name, f"{plural(summary.poses, 'pose')}"), *(Cell(value) for value in values))))
    return Table(
        caption="Errors of the reference poses against the truth",
        columns=(
            Column("Poses", numeric=False),
            *(Column(f"position, {which}", "mm") for which in ("mean", "95 %", "worst")),
            *(Column(f"heading, {which}", "°") for which in ("mean", "95 %", "worst")),
            Column("NEES, mean"),
        ),
        rows=tuple(rows),
        note=f"{plural(accuracy.runs, 'run')}, {significant(accuracy.distance_m, 4)} m in all. Drift: the "
        "growth k of the error over the distance s, from error² = noise² + (k s)²; 0 where it does not grow.",
    )


def _biases(accuracy: SlamAccuracy) -> Table:
    rows = []
    for name, summary in _summaries(accuracy):
        lengths = (_mm(v, signed=True) for v in (summary.bias_forward_m, summary.bias_left_m))
        cells = (Cell(name), *map(Cell, lengths), Cell(_degrees(summary.bias_heading_rad, signed=True)))
        rows.append(Row(cells))
    return Table(
        caption="Mean error along the robot's axes",
        columns=(
            Column("Poses", numeric=False),
            Column("forward", "mm"),
            Column("to the left", "mm"),
            Column("heading", "°"),
        ),
        rows=tuple(rows),
        note="The signed mean of the errors: 0 for a reference without bias.",
    )


def _summaries(accuracy: SlamAccuracy) -> tuple[tuple[str, ErrorSummary], ...]:
    return (("last of each run", accuracy.final), ("all after the first", accuracy.every))


def _mm(metres: float, signed: bool = False) -> str:
    return significant(1e3 * metres, 2, signed)


def _degrees(angle: float, signed: bool = False) -> str:
    return significant(math.degrees(angle), 2, signed)


def _nees(summary: ErrorSummary) -> str:
    return NOTHING if summary.nees_mean is None else significant(summary.nees_mean, 3)
