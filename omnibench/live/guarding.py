"""The guard at work: on a recording, its runs one after another, and in a node while the robot drives."""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise
from typing import Final

import numpy as np
from pydantic import Field

from omnibench.config import Model
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.errors import DataError, require_type
from omnibench.live.guard import LEAST_POSES, Guard
from omnibench.live.health import Alarm, GuardHealth, Proposal
from omnibench.live.stretches import Stretch
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.robot.calibration import Calibration
from omnibench.robot.effects.effect import ReferenceEffect
from omnibench.robot.kinematics import Array, usable_covariances
from omnibench.words import plural

_REFITTED: Final = 0.5  # share of a change by which its refitted value may differ; chosen


class GuardReport(Model):
    """The guard's answer on a recording. metres, seconds: watched between poses, standing included.

    proposed: the calibration with the changes that were accepted, each refitted to the final poses of the runs since.
    """

    alarms: tuple[Alarm, ...]
    proposals: tuple[Proposal, ...]
    metres: float
    seconds: float
    proposed: Calibration | None = Field(None, exclude=True)


def watch_recording(
    calibration: Calibration, dataset: Dataset, watch: Reporter = no_progress
) -> tuple[GuardReport, Guard]:
    """Let a guard watch all runs of a data set, sessions in their order; its report, and the guard.

    DataError: the wheels differ, no run has reference poses, or the recordings lack what an effect needs.
    """
    from scipy.optimize import minimize_scalar

    from omnibench.fit.evaluate import final_errors  # which a node does without
    from omnibench.live.drive import in_order

    require_type(calibration, Calibration, "read_calibration")
    require_type(dataset, Dataset, "load_dataset")
    calibration.check_wheels(dataset.robot, f"the data set {dataset.name}")
    ordered = in_order(run for run in dataset.trajectories if run.has_poses)
    if not ordered:
        raise DataError(f"data set {dataset.name}: no run has two reference poses, between which motion is compared")
    guard = Guard(calibration)
    for number, run in enumerate(ordered, 1):
        _watch_run(guard, run)
        watch(Progress("guard", number, len(ordered), "run", note=plural(len(guard.alarms), "alarm")))
    guard.end()
    # Refit what was accepted, Eq. (6) of Palacin et al. 2023 over the runs since the change.
    changes = guard.accepted
    for name in changes:
        number = max(k for k, each in enumerate(guard.proposals) if each.name == name and each.accepted)
        proposal = guard.proposals[number]
        since = ordered[[run.id for run in ordered].index(proposal.since) :]

        def cost(value: float, name: str = name, since: list[Trajectory] = since) -> float:
            changed = guard.proposed(changes | {name: value})
            assert changed is not None
            return float(np.linalg.norm(final_errors(changed.model, since), axis=1).mean())

        reach = _REFITTED * abs(changes[name])
        bounds = changes[name] - reach, changes[name] + reach
        refitted = float(minimize_scalar(cost, bounds=bounds, method="bounded").x)
        value = proposal.value + refitted - changes[name]
        guard.proposals[number] = proposal.model_copy(update={"value": value, "low": None, "high": None})
        changes[name] = refitted
    report = GuardReport(
        alarms=tuple(guard.alarms),
        proposals=tuple(guard.proposals),
        metres=guard.metres,
        seconds=guard.seconds,
        proposed=guard.proposed(changes),
    )
    return report, guard


