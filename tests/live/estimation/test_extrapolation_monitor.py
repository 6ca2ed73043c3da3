"""A node whose robot drives motions that the calibration's effects were not fitted to."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from drives import ORIGIN, PERIOD, SECOND, calibration

from omnibench.live.estimation.extrapolation_monitor import ExtrapolationMonitor
from omnibench.live.estimation.health import diagnostic
from omnibench.live.estimation.tracker import RobotTracker
from omnibench.live.wheels.wheel_input import WheelStep
from omnibench.live.wire.messages import JOINT_STATE, JointState
from omnibench.robot.calibration import Calibration, EffectTerm

FORWARDS, SIDEWAYS, STANDING = (0.2, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.0)
SLIP = EffectTerm(name="centripetal_slip", parameters={"k": 0.03})
WARNING = (
    "apr: drives motions that 'synthetic 1' was not fitted to, such as driving straight at 0.20 m/s: centripetal_slip "
    "is not known to hold there, and errors may be larger than stated; told once, then counted in health"
)
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


def test_a_new_motion_is_told_once_and_its_seconds_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    watch = watched(steps(FORWARDS, 2), steps(SIDEWAYS, 4), steps(FORWARDS, 2), steps(SIDEWAYS, 3))
    assert warnings(caplog) == [WARNING]
    assert watch.seconds == pytest.approx(7.0, abs=0.1)


def test_nothing_is_told_before_it_has_lasted_for_a_second(caplog: pytest.LogCaptureFixture) -> None:
    watched(steps(SIDEWAYS, 0.9))
    assert warnings(caplog) == []
    watched(steps(SIDEWAYS, 1.6))
    assert warnings(caplog) == [WARNING]


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
def test_nothing_is_watched_where_nothing_is_at_stake(
    changes: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    assert watched(steps(SIDEWAYS, 5), by=fitted(**changes)).seconds is None
    assert warnings(caplog) == []


def feed(robot: RobotTracker, twist: Twist, seconds: float, begin: float) -> None:
    """Wheel messages with counters that go on from rest at 0."""
    rates = np.linalg.solve(calibration().matrix_array, twist)
    for sample in range(round(seconds / PERIOD) + 1):
        now = begin + sample * PERIOD
        message = JointState(ORIGIN + round(now * SECOND), ("a", "b", "c"), now * rates, rates)
        robot.take_wheels(JOINT_STATE.encode(message), now)


def test_health_and_diagnostics_show_the_seconds(caplog: pytest.LogCaptureFixture) -> None:
    robot = RobotTracker("apr", fitted())
    feed(robot, SIDEWAYS, 3.0, 0.0)
    assert warnings(caplog) == [WARNING]
    health = robot.health(3.0)
    assert health.unfitted_motion_s == pytest.approx(3.0, abs=0.1)
    assert ("unfitted_motion_s", f"{health.unfitted_motion_s:.1f}") in diagnostic(health, "").values


def test_another_calibration_is_watched_for_itself(caplog: pytest.LogCaptureFixture) -> None:
    robot = RobotTracker("apr", fitted())
    feed(robot, SIDEWAYS, 3.0, 0.0)
    robot.swap(fitted(name="second", driven=(FORWARDS, SIDEWAYS)))
    feed(robot, SIDEWAYS, 3.0, 3.0 + PERIOD)
    assert robot.health(6.0).unfitted_motion_s == 0.0
    assert warnings(caplog) == [WARNING]
    robot.swap(calibration())
    assert robot.health(6.0).unfitted_motion_s is None
    assert "unfitted_motion_s" not in dict(diagnostic(robot.health(6.0), "").values)
