"""The check of a recording: an ordered list of detectors, each of which looks at it and gives findings.

A detector is left out where an error was found that hides what it would tell. A calibration is needed if it gains on
runs that were not fitted, by the verdict of ``calibrate``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Set
from pathlib import Path
from textwrap import wrap
from typing import Any, Literal

from pydantic import Field

from omnibench.check import faults
from omnibench.check.evidence import Evidence
from omnibench.check.misreadings import UNRELATED
from omnibench.check.motions import lacking
from omnibench.check.source import RecordingSource, odd_times, of_dataset, other_times, read_source, sensible
from omnibench.config import Model
from omnibench.data.clock_matching import ClockMatch
from omnibench.data.dataset import Dataset
from omnibench.data.finding import CLOCKS, LACKING, MISREAD, SPOILED, UNREAD, Finding, error
from omnibench.errors import computable
from omnibench.fit.estimate import estimate, usual_problem
from omnibench.fit.evaluate import looked_at, verdict_on
from omnibench.views import screenful
from omnibench.words import noun_for, plural

_WIDTH = 110  # characters of a line of a report at a Python prompt
_SMALL = 0.1  # share of the cost: a larger gain that is not significant is left open; chosen
_ENOUGH = 10  # commands, from which on a gain would have shown if there were one; chosen
_ORDER = {"error": 0, "warning": 1, "note": 2}
Verdict = Literal["ready", "fix", "record more"]


class CheckReport(Model):
    """The check of one recording.

    needed: True if a calibration gains more than chance on runs that it was not fitted to, False if it does not; None
    if that cannot be told. sentence: the verdict in words. gain: what cross-validation says. command: the import that
    mends all errors or, of a recording that is ready, all warnings, as far as options do; else empty. clocks: of the
    runs that have poses, in their order; None where one does not show.
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


def misreadings(evidence: Evidence) -> Iterator[Finding]:
    """Mistakes in the log or in the robot's file; and a design that none of them brings near the motion."""
    explained = evidence.explained
    others = " or ".join("; ".join(mistake.what for mistake in mistakes) for mistakes in explained.alike)
    for index, mistake in enumerate(explained.mistakes):
        alike = f" (this recording cannot tell that from another reading: {others})" if others and not index else ""
        yield mistake.model_copy(update={"what": mistake.what + alike})
    if explained.far and not explained.mistakes and explained.unexplained < UNRELATED:
        said, fit, design = "", explained.fit, evidence.dataset.robot.inverse_kinematic_matrix
        if fit is not None:
            rows = zip(("goes ahead", "goes sideways", "turns"), fit.matrix, design, strict=True)
            shares = [
                f"{name} {float(row @ fit.gram @ meant) / size:.2f} times as far"
                for name, row, meant in rows
                if (size := float(meant @ fit.gram @ meant)) > 0
            ]
            said = f" (it {', '.join(shares)} as its wheels say)"
        what = f"the robot does not move as robot.yaml says{said}, and no single mistake explains it"
        fix = "measure its wheels anew (radius, x, y, distance, angle; m), see their order and signs, and correct "
        fix += "robot.yaml; a calibration would end at its bounds"
        yield error("design_unknown", what, "robot.yaml", fix=fix)


