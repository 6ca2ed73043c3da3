"""One robot's estimation: from the payload that a subscriber receives to the update that is published.

A wheel sample is decoded, put in order and repaired, integrated to odometry with its covariance, fused with the poses
of SLAM, and published. A pose of SLAM is decoded and checked, corrected for the calibration's effects on the
reference (latency, lever arm of the LIDAR), and fused at its own time; the changed pose is published with the next
wheel sample. There is no network here, and any thread may call.

Another calibration of the same robot takes over at the next wheel sample. A query asks where the robot was at a time of
the last seconds. The health is reported from the state: status, rate, age and standard deviations.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from omnibench.errors import DataError, OmnibenchError
from omnibench.live import state as robot_state
from omnibench.live.fusion import Entry, Fusion, FusionSettings, Outcome, PoseInput
from omnibench.live.health import Counts, FusionHealth, Health, Status, SwapRecord
from omnibench.live.odometry import Motion
from omnibench.live.topics import Frames, JointStateDecoder, Update
from omnibench.live.wheels import WheelSettings, WheelStep
from omnibench.live.wire import JointState, MessageError, arrival_stamp
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array
from omnibench.robot.signals import of_centre

_RATE_WINDOW = 0.9  # s, over which samples are counted at least; below the period of the diagnostics, 1 s
_BEHIND = 0.1  # s that samples may wait; a node whose samples wait for longer cannot keep up; chosen
_SECOND = 1e9  # ns


class HealthReporter:
    """Reports one robot's health. stale_after: s without wheel samples after which the stream counts as stale."""

    def __init__(self, stale_after: float) -> None:
        self._stale_after = stale_after
        self._counted = (time.monotonic(), 0)  # when samples were counted last, and how many there were
        self._rate = 0.0  # Hz
        self._behind = 0.0  # s, in the last whole window

    def report(self, state: robot_state.RobotState, now: float, waiting_since: float | None = None) -> Health:
        """The health at ``now`` (s, monotonic). waiting_since: when the oldest message that waits came."""
        # Rate and waiting time of samples, measured once a window.
        since, counted = self._counted
        if now - since >= _RATE_WINDOW:
            self._rate = (state.counts.samples - counted) / (now - since)
            self._counted = now, state.counts.samples
            self._behind, state.behind = state.behind, 0.0
        if waiting_since is not None:
            state.behind = max(state.behind, now - waiting_since)
        age = None if state.arrival is None else now - state.arrival
        behind = max(self._behind, state.behind)
        status, message = self._status(state, now, age, behind)
        covariance = _covariance(state, age if status == "stale" else None)
        provenance, fusion, fusion_health = state.calibration.provenance, state.fusion, None
        if fusion is not None:
            fusion_health = FusionHealth(
                located=fusion.located,
                pose_age_s=None if fusion.fused_at is None else now - fusion.fused_at,
                last_outcome=fusion.outcome,
                rejected_in_a_row=fusion.rejected_in_a_row,
            )
        return Health(
            robot=state.name,
            status=status,
            message=message,
            calibration=state.calibration.name,
            simulated=provenance is not None and provenance.simulated,
            rate_hz=self._rate,
            age_s=age,
            behind_s=behind,
            last_stamp=state.timeline.newest / _SECOND if state.timeline.entries else None,
            position_sigma_m=float(np.sqrt((covariance[0, 0] + covariance[1, 1]) / 2)),
            heading_sigma_rad=float(np.sqrt(covariance[2, 2])),
            fusion=fusion_health,
            counts=state.counts.as_dict(),
            last_refusal=state.last_refusal,
            last_swap=state.last_swap,
            unfitted_motion_s=state.monitor.seconds,
        )

    def _status(
        self, state: robot_state.RobotState, now: float, age: float | None, behind: float
    ) -> tuple[Status, str]:
        """The status and its reason in words.

        age: of the last wheel sample, s; None before the first. behind: longest time that samples waited, s.
        """
        if age is None:
            return "waiting", f"no wheel sample yet{f': {state.last_refusal}' if state.last_refusal else ''}"
        if age > self._stale_after + behind:
            wheels = state.wheel_input
            if wheels.repeats and now - wheels.repeated_at <= self._stale_after + behind:
                repeated = f"{wheels.repeats} wheel samples have the stamp {state.timeline.newest / _SECOND:.3f} s"
                return "stale", f"stamps stand still: {repeated}; `wheels: {{stamps: arrival}}` takes times of arrival"
            return "stale", f"no wheel sample for {age:.1f} s"
        if behind > _BEHIND:
            return "degraded", f"behind by {behind:.1f} s: samples come faster than they can be taken"
        if old := state.wheel_input.old_steering:
            return "degraded", f"no steering angles for {old:.1f} s: the last ones are held"
        fusion = state.fusion
        if fusion is None:
            return "ok", "odometry"
        if not fusion.located:
            return "degraded", "no pose of SLAM yet"
        silent = None if fusion.fused_at is None else now - fusion.fused_at
        if silent is None or silent > fusion.settings.stale_after:
            rejected = f", {fusion.rejected_in_a_row} rejected" if fusion.rejected_in_a_row else ""
            return "degraded", "no pose of SLAM" + ("" if silent is None else f" fused for {silent:.1f} s") + rejected
        return "ok", "odometry and SLAM"


