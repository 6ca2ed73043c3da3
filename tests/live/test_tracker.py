"""One robot, message by message: what is published, what is refused, what is remembered and what its health says."""

import json
import re
import time
import zlib
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import disk_that_takes
from drives import NOISE, ORIGIN, PERIOD, SECOND, calibration, drive, fed, odometry, slam, term, with_effects
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from omnibench.config import to_yaml
from omnibench.errors import ConfigError, DataError
from omnibench.live.fusion import FusionSettings
from omnibench.live.health import Counts, anomalies_in_words, diagnostics
from omnibench.live.odometry import ExtrapolationMonitor
from omnibench.live.state import RobotMemory, SavedState
from omnibench.live.topics import Update
from omnibench.live.tracker import PublishedStamps, RobotTracker
from omnibench.live.wheels import WheelSettings, WheelStep
from omnibench.live.wire import JOINT_STATE, JointState
from omnibench.robot.calibration import Calibration, matrix_rows, write_calibration
from omnibench.robot.odometry import Integration

DRIVE = drive(1.0)


def tracker(**options: Any) -> RobotTracker:
    return RobotTracker("apr", calibration(), **{"fusion": FusionSettings(), **options})


@pytest.fixture
def robot() -> RobotTracker:
    return tracker()


@pytest.mark.parametrize("integration", ["euler", "arc"])
@pytest.mark.parametrize("wheels", [3, 4])
def test_odom_is_the_batch_odometry_until_it_is_closed(integration: Integration, wheels: int) -> None:
    path = drive(5.0, using=calibration(integration=integration, wheels=wheels))
    robot = RobotTracker("apr", path.calibration)
    updates = fed(robot, path.payloads()[:-1])
    np.testing.assert_allclose(odometry(updates), path.poses[:-1], atol=1e-9)
    assert [update.stamp for update in updates] == path.stamps[:-1]
    robot.close()
    assert robot.take_wheels(path.payloads()[-1], 5.0) == []
    assert robot.counts.samples == 500


def test_covariances_come_from_the_calibration() -> None:
    path = drive(1.0, using=calibration(deviation=None))
    last = fed(RobotTracker("apr", path.calibration), path.payloads())[-1]
    assert last.covariance[2, 2] == pytest.approx(NOISE.walk_heading**2 * 1.0, rel=1e-6)
    assert last.twist_covariance[2, 2] == pytest.approx(NOISE.walk_heading**2 / 0.01, rel=1e-6)


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_odom_never_jumps_and_no_stamp_comes_twice_whatever_happens(data: st.DataObject) -> None:
    """Swaps, poses from anywhere, clocks that jump, messages lost, doubled and late, angles or rates."""
    path, rates = drive(1.0), data.draw(st.booleans())
    robot, shift = tracker(), 0
    updates: list[Update] = []
    arrivals: list[float] = []
    samples = path.samples()
    for index, sample in enumerate(samples):
        event = data.draw(
            st.sampled_from(["none"] * 12 + ["swap", "slam", "far", "jump", "lose", "twice", "late", "set", "reset"])
        )
        arrival = 0.01 * index
        if event == "swap":
            robot.swap(calibration(scale=data.draw(st.floats(0.7, 1.3))))
        elif event in ("slam", "far"):
            error = 1000.0 if event == "far" else data.draw(st.floats(-0.5, 0.5))
            robot.take_pose(slam(sample.stamp + shift - 5_000_000, [error, 1.0, 0.2]), arrival)
        elif event == "jump":
            shift += int(data.draw(st.sampled_from([-7200, -30, -2, -0.9, -0.15, 0.15, 0.5, 0.9, 2, 3600])) * SECOND)
        elif event == "set" and updates:
            robot.set_pose(np.array([9.0, 9.0, 1.0]), 0.01 * np.eye(3))
        elif event == "reset" and updates:
            robot.reset()
        sent = {"lose": [], "twice": [sample] * 2, "late": [sample, samples[max(index - 3, 0)]]}.get(event, [sample])
        for each in sent:
            chosen = replace(each, stamp=each.stamp + shift, positions=None if rates else each.positions)
            new = robot.take_wheels(JOINT_STATE.encode(chosen), arrival)
            updates += new
            arrivals += [arrival] * len(new)
    stamps = [update.stamp for update in updates]
    assert len(set(stamps)) == len(stamps)
    # No wheel turns faster than 3 rad/s: 0.3 m/s and 1.6 rad/s, times the largest scale, bound the robot's motion
    # in the time since the message before; 0.05 s for samples that wait until a clock's jump is confirmed.
    moved = np.diff(odometry(updates), axis=0) if len(updates) > 1 else np.zeros((0, 3))
    elapsed = np.diff(arrivals) + 0.05 if len(updates) > 1 else np.zeros(0)
    assert (np.hypot(moved[:, 0], moved[:, 1]) < 0.3 * 1.3 * elapsed).all()
    assert (np.abs(moved[:, 2]) < 1.6 * 1.3 * elapsed).all()


