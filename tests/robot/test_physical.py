"""Physical parameters that a matrix means: every class of robot, the tracked point, intervals, and what has none."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02, CAR, DIFFERENTIAL, MECANUM, SKID, SWERVE, TRICYCLE, WHEELED
from scipy.special import stdtrit

from omnibench.robot.calibration import EffectTerm
from omnibench.robot.kinematics import Array, Mount, Robot, Wheel, published_matrix
from omnibench.robot.physical import Geometry, PhysicalParameter, PhysicalReading, physical_tolerance, read_matrix

# Names of the parameters of each class, in the order in which they are shown.
ANGLES = ("front_left", "front_right", "rear_left", "rear_right")
POINT = ("mount_x", "mount_y", "mount_yaw")
NAMES = {
    "APR-02": [f"{kind}_{wheel}" for kind in ("radius", "distance", "angle") for wheel in "abc"],
    "diff": ["radius_left", "radius_right", "track", *POINT],
    "skid": [*(f"radius_{wheel}" for wheel in ANGLES), "track", *POINT],
    "mecanum": [f"{kind}_{wheel}" for kind in ("radius", "distance", "angle") for wheel in ANGLES],
    "tricycle": ["radius_front", "wheelbase", "steering_zero_front", *POINT],
    "car": [
        *("radius_left", "radius_right", "wheelbase", "steering_zero_front_left", "steering_zero_front_right"),
        *POINT,
    ],
    "swerve": [
        *(f"radius_{wheel}" for wheel in ANGLES),
        *("track", "wheelbase"),
        *(f"steering_zero_{wheel}" for wheel in ANGLES),
    ],
}


def scattered(robot: Robot, size: float = 1e-4) -> Array:
    """A covariance of the elements of a robot's matrix, independent, by shares of each row's largest."""
    deviations = size * np.repeat(robot.row_scales, len(robot.drive.names))
    return np.diag(deviations**2)


def matrix_of(robot: Robot, changes: Mapping[str, float]) -> Array:
    """The matrix (3, M) of a robot whose numbers are changed; a name that ends in * is of every wheel."""
    geometry = Geometry(robot)
    vector = geometry.design.copy()
    for name, change in changes.items():
        for index, number in enumerate(geometry.names):
            if number == name or (name.endswith("*") and number.startswith(name[:-1])):
                vector[index] += change
    return geometry.matrices(vector[None])[0]


def values(reading: PhysicalReading) -> dict[str, float]:
    return {each.name: each.value for each in reading.parameters}


def intervals(reading: PhysicalReading) -> dict[str, tuple[float | None, float | None]]:
    return {each.name: (each.low, each.high) for each in reading.parameters}


def inside(parameter: PhysicalParameter, truth: float) -> bool:
    return parameter.low is not None and parameter.high is not None and parameter.low <= truth <= parameter.high


@pytest.mark.parametrize("robot", [APR_02, *WHEELED], ids=lambda robot: robot.name)
def test_the_design_has_the_parameters_of_its_class(robot: Robot) -> None:
    mounted = "mount_x" in NAMES[robot.name]
    design = read_matrix(robot, robot.inverse_kinematic_matrix, scattered(robot), fitted_mount=mounted)
    assert list(values(design)) == NAMES[robot.name]
    assert all(each.value == pytest.approx(each.design, abs=1e-12) for each in design.parameters)
    assert all(inside(each, each.design) for each in design.parameters)
    assert not design.doubt


SHARE, ANGLE = st.floats(-0.06, 0.06), st.floats(-0.05, 0.05)


@given(st.lists(SHARE, min_size=6, max_size=6), st.lists(ANGLE, min_size=3, max_size=3))
def test_the_geometry_of_three_omni_wheels_comes_back(lengths: list[float], angles: list[float]) -> None:
    names = [f"{kind}_{wheel}" for kind in ("radius", "distance") for wheel in "abc"]
    scale = [0.148] * 3 + [0.195] * 3
    changes = {name: share * size for name, share, size in zip(names, lengths, scale, strict=True)}
    changes |= {f"angle_{wheel}": angle for wheel, angle in zip("abc", angles, strict=True)}
    reading = read_matrix(APR_02, matrix_of(APR_02, changes))
    assert {each.name: each.deviation for each in reading.parameters} == pytest.approx(changes, abs=1e-9)


@given(left=SHARE, right=SHARE, track=SHARE, x=SHARE, y=SHARE, yaw=ANGLE)
def test_the_radii_and_the_track_of_two_wheels_come_back(
    left: float, right: float, track: float, x: float, y: float, yaw: float
) -> None:
    changes = {"radius_left": 0.05 * left, "radius_right": 0.05 * right, "mount_x": x, "mount_y": y, "mount_yaw": yaw}
    matrix = matrix_of(DIFFERENTIAL, changes | {"distance_left": -0.15 * track, "distance_right": 0.15 * track})
    found = {each.name: each.deviation for each in read_matrix(DIFFERENTIAL, matrix, fitted_mount=True).parameters}
    expected = changes | {"track": 0.3 * track}
    assert {name: found.get(name, 0.0) for name in expected} == pytest.approx(expected, abs=1e-9)


@given(radius=SHARE, wheelbase=SHARE, zero=ANGLE, x=SHARE, y=SHARE, yaw=ANGLE)
@pytest.mark.parametrize("robot", [TRICYCLE, CAR], ids=lambda robot: robot.name)
def test_radius_wheelbase_and_steering_zero_come_back(
    robot: Robot, radius: float, wheelbase: float, zero: float, x: float, y: float, yaw: float
) -> None:
    place = "wheelbase" if robot is CAR else "x_front"
    mount = {"mount_x": x, "mount_y": y, "mount_yaw": yaw}
    matrix = matrix_of(robot, mount | {"radius*": 0.05 * radius, place: 0.5 * wheelbase, "offset*": zero})
    for each in read_matrix(robot, matrix, fitted_mount=True).parameters:
        expected = {"radius": 0.05 * radius, "wheelbase": 0.5 * wheelbase, "steering": zero}
        change = mount.get(each.name, expected.get(each.name.partition("_")[0]))
        assert each.deviation == pytest.approx(change, abs=1e-9)


@given(left=SHARE, right=SHARE, track=st.floats(-0.1, 1.0), y=SHARE)
def test_a_skid_steered_base_has_one_effective_track(left: float, right: float, track: float, y: float) -> None:
    changes = {f"radius_{end}_{side}": 0.05 * share for side, share in (("left", left), ("right", right))
               for end in ("front", "rear")}  # fmt: skip
    moved = {f"distance_{end}_{side}": sign * 0.15 * track for side, sign in (("left", -1), ("right", 1))
             for end in ("front", "rear")}  # fmt: skip
    reading = read_matrix(SKID, matrix_of(SKID, changes | moved | {"mount_y": y}), fitted_mount=True)
    found = {each.name: each.deviation for each in reading.parameters}
    expected = changes | {"track": 0.3 * track, "mount_y": y}
    assert {name: found.get(name, 0.0) for name in expected} == pytest.approx(expected, abs=1e-9)
    assert not reading.doubt  # its wheels slide


@given(radius=SHARE, distance=SHARE, angle=ANGLE)
def test_what_all_mecanum_wheels_have_in_common_comes_back(radius: float, distance: float, angle: float) -> None:
    matrix = matrix_of(MECANUM, {"radius*": 0.05 * radius, "angle*": angle})
    for each in read_matrix(MECANUM, matrix).parameters:
        expected = {"radius": 0.05 * radius, "distance": 0.0, "angle": angle}
        assert each.deviation == pytest.approx(expected[each.name.partition("_")[0]], abs=1e-6)
    levers = {f"distance_{wheel}": (-0.35 if wheel.endswith("left") else 0.35) * distance for wheel in ANGLES}
    found = values(read_matrix(MECANUM, matrix_of(MECANUM, levers)))
    assert [found[f"distance_{wheel}"] for wheel in ANGLES] == pytest.approx([0.35 * (1 + distance)] * 4, abs=1e-9)


def test_numbers_that_four_wheels_do_not_show_keep_to_the_design_and_have_its_tolerance_in_their_intervals() -> None:
    truth = {"radius_front_left": 0.0008, "radius_rear_left": -0.0006, "distance_rear_right": 0.004}
    for robot in (MECANUM, SWERVE, SKID):
        changes = {name: change for name, change in truth.items() if name.startswith("radius") or robot is MECANUM}
        reading = read_matrix(robot, matrix_of(robot, changes), scattered(robot))
        for each in reading.parameters:
            assert inside(each, each.design + changes.get(each.name, 0.0))
        radius = next(each for each in reading.parameters if each.name == "radius_front_left")
        prior = 1.96 * physical_tolerance(robot).radius * 0.05
        assert 0.2 * prior < radius.high - radius.value < prior


# The tracked point.

MARKER = Mount(x=0.02, y=0.03)  # 36 mm off the centre of three wheels 155 mm from it
OMNI = APR_02.model_copy(
    update={"wheels": tuple(each.model_copy(update={"distance": 0.155, "radius": 0.05}) for each in APR_02.wheels)}
)


def test_a_marker_off_the_centre_looks_like_wrong_distances_until_it_is_declared_or_fitted() -> None:
    seen = MARKER.twist @ OMNI.inverse_kinematic_matrix
    assert max(abs(each - 0.155) for each in distances(read_matrix(OMNI, seen))) > 0.03
    declared = OMNI.model_copy(update={"mount": MARKER})
    assert distances(read_matrix(declared, seen)) == pytest.approx([0.155] * 3, abs=1e-9)
    fitted = read_matrix(OMNI, seen, scattered(OMNI), fitted_mount=True)
    assert values(fitted)["mount_x"] == pytest.approx(0.02, abs=0.0015)
    assert values(fitted)["mount_y"] == pytest.approx(0.03, abs=0.0015)
    truth = {"mount_x": 0.02, "mount_y": 0.03}
    assert all(inside(each, truth.get(each.name, each.design)) for each in fitted.parameters)


def distances(reading: PhysicalReading) -> list[float]:
    return [value for name, value in values(reading).items() if name.startswith("distance")]


@pytest.mark.parametrize("robot", [DIFFERENTIAL, TRICYCLE, CAR, MECANUM, SKID, SWERVE], ids=lambda robot: robot.name)
def test_a_declared_mount_is_taken_out_of_every_robot(robot: Robot) -> None:
    mounted = robot.model_copy(update={"mount": Mount(x=0.1, y=-0.05, yaw=0.3)})
    reading = read_matrix(mounted, mounted.inverse_kinematic_matrix)
    assert all(each.value == pytest.approx(each.design, abs=1e-9) for each in reading.parameters)


def test_the_tracked_point_of_two_wheels_is_among_the_parameters_where_it_is_fitted_and_moves_no_other() -> None:
    seen = MARKER.twist @ DIFFERENTIAL.inverse_kinematic_matrix
    known, fitted = (values(read_matrix(DIFFERENTIAL, seen, fitted_mount=mount)) for mount in (False, True))
    assert list(known) == ["radius_left", "radius_right", "track"]
    assert (
        {name: fitted[name] for name in known}
        == known
        == pytest.approx({"radius_left": 0.05, "radius_right": 0.05, "track": 0.3}, abs=1e-9)
    )
    assert (fitted["mount_x"], fitted["mount_y"]) == pytest.approx((0.02, 0.03), abs=1e-9)


def test_what_the_wheels_hold_has_no_interval() -> None:
    kept = scattered(DIFFERENTIAL)
    kept[2:4] = kept[:, 2:4] = 0.0  # row 2, which the wheels allow to be zero alone
    reading = read_matrix(DIFFERENTIAL, DIFFERENTIAL.inverse_kinematic_matrix, kept, fitted_mount=True)
    assert [name for name, ends in intervals(reading).items() if None in ends] == ["mount_x", "mount_yaw"]


# Intervals.


@pytest.mark.parametrize("robot", [APR_02, DIFFERENTIAL, TRICYCLE], ids=lambda robot: robot.name)
def test_intervals_carry_the_elements_covariance_by_the_slopes_of_the_reading(robot: Robot) -> None:
    def read(matrix: Array, *scatter: Any) -> PhysicalReading:
        return read_matrix(robot, matrix, *scatter, fitted_mount=robot is not APR_02)

    rng = np.random.default_rng(3)
    matrix = robot.inverse_kinematic_matrix * 1.01
    root = np.sqrt(scattered(robot)) @ rng.standard_normal((matrix.size, matrix.size))
    step, slopes = 0.03, []
    for direction in root.T.reshape(-1, *matrix.shape):
        low, high = (np.array(list(values(read(matrix + side * step * direction)).values())) for side in (-1, 1))
        slopes.append((high - low) / (2 * step))
    expected = stdtrit(7, 0.975) * np.linalg.norm(slopes, axis=0)
    reach = [(each.high - each.low) / 2 for each in read(matrix, root @ root.T, 7).parameters]
    assert reach == pytest.approx(list(expected), rel=1e-5)


def test_degrees_of_freedom_of_single_elements_are_weighted_by_their_shares() -> None:
    robot, covariance = DIFFERENTIAL, scattered(DIFFERENTIAL)
    alike = intervals(read_matrix(robot, robot.inverse_kinematic_matrix, covariance, 4))
    each = intervals(read_matrix(robot, robot.inverse_kinematic_matrix, covariance, np.full(6, 4.0)))
    assert alike == each


def test_without_a_covariance_there_are_values_alone() -> None:
    assert set(intervals(read_matrix(APR_02, APR_02.inverse_kinematic_matrix)).values()) == {(None, None)}


def test_a_direction_that_was_not_driven_leaves_no_interval_to_what_depends_on_it() -> None:
    turning = np.kron(np.eye(3), np.ones((1, 3)) / math.sqrt(3))
    reading = read_matrix(APR_02, APR_02.inverse_kinematic_matrix, scattered(APR_02), unknown=turning)
    assert [name for name, ends in intervals(reading).items() if None in ends] == [f"distance_{w}" for w in "abc"]


# Effects.


def test_effects_add_lost_rate_steering_gain_and_zero() -> None:
    effects = (
        EffectTerm(name="wheel_dead_zone", parameters={"c": -0.012}),
        EffectTerm(name="steering_gain", parameters={"g": 0.83}),
        EffectTerm(name="driven_steering_offset", parameters={"c_front": 0.02}),
        EffectTerm(name="heading_drift", parameters={"b": 0.1}),
    )
    of_matrix = scattered(TRICYCLE)
    whole = np.zeros((10, 10))
    whole[:6, :6], whole[6:, 6:] = of_matrix, np.diag([0.001, 0.01, 0.002, 0.1]) ** 2
    reading = read_matrix(TRICYCLE, TRICYCLE.inverse_kinematic_matrix, whole, effects=effects)
    found = values(reading)
    assert found["lost_rate"] == pytest.approx(0.012)
    assert found["steering_gain_front"] == pytest.approx(1.83)
    assert found["steering_zero_front"] == pytest.approx(0.02)
    units = {each.name: each.unit for each in reading.parameters}
    assert (units["lost_rate"], units["steering_gain_front"], units["steering_zero_front"]) == ("rad/s", "1", "rad")
    ends = intervals(reading)
    assert ends["lost_rate"] == pytest.approx((0.012 - 0.00196, 0.012 + 0.00196), abs=1e-6)
    of_elements = intervals(read_matrix(TRICYCLE, TRICYCLE.inverse_kinematic_matrix, of_matrix, effects=effects))
    assert of_elements["lost_rate"] == of_elements["steering_zero_front"] == (None, None)
    assert None not in of_elements["radius_front"]


# Matrices without a reading.


@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), np.ones((3, 3)), -APR_02.inverse_kinematic_matrix])
def test_a_matrix_that_no_wheels_near_the_design_have_says_so_in_one_line(matrix: Array) -> None:
    reading = read_matrix(APR_02, matrix)
    assert reading.parameters == ()
    assert reading.doubt.startswith("the matrix has no reading in physical parameters: ")
    assert "\n" not in reading.doubt


def test_two_modules_cannot_drive_as_every_matrix_says() -> None:
    wheels = tuple(wheel for wheel in SWERVE.wheels if wheel.name in ("front_left", "rear_right"))
    robot = SWERVE.model_copy(update={"wheels": wheels})
    matrix = robot.inverse_kinematic_matrix.copy()
    matrix[0] *= 1.3  # x goes farther and y does not
    assert "by more than its uncertainty" in read_matrix(robot, matrix, scattered(robot)).doubt


def test_eq_8_of_the_paper_says_that_its_lengths_can_hardly_be_those_of_wheels() -> None:
    doubt = read_matrix(APR_02, published_matrix("palacin2023_eq8")).doubt
    assert doubt.startswith("distance_b +14.6 %, distance_c +11.5 %: ")
    assert "no physical reading" in doubt
    assert "\n" not in doubt


def test_a_length_whose_interval_reaches_plausible_ones_is_not_doubted() -> None:
    matrix = published_matrix("palacin2023_eq8")
    assert not read_matrix(APR_02, matrix, scattered(APR_02, 0.05)).doubt


def test_a_wheel_in_the_middle_whose_lever_arm_is_0_by_design_is_read_like_any_other() -> None:
    odometer = Wheel(name="odometer", type="omni", radius=0.03, x=0, y=0, angle=0.0)
    robot = DIFFERENTIAL.model_copy(update={"wheels": (*DIFFERENTIAL.wheels, odometer)})
    reading = read_matrix(robot, robot.inverse_kinematic_matrix, scattered(robot))
    assert (values(reading)["distance_odometer"], reading.doubt) == (pytest.approx(0.0, abs=1e-9), "")
