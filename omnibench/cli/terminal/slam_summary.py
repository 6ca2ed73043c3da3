"""What SLAM came to, on a terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from omnibench.report.numbers import plural
from omnibench.slam.accuracy import SlamAccuracy
from omnibench.slam.summary import SlamSummary


def print_slam(console: Console, found: SlamSummary) -> None:
    """The runs, what SLAM states of its poses, how far they are from those before and, if it is known, the truth."""
    kind = "simulated data" if found.simulated else "recorded data"
    matched = f"{found.matched_mean:.1%} of the points matched (worst scan {found.matched_min:.0%})"
    console.print(
        f"{found.dataset}: {kind}; {plural(found.runs, 'run')}, {plural(found.scans, 'scan')}, {matched}",
        soft_wrap=True,
    )
    table = _table("reference poses from the scans")
    deviations = (
        (found.position_deviation_mean_m, None, found.position_deviation_max_m),
        (found.heading_deviation_mean_rad, None, found.heading_deviation_max_rad),
    )
    table.add_row("deviation stated at the end of a run", *_cells(*deviations))
    if found.recorded is not None:
        apart = found.recorded
        distances = (
            (apart.position_mean_m, apart.position_p95_m, None),
            (apart.heading_mean_rad, apart.heading_p95_rad, None),
        )
        table.add_row(f"from the recorded reference ({plural(apart.poses, 'pose')})", *_cells(*distances))
    console.print(table)
    if found.accuracy is not None:
        print_slam_accuracy(console, found.accuracy)


def print_slam_accuracy(console: Console, found: SlamAccuracy) -> None:
    """Errors against the truth of a simulation."""
    table = _table("errors of the reference poses against the simulated truth")
    table.add_column("NEES\n(ideal 3)", justify="right")
    for what, errors in (("at the end of a run", found.final), ("at every scan", found.every)):
        positions = (errors.position_mean_m, errors.position_p95_m, errors.position_max_m)
        headings = (errors.heading_mean_rad, errors.heading_p95_rad, errors.heading_max_rad)
        nees = "" if errors.nees_mean is None else f"{errors.nees_mean:.1f}"
        table.add_row(f"{what} ({plural(errors.poses, 'pose')})", *_cells(positions, headings), nees)
    console.print(table)
    bias = found.final
    console.print(
        f"bias at the end, along the robot's axes: {1000 * bias.bias_forward_m:+.2f} mm forward, "
        f"{1000 * bias.bias_left_m:+.2f} mm left, {math.degrees(bias.bias_heading_rad):+.3f} deg; drift "
        f"{1000 * found.drift_position:.2g} mm and {math.degrees(found.drift_heading):.2g} deg a metre, over "
        f"{found.distance_m:.0f} m in {plural(found.runs, 'run')}",
        soft_wrap=True,
    )


def _table(title: str) -> Table:
    """Positions in mm and headings in deg: their mean, 95th percentile and largest."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    table.add_column("")
    for unit in ("mm", "deg"):
        for figure in ("mean", "95 %", "max"):
            table.add_column(f"{figure}\n{unit}", justify="right")
    return table


def _cells(metres: Sequence[float | None], radians: Sequence[float | None]) -> list[str]:
    millimetres = ["" if value is None else f"{1000 * value:.2f}" for value in metres]
    return millimetres + ["" if value is None else f"{math.degrees(value):.3f}" for value in radians]