def test_time_backwards_is_counted_and_the_stream_goes_on(robot: RobotTracker) -> None:
    fed(robot, DRIVE.payloads()[:50])
    back = [JOINT_STATE.encode(replace(each, stamp=each.stamp - 100 * SECOND)) for each in DRIVE.samples()[50:]]
    updates = fed(robot, back, 0.5)
    assert robot.counts.clock_jumps == 1
    np.testing.assert_allclose(updates[-1].pose, DRIVE.poses[-1], atol=1e-9)
    assert robot.take_pose(slam(DRIVE.stamps[-1] - 100 * SECOND, DRIVE.poses[-1]), 1.0) == "located"


def giant() -> Calibration:
    """A calibration of a larger robot with the same wheels."""
    robot = calibration().robot
    wheels = tuple(each.model_copy(update={"radius": 5 * each.radius}) for each in robot.wheels)
    robot = robot.model_copy(update={"wheels": wheels, "name": "giant"})
    return calibration().model_copy(update={"robot": robot, "matrix": matrix_rows(robot.inverse_kinematic_matrix)})


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        (calibration(wheels=4), "wheels fl, fr, rl, rr, .* a, b, c"),
        (calibration(scale=30.0), "off the design"),
        (giant(), "off the design"),
        (with_effects(term("heading_drft", b=0.1)), "heading_drift"),
    ],
    ids=["another robot", "absurd", "giant", "unknown effect"],
)
def test_a_calibration_that_does_not_fit_is_refused_and_the_old_one_runs_on(other: Calibration, reason: str) -> None:
    path, robot = drive(0.5), tracker()
    running = robot.calibration
    with pytest.raises(DataError, match=reason):
        robot.swap(other)
    assert robot.calibration is running
    health = robot.health(0.0)
    assert (health.last_swap.accepted, robot.counts.swaps_refused) == (False, 1)
    np.testing.assert_allclose(odometry(fed(robot, path.payloads())), path.poses, atol=1e-9)


def test_after_a_silence_of_a_sender_of_rates_the_twist_is_true_and_the_pose_uncertain() -> None:
    robot = tracker(fusion=None)
    rates = np.array([2.0, -1.0, 0.5])
    times = [*np.arange(0, 1, 0.01), *np.arange(20, 20.05, 0.01)]
    updates = []
    for at in times:
        payload = JOINT_STATE.encode(JointState(ORIGIN + round(float(at) * SECOND), NAMES, None, rates))
        updates += robot.take_wheels(payload, float(at))
    twist = calibration().matrix_array @ rates
    for update in updates[1:]:
        np.testing.assert_allclose(update.twist, twist, atol=1e-9)
    before, after = updates[99].covariance, updates[100].covariance
    driven = float(np.hypot(*twist[:2])) * 19
    assert np.sqrt(after[0, 0] - before[0, 0]) > 0.25 * driven


def test_a_full_disk_costs_the_state_and_no_odometry(tmp_path: Path) -> None:
    robot = tracker(memory=RobotMemory(tmp_path, "apr"))
    with disk_that_takes(0):
        updates = fed(robot, DRIVE.payloads())
    assert len(updates) == 101
    assert robot.counts.failures > 0
    assert "File too large" in robot.health(1.0).last_refusal


