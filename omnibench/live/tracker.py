"""One robot's estimation: from the payload that a subscriber receives to the update that is published.

A wheel sample is decoded, put in order, integrated to odometry, predicts the pose in the map, is fused with the poses
of SLAM that waited for it, and is published (``take_wheels``). A pose of SLAM is decoded and checked, corrected for the
calibration's effects on the reference (latency, lever arm of the LIDAR), and fused at its own time; the changed pose is
published with the next wheel sample. There is no network here, and any thread may call.

Another calibration of the same robot takes over at the next wheel sample. A query asks where the robot was at a time of
the last seconds. The health reports status, rate, age and standard deviations. No stamp is published twice, since
listeners such as tf2 take a repeated stamp for repeated data.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from itertools import count
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from omnibench.errors import DataError, OmnibenchError
from omnibench.live.fusion import (
    Entry,
    Estimate,
    Fusion,
    FusionSettings,
    Outcome,
    PoseInput,
    ReferenceCorrection,
    Timeline,
    predict,
)
from omnibench.live.guarding import LiveGuard
from omnibench.live.health import Counts, FusionHealth, Health, Status, SwapRecord
from omnibench.live.odometry import ExtrapolationMonitor, LiveOdometry, Motion
from omnibench.live.state import RobotMemory, SavedState
from omnibench.live.topics import Frames, JointStateDecoder, Update
from omnibench.live.wheels import WheelSettings, WheelState, admit, decode
from omnibench.live.wire import MessageError
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array
from omnibench.robot.signals import of_centre
from omnibench.words import plural

LOG = logging.getLogger("omnibench.live")
_SECOND: Final = 1e9  # ns


class PublishedStamps:
    """Stamps (ns) that were published, to be told apart from those that come when the robot's clock jumps back.

    remembered: how many of the latest stamps are kept (some 80 bytes each). A stamp older than these can be published
    twice by chance, after a clock that jumped back so far.
    """

    def __init__(self, remembered: int = 120_000) -> None:
        self._remembered = remembered
        self._order: deque[int] = deque()
        self._known: set[int] = set()  # the stamps of _order, for looking up
        self._shift = 1  # ns by which the last repeated stamp was moved; a recording in a loop moves all alike

    def __len__(self) -> int:
        return len(self._order)

    def unique(self, stamp: int) -> int:
        """``stamp``, or the next free one (ns) if it was published already; the result counts as published."""
        if stamp in self._known:
            if stamp + self._shift in self._known:
                longer = count(self._shift + 1)
                self._shift = next(shift for shift in longer if stamp + shift not in self._known)
            stamp += self._shift
        if len(self._order) == self._remembered:
            self._known.remove(self._order.popleft())
        self._order.append(stamp)
        self._known.add(stamp)
        return stamp


_HISTORY = 5.0  # s of odometry that are remembered without fusion; chosen, as FusionSettings.history
_NO_ESTIMATE = Estimate(np.zeros(3), np.zeros((3, 3)))  # where there is no fusion
_RATE_WINDOW = 0.9  # s, over which samples are counted at least; below the period of the diagnostics, 1 s
_BEHIND = 0.1  # s that samples may wait; a node whose samples wait for longer cannot keep up; chosen
_SAVE_PERIOD = 0.1  # s between two saved states; chosen: a node that is killed loses no more
_SAVE_RETRY = 10.0  # s until a state that could not be written is tried again; chosen
_OTHER_ROBOT = 0.5  # share of a row's largest element; chosen: no calibration moves a matrix so far from its design


class PoseAt(NamedTuple):
    """A robot's pose at ``stamp`` (ns). odometry: pose (3,) in odom. in_map: pose (3,) and covariance (3, 3)."""

    stamp: int
    odometry: Array
    in_map: tuple[Array, Array] | None


