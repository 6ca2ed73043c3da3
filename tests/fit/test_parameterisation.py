"""What is searched and in which box: matrix elements and wheel geometry."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from fit_samples import box_between, make_problem
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02, DIFFERENTIAL, SKID

from omnibench.config import validate
from omnibench.errors import ConfigError
from omnibench.fit.geometry import GeometryLimits, WheelGeometry
from omnibench.fit.parameterisation import Box, MatrixElements, make_bounds
from omnibench.robot.kinematics import Array, Robot, inverse_kinematic_matrix, published_matrix
from omnibench.testing.synthetic import synthetic_robot

DESIGN = APR_02.inverse_kinematic_matrix
NO_NULL = np.zeros((0, 3))


def elements(box: Box, robot: Robot = APR_02) -> MatrixElements:
    return MatrixElements(robot, box, np.zeros((0, len(robot.wheels))))


def bounds(box: Box) -> tuple[Array, Array]:
    found = elements(box).bounds
    return found.lower.reshape(3, 3), found.upper.reshape(3, 3)


class TestPaperBox:
    """+-10 % of each start element."""

    def test_every_element_has_ten_per_cent_of_itself_on_either_side(self) -> None:
        lower, upper = bounds("paper")
        np.testing.assert_allclose(upper - DESIGN, 0.1 * np.abs(DESIGN), rtol=1e-12, atol=0)
        np.testing.assert_allclose(DESIGN - lower, 0.1 * np.abs(DESIGN), rtol=1e-12, atol=0)

    def test_m12_has_no_width(self) -> None:
        lower, upper = bounds("paper")
        assert lower[0, 1] == upper[0, 1] == 0.0

    def test_it_holds_eq_9_but_not_eq_8(self) -> None:
        lower, upper = bounds("paper")
        inside = [
            ((published_matrix(name) >= lower) & (published_matrix(name) <= upper)).all()
            for name in ("palacin2023_eq9", "palacin2023_eq8")
        ]
        assert inside == [True, False]


class TestRowBox:
    """+-25 % of the row's largest element."""

    def test_every_element_has_a_quarter_of_the_rows_largest_on_either_side(self) -> None:
        lower, upper = bounds("row")
        for row in range(3):
            width = 0.25 * max(abs(element) for element in DESIGN[row])
            np.testing.assert_allclose(upper[row] - DESIGN[row], width, rtol=1e-12)
            np.testing.assert_allclose(DESIGN[row] - lower[row], width, rtol=1e-12)

    def test_m12_is_free(self) -> None:
        lower, upper = bounds("row")
        assert lower[0, 1] == pytest.approx(-0.25 * DESIGN[0, 2])
        assert upper[0, 1] == pytest.approx(0.25 * DESIGN[0, 2])


def test_an_explicit_box_is_taken_as_it_is() -> None:
    lower, upper = DESIGN - 0.01, DESIGN + 0.02
    found = elements(box_between(lower, upper)).bounds
    assert found.name == "custom"
    np.testing.assert_array_equal(found.lower, lower.ravel())
    np.testing.assert_array_equal(found.upper, upper.ravel())


def changed(matrix: Array, row: int, column: int, value: float) -> Array:
    matrix = matrix.copy()
    matrix[row, column] = value
    return matrix


def test_a_box_that_excludes_the_start_is_refused_in_one_line() -> None:
    box = box_between(changed(DESIGN - 0.1, 1, 2, 0.06), DESIGN + 0.1)
    with pytest.raises(ConfigError) as refusal:
        make_problem(box=box_for_synthetic(box))
    assert str(refusal.value).startswith("box: start value ")
    assert "of m23 is outside [0.06, " in str(refusal.value)
    assert str(refusal.value).endswith("]; widen the box")


def box_for_synthetic(box: Box) -> Box:
    """The same box; the robot of the samples has the design of the APR-02."""
    np.testing.assert_allclose(synthetic_robot().inverse_kinematic_matrix, DESIGN, atol=1e-15)
    return box