def test_poses_that_wait_and_are_then_rejected_are_told(robot: RobotTracker) -> None:
    """SLAM whose stamps are always a little ahead of the wheels', a kilometre off."""
    path = drive(3.0)
    for index, payload in enumerate(path.payloads()):
        robot.take_wheels(payload, 0.01 * index)
        if index % 25 == 0:
            away = [1000.0 if index > 50 else 0.0, 0, 0]
            robot.take_pose(slam(path.stamps[index] + 10_000_000, path.poses[min(index + 1, 300)] + away), 0.01 * index)
    health = robot.health(3.0)
    assert health.status == "degraded"
    assert health.fusion.rejected_in_a_row == health.counts["pose_rejected"] > 5
    assert health.fusion.last_outcome in ("rejected", "waiting")


def test_every_pose_that_waits_in_vain_is_counted(robot: RobotTracker) -> None:
    fed(robot, DRIVE.payloads()[:50])
    for number in range(40):
        robot.take_pose(slam(DRIVE.stamps[50] + 10_000_000 * number, [0, 0, 0]), 0.5)
    fed(robot, DRIVE.payloads()[50:], 0.5)
    counts = robot.counts
    assert counts.poses + counts.pose_rejected + counts.pose_ahead == 40


NAMES = ("a", "b", "c")
TILTED = np.array([[1, 0.9, 0], [0.9, 1, 0], [0, 0, 1.0]])
LAST = ORIGIN + SECOND  # of the drive that comes before nonsense
NONSENSE: dict[str, tuple[str, bytes, str]] = {
    "nan": ("wheels", JOINT_STATE.encode(JointState(LAST + 1, NAMES, np.array([np.nan, 0, 0]))), "not_finite"),
    "other joints": ("wheels", JOINT_STATE.encode(JointState(LAST + 1, ("x", "y", "z"), np.zeros(3))), "wrong_joints"),
    "nothing to read": ("wheels", JOINT_STATE.encode(JointState(LAST + 1, NAMES)), "wrong_joints"),
    "garbage": ("wheels", b"\xde\xad\xbe\xef" * 40, "undecodable"),
    "nothing at all": ("wheels", b"", "undecodable"),
    "truncated": ("wheels", drive(0.1).payloads()[10][:-9], "undecodable"),
    "another type": ("wheels", slam(LAST, [0, 0, 0]), "undecodable"),
    "a garbled pose": ("poses", b"\xde\xad\xbe\xef" * 40, "pose_undecodable"),
    "no pose": ("poses", b"", "pose_undecodable"),
    "a pose of nan": ("poses", slam(LAST, [np.nan, 0, 0]), "pose_invalid"),
    "a pose of another frame": ("poses", slam(LAST, [0, 0, 0], frame="odom"), "pose_invalid"),
    "beyond the world": ("poses", slam(LAST, [1e9, 0, 0], TILTED), "pose_invalid"),
    "almost infinite": ("poses", slam(LAST, [1.7e308, 0.5e308, 0.1], TILTED), "pose_invalid"),
    "no covariance": ("poses", slam(LAST, [0, 0, 0], np.full((3, 3), np.nan)), "pose_default_covariance"),
    "a kilometre away": ("poses", slam(LAST - 20_000_000, [1000, 0, 0]), "pose_rejected"),
    "of an hour ago": ("poses", slam(LAST - 3600 * SECOND, [0, 0, 0]), "pose_too_late"),
    "of tomorrow": ("poses", slam(LAST + 86400 * SECOND, [0, 0, 0]), "pose_ahead"),
}


@pytest.mark.parametrize("what", NONSENSE)
def test_nonsense_is_counted_and_the_stream_goes_on(what: str) -> None:
    path, robot = drive(1.1), tracker()
    topic, payload, counter = NONSENSE[what]
    fed(robot, path.payloads()[:101])
    robot.take_pose(slam(path.stamps[90], [0, 0, 0]), 1.0)
    if topic == "wheels":
        assert robot.take_wheels(payload, 1.005) == []
    else:
        robot.take_pose(payload, 1.005)
    assert getattr(robot.counts, counter) == 1
    assert robot.counts.failures == 0
    after = fed(robot, path.payloads()[101:], 1.01)
    np.testing.assert_allclose(odometry(after), path.poses[101:], atol=1e-9)