class RobotTracker:
    """One robot: takes its samples and poses, and answers orders and questions.

    fusion: None for odometry alone. stale_after: s without wheel samples after which the stream counts as stale.
    memory: where the state outlives the node. guard: watch for changes of the robot by the poses of SLAM; swap: drive
    with those that are accepted. ConfigError: the joints that ``wheels`` names are not one for each wheel.

    calibration: the one that runs. counts: everything that was taken, refused or put right. refusals: number of
    messages that were refused for a reason. flows: flow of an acknowledged replay -> number of the next message that is
    not in the odometry. closed: it takes no more wheel samples.
    """

    def __init__(
        self,
        name: str,
        calibration: Calibration,
        *,
        wheels: WheelSettings | None = None,
        fusion: FusionSettings | None = None,
        frames: Frames | None = None,
        stale_after: float = 0.5,
        memory: RobotMemory | None = None,
        guard: bool | Literal["swap"] = False,
    ) -> None:
        self.name, self.calibration = name, calibration
        self.frames = frames or Frames()
        self.counts, self.refusals, self._last_refusal = Counts(), 0, ""
        self.flows: dict[int, int] = {}
        settings = fusion or FusionSettings()
        self._decoder = JointStateDecoder()
        self._wheels = WheelState(
            calibration.robot,
            wheels or WheelSettings(),
            calibration.sample_period,
            self.counts,
            f"robot {name!r}: wheels",
        )
        self._odometry = LiveOdometry(calibration, settings.standstill)
        self._monitor = ExtrapolationMonitor(name, calibration)
        self._guessed_angles = _wheel_angle_effects(calibration)
        self._timeline = Timeline(fusion.history if fusion else _HISTORY)
        self._fusion = Fusion(fusion, self._timeline, self.counts) if fusion else None
        self._pose_input = PoseInput(self.frames.map, settings, self.counts)
        self._reference = ReferenceCorrection(calibration.model)
        self._guarding = guard if fusion else False
        self._guard = LiveGuard(name, calibration) if self._guarding else None
        self._stamps = PublishedStamps()
        self._last_swap: SwapRecord | None = None
        self._memory = memory
        # arrival (s, monotonic) of the wheel sample after which the state is to be written; never without a memory
        self._save_due = -math.inf if memory is not None else math.inf
        self._arrival: float | None = None  # of the last wheel sample, s, monotonic
        # s, longest time that a sample had waited when it was taken, in this window and in the last whole one
        self._behind = self._behind_before = 0.0
        self._counted = (time.monotonic(), 0)  # when samples were counted last, and how many there were
        self._rate = 0.0  # Hz
        self._stale_after = stale_after
        self._state_lock = threading.Lock()  # held while the state is read or changed
        self.closed = False
        self.waiting_since: Callable[[], float | None] = lambda: None  # when the oldest that waits came, s, monotonic

    def take_wheels(self, payload: bytes, arrival: float, skipped: int = 0, *, replayed: bool = False) -> list[Update]:
        """Take a sensor_msgs/JointState in CDR; its updates, in order.

        Mostly there is one; none while a sample is refused or has to be confirmed. arrival: s, monotonic. skipped:
        messages before it that never came, by the sender's numbers. replayed: its stamp counts in any case.
        """
        with self._state_lock:
            if self.closed:
                return []
            wheels, odometry, fusion, timeline = self._wheels, self._odometry, self._fusion, self._timeline
            # 1. Decode the message; what cannot be of this robot's wheels is refused.
            try:
                message = self._decoder.decode(payload)
            except MessageError as error:
                self.counts.undecodable += 1
                self._refused(str(error))
                return []
            reading = decode(message, arrival, wheels, skipped, replayed=replayed)
            # 2. Put it in order, and tell how the wheels turned since the last sample.
            steps = [] if reading is None else admit(reading, wheels)
            if wheels.refusal:
                self._refused(wheels.refusal)
            updates = []
            for step in steps:
                # 3. Integrate odometry and its covariance.
                if self._guessed_angles and step.positions is None:
                    acts = f"{self.name}: {self._guessed_angles} acts by wheel angles"
                    LOG.warning("%s, and the messages tell none: they are counted from 0, at a guess", acts)
                    self._guessed_angles = ""
                if fusion is not None and fusion.located:
                    odometry.set_odom_heading(float(fusion.estimate.pose[2] - odometry.pose[2]))
                motion = odometry.step(step)
                if self._monitor.seconds is not None:
                    self._monitor.take(step, odometry.driven)
                if self._guard is not None:
                    if step.blind or motion.restarted:
                        self._guard.restart()
                    else:
                        self._guard.add(motion.stamp, motion.duration, odometry.tracked_motion, odometry.driven)
                # 4. Predict the pose in the map.
                if motion.restarted and timeline.entries:
                    # the clock jumped: the motion counts as if it ended at the new time, and times before it have no
                    # meaning
                    timeline.restart(motion.stamp - round(motion.duration * _SECOND))
                    if fusion is not None:
                        fusion.restart()
                estimate = _NO_ESTIMATE
                if fusion is not None:
                    estimate = fusion.estimate = predict(fusion.estimate, motion)
                timeline.append(Entry(motion.stamp, motion, odometry.pose, estimate))
                # 5. Fuse the poses of SLAM that waited for this time.
                if fusion is not None:
                    fusion.take_waiting()
                # 6. Publish the estimates at the stamp of the sample.
                updates.append(
                    Update(
                        self._stamps.unique(motion.stamp),
                        odometry.pose,
                        odometry.covariance,
                        odometry.twist,
                        odometry.twist_covariance,
                        None if fusion is None else fusion.estimate,
                    )
                )
            if updates:
                self._arrival = arrival
                if arrival >= self._save_due:
                    self._save()
            return updates

    def take_pose(self, payload: bytes, arrival: float, *, replayed: bool = False) -> Outcome | None:
        """Take a geometry_msgs/PoseWithCovarianceStamped in CDR; None: it is invalid, or there is no fusion."""
        with self._state_lock:
            if self._fusion is None:
                return None
            try:
                measurement = self._pose_input.read(payload, arrival, self.calibration, replayed=replayed)
            except MessageError as error:
                self._refused(str(error))
                return None
            measurement = self._reference.corrected(measurement)
            if self._guard is not None:
                self._guard.pose(measurement.stamp, measurement.pose, measurement.covariance)
            return self._fusion.correct(measurement)

    def watch(self) -> list[str]:
        """Let the guard judge what came since the last call, and drive with what it accepts if that is asked for.

        What is new, in words. It may take long, and nothing waits for it. For one thread.
        """
        guard = self._guard
        if guard is None:
            return []
        with self._state_lock:
            work = guard.take()
        news = guard.judge(*work)
        if self._guarding == "swap" and (changes := guard.changes_to_drive_with()) is not None:
            guard.drives_with(changes)  # whether it can be swapped in or not
            try:
                self.swap(guard.guard.proposed(changes) or guard.guard.calibration, guard)
            except DataError as error:
                news.append(f"cannot drive with that: {error}")
        return news

    @property
    def fusing(self) -> bool:
        """True if SLAM poses are fused."""
        return self._fusion is not None

    def health(self, now: float) -> Health:
        """The robot's health. now: s, monotonic."""
        with self._state_lock:
            # Rate and waiting time of samples, measured once a window.
            since, counted = self._counted
            if now - since >= _RATE_WINDOW:
                self._rate = (self.counts.samples - counted) / (now - since)
                self._counted = now, self.counts.samples
                self._behind_before, self._behind = self._behind, 0.0
            waiting_since = self.waiting_since()
            if waiting_since is not None:
                self._behind = max(self._behind, now - waiting_since)
            age = None if self._arrival is None else now - self._arrival
            behind = max(self._behind_before, self._behind)
            status, message = self._status(now, age, behind)
            # Covariance of the fused pose, or of odometry's; it grows in a silence of the wheels.
            fusion, odometry = self._fusion, self._odometry
            covariance = odometry.covariance if fusion is None else fusion.estimate.covariance
            if status == "stale" and age is not None:
                covariance = covariance + odometry.silence_covariance(age)
            provenance, fusion_health = self.calibration.provenance, None
            if fusion is not None:
                fusion_health = FusionHealth(
                    located=fusion.located,
                    pose_age_s=None if fusion.fused_at is None else now - fusion.fused_at,
                    last_outcome=fusion.outcome,
                    rejected_in_a_row=fusion.rejected_in_a_row,
                )
            return Health(
                robot=self.name,
                status=status,
                message=message,
                calibration=self.calibration.name,
                simulated=provenance is not None and provenance.simulated,
                rate_hz=self._rate,
                age_s=age,
                behind_s=behind,
                last_stamp=self._timeline.newest / _SECOND if self._timeline.entries else None,
                position_sigma_m=float(np.sqrt((covariance[0, 0] + covariance[1, 1]) / 2)),
                heading_sigma_rad=float(np.sqrt(covariance[2, 2])),
                fusion=fusion_health,
                counts=self.counts.as_dict(),
                last_refusal=self._last_refusal,
                last_swap=self._last_swap,
                unfitted_motion_s=self._monitor.seconds,
                guard=None if self._guard is None else self._guard.health(),
            )

    def _status(self, now: float, age: float | None, behind: float) -> tuple[Status, str]:
        """The status and its reason in words.

        age: of the last wheel sample, s; None before the first. behind: longest time that samples waited, s.
        """
        wheels, fusion = self._wheels, self._fusion
        if age is None:
            return "waiting", f"no wheel sample yet{f': {self._last_refusal}' if self._last_refusal else ''}"
        if age > self._stale_after + behind:
            if wheels.repeats and now - wheels.repeated_at <= self._stale_after + behind:
                repeated = f"{wheels.repeats} wheel samples have the stamp {self._timeline.newest / _SECOND:.3f} s"
                return "stale", f"stamps stand still: {repeated}; `wheels: {{stamps: arrival}}` takes times of arrival"
            return "stale", f"no wheel sample for {age:.1f} s"
        if behind > _BEHIND:
            return "degraded", f"behind by {behind:.1f} s: samples come faster than they can be taken"
        if old := wheels.old_steering:
            return "degraded", f"no steering angles for {old:.1f} s: the last ones are held"
        if fusion is None:
            return "ok", "odometry"
        if not fusion.located:
            return "degraded", "no pose of SLAM yet"
        silent = None if fusion.fused_at is None else now - fusion.fused_at
        if silent is None or silent > fusion.settings.stale_after:
            rejected = f", {fusion.rejected_in_a_row} rejected" if fusion.rejected_in_a_row else ""
            return "degraded", "no pose of SLAM" + ("" if silent is None else f" fused for {silent:.1f} s") + rejected
        return "ok", "odometry and SLAM"

    def pose_at(self, stamp: int | None = None) -> PoseAt:
        """The pose at a time (ns; default: of the last sample). DataError: nothing is remembered of that time."""
        with self._state_lock:
            timeline = self._timeline
            if not timeline.entries:
                raise DataError(f"robot {self.name!r} has sent no wheel sample yet")
            chosen = timeline.newest if stamp is None else stamp
            odometry = timeline.odometry_at(chosen)
            if odometry is None:
                oldest, newest = timeline.oldest / _SECOND, timeline.newest / _SECOND
                raise DataError(f"at: {chosen / _SECOND:.6f} s is not within {oldest:.6f} to {newest:.6f} s")
            return PoseAt(chosen, odometry, self._fusion.at(chosen) if self._fusion else None)

    def swap(self, calibration: Calibration, guard: LiveGuard | None = None) -> None:
        """Continue with another calibration from the next sample on; poses do not jump.

        guard: the one that proposes it; else a new one watches. DataError: it is not this robot's, or cannot be run.
        """
        try:
            with self._state_lock:
                if guard is not None and guard is not self._guard:
                    return  # an operator's calibration came meanwhile
                _check_same_robot(calibration, self.calibration)
                odometry = self._odometry.continued(calibration)
                self._reference = ReferenceCorrection(calibration.model, self._reference.start)
                self.calibration, self._odometry = calibration, odometry
                self._monitor = ExtrapolationMonitor(self.name, calibration)
                if self._guarding:
                    self._guard = guard or LiveGuard(self.name, calibration)
                    self._guard.restart()
                self._guessed_angles = _wheel_angle_effects(calibration)
                self.counts.swaps += 1
                self._last_swap = SwapRecord(accepted=True, name=calibration.name, reason="runs", at=time.time())
                self._save()
        except OmnibenchError as error:
            self.refuse_swap(str(error), calibration.name)
            raise DataError(str(error)) from None

    def refuse_swap(self, reason: str, name: str | None = None) -> None:
        """Count a calibration that was sent and refused. name: the calibration's, if it could be read."""
        with self._state_lock:
            self.counts.swaps_refused += 1
            self._last_swap = SwapRecord(accepted=False, name=name, reason=reason, at=time.time())

    def set_pose(self, pose: Array, covariance: Array) -> None:
        """Set the pose (3,) in the map, now. DataError without fusion: odometry itself never jumps."""
        with self._state_lock:
            self._required_fusion("set_pose").set_pose(pose, covariance)

    def reset(self) -> None:
        """Forget the pose in the map; odometry continues. DataError without fusion."""
        with self._state_lock:
            self._required_fusion("reset").reset()
            if self._guard is not None:
                self._guard.restart()
            self._reference.start = None  # the next pose is the first of another run

    def resume(self, saved: SavedState, now: float, wall: float) -> None:
        """Continue where another node stopped. now, wall: monotonic and unix time, s.

        DataError: the saved state is of a robot with other wheels.
        """
        drive, odometry, fusion = self.calibration.robot.drive, self._odometry, self._fusion
        for angles, wheels, what in (
            (saved.positions, drive.wheels, "wheel"),
            (saved.steering, drive.steered, "steered wheel"),
        ):
            if angles is not None and len(angles) != len(wheels):
                which = plural(len(angles), what)
                raise DataError(f"the state of robot {self.name!r} is of a robot with {which}; remove it")
        with self._state_lock:
            positions, steering = (None if row is None else list(row) for row in (saved.positions, saved.steering))
            self._wheels.resume(saved.stamp, positions, now - (wall - saved.wall), steering)
            self.flows.update(saved.flows)
            steered = None if steering is None else np.array(steering)
            odometry.resume(np.array(saved.pose), np.reshape(saved.covariance, (3, 3)), saved.session_time, steered)
            if fusion is not None and saved.map_pose is not None and saved.map_covariance is not None:
                fusion.set_pose(np.array(saved.map_pose), np.reshape(saved.map_covariance, (3, 3)))
            self._stamps.unique(saved.stamp)
            motion = Motion(saved.stamp, 0.0, np.zeros(3), self.calibration.integration, 0.0, 0.0)
            estimate = _NO_ESTIMATE if fusion is None else fusion.estimate
            self._timeline.append(Entry(saved.stamp, motion, odometry.pose, estimate))

    def count(self, counter: Literal["failures", "overflow"]) -> None:
        """Count a message on which omnibench itself failed, or one that had no place among those that wait."""
        with self._state_lock:
            setattr(self.counts, counter, getattr(self.counts, counter) + 1)

    def record_backlog(self, behind: float) -> None:
        """Record how long samples had waited when they were taken, s."""
        with self._state_lock:
            self._behind = max(self._behind, behind)

    def save(self) -> None:
        """Write the state, where it outlives the node."""
        with self._state_lock:
            self._save()

    def close(self) -> None:
        """Take no more wheel samples, and write the state."""
        with self._state_lock:
            self.closed = True
            self._save()
            if self._memory is not None:
                self._memory.close()
                self._memory = None

    def _save(self) -> None:
        """Write the state after the last wheel sample; a disk that refuses is counted and told in health."""
        last, fusion = self._wheels.last, self._fusion
        if self._memory is None or last is None:
            return
        self._save_due = last.arrival + _SAVE_PERIOD
        fused = fusion.estimate if fusion is not None and fusion.located else (None, None)
        saved = SavedState.model_construct(  # not validated: reading refuses numbers that cannot be
            stamp=last.stamp,
            wall=time.time() - (time.monotonic() - last.arrival),
            positions=_row(self._wheels.known),
            steering=_row(last.steering),
            pose=_row(self._odometry.pose),
            covariance=_row(self._odometry.covariance),
            map_pose=_row(fused[0]),
            map_covariance=_row(fused[1]),
            session_time=self._odometry.session_time,
            flows=dict(self.flows),
        )
        try:
            self._memory.save(saved)
        except OSError as error:  # a full disk must not stop the odometry
            self.counts.failures += 1
            self._refused(f"the state could not be written: {error.strerror}")
            self._save_due += _SAVE_RETRY

    def _refused(self, reason: str) -> None:
        """Remember why a message was refused."""
        self.refusals += 1
        self._last_refusal = reason

    def _required_fusion(self, order: str) -> Fusion:
        """The fusion that an order needs. order: its name, for messages. DataError: there is no fusion."""
        if self._fusion is None:
            raise DataError(f"{order}: robot {self.name!r} runs without fusion, and odom itself never jumps")
        return self._fusion


def _row(values: Array | list[float] | None) -> Any:
    return None if values is None else tuple(np.ravel(values).tolist())


def _wheel_angle_effects(calibration: Calibration) -> str:
    """Names of the calibration's effects that depend on the absolute angles of the wheels."""
    terms = calibration.model.motion_terms
    return ", ".join(term.name for term in terms if "wheel_angles" in term.effect.needs)


def _check_same_robot(calibration: Calibration, running: Calibration) -> None:
    """DataError: a calibration has other wheels than the running one, or its matrix is far off the design's.

    The tracked point may be another one; matrices of the robot's centre are compared.
    """
    calibration.check_wheels(running.robot, "this robot")
    matrix = of_centre(calibration.robot, calibration.matrix_array.T).T
    for robot in (calibration.robot, running.robot):
        centred = robot.model_copy(update={"mount": None})
        off = np.abs(matrix - centred.inverse_kinematic_matrix).max(axis=1) / centred.row_scales
        if off.max() > _OTHER_ROBOT:
            raise DataError(
                f"row {int(off.argmax()) + 1} of the matrix is {off.max():.0%} off the design of robot "
                f"{robot.name!r}; is it another robot's, or in other units?"
            )
