"""Tables of reference poses by SLAM: stated deviations, and errors against the truth with drift, bias and NEES."""

from __future__ import annotations

import math
from collections.abc import Sequence

from omnibench.report.blocks import Cell, Column, Fact, Row, Table
from omnibench.report.numbers import NOTHING, significant
from omnibench.slam.slam_request import ErrorSummary, SlamAccuracy, SlamSummary
from omnibench.words import plural


def errors_in_words(accuracy: SlamAccuracy) -> str:
    """The mean errors of the last poses, such as ``1.2 mm and 0.05°``."""
    final = accuracy.final
    return f"{_mm(final.position_mean_m)} mm and {_degrees(final.heading_mean_rad)}°"


def accuracy_tiles(accuracy: SlamAccuracy) -> tuple[Fact, ...]:
    """The errors of reference poses against the truth as a few figures."""
    final = accuracy.final
    position, heading = _mm(final.position_mean_m), _degrees(final.heading_mean_rad)
    drift, turn = _mm(accuracy.drift_position), _degrees(accuracy.drift_heading)
    return (
        Fact("Final position error, mean", f"{position} mm", f"95 % below {_mm(final.position_p95_m)} mm"),
        Fact("Final heading error, mean", f"{heading}°", f"95 % below {_degrees(final.heading_p95_rad)}°"),
        Fact("Drift", f"{drift} mm per metre", f"heading {turn}° per metre"),
        Fact("NEES, mean of all poses", _nees(accuracy.every), "3 where covariances are right"),
    )


def error_table(accuracy: SlamAccuracy) -> Table:
    """The errors of the last pose of each run, and of all poses."""
    rows = []
    for name, summary in _summaries(accuracy):
        positions = (summary.position_mean_m, summary.position_p95_m, summary.position_max_m)
        headings = (summary.heading_mean_rad, summary.heading_p95_rad, summary.heading_max_rad)
        rows.append(Row.of(Cell(name, plural(summary.poses, "pose")), *_figures(positions, headings), _nees(summary)))
    return Table(
        caption="Errors of the reference poses against the truth",
        columns=(*_FIGURES, Column("NEES, mean")),
        rows=tuple(rows),
        note=f"{plural(accuracy.runs, 'run')}, {significant(accuracy.distance_m, 4)} m in all. Drift: the "
        "growth k of the error over the distance s, from error² = noise² + (k s)²; 0 where it does not grow.",
    )


def bias_table(accuracy: SlamAccuracy) -> Table:
    """The mean errors along the robot's axes."""
    rows = []
    for name, summary in _summaries(accuracy):
        lengths = (_mm(v, signed=True) for v in (summary.bias_forward_m, summary.bias_left_m))
        rows.append(Row.of(name, *lengths, _degrees(summary.bias_heading_rad, signed=True)))
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


def summary_table(summary: SlamSummary) -> Table:
    """The deviations that SLAM states, and the distances from the reference poses that were recorded."""
    deviations = _figures(
        (summary.position_deviation_mean_m, None, summary.position_deviation_max_m),
        (summary.heading_deviation_mean_rad, None, summary.heading_deviation_max_rad),
    )
    rows = [Row.of("deviation stated at the end of a run", *deviations)]
    if summary.recorded is not None:
        recorded = summary.recorded
        name = Cell("distance from the recorded reference", plural(recorded.poses, "pose"))
        distances = _figures(
            (recorded.position_mean_m, recorded.position_p95_m, None),
            (recorded.heading_mean_rad, recorded.heading_p95_rad, None),
        )
        rows.append(Row.of(name, *distances))
    return Table("Reference poses from the scans", _FIGURES, tuple(rows))


_FIGURES = (
    Column("Poses", numeric=False),
    *(Column(f"position, {which}", "mm") for which in ("mean", "95 %", "worst")),
    *(Column(f"heading, {which}", "°") for which in ("mean", "95 %", "worst")),
)


def _figures(metres: Sequence[float | None], radians: Sequence[float | None]) -> list[str]:
    """Mean, 95th percentile and maximum of positions in mm, then of headings in degrees."""
    lengths = [NOTHING if value is None else _mm(value) for value in metres]
    return lengths + [NOTHING if value is None else _degrees(value) for value in radians]


def _summaries(accuracy: SlamAccuracy) -> tuple[tuple[str, ErrorSummary], ...]:
    return (("last of each run", accuracy.final), ("all after the first", accuracy.every))


def _mm(metres: float, signed: bool = False) -> str:
    return significant(1e3 * metres, 2, signed)


def _degrees(angle: float, signed: bool = False) -> str:
    return significant(math.degrees(angle), 2, signed)


def _nees(summary: ErrorSummary) -> str:
    return NOTHING if summary.nees_mean is None else significant(summary.nees_mean, 3)