@pytest.mark.parametrize("variance", [1.797e308, 0.0, -1.0, np.nan, np.inf])
def test_poses_without_covariance_get_the_default(variance: float, caplog: pytest.LogCaptureFixture) -> None:
    path, robot = drive(0.5), tracker(fusion=FusionSettings(pose_sigma=(0.2, 3.0)))
    fed(robot, path.payloads())
    for stamp in path.stamps[-2:]:
        robot.take_pose(slam(stamp, [1.0, 2.0, 0.5], np.diag([variance] * 3)), 0.5)
    assert (robot.counts.poses, robot.counts.pose_default_covariance, robot.counts.pose_invalid) == (2, 2, 0)
    assert 0.1 < robot.health(0.5).position_sigma_m <= 0.2
    (line,) = [each.getMessage() for each in caplog.records if "covariance of a pose is unknown" in each.getMessage()]
    assert "0.2 m and 3 deg" in line
    assert "pose_sigma" in line


def test_stamps_that_stand_still_are_said_and_arrival_takes_the_times_of_arrival() -> None:
    still = JOINT_STATE.encode(JointState(0, NAMES, None, np.array([2.0, -1.0, -1.0])))
    robot = tracker(fusion=None, stale_after=0.2)
    assert len(fed(robot, [still] * 100)) == 1
    assert robot.health(1.0).status == "stale"
    assert "`wheels: {stamps: arrival}`" in robot.health(1.0).message
    robot = tracker(fusion=None, wheels=WheelSettings(stamps="arrival"))
    updates = fed(robot, [still] * 100, time.monotonic())
    assert (len(updates), robot.counts.duplicates) == (100, 0)
    assert abs(updates[-1].stamp / SECOND - time.time()) < 30
    assert np.linalg.norm(updates[-1].pose[:2]) > 0


def test_joints_called_like_the_wheels_are_found_as_in_a_bag() -> None:
    robot, names = tracker(), ("b_wheel_joint", "base/A_wheel", "wheel_c")
    samples = [replace(each, names=names) for each in drive(0.1).samples()]
    assert len(fed(robot, [JOINT_STATE.encode(each) for each in samples])) == 11
    assert robot.counts.anomalies() == {}


def test_a_stale_stream_says_so_and_is_less_and_less_certain() -> None:
    robot = tracker(fusion=None, stale_after=0.5)
    assert robot.health(0.0).status == "waiting"
    fed(robot, DRIVE.payloads())
    healths = [robot.health(1.0 + seconds) for seconds in (0.1, 1.0, 5.0)]
    assert [health.status for health in healths] == ["ok", "stale", "stale"]
    sigmas = [health.position_sigma_m for health in healths]
    assert sigmas[0] < sigmas[1] < sigmas[2]


def test_health_says_when_slam_is_silent(robot: RobotTracker) -> None:
    path = drive(3.0)
    fed(robot, path.payloads()[:10])
    assert robot.health(0.1).message == "no pose of SLAM yet"
    robot.take_pose(slam(path.stamps[5], [0, 0, 0]), 0.1)
    assert robot.health(0.1).status == "ok"
    fed(robot, path.payloads()[10:], 0.1)
    assert robot.health(3.0).status == "degraded"


def test_poses_between_samples_are_at_constant_twist_and_others_are_refused(robot: RobotTracker) -> None:
    with pytest.raises(DataError, match="has sent no wheel sample yet"):
        robot.pose_at()
    fed(robot, DRIVE.payloads())
    middle = robot.pose_at(ORIGIN + round(0.505 * SECOND)).odometry
    np.testing.assert_allclose(middle[2], DRIVE.poses[50:52, 2].mean(), atol=1e-9)
    with pytest.raises(DataError, match=r"is not within 1800000000\.\d+ to 1800000001\.000000 s"):
        robot.pose_at(ORIGIN - SECOND)