def _covariance(state: robot_state.RobotState, silence: float | None) -> Array:
    """Covariance (3, 3) of the fused pose, or of odometry's; it grows in a silence of the wheels (s)."""
    odometry, fusion = state.odometry, state.fusion
    if fusion is None:
        return odometry.covariance if silence is None else odometry.covariance_after_silence(silence)
    if silence is None:
        return fusion.covariance
    return fusion.covariance + (odometry.covariance_after_silence(silence) - odometry.covariance)


@dataclass(frozen=True, slots=True, eq=False)
class PoseAt:
    """A robot's pose at ``stamp`` (ns). odometry: pose (3,) in odom. in_map: pose (3,) and covariance (3, 3)."""

    stamp: int
    odometry: Array
    in_map: tuple[Array, Array] | None


_OTHER_ROBOT = 0.5  # share of a row's largest element; chosen: no calibration moves a matrix so far from its design


def swap_calibration(state: robot_state.RobotState, calibration: Calibration) -> None:
    """Continue with another calibration; poses do not jump. DataError: it is not this robot's, or cannot be run."""
    try:
        check_same_robot(calibration, state.calibration)
        odometry = state.odometry.continued(calibration)
        reference = state.reference.continued(calibration.model)
    except OmnibenchError as error:
        record_refused_swap(state, calibration.name, str(error))
        raise DataError(str(error)) from None
    state.calibration, state.odometry, state.reference = calibration, odometry, reference
    state.monitor = robot_state.ExtrapolationMonitor(state.name, calibration)
    state.guessed_angles = robot_state.wheel_angle_effects(calibration)
    state.counts.swaps += 1
    state.last_swap = SwapRecord(accepted=True, name=calibration.name, reason="runs", at=time.time())


def record_refused_swap(state: robot_state.RobotState, name: str | None, reason: str) -> None:
    """Count a calibration that was sent and refused. name: the calibration's, if it could be read."""
    state.counts.swaps_refused += 1
    state.last_swap = SwapRecord(accepted=False, name=name, reason=reason, at=time.time())


def check_same_robot(calibration: Calibration, running: Calibration) -> None:
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


LOG = logging.getLogger("omnibench.live")


