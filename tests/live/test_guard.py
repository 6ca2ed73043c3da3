"""The guard on drives that guard_study.py simulates, by code that shares nothing with it, and on recordings."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Literal

import numpy as np
import pytest
from guard_study import HEADING, PLACE, STEP, Drive, Truth, befallen, calibrated, commands, driven, moving, watched
from real_recordings import OPTIODOM

import omnibench
from omnibench.config import to_json
from omnibench.errors import DataError
from omnibench.live.fusion import FusionSettings
from omnibench.live.guard import Guard
from omnibench.live.guarding import watch_recording
from omnibench.live.health import Alarm, diagnostics
from omnibench.live.tracker import RobotTracker
from omnibench.live.wire import JOINT_STATE, POSE_ESTIMATE, JointState, PoseEstimate
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array
from omnibench.robot.physical import directions_of

CHANGED = 2000  # step at which something happens: after 100 s


@pytest.fixture(scope="module", params=["differential", "omni"])
def robot(request: pytest.FixtureRequest) -> tuple[Truth, Calibration]:
    """A simulated robot and its calibration by runs of its own."""
    rng = np.random.default_rng(4)
    truth = Truth.drawn(request.param, rng)
    return truth, calibrated(truth, rng)


def told(calibration: Calibration, drive: Drive, seed: int = 0, slam: Array | None = None) -> Guard:
    """A guard that has watched a drive with SLAM."""
    guard = Guard(calibration)
    for _ in watched(guard, drive, np.random.default_rng(seed), slam):
        pass
    return guard


def drive_of(
    truth: Truth, seconds: float = 300.0, seed: int = 1, then: Truth | None = None, lasting: float | None = None
) -> Drive:
    """A drive at random. then: what the robot becomes; lasting: s after which it is as before again."""
    rng = np.random.default_rng(seed)
    changes = [] if then is None else [(CHANGED, then)]
    if lasting is not None:
        changes.append((CHANGED + round(lasting / STEP), truth))
    return driven(truth, commands(truth.kind, seconds, rng), rng, *changes)


def test_a_robot_that_drives_as_calibrated_is_left_alone(robot: tuple[Truth, Calibration]) -> None:
    truth, calibration = robot
    guard = told(calibration, drive_of(truth, 600.0))
    assert guard.alarms == []
    assert guard.proposals == []
    assert guard.proposed() is None


def test_the_wheel_that_changed_is_named_with_its_radius_and_proposed(robot: tuple[Truth, Calibration]) -> None:
    truth, calibration = robot
    wheel = list(truth.wheels)[1]
    changed = truth.changed(f"radius_{wheel}", -0.01)
    guard = told(calibration, drive_of(truth, then=changed))
    (alarm,) = guard.alarms
    assert (alarm.kind, alarm.name, alarm.alternatives) == ("change", f"radius_{wheel}", ())
    assert alarm.detected_after_m < 20
    assert alarm.t > CHANGED * STEP
    assert alarm.low is not None
    assert alarm.high is not None
    assert alarm.low < alarm.high
    assert alarm.value == pytest.approx(changed.wheels[wheel][0], rel=2e-3)
    (proposal,) = guard.proposals
    assert proposal.accepted
    assert not proposal.rolled_back
    proposed = guard.proposed()
    assert proposed is not None
    again = told(proposed, drive_of(changed, 300.0, seed=2))
    assert again.alarms == []
    # what comes after it was accepted makes its value surer
    (later,) = told(calibration, drive_of(truth, 900.0, then=changed)).proposals
    assert later.high is not None
    assert later.low is not None
    assert proposal.high is not None
    assert proposal.low is not None
    assert later.high - later.low < proposal.high - proposal.low
    assert later.value == pytest.approx(changed.wheels[wheel][0], rel=5e-4)


def test_two_changes_one_after_the_other_are_both_accepted() -> None:
    rng = np.random.default_rng(4)
    truth = Truth.drawn("differential", rng)
    calibration = calibrated(truth, rng)
    smaller = truth.changed("radius_left", -0.01)
    wider = smaller.changed("track", 0.015)
    drive = driven(truth, commands("differential", 900.0, rng), rng, (CHANGED, smaller), (3 * CHANGED, wider))
    guard = told(calibration, drive)
    assert [alarm.name for alarm in guard.alarms] == ["radius_left", "track"]
    assert [(each.name, each.verdict) for each in guard.proposals] == [
        ("radius_left", "accepted"),
        ("track", "accepted"),
    ]
    radius, track = (each.value for each in guard.proposals)
    assert radius == pytest.approx(smaller.wheels["left"][0], rel=1e-3)
    assert track == pytest.approx(wider.wheels["left"][2] - wider.wheels["right"][2], rel=2e-3)


def test_a_proposal_is_taken_back_when_later_motion_is_as_before(robot: tuple[Truth, Calibration]) -> None:
    truth, calibration = robot
    wheel = next(iter(truth.wheels))
    changed = truth.changed(f"radius_{wheel}", -0.015)
    lasting = {"differential": 12.0, "omni": 17.0}[truth.kind]
    guard = told(calibration, drive_of(truth, 400.0, then=changed, lasting=lasting))
    assert [alarm.name for alarm in guard.alarms] == [f"radius_{wheel}"]
    (proposal,) = guard.proposals
    assert proposal.passed
    assert "worse" in proposal.reason
    assert guard.settled
    assert guard.accepted == {}
    assert guard.proposed() is None


@pytest.mark.parametrize(
    ("what", "kind", "names"),
    [
        ("push", "burst", ("push", "slip")),
        ("edge", "burst", ("push", "slip")),
        ("jump", "reference", ("reference_jump",)),
        ("encoder", "fault", ("encoder_",)),
        ("scale", "reference", ("reference_scale",)),
    ],
)
def test_what_passes_is_told_as_such_and_changes_no_parameter(
    robot: tuple[Truth, Calibration], what: str, kind: str, names: Sequence[str]
) -> None:
    truth, calibration = robot
    drive = drive_of(truth)
    start = moving(drive, CHANGED)
    changed, slam = befallen(drive, what, start, np.random.default_rng(3))
    guard = told(calibration, changed, slam=slam)
    assert {alarm.kind for alarm in guard.alarms} == {kind}
    assert all(alarm.name.startswith(tuple(names)) for alarm in guard.alarms)
    assert guard.proposed() is None


def test_a_first_pose_that_is_far_off_is_no_delay_of_the_reference(robot: tuple[Truth, Calibration]) -> None:
    truth, calibration = robot
    for seed in range(3):
        drive = drive_of(truth, 120.0, seed=seed)
        slam = drive.poses.copy()
        slam[0, :2] -= [0.15, 0.1]
        assert told(calibration, drive, slam=slam).alarms == []


def test_a_robot_that_stands_moves_no_parameter(robot: tuple[Truth, Calibration]) -> None:
    truth, calibration = robot
    still = drive_of(truth, 300.0)
    quiet = Drive(0 * still.signals, np.zeros_like(still.poses), 0 * still.rates, still.steering)
    guard = told(calibration, quiet)
    assert guard.alarms == []
    assert guard.metres == 0.0


def test_straight_driving_leaves_open_which_of_two_changed_and_says_what_to_drive(
    robot: tuple[Truth, Calibration],
) -> None:
    truth, calibration = robot
    wider = truth
    for name in truth.wheels:
        wider = wider.changed(f"radius_{name}", -0.02)
    rng = np.random.default_rng(0)
    twists = np.tile([0.5, 0.0, 0.0], (round(300 / STEP), 1))
    guard = told(calibration, driven(truth, twists, rng, (CHANGED, wider)))
    alarm = guard.alarms[0]
    assert {"floor", "reference_scale"} <= {alarm.name, *alarm.alternatives}
    assert "turn on the spot" in alarm.advice
    assert guard.proposed() is None


def changed_calibration(calibration: Calibration, name: str, share: float) -> Calibration:
    """A calibration with a wrong parameter."""
    design, slopes = directions_of(calibration.robot)[name]
    matrix = calibration.matrix_array + (share * design * slopes).reshape(3, -1)
    return calibration.model_copy(update={"matrix": tuple(map(tuple, matrix.tolist())), "parameters": None})


def test_a_real_robot_shows_which_radius_of_its_calibration_is_wrong() -> None:
    squares = OPTIODOM / "diff" / "square"
    if not squares.is_dir():
        pytest.skip(f"the recordings are not at {squares}")
    dataset = omnibench.import_dataset("optiodom", squares)
    calibration = omnibench.calibrate(dataset).calibration
    right, _ = watch_recording(calibration, dataset)
    assert not [alarm for alarm in right.alarms if alarm.kind == "change"]
    for name in ("radius_left", "radius_right"):
        wrong = changed_calibration(calibration, name, 0.01)
        report, _ = watch_recording(wrong, dataset)
        assert [alarm.name for alarm in report.alarms if alarm.kind == "change"] == [name]
        assert report.proposed is not None
        both = (calibration, report.proposed)
        before, after = (omnibench.evaluate(each, dataset).splits["all"].cost for each in both)
        assert after < 1.1 * before


def test_a_calibration_of_other_wheels_is_refused(robot: tuple[Truth, Calibration]) -> None:
    _, calibration = robot
    wheels = [{"name": n, "type": "fixed", "radius": 0.05, "x": 0, "y": y} for n, y in (("l", 0.1), ("r", -0.1))]
    other = omnibench.make_dataset(
        "other",
        omnibench.Robot.model_validate({"name": "cart", "wheels": wheels}),
        wheels={"t": [0.1, 0.2], "omega_l": [1.0, 1.0], "omega_r": [1.0, 1.0]},
        poses={"t": [0.0, 0.2], "x": [0.0, 0.01], "y": [0.0, 0.0], "theta": [0.0, 0.0]},
    )
    with pytest.raises(DataError, match="is for wheels"):
        watch_recording(calibration, other)


def test_the_json_of_an_alarm_has_the_fields_that_scripts_read() -> None:
    assert {"kind", "name", "value", "low", "high", "trajectory", "t", "detected_after_m", "alternatives"} <= set(
        json.loads(json.dumps(Alarm.model_json_schema()))["properties"]
    )


def messages(drive: Drive) -> list[tuple[bool, bytes]]:
    """The wheel samples of a differential drive and its SLAM poses, in CDR, in order; True for a pose."""
    rng, every = np.random.default_rng(5), round(0.25 / STEP)
    angles, stamp = np.cumsum(drive.rates * STEP, axis=0), 1_800_000_000 * 10**9
    sent = []
    for k in range(len(angles)):
        at = stamp + round((k + 1) * STEP * 1e9)
        sent.append((False, JOINT_STATE.encode(JointState(at, ("left", "right"), angles[k], drive.rates[k]))))
        if (k + 1) % every == 0:
            pose = drive.poses[k + 1] + np.array([PLACE, PLACE, HEADING]) * rng.standard_normal(3)
            covariance = np.diag([PLACE**2, PLACE**2, HEADING**2])
            sent.append((True, POSE_ESTIMATE.encode(PoseEstimate(at, "map", pose, covariance))))
    return sent


@pytest.mark.parametrize("guard", [True, "swap"])
def test_a_node_tells_the_change_and_drives_with_it_where_the_config_says_so(guard: bool | Literal["swap"]) -> None:
    rng = np.random.default_rng(4)
    truth = Truth.drawn("differential", rng)
    calibration = calibrated(truth, rng)
    tracker = RobotTracker("apr", calibration, fusion=FusionSettings(), guard=guard)
    changed = truth.changed("radius_left", -0.01)
    told: list[str] = []
    for number, (is_pose, payload) in enumerate(messages(drive_of(truth, 250.0, then=changed))):
        (tracker.take_pose if is_pose else tracker.take_wheels)(payload, number * STEP)
        if number % 25 == 0:
            told += tracker.watch()
    assert told[0].startswith("change radius_left is")
    assert told[-1].startswith("radius_left of")
    assert "accepted" in told[-1]
    health = tracker.health(number * STEP)
    assert health.guard is not None
    assert health.guard.changed == (guard != "swap")
    assert "radius_left" in health.guard.message
    odometry, status = diagnostics(health, "")
    assert (odometry.level, status.level) == (0, int(guard != "swap"))
    matrix = tracker.calibration.matrix_array
    if guard == "swap":
        assert health.counts["swaps"] >= 1  # and once more when the value is surer
        assert matrix[0, 0] / calibration.matrix_array[0, 0] == pytest.approx(0.99, abs=2e-3)
    else:
        assert tracker.calibration is calibration
    json.loads(to_json(health))