def test_without_fusion_there_is_no_pose_to_set() -> None:
    robot = tracker(fusion=None)
    with pytest.raises(DataError, match="without fusion"):
        robot.set_pose(np.zeros(3), np.eye(3))
    with pytest.raises(DataError, match="reset"):
        robot.reset()


def test_a_robot_goes_on_where_it_was_after_its_node_was_killed(tmp_path: Path) -> None:
    path = drive(2.0)
    memory = RobotMemory(tmp_path, "apr")
    robot = tracker(memory=memory)
    fed(robot, path.payloads()[:100])
    robot.take_pose(slam(path.stamps[90], path.poses[90] + [3, 0, 0]), 1.0)
    fed(robot, path.payloads()[100:111], 1.0)
    memory.close()  # no word of farewell: what was saved by then, 0.1 s apart, is all there is

    memory = RobotMemory(tmp_path, "apr")
    again, saved = tracker(memory=memory), memory.load()
    again.resume(saved, now=1.3, wall=saved.wall + 0.2)
    updates = fed(again, path.payloads()[130:], 1.3)
    # the wheels' angles bridge what nobody saw, as one arc
    np.testing.assert_allclose(updates[-1].pose, path.poses[-1], atol=0.01)
    np.testing.assert_allclose(updates[-1].in_map[0], path.poses[-1] + [3, 0, 0], atol=0.02)
    assert updates[0].stamp == path.stamps[130]
    memory.close()


def test_a_node_that_was_killed_before_its_first_wheel_sample_leaves_what_it_had_acknowledged(tmp_path: Path) -> None:
    path = drive(1.0)
    memory = RobotMemory(tmp_path, "apr")
    robot = tracker(memory=memory)
    fed(robot, path.payloads()[:50])
    robot.close()

    memory = RobotMemory(tmp_path, "apr")
    again, saved = tracker(memory=memory), memory.load()
    again.resume(saved, now=5.0, wall=saved.wall + 3.0)
    again.flows[7] = 12  # poses of SLAM alone, by a replay
    again.save()
    memory.close()

    memory = RobotMemory(tmp_path, "apr")
    left = memory.load()
    memory.close()
    assert left.flows == {7: 12}
    assert (left.stamp, left.pose) == (saved.stamp, saved.pose)
    assert left.wall == pytest.approx(saved.wall, abs=60.0)


def test_two_nodes_cannot_share_a_robots_memory(tmp_path: Path) -> None:
    with closing(RobotMemory(tmp_path, "apr")), pytest.raises(ConfigError, match=r"apr\.state\.json: another node"):
        RobotMemory(tmp_path, "apr")


def test_every_anomaly_is_named_with_its_number() -> None:
    every = Counts(**{field.name: 2 for field in fields(Counts)}).anomalies()
    assert anomalies_in_words(every).count(": 2") == len(every)
    assert anomalies_in_words({"missing": 1, "pose_invalid": 3}) == "wheel samples missing: 1, poses invalid: 3"


FORWARDS, SIDEWAYS, STANDING = (0.2, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.0)
SLIP = term("centripetal_slip", k=0.03)
Twist = tuple[float, float, float]


def fitted(**changes: Any) -> Calibration:
    """Fitted to driving forwards, unless it is changed."""
    return calibration().model_copy(update={"effects": (SLIP,), "covariance": None, "driven": (FORWARDS,)} | changes)


def steps(twist: Twist, seconds: float, blind: float = 0.0) -> list[WheelStep]:
    rates = np.linalg.solve(calibration().matrix_array, twist)
    return [WheelStep(0, PERIOD, PERIOD * rates, rates, blind) for _ in range(round(seconds / PERIOD))]


def watched(*driven: list[WheelStep], by: Calibration | None = None) -> ExtrapolationMonitor:
    watch = ExtrapolationMonitor("apr", by or fitted())
    for each in driven:
        for step in each:
            watch.take(step, step.angles)
    return watch


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records]


def assert_warned_once(caplog: pytest.LogCaptureFixture) -> None:
    (warning,) = warnings(caplog)
    for part in ("apr: ", "'synthetic 1'", "driving straight at 0.20 m/s", "centripetal_slip"):
        assert part in warning


