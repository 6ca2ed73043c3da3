"""The check of a recording, step by step: what is misread, what is missing, and whether a calibration is needed.

It is needed if it gains on runs that were not fitted, by the verdict of ``calibrate``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import wrap
from typing import Any, Literal

import numpy as np
from pydantic import Field
from xxhash import xxh3_64_intdigest

from omnibench.config import Model
from omnibench.data.checks.finding import Finding, FindingWarning, findings_of
from omnibench.data.checks.misread_search import UNRELATED, Explained, Recorded, Windows, continuous, search
from omnibench.data.checks.stream_faults import clock_findings, clocks_of, runs_in_words, stream_faults
from omnibench.data.clock_matching import ClockMatch
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.importers.copied_reference import follows_the_wheels
from omnibench.data.references import odd_references
from omnibench.data.stored_rows import count_drawn, drawn_runs
from omnibench.errors import computable
from omnibench.fit.check.fixes import (
    CannotBeTypedError,
    RecordingSource,
    attempt,
    command,
    mended_options,
    odd_times,
    of_dataset,
    other_times,
    read_source,
    recorded,
    with_fixes,
)
from omnibench.fit.check.missing_motions import missing_motions, too_few
from omnibench.fit.evaluate import looked_at, verdict_on
from omnibench.fit.linear_fit import quick_fit
from omnibench.fit.open_combinations import open_sentences
from omnibench.robot.model import OdometryModel
from omnibench.views import screenful
from omnibench.words import noun_for, plural

_WIDTH = 110  # characters of a line of a report at a Python prompt
_QUANTITIES = {"": "positions", "/sample": "increments since the row before", "/s": "rates"}
_SMALL = 0.1  # share of the cost: a larger gain that is not significant is left open; chosen
_ENOUGH = 10  # commands, from which on a gain would have shown if there were one; chosen
_REACHED = 0.05  # share of a run's time after which its last pose comes at least; chosen
# Share of the runs' turns (squares of the whole runs') that the best matrix leaves: at most 0.005 on OptiOdom's
# recordings, and 0.68 to 1.45 where the poses of each run were given to one of another command.
_LEFT = 0.25
_TURNED = 0.5  # rad, root mean square of the runs' turns: less of it tells nothing; chosen
_FEWEST = 3  # runs whose turns a matrix of a few numbers cannot all follow; chosen
_BENT = ("heading_unit", "time_unit", "steering")  # misreadings that no matrix takes up, as it does others
_SPOILED = ("reference_frozen", "reference_is_odometry")  # after which the wheels cannot be judged by the reference
_ORDER = {"error": 0, "warning": 1, "note": 2}
_TOLD = 12  # restarts that are told one by one; chosen
# Poses in a row that two runs must share, changes among them, and share of the later run's rows (chosen: a reference
# scatters, so that no two drives share any; wheel rates as commanded are alike in all repetitions).
_ROWS, _CHANGES, _SHARED = 12, 8, 0.3
_MOST_KEYS = 2_000_000  # stretches of poses that are kept, some 0.2 GB; of more every second, or third... (chosen)
_DIGIT = 1e-7  # m, to which positions are compared; below the noise of any reference
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


def read_otherwise(read: RecordingSource, explained: Explained) -> RecordingSource | None:
    """The recording by other units, with the findings that say so; None where none makes more sense of it.

    explained: what the search for misreadings tells of it. Tried are the units that reading it warned of, where the
    search tells something else, and wheels that count positions in the place of rates or increments, and the like,
    where no matrix explains the motion, with other units of time where the times are odd.
    """
    if not read.readable:
        return None
    warned = _unit_warnings(read)
    if {finding.kind for finding in warned} - {mistake.kind for mistake in explained.mistakes}:
        other = _mended(read, warned)
        return None if other is None or _unit_warnings(other) or search(recorded(other.dataset)).mistakes else other
    senseless = explained.unexplained > UNRELATED or (not explained.searched and odd_times(read.dataset))
    if not senseless or any(finding.kind == "wheel_unit" for finding in read.findings):
        return None
    # Another quantity of the wheels is tried with each other unit of times that are odd.
    odd = odd_times(read.dataset)
    for times in [[finding] for finding in other_times(read.importer, read.options)] if odd else [[]]:
        for quantity in _other_quantities(read):
            if (other := _mended(read, [*times, quantity])) is not None:
                return other
    return None


def _unit_warnings(read: RecordingSource) -> list[Finding]:
    """The findings of units that reading the recording warned of."""
    return [each.finding for each in read.dataset.warnings if isinstance(each, FindingWarning) and each.unit]


def _mended(read: RecordingSource, findings: list[Finding]) -> RecordingSource | None:
    """The recording read anew without the mistakes of findings, old and new; None if it makes no sense then."""
    mistakes = (*read.findings, *findings)
    try:
        options = mended_options(read, read.importer, read.options, [finding.changes for finding in mistakes])
    except CannotBeTypedError:
        return None
    dataset = attempt(read.importer, read.source, options)
    return None if dataset is None else replace(read, dataset=dataset, findings=mistakes)


def _other_quantities(read: RecordingSource) -> Iterator[Finding]:
    present = str(read.options.get("wheel_unit", "rad/s"))
    unit, _, per = present.partition("/")
    for ending, quantity in _QUANTITIES.items():
        if unit != "rpm" and ending.lstrip("/") != per:
            yield Finding(
                kind="wheel_unit",
                what=f"the wheels look like {quantity} ({unit}{ending}); they are read as "
                f"{_QUANTITIES[present.removeprefix(unit)]} ({present})",
                where="all wheels",
                severity="error",
                changes={"wheel_quantity": f"{unit}{ending}"},
            )


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


def foreign_reference(recording: Recorded, runs: Sequence[Trajectory]) -> Iterator[Finding]:
    """The finding that the poses of most runs are of other times, or of other drives, than the wheels."""
    early = [run for run in runs if run.references is None and run.pose_times[-1] < _REACHED * run.times[-1]]
    if 2 * len(early) > len(runs):
        seen, driven = early[0].pose_times[-1], early[0].times[-1]
        yield Finding(
            kind="reference_foreign",
            what=f"the poses of {plural(len(early), 'run')} end long before the wheels, as after {seen:.2g} s of "
            f"{driven:.3g} s",
            where="the reference",
            severity="error",
            fix="say the unit of the poses' times (pose_time_unit), or record poses to the end of each run",
        )
    elif (left := _turns_left(recording)) is not None and left > _LEFT:
        yield Finding(
            kind="reference_foreign",
            what=f"the wheels explain {max(0.0, 1 - left):.0%} of how the reference turns",
            where="the reference",
            severity="error",
            fix="see whether wheels and poses of each run are of the same drive, and name the robot's wheels right",
        )


def _turns_left(recording: Recorded) -> float | None:
    """Share of the squares of the runs' turns that the best matrix does not explain; None: they turn too little."""
    some = recording.some()
    windows = Windows.of(some.logs, some.poses)
    fit = None if windows is None else windows.fit()
    if windows is None or fit is None or len(some.logs) < _FEWEST:
        return None
    turned = np.bincount(windows.run, windows.turned)
    if np.sqrt(np.mean(turned**2)) < _TURNED:
        return None
    missed = turned - np.bincount(windows.run, windows.driven @ fit.matrix[2])
    return float((missed**2).sum() / (turned**2).sum())


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
    dataset, robot = read.dataset, read.dataset.robot
    runs = [replace(run, poses=continuous(run.pose_times, run.poses)) for run in dataset.trajectories if run.has_poses]
    clocks = clocks_of(robot, runs)
    aligned = []  # poses by the wheels' clock
    for run, clock in zip(runs, clocks, strict=True):
        times = run.pose_times if clock is None else clock.corrected(run.pose_times)
        used = np.flatnonzero((times >= 0) & (times <= run.times[-1]))
        if clock is not None and len(used) >= max(3, len(times) // 2):
            run = replace(run, pose_times=times[used], poses=run.poses[used], pose_covariances=None)
        aligned.append(run)
    faults = list(stream_faults(robot, [*aligned, *(run for run in dataset.trajectories if not run.has_poses)]))
    odometry = list(_odometry(dataset, drawn_runs(runs)))
    spoiled = {finding.kind for finding in (*faults, *odometry)} & set(_SPOILED)
    seen = recorded(replace(dataset, trajectories=tuple(aligned)))
    explained = search(seen)
    # A steering or a wheel that never counts is mended by no other reading of it.
    frozen = any(fault.kind in ("steering_frozen", "wheel_dead") and not fault.changes for fault in faults)
    if not frozen and not spoiled and (otherwise := read_otherwise(read, explained)) is not None:
        return check_recording(otherwise).model_copy(update={"clocks": tuple(clocks)})
    if frozen:
        misread = []
    elif explained.searched:
        misread = list(_misreadings(explained))
    else:  # the search for misreadings needs more poses than there are: what reading the data set warned of stands
        misread = [finding for finding in findings_of(dataset.warnings) if finding.severity == "error"]
    if misread:  # wheels that are misread tell no jumps
        faults = [fault for fault in faults if fault.kind != "reference_jump"]
    odd = _odd_references(dataset) if explained.searched else []
    wrong = any(finding.severity == "error" for finding in (*odd, *odometry, *faults))
    bent = any(finding.kind.startswith(_BENT) for finding in misread)
    foreign = [] if wrong or bent else list(foreign_reference(seen, aligned))
    if foreign:
        misread = []
    findings = [*read.findings, *_noted(dataset), *misread, *odd, *foreign, *odometry, *faults, *copied_runs(runs)]
    off = [] if spoiled or foreign else list(clock_findings(runs, clocks))
    findings += off
    measured = any(run.references is not None for run in dataset.trajectories)
    findings += _left_open(dataset) if measured else missing_motions(robot, drawn_runs(aligned))
    findings += [*too_few(dataset.trajectories), *_drawn(dataset.trajectories)]
    distinct: dict[tuple[str, str], Finding] = {}
    for finding in findings:
        distinct.setdefault((finding.kind, finding.where), finding)
    findings = with_fixes(read, sorted(distinct.values(), key=lambda finding: _ORDER[finding.severity]))
    clocks_agree = not any(finding.severity == "error" for finding in off)
    gain = Gain(None, "") if misread or odd or foreign or spoiled else expected_gain(dataset, clocks_agree=clocks_agree)
    return _report(read, findings, gain, clocks)


def mending(read: RecordingSource, report: CheckReport) -> str:
    """Command that reads a recording again without the errors of its report, also once a data set is written."""
    return command(read, [finding for finding in report.findings if finding.severity == "error"])


def _report(
    read: RecordingSource, findings: Sequence[Finding], gain: Gain, clocks: Sequence[ClockMatch | None]
) -> CheckReport:
    errors = [finding for finding in findings if finding.severity == "error"]
    typed = [finding for finding in errors if finding.changes]
    lacking = [finding for finding in findings if finding.kind in ("motion_missing", "few_runs", "few_repetitions")]
    verdict: Verdict = "fix" if typed else "record more" if errors or lacking else "ready"
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


def _left_open(dataset: Dataset) -> Iterator[Finding]:
    """Findings on what the training runs leave open: with no reference of turning, or none of lengths, a warning."""
    training = dataset.split("train")
    for number, sentence in enumerate(open_sentences(dataset.robot, training) if training else ()):
        what, _, fix = sentence.rpartition("; " if "; " in sentence else ": ")
        missing = what.startswith(("no reference tells of turning", "no reference tells of lengths"))
        yield Finding(
            kind="motion_missing" if missing else "references_leave_open",
            what=what,
            where="the recording" if not number else f"the recording, {number + 1}",
            severity="warning" if missing else "note",
            fix=fix,
        )


def _misreadings(explained: Explained) -> Iterator[Finding]:
    others = " or ".join("; ".join(mistake.what for mistake in mistakes) for mistakes in explained.alike)
    for index, mistake in enumerate(explained.mistakes):
        alike = f" (this recording cannot tell that from another reading: {others})" if others and not index else ""
        yield mistake.finding(alike)


def _odd_references(dataset: Dataset) -> list[Finding]:
    """Findings on references in another unit beside poses that are right: no option changes the ones alone."""
    measured = [(run.log([0.0]), run.references) for run in dataset.trajectories if run.references is not None]
    fix = "write these references in m and rad, as the poses are, and import again"
    return [
        finding.model_copy(update={"changes": {}, "fix": fix})
        for finding in findings_of(odd_references(dataset.robot, measured))
    ]


def _odometry(dataset: Dataset, runs: Sequence[Trajectory]) -> Iterator[Finding]:
    if dataset.simulated or (residual := follows_the_wheels(runs)) is None:
        return
    yield Finding(
        kind="reference_is_odometry",
        what="the reference is the robot's own odometry, or simulated without noise: some matrix makes its headings of "
        f"the wheels to {residual:.1g} rad a second, and nothing can be learnt from it",
        where="the reference",
        severity="error",
        fix="record an independent reference, such as motion capture, SLAM, or a tape measure (omnibench guide data)",
    )


def _drawn(runs: Sequence[Trajectory]) -> Iterator[Finding]:
    """A note where not all runs are looked at together."""
    if (count := count_drawn(runs)) < len(runs):
        yield Finding(
            kind="runs_drawn",
            what=f"what concerns the recording as a whole is judged by {count:,} of {len(runs):,} runs, which chance "
            "has drawn, some of every session and command first; every run by itself is looked at",
            where="the recording",
            severity="note",
            fix="nothing: so many tell as much as all",
        )


def _noted(dataset: Dataset) -> Iterator[Finding]:
    """Restarts of counters that the importer has mended."""
    notes = [finding.what for finding in findings_of(dataset.warnings) if finding.kind == "counter_restart"]
    if notes:
        yield Finding(
            kind="counter_restart",
            what="; ".join(notes[:_TOLD]) + (f" and {len(notes) - _TOLD} more" if len(notes) > _TOLD else ""),
            where="all wheels",
            severity="note",
            fix="nothing: the import has mended it",
        )


def copied_runs(runs: Sequence[Trajectory]) -> Iterator[Finding]:
    """Runs that repeat an earlier one."""
    every = -(-sum(len(run.pose_times) for run in runs) // _MOST_KEYS)
    seen: dict[int, str] = {}
    copies: dict[str, str] = {}
    for run in runs:
        keys = {key for key in _keys(run) if key % every == 0}
        shared = [seen[key] for key in keys if key in seen]
        if keys and len(shared) > _SHARED * len(keys):
            copies[run.id] = max(set(shared), key=shared.count)
        else:
            seen.update(dict.fromkeys(keys, run.id))
    if copies:
        first = next(iter(copies.items()))
        yield Finding(
            kind="copies",
            what=f"{plural(len(copies), 'run')} {'repeats' if len(copies) == 1 else 'repeat'} the poses of "
            f"others, as {first[0]} those of {first[1]}: what validates then was trained on",
            where=runs_in_words(list(copies), len(runs)),
            severity="error",
            changes={"leave_out": list(copies)},
        )


def _keys(run: Trajectory) -> Iterator[int]:
    """Digests of every stretch of reference positions that change often enough."""
    rounded = np.round(run.poses[:, :2] / _DIGIT).astype(np.int64)
    changes = np.append(0, np.cumsum(np.any(np.diff(rounded, axis=0) != 0, axis=1)))
    for row in range(len(rounded) - _ROWS + 1):
        if changes[row + _ROWS - 1] - changes[row] >= _CHANGES:
            yield xxh3_64_intdigest(rounded[row : row + _ROWS].tobytes())
