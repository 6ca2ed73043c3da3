"""The whole live system on one machine without a robot: a node's output is evaluated on a replayed recording."""

from __future__ import annotations

import math
import threading
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from omnibench.live.config import LiveConfig, client_session, robot_called
from omnibench.live.delivery import DeliveryError
from omnibench.live.drive import Recording, concatenate_recording, concatenated_truth
from omnibench.live.health import Health
from omnibench.live.network import close_session, open_session
from omnibench.live.node import LiveNode, load_effects
from omnibench.live.odometry import RobotCentre
from omnibench.live.replay import Player, PlayReport
from omnibench.live.stopping import wait_until
from omnibench.live.subscriber import subscribe
from omnibench.live.topics import GraphNode
from omnibench.live.wheels import joints_of
from omnibench.live.wire import Odometry
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.robot.calibration import read_calibration
from omnibench.robot.kinematics import Array, interpolated, moved_to
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

_FUSED: Final = "odometry/filtered"
_LAST_MESSAGES: Final = 30.0  # s for the messages that wait in the queues at the end; chosen

_Received = list[tuple[int, Array]]  # stamps, ns, and poses (3,) of one topic, by arrival


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
    robot = robot_called(config, config.replay.robot)
    load_effects(config)
    what = f"the recording {recording.dataset.name} for robot {robot.name!r}"
    read_calibration(robot.calibration).check_wheels(recording.dataset.robot, what)
    drive = concatenate_recording(recording, pause=config.replay.pause, split=config.replay.split)
    received: dict[str, _Received] = {"odom": []}
    if config.fusion_of(robot) is not None:
        received[_FUSED] = []
    with LiveNode(config, remember=False) as node, ExitStack() as closing:
        tracker = node.trackers[robot.name]
        for topic, messages in received.items():

            def take(message: Odometry, messages: _Received = messages) -> None:
                messages.append((message.stamp, message.pose))

            # In the node's own session, in which a full queue delays the node and loses nothing.
            at: dict[str, Any] = {"session": node.session, "profile": config.profile, "domain": config.domain}
            closing.enter_context(subscribe(robot.name, topic=topic, callback=take, lossless=True, **at))
        session = node.session
        if config.zenoh.users_file is None or config.zenoh.user is not None:
            session = open_session(client_session(config.zenoh), "replay")
            closing.callback(close_session, session)
        calibration = tracker.calibration
        names, noise = joints_of(calibration.robot, robot.wheels).names, calibration.noise
        player = Player(GraphNode(session, node.keys, "replay"), robot.name, drive, config.replay, names, noise)

        def with_health(event: Progress) -> None:
            health = node.health(robot.name)
            fused = plural(health.counts["poses"], "pose")
            watch(replace(event, note=f"{event.note}, {health.rate_hz:.0f} samples/s, {fused} fused"))

        def missing() -> int:
            return tracker.counts.samples - min(map(len, received.values()))

        report = player.play(stop, with_health, seconds=seconds)
        if not wait_until(lambda: not missing(), _LAST_MESSAGES):
            samples = plural(tracker.counts.samples, "odometry message")
            raise DeliveryError(f"{missing():,} of {samples} of the node did not reach their subscriber")
        health = node.health(robot.name)
        # Samples that the replay did not send are another sender's.
        if health.counts["samples"] > report.sent["joint_states"] or len(tracker.flows) > 1:
            why = f"another sender wrote to robot {robot.name!r} meanwhile: its odometry is not that of the recording"
            raise DeliveryError(f"{why}; end the other one, or listen at another port")
    # Compare the node's output with the batch odometry, and all odometry with the truth or the reference.
    drive = replace(drive, robot=calibration.robot)  # whose drive signals the node took
    times = drive.wheel_times
    batch = calibration.model.poses([drive.log(session=calibration.session)])[0]
    design = OdometryModel.of_design(calibration.robot, calibration.integration).poses([drive.log()])[0]
    origin = received["odom"][0][0] if received["odom"] else 0
    mount = calibration.robot.mount

    def aligned(messages: _Received) -> tuple[NDArray[np.intp], Array]:
        """Index of the wheel sample of each message, and its pose (K, 3), of the tracked point, headings continuous."""
        seconds = np.array([stamp - origin for stamp, _ in messages], dtype=np.int64) / 1e9
        poses = np.array([pose for _, pose in messages]).reshape(-1, 3)
        poses[:, 2] = np.unwrap(poses[:, 2])  # messages hold quaternions
        rows = np.clip(np.searchsorted(times, seconds - 1e-6), 0, len(times) - 1)
        return rows, poses if mount is None else RobotCentre(mount).tracked(poses)

    rows, published = aligned(received["odom"])
    if len(rows):  # odom begins at the origin, the drive at its start pose
        published = moved_to(drive.start_poses[0], published)
    if recording.truth is not None:
        against, reference, chosen = "the simulated truth", concatenated_truth(drive, recording), rows
    else:
        against = "the reference poses of the recording"
        reference = interpolated(times, drive.slam_times, drive.slam_poses)
        chosen = rows[(times[rows] >= drive.slam_times[0]) & (times[rows] <= drive.slam_times[-1])]
    fused = None
    if _FUSED in received:
        # From 1 s after the first SLAM pose on: before, the robot's pose in the map is not known.
        fused_rows, poses = aligned(received[_FUSED])
        known = np.isin(fused_rows, chosen) & (times[fused_rows] > drive.slam_times[0] + 1.0)
        poses, expected = poses[known], reference[fused_rows[known]]
        poses[:, 2] -= math.tau * np.round((poses[:1, 2] - expected[:1, 2]) / math.tau)
        fused = _deviation(poses, expected)
    return Demonstration(
        robot=health.robot,
        calibration=calibration.name,
        simulated=recording.dataset.simulated,
        report=report,
        against=against,
        theoretical=_deviation(design[chosen], reference[chosen]),
        calibrated=_deviation(batch[chosen], reference[chosen]),
        fused=fused,
        batch_difference=float(np.abs(published - batch[rows]).max()) if len(rows) else math.nan,
        health=health,
    )


def _deviation(poses: Array, reference: Array) -> Deviation:
    if not len(poses):
        return Deviation(math.nan, math.nan, math.nan)
    distance = np.hypot(*(poses - reference)[:, :2].T)
    heading = poses[:, 2] - reference[:, 2]
    return Deviation(float(np.sqrt(np.mean(distance**2))), float(np.sqrt(np.mean(heading**2))), float(distance[-1]))