def test_a_new_motion_is_told_once_and_its_seconds_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    watch = watched(steps(FORWARDS, 2), steps(SIDEWAYS, 4), steps(FORWARDS, 2), steps(SIDEWAYS, 3))
    assert_warned_once(caplog)
    assert watch.seconds == pytest.approx(7.0, abs=0.1)


def test_nothing_is_told_before_it_has_lasted_for_a_second(caplog: pytest.LogCaptureFixture) -> None:
    watched(steps(SIDEWAYS, 0.9))
    assert warnings(caplog) == []
    watched(steps(SIDEWAYS, 1.6))
    assert_warned_once(caplog)


@pytest.mark.parametrize(
    "driven",
    [
        [steps(FORWARDS, 5)],
        [steps(STANDING, 5)],
        [*[steps(FORWARDS, 1), steps(SIDEWAYS, 0.5)] * 5],
        [steps(SIDEWAYS, 5, blind=PERIOD)],
    ],
    ids=["a known one", "standing", "in passing", "out of sight"],
)
def test_other_motions_do_not_count(driven: list[list[WheelStep]], caplog: pytest.LogCaptureFixture) -> None:
    assert watched(*driven).seconds == 0.0
    assert warnings(caplog) == []


@pytest.mark.parametrize("changes", [{"driven": None}, {"driven": ()}, {"effects": ()}])
def test_nothing_is_watched_without_a_stake(changes: dict[str, Any], caplog: pytest.LogCaptureFixture) -> None:
    assert watched(steps(SIDEWAYS, 5), by=fitted(**changes)).seconds is None
    assert warnings(caplog) == []


def feed(robot: RobotTracker, twist: Twist, seconds: float, begin: float) -> None:
    """Wheel messages with counters that go on from rest at 0."""
    rates = np.linalg.solve(calibration().matrix_array, twist)
    for sample in range(round(seconds / PERIOD) + 1):
        now = begin + sample * PERIOD
        message = JointState(ORIGIN + round(now * SECOND), ("a", "b", "c"), now * rates, rates)
        robot.take_wheels(JOINT_STATE.encode(message), now)


def test_health_and_diagnostics_show_the_seconds_of_each_calibration(caplog: pytest.LogCaptureFixture) -> None:
    robot = RobotTracker("apr", fitted())
    feed(robot, SIDEWAYS, 3.0, 0.0)
    health = robot.health(3.0)
    assert health.unfitted_motion_s == pytest.approx(3.0, abs=0.1)
    assert ("unfitted_motion_s", f"{health.unfitted_motion_s:.1f}") in diagnostics(health, "")[0].values
    robot.swap(fitted(name="second", driven=(FORWARDS, SIDEWAYS)))
    feed(robot, SIDEWAYS, 3.0, 3.0 + PERIOD)
    assert robot.health(6.0).unfitted_motion_s == 0.0
    assert_warned_once(caplog)
    robot.swap(calibration())
    assert robot.health(6.0).unfitted_motion_s is None
    assert "unfitted_motion_s" not in dict(diagnostics(robot.health(6.0), "")[0].values)


# What a node remembers of a robot, on a real disk, and of the stamps that it has published.

STATE: dict[str, Any] = {
    "sequence": 5,
    "stamp": 10**18,
    "wall": 1.8e9,
    "positions": [1.0, 2.0, 3.0],
    "pose": [1.0, 2.0, 0.3],
    "covariance": [1e-4, 0, 0, 0, 1e-4, 0, 0, 0, 1e-5],
}


@pytest.fixture
def memory(tmp_path: Path) -> Iterator[RobotMemory]:
    opened = RobotMemory(tmp_path, "apr")
    yield opened
    opened.close()


def loaded(folder: Path, content: bytes) -> SavedState | None:
    """What a node makes of such a file."""
    (folder / "apr.state.json").write_bytes(content)
    memory = RobotMemory(folder, "apr")
    try:
        return memory.load()
    finally:
        memory.close()


def with_checksum(document: dict[str, Any]) -> bytes:
    """The line of a state."""
    text = json.dumps(document).encode()
    return b"%08x %s\n" % (zlib.crc32(text), text)


