"""The table and the findings of ``omnibench inspect``."""

from __future__ import annotations

import math

from rich.console import Console
from rich.table import Table

from omnibench.fit.inspect import Inspection, ScansContent
from omnibench.fit.uncertainty.identifiability import ROWS, Identifiability
from omnibench.report.numbers import plural


def print_inspection(console: Console, found: Inspection) -> None:
    """A data set in a table and its findings in words."""
    kind = "simulated data" if found.simulated else "recorded data"
    described = f"; {found.description}" if found.description else ""
    console.print(f"{found.dataset}: {kind}{described}", soft_wrap=True)
    for label, text in (("source", found.source), ("licence", found.licence)):
        if text:
            console.print(f"{label}: {text}", soft_wrap=True)
    shortest, longest = (1000 * period for period in found.sample_period_range_s)
    console.print(
        f"robot {found.robot}, wheels {', '.join(found.wheels)}; {plural(found.wheel_samples, 'wheel sample')} every "
        f"{1000 * found.sample_period_s:g} ms ({shortest:.3g} to {longest:.3g} ms), "
        f"{plural(found.reference_poses, 'reference pose')} every {1000 * found.pose_period_s:.3g} ms",
        soft_wrap=True,
    )
    if found.scans is not None:
        _print_scans(console, found.scans)
    table = Table()
    for heading in ("split", "runs", "commands", "repetitions", "sessions", "duration", "distance", "turned"):
        table.add_column(heading, justify="left" if heading == "split" else "right")
    for name, split in found.splits.items():
        repetitions = f"{split.repetitions_min}"
        if split.repetitions_max != split.repetitions_min:
            repetitions += f" to {split.repetitions_max}"
        table.add_row(
            name,
            str(split.trajectories),
            str(split.commands),
            repetitions,
            str(split.sessions),
            f"{split.duration_s:.0f} s",
            f"{split.distance_m:.1f} m",
            f"{math.degrees(split.turned_rad):.0f} deg",
        )
    console.print(table)
    shares = ", ".join(f"{share:.2g}" for share in found.driven_shares)
    console.print(f"directions of wheel rates driven: {found.driven_directions} of {len(found.wheels)} ({shares})")
    _print_identifiability(console, found.identifiability)
    for finding in found.findings:
        console.print(f"- {finding}", soft_wrap=True)


def _print_scans(console: Console, scans: ScansContent) -> None:
    every = "" if scans.scan_period_s is None else f" every {1000 * scans.scan_period_s:.3g} ms"
    console.print(
        f"{plural(scans.scans, 'scan')}{every} in {plural(scans.trajectories, 'run')}; "
        f"{plural(scans.rays, 'ray')} over {math.degrees(scans.field_of_view_rad):.0f} deg up to "
        f"{scans.range_max_m:g} m, of which {scans.seen_share:.0%} measured something",
        soft_wrap=True,
    )


def _print_identifiability(console: Console, told: Identifiability) -> None:
    table = Table(title="what a calibration can tell, +- % of the row's largest element", title_justify="left")
    for heading in ("wheel rates along", "which is", "driven", *(f"row {row}" for row in ROWS)):
        table.add_column(heading, justify="left" if heading in ("wheel rates along", "which is") else "right")
    for each in told.directions:
        deviations = ["open"] * len(ROWS)
        if each.state == "driven" and each.deviations is not None:
            deviations = [f"{100 * value:.2g} %" for value in each.deviations]
        table.add_row(each.direction, each.motion or "slip of the wheels", f"{100 * each.share:.3g} %", *deviations)
    console.print(table)
    console.print(f"noise: {told.noise_source}", soft_wrap=True)
