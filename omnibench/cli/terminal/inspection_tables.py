"""The table and the findings of ``omnibench inspect``."""

from __future__ import annotations

import math

from rich.console import Console
from rich.table import Table

from omnibench.fit.inspect import Inspection, ScansContent
from omnibench.fit.uncertainty.identifiability import ROWS, Identifiability
from omnibench.words import plural


def print_inspection(console: Console, inspection: Inspection) -> None:
    """Print what a data set holds, what can be identified from it, and the findings."""
    kind = "simulated data" if inspection.simulated else "recorded data"
    described = f"; {inspection.description}" if inspection.description else ""
    console.print(f"{inspection.dataset}: {kind}{described}", soft_wrap=True)
    for label, text in (("source", inspection.source), ("licence", inspection.licence)):
        if text:
            console.print(f"{label}: {text}", soft_wrap=True)
    shortest, longest = (1000 * period for period in inspection.sample_period_range_s)
    console.print(
        f"robot {inspection.robot}, wheels {', '.join(inspection.wheels)}; "
        f"{plural(inspection.wheel_samples, 'wheel sample')} every {1000 * inspection.sample_period_s:g} ms "
        f"({shortest:.3g} to {longest:.3g} ms), {plural(inspection.reference_poses, 'reference pose')} "
        f"every {1000 * inspection.pose_period_s:.3g} ms",
        soft_wrap=True,
    )
    if inspection.scans is not None:
        _print_scans(console, inspection.scans)
    table = Table()
    for heading in ("split", "runs", "commands", "repetitions", "sessions", "duration", "distance", "turned"):
        table.add_column(heading, justify="left" if heading == "split" else "right")
    for name, split in inspection.splits.items():
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
    shares = ", ".join(f"{share:.2g}" for share in inspection.driven_shares)
    console.print(
        f"directions of wheel rates driven: {inspection.driven_directions} of {len(inspection.wheels)} ({shares})"
    )
    _print_identifiability(console, inspection.identifiability)
    for finding in inspection.findings:
        console.print(f"- {finding}", soft_wrap=True)


def _print_scans(console: Console, scans: ScansContent) -> None:
    every = "" if scans.scan_period_s is None else f" every {1000 * scans.scan_period_s:.3g} ms"
    console.print(
        f"{plural(scans.scans, 'scan')}{every} in {plural(scans.trajectories, 'run')}; "
        f"{plural(scans.rays, 'ray')} over {math.degrees(scans.field_of_view_rad):.0f} deg up to "
        f"{scans.range_max_m:g} m, of which {scans.seen_share:.0%} measured something",
        soft_wrap=True,
    )


def _print_identifiability(console: Console, identifiability: Identifiability) -> None:
    table = Table(
        title="precision of a calibration from these data, +- % of the row's largest element", title_justify="left"
    )
    for heading in ("wheel rates along", "motion", "driven", *(f"row {row}" for row in ROWS)):
        table.add_column(heading, justify="left" if heading in ("wheel rates along", "motion") else "right")
    for direction in identifiability.directions:
        deviations = ["open"] * len(ROWS)
        if direction.state == "driven" and direction.deviations is not None:
            deviations = [f"{100 * value:.2g} %" for value in direction.deviations]
        table.add_row(
            direction.direction, direction.motion or "slip of the wheels", f"{100 * direction.share:.3g} %", *deviations
        )
    console.print(table)
    console.print(f"noise: {identifiability.noise_source}", soft_wrap=True)
