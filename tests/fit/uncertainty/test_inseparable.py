"""Numbers of a geometry that recordings cannot tell apart."""

from __future__ import annotations

import numpy as np
import pytest
from wheeled_samples import CAR, DIFF, driven

from omnibench.fit.calibrate import calibrate
from omnibench.fit.geometry import WheelGeometry
from omnibench.fit.identifiability import identified_parameters, inseparable_in_words, inseparable_parameters
from omnibench.fit.problem import Budget
from omnibench.robot.kinematics import Robot

KNOWN = np.empty((0, 2))  # no direction of wheel rates is unknown


def test_the_track_of_two_wheels_and_the_tracked_point_between_them_cannot_be_told_apart() -> None:
    geometry = WheelGeometry(DIFF, fitted_mount=True)
    assert inseparable_parameters(geometry, KNOWN) == (("distance_right", "distance_left", "mount_y"),)


def test_with_the_tracked_point_known_every_number_is_identified() -> None:
    assert inseparable_parameters(WheelGeometry(DIFF), KNOWN) == ()


@pytest.mark.parametrize("robot", [DIFF, CAR], ids=lambda robot: robot.name)
@pytest.mark.parametrize("fitted_mount", [False, True])
def test_the_groups_hold_the_numbers_that_are_not_identified(robot: Robot, fitted_mount: bool) -> None:
    geometry = WheelGeometry(robot, fitted_mount=fitted_mount)
    kept = np.empty((0, len(robot.drive.names)))
    identified = dict(zip(geometry.names, identified_parameters(geometry, kept), strict=True))
    grouped = {name for group in inseparable_parameters(geometry, kept) for name in group}
    assert grouped == {name for name, known in identified.items() if not known}


def test_calibrate_says_which_numbers_cannot_be_told_apart() -> None:
    run = calibrate(driven(DIFF), "crs", parameterisation="geometry", mount="fit", budget=Budget(evaluations=300))
    (warning,) = [each for each in run.warnings if "apart" in each]
    assert warning.startswith("these data cannot tell distance_right, distance_left and mount_y apart: ")
    assert run.uncertainty is None or run.uncertainty.parameters is not None


def test_a_number_alone_is_named_alone() -> None:
    geometry = WheelGeometry(DIFF)
    undriven = np.array([[1.0, 0.0]])  # of the right wheel nothing is known
    sentences = inseparable_in_words(geometry, undriven)
    assert any(sentence.startswith("these data say nothing of ") for sentence in sentences)
