"""The check of a recording: an ordered list of detectors, each of which looks at it and gives findings.

A detector is left out where an error was found that hides what it would tell. A calibration is needed if it gains on
runs that were not fitted, by the verdict of ``calibrate``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from textwrap import wrap
from typing import Any, Literal

import numpy as np
from pydantic import Field

from omnibench.check.clocks import clock_findings, clocks_of
from omnibench.check.misreadings import UNRELATED, Explained, Recorded, search
from omnibench.check.motion_fit import FreeFit, Windows, continuous
from omnibench.check.motions import missing_motions, too_few
from omnibench.check.references import early_references, left_open, odd_references, unrelated_references
from omnibench.check.source import (
    RecordingSource,
    command,
    mended_options,
    odd_times,
    of_dataset,
    other_quantities,
    other_times,
    read_source,
    recorded,
    sensible,
    with_fixes,
)
from omnibench.check.streams import (
    Look,
    copied_runs,
    dead_wheels,
    frozen_steering,
    jump_findings,
    looks_of,
    reference_faults,
    unsigned_counts,
    wheel_faults,
)
from omnibench.config import Model
from omnibench.data.clock_matching import ClockMatch
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.finding import Finding, findings_of
from omnibench.data.importers.copied_reference import follows_the_wheels
from omnibench.data.stored import count_drawn, drawn_runs
from omnibench.errors import computable
from omnibench.fit.evaluate import looked_at, verdict_on
from omnibench.fit.linear_fit import quick_fit
from omnibench.robot.model import OdometryModel
from omnibench.views import screenful
from omnibench.words import noun_for, plural

_WIDTH = 110  # characters of a line of a report at a Python prompt
_SMALL = 0.1  # share of the cost: a larger gain that is not significant is left open; chosen
_ENOUGH = 10  # commands, from which on a gain would have shown if there were one; chosen
_ORDER = {"error": 0, "warning": 1, "note": 2}
_TOLD = 12  # restarts that are told one by one; chosen
Verdict = Literal["ready", "fix", "record more"]


class CheckReport(Model):
    """The check of one recording.

    needed: True if a calibration gains more than chance on runs that it was not fitted to, False if it does not; None
    if that cannot be told. sentence: the verdict in words. gain: what cross-validation says. command: the import with
    all fixes that can be typed; empty if there is none. clocks: of the runs that have poses, in their order; None where
    one does not show.
    """

    verdict: Verdict
    needed: bool | None
    findings: tuple[Finding, ...]
    sentence: str
    gain: str
    command: str = ""
    clocks: tuple[ClockMatch | None, ...] = Field((), exclude=True, repr=False)

    def __repr__(self) -> str:
        findings = [f"{finding.severity}: {finding.what} [{finding.where}]" for finding in self.findings]
        typed = ["its .command mends what can be mended"] if self.command else []
        said = [f"{self.verdict}: {self.sentence}", *findings, *filter(None, [self.gain]), *typed]
        return "\n".join(screenful([line for text in said for line in wrap(text, _WIDTH, subsequent_indent="    ")]))


@dataclass(frozen=True, eq=False)
class Evidence:
    """What detectors look at: a recording, and what was computed of it once for all of them.

    runs: those that have poses. clocks: of their references. aligned: the same runs with poses by the wheels' clock, as
    far as it shows.
    """

    read: RecordingSource
    runs: Sequence[Trajectory]
    clocks: Sequence[ClockMatch | None]
    aligned: Sequence[Trajectory]

    @classmethod
    def of(cls, read: RecordingSource) -> Evidence:
        """The evidence of a recording."""
        runs = [run for run in read.dataset.trajectories if run.has_poses]
        smooth = [replace(run, poses=continuous(run.pose_times, run.poses)) for run in runs]
        clocks = clocks_of(read.dataset.robot, smooth)
        aligned = []
        for run, clock in zip(runs, clocks, strict=True):
            times = run.pose_times if clock is None else clock.corrected(run.pose_times)
            used = np.flatnonzero((times >= 0) & (times <= run.times[-1]))
            if clock is not None and len(used) >= max(3, len(times) // 2):
                run = replace(run, pose_times=times[used], poses=run.poses[used], pose_covariances=None)
            aligned.append(run)
        return cls(read, runs, clocks, aligned)

    @property
    def dataset(self) -> Dataset:
        """The data set of the recording."""
        return self.read.dataset

    @cached_property
    def seen(self) -> Recorded:
        """The runs that have poses, by the wheels' clock."""
        return recorded(replace(self.dataset, trajectories=tuple(self.aligned)))

    @cached_property
    def explained(self) -> Explained:
        """The mistakes that explain the motion."""
        return search(self.seen)

    @cached_property
    def looks(self) -> list[Look]:
        """A look at each of the runs that have poses."""
        return looks_of(self.dataset.robot, self.aligned) if self.aligned else []

    @cached_property
    def windows(self) -> Windows | None:
        """Windows of a second of the runs that have poses, of many some; None where poses are sparse."""
        poses = [continuous(run.pose_times, run.poses) for run in self.aligned]
        return Windows.of([run.log(run.pose_times) for run in self.aligned], poses)

    @cached_property
    def fit(self) -> FreeFit | None:
        """The matrix that fits these windows best."""
        return None if self.windows is None else self.windows.fit(self.dataset.robot.reach)


