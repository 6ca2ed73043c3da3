"""Terminal output of ``check``, ``inspect``, ``design`` and ``slam``, and the last sentence of ``import``."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

from omnibench.cli.terminal.console import print_ending
from omnibench.cli.terminal.tables import print_table
from omnibench.words import kind_of_data, plural

if TYPE_CHECKING:
    from omnibench.check.check import CheckReport
    from omnibench.design.design import Design
    from omnibench.fit.inspect import Inspection
    from omnibench.slam.slam_dataset import SlamAccuracy, SlamSummary

_COLOURS = {
    "ready": "bold green", "fix": "bold red", "record more": "bold yellow",
    "error": "red", "warning": "yellow", "note": "cyan",
}  # fmt: skip
_NEEDED = {True: "a calibration is needed: ", False: "a calibration is hardly needed: ", None: ""}


def print_check(console: Console, checked: CheckReport, next_step: str) -> None:
    """Print the report; what can be typed is not wrapped, so that it can be copied.

    next_step: the command line for a recording that is ready.
    """

    def coloured(word: str, text: str) -> None:
        console.print(Text.assemble((word, _COLOURS[word.lower()]), f": {text}"), soft_wrap=True)

    coloured(checked.verdict.upper(), f"{checked.sentence}.")
    for finding in checked.findings:
        console.print()
        coloured(finding.severity, f"{finding.what} [{finding.where}]")
        if finding.changes and finding.fix:
            console.out(f"  --set {finding.fix}", highlight=False)
        elif finding.fix:
            console.print(f"  {finding.fix}", soft_wrap=True)
    if checked.gain:
        console.print()
        console.print(f"{_NEEDED[checked.needed]}{checked.gain}", soft_wrap=True)
    console.print()
    typed = shlex.split(checked.command or next_step)
    if checked.verdict == "ready":
        then = "mend what it warns of" if checked.command else f"{typed[1]} it"
        print_ending("nothing stands in the way", then, *typed)
    elif checked.command:
        print_ending("what can be mended is mended by one import", "type", *typed)
    elif checked.verdict == "record more":
        print_ending("nothing of this can be typed", "record what is missing, and check again")
    else:
        print_ending("no option mends this", "correct what is named above, and check again")


def print_import_ending(holds: str, folder: Path, report: CheckReport | None) -> None:
    """Print the last sentence of ``import``. report: of the check, if there was one."""
    if report is None:
        print_ending(holds, "see what they tell", "omnibench", "inspect", folder)
    elif report.command:
        then = "mend what it warns of" if report.verdict == "ready" else "mend it"
        print_ending(holds, then, *shlex.split(report.command))
    elif report.verdict == "ready":
        print_ending(holds, "calibrate it", "omnibench", "calibrate", folder, "-o", "calibration.yaml")
    else:
        print_ending(holds, "see what is missing", "omnibench", "check", folder)


def print_inspection(console: Console, inspection: Inspection) -> None:
    """Print what a data set holds, what can be identified from it, and the findings."""
    from omnibench.report.recording.inspection_report import driven_by, identifiability_table, split_table

    described = f"; {inspection.description}" if inspection.description else ""
    lines = [f"{inspection.dataset}: {kind_of_data(inspection.simulated)}{described}"]
    lines += [f"source: {inspection.source}"] if inspection.source else []
    lines += [f"licence: {inspection.licence}"] if inspection.licence else []
    references = [f"{plural(count, 'reference')} of {kind}" for kind, count in inspection.references.items()]
    if inspection.pose_period_s is not None:
        every = f"every {1000 * inspection.pose_period_s:.3g} ms"
        references.insert(0, f"{plural(inspection.reference_poses, 'reference pose')} {every}")
    shortest, longest = (1000 * period for period in inspection.sample_period_range_s)
    lines.append(
        f"robot {inspection.robot}, wheels {', '.join(inspection.wheels)}; "
        f"{plural(inspection.wheel_samples, 'wheel sample')} every {1000 * inspection.sample_period_s:g} ms "
        f"({shortest:.3g} to {longest:.3g} ms), {', '.join(references)}"
    )
    if (scans := inspection.scans) is not None:
        every = "" if scans.scan_period_s is None else f" every {1000 * scans.scan_period_s:.3g} ms"
        lines.append(
            f"{plural(scans.scans, 'scan')}{every} in {plural(scans.trajectories, 'run')}; "
            f"{plural(scans.rays, 'ray')} over {math.degrees(scans.field_of_view_rad):.0f} deg up to "
            f"{scans.range_max_m:g} m, of which {scans.seen_share:.0%} measured something"
        )
    for line in lines:
        console.print(line, soft_wrap=True)
    print_table(console, split_table(inspection))
    driven = f"{inspection.driven_directions} of {len(inspection.driven_shares)}"
    shares = ", ".join(f"{share:.2g}" for share in inspection.driven_shares)
    console.print(f"directions of {driven_by(inspection)} driven: {driven} ({shares})")
    print_table(console, identifiability_table(inspection))
    for line in (f"noise: {inspection.identifiability.noise_source}", *(f"- {each}" for each in inspection.findings)):
        console.print(line, soft_wrap=True)


def print_design(console: Console, design: Design) -> None:
    """Print the chosen commands of every set, their precision against the number of runs, and the baseline's equals."""
    from omnibench.design import report

    kind = "" if design.recorded and not design.simulated else " (simulated data)" if design.recorded else " (assumed)"
    use = report.USE_IN_WORDS[design.use]
    console.print(f"{design.name}{kind}: robot {design.robot}, D-optimal per {design.per}, {use}")
    console.print(report.origin_in_words(design))
    for of_set in design.sets:
        console.print()
        print_table(console, report.chosen_table(design, of_set))
        console.print(report.choice_in_words(design, of_set))
        if not design.recorded:
            console.print("What to drive:")
            for line in report.plan_in_words(design, of_set):
                console.print(f"  {line}")
        console.print(report.motions_in_words(of_set))
        console.print()
        print_table(console, report.effort_table(design, of_set))
    console.print()
    print_table(console, report.equal_table(design))
    for note in design.notes:
        console.print(f"- {note}")


def print_slam(console: Console, summary: SlamSummary) -> None:
    """Print how well scans matched, the poses' stated deviations, and their distance from recorded and true poses."""
    from omnibench.report.recording.section import summary_table

    counts = f"{plural(summary.runs, 'run')}, {plural(summary.scans, 'scan')}"
    matched = f"{summary.matched_mean:.1%} of the points matched (worst scan {summary.matched_min:.0%})"
    console.print(f"{summary.dataset}: {kind_of_data(summary.simulated)}; {counts}, {matched}", soft_wrap=True)
    print_table(console, summary_table(summary))
    if summary.accuracy is not None:
        print_slam_accuracy(console, summary.accuracy)


def print_slam_accuracy(console: Console, accuracy: SlamAccuracy) -> None:
    """Print the errors of reference poses against the truth of a simulation."""
    from omnibench.report.recording.section import bias_table, error_table

    print_table(console, error_table(accuracy))
    print_table(console, bias_table(accuracy))
    position, heading = 1000 * accuracy.drift_position, math.degrees(accuracy.drift_heading)
    console.print(f"drift {position:.2g} mm and {heading:.2g} deg a metre", soft_wrap=True)
