"""Results of SLAM on a terminal: reference poses, how certain they are, and their errors where the truth is known."""

from __future__ import annotations

import math

from rich.console import Console

from omnibench.cli.terminal.tables import print_table
from omnibench.report.recording.section import bias_table, error_table, summary_table
from omnibench.slam.slam_dataset import SlamAccuracy, SlamSummary
from omnibench.words import plural


def print_slam(console: Console, summary: SlamSummary) -> None:
    """Print how well scans matched, the poses' stated deviations, and their distance from recorded and true poses."""
    kind = "simulated data" if summary.simulated else "recorded data"
    matched = f"{summary.matched_mean:.1%} of the points matched (worst scan {summary.matched_min:.0%})"
    console.print(
        f"{summary.dataset}: {kind}; {plural(summary.runs, 'run')}, {plural(summary.scans, 'scan')}, {matched}",
        soft_wrap=True,
    )
    print_table(console, summary_table(summary))
    if summary.accuracy is not None:
        print_slam_accuracy(console, summary.accuracy)


def print_slam_accuracy(console: Console, accuracy: SlamAccuracy) -> None:
    """Print the errors of reference poses against the truth of a simulation."""
    print_table(console, error_table(accuracy))
    print_table(console, bias_table(accuracy))
    console.print(
        f"drift {1000 * accuracy.drift_position:.2g} mm and {math.degrees(accuracy.drift_heading):.2g} deg a metre",
        soft_wrap=True,
    )