@dataclass(frozen=True)
class Detector:
    """A detector, and the kinds of errors that hide what it would tell."""

    find: Callable[[Evidence], Iterator[Finding]]
    hidden_by: frozenset[str] = frozenset()


_SPOILED = frozenset({"reference_frozen", "reference_is_odometry"})  # the reference tells nothing
_UNREAD = _SPOILED | {
    "steering_frozen",
    "wheel_dead",
    "wheel_unsigned",
    "reference_foreign",
}  # no other reading mends it
_MISREAD = frozenset(
    {
        *("wheels_swapped", "wheel_negated", "wheels_negated", "wheel_scale", "wheel_unit", "position_unit"),
        *(
            "steering_unit",
            "steering_sign",
            "steering_zero",
            "steering_swapped",
            "steering_lag",
            "heading_unit",
            "time_unit",
        ),
        *(
            "reference_mirrored",
            "reference_turned",
            "design_distance",
            "design_rollers",
            "design_mount",
            "design_unknown",
        ),
    }
)


def _notes(evidence: Evidence) -> Iterator[Finding]:
    """Restarts of counters that the importer has mended, and a note where not all runs are looked at together."""
    notes = [finding.what for finding in findings_of(evidence.dataset.warnings) if finding.kind == "counter_restart"]
    if notes:
        more = f" and {len(notes) - _TOLD} more" if len(notes) > _TOLD else ""
        what, fix = "; ".join(notes[:_TOLD]) + more, "nothing: the import has mended it"
        yield Finding(kind="counter_restart", what=what, where="all wheels", severity="note", fix=fix)
    runs = evidence.dataset.trajectories
    if (count := count_drawn(runs)) < len(runs):
        yield Finding(
            kind="runs_drawn",
            what=f"what concerns the recording as a whole is judged by {count:,} of {len(runs):,} runs, which chance "
            "has drawn, some of every session and command first; every run by itself is looked at",
            where="the recording",
            severity="note",
            fix="nothing: so many tell as much as all",
        )


def _wheels(evidence: Evidence) -> Iterator[Finding]:
    sparse = [run for run in evidence.dataset.trajectories if not run.has_poses]
    looks = evidence.looks + (looks_of(evidence.dataset.robot, sparse) if sparse else [])
    yield from wheel_faults([*evidence.aligned, *sparse], looks)


def _odometry(evidence: Evidence) -> Iterator[Finding]:
    """A reference that is the robot's own odometry."""
    if evidence.dataset.simulated or (residual := follows_the_wheels(drawn_runs(evidence.runs))) is None:
        return
    yield Finding(
        kind="reference_is_odometry",
        what="the reference is the robot's own odometry, or simulated without noise: some matrix makes its headings of "
        f"the wheels to {residual:.1g} rad a second, and nothing can be learnt from it",
        where="the reference",
        severity="error",
        fix="record an independent reference, such as motion capture, SLAM, or a tape measure (omnibench guide data)",
    )


def _dead(evidence: Evidence) -> Iterator[Finding]:
    robot = evidence.dataset.robot
    if evidence.looks:
        yield from dead_wheels(robot, evidence.looks, evidence.windows, evidence.fit)
        yield from frozen_steering(robot, evidence.looks)
        yield from unsigned_counts(robot, evidence.windows, evidence.aligned)


def _misreadings(evidence: Evidence) -> Iterator[Finding]:
    """Mistakes in the log or in the robot's file; and a design that none of them brings near the motion."""
    explained = evidence.explained
    others = " or ".join("; ".join(mistake.what for mistake in mistakes) for mistakes in explained.alike)
    for index, mistake in enumerate(explained.mistakes):
        alike = f" (this recording cannot tell that from another reading: {others})" if others and not index else ""
        yield mistake.model_copy(update={"what": mistake.what + alike})
    if explained.far and not explained.mistakes and explained.unexplained < UNRELATED:
        yield from _unknown_design(evidence)


