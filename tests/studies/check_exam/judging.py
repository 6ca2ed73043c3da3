"""The judge: findings against the table, and whether what a fix has made is sound, by the examiner's own odometry."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from check_exam.faults import Damage
from check_exam.motion import clock, fitted_matrix, lever, misfit, windows
from check_exam.recordings import Recording, Run
from check_exam.writing import file_name

_WORSE, _MARGIN = 1.15, 0.01  # times the sound misfit, and above it
_LENGTH = 0.05  # share by which a path's length may differ
_KEPT, _KEPT_WHOLE = 0.6, 0.9  # of the seconds, where runs were spoilt and where not
_SPOILT = {"wheel_dropout", "reference_dropout", "reference_jump", "counter_restart", "wheel_dead", "reference_frozen",
           "not_at_rest", "copies"}  # fmt: skip
_CLOCKS = {"clock_offset", "clock_drift"}
_CLOCK_LEFT, _CLOCK_MORE, _SURE = 0.1, 0.05, 0.3  # s left at most, or more than in the sound recording; contrast
_FEW_RUNS, _OPEN_RUNS = 3, 7
_STRAIGHT = 2.5  # m, the least radius of a path that counts as straight
_MISSING, _WAYS = 0.02, ("left", "right", "straight")  # share of the time below which a motion was not driven


@dataclass(frozen=True)
class Finding:
    """A finding as `check --json` prints it."""

    kind: str
    what: str
    where: str
    severity: str
    fix: str

    @staticmethod
    def of(content: Mapping[str, Any]) -> Finding:
        return Finding(*(str(content.get(key) or "") for key in ("kind", "what", "where", "severity", "fix")))

    def names(self, wanted: Sequence[str]) -> bool:
        return all(name in f"{self.where} {self.what} {self.fix}" for name in wanted)


@cache
def table() -> dict[str, Any]:
    """The table of kinds and robots."""
    content: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("table.yaml").read_text())
    return content


def applies(kind: str, robot: str) -> bool:
    return isinstance(table()["kinds"][kind]["cells"][robot], list)


def right_kinds(kind: str, robot: str) -> set[str]:
    """The kinds that are right for a fault."""
    entry = table()["kinds"][kind]
    return {kind, *entry.get("same", ()), *entry["cells"][robot]}


def known_kinds(robot: str) -> set[str]:
    """Kinds that are true of the untouched recordings, or open."""
    entry = table()["robots"][robot]
    return {kind for kind, why in (entry["known"] | entry["open"]).items() if isinstance(why, str)}


def _known_of_a_run(finding: Finding, robot: str) -> bool:
    """True if a finding is known of a run that it names."""
    known = table()["robots"][robot]["known"].get(finding.kind)
    return isinstance(known, dict) and finding.names([known["run"]])


def false_findings(findings: Sequence[Finding], recording: Recording) -> list[Finding]:
    """The findings of an untouched recording, or a part of one, that are not true of it."""
    allowed = known_kinds(recording.robot)
    commands = Counter(run.command for run in recording.runs)
    if len(recording.runs) <= _OPEN_RUNS:
        allowed |= {"few_runs"}
    if min(commands.values()) < 3:
        allowed |= {"few_repetitions"}
    missing = min(driven(recording).values()) < _MISSING
    return [
        finding
        for finding in findings
        if finding.kind not in allowed
        and not _known_of_a_run(finding, recording.robot)
        and not (finding.kind == "motion_missing" and (missing or finding.severity == "note"))
    ]


def driven(recording: Recording) -> dict[str, float]:
    """The shares of the time in which the robot turned left, right and went straight."""
    body = np.vstack([windows(recording, run)[1] for run in recording.runs])
    turn, speed = lever(recording) * body[:, 2], np.hypot(body[:, 0], body[:, 1])
    moving = np.hypot(turn, speed) > 0.1 * np.percentile(np.hypot(turn, speed), 90)
    straight = moving & (np.abs(body[:, 2]) * max(10 * lever(recording), _STRAIGHT) < speed)
    shares = (moving & ~straight & (turn > 0), moving & ~straight & (turn < 0), straight)
    return {way: float(share.mean()) for way, share in zip(_WAYS, shares, strict=True)}


def unsound(kind: str, damage: Damage, mended: Recording) -> str:
    """What is wrong with the recording that a fix made; empty if it is sound."""
    sound = damage.sound
    kept = sum(run.seconds for run in mended.runs) / sum(run.seconds for run in sound.runs)
    if kept < (_KEPT if kind in _SPOILT else _KEPT_WHOLE) or kept > 1.1:
        return f"{100 * kept:.0f} % of the seconds are there"
    there = {run.name.partition("#")[0] for run in mended.runs}  # parts of a run that was cut have a number
    same = sound.of([run for run in sound.runs if file_name(run) in there] or list(sound.runs))
    for names in {(), damage.named}:  # all runs, and those that were spoilt
        before, after = (misfit(_named(recording, names)) for recording in (same, mended))
        if not after <= _WORSE * before + _MARGIN and math.isfinite(before):
            return f"misfit {after:.3f}, sound {before:.3f}"
    lengths = [
        _length(other) / _length(run)
        for run in sound.runs
        for other in mended.runs
        if other.name == file_name(run) and other.seconds > 0.95 * run.seconds and _length(run) > 0.1
    ]
    if lengths and not abs(math.log(float(np.median(lengths)))) < _LENGTH:
        return f"paths are {float(np.median(lengths)):.3g} times as long"
    if kind == "time_unit":
        periods = [float(np.median(np.diff(run.times))) for run in (sound.runs[0], mended.runs[0])]
        if not 0.95 < periods[1] / periods[0] < 1.05:
            return f"sample period {periods[1]:.3g} s, sound {periods[0]:.3g} s"
    return _late(sound, mended) if kind in _CLOCKS else ""


def _named(recording: Recording, names: Sequence[str]) -> Recording:
    """The runs with one of the names in theirs; all where no run has one, as where it was left out."""
    runs = [run for run in recording.runs if any(name in run.name for name in names)]
    return recording.of(runs or list(recording.runs))


def _length(run: Run) -> float:
    times = np.arange(run.pose_times[0], run.pose_times[-1], 0.5)
    x, y = (np.interp(times, run.pose_times, column) for column in run.poses.T[:2])
    return float(np.hypot(np.diff(x), np.diff(y)).sum()) if len(times) > 1 else 0.0


def _late(sound: Recording, mended: Recording) -> str:
    """What is wrong with the clocks of a mended recording; empty where they are as good as the sound one's."""
    left = {}
    matrix = sound.forward if sound.steered else fitted_matrix(sound)
    for name, recording in (("sound", sound), ("mended", mended)):
        clocks = [clock(recording, run, matrix) for run in recording.runs]
        left[name] = [each.farthest for each in clocks if each is not None and each.contrast > _SURE]
    if not left["mended"]:
        return "" if not left["sound"] else "no clock can be measured any more"
    usual, remaining = (float(np.median(left[name] or [0.0])) for name in ("sound", "mended"))
    if remaining > max(_CLOCK_LEFT, usual + _CLOCK_MORE):
        return f"clocks are {remaining:.2f} s off, {usual:.2f} s in the sound recording"
    return ""
