"""One robot: messages in, odometry out. No network here; a lock lets messages and questions come from any thread."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from omnibench.config import Model
from omnibench.errors import DataError, OmnibenchError
from omnibench.live.estimation.counts import Counts
from omnibench.live.estimation.extrapolation_monitor import ExtrapolationMonitor
from omnibench.live.estimation.health import FusionHealth, Health, Status, SwapRecord
from omnibench.live.estimation.live_odometry import UNKNOWN_NOISE, LiveOdometry, Motion
from omnibench.live.estimation.published_stamps import PublishedStamps
from omnibench.live.estimation.saved_state import RobotMemory, SavedState
from omnibench.live.estimation.wheel_input import WheelInput, WheelSettings, WheelStep
from omnibench.live.fusion.pose_fusion import Fusion, FusionSettings, Outcome
from omnibench.live.fusion.reference_correction import ReferenceCorrection
from omnibench.live.fusion.timeline import Entry, PoseMeasurement, Timeline
from omnibench.live.wire.messages import POSE_ESTIMATE, MessageError, Odometry, Transform
from omnibench.live.wire.robot_messages import JointStateDecoder
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array
from omnibench.robot.planar import correction

LOG = logging.getLogger("omnibench.live")
_HISTORY = 5.0  # s of odometry without fusion
_SAVING = 0.1  # s between states written
_OTHER_ROBOT = 0.5  # of a row's largest element; no calibration moves a matrix so far from its design
_FARTHEST = 1e7  # m; no robot has come as far
_SUREST = 1e-7  # m, rad; no SLAM is as sure
_UNSAVED = 10.0  # s until a state that could not be written is tried again
_SECOND = 1e9  # ns


FrameName = Annotated[str, Field(pattern=r"^[^\s/][^\s]*$", max_length=200)]


class Frames(Model):
    """Names of the coordinate frames (REP-105)."""

    map: FrameName = "map"
    odom: FrameName = "odom"
    base: FrameName = "base_link"

    @model_validator(mode="after")
    def _differ(self) -> Frames:
        if len({self.map, self.odom, self.base}) < 3:
            raise ValueError(f"map, odom and base must differ: {self.map}, {self.odom}, {self.base}")
        return self


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """What is published of one wheel sample."""

    odometry: Odometry
    filtered: Odometry | None
    transforms: tuple[Transform, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PoseAt:
    """Where the robot was at ``stamp`` (ns); in_map: pose (3,) and covariance (3, 3)."""

    stamp: int
    odometry: Array
    in_map: tuple[Array, Array] | None


class RobotTracker:
    """The state of one robot.

    stale_after: s without wheel samples after which the stream counts as stale. fusion: None for odometry alone.
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
    ) -> None:
        self.name = name
        self.calibration = calibration
        self.counts = Counts()
        self.frames = frames or Frames()
        self._stale_after = stale_after
        self._memory = memory
        self._lock = threading.RLock()
        self._wheels = WheelInput(
            calibration.robot.wheel_names, wheels or WheelSettings(), calibration.sample_period, self.counts
        )
        self._odometry = LiveOdometry(calibration, (fusion or FusionSettings()).standstill)
        self._timeline = Timeline(fusion.history if fusion else _HISTORY)
        self._fusion = Fusion(fusion, self._timeline, self.counts) if fusion else None
        self._reference = ReferenceCorrection(calibration.model)
        self._wants_angles = _wheel_angle_effects(calibration)
        self._watch = ExtrapolationMonitor(name, calibration)
        self._stamps = PublishedStamps()
        self._decode = JointStateDecoder().decode
        self._arrival: float | None = None  # of the last wheel sample
        self._last_refusal = ""
        self._last_swap: SwapRecord | None = None
        self._saved = -np.inf
        self._counted = (time.monotonic(), 0)
        self._rate = 0.0

    @property
    def fusing(self) -> bool:
        """True if SLAM poses are fused."""
        return self._fusion is not None

    def take_wheels(self, payload: bytes, arrival: float) -> list[Update]:
        """Take a sensor_msgs/JointState; what is to be published. arrival: s, monotonic."""
        with self._lock:
            try:
                message = self._decode(payload)
            except MessageError as error:
                self.counts.undecodable += 1
                self._last_refusal = str(error)
                return []
            self._wheels.last_refusal = ""
            steps = self._wheels.take(message, arrival)
            self._last_refusal = self._wheels.last_refusal or self._last_refusal
            if not steps:
                return []
            self._arrival = arrival
            updates = [self._drive(step) for step in steps]
            if arrival - self._saved >= _SAVING:
                self._save()
            return updates

    def take_pose(self, payload: bytes, arrival: float) -> Outcome | None:
        """Take a geometry_msgs/PoseWithCovarianceStamped; what became of it, None when it is invalid."""
        with self._lock:
            if self._fusion is None:
                return None
            try:
                return self._fusion.correct(self._reference.corrected(self._measurement(payload, arrival)))
            except MessageError as error:
                self._last_refusal = str(error)
                return None

    def swap(self, calibration: Calibration) -> None:
        """Go on with another calibration from the next sample on. DataError: it is not this robot's."""
        with self._lock:
            try:
                self._check(calibration)
                odometry = self._odometry.continued(calibration)
                reference = self._reference.continued(calibration.model)
            except OmnibenchError as error:
                self.counts.swaps_refused += 1
                self._last_swap = SwapRecord(accepted=False, name=calibration.name, reason=str(error), at=time.time())
                raise DataError(str(error)) from None
            self._odometry, self._reference, self.calibration = odometry, reference, calibration
            self._wants_angles = _wheel_angle_effects(calibration)
            self._watch = ExtrapolationMonitor(self.name, calibration)
            self.counts.swaps += 1
            self._last_swap = SwapRecord(accepted=True, name=calibration.name, reason="runs", at=time.time())
            self._save()

    def refuse_swap(self, reason: str) -> None:
        """A calibration was sent that is none."""
        with self._lock:
            self.counts.swaps_refused += 1
            self._last_swap = SwapRecord(accepted=False, name=None, reason=reason, at=time.time())

    def set_pose(self, pose: Array, covariance: Array) -> None:
        """The robot is at ``pose`` (3,) of the map, now. DataError without fusion: odometry itself never jumps."""
        with self._lock:
            fusion = self._fusing("set_pose")
            if self._timeline.entries:
                fusion.set_pose(pose, covariance)
            else:
                fusion.begin(pose, covariance)

    def reset(self) -> None:
        """Forget where the robot is in the map; odometry goes on."""
        with self._lock:
            fusion = self._fusing("reset")
            self._reference.restart()
            if self._timeline.entries:
                fusion.reset()
            else:
                fusion.begin(np.zeros(3), None)

    def pose_at(self, stamp: int | None = None) -> PoseAt:
        """Where the robot was at a time (ns; default: of the last sample). DataError outside of what is remembered."""
        with self._lock:
            if not self._timeline.entries:
                raise DataError(f"robot {self.name!r} has sent no wheel sample yet")
            chosen = self._timeline.newest if stamp is None else stamp
            odometry = self._timeline.odometry_at(chosen)
            if odometry is None:
                oldest, newest = self._timeline.oldest / _SECOND, self._timeline.newest / _SECOND
                raise DataError(f"at: {chosen / _SECOND:.6f} s is not within {oldest:.6f} to {newest:.6f} s")
            return PoseAt(chosen, odometry, self._fusion.at(chosen) if self._fusion else None)

    def health(self, now: float) -> Health:
        """How the stream is. now: s, monotonic."""
        with self._lock:
            self._measure_rate(now)
            age = None if self._arrival is None else now - self._arrival
            status, message = self._status(now, age)
            covariance = self._odometry.grown(age) if status == "stale" and age is not None else None
            if covariance is None:
                covariance = self._odometry.covariance
            elif self._fusion is not None:
                covariance = covariance - self._odometry.covariance
            if self._fusion is not None:
                covariance = self._fusion.covariance + (covariance if status == "stale" else 0.0)
            return Health(
                robot=self.name,
                status=status,
                message=message,
                calibration=self.calibration.name,
                simulated=self.calibration.provenance is not None and self.calibration.provenance.simulated,
                rate_hz=self._rate,
                age_s=age,
                last_stamp=self._timeline.newest / _SECOND if self._timeline.entries else None,
                position_sigma_m=float(np.sqrt((covariance[0, 0] + covariance[1, 1]) / 2)),
                heading_sigma_rad=float(np.sqrt(covariance[2, 2])),
                fusion=self._fusion_health(now),
                counts=self.counts.as_dict(),
                last_refusal=self._last_refusal,
                last_swap=self._last_swap,
                unfitted_motion_s=self._watch.seconds,
            )

    def count_failure(self) -> None:
        """A message that omnibench itself failed on."""
        with self._lock:
            self.counts.failures += 1

    def close(self) -> None:
        """Write down where the robot is."""
        with self._lock:
            self._save()
            if self._memory is not None:
                self._memory.close()
                self._memory = None

    def resume(self, saved: SavedState, now: float, wall: float) -> None:
        """Go on where another node stopped. now, wall: monotonic and unix time, s."""
        with self._lock:
            wheels = len(self.calibration.robot.wheels)
            positions = None if saved.positions is None else np.array(saved.positions)
            if positions is not None and len(positions) != wheels:
                raise DataError(
                    f"the state of robot {self.name!r} is of a robot with {len(positions)} wheels; remove it"
                )
            self._wheels.resume(saved.stamp, positions, now - (wall - saved.wall))
            covariance = np.reshape(saved.covariance, (3, 3))
            self._odometry.resume(np.array(saved.pose), covariance, saved.session_time)
            if self._fusion is not None and saved.map_pose is not None and saved.map_covariance is not None:
                self._fusion.begin(np.array(saved.map_pose), np.reshape(saved.map_covariance, (3, 3)))
            self._stamps.unique(saved.stamp)
            self._add(Motion(saved.stamp, 0.0, np.zeros(3), self.calibration.integration, 0.0, 0.0))

    def _drive(self, step: WheelStep) -> Update:
        if self._wants_angles and step.positions is None:
            LOG.warning(
                "%s: %s acts by wheel angles, and the messages tell none: they are counted from 0, at a guess",
                *(self.name, self._wants_angles),
            )
            self._wants_angles = ""
        if self._fusion is not None and self._fusion.located:
            self._odometry.face(float(self._fusion.pose[2] - self._odometry.pose[2]))
        motion = self._odometry.step(step)
        self._watch.take(step)
        if motion.restarted and self._timeline.entries:
            # the motion is taken as if it ended at the new time; what came before has no time any more
            self._timeline.restart(motion.stamp - round(motion.duration * _SECOND))
            if self._fusion is not None:
                self._fusion.restart()
        self._add(motion)
        return self._update(motion.stamp)

    def _add(self, motion: Motion) -> None:
        pose = self._odometry.pose
        if self._fusion is None:
            self._timeline.append(Entry(motion.stamp, motion, pose, pose, np.zeros((3, 3))))
            return
        self._timeline.append(Entry(motion.stamp, motion, pose, *self._fusion.predict(motion)))
        self._fusion.take_waiting()

    def _update(self, stamp: int) -> Update:
        stamp = self._stamps.unique(stamp)
        frames, twist = self.frames, self._odometry.twist
        pose, twist_covariance = self._odometry.pose, self._odometry.twist_covariance
        odometry = Odometry(stamp, frames.odom, frames.base, pose, self._odometry.covariance, twist, twist_covariance)
        to_base = Transform(stamp, frames.odom, frames.base, pose)
        if self._fusion is None:
            return Update(odometry, None, (to_base,))
        fused = self._fusion.pose
        filtered = Odometry(stamp, frames.map, frames.base, fused, self._fusion.covariance, twist, twist_covariance)
        to_odom = Transform(stamp, frames.map, frames.odom, correction(fused, pose))
        return Update(odometry, filtered, (to_odom, to_base))

    def _measurement(self, payload: bytes, arrival: float) -> PoseMeasurement:
        try:
            message = POSE_ESTIMATE.decode(payload)
        except MessageError:
            self.counts.pose_undecodable += 1
            raise
        try:
            if message.frame not in ("", self.frames.map):
                raise MessageError(f"the pose is in frame {message.frame!r}, not in {self.frames.map!r}")
            if not np.isfinite(message.pose).all() or not np.isfinite(message.covariance).all():
                raise MessageError("the pose or its covariance is not finite")
            if np.abs(message.pose[:2]).max() > _FARTHEST:
                raise MessageError(f"the pose lies {np.abs(message.pose[:2]).max():.3g} m away")
            covariance = message.covariance if message.covariance.any() else self._usual_covariance()
            least, *_, largest = np.linalg.eigvalsh(covariance)
            if not np.allclose(covariance, covariance.T) or least <= 0:
                raise MessageError("the pose's covariance is not positive definite")
            if largest > _FARTHEST**2 or least < _SUREST**2:
                raise MessageError(f"the pose's standard deviations reach from {least**0.5:.1e} to {largest**0.5:.1e}")
        except MessageError:
            self.counts.pose_invalid += 1
            raise
        return PoseMeasurement(message.stamp, message.pose, covariance, arrival)

    def _usual_covariance(self) -> Array:
        """Of a pose that comes without: white noise and bias of the reference, as the calibration knows them."""
        noise = self.calibration.noise or UNKNOWN_NOISE
        position = noise.pose_position**2 + noise.bias_position**2 or UNKNOWN_NOISE.pose_position**2
        heading = noise.pose_heading**2 + noise.bias_heading**2 or UNKNOWN_NOISE.pose_heading**2
        return np.diag([position, position, heading])

    def _check(self, calibration: Calibration) -> None:
        running = self.calibration.robot.wheel_names
        if calibration.robot.wheel_names != running:
            found = ", ".join(calibration.robot.wheel_names)
            raise DataError(f"calibration {calibration.name!r} has wheels {found}; this robot has {', '.join(running)}")
        for robot in (calibration.robot, self.calibration.robot):
            design = robot.inverse_kinematic_matrix
            off = np.abs(calibration.matrix_array - design).max(axis=1) / np.abs(design).max(axis=1)
            if off.max() > _OTHER_ROBOT:
                raise DataError(
                    f"row {int(off.argmax()) + 1} of the matrix is {off.max():.0%} off the design of robot "
                    f"{robot.name!r}; is it another robot's, or in other units?"
                )

    def _fusing(self, what: str) -> Fusion:
        if self._fusion is None:
            raise DataError(f"{what}: robot {self.name!r} runs without fusion, and odom itself never jumps")
        return self._fusion

    def _status(self, now: float, age: float | None) -> tuple[Status, str]:
        if age is None:
            return "waiting", "no wheel sample yet"
        if age > self._stale_after:
            return "stale", f"no wheel sample for {age:.1f} s"
        if self._fusion is None:
            return "ok", "odometry"
        if not self._fusion.located:
            return "degraded", "no pose of SLAM yet"
        silent = None if self._fusion.fused_at is None else now - self._fusion.fused_at
        if silent is None or silent > self._fusion.settings.stale_after:
            rejected = self._fusion.rejected_in_a_row
            why = f", {rejected} rejected" if rejected else ""
            return "degraded", "no pose of SLAM" + ("" if silent is None else f" fused for {silent:.1f} s") + why
        return "ok", "odometry and SLAM"

    def _fusion_health(self, now: float) -> FusionHealth | None:
        fusion = self._fusion
        if fusion is None:
            return None
        return FusionHealth(
            located=fusion.located,
            pose_age_s=None if fusion.fused_at is None else now - fusion.fused_at,
            last_outcome=fusion.outcome,
            rejected_in_a_row=fusion.rejected_in_a_row,
        )

    def _measure_rate(self, now: float) -> None:
        since, samples = self._counted
        if now - since >= 0.9:
            self._rate = (self.counts.samples - samples) / (now - since)
            self._counted = now, self.counts.samples

    def _save(self) -> None:
        last = self._wheels.last_sample
        if self._memory is None or last is None or self._arrival is None:
            return
        self._saved = self._arrival
        stamp, positions = last
        fused = None
        if self._fusion is not None and self._fusion.located:
            fused = self._fusion.pose, self._fusion.covariance
        wall = time.time() - (time.monotonic() - self._arrival)
        try:
            odometry = self._odometry.pose, self._odometry.covariance
            self._memory.save(stamp, wall, positions, odometry, fused, self._odometry.session_time)
        except OSError as error:  # a full disk is no reason to stand still
            self.counts.failures += 1
            self._last_refusal = f"the state could not be written: {error.strerror}"
            self._saved += _UNSAVED


def _wheel_angle_effects(calibration: Calibration) -> str:
    """The names of its effects that act by the absolute angles of the wheels."""
    terms = calibration.model.motion_terms
    return ", ".join(term.name for term in terms if "wheel_angles" in term.effect.needs)
