"""Physical parameters of calibrations: true within their intervals, of every calibrator, tracked point, lost rate."""

import math
import re
from typing import Any

import numpy as np
import pytest
from lanes import slow
from motions import RING
from motions import driven as rolled
from sample_robots import APR_02, CAR, DIFFERENTIAL, MECANUM, SKID, SWERVE, TRICYCLE
from wheeled_recordings import PERIOD, recorded

from omnibench.data.dataset import Dataset, make_dataset
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.robot.kinematics import Array, Mount, Robot
from omnibench.robot.physical import Geometry, PhysicalParameter
from omnibench.testing.synthetic import synthetic_robot


def recording(robot: Robot, matrix: Array, seed: int = 5) -> Dataset:
    """Three runs of twelve commands."""
    runs = recorded(robot, matrix, np.random.default_rng(seed))
    return make_dataset(robot.name, robot, PERIOD, runs, simulated=True)


def true_matrix(robot: Robot, changes: dict[str, float]) -> Array:
    geometry = Geometry(robot)
    numbers = dict(zip(geometry.names, geometry.design, strict=True))
    assert changes.keys() <= numbers.keys()
    return geometry.matrices(np.array([[value + changes.get(name, 0.0) for name, value in numbers.items()]]))[0]


def named(run: CalibrationRun) -> dict[str, PhysicalParameter]:
    return {each.name: each for each in run.parameters}


def is_inside(parameter: PhysicalParameter, truth: float, factor: float = 1.0) -> bool:
    assert parameter.low is not None
    assert parameter.high is not None
    return abs(parameter.value - truth) <= factor * (parameter.high - parameter.low) / 2


TRUE = {"radius_left": 0.0006, "radius_right": -0.0004, "distance_left": -0.004, "distance_right": 0.004}
ANSWERS: list[tuple[str, dict[str, Any]]] = [
    ("closed_form", {}),
    ("closed_form", {"unidentified": "keep"}),
    ("least_squares", {}),
    ("map", {}),
    ("parametric", {}),
]


@pytest.mark.parametrize(("calibrator", "choices"), ANSWERS, ids=lambda value: str(value))
def test_radii_and_track_of_two_wheels_are_true_within_the_intervals_of_every_calibrator(
    calibrator: str, choices: dict[str, Any]
) -> None:
    found = named(calibrate(recording(DIFFERENTIAL, true_matrix(DIFFERENTIAL, TRUE)), calibrator, **choices))
    truth = {"radius_left": 0.0506, "radius_right": 0.0496, "track": 0.308}
    for name, value in truth.items():
        assert is_inside(found[name], value), found[name]
        assert found[name].high - found[name].low < 0.05 * value
    assert found["track"].design == pytest.approx(0.3)


@pytest.mark.parametrize(
    "robot", [DIFFERENTIAL, SWERVE, *slow(SKID, MECANUM, TRICYCLE, CAR)], ids=lambda robot: robot.name
)
def test_the_file_has_the_parameters_of_the_run_of_every_class(robot: Robot) -> None:
    run = calibrate(recording(robot, robot.inverse_kinematic_matrix))
    assert run.calibration.parameters == named(run)
    assert list(run.calibration.to_frame("parameters")["name"]) == [each.name for each in run.parameters]
    assert all(is_inside(each, each.design, 1.5) for each in run.parameters if each.low is not None)
    assert any(each.low is not None for each in run.parameters)


# The tracked point.

OMNI = APR_02.model_copy(
    update={"wheels": tuple(each.model_copy(update={"distance": 0.155, "radius": 0.05}) for each in APR_02.wheels)}
)
MARKER = Mount(x=0.02, y=0.03)


@pytest.mark.parametrize("calibrator", ["map", "closed_form"])
def test_a_marker_36_mm_off_the_centre_of_three_omni_wheels_leaves_their_distances_as_they_are(calibrator: str) -> None:
    seen = recording(OMNI, MARKER.twist @ OMNI.inverse_kinematic_matrix)
    fitted = named(calibrate(seen, calibrator, mount="fit"))
    for found in (fitted, named(calibrate(make_dataset("d", declared(), PERIOD, seen.trajectories), calibrator))):
        assert all(is_inside(found[f"distance_{wheel}"], 0.155) for wheel in "abc")
    assert is_inside(fitted["mount_x"], 0.02)
    assert is_inside(fitted["mount_y"], 0.03)
    assert fitted["mount_y"].low > 0.01
    assert "mount_x" not in named(calibrate(seen, calibrator, mount="known"))


def test_the_tracked_point_of_two_wheels_is_fitted_where_that_is_asked_for() -> None:
    point = Mount(x=-0.015, y=0.01, yaw=0.02)
    found = named(calibrate(recording(DIFFERENTIAL, point.twist @ DIFFERENTIAL.inverse_kinematic_matrix), mount="fit"))
    truth = {"mount_x": point.x, "mount_y": point.y, "mount_yaw": point.yaw, "track": 0.3, "radius_left": 0.05}
    assert all(is_inside(found[name], value) for name, value in truth.items())


def declared() -> Robot:
    return OMNI.model_copy(update={"mount": MARKER})


def test_a_fitted_mount_is_in_the_file_and_an_attribute() -> None:
    seen = recording(OMNI, MARKER.twist @ OMNI.inverse_kinematic_matrix)
    run = calibrate(seen, "closed_form", mount="fit")
    assert run.calibration.provenance.mount == "fit"
    assert math.hypot(run.calibration.mount.x - 0.02, run.calibration.mount.y - 0.03) < 0.002
    assert run.calibration.matrix == calibrate(seen, "closed_form").calibration.matrix


def test_wrong_lengths_are_doubted_in_one_line() -> None:
    off = {f"radius_{wheel}": 0.15 * 0.148 for wheel in "abc"}
    run = calibrate(recording(APR_02, true_matrix(APR_02, off)))
    (doubt,) = (warning for warning in run.warnings if "no physical reading" in warning)
    assert re.match(r"radius_a \+1[45]\.\d %, radius_b ", doubt)


# What the data do not tell.


def test_runs_without_turns_leave_the_distances_without_interval() -> None:
    data = make_dataset("ring", synthetic_robot(), 0.1, rolled(RING, slip=0.02))
    found = named(calibrate(data, "closed_form"))
    assert [name for name, each in found.items() if each.low is None] == ["distance_a", "distance_b", "distance_c"]


def test_published_and_design_matrices_have_values_without_intervals() -> None:
    data = recording(APR_02, APR_02.inverse_kinematic_matrix)
    run = calibrate(data, "theoretical")
    assert {(each.low, each.high) for each in run.parameters} == {(None, None)}
    assert max(abs(each.deviation) for each in run.parameters) < 1e-9


def test_the_lost_rate_of_map_is_among_the_parameters() -> None:
    run = calibrate(recording(DIFFERENTIAL, DIFFERENTIAL.inverse_kinematic_matrix), "map")
    (effect,) = run.calibration.effects
    lost = named(run)["lost_rate"]
    assert lost.value == -effect.parameters["c"]
    assert is_inside(lost, 0.0, 1.5)
    assert lost.unit == "rad/s"
