"""The table and the findings of ``omnibench inspect``."""

from __future__ import annotations

import math

from rich.console import Console

from omnibench.cli.terminal.tables import print_table
from omnibench.fit.inspect import Inspection
from omnibench.report.recording.inspection_report import driven_by, identifiability_table, split_table
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
        f"({shortest:.3g} to {longest:.3g} ms), {_references(inspection)}",
        soft_wrap=True,
    )
    if (scans := inspection.scans) is not None:
        every = "" if scans.scan_period_s is None else f" every {1000 * scans.scan_period_s:.3g} ms"
        console.print(
            f"{plural(scans.scans, 'scan')}{every} in {plural(scans.trajectories, 'run')}; "
            f"{plural(scans.rays, 'ray')} over {math.degrees(scans.field_of_view_rad):.0f} deg up to "
            f"{scans.range_max_m:g} m, of which {scans.seen_share:.0%} measured something",
            soft_wrap=True,
        )
    print_table(console, split_table(inspection))
    shares = ", ".join(f"{share:.2g}" for share in inspection.driven_shares)
    what = driven_by(inspection)
    console.print(
        f"directions of {what} driven: {inspection.driven_directions} of {len(inspection.driven_shares)} ({shares})"
    )
    print_table(console, identifiability_table(inspection))
    console.print(f"noise: {inspection.identifiability.noise_source}", soft_wrap=True)
    for finding in inspection.findings:
        console.print(f"- {finding}", soft_wrap=True)


def _references(inspection: Inspection) -> str:
    """What is known of the runs' motion: ``60 reference poses every 250 ms``, ``12 references of distance``."""
    words = [f"{plural(count, 'reference')} of {kind}" for kind, count in inspection.references.items()]
    if inspection.pose_period_s is not None:
        every = f"every {1000 * inspection.pose_period_s:.3g} ms"
        words = [f"{plural(inspection.reference_poses, 'reference pose')} {every}", *words]
    return ", ".join(words)