# Each detector with the kinds of errors that hide what it would tell.
DETECTORS: tuple[tuple[Callable[[Evidence], Iterator[Finding]], frozenset[str]], ...] = (
    (faults.notes, frozenset()),
    (faults.own_odometry, frozenset()),
    (faults.early_references, frozenset()),
    (faults.wheel_faults, frozenset()),
    (faults.reference_faults, frozenset()),
    (faults.dead_sensors, SPOILED),
    (misreadings, UNREAD),
    (faults.odd_references, UNREAD),
    (faults.unrelated_references, UNREAD | MISREAD | {"wheel_dropout", "reference_dropout"}),
    (faults.jumps, UNREAD | MISREAD),
    (faults.steering_zero, UNREAD | MISREAD),
    (faults.clocks, UNREAD | {"reference_jump"}),
    (faults.copied_runs, frozenset()),
    (lacking, frozenset()),
)


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
    """Check a recording that was read.

    Where mistakes explain its motion that options mend, other findings are looked for in what was meant.
    """
    evidence = Evidence(read)
    if not read.findings and (otherwise := _read_otherwise(evidence)) is not None:
        return check_recording(otherwise)
    others = list[Finding]()
    for detector, hidden_by in DETECTORS:
        if hidden_by & {finding.kind for finding in others if finding.severity == "error"}:
            continue
        findings = (*detector(evidence),)
        by_options = detector is misreadings and not read.findings and any(finding.changes for finding in findings)
        if by_options and (mended := read.mended(findings)) is not None:
            return check_recording(mended).model_copy(update={"clocks": tuple(evidence.clocks)})
        others += [finding for finding in findings if finding not in read.findings]
    # Each finding of its kind and place once, those of the reading first.
    distinct: dict[tuple[str, str], Finding] = {}
    for finding in (*read.findings, *others):
        distinct.setdefault((finding.kind, finding.where), finding)
    ordered = sorted(distinct.values(), key=lambda finding: _ORDER[finding.severity])
    findings = tuple(read.with_fixes(ordered))
    errors = [finding for finding in findings if finding.severity == "error"]
    kinds = {finding.kind for finding in errors}
    misread = MISREAD & {each.kind for each in ordered if each.severity == "error" and each not in read.findings}
    unknown = misread or kinds & (SPOILED | {"reference_foreign", "wheel_unsigned"})
    needed, gain = (None, "") if unknown else expected_gain(read.dataset, kinds)
    typed = [finding for finding in errors if finding.changes]
    missing = [finding for finding in findings if finding.kind in LACKING]
    to_mend = typed or any(kind.startswith("design") for kind in kinds)
    verdict: Verdict = "fix" if to_mend else "record more" if errors or missing else "ready"
    if verdict == "ready":
        typed = [finding for finding in findings if finding.severity == "warning" and finding.changes]
        sentence = f"{read.dataset.name} is ready for calibration"
        sentence += f"; {plural(len(findings), 'remark')} below" if findings else ""
        sentence += ", and hardly needs one: it would gain no more than chance" if needed is False else ""
    else:
        must = "must be mended before a calibration" if verdict == "fix" else "needs more recordings"
        sentence = f"{read.dataset.name} {must}: {(typed or errors or missing)[0].what}"
        more = len(findings) - 1
        sentence += f" (and {more} more {noun_for(more, 'finding')})" if more else ""
    command, clocks = read.command(typed), tuple(evidence.clocks)
    return CheckReport(
        verdict=verdict, needed=needed, findings=findings, sentence=sentence, gain=gain, command=command, clocks=clocks
    )


def _read_otherwise(evidence: Evidence) -> RecordingSource | None:
    """The recording by other units of times or another quantity of wheels, with the findings that say so.

    They are tried where no matrix explains the motion, or the times are odd. None where none makes more sense of it.
    """
    read, odd = evidence.read, odd_times(evidence.dataset)
    if not evidence.runs:
        return None
    if not odd and (evidence.explained.mistakes or evidence.explained.unexplained <= UNRELATED):
        return None
    if not odd and [*faults.dead_sensors(evidence), *faults.own_odometry(evidence)]:
        return None
    quantities: list[list[Finding]] = [[], *([finding] for finding in read.other_quantities())]
    times: list[list[Finding]] = [[finding] for finding in other_times(read.options)] if odd else [[]]
    for findings in [[*time, *quantity] for quantity in quantities for time in times]:
        if findings and (other := read.mended(findings)) is not None and sensible(other.dataset):
            return other
    return None


def expected_gain(dataset: Dataset, errors: Set[str] = frozenset()) -> tuple[bool | None, str]:
    """The verdict on the default estimate from the training runs, as ``calibrate`` has it: is it needed, and in words.

    errors: kinds of the errors that were found; clocks that are off, and jumps, hide whether there is a gain.
    """
    robot, held_out = dataset.robot, dataset.split("validation")
    training = looked_at(dataset.split("train") or held_out)
    problem = usual_problem(robot, training)
    model = estimate(problem).model(problem)
    verdict = verdict_on(model, training, looked_at(held_out) if dataset.split("train") else ())
    needed = {"better": True, "worse": False}.get(verdict.verdict)
    small = verdict.improvement is not None and abs(verdict.improvement) < _SMALL
    if verdict.verdict == "undecided" and small and verdict.units >= _ENOUGH:
        needed = False
    for hiding, mended in ((CLOCKS, "the clocks are matched"), ({"reference_jump"}, "the jumps are out")):
        if needed is None and hiding & errors:
            return None, f"whether a calibration is needed can be told once {mended}"
    if verdict.verdict == "unknown":
        runs = plural(len(dataset.trajectories), "run")
        return None, f"whether a calibration is needed cannot be told from {runs}; record four, of three commands"
    return needed, verdict.sentence
