"""Fusion of SLAM poses with odometry, each at its own time.

A pose that comes late is inserted where it belongs, and the motions and poses after it are filtered again. A gate
refuses poses whose normalised innovation is too large; several refused poses that agree replace the filter's.

The timeline holds a robot's last seconds: its motions, the poses after them, and poses measured in between, corrected.
A message that cannot be a pose in the map is refused and counted.
"""

from __future__ import annotations

import logging
import math
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from pydantic import Field
from scipy.special import gammaincinv

from omnibench.config import Model, Positive
from omnibench.live.health import Counts
from omnibench.live.odometry import UNKNOWN_NOISE, Motion, RobotCentre, carried
from omnibench.live.wire import POSE_ESTIMATE, MessageError, PoseEstimate, arrival_stamp
from omnibench.robot.calibration import Calibration
from omnibench.robot.effects.effect import ReferenceEffect, Values
from omnibench.robot.kinematics import Array, Mount, compose, pose_covariance, relative, usable_covariances
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import advance

_SECOND = 1e9  # ns
_MOST_A_SECOND = 2000  # samples that are kept, whatever the stamps say, so that wrong ones cannot fill the memory


@dataclass(frozen=True, slots=True, eq=False)
class PoseMeasurement:
    """Measurement of a pose (3,) in the map, m, m, rad, at ``stamp`` (ns), with its covariance (3, 3).

    arrival: s, monotonic. absolute: it replaces the filter's pose instead of correcting it. heading_stamp: when its
    heading was measured (ns), if that is another time. mount: the point of the robot that it is of; None: its centre.
    """

    stamp: int
    pose: Array
    covariance: Array
    arrival: float = 0.0
    absolute: bool = False
    heading_stamp: int | None = None
    mount: Mount | None = None

    @property
    def latest(self) -> int:
        """The later of its two times, ns: from there on odometry is known for all of it."""
        return self.stamp if self.heading_stamp is None else max(self.stamp, self.heading_stamp)

    @property
    def earliest(self) -> int:
        """The earlier of its two times, ns."""
        return self.stamp if self.heading_stamp is None else min(self.stamp, self.heading_stamp)


class Estimate(NamedTuple):
    """Pose (3,) in the map, m, m, rad, the heading not wrapped, with its covariance (3, 3)."""

    pose: Array
    covariance: Array


@dataclass(slots=True, eq=False)
class Entry:
    """One wheel sample: the motion up to it, and after it odometry's pose (3,) and the filter's estimate.

    measurements: poses whose time lies within the motion, in the order of time.
    """

    stamp: int
    motion: Motion
    odometry: Array
    estimate: Estimate
    measurements: tuple[PoseMeasurement, ...] = ()


class Timeline:
    """Entries of at least the last ``seconds`` (up to 2 kHz), by stamp; one at least, once one was added."""

    def __init__(self, seconds: float) -> None:
        self._length = int(seconds * _SECOND)
        self._most = int(seconds * _MOST_A_SECOND)
        self.entries: list[Entry] = []
        self._stamps: list[int] = []

    @property
    def oldest(self) -> int:
        return self._stamps[0]

    @property
    def newest(self) -> int:
        return self._stamps[-1]

    def append(self, entry: Entry) -> None:
        """Add the newest entry and forget what is too old."""
        self.entries.append(entry)
        self._stamps.append(entry.stamp)
        first = 0
        if self._stamps[0] < entry.stamp - 2 * self._length:  # seldom, and then many at once, which is fast
            first = bisect_left(self._stamps, entry.stamp - self._length) - 1
        elif len(self._stamps) > 2 * self._most:
            first = self._most
        if first > 0:
            del self.entries[:first], self._stamps[:first]

    def restart(self, stamp: int) -> None:
        """Keep the newest entry alone, at another stamp: the clock jumped, and the times before have no meaning."""
        newest = self.entries[-1]
        newest.stamp, newest.measurements = stamp, ()
        self.entries, self._stamps = [newest], [stamp]

    def index(self, stamp: int) -> int:
        """The first entry at or after ``stamp``; as many as there are entries where there is none."""
        return bisect_left(self._stamps, stamp)

    def share(self, index: int, stamp: int) -> float:
        """Share (0 to 1) of an entry's motion that lies before ``stamp``."""
        begin, end = self._stamps[index - 1], self._stamps[index]
        return (stamp - begin) / (end - begin)

    def odometry_at(self, stamp: int) -> Array | None:
        """Odometry's pose (3,) at a time (ns), between samples at constant twist; None outside the timeline."""
        index = self.index(stamp)
        if not self.entries or index == len(self.entries) or stamp < self.oldest:
            return None
        entry = self.entries[index]
        if entry.stamp == stamp:
            return np.array(entry.odometry)
        part = entry.motion.part(self.share(index, stamp))
        return advance(self.entries[index - 1].odometry, part.moved, part.integration)


