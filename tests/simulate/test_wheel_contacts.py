"""True kinematics of simulated robots, from where their wheels touch the floor, and their true motion."""

from __future__ import annotations

import math

import numpy as np
import pytest
from config_robots import NAMES, robot
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02

from omnibench.robot.kinematics import Mount, Robot, Wheel
from omnibench.robot.odometry import Path
from omnibench.simulate.mechanics import TrueMotion, WheelContacts

REAR = Robot(
    name="behind its centre, and rolling to its side",
    wheels=tuple(
        Wheel(name=name, type="fixed", radius=0.05, x=x, y=-0.3, angle=math.pi / 2)
        for name, x in (("a", 0.2), ("b", -0.2))
    ),
    mount=Mount(x=0.1, y=-0.05, yaw=0.3),
)
rates_of_wheels = st.floats(-10, 10).filter(lambda rate: abs(rate) > 0.1)


@pytest.mark.parametrize("design", [*map(robot, NAMES), APR_02, REAR], ids=lambda design: design.name)
def test_wheels_as_designed_move_the_robot_by_the_design_matrix(design: Robot) -> None:
    matrix = WheelContacts(design, design.wheels, (), design.mount).matrix
    np.testing.assert_allclose(matrix, design.inverse_kinematic_matrix, atol=1e-9)


@given(rates_of_wheels, st.floats(-1.3, 1.3), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_no_wheel_of_a_tricycle_slides_whatever_its_front_wheel_is_off(
    rate: float, angle: float, aside: float, offset: float
) -> None:
    design = robot("tricycle")
    front, *rear = design.wheels
    contacts = WheelContacts(design, [front.model_copy(update={"y": aside}), *rear], [offset])
    vx, vy, turn = contacts.twists(np.array([[rate]]), np.array([[angle]]))[0]
    assert vy == pytest.approx(0, abs=1e-12)
    over_front = complex(vx - aside * turn, 0.6 * turn)
    assert over_front == pytest.approx(0.1 * rate * complex(math.cos(angle + offset), math.sin(angle + offset)))


@given(st.floats(0.0, 5.0))
def test_lateral_friction_widens_the_track_of_a_skid_steered_robot(friction: float) -> None:
    design = robot("skid")
    rates = np.array([[-1.0, 1.0, -1.0, 1.0]])  # on the spot, at 0.1 m/s on each side
    turn = WheelContacts(design, design.wheels, lateral_friction=friction).twists(rates, None)[0, 2]
    assert turn == pytest.approx(0.1 / (0.25 + friction * 0.2**2 / 0.25), rel=1e-8)


@given(st.floats(0.1, 10), st.floats(-0.5, 0.5))
def test_the_axles_of_a_car_meet_in_one_point_and_its_rear_wheels_turn_as_they_roll(rate: float, turned: float) -> None:
    design = robot("car")
    contacts = WheelContacts(design, design.wheels)
    signals = np.array([[rate, rate * math.tan(turned), 0.0]])
    rates, steering = design.drive.commands(signals)
    (twist,) = contacts.twists(rates, steering)
    assert twist[2] == pytest.approx(twist[0] * math.tan(turned) / 0.6, abs=1e-12)
    rolling = contacts.rolling_rates(twist[None])[0]
    assert rolling.mean() == pytest.approx(rate)
    assert rolling[1] - rolling[0] == pytest.approx(twist[2] * 0.4 / 0.1, abs=1e-9)


@pytest.mark.parametrize("integration", ["arc", "euler"])
@given(twists=st.lists(st.tuples(*[st.floats(-3, 3)] * 5), min_size=1, max_size=5))
def test_the_true_motion_is_that_of_the_odometry_on_other_code(
    integration: str, twists: list[tuple[float, ...]]
) -> None:
    moved, drift = np.array(twists)[:, :3], np.array(twists)[:, 3:]
    times = 0.3 * np.arange(1, len(twists) + 1)
    start, stamps = np.array([1.0, -2.0, 0.5]), np.linspace(-0.1, times[-1] + 0.1, 11)
    way = "arc" if integration == "arc" else "euler"
    true = TrueMotion(times, start, moved, way, drift).poses(stamps)
    np.testing.assert_allclose(true, Path(times, start, 0.3 * moved, way, 0.3 * drift).poses(stamps), atol=1e-12)


@given(st.floats(-1e-3, 1e-3))
def test_a_slow_turn_loses_no_digits(turn: float) -> None:
    (pose,) = TrueMotion(np.array([1.0]), np.zeros(3), np.array([[1.0, 0.0, turn]]), "arc").poses(np.array([1.0]))
    assert pose == pytest.approx([1 - turn**2 / 6 + turn**4 / 120, turn / 2 - turn**3 / 24, turn], abs=1e-15, rel=1e-14)
