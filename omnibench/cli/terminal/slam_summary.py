"""Results of SLAM on a terminal: reference poses, how certain they are, and their errors where the truth is known."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from omnibench.slam.accuracy import SlamAccuracy
from omnibench.slam.summary import SlamSummary
from omnibench.words import plural


def print_slam(console: Console, summary: SlamSummary) -> None:
    """Print how well scans matched, the poses' stated deviations, and their distance from recorded and true poses."""
    kind = "simulated data" if summary.simulated else "recorded data"
    matched = f"{summary.matched_mean:.1%} of the points matched (worst scan {summary.matched_min:.0%})"
    console.print(
        f"{summary.dataset}: {kind}; {plural(summary.runs, 'run')}, {plural(summary.scans, 'scan')}, {matched}",
        soft_wrap=True,
    )
    table = _table("reference poses from the scans")
    deviations = (
        (summary.position_deviation_mean_m, None, summary.position_deviation_max_m),
        (summary.heading_deviation_mean_rad, None, summary.heading_deviation_max_rad),
    )
    table.add_row("deviation stated at the end of a run", *_cells(*deviations))
    if summary.recorded is not None:
        recorded = summary.recorded
        distances = (
            (recorded.position_mean_m, recorded.position_p95_m, None),
            (recorded.heading_mean_rad, recorded.heading_p95_rad, None),
        )
        table.add_row(f"from the recorded reference ({plural(recorded.poses, 'pose')})", *_cells(*distances))
    console.print(table)
    if summary.accuracy is not None:
        print_slam_accuracy(console, summary.accuracy)


def print_slam_accuracy(console: Console, accuracy: SlamAccuracy) -> None:
    """Print the errors of reference poses against the truth of a simulation."""
    table = _table("errors of the reference poses against the simulated truth")
    table.add_column("NEES\n(ideal 3)", justify="right")
    for what, errors in (("at the end of a run", accuracy.final), ("at every scan", accuracy.every)):
        positions = (errors.position_mean_m, errors.position_p95_m, errors.position_max_m)
        headings = (errors.heading_mean_rad, errors.heading_p95_rad, errors.heading_max_rad)
        nees = "" if errors.nees_mean is None else f"{errors.nees_mean:.1f}"
        table.add_row(f"{what} ({plural(errors.poses, 'pose')})", *_cells(positions, headings), nees)
    console.print(table)
    bias = accuracy.final
    console.print(
        f"bias at the end, along the robot's axes: {1000 * bias.bias_forward_m:+.2f} mm forward, "
        f"{1000 * bias.bias_left_m:+.2f} mm left, {math.degrees(bias.bias_heading_rad):+.3f} deg; drift "
        f"{1000 * accuracy.drift_position:.2g} mm and {math.degrees(accuracy.drift_heading):.2g} deg a metre, over "
        f"{accuracy.distance_m:.0f} m in {plural(accuracy.runs, 'run')}",
        soft_wrap=True,
    )


def _table(title: str) -> Table:
    """A table without rows for positions (mm) and headings (deg): mean, 95th percentile and maximum."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    table.add_column("")
    for unit in ("mm", "deg"):
        for figure in ("mean", "95 %", "max"):
            table.add_column(f"{figure}\n{unit}", justify="right")
    return table


def _cells(metres: Sequence[float | None], radians: Sequence[float | None]) -> list[str]:
    millimetres = ["" if value is None else f"{1000 * value:.2f}" for value in metres]
    return millimetres + ["" if value is None else f"{math.degrees(value):.3f}" for value in radians]