class ReferenceCorrection:
    """Undoes a model's effects of the reference.

    start: the first pose of a run, from which some effects act on; None: the next pose that comes.
    """

    def __init__(self, model: OdometryModel, start: PoseMeasurement | None = None) -> None:
        self._mount = model.robot.mount
        self._terms: list[tuple[ReferenceEffect, Values]] = [
            (term.effect, term.values) for term in model.reference_terms if isinstance(term.effect, ReferenceEffect)
        ]
        self.start = start

    def corrected(self, measurement: PoseMeasurement) -> PoseMeasurement:
        """The tracked point's true pose when its position was measured; its heading may be of another time."""
        if self.start is None:
            self.start = measurement
        if self._mount is not None:
            measurement = replace(measurement, mount=self._mount)
        if not self._terms:
            return measurement
        stamps = np.array([(measurement.stamp - self.start.stamp) / _SECOND])
        delays = [effect.delays(stamps, values) for effect, values in self._terms]
        of_position, of_heading = (sum(float(delay[kind][0]) for delay in delays) for kind in range(2))
        poses = measurement.pose[None]
        for effect, values in reversed(self._terms):
            poses = effect.corrected(poses, self.start.pose, values)
        return replace(
            measurement,
            stamp=measurement.stamp - round(_SECOND * of_position),
            heading_stamp=measurement.stamp - round(_SECOND * of_heading),
            pose=np.array(poses[0]),
        )


_TURN = 2 * math.pi
_POSE = np.eye(3)  # measurement matrix: SLAM measures the pose itself


def predict(estimate: Estimate, motion: Motion) -> Estimate:
    """Extended Kalman filter: the estimate after a motion, P <- F P F^T + Q."""
    before, after = estimate.pose, advance(estimate.pose, motion.moved, motion.integration)
    (x, y, _), (to_x, to_y, _) = before.tolist(), after.tolist()
    position, heading = motion.position_variance, motion.heading_variance
    # F, derivative of the pose after the motion by the pose before; Q, noise of the motion
    derivative = np.array([[1.0, 0.0, y - to_y], [0.0, 1.0, to_x - x], [0.0, 0.0, 1.0]])
    noise = np.array([[position, 0.0, 0.0], [0.0, position, 0.0], [0.0, 0.0, heading]])
    return Estimate(after, derivative.dot(estimate.covariance).dot(derivative.T) + noise)


def correct(estimate: Estimate, pose: Array, covariance: Array) -> Estimate:
    """Extended Kalman filter: the estimate corrected by a measured pose (3,) with its covariance (3, 3)."""
    ekf: Any = ExtendedKalmanFilter(dim_x=3, dim_z=3)
    ekf.x, ekf.P = estimate
    ekf.update(pose, lambda _: _POSE, lambda x: x, R=covariance, residual=innovation_of)
    return Estimate(ekf.x, ekf.P)


def innovation_of(measured: Array, expected: Array) -> Array:
    """Innovation (3,): measured minus expected pose, the heading the shortest way."""
    difference: Array = measured - expected
    difference[2] -= _TURN * round(float(difference[2]) / _TURN)
    return difference


def squared_distance(pose: Array, expected: Array, covariance: Array) -> float:
    """Squared Mahalanobis distance of two poses whose difference has a covariance: in theory chi2 with 3 degrees."""
    innovation = innovation_of(pose, expected)
    return float(innovation @ np.linalg.solve(covariance, innovation))


