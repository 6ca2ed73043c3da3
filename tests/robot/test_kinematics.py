"""From wheel geometry to the inverse kinematic matrix: Eq. (3) and (7), mecanum, any number of wheels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from sample_robots import APR_02

from omnibench.config import validate
from omnibench.errors import ConfigError
from omnibench.robot.kinematics import (
    Array,
    Robot,
    Wheel,
    inverse_kinematic_matrices,
    inverse_kinematic_matrix,
    published_matrix,
    wheel_equations,
)

# Eq. (7) of the article, as printed.
EQ_7 = np.array(
    [
        [-0.0854478398400646, 0.0000000000000000, 0.0854478398400646],
        [0.04933333333333333, -0.09866666666666667, 0.04933333333333333],
        [0.2529914529914529, 0.2529914529914529, 0.2529914529914529],
    ]
)


def a_wheel(name: str, roller_angle: st.SearchStrategy[float]) -> st.SearchStrategy[Wheel]:
    return st.builds(
        Wheel,
        name=st.just(name),
        radius=st.floats(0.02, 0.5),
        distance=st.floats(0.05, 1.5),
        angle=st.floats(-math.pi, math.pi),
        roller_angle=roller_angle,
    )


def wheels_of(count: int, roller_angle: st.SearchStrategy[float]) -> st.SearchStrategy[tuple[Wheel, ...]]:
    return st.tuples(*(a_wheel(f"w{index}", roller_angle) for index in range(count)))


three_omni_wheels = wheels_of(3, st.just(0.0))
many_wheels = st.integers(4, 8).flatmap(lambda count: wheels_of(count, st.floats(-1.0, 1.0)))


def geometry_of(matrix: Array) -> tuple[Array, Array, Array]:
    """Radii, distances (m) and angles in [0, 2 pi) (rad) of the three omni wheels whose M^-1 this is."""
    equations = np.linalg.inv(matrix)
    radius = 1 / np.hypot(equations[:, 0], equations[:, 1])
    angle = np.arctan2(-equations[:, 0], equations[:, 1]) % (2 * math.pi)
    return radius, equations[:, 2] * radius, angle


def condition(equations: Array) -> float:
    return float(np.linalg.cond(equations))


@pytest.mark.parametrize("row", [0, 1, 2])
@pytest.mark.parametrize("column", [0, 1, 2])
def test_the_design_values_give_every_element_of_eq_7(row: int, column: int) -> None:
    assert abs(inverse_kinematic_matrix(APR_02.wheels)[row, column] - EQ_7[row, column]) <= 1e-15


def test_m12_of_the_design_is_exactly_zero_so_that_the_papers_box_freezes_it() -> None:
    assert inverse_kinematic_matrix(APR_02.wheels)[0, 1] == 0.0


@given(wheels=three_omni_wheels)
def test_eq_3_is_the_inverse_of_the_wheel_equations(wheels: tuple[Wheel, ...]) -> None:
    equations = wheel_equations(wheels)
    assume(condition(equations) < 1e4)
    product = inverse_kinematic_matrix(wheels) @ equations
    np.testing.assert_allclose(product, np.eye(3), atol=1e-14 * condition(equations))


@given(wheels=three_omni_wheels)
def test_eq_3_is_the_pseudo_inverse_of_the_wheel_equations(wheels: tuple[Wheel, ...]) -> None:
    equations = wheel_equations(wheels)
    assume(condition(equations) < 1e4)
    expected = np.linalg.pinv(equations)
    error = np.abs(inverse_kinematic_matrix(wheels) - expected).max() / np.abs(expected).max()
    assert error < 1e-14 * condition(equations)


@given(wheels=many_wheels)
def test_the_matrix_of_any_number_of_wheels_gives_the_twist_back(wheels: tuple[Wheel, ...]) -> None:
    equations = wheel_equations(wheels)
    assume(condition(equations) < 1e4)
    product = inverse_kinematic_matrix(wheels) @ equations
    np.testing.assert_allclose(product, np.eye(3), atol=1e-13 * condition(equations))


def test_four_omni_wheels_share_the_work() -> None:
    r, R = 0.05, 0.2
    wheels = tuple(Wheel(name=f"w{i}", radius=r, distance=R, angle=i * math.pi / 2) for i in range(4))
    expected = np.array([[0, -r / 2, 0, r / 2], [r / 2, 0, -r / 2, 0], [r / (4 * R)] * 4])
    np.testing.assert_allclose(inverse_kinematic_matrix(wheels), expected, atol=1e-16)


def test_mecanum_wheels_give_the_matrix_of_the_textbooks() -> None:
    r, lx, ly = 0.05, 0.2, 0.15
    # Front left, front right, rear left, rear right; in textbooks a positive rate drives forward.
    textbook = r / 4 * np.array([[1, 1, 1, 1], [-1, 1, 1, -1], np.array([-1, 1, -1, 1]) / (lx + ly)])
    left, right, rollers = math.pi / 2, -math.pi / 2, math.pi / 4
    wheels = tuple(
        Wheel(name=name, radius=r, distance=lx + ly, angle=angle, roller_angle=roller)
        for name, angle, roller in (
            ("fl", left, rollers),
            ("fr", right, -rollers),
            ("rl", left, -rollers),
            ("rr", right, rollers),
        )
    )
    # Here a positive rate drives counter-clockwise, which is backward on the left.
    np.testing.assert_allclose(inverse_kinematic_matrix(wheels), textbook * [-1, 1, -1, 1], atol=1e-16)


@given(wheels=many_wheels, angle=st.floats(-3, 3))
def test_a_robot_with_its_wheels_turned_about_its_centre_drives_in_the_turned_direction(
    wheels: tuple[Wheel, ...], angle: float
) -> None:
    turned = tuple(wheel.model_copy(update={"angle": wheel.angle + angle}) for wheel in wheels)
    rotation = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    np.testing.assert_allclose(wheel_equations(turned) @ rotation, wheel_equations(wheels), rtol=1e-9, atol=1e-10)


@given(wheels=many_wheels, turn=st.floats(-3, 3))
def test_a_pure_turn_needs_lever_arm_over_radius_of_every_wheel(wheels: tuple[Wheel, ...], turn: float) -> None:
    rates = wheel_equations(wheels) @ [0.0, 0.0, turn]
    np.testing.assert_allclose(rates, [turn * wheel.distance / wheel.radius for wheel in wheels], atol=1e-300)


@pytest.mark.parametrize("rollers", [np.zeros(3), np.zeros(5), np.array([0.7, -0.7, -0.7, 0.7])])
def test_many_geometries_at_once_equal_one_at_a_time(rollers: Array) -> None:
    rng = np.random.default_rng(4)
    shape = (20, len(rollers))
    radius, distance = rng.uniform(0.03, 0.2, shape), rng.uniform(0.1, 0.5, shape)
    angle = 2 * math.pi * np.arange(len(rollers)) / len(rollers) + rng.uniform(-0.1, 0.1, shape)
    together = inverse_kinematic_matrices(radius, distance, angle, rollers)
    alone = [
        inverse_kinematic_matrix(
            tuple(
                Wheel(name=f"w{i}", radius=r, distance=R, angle=d, roller_angle=g)
                for i, (r, R, d, g) in enumerate(zip(*rows, rollers, strict=True))
            )
        )
        for rows in zip(radius, distance, angle, strict=True)
    ]
    np.testing.assert_allclose(together, alone, rtol=1e-12, atol=1e-16)


@pytest.mark.parametrize("wheels", [3, 4])
@pytest.mark.parametrize("value", [0.0, math.nan, math.inf])
def test_a_geometry_without_a_matrix_spoils_no_other(wheels: int, value: float) -> None:
    angle = np.tile(2 * math.pi * np.arange(wheels) / wheels, (2, 1))
    radius, distance = np.full((2, wheels), 0.05), np.full((2, wheels), 0.2)
    distance[1] = value  # a robot whose wheels cannot turn it, or nonsense
    radius[1] = 0.05 if value == 0 and wheels == 3 else value
    with np.errstate(all="ignore"):
        bad, good = inverse_kinematic_matrices(radius[::-1], distance[::-1], angle)
    assert not np.isfinite(bad).all()
    assert np.isfinite(good).all()


def test_eq_8_inverted_is_the_geometry_that_is_known() -> None:
    radius, distance, angle = geometry_of(published_matrix("palacin2023_eq8"))
    np.testing.assert_allclose(100 * (radius / 0.148 - 1), [3.4, 3.6, 3.3], atol=0.05)
    np.testing.assert_allclose(100 * (distance / 0.195 - 1), [7.6, 14.6, 11.5], atol=0.05)
    np.testing.assert_allclose(100 * (np.degrees(angle) / [60, 180, 300] - 1), [0.98, 0.26, -0.02], atol=0.005)


def test_the_geometry_of_eq_8_gives_eq_8_back() -> None:
    radius, distance, angle = geometry_of(published_matrix("palacin2023_eq8"))
    matrix = inverse_kinematic_matrices(radius[None], distance[None], angle[None])[0]
    np.testing.assert_allclose(matrix, published_matrix("palacin2023_eq8"), atol=1e-15)


def robot(*wheels: dict[str, Any]) -> Robot:
    defaults: dict[str, Any] = {"radius": 0.05, "distance": 0.2, "angle": 0.0}
    named = [{"name": f"w{index}", **defaults, **wheel} for index, wheel in enumerate(wheels)]
    return validate(Robot, {"name": "robot", "wheels": named}, "robot.yaml")


def omni(*angles: float) -> list[dict[str, Any]]:
    return [{"angle": angle} for angle in angles]


REFUSED = {
    "parallel axles": (omni(0, 0, math.pi), "every direction"),
    "rollers that all slip the same way": (
        [{"angle": side * math.pi / 2, "roller_angle": side * math.pi / 4} for side in (1, -1, 1, -1)],
        "every direction",
    ),
    "two wheels": (omni(0, math.pi / 2), "wheels"),
    "angles in degrees": (omni(60, 180, 300), "60 cannot be an angle in rad; is it in degrees?"),
    "a roller angle in degrees": ([{"angle": a, "roller_angle": 45} for a in (0, 2, 4)], "wheels.0.roller_angle"),
    "the same name twice": ([{"name": "a", "angle": 2.0 * i} for i in range(3)], "names must differ: a, a, a"),
    "a name that makes no column": ([{"name": "front left", "angle": 2.0 * i} for i in range(3)], "wheels.0.name"),
    "no radius": ([{"radius": 0, "angle": 2.0 * i} for i in range(3)], "wheels.0.radius"),
    "a negative distance": ([{"distance": -0.2, "angle": 2.0 * i} for i in range(3)], "wheels.0.distance"),
    "a radius that is not a number": ([{"radius": math.nan, "angle": 2.0 * i} for i in range(3)], "wheels.0.radius"),
    "an infinite angle": ([{"angle": math.inf} for _ in range(3)], "wheels.0.angle"),
    "a misspelt key": ([{"angel": 1.0} for _ in range(3)], "did you mean 'angle'?"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_robot_that_cannot_be_is_refused_in_one_line(case: str) -> None:
    wheels, words = REFUSED[case]
    with pytest.raises(ConfigError) as refusal:
        robot(*wheels)
    assert str(refusal.value).startswith("robot.yaml: ")
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)
