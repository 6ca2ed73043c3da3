"""The geometry of every kind of robot as what is searched."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from sample_robots import APR_02, CAR, DIFFERENTIAL, MECANUM, SKID, SWERVE, TRICYCLE, WHEELED

from omnibench.fit.geometry import WheelGeometry
from omnibench.fit.identifiability import identified_parameters
from omnibench.robot.kinematics import Array, Mount, Robot


def with_wheels(robot: Robot, change: Callable[[Any], dict[str, float]]) -> Robot:
    """A robot with other design values of its measured wheels."""
    return robot.model_copy(
        update={
            "wheels": tuple(
                wheel.model_copy(update=change(wheel)) if wheel in robot.measured else wheel for wheel in robot.wheels
            )
        }
    )


@pytest.mark.parametrize("robot", [pytest.param(robot, id=robot.name) for robot in (APR_02, *WHEELED)])
@pytest.mark.parametrize("fitted_mount", [False, True])
def test_the_design_values_have_the_design_matrix(robot: Robot, fitted_mount: bool) -> None:
    mounted = robot.model_copy(update={"mount": Mount(x=0.3, y=0.1, yaw=0.2)})
    geometry = WheelGeometry(mounted, fitted_mount=fitted_mount)
    found = geometry.matrices(geometry.start[None])[0]
    np.testing.assert_allclose(found, mounted.inverse_kinematic_matrix, rtol=0, atol=1e-15)
    assert ("mount_x" in geometry.names) == (fitted_mount and not robot.slides)


@pytest.mark.parametrize(
    ("robot", "kind", "change"),
    [
        (DIFFERENTIAL, "radius", lambda wheel: {"radius": 1.1 * wheel.radius}),
        (DIFFERENTIAL, "distance", lambda wheel: {"y": 1.2 * wheel.y}),
        (SKID, "distance", lambda wheel: {"y": 1.2 * wheel.y}),
        (TRICYCLE, "x", lambda wheel: {"x": wheel.x + 0.1}),
        (TRICYCLE, "y", lambda wheel: {"y": wheel.y + 0.1}),
        (SWERVE, "radius", lambda wheel: {"radius": 1.1 * wheel.radius}),
        (SWERVE, "x", lambda wheel: {"x": wheel.x + 0.1}),
    ],
)
def test_a_changed_number_has_the_matrix_of_a_robot_that_is_changed_so(
    robot: Robot, kind: str, change: Callable[[Any], dict[str, float]]
) -> None:
    changed = with_wheels(robot, change)
    vector = WheelGeometry(changed).start
    others = [index for index, name in enumerate(WheelGeometry(robot).names) if not name.startswith(kind)]
    np.testing.assert_array_equal(vector[others], WheelGeometry(robot).start[others])
    found = WheelGeometry(robot).matrices(vector[None])[0]
    np.testing.assert_allclose(found, changed.inverse_kinematic_matrix, rtol=0, atol=1e-15)


def test_an_offset_turns_the_signals_of_its_wheel() -> None:
    geometry = WheelGeometry(TRICYCLE)
    vector = geometry.start.copy()
    vector[geometry.names.index("offset_front")] = 0.1
    measured, true = np.array([[0.3]]), np.array([[0.4]])
    found = geometry.matrices(vector[None])[0] @ TRICYCLE.drive.signals(np.array([[2.0]]), measured)[0]
    expected = TRICYCLE.inverse_kinematic_matrix @ TRICYCLE.drive.signals(np.array([[2.0]]), true)[0]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)


def test_a_longer_wheelbase_turns_a_car_less() -> None:
    geometry = WheelGeometry(CAR)
    longer = geometry.matrices((geometry.start * [1.0, 1.25])[None])[0]
    np.testing.assert_allclose(longer, CAR.inverse_kinematic_matrix * [[1.0], [1.0], [0.8]], rtol=0, atol=1e-15)


def none_kept(robot: Robot) -> Array:
    return np.zeros((0, len(robot.drive.names)))


@pytest.mark.parametrize("robot", [DIFFERENTIAL, CAR], ids=lambda robot: robot.name)
def test_a_matrix_tells_the_geometry_of_a_robot_whose_tracked_point_is_known(robot: Robot) -> None:
    assert all(identified_parameters(WheelGeometry(robot), none_kept(robot)))


def test_the_side_of_a_tracked_point_is_not_told_apart_from_that_of_the_wheels() -> None:
    geometry = WheelGeometry(TRICYCLE, fitted_mount=True)
    told = dict(zip(geometry.names, identified_parameters(geometry, none_kept(TRICYCLE)), strict=True))
    assert [name for name, known in told.items() if not known] == ["y_front", "mount_y"]


def test_the_limits_of_a_mecanum_geometry_hold_its_design() -> None:
    bounds = WheelGeometry(MECANUM).bounds
    assert (bounds.lower < WheelGeometry(MECANUM).start).all()
    assert (bounds.upper > WheelGeometry(MECANUM).start).all()