_NOWHERE = np.diag([100.0**2, 100.0**2, math.pi**2])  # m, rad: covariance before the robot is located; chosen
_WAITING = 16  # poses that may wait for the wheel samples of their time; chosen
_EVER = -(2**63)  # ns, before every stamp
# Covariance of odometry's error from one rejected pose to another, m, rad; chosen.
_DRIFT = np.diag([0.1**2, 0.1**2, 0.1**2])

Outcome = Literal["fused", "located", "reacquired", "rejected", "too late", "ahead", "waiting", "duplicate"]


class FusionSettings(Model):
    """Settings of the fusion of SLAM poses."""

    history: float = Field(5.0, ge=2.0, le=600.0, description="how late a pose may come, s")
    ahead: float = Field(1.0, ge=0.0, le=60.0, description="how far its stamp may lie in the future, s")
    gate: float = Field(0.999, gt=0.0, lt=1.0, description="probability with which a correct pose passes")
    reacquire_after: int = Field(
        10, ge=1, description="rejected poses that agree with each other: then SLAM is believed"
    )
    standstill: float = Field(0.01, gt=0.0, le=1.0, description="share of the wheels' noise while none turns")
    pose_sigma: tuple[Positive, Positive] | None = Field(
        None,
        description="m and deg, standard deviations of poses whose covariance is unknown (0, negative, NaN, huge); "
        "default: the calibration's",
    )
    stamps: Literal["header", "arrival"] = Field("header", description="arrival: as wheels.stamps, for SLAM's poses")
    stale_after: float = Field(2.0, gt=0.0, description="no pose for so long makes the health degraded, s")


