"""What recordings can tell before anything is fitted, what they leave open, and what they cannot tell apart."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fit_samples import make_problem
from motions import FLOWER, RING, SPEED, TURNS, Twist, driven
from wheeled_samples import CAR, DIFF
from wheeled_samples import driven as curves

from omnibench.data.dataset import Dataset
from omnibench.errors import DataError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.calibrators.closed_form import linear_start
from omnibench.fit.geometry import WheelGeometry
from omnibench.fit.identifiability import (
    Identifiability,
    deviations_along,
    identifiability,
    identified_parameters,
    inseparable_in_words,
    inseparable_parameters,
    warnings_of_calibration,
)
from omnibench.fit.inspect import inspect_dataset
from omnibench.fit.problem import Budget
from omnibench.fit.span import aligned, driven_span, unidentified_directions
from omnibench.robot.kinematics import Robot
from omnibench.testing.synthetic import synthetic_robot

ROBOT = synthetic_robot()
DISTANCES = ("distance_a", "distance_b", "distance_c")


def told_of(twists: tuple[Twist, ...], slip: float = 0.0, **changes: float) -> Identifiability:
    return identifiability(ROBOT, driven(twists, slip=slip, **changes))


def states(found: Identifiability) -> dict[str, str]:
    return {each.motion: each.state for each in found.directions}


def untold(found: Identifiability) -> tuple[str, ...]:
    return tuple(each.name for each in found.parameters if not each.told)


class TestSmallMatrices:
    """Information matrices of two or three wheels, whose inverses are known."""

    def test_independent_elements_have_the_inverse_root_of_their_information(self) -> None:
        information = np.diag([1.0, 4.0, 16.0, 25.0, 100.0, 0.25])
        np.testing.assert_allclose(
            deviations_along(information, np.eye(2)), [[1.0, 0.25, 0.1], [0.5, 0.2, 2.0]], rtol=1e-12
        )

    def test_directions_that_are_fitted_together_share_their_information_and_kept_ones_take_none(self) -> None:
        correlated = np.kron(np.eye(3), [[2.0, 1.0], [1.0, 2.0]])  # its inverse is [[2, -1], [-1, 2]] / 3
        together = deviations_along(correlated, np.eye(2))
        alone = deviations_along(correlated, np.array([[1.0, 0.0]]))
        turned = deviations_along(correlated, np.array([[1.0, 1.0], [1.0, -1.0]]) / math.sqrt(2))
        np.testing.assert_allclose(together, math.sqrt(2 / 3) * np.ones((2, 3)), rtol=1e-12)
        np.testing.assert_allclose(alone, math.sqrt(1 / 2) * np.ones((1, 3)), rtol=1e-12)
        np.testing.assert_allclose(turned.T, np.tile([math.sqrt(1 / 3), 1.0], (3, 1)), rtol=1e-12)

    def test_a_direction_without_information_is_open_and_leaves_the_others_as_they_are(self) -> None:
        deviations = deviations_along(np.diag([4.0, 0.0, 4.0, 0.0, 4.0, 0.0]), np.eye(2))
        np.testing.assert_allclose(deviations[0], 0.5, rtol=1e-12)
        assert (deviations[1] > 1e6).all()
        assert np.isfinite(deviations).all()

    def test_each_parameter_needs_the_directions_in_which_it_shows(self) -> None:
        """Equal steps of all three wheels turn the robot: only the distances change with what it then does."""
        turn = np.full((1, 3), 1 / math.sqrt(3))
        assert identified_parameters(WheelGeometry(ROBOT), np.zeros((0, 3))) == (True,) * 9
        assert identified_parameters(WheelGeometry(ROBOT), turn) == (True,) * 3 + (False,) * 3 + (True,) * 3
        assert identified_parameters(WheelGeometry(ROBOT), np.eye(3)) == (False,) * 9


class TestPrecision:
    """Predicted standard deviations, against those of linear regressions that are known."""

    def test_headings_alone_give_row_3_the_precision_of_a_regression_on_wheel_angles(self) -> None:
        """With positions that tell nothing, row 3 is m3 in heading = m3.C + noise at every stamp."""
        rng = np.random.default_rng(1)
        blurred = np.array([50.0, 50.0, 0.0])
        runs = [
            replace(run, poses=run.poses + blurred * rng.standard_normal(run.poses.shape))
            for run in driven(FLOWER, repetitions=2)
        ]
        found = identifiability(ROBOT, runs)
        information = 0.0
        for run in runs:
            angles, stamps = run.rates[0] * run.pose_times[1:, None], run.pose_times[1:]
            noise = found.noise
            covariance = noise.pose_heading**2 * np.eye(len(stamps)) + noise.bias_heading**2
            covariance += noise.walk_heading**2 * np.minimum.outer(stamps, stamps)
            information = information + angles.T @ np.linalg.solve(covariance, angles)
        directions = unidentified_directions(ROBOT, driven_span(runs)), aligned(driven_span(runs).strong, ROBOT)
        basis = np.concatenate(directions)
        expected = np.sqrt(np.diag(basis @ np.linalg.inv(information) @ basis.T))
        largest = np.abs(ROBOT.inverse_kinematic_matrix[2]).max()
        predicted = [each.deviations[2] for each in found.directions if each.deviations is not None]
        np.testing.assert_allclose(predicted, expected / largest, rtol=1e-3)


class TestDirections:
    """Every direction of wheel rates, with its motion and how well it is told."""

    def test_runs_that_turn_and_drive_tell_everything_even_if_they_never_reverse(self) -> None:
        found = told_of(FLOWER)
        assert states(found) == dict.fromkeys(("turning on the spot", "moving along x", "moving along y"), "driven")
        assert (found.sentences, untold(found)) == ((), ())
        assert told_of(((SPEED, 0.0, 0.4), (0.0, SPEED, 0.4), (SPEED, SPEED, 0.4))).sentences == ()

    @pytest.mark.parametrize("slip", [0.0, 0.02])
    def test_translation_alone_leaves_the_turn_and_the_distances(self, slip: float) -> None:
        found = told_of(RING, slip)
        assert states(found)["turning on the spot"] == ("weak" if slip else "undriven")
        assert untold(found) == DISTANCES
        assert ", ".join(DISTANCES) in found.sentences[-1]

    @pytest.mark.parametrize(
        ("twists", "slip", "motion"),
        [
            (TURNS, 0.02, "turning on the spot"),
            (((SPEED, 0.0, 0.0), (-SPEED, 0.0, 0.0)), 0.002, "moving along x"),
            (((SPEED, 0.0, 0.3),), 0.0, "moving along x while turning"),
        ],
    )
    def test_turns_lines_or_one_command_alone_are_one_direction(
        self, twists: tuple[Twist, ...], slip: float, motion: str
    ) -> None:
        found = told_of(twists, slip=slip)
        assert [each.motion for each in found.directions if each.state == "driven"] == [motion]
        assert {each.state for each in found.directions} <= {"driven", "weak", "undriven"}
        assert len(untold(found)) >= 8
        assert all("record" in sentence for sentence in found.sentences[:2])

    def test_four_wheels_name_the_slipping_direction_apart_from_the_turn_and_slip_is_no_motion(self) -> None:
        still = identifiability(synthetic_robot(4), driven(RING, wheels=4))
        assert [(each.direction, each.motion) for each in still.directions[2:]] == [
            ("fl + fr + rl + rr", "turning on the spot"),
            ("fl - fr - rl + rr", ""),
        ]
        found = identifiability(synthetic_robot(4), driven(FLOWER, wheels=4, slip=0.02))
        assert [each.state for each in found.directions] == ["driven"] * 3 + ["weak"]
        (sentence,) = found.sentences
        assert f"fl - fr - rl + rr, which only slips, with {100 * found.directions[3].share:.1f} %" in sentence


class TestPrediction:
    """The standard deviations that the noise allows."""

    def test_noise_is_estimated_from_the_repetitions(self) -> None:
        found = told_of(FLOWER)
        assert found.noise.pose_position == pytest.approx(0.003, rel=0.1)
        assert "48 runs of 16 commands" in found.noise_source

    def test_deviations_grow_with_the_noise_and_shrink_with_the_repetitions(self) -> None:
        once, noisy, often = told_of(FLOWER), told_of(FLOWER, noise=0.03), told_of(FLOWER, repetitions=12)
        for one, more, less in zip(once.directions, noisy.directions, often.directions, strict=True):
            assert np.divide(more.deviations, one.deviations) == pytest.approx(10, rel=0.2)
            assert np.divide(less.deviations, one.deviations) == pytest.approx(0.5, rel=0.2)

    def test_a_row_that_is_told_badly_is_named_with_its_deviation(self) -> None:
        found = told_of(((SPEED, 0.0, 0.4), (0.0, SPEED, 0.4), (SPEED, SPEED, -0.4)), noise=0.2, repetitions=2)
        rough = next(sentence for sentence in found.sentences if sentence.startswith("of a + b + c"))
        assert "row 1 (x) to " in rough
        assert rough.endswith("record more or longer runs")

    @pytest.mark.slow
    def test_the_calibrations_of_many_recordings_scatter_as_predicted(self) -> None:
        # The bound is of the best estimator; least squares at every pose is close to it under white noise.
        found = told_of(FLOWER)
        matrices = []
        for seed in range(25):
            problem = make_problem(driven(FLOWER, seed=seed), cost="trajectory")
            matrices.append(problem.matrix(linear_start(problem)))
        turn = np.ones(3) / math.sqrt(3)
        seen = np.std(np.array(matrices) @ turn, axis=0) / np.abs(ROBOT.inverse_kinematic_matrix).max(axis=1)
        predicted = next(each.deviations for each in found.directions if each.motion == "turning on the spot")
        # Of 25 values the standard deviation is uncertain by 14 %.
        assert (seen > 0.65 * np.array(predicted)).all()
        assert (seen < 1.8 * np.array(predicted)).all()

    def test_runs_without_reference_poses_are_refused(self) -> None:
        blind = [replace(run, pose_times=run.pose_times[:1], poses=run.poses[:1]) for run in driven(TURNS)]
        with pytest.raises(DataError, match="no trajectory has a reference pose after its start"):
            identifiability(ROBOT, blind)


class TestWarnings:
    """What a calibration says of the directions it could not tell."""

    @pytest.mark.parametrize("wheels", [3, 4])
    def test_fine_data_give_none(self, wheels: Any) -> None:
        runs = driven(FLOWER, wheels=wheels)
        assert warnings_of_calibration(synthetic_robot(wheels), driven_span(runs), "matrix", "keep") == ()

    @pytest.mark.parametrize(
        ("parameterisation", "unidentified", "end"),
        [
            ("matrix", "keep", "kept at the design values"),
            ("matrix", "fit", "what was fitted there rests on slip and noise"),
            ("geometry", "keep", "what was fitted to it rests on slip and noise"),
        ],
    )
    def test_each_way_to_go_on_is_said(self, parameterisation: str, unidentified: str, end: str) -> None:
        runs = driven(RING, slip=0.02)
        (warning,) = warnings_of_calibration(ROBOT, driven_span(runs), parameterisation, unidentified)
        assert "a + b + c (turning on the spot)" in warning
        assert f"{100 * driven_span(runs).shares[2]:.1f} %" in warning
        assert warning.endswith(end)

    def test_what_is_not_driven_at_all_is_kept_whatever_is_asked(self) -> None:
        (warning,) = warnings_of_calibration(ROBOT, driven_span(driven(RING)), "matrix", "fit")
        assert warning.endswith("do; kept at the design values")


class TestRecordings:
    """The Robotino's table recordings translate only; omni3 drives everything."""

    def test_table_recordings_leave_the_turn_open_and_omni3_nothing(self, robotino: Dataset, omni3: Dataset) -> None:
        found = inspect_dataset(robotino)
        turning = found.findings[0]
        assert turning.startswith("these recordings hardly turn the robot: they drive the wheels along 1 + 2 + 3")
        assert "row 3 (heading)" in turning
        assert states(found.identifiability)["turning on the spot"] == "weak"
        assert untold(found.identifiability) == ("distance_1", "distance_2", "distance_3")
        assert warnings_of_calibration(omni3.robot, driven_span(omni3.split("train")), "matrix", "keep") == ()