def _unknown_design(evidence: Evidence) -> Iterator[Finding]:
    """The finding that the robot moves as no reading of the log and no usual mistake in robot.yaml explains."""
    design, fit = evidence.dataset.robot.inverse_kinematic_matrix, evidence.explained.fit
    said = ""
    if fit is not None:
        gains = [float(row @ gram_row) for row, gram_row in zip(fit.matrix @ fit.gram, design, strict=True)]
        sizes = [float(row @ fit.gram @ row) for row in design]
        names = ("ahead", "sideways", "turning")
        shares = [
            f"{name} {gain / size:.2g} times" for name, gain, size in zip(names, gains, sizes, strict=True) if size > 0
        ]
        said = f" (it moves {', '.join(shares)} as much as its wheels say)"
    yield Finding(
        kind="design_unknown",
        what=f"the robot does not move as robot.yaml says{said}, and no single mistake explains it",
        where="robot.yaml",
        severity="error",
        fix="measure its wheels anew (radius, x, y, distance, angle; m), see their order and signs, and correct "
        "robot.yaml; a calibration would end at its bounds",
    )


def _references(evidence: Evidence) -> Iterator[Finding]:
    yield from odd_references(evidence.dataset)


def _early(evidence: Evidence) -> Iterator[Finding]:
    yield from early_references(evidence.aligned)


def _foreign(evidence: Evidence) -> Iterator[Finding]:
    yield from unrelated_references(evidence.seen)


def _streams(evidence: Evidence) -> Iterator[Finding]:
    yield from reference_faults(evidence.aligned, evidence.looks)


def _jumps(evidence: Evidence) -> Iterator[Finding]:
    standing = {look.run for look in evidence.looks if look.standing}
    yield from jump_findings(evidence.dataset.robot, [run for run in evidence.aligned if run.id not in standing])


def _clocks(evidence: Evidence) -> Iterator[Finding]:
    yield from clock_findings(evidence.runs, evidence.clocks)


def _motions(evidence: Evidence) -> Iterator[Finding]:
    """Motions, runs and repetitions that are missing."""
    if any(run.references is not None for run in evidence.dataset.trajectories):
        yield from left_open(evidence.dataset)
    else:
        yield from missing_motions(evidence.dataset.robot, drawn_runs(evidence.aligned))
    yield from too_few(evidence.dataset.trajectories)


def _copies(evidence: Evidence) -> Iterator[Finding]:
    yield from copied_runs(evidence.runs)


DETECTORS: tuple[Detector, ...] = (
    Detector(_notes),
    Detector(_odometry),
    Detector(_early),
    Detector(_wheels),
    Detector(_streams),
    Detector(_dead, _SPOILED),
    Detector(_misreadings, _UNREAD),
    Detector(_references, _UNREAD),
    Detector(_foreign, _UNREAD | _MISREAD | {"wheel_dropout", "reference_dropout"}),
    Detector(_jumps, _UNREAD | _MISREAD | {"reference_foreign"}),
    Detector(_clocks, _SPOILED | {"reference_foreign"}),
    Detector(_copies),
    Detector(_motions),
)


def findings_in(evidence: Evidence) -> list[Finding]:
    """The findings of all detectors, those that read the recording first, each of its kind and place once."""
    findings = list(evidence.read.findings)
    for detector in DETECTORS:
        errors = {
            finding.kind
            for finding in findings
            if finding.severity == "error" and finding not in evidence.read.findings
        }
        if not detector.hidden_by & errors:
            findings += detector.find(evidence)
    distinct: dict[tuple[str, str], Finding] = {}
    for finding in findings:
        distinct.setdefault((finding.kind, finding.where), finding)
    return sorted(distinct.values(), key=lambda finding: _ORDER[finding.severity])


@computable
def check(
    source: Dataset | Path | str,
    *,
    importer: str | None = None,
    options: Mapping[str, Any] | None = None,
    robot: Path | str | None = None,
) -> CheckReport:
    """Check whether a recording is fit for calibration, what is wrong with it, and what to type.

    source: a data set, its folder, or recordings that an importer reads. importer, options: of recordings; by default
    the importer is recognised. robot: file of the robot, where the source has none. DataError or ConfigError in one
    line where the source cannot be read.
    """
    if isinstance(source, Dataset):
        return check_recording(of_dataset(source))
    return check_recording(read_source(Path(source), importer, options, None if robot is None else Path(robot)))


def check_recording(read: RecordingSource) -> CheckReport:
    """The check of a recording that was read."""
    evidence = Evidence.of(read)
    if not read.findings and (otherwise := _read_otherwise(evidence) or _mended(evidence)) is not None:
        return check_recording(otherwise).model_copy(update={"clocks": tuple(evidence.clocks)})
    found = findings_in(evidence)
    unread = {finding.kind for finding in found if finding.kind in _MISREAD and finding not in read.findings}
    findings = with_fixes(read, found)
    kinds = {finding.kind for finding in findings if finding.severity == "error"}
    if unread or kinds & (_SPOILED | {"reference_foreign", "wheel_unsigned"}):
        gain = Gain(None, "")
    else:
        gain = expected_gain(read.dataset, clocks_agree=not kinds & {"clock_offset", "clock_drift"})
    return _report(read, findings, gain, evidence.clocks)