def test_an_inverted_box_is_refused_in_one_line() -> None:
    box = box_between(changed(DESIGN - 0.1, 0, 0, 0.5), changed(DESIGN + 0.1, 0, 0, -0.5))
    with pytest.raises(ConfigError, match=r"^box: lower bound 0\.5 of m11 is above its upper bound -0\.5$"):
        assert elements(box).bounds


@pytest.mark.parametrize("shape", [(3, 2), (2, 3), (3, 4)])
def test_a_box_of_another_shape_is_refused_in_one_line(shape: tuple[int, int]) -> None:
    box = box_between(np.full(shape, -1.0), np.full(shape, 1.0))
    with pytest.raises(ConfigError, match=r"^box: lower and upper must have 3 rows of 3 values$"):
        make_bounds(APR_02, box)


def test_elements_are_named_by_row_and_column() -> None:
    assert elements("row").names == ("m11", "m12", "m13", "m21", "m22", "m23", "m31", "m32", "m33")


def test_the_start_is_the_matrix_of_the_design_row_by_row() -> None:
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

    def test_by_default_radii_have_10_distances_20_per_cent_and_angles_3_degrees(self) -> None:
        box = WheelGeometry(APR_02).bounds
        lower, upper = box.lower.reshape(3, 3), box.upper.reshape(3, 3)
        angles = np.radians([60, 180, 300])
        np.testing.assert_allclose(lower[:2], [[0.9 * 0.148] * 3, [0.8 * 0.195] * 3], rtol=1e-12)
        np.testing.assert_allclose(lower[2], angles - math.radians(3), rtol=1e-12)
        np.testing.assert_allclose(upper[:2], [[1.1 * 0.148] * 3, [1.2 * 0.195] * 3], rtol=1e-12)
        np.testing.assert_allclose(upper[2], angles + math.radians(3), rtol=1e-12)

    def test_limits_may_be_one_sided(self) -> None:
        limits = GeometryLimits(radius=(-0.02, 0.05), distance=(0.0, 0.3), angle_deg=(-1.0, 0.5))
        box = WheelGeometry(APR_02, limits).bounds
        lower, upper = box.lower.reshape(3, 3)[:, 1], box.upper.reshape(3, 3)[:, 1]
        np.testing.assert_allclose(lower, [0.98 * 0.148, 0.195, math.pi - math.radians(1)], rtol=1e-12)
        np.testing.assert_allclose(upper, [1.05 * 0.148, 1.3 * 0.195, math.pi + math.radians(0.5)], rtol=1e-12)

    def test_parameters_are_named_by_wheel(self) -> None:
        assert WheelGeometry(APR_02).names == (
            *("radius_a", "radius_b", "radius_c"),
            *("distance_a", "distance_b", "distance_c"),
            *("angle_a", "angle_b", "angle_c"),
        )

    @pytest.mark.parametrize("wheels", [3, 4])
    def test_the_start_means_the_matrix_of_the_design(self, wheels: Any) -> None:
        geometry = WheelGeometry(synthetic_robot(wheels))
        matrix = geometry.matrices(geometry.start[None])[0]
        np.testing.assert_allclose(matrix, synthetic_robot(wheels).inverse_kinematic_matrix, rtol=1e-14, atol=1e-17)

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

    def test_limits_that_exclude_the_design_are_refused_in_one_line(self) -> None:
        with pytest.raises(ConfigError, match=r"box: start value 0\.148 of radius_a is outside \[0\.14948, "):
            make_problem(parameterisation="geometry", limits=GeometryLimits(radius=(0.01, 0.1)))

    def test_limits_the_wrong_way_round_are_refused_in_one_line(self) -> None:
        with pytest.raises(ConfigError, match="of distance_a is above its upper bound"):
            make_problem(parameterisation="geometry", limits=GeometryLimits(distance=(0.1, -0.1)))

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
