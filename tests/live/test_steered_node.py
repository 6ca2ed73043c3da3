"""A node of robots that steer, with real sessions: what goes in, what comes out, how it starts again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zenoh
from drives import PERIOD
from mcap_recordings import messages_of
from nodes import asked, config_of, running, sent_one_by_one
from received_messages import ReceivedMessages
from sessions import until
from steered import DIFFERENTIAL, SWERVE, SteeredDrive, calibration, drive, recording

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.errors import DataError
from omnibench.live.config import LiveConfig
from omnibench.live.replay.concatenated_drive import Recording
from omnibench.live.replay.demonstration import demonstrate
from omnibench.live.wire.messages import ODOMETRY, JointState
from omnibench.robot.calibration import Calibration, EffectTerm, matrix_rows, write_calibration
from omnibench.robot.kinematics import Array, Mount, Robot
from omnibench.robot.odometry import WheelLog

SLIPPING = (
    EffectTerm(name="acceleration_slip", parameters={"k": 0.08}),
    EffectTerm(name="centripetal_slip", parameters={"k": 0.05}),
    EffectTerm(name="floor_drift", parameters={"dx": 0.02, "dy": -0.01}),
)
MOUNTED = SWERVE.model_copy(update={"mount": Mount(x=0.3, y=-0.1, yaw=0.4)})


def config(folder: Path, using: Calibration, **changes: object) -> LiveConfig:
    made = config_of(folder, "base", **changes)
    write_calibration(using, folder / "calibration.yaml")
    return made


def heard(session: zenoh.Session, samples: list[JointState]) -> Array:
    """The odometry that a node makes of some samples."""
    messages = ReceivedMessages(session, base__odom=ODOMETRY)
    wheels = session.declare_publisher("base/joint_states")
    until(lambda: wheels.matching_status.matching, "the node's subscription")
    sent_one_by_one(wheels, samples, messages["base__odom"])
    return np.array([each.pose for each in messages["base__odom"]])


@pytest.mark.parametrize("effects", [(), SLIPPING], ids=["plain", "with effects"])
def test_a_swerve_base_is_at_the_batch_odometry(tmp_path: Path, effects: tuple[EffectTerm, ...]) -> None:
    path = drive(using=calibration(effects=effects, covariance=None))
    with running(config(tmp_path, path.using)) as (_, session):
        poses = heard(session, path.samples())
    agrees(poses, path)


def test_a_node_that_starts_again_goes_on_exactly(tmp_path: Path) -> None:
    path = drive()
    chosen = config(tmp_path, path.using, state="state", fusion="none")
    with running(chosen) as (_, session):
        before = heard(session, path.samples()[:51])
    with running(chosen) as (_, session):
        after = heard(session, path.samples()[51:])
    agrees(np.concatenate([before, after]), path)


def agrees(poses: Array, path: SteeredDrive) -> None:
    """Headings on the wire lie within a turn."""
    np.testing.assert_allclose(poses[:, :2], path.poses[:, :2], atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * poses[:, 2]), np.exp(1j * path.poses[:, 2]), atol=1e-12)


@pytest.mark.parametrize("robot", [SWERVE, MOUNTED], ids=["centre", "mounted"])
def test_a_replay_shows_the_batch_odometry_of_the_tracked_point_and_is_recorded(tmp_path: Path, robot: Robot) -> None:
    using = calibration(robot)
    made = config(tmp_path, using, record="run.mcap", replay={"speed": "max", "slam": {"period": 0.1, "delay": 0.0}})
    played = recording(using=using)
    shown = demonstrate(made, played)
    assert shown.batch_difference < 1e-12
    assert shown.calibrated.final_position < 1e-9 < 1e-4 < shown.theoretical.final_position
    assert shown.fused is not None
    assert shown.fused.final_position < 0.05
    assert len(messages_of(tmp_path / "run.mcap")["/base/joint_states"]) == shown.report.sent["joint_states"]


def test_a_replay_counts_every_turn_by_which_the_odometry_is_off(tmp_path: Path) -> None:
    design = DIFFERENTIAL.inverse_kinematic_matrix
    using = calibration(DIFFERENTIAL, matrix=matrix_rows(design * [[1.0], [1.0], [0.4]]))
    times, rates = PERIOD * np.arange(1, 401), np.tile([-4.0, 4.0], (400, 1))
    log = WheelLog(times, rates, np.zeros(3), np.append(0.0, times[9::10]))
    poses = using.model.poses([log])[0]
    run = Trajectory("turn", "train", times, rates, log.stamps, poses)
    made = config(tmp_path, using, replay={"speed": "max", "slam": {"period": 0.1, "delay": 0.0}})
    shown = demonstrate(made, Recording(Dataset("turns", using.robot, PERIOD, (run,))))
    headings = np.append(0.0, times * (design[2] @ rates[0]))
    assert poses[-1, 2] > np.pi
    assert 0.6 * headings[-1] > np.pi
    assert shown.theoretical.heading == pytest.approx(float(np.sqrt(np.mean((0.6 * headings) ** 2))), rel=1e-6)
    assert shown.calibrated.heading < 1e-9
    assert shown.batch_difference < 1e-9
    assert shown.fused is not None
    assert shown.fused.heading < 0.05


def test_info_names_steered_wheels_signals_and_the_tracked_point(tmp_path: Path) -> None:
    with running(config(tmp_path, calibration(MOUNTED))) as (_, session):
        info = asked(session, "omnibench/base/info")
    assert info["steered"] == ["fl", "fr", "rl", "rr"]
    assert info["signals"][:2] == ["fl_cos", "fl_sin"]
    assert info["mount"] == {"x": 0.3, "y": -0.1, "yaw": 0.4}


def test_a_recording_of_a_robot_that_steers_otherwise_is_refused(tmp_path: Path) -> None:
    fixed = SWERVE.model_copy(update={"wheels": SWERVE.wheels[:2]})
    with pytest.raises(DataError, match="for robot 'base' has fl, fr; take a calibration of the same robot"):
        demonstrate(config(tmp_path, calibration()), recording(using=calibration(fixed)))