def _watch_run(guard: Guard, run: Trajectory) -> None:
    """Let a guard watch a run from its first reference pose to its last."""
    calibration = guard.calibration
    stream = calibration.model.stream(run.start, calibration.session, run.started_at or 0.0)
    durations = np.diff(run.times, prepend=0.0)
    rates, angles, steering = run.rates, run.angles, run.steering
    moved, driven = np.zeros((len(durations), 3)), np.zeros((len(durations), calibration.matrix_array.shape[1]))
    for k, duration in enumerate(durations.tolist()):
        stream.drive(
            rates[k] * duration,
            duration,
            None if angles is None else angles[k],
            None if steering is None else steering[k],
        )
        moved[k], driven[k] = stream.moved, stream.driven
    # The reference without the calibration's effects on it, at poses that are far enough apart.
    stamps, poses, covariances = run.pose_times, run.poses, run.pose_covariances
    for term in reversed(calibration.model.reference_terms):
        assert isinstance(term.effect, ReferenceEffect)
        stamps = np.maximum(stamps - term.effect.delays(stamps, term.values)[0], 0.0)
        poses = term.effect.corrected(poses, run.start, term.values)
    chosen = [0]
    for k in range(1, len(stamps)):
        if stamps[k] - stamps[chosen[-1]] >= LEAST_POSES and stamps[k] <= run.times[-1]:
            chosen.append(k)
    if covariances is not None and not usable_covariances(covariances[chosen]).all():
        covariances = None
    guard.begin(poses[0], None if covariances is None else covariances[0])
    for previous, k in pairwise(chosen):
        since, until = float(stamps[previous]), float(stamps[k])
        stretch = _between(guard, run.times, durations, moved, driven, since, until)
        guard.take(stretch, poses[k], (run.id, until), None if covariances is None else covariances[k])


def _between(
    guard: Guard, ends: Array, durations: Array, moved: Array, driven: Array, since: float, until: float
) -> Stretch:
    """The stretch from one time to another, s, of samples with these ends (n,), in parts at constant twist."""
    begins = ends - durations
    part = slice(int(np.searchsorted(ends, since, side="right")), int(np.searchsorted(begins, until)))
    seconds = np.minimum(ends[part], until) - np.maximum(begins[part], since)
    share = (seconds / durations[part])[:, None]
    return guard.predictor.stretch(moved[part] * share, driven[part] * share, seconds)


_MOST_SAMPLES: Final = 100_000  # that wait for a pose: 1000 s at 100 Hz; chosen
_AHEAD: Final = 2.0  # s: a pose that is farther ahead of the wheel samples has no meaning; chosen
_ROUNDING: Final = 1e-6  # s
_MOST_TOLD: Final = 5  # alarms and proposals in a health; chosen
_MOST_ALARMS: Final = 1000  # that are remembered; chosen
_MOST_POSES: Final = 1000  # that wait to be judged; chosen
_SECOND: Final = 1e9  # ns