def _read_otherwise(evidence: Evidence) -> RecordingSource | None:
    """The recording by other units of times or another quantity of wheels, with the findings that say so.

    They are tried where no matrix explains the motion, or the times are odd. None where none makes more sense of it.
    """
    read, dataset = evidence.read, evidence.dataset
    if not evidence.runs or read.reading is None:
        return None
    odd = odd_times(dataset)
    if not odd and (evidence.explained.mistakes or evidence.explained.unexplained <= UNRELATED):
        return None
    if next(_dead(evidence), None) is not None or next(_odometry(evidence), None) is not None:
        return None
    quantities: list[list[Finding]] = [[], *([finding] for finding in other_quantities(read))]
    times: list[list[Finding]] = [[finding] for finding in other_times(read.options)] if odd else [[]]
    for findings in [[*time, *quantity] for quantity in quantities for time in times]:
        if findings and (other := read.read_by(mended_options(read, findings))) is not None and sensible(other):
            return replace(read, dataset=other, findings=tuple(findings))
    return None


def _mended(evidence: Evidence) -> RecordingSource | None:
    """The recording without the mistakes that explain its motion, so that others are looked for in what was meant."""
    read, hidden = evidence.read, (*_odometry(evidence), *_early(evidence), *_streams(evidence), *_dead(evidence))
    mistakes = (
        []
        if _UNREAD & {finding.kind for finding in hidden if finding.severity == "error"}
        else [*_misreadings(evidence)]
    )
    if not any(finding.changes for finding in mistakes):
        return None
    mended = read.read_by(mended_options(read, mistakes))
    return None if mended is None else replace(read, dataset=mended, findings=tuple(mistakes))


@dataclass(frozen=True)
class Gain:
    """needed: as in CheckReport. sentence: the errors before and after."""

    needed: bool | None
    sentence: str


def expected_gain(dataset: Dataset, *, clocks_agree: bool = True) -> Gain:
    """The verdict on a quick fit to the training runs, as ``calibrate`` judges its own.

    clocks_agree: False where the reference's clock is so far off that a gain which is not significant says nothing.
    """
    robot, held_out = dataset.robot, dataset.split("validation")
    training = looked_at(dataset.split("train") or held_out)
    model = OdometryModel(robot, quick_fit(robot, training), "arc")
    verdict = verdict_on(model, training, looked_at(held_out) if dataset.split("train") else ())
    needed = {"better": True, "worse": False}.get(verdict.verdict)
    small = verdict.improvement is not None and abs(verdict.improvement) < _SMALL
    if verdict.verdict == "undecided" and small and verdict.units >= _ENOUGH:
        needed = False
    if needed is None and not clocks_agree:
        return Gain(None, "whether a calibration is needed can be told once the clocks are matched")
    if verdict.verdict == "unknown":
        runs = plural(len(dataset.trajectories), "run")
        return Gain(None, f"whether a calibration is needed cannot be told from {runs}; record four, of three commands")
    return Gain(needed, verdict.sentence)


def mending(read: RecordingSource, report: CheckReport) -> str:
    """Command that reads a recording again without the errors of its report, also once a data set is written."""
    return command(read, [finding for finding in report.findings if finding.severity == "error"])


def _report(
    read: RecordingSource, findings: Sequence[Finding], gain: Gain, clocks: Sequence[ClockMatch | None]
) -> CheckReport:
    errors = [finding for finding in findings if finding.severity == "error"]
    typed = [finding for finding in errors if finding.changes]
    lacking = [finding for finding in findings if finding.kind in ("motion_missing", "few_runs", "few_repetitions")]
    mended = typed or any(finding.kind.startswith("design") for finding in errors)
    verdict: Verdict = "fix" if mended else "record more" if errors or lacking else "ready"
    name = read.dataset.name
    first = (typed or errors or lacking or list(findings))[:1]
    what = first[0].what if first else ""
    others = len(findings) - 1
    more = f" (and {others} more {noun_for(others, 'finding')})" if others > 0 else ""
    if verdict == "ready":
        sentence = f"{name} is ready for calibration" + (
            f"; {plural(len(findings), 'remark')} below" if findings else ""
        )
    elif verdict == "fix":
        sentence = f"{name} must be mended before a calibration: {what}{more}"
    else:
        sentence = f"{name} needs more recordings: {what}{more}"
    if gain.needed is False and verdict == "ready":
        sentence += ", and hardly needs one: it would gain no more than chance"
    return CheckReport(
        verdict=verdict,
        needed=gain.needed,
        findings=tuple(findings),
        sentence=sentence,
        gain=gain.sentence,
        command=command(read, typed),
        clocks=tuple(clocks),
    )