@pytest.mark.parametrize("wheels", [3, 12, 200, 2000])
def test_the_newest_state_of_any_number_of_wheels_comes_back_as_it_was(memory: RobotMemory, wheels: int) -> None:
    angles = tuple((np.pi * 10.0 ** np.arange(wheels).clip(max=9)).tolist())
    for stamp in range(3):
        state = SavedState(**STATE | {"stamp": stamp, "positions": angles})
        memory.save(state)
        assert memory.load() == state.model_copy(update={"sequence": memory.load().sequence})


@pytest.mark.parametrize(
    "content",
    [b"\x00" * 8192, b"[" * 4096, b"00000000 {", with_checksum({}) * 2, json.dumps(STATE).encode().ljust(4095) + b"\n"],
    ids=["zeros", "brackets", "torn", "nothing in it", "of a version without checksums"],
)
def test_what_is_no_state_is_left_aside(tmp_path: Path, caplog: pytest.LogCaptureFixture, content: bytes) -> None:
    assert loaded(tmp_path, content) is None
    assert ("earlier version" in caplog.text) == (b"positions" in content)


@pytest.mark.parametrize(
    "change",
    [
        {"covariance": [1e-4] * 8},
        {"covariance": [-1e-4, 0, 0, 0, 1e-4, 0, 0, 0, 1e-5]},
        {"map_covariance": [1e-4] * 10},
        {"pose": [1.0, float("inf"), 0.3]},
        {"pose": [1.0, 2.0]},
        {"stamp": 10**30},
        {"more": 1},
        {"pose": [1e300, 2.0, 0.3]},
        {"map_pose": [0.0, -1e10, 0.0]},
        {"covariance": [1e300, 0, 0, 0, 1e-4, 0, 0, 0, 1e-5]},
        {"positions": [1.0, 1e300, 3.0]},
        {"wall": 1e300},
        {"sequence": 2**64},
        {"flows": {"1": 2**64}},
    ],
)
def test_a_damaged_state_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture, change: dict[str, Any]) -> None:
    assert loaded(tmp_path, with_checksum(STATE)) is not None
    assert not caplog.text
    assert loaded(tmp_path, with_checksum(STATE | change)) is None
    assert "apr.state.json: damaged" in caplog.text


@pytest.mark.parametrize("wheels", [3, 12, 200])
def test_no_part_of_a_write_torn_at_any_sector_is_taken(tmp_path: Path, memory: RobotMemory, wheels: int) -> None:
    def save(step: int) -> bytes:
        place, angles = [np.pi * step] * 3, (np.pi * (np.arange(wheels) + step)).tolist()
        covariance = (1e-4 * np.pi * step * (np.eye(3) + 0.1)).ravel().tolist()
        poses = {"pose": place, "covariance": covariance, "map_pose": place, "map_covariance": covariance}
        memory.save(SavedState(**STATE | poses | {"stamp": step, "positions": angles}))
        return (tmp_path / "apr.state.json").read_bytes()

    for step in range(1, 9):
        before = save(step)
    after = save(9)
    memory.close()
    taken = []
    for sector in range(0, len(after) + 512, 512):
        for torn in (after[:sector] + before[sector:], before[:sector] + after[sector:]):
            state = loaded(tmp_path, torn)
            taken.append((torn == after, torn == before, state.stamp))
            assert state.pose == state.map_pose == (np.pi * state.stamp,) * 3
    assert {stamp for whole, _, stamp in taken if whole} == {9}
    assert {stamp for whole, _, stamp in taken if not whole} == {8}
    assert sum(not whole and not untouched for whole, untouched, _ in taken) >= 2


@pytest.mark.parametrize(("file_changes", "runs"), [(False, "synthetic 1.1"), (True, "synthetic 0.9")])
def test_a_swap_is_kept_until_the_first_file_changes(tmp_path: Path, file_changes: bool, runs: str) -> None:
    file, elsewhere = tmp_path / "calibration.yaml", tmp_path / "elsewhere.yaml"
    write_calibration(calibration(), file)
    with closing(RobotMemory(tmp_path / "state", "apr")) as memory:
        memory.calibration(file)
        file.rename(elsewhere)  # while the node runs
        memory.keep_calibration(calibration(scale=1.1))
        elsewhere.rename(file)
        if file_changes:
            write_calibration(calibration(scale=0.9), file)
        assert memory.calibration(file).name == runs


