"""The whole live system on one machine without a robot: a node's output is evaluated on a replayed recording."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import zenoh

from omnibench.live.config import LiveConfig, client_session, robot_called
from omnibench.live.drive import (
    ConcatenatedDrive,
    Recording,
    concatenate_recording,
    concatenated_truth,
)
from omnibench.live.health import Health
from omnibench.live.network import close_session, open_session
from omnibench.live.node import LiveNode, load_effects
from omnibench.live.odometry import RobotCentre
from omnibench.live.replay import WINDOW, DeliveryError, Player, PlayReport
from omnibench.live.stopping import wait_until
from omnibench.live.subscriber import Subscription, subscribe
from omnibench.live.topics import GraphNode
from omnibench.live.tracker import RobotTracker
from omnibench.live.wheels import joints_of
from omnibench.live.wire import Odometry
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.robot.calibration import Calibration, read_calibration
from omnibench.robot.kinematics import Array, interpolated, moved_to
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

_LAST_MESSAGES = 5.0  # s without any of the messages under way after which they count as lost; chosen


@dataclass(frozen=True)
class Deviation:
    """Errors of an estimate: root mean squares of position (m) and heading (rad), last position's error (m)."""

    position: float
    heading: float
    final_position: float


@dataclass(frozen=True, eq=False)
class Demonstration:
    """The results of a replay to a node.

    against: the reference of all deviations, in words. theoretical, calibrated: odometry with the design matrix and
    with the calibration. fused: None without fusion. batch_difference: largest difference between published odom and
    the batch odometry of the same recording, m or rad.
    """

    robot: str
    calibration: str
    simulated: bool
    report: PlayReport
    against: str
    theoretical: Deviation
    calibrated: Deviation
    fused: Deviation | None
    batch_difference: float
    health: Health


class _Collector:
    """Collects the messages of one topic in the order of arrival. stamps: ns; poses (K, 3) with continuous headings."""

    def __init__(self, session: zenoh.Session, robot: str, topic: str, config: LiveConfig) -> None:
        self.stamps: list[int] = []
        self._poses: list[Array] = []
        self._subscription: Subscription = subscribe(
            robot,
            topic=topic,
            session=session,
            profile=config.profile,
            domain=config.domain,
            callback=self._take,
            lossless=True,
        )

    def _take(self, message: Odometry) -> None:
        self._poses.append(message.pose)
        self.stamps.append(message.stamp)

    @property
    def poses(self) -> Array:
        poses = np.array(self._poses).reshape(-1, 3)
        return np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])])  # messages hold quaternions

    def close(self) -> None:
        self._subscription.close()


class _Results:
    """The node's messages on their way to the collectors, of which no more than ``WINDOW`` are to be under way."""

    def __init__(self, tracker: RobotTracker, collectors: Sequence[_Collector]) -> None:
        self._counts, self._collectors = tracker.counts, collectors
        self._missing, self._changed_at = 0, time.monotonic()

    def behind(self) -> bool:
        """True while so many messages are under way that more could be lost; False once they seem lost."""
        missing = self._missing_now()
        if missing != self._missing:
            self._missing, self._changed_at = missing, time.monotonic()
        return missing > WINDOW and time.monotonic() - self._changed_at < _LAST_MESSAGES

    def wait_for_the_last(self) -> None:
        """Wait for the messages under way. DeliveryError: some were lost."""
        if not wait_until(lambda: not self._missing_now(), _LAST_MESSAGES):
            samples = plural(self._counts.samples, "odometry message")
            raise DeliveryError(f"{self._missing_now():,} of {samples} of the node did not reach their subscriber")

    def _missing_now(self) -> int:
        """Messages that were published, or are about to be, and have not come."""
        return self._counts.samples - min(len(each.stamps) for each in self._collectors)