class RobotTracker:
    """One robot: takes its samples and poses, and answers orders and questions.

    fusion: None for odometry alone. stale_after: s without wheel samples after which the stream counts as stale.
    memory: where the state outlives the node.
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
        memory: robot_state.RobotMemory | None = None,
    ) -> None:
        self.name = name
        self.frames = frames or Frames()
        self._state = robot_state.new_state(name, calibration, wheels or WheelSettings(), fusion)
        self._decoder = JointStateDecoder()
        self._by_arrival = wheels is not None and wheels.stamps == "arrival"
        self._pose_input = PoseInput(self.frames.map, fusion or FusionSettings(), self.counts)
        self._state_writer = robot_state.StateWriter(memory)
        self._health = HealthReporter(stale_after)
        self._state_lock = threading.Lock()  # held while the state is read or changed
        self._closed = False
        self.waiting_since: Callable[[], float | None] = lambda: None  # when the oldest that waits came, s, monotonic

    @property
    def refusals(self) -> int:
        """Number of messages that were refused for a reason."""
        return self._state.refusals

    def take_wheels(self, payload: bytes, arrival: float, skipped: int = 0, *, replayed: bool = False) -> list[Update]:
        """Take a sensor_msgs/JointState in CDR; its updates, in order.

        Mostly there is one; none while a sample is refused or has to be confirmed. arrival: s, monotonic. skipped:
        messages before it that never came, by the sender's numbers. replayed: its stamp counts in any case.
        """
        with self._state_lock:
            message = self._decode(payload)
            if message is not None and self._by_arrival and not replayed:
                message = replace(message, stamp=arrival_stamp(arrival))
            updates = []
            for step in self._order_and_repair(message, arrival, skipped):
                motion = self._integrate(step)
                self._fuse(motion)
                updates.append(self._update(motion.stamp))
            self._state_writer.save_if_due(self._state)
            return updates

    def take_pose(self, payload: bytes, arrival: float, *, replayed: bool = False) -> Outcome | None:
        """Take a geometry_msgs/PoseWithCovarianceStamped in CDR; None: it is invalid, or there is no fusion."""
        with self._state_lock:
            fusion = self._state.fusion
            if fusion is None:
                return None
            try:
                measurement = self._pose_input.read(payload, arrival, self.calibration, replayed=replayed)
            except MessageError as error:
                self._state.refused(str(error))
                return None
            return fusion.correct(self._state.reference.corrected(measurement))

    def _decode(self, payload: bytes) -> JointState | None:
        """Step 1: the wheel message in a payload; None if it is not one, or the tracker is closed."""
        if self._closed:
            return None
        try:
            return self._decoder.decode(payload)
        except MessageError as error:
            self.counts.undecodable += 1
            self._state.refused(str(error))
            return None

    def _order_and_repair(self, message: JointState | None, arrival: float, skipped: int) -> list[WheelStep]:
        """Step 2: how the wheels turned since the last sample; late, doubled and impossible samples are refused."""
        if message is None:
            return []
        state = self._state
        state.wheel_input.last_refusal = ""
        steps = state.wheel_input.take(message, arrival, skipped)
        if state.wheel_input.last_refusal:
            state.refused(state.wheel_input.last_refusal)
        if steps:
            state.arrival = arrival
        return steps

    def _integrate(self, step: WheelStep) -> Motion:
        """Step 3: odometry and its covariance after the step; the motion that the step made."""
        state = self._state
        if self._state.guessed_angles and step.positions is None:
            LOG.warning(
                "%s: %s acts by wheel angles, and the messages tell none: they are counted from 0, at a guess",
                *(self.name, self._state.guessed_angles),
            )
            self._state.guessed_angles = ""
        if state.fusion is not None and state.fusion.located:
            state.odometry.set_odom_heading(float(state.fusion.pose[2] - state.odometry.pose[2]))
        motion = state.odometry.step(step)
        state.monitor.take(step, state.odometry.driven)
        return motion

    def _fuse(self, motion: Motion) -> None:
        """Step 4: the motion joins the timeline, and poses that were waiting for its time are fused."""
        state = self._state
        if motion.restarted and state.timeline.entries:
            # the clock jumped: the motion counts as if it ended at the new time, and times before it have no meaning
            state.timeline.restart(motion.stamp - round(motion.duration * _SECOND))
            if state.fusion is not None:
                state.fusion.restart()
        self._add_to_timeline(motion)

    def _update(self, stamp: int) -> Update:
        """Step 5: the estimates at the stamp of the sample (ns), as they are published."""
        odometry, fusion = self._state.odometry, self._state.fusion
        return Update(
            self._state.stamps.unique(stamp),
            odometry.pose,
            odometry.covariance,
            odometry.twist,
            odometry.twist_covariance,
            None if fusion is None else (fusion.pose, fusion.covariance),
        )

    def _add_to_timeline(self, motion: Motion) -> None:
        timeline, fusion, pose = self._state.timeline, self._state.fusion, self._state.odometry.pose
        if fusion is None:
            timeline.append(Entry(motion.stamp, motion, pose, pose, np.zeros((3, 3))))
            return
        timeline.append(Entry(motion.stamp, motion, pose, *fusion.predict(motion)))
        fusion.take_waiting()

    @property
    def calibration(self) -> Calibration:
        """The calibration that runs."""
        return self._state.calibration

    @property
    def counts(self) -> Counts:
        """Everything that was taken, refused or put right, counted."""
        return self._state.counts

    @property
    def fusing(self) -> bool:
        """True if SLAM poses are fused."""
        return self._state.fusion is not None

    @property
    def flows(self) -> dict[int, int]:
        """Flow of an acknowledged replay -> number of the next message that is not in the odometry."""
        return self._state.flows

    def health(self, now: float) -> Health:
        """The robot's health. now: s, monotonic."""
        with self._state_lock:
            return self._health.report(self._state, now, self.waiting_since())

    def pose_at(self, stamp: int | None = None) -> PoseAt:
        """The pose at a time (ns; default: of the last sample). DataError: nothing is remembered of that time."""
        with self._state_lock:
            timeline, fusion = self._state.timeline, self._state.fusion
            if not timeline.entries:
                raise DataError(f"robot {self.name!r} has sent no wheel sample yet")
            chosen = timeline.newest if stamp is None else stamp
            odometry = timeline.odometry_at(chosen)
            if odometry is None:
                oldest, newest = timeline.oldest / _SECOND, timeline.newest / _SECOND
                raise DataError(f"at: {chosen / _SECOND:.6f} s is not within {oldest:.6f} to {newest:.6f} s")
            return PoseAt(chosen, odometry, fusion.at(chosen) if fusion else None)

    def swap(self, calibration: Calibration) -> None:
        """Continue with another calibration from the next sample on. DataError: it is not this robot's."""
        with self._state_lock:
            swap_calibration(self._state, calibration)
            self._state_writer.save(self._state)

    def refuse_swap(self, reason: str) -> None:
        """Count a calibration that was sent and cannot be read."""
        with self._state_lock:
            record_refused_swap(self._state, None, reason)

    def set_pose(self, pose: Array, covariance: Array) -> None:
        """Set the pose (3,) in the map, now. DataError without fusion: odometry itself never jumps."""
        with self._state_lock:
            self._required_fusion("set_pose").set_pose(pose, covariance)

    def reset(self) -> None:
        """Forget the pose in the map; odometry continues. DataError without fusion."""
        with self._state_lock:
            self._required_fusion("reset").reset()
            self._state.reference.restart()

    def resume(self, saved: robot_state.SavedState, now: float, wall: float) -> None:
        """Continue where another node stopped. now, wall: monotonic and unix time, s."""
        with self._state_lock:
            self._add_to_timeline(robot_state.resume_state(self._state, saved, now, wall))

    def count_failure(self) -> None:
        """Count a message on which omnibench itself failed."""
        with self._state_lock:
            self.counts.failures += 1

    def record_backlog(self, behind: float, unpublished: int) -> None:
        """Record how long samples had waited when they were taken, s, and how many updates were not published."""
        with self._state_lock:
            self._state.behind = max(self._state.behind, behind)
            self.counts.unpublished += unpublished

    def save(self) -> None:
        """Write the state, where it outlives the node."""
        with self._state_lock:
            self._state_writer.save(self._state)

    def count_overflow(self) -> None:
        """Count a message that was not taken, because too many were waiting."""
        with self._state_lock:
            self.counts.overflow += 1

    def close(self) -> None:
        """Take no more wheel samples, and write the state."""
        with self._state_lock:
            self._closed = True
            self._state_writer.close(self._state)

    def _required_fusion(self, order: str) -> Fusion:
        """The fusion that an order needs. order: its name, for messages. DataError: there is no fusion."""
        if self._state.fusion is None:
            raise DataError(f"{order}: robot {self.name!r} runs without fusion, and odom itself never jumps")
        return self._state.fusion