def test_a_calibration_that_the_disk_refuses_or_has_damaged_is_named(tmp_path: Path, memory: RobotMemory) -> None:
    kept, file = tmp_path / "apr.calibration.yaml", tmp_path / "calibration.yaml"
    kept.mkdir()
    with pytest.raises(DataError, match=re.escape(kept.name)):
        memory.keep_calibration(calibration())
    kept.rmdir()
    file.write_text(to_yaml(calibration()))
    kept.write_text("instead_of: 1\n")
    with pytest.raises(DataError, match=rf"remove {re.escape(str(kept))} .*{re.escape(str(file))}"):
        memory.calibration(file)


def test_a_closed_memory_writes_nothing_more(tmp_path: Path) -> None:
    memory = RobotMemory(tmp_path, "apr")
    memory.save(SavedState(**STATE))
    memory.close()
    memory.close()
    before = (tmp_path / "apr.state.json").read_bytes()
    memory.save(SavedState(**STATE))  # of a sample that was on its way
    assert (tmp_path / "apr.state.json").read_bytes() == before


STAMP_PERIOD = 10**7  # ns


@given(st.lists(st.integers(0, 300), max_size=300), st.lists(st.integers(0, 10**18), unique=True, max_size=100))
def test_no_stamp_comes_twice_and_one_that_is_new_stays_as_it_is(stamps: list[int], new: list[int]) -> None:
    published = PublishedStamps()
    given_out = [published.unique(stamp) for stamp in stamps]
    assert len(set(given_out)) == len(given_out)
    for order in (new, sorted(new)):
        published = PublishedStamps()
        assert [published.unique(stamp) for stamp in order] == order


@given(st.lists(st.integers(0, 60), max_size=300), st.integers(1, 40))
def test_no_stamp_comes_twice_among_those_that_are_remembered(stamps: list[int], remembered: int) -> None:
    published = PublishedStamps(remembered)
    given_out = [published.unique(stamp) for stamp in stamps]
    for begin in range(len(given_out)):
        latest = given_out[begin : begin + remembered + 1]
        assert len(set(latest)) == len(latest)


def test_a_clock_that_jumps_back_over_and_over_repeats_no_stamp() -> None:
    published = PublishedStamps(remembered=1000)
    given_out = [published.unique(STAMP_PERIOD * (k % 100)) for k in range(900)]
    assert len(set(given_out)) == 900
    assert max(abs(out - STAMP_PERIOD * (k % 100)) for k, out in enumerate(given_out)) <= 9  # ns


def test_old_stamps_are_forgotten_and_memory_stays_flat() -> None:
    published = PublishedStamps(remembered=1000)
    for stamp in range(20_000):
        published.unique(stamp)
    assert len(published) == 1000
    assert published.unique(19_500) != 19_500  # among the latest thousand


@pytest.mark.parametrize(
    "stamps",
    [
        pytest.param(
            [STAMP_PERIOD * (k // 2) - 10 * SECOND * (k % 2) for k in range(30_000)], id="two clocks, 10 s apart"
        ),
        pytest.param([STAMP_PERIOD * (k % 1000) for k in range(30_000)], id="a recording of 10 s in a loop"),
        pytest.param([STAMP_PERIOD * (k % 3) for k in range(30_000)], id="three stamps in a loop"),
        pytest.param([STAMP_PERIOD * (k % 3) - SECOND * (k // 3) for k in range(30_000)], id="ever further back"),
        pytest.param([STAMP_PERIOD * (k * 7919 % 29_989) for k in range(30_000)], id="no order at all"),
    ],
)
def test_a_clock_gone_wild_costs_a_sample_no_more_than_20_us(stamps: Iterable[int]) -> None:
    published = PublishedStamps()
    begin = time.thread_time()
    given_out = [published.unique(stamp) for stamp in stamps]
    seconds = time.thread_time() - begin
    assert seconds / len(given_out) < 20e-6
    assert len(set(given_out)) == len(given_out)