def demonstrate(
    config: LiveConfig,
    recording: Recording,
    stop: threading.Event | None = None,
    watch: Reporter = no_progress,
    seconds: float = math.inf,
) -> Demonstration:
    """Run the node of ``config``, replay ``recording`` to it as the config's ``replay`` says, and evaluate its output.

    The node starts without saved state. DataError: the recording has other wheels than the robot's calibration.
    DeliveryError: samples, or the odometry of some, were lost, or another sender wrote to the robot. Other errors as
    from LiveNode and Player.
    """
    stop = stop or threading.Event()
    robot = robot_called(config, config.replay.robot)
    load_effects(config)
    read_calibration(robot.calibration).check_wheels(
        recording.dataset.robot, f"the recording {recording.dataset.name} for robot {robot.name!r}"
    )
    drive = concatenate_recording(recording, pause=config.replay.pause, split=config.replay.split)
    with LiveNode(config, remember=False) as node:
        tracker = node.trackers[robot.name]
        guarded = config.zenoh.users_file is not None and config.zenoh.user is None
        session = node.session if guarded else open_session(client_session(config.zenoh), "replay")
        try:
            odometry = _Collector(session, robot.name, "odom", config)
            fused = None
            if config.fusion_of(robot) is not None:
                fused = _Collector(session, robot.name, "odometry/filtered", config)
            player = Player(
                GraphNode(session, node.keys, "replay"),
                robot.name,
                drive,
                config.replay,
                names=joints_of(tracker.calibration.robot, robot.wheels).names,
                noise=tracker.calibration.noise,
            )

            def with_health(event: Progress) -> None:
                health = node.health(robot.name)
                fused = plural(health.counts["poses"], "pose")
                watch(replace(event, note=f"{event.note}, {health.rate_hz:.0f} samples/s, {fused} fused"))

            results = _Results(tracker, [each for each in (odometry, fused) if each is not None])
            report = player.play(stop, with_health, results.behind, seconds)
            results.wait_for_the_last()
            health = node.health(robot.name)
            # Samples that the replay did not send are another sender's.
            others = health.counts["samples"] - report.sent["joint_states"]
            if others > 0 or len(tracker.flows) > 1:
                raise DeliveryError(
                    f"another sender wrote to robot {robot.name!r} meanwhile: its odometry is not that of the "
                    "recording; end the other one, or listen at another port"
                )
            for collector in (odometry, fused):
                if collector is not None:
                    collector.close()
        finally:
            if not guarded:
                close_session(session)
        return _evaluate(drive, recording, tracker.calibration, report, odometry, fused, health)


def _evaluate(
    drive: ConcatenatedDrive,
    recording: Recording,
    calibration: Calibration,
    report: PlayReport,
    odometry: _Collector,
    fused: _Collector | None,
    health: Health,
) -> Demonstration:
    """Compare the node's output with the batch odometry, and all odometry with the truth or the reference."""
    drive = replace(drive, robot=calibration.robot)  # whose drive signals the node took
    times = drive.wheel_times
    batch = calibration.model.poses([drive.log(session=calibration.session)])[0]
    design = OdometryModel.of_design(calibration.robot, calibration.integration).poses([drive.log()])[0]
    origin = odometry.stamps[0] if odometry.stamps else 0
    rows = _rows(odometry.stamps, origin, times)
    # odom begins at the origin, the drive at its start pose; the drive's poses are of the tracked point
    published = _tracked(calibration, odometry.poses)
    if odometry.stamps:
        published = moved_to(drive.start_poses[0], published)
    if recording.truth is not None:
        against, reference = "the simulated truth", concatenated_truth(drive, recording)
        chosen = rows
    else:
        against, reference = (
            "the reference poses of the recording",
            interpolated(times, drive.slam_times, drive.slam_poses),
        )
        chosen = rows[(times[rows] >= drive.slam_times[0]) & (times[rows] <= drive.slam_times[-1])]
    return Demonstration(
        robot=health.robot,
        calibration=calibration.name,
        simulated=recording.dataset.simulated,
        report=report,
        against=against,
        theoretical=_deviation(design[chosen], reference[chosen]),
        calibrated=_deviation(batch[chosen], reference[chosen]),
        fused=None
        if fused is None
        else _fused_deviation(fused.stamps, _tracked(calibration, fused.poses), origin, drive, reference, chosen),
        batch_difference=float(np.abs(published - batch[rows]).max()) if len(rows) else math.nan,
        health=health,
    )


def _rows(stamps: list[int], origin: int, times: Array) -> Array:
    """Index of the wheel sample of each stamp."""
    seconds = (np.array(stamps, dtype=np.int64) - origin) / 1e9
    return np.clip(np.searchsorted(times, seconds - 1e-6), 0, len(times) - 1)


def _tracked(calibration: Calibration, poses: Array) -> Array:
    """Poses (K, 3) of the tracked point, from those of the robot's centre, which a node publishes."""
    mount = calibration.robot.mount
    return poses if mount is None else RobotCentre(mount).tracked(poses)


def _fused_deviation(
    stamps: list[int], poses: Array, origin: int, drive: ConcatenatedDrive, reference: Array, chosen: Array
) -> Deviation:
    """Deviation from 1 s after the first SLAM pose on: before, the robot's pose in the map is not known."""
    rows = _rows(stamps, origin, drive.wheel_times)
    known = np.isin(rows, chosen) & (drive.wheel_times[rows] > drive.slam_times[0] + 1.0)
    poses, reference = poses[known], reference[rows[known]]
    turns = np.round((poses[:1, 2] - reference[:1, 2]) / math.tau)
    return _deviation(poses - [0.0, 0.0, 1.0] * (math.tau * turns[:, None]), reference)


def _deviation(poses: Array, reference: Array) -> Deviation:
    if not len(poses):
        return Deviation(math.nan, math.nan, math.nan)
    distance = np.hypot(*(poses - reference)[:, :2].T)
    heading = poses[:, 2] - reference[:, 2]
    return Deviation(float(np.sqrt(np.mean(distance**2))), float(np.sqrt(np.mean(heading**2))), float(distance[-1]))