class Fusion:
    """Pose of one robot in the map, by a Kalman filter over its timeline.

    estimate: now; ``predict`` brings it to the next sample. located: True once a pose or an order has said where the
    robot is. outcome: of the pose that was taken last. fused_at: arrival of the last pose that was fused, s, monotonic;
    None since a reset. rejected_in_a_row: poses that the gate rejected since one was fused.
    """

    def __init__(self, settings: FusionSettings, timeline: Timeline, counts: Counts) -> None:
        self.settings = settings
        self._timeline = timeline
        self._counts = counts
        self.estimate = Estimate(np.zeros(3), _NOWHERE)
        self._limit = 2.0 * float(gammaincinv(3 / 2, settings.gate))  # quantile of chi2 with 3 degrees of freedom
        # The latest rejected poses, with odometry's poses (3,) at their times; enough that agree are believed
        self._rejected: deque[tuple[PoseMeasurement, Array]] = deque(maxlen=settings.reacquire_after)
        self.rejected_in_a_row = 0
        self._waiting: deque[PoseMeasurement] = deque()
        self._since = _EVER  # ns; poses measured before are too late, as the pose was set then
        self.located = False
        self.outcome: Outcome | None = None
        self.fused_at: float | None = None

    def take_waiting(self) -> None:
        """Fuse the poses that came before the wheel samples of their time, if these are there now."""
        if self._waiting and min(measurement.latest for measurement in self._waiting) <= self._timeline.newest:
            waiting, self._waiting = self._waiting, deque()
            for measurement in waiting:
                self.correct(measurement)

    def correct(self, measurement: PoseMeasurement) -> Outcome:
        """Fuse a pose at its own time, or refuse it; every outcome is counted."""
        self.outcome = self._refused(measurement) or self._fused_or_rejected(self._at_one_time(measurement))
        if self.outcome in ("fused", "located", "reacquired"):
            self._counts.poses += 1
            self._forget_rejected()
            self.fused_at = measurement.arrival
        return self.outcome

    def set_pose(self, pose: Array, covariance: Array) -> None:
        """Set the pose now; poses that were measured before are not fused any more."""
        self.estimate, self.located = Estimate(pose, covariance), True
        if self._timeline.entries:
            self.restart(self._timeline.newest + 1)
            self._timeline.entries[-1].estimate = self.estimate

    def reset(self) -> None:
        """Forget where the robot is; the next pose of SLAM locates it."""
        self.set_pose(self.estimate.pose, _NOWHERE)
        self.located, self.outcome, self.fused_at = False, None, None

    def restart(self, since: int = _EVER) -> None:
        """Forget the poses that wait or were rejected, and take none that was measured before a time, ns."""
        self._waiting.clear()
        self._forget_rejected()
        self._since = since

    def at(self, stamp: int) -> Estimate | None:
        """The estimate at a time (ns), between samples at constant twist; None outside the timeline."""
        entries, index = self._timeline.entries, self._timeline.index(stamp)
        if not entries or index == len(entries) or stamp < self._timeline.oldest:
            return None
        return entries[index].estimate if entries[index].stamp == stamp else self._within(index, stamp)

    def _refused(self, measurement: PoseMeasurement) -> Outcome | None:
        """Why a pose's stamp does not let it be fused now; None if it can be."""
        timeline = self._timeline
        if not timeline.entries or measurement.latest > timeline.newest:
            ahead = (measurement.latest - timeline.newest) / _SECOND if timeline.entries else 0.0
            if ahead > self.settings.ahead or len(self._waiting) >= _WAITING:
                self._counts.pose_ahead += 1
                return "ahead"
            self._waiting.append(measurement)
            return "waiting"
        if measurement.earliest < timeline.oldest or measurement.stamp < self._since:
            self._counts.pose_too_late += 1
            return "too late"
        taken = timeline.entries[timeline.index(measurement.stamp)].measurements
        if measurement.stamp in {earlier.stamp for earlier in (*taken, *(pose for pose, _ in self._rejected))}:
            self._counts.pose_duplicates += 1
            return "duplicate"
        return None

    def _at_one_time(self, measurement: PoseMeasurement) -> PoseMeasurement:
        """The centre's pose, its heading turned by odometry to the time of its position if it is of another."""
        pose, covariance = measurement.pose, measurement.covariance
        if measurement.heading_stamp is not None:
            before = self._timeline.odometry_at(measurement.heading_stamp)
            after = self._timeline.odometry_at(measurement.stamp)
            assert before is not None
            assert after is not None
            pose = pose + np.array([0.0, 0.0, after[2] - before[2]])
        if measurement.mount is not None:
            tracked, pose = pose, RobotCentre(measurement.mount).pose(pose)
            covariance = carried(covariance, (pose - tracked)[:2])
        return replace(measurement, pose=pose, covariance=covariance, heading_stamp=None, mount=None)

    def _fused_or_rejected(self, measurement: PoseMeasurement) -> Outcome:
        """Fuse a pose whose time is within the timeline, or reject it by the gate."""
        index = self._timeline.index(measurement.stamp)
        if not self.located:
            self._replace(index, measurement)
            self.located = True
            return "located"
        expected, covariance = self._within(index, measurement.stamp)
        if squared_distance(measurement.pose, expected, covariance + measurement.covariance) <= self._limit:
            self._insert(index, measurement)
            return "fused"
        odometry = self._timeline.odometry_at(measurement.stamp)
        assert odometry is not None
        self.rejected_in_a_row += 1
        self._rejected.append((measurement, odometry))
        # SLAM is believed if all of enough rejected poses, moved by odometry from their times on, are this one.
        if len(self._rejected) == self._rejected.maxlen and all(
            squared_distance(
                measurement.pose,
                compose(earlier.pose, relative(before, odometry)),
                measurement.covariance + earlier.covariance + _DRIFT,
            )
            <= self._limit
            for earlier, before in self._rejected
        ):
            self._replace(index, measurement)
            self._counts.reacquired += 1
            return "reacquired"
        self._counts.pose_rejected += 1
        return "rejected"

    def _forget_rejected(self) -> None:
        self._rejected.clear()
        self.rejected_in_a_row = 0

    def _replace(self, index: int, measurement: PoseMeasurement) -> None:
        """Set the estimate to a pose; the other poses of its entry and of later ones are forgotten."""
        for entry in self._timeline.entries[index:]:
            entry.measurements = ()
        self._insert(index, replace(measurement, absolute=True))

    def _insert(self, index: int, measurement: PoseMeasurement) -> None:
        """Add a pose to its entry, and filter it and what came after it again."""
        entries = self._timeline.entries
        entry = entries[index]
        entry.measurements = tuple(sorted((*entry.measurements, measurement), key=lambda one: one.stamp))
        if index == 0:  # the motion up to the oldest entry is not known: its pose is corrected as it is
            entry.estimate = _corrected(entry.estimate, measurement)
        for number in range(max(index, 1), len(entries)):
            later = entries[number]
            later.estimate = (
                self._within(number, later.stamp)
                if later.measurements
                else predict(entries[number - 1].estimate, later.motion)
            )
        self.estimate = entries[-1].estimate

    def _within(self, index: int, stamp: int) -> Estimate:
        """The estimate at a time (ns) within an entry's motion, corrected by the entry's poses up to then."""
        if index == 0:
            return self._timeline.entries[0].estimate
        entry, estimate, done = self._timeline.entries[index], self._timeline.entries[index - 1].estimate, 0.0
        poses = [measurement for measurement in entry.measurements if measurement.stamp <= stamp]
        for measurement in (*poses, None):
            share = self._timeline.share(index, stamp if measurement is None else measurement.stamp)
            if share > done:
                estimate, done = predict(estimate, entry.motion.part(share - done)), share
            if measurement is not None:
                estimate = _corrected(estimate, measurement)
        return estimate