class LiveGuard:
    """The guard of one robot in a node. ``add`` and ``pose`` only note; ``judge`` works, in a thread that may be slow.

    The caller holds a lock around ``add``, ``pose`` and ``take``, and calls ``judge`` without it.
    """

    def __init__(self, robot: str, calibration: Calibration) -> None:
        self.robot, self.guard = robot, Guard(calibration)
        self._samples: deque[tuple[int, float, Array, Array]] = deque(maxlen=_MOST_SAMPLES)
        self._poses: deque[tuple[int, Array, Array]] = deque(maxlen=_MOST_POSES)
        self._last: int | None = None  # stamp of the last pose that was judged, ns; None: the next one begins a run
        self._restart = False
        self._noted: int | None = None  # stamp of the last pose that was noted, ns
        self._told_until = 0.0  # s, when the last alarm was told
        self._driven_with: dict[str, float] = {}

    def add(self, stamp: int, duration: float, moved: Array, driven: Array) -> None:
        """Note a wheel sample: its end, ns, duration, s, motion (3,) of the tracked point and signals (M,)."""
        if duration > 0:
            self._samples.append((stamp, duration, moved, driven))

    def pose(self, stamp: int, pose: Array, covariance: Array) -> None:
        """Note a reference pose (3,) of the tracked point, with its covariance (3, 3)."""
        if self._noted is not None and 0 <= stamp - self._noted < LEAST_POSES * _SECOND:
            return
        if self._samples and stamp - self._samples[-1][0] > _AHEAD * _SECOND:
            return
        self._noted = stamp
        self._poses.append((stamp, pose, covariance))

    def restart(self) -> None:
        """Begin again at the next pose: motion or times before it are not known."""
        self._samples.clear()
        self._poses.clear()
        self._restart, self._noted = True, None

    def take(self) -> tuple[list[tuple[int, float, Array, Array]], list[tuple[int, Array, Array]], bool]:
        """The samples and the poses that can be judged now, which are forgotten, and whether a run begins."""
        newest = self._samples[-1][0] if self._samples else None
        poses = []
        while self._poses and newest is not None and self._poses[0][0] <= newest:
            poses.append(self._poses.popleft())
        samples = list(self._samples) if poses else []
        while poses and self._samples and self._samples[0][0] <= poses[-1][0]:
            self._samples.popleft()
        restarted, self._restart = self._restart, False
        return samples, poses, restarted

    def judge(
        self, samples: list[tuple[int, float, Array, Array]], poses: list[tuple[int, Array, Array]], restarted: bool
    ) -> list[str]:
        """Judge what ``take`` gave; what is new, in words: alarms, and proposals that were decided."""
        if restarted:
            self._last = None
        if not poses:
            return []
        origin = samples[0][0]
        ends = np.array([(stamp - origin) / _SECOND for stamp, *_ in samples])
        durations = np.array([duration for _, duration, _, _ in samples])
        moved, driven = (np.array([sample[k] for sample in samples]) for k in (2, 3))
        guard = self.guard
        names, before = {alarm.name for alarm in guard.alarms}, tuple(guard.proposals)
        for stamp, pose, covariance in poses:
            since = -math.inf if self._last is None else (self._last - origin) / _SECOND
            until = (stamp - origin) / _SECOND
            if not ends[0] - durations[0] - _ROUNDING <= since < until:  # samples are missing, or it is an old pose
                self.guard.begin(pose, covariance)
            else:
                stretch = _between(self.guard, ends, durations, moved, driven, since, until)
                self.guard.take(stretch, pose, (self.robot, stamp / _SECOND), covariance)
            self._last = stamp
        new = [alarm for alarm in guard.alarms if alarm.name not in names or alarm.t > self._told_until]
        self._told_until = max((alarm.t for alarm in guard.alarms), default=self._told_until)
        decided = [each for each in guard.proposals if each.accepted is not None and each not in before]
        if len(guard.alarms) > _MOST_ALARMS and guard.settled:
            del guard.alarms[: -_MOST_ALARMS // 2]
        return [f"{alarm.kind} {alarm.sentence}" for alarm in new] + [each.sentence for each in decided]

    def changes_to_drive_with(self) -> dict[str, float] | None:
        """The accepted changes, if the robot does not drive with them yet; else None."""
        accepted = self.guard.accepted
        return None if accepted == self._driven_with else accepted

    def drives_with(self, changes: dict[str, float]) -> None:
        """Take it that the samples that come hold these changes."""
        self._driven_with = changes
        self.guard.drives_with(changes)

    def health(self) -> GuardHealth:
        """Its part of the robot's health."""
        guard, alarms, proposals = self.guard, tuple(self.guard.alarms), tuple(self.guard.proposals)
        last = {each.name: each for each in proposals} if guard.settled else {}
        cured = {*self._driven_with, *(name for name, each in last.items() if each.passed)}
        lasting = [alarm for alarm in alarms if alarm.kind in ("change", "fault") and alarm.name not in cured]
        message = f"nothing changed in {guard.metres:.0f} m"
        if self._driven_with:
            message = f"drives with other {', '.join(self._driven_with)} than calibrated; {message} but that"
        if lasting:
            message = lasting[-1].sentence
            if guard.accepted:
                message += "; a calibration with that value predicts better"
        return GuardHealth(
            changed=bool(lasting),
            message=message,
            metres=guard.metres,
            alarms=alarms[-_MOST_TOLD:],
            proposals=proposals[-_MOST_TOLD:],
        )