KNOWN = np.empty((0, 2))  # no direction of wheel rates is unknown


def test_the_track_of_two_wheels_and_an_unknown_tracked_point_between_them_cannot_be_told_apart() -> None:
    geometry = WheelGeometry(DIFF, fitted_mount=True)
    assert inseparable_parameters(geometry, KNOWN) == (("distance_right", "distance_left", "mount_y"),)
    assert inseparable_parameters(WheelGeometry(DIFF), KNOWN) == ()
    of_the_right_wheel = np.array([[1.0, 0.0]])  # nothing is known of it
    sentences = inseparable_in_words(WheelGeometry(DIFF), of_the_right_wheel)
    assert any(sentence.startswith("these data say nothing of ") for sentence in sentences)


@pytest.mark.parametrize("robot", [DIFF, CAR], ids=lambda robot: robot.name)
@pytest.mark.parametrize("fitted_mount", [False, True])
def test_the_groups_hold_the_numbers_that_are_not_identified(robot: Robot, fitted_mount: bool) -> None:
    geometry = WheelGeometry(robot, fitted_mount=fitted_mount)
    kept = np.empty((0, len(robot.drive.names)))
    identified = dict(zip(geometry.names, identified_parameters(geometry, kept), strict=True))
    grouped = {name for group in inseparable_parameters(geometry, kept) for name in group}
    assert grouped == {name for name, known in identified.items() if not known}


def test_calibrate_says_which_numbers_cannot_be_told_apart() -> None:
    run = calibrate(curves(DIFF), "crs", parameterisation="geometry", mount="fit", budget=Budget(evaluations=300))
    (warning,) = [each for each in run.warnings if "apart" in each]
    assert "distance_right, distance_left and mount_y" in warning