def _corrected(estimate: Estimate, measurement: PoseMeasurement) -> Estimate:
    """The estimate corrected by a pose, or replaced."""
    if measurement.absolute:
        return Estimate(measurement.pose, measurement.covariance)
    return correct(estimate, measurement.pose, measurement.covariance)


LOG = logging.getLogger("omnibench.live")
_FARTHEST = 1e7  # m; chosen: no robot drives as far from its map's origin


class PoseInput:
    """Reads geometry_msgs/PoseWithCovarianceStamped messages whose poses are in the frame ``frame``."""

    def __init__(self, frame: str, settings: FusionSettings, counts: Counts) -> None:
        self._frame = frame
        self._settings = settings
        self._counts = counts

    def read(
        self, payload: bytes, arrival: float, calibration: Calibration, *, replayed: bool = False
    ) -> PoseMeasurement:
        """The measurement in a payload that came at ``arrival`` (s, monotonic). MessageError: why it is refused.

        calibration: its noise model gives the covariance of a pose that comes without one, unless the settings do.
        replayed: its stamp counts in any case.
        """
        try:
            message = POSE_ESTIMATE.decode(payload)
        except MessageError:
            self._counts.pose_undecodable += 1
            raise
        fault = ""
        if message.frame not in ("", self._frame):
            fault = f"the pose is in frame {message.frame!r}, not in {self._frame!r}"
        elif not np.isfinite(message.pose).all():
            fault = "the pose is not finite"
        elif np.abs(message.pose[:2]).max() > _FARTHEST:
            fault = f"the pose lies {np.abs(message.pose[:2]).max():.3g} m away"
        if fault:
            self._counts.pose_invalid += 1
            raise MessageError(fault)
        by_arrival = self._settings.stamps == "arrival" and not replayed
        stamp = arrival_stamp(arrival) if by_arrival else message.stamp
        return PoseMeasurement(stamp, message.pose, self._covariance(message, calibration), arrival)

    def _covariance(self, message: PoseEstimate, calibration: Calibration) -> Array:
        """The covariance (3, 3) of a message, or the default where that says that it is unknown, with a warning."""
        if usable_covariances(message.covariance):
            return message.covariance
        sigma = self._settings.pose_sigma
        if sigma is not None:
            covariance = pose_covariance(*sigma)
        else:  # the reference's white noise and bias together, as the calibration knows them
            noise = calibration.noise or UNKNOWN_NOISE
            position = noise.pose_position**2 + noise.bias_position**2 or UNKNOWN_NOISE.pose_position**2
            heading = noise.pose_heading**2 + noise.bias_heading**2 or UNKNOWN_NOISE.pose_heading**2
            covariance = np.diag([position, position, heading])
        if not self._counts.pose_default_covariance:
            LOG.warning(
                "slam_pose: the covariance of a pose is unknown (variances %s); standard deviations of %.3g m and "
                "%.3g deg count, by %s",
                ", ".join(f"{variance:.3g}" for variance in np.diagonal(message.covariance)),
                math.sqrt(covariance[0, 0]),
                math.degrees(math.sqrt(covariance[2, 2])),
                "the calibration; `fusion: {pose_sigma: [m, deg]}` sets others" if sigma is None else "pose_sigma",
            )
        self._counts.pose_default_covariance += 1
        return covariance
