"""What is searched and in which box: matrix elements, and the wheel geometry of every kind of robot."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fit_samples import box_between, make_problem
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02, CAR, DIFFERENTIAL, MECANUM, SKID, SWERVE, TRICYCLE, WHEELED

from omnibench.config import validate
from omnibench.errors import ConfigError
from omnibench.fit.geometry import GeometryLimits, WheelGeometry
from omnibench.fit.identifiability import identified_parameters
from omnibench.fit.parameterisation import Box, MatrixElements, make_bounds
from omnibench.robot.kinematics import Array, Mount, Robot, inverse_kinematic_matrix, published_matrix
from omnibench.testing.synthetic import synthetic_robot

DESIGN = APR_02.inverse_kinematic_matrix


def elements(box: Box, robot: Robot = APR_02) -> MatrixElements:
    return MatrixElements(robot, box, np.zeros((0, len(robot.wheels))))


def bounds(box: Box) -> tuple[Array, Array]:
    found = elements(box).bounds
    return found.lower.reshape(3, 3), found.upper.reshape(3, 3)


def test_the_papers_box_has_ten_per_cent_of_every_element_on_either_side() -> None:
    lower, upper = bounds("paper")
    np.testing.assert_allclose(upper - DESIGN, 0.1 * np.abs(DESIGN), rtol=1e-12, atol=0)
    np.testing.assert_allclose(DESIGN - lower, 0.1 * np.abs(DESIGN), rtol=1e-12, atol=0)
    assert lower[0, 1] == upper[0, 1] == 0.0
    published = [published_matrix(name) for name in ("palacin2023_eq9", "palacin2023_eq8")]
    assert [bool(((matrix >= lower) & (matrix <= upper)).all()) for matrix in published] == [True, False]


def test_the_row_box_has_a_quarter_of_the_rows_largest_element_on_either_side() -> None:
    lower, upper = bounds("row")
    width = np.tile(0.25 * np.abs(DESIGN).max(axis=1, keepdims=True), 3)
    np.testing.assert_allclose(upper - DESIGN, width, rtol=1e-12)
    np.testing.assert_allclose(DESIGN - lower, width, rtol=1e-12)


def test_an_explicit_box_is_taken_as_it_is() -> None:
    lower, upper = DESIGN - 0.01, DESIGN + 0.02
    found = elements(box_between(lower, upper)).bounds
    assert found.name == "custom"
    np.testing.assert_array_equal(found.lower, lower.ravel())
    np.testing.assert_array_equal(found.upper, upper.ravel())


def with_m11(value: float) -> Array:
    matrix = DESIGN.copy()
    matrix[0, 0] = value
    return matrix


@pytest.mark.parametrize(
    ("lower", "upper", "named"),
    [
        (with_m11(0.06), with_m11(0.09), "of m11 is outside [0.06, "),
        (with_m11(0.5), with_m11(-0.5), "m11"),
        (np.full((3, 2), -1.0), np.full((3, 2), 1.0), "3 rows of 3 values"),
        (np.full((2, 3), -1.0), np.full((2, 3), 1.0), "3 rows of 3 values"),
    ],
)
def test_a_box_that_cannot_be_is_refused_by_its_element_or_shape(lower: Array, upper: Array, named: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        make_problem(box=box_between(lower, upper))  # the robot of the samples has the design of the APR-02
    assert str(refusal.value).startswith("box: ")
    assert named in str(refusal.value)


def test_elements_are_named_by_row_and_column_and_start_at_the_design() -> None:
    assert elements("row").names == ("m11", "m12", "m13", "m21", "m22", "m23", "m31", "m32", "m33")
    np.testing.assert_array_equal(elements("row").start, DESIGN.ravel())


@given(vectors=st.lists(st.lists(st.floats(-1, 1), min_size=9, max_size=9), min_size=1, max_size=4))
def test_vectors_are_the_matrices_where_every_direction_is_driven(vectors: list[list[float]]) -> None:
    np.testing.assert_array_equal(elements("row").matrices(np.array(vectors)), np.reshape(vectors, (-1, 3, 3)))


@given(seed=st.integers(0, 2**16))
def test_along_undriven_directions_the_design_is_kept(seed: int) -> None:
    robot = synthetic_robot(4)
    design = robot.inverse_kinematic_matrix
    rng = np.random.default_rng(seed)
    null = np.linalg.qr(rng.normal(size=(4, 4)))[0][:1]
    vectors = design.ravel() + rng.normal(0, 0.1, (5, 12))
    matrices = MatrixElements(robot, "row", null).matrices(vectors)
    np.testing.assert_allclose(matrices @ null[0], np.tile(design @ null[0], (5, 1)), atol=1e-14)
    driven = np.eye(4) - null.T @ null
    np.testing.assert_allclose(matrices @ driven, vectors.reshape(-1, 3, 4) @ driven, atol=1e-14)


class TestGeometry:
    """Radius, distance and angle of every wheel within physical limits."""

    @pytest.mark.parametrize(
        ("limits", "radius", "distance", "angle_deg"),
        [
            (GeometryLimits(), (0.9, 1.1), (0.8, 1.2), (-3.0, 3.0)),
            (
                GeometryLimits(radius=(-0.02, 0.05), distance=(0.0, 0.3), angle_deg=(-1.0, 0.5)),
                (0.98, 1.05),
                (1.0, 1.3),
                (-1.0, 0.5),
            ),
        ],
    )
    def test_limits_are_shares_of_radius_and_distance_and_degrees(
        self, limits: GeometryLimits, radius: Any, distance: Any, angle_deg: Any
    ) -> None:
        geometry = WheelGeometry(APR_02, limits)
        ends = (geometry.bounds.lower, geometry.bounds.upper)
        for end, of_radius, of_distance, degrees in zip(ends, radius, distance, angle_deg, strict=True):
            found = end.reshape(3, 3)
            np.testing.assert_allclose(found[:2], [[of_radius * 0.148] * 3, [of_distance * 0.195] * 3], rtol=1e-12)
            np.testing.assert_allclose(found[2], np.radians(np.array([60, 180, 300]) + degrees), rtol=1e-12)

    @pytest.mark.parametrize("wheels", [3, 4])
    def test_vectors_mean_the_matrix_of_a_robot_built_like_that(self, wheels: Any) -> None:
        robot = synthetic_robot(wheels)
        rng = np.random.default_rng(2)
        geometry = WheelGeometry(robot)
        vectors = rng.uniform(geometry.bounds.lower, geometry.bounds.upper, (6, 3 * wheels))
        for vector, matrix in zip(vectors, geometry.matrices(vectors), strict=True):
            built = tuple(
                wheel.model_copy(update={"radius": r, "distance": d, "angle": a})
                for wheel, r, d, a in zip(robot.wheels, *vector.reshape(3, -1), strict=True)
            )
            np.testing.assert_allclose(matrix, inverse_kinematic_matrix(built), rtol=1e-12, atol=1e-16)

    @pytest.mark.parametrize("limits", [{"radius": (0.01, 0.1)}, {"distance": (0.1, -0.1)}])
    def test_limits_that_exclude_the_design_or_are_the_wrong_way_round_are_refused_by_name(self, limits: Any) -> None:
        (name,) = limits
        with pytest.raises(ConfigError, match=f"of {name}_a is "):
            make_problem(parameterisation="geometry", limits=GeometryLimits(**limits))

    @pytest.mark.parametrize(
        "limits", [{"radius": 1.5}, {"distance": [-1.0, 0.2]}, {"radius": math.nan}, {"radii": 0.1}]
    )
    def test_limits_that_cannot_be_are_refused_in_one_line(self, limits: dict[str, Any]) -> None:
        with pytest.raises(ConfigError, match=r"^limits: ") as refusal:
            validate(GeometryLimits, limits, "limits")
        assert "\n" not in str(refusal.value)


def test_the_derivatives_of_a_geometry_are_those_of_the_wheel_equations_inverse() -> None:
    """With E the wheel equations, rows (-sin d, cos d, R) / r, the matrix is M = E^-1 and dM = -M dE M."""
    geometry = WheelGeometry(APR_02)
    slopes = geometry.slopes(geometry.start).reshape(3, 3, 9)
    for index, wheel in enumerate(APR_02.wheels):
        column = DESIGN[:, index]
        of_distance = -np.outer(column, DESIGN[2]) / wheel.radius
        of_angle = np.outer(column, np.cos(wheel.angle) * DESIGN[0] + np.sin(wheel.angle) * DESIGN[1]) / wheel.radius
        np.testing.assert_allclose(slopes[:, index, index], column / wheel.radius, rtol=1e-8, atol=1e-11)
        np.testing.assert_allclose(slopes[:, :, 3 + index], of_distance, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(slopes[:, :, 6 + index], of_angle, rtol=1e-7, atol=1e-9)


def test_the_derivatives_of_matrix_elements_are_zero_along_directions_that_are_kept() -> None:
    slopes = MatrixElements(APR_02, "row", np.array([[0.6, 0.8, 0.0]])).slopes(DESIGN.ravel())
    kept = np.array([[0.64, -0.48, 0.0], [-0.48, 0.36, 0.0], [0.0, 0.0, 1.0]])  # 1 - n n'
    np.testing.assert_allclose(slopes, np.kron(np.eye(3), kept), rtol=0, atol=1e-15)


def test_a_robot_that_turns_by_half_of_its_track_is_in_the_box_where_it_skids_and_not_where_it_cannot() -> None:
    for robot, turns_by_half in ((SKID, True), (DIFFERENTIAL, False)):
        matrix = robot.inverse_kinematic_matrix * [[1.0], [1.0], [0.5]]
        box = make_bounds(robot, "row")
        assert bool(((matrix.ravel() >= box.lower) & (matrix.ravel() <= box.upper)).all()) is turns_by_half


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


def test_the_side_of_a_tracked_point_is_not_told_apart_from_that_of_the_wheels() -> None:
    geometry = WheelGeometry(TRICYCLE, fitted_mount=True)
    told = dict(zip(geometry.names, identified_parameters(geometry, none_kept(TRICYCLE)), strict=True))
    assert [name for name, known in told.items() if not known] == ["y_front", "mount_y"]


def test_the_limits_of_a_mecanum_geometry_hold_its_design() -> None:
    bounds = WheelGeometry(MECANUM).bounds
    assert (bounds.lower < WheelGeometry(MECANUM).start).all()
    assert (bounds.upper > WheelGeometry(MECANUM).start).all()
