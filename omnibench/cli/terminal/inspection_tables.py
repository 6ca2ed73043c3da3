"""The table and the findings of ``omnibench inspect``."""

from __future__ import annotations

import math

from rich.console import Console

from omnibench.cli.terminal.tables import print_table
from omnibench.fit.inspect import Inspection, ScansContent
from omnibench.fit.uncertainty.identifiability import ROWS, Identifiability
from omnibench.report.blocks import Column, Row, Table
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
    print_table(console, _split_table(inspection))
    shares = ", ".join(f"{share:.2g}" for share in inspection.driven_shares)
    what = "wheel rates" if len(inspection.driven_shares) == len(inspection.wheels) else "drive signals"
    console.print(
        f"directions of {what} driven: {inspection.driven_directions} of {len(inspection.driven_shares)} ({shares})"
    )
    print_table(console, _identifiability_table(inspection.identifiability, what))
    console.print(f"noise: {inspection.identifiability.noise_source}", soft_wrap=True)
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


def _split_table(inspection: Inspection) -> Table:
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
        *(Column(*quantity) for quantity in (("duration", "s"), ("distance", "m"), ("turned", "deg"))),
    )
    return Table("", columns, tuple(rows))


def _identifiability_table(identifiability: Identifiability, what: str) -> Table:
    rows = []
    for direction in identifiability.directions:
        deviations = ["open"] * len(ROWS)
        if direction.state == "driven" and direction.deviations is not None:
            deviations = [f"{100 * value:.2g} %" for value in direction.deviations]
        motion = direction.motion or "slip of the wheels"
        rows.append(Row.of(direction.direction, motion, f"{100 * direction.share:.3g} %", *deviations))
    columns = (
        Column(f"{what} along", numeric=False),
        Column("motion", numeric=False),
        Column("driven"),
        *(Column(f"row {row}") for row in ROWS),
    )
    caption = "precision of a calibration from these data, +- % of the row's largest element"
    return Table(caption, columns, tuple(rows))
