"""Fits of a steering's gain, play, coupling and zero, on simulated drives and on a real tricycle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from corelli import corelli_dataset, half
from numpy.typing import NDArray
from sample_robots import CAR, DIFFERENTIAL, TRICYCLE
from wheeled_recordings import PERIOD, path, recorded

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.errors import ConfigError
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.fit.cost import Cost
from omnibench.fit.steering_fit import SteeringFit
from omnibench.registry import costs
from omnibench.robot.kinematics import Array, Robot


def misread(robot: Robot, gain: float = 1.0, zero: float = 0.0) -> Dataset:
    """Simulated runs whose true steering angle is gain times the measured one plus a zero, rad."""
    runs = []
    for run in recorded(robot, robot.inverse_kinematic_matrix, np.random.default_rng(3), 0.1):
        assert run.steering is not None
        runs.append(replace(run, steering=(run.steering - zero) / gain))
    return make_dataset(robot.name, robot, PERIOD, runs, simulated=True)


def weaving(coupling: float) -> Dataset:
    """Simulated runs of a tricycle that steers all the time, by which its wheel is turned along."""
    times, runs = PERIOD * np.arange(1, 101), []
    for number, phase in enumerate(np.linspace(0, 6, 8)):
        steering = 0.5 * np.sin(times + phase)[:, None]
        rates = np.full((100, 1), 6.0)
        middle = (np.vstack([steering[:1], steering[:-1]]) + steering) / 2
        moved = TRICYCLE.drive.signals(rates, middle) @ TRICYCLE.inverse_kinematic_matrix.T * PERIOD
        turned = np.diff(np.vstack([steering[:1], steering]), axis=0) / PERIOD
        stamps = np.concatenate([[0.0], times[9::10]])
        runs.append(
            Trajectory(
                str(number), "train", times, rates - coupling * turned, stamps, path(moved)[::10], steering=steering
            )
        )
    return make_dataset("weaving", TRICYCLE, PERIOD, runs, simulated=True)


class Worst(Cost):
    """The largest pose error."""

    name = "worst"

    def combine(self, errors: Array, trajectory: NDArray[np.intp]) -> Array:  # noqa: ARG002
        worst: Array = np.abs(errors).max(axis=(1, 2))
        return worst


def fitted(run: CalibrationRun) -> dict[str, float]:
    return {name: value for term in run.calibration.effects for name, value in term.parameters.items()}


@pytest.mark.parametrize("gain", [*(pytest.param(gain, marks=pytest.mark.slow) for gain in (0.4, 1.1)), 5.5])
def test_the_gain_of_a_steering_is_found_even_where_it_is_far_off_and_predicts_the_runs(gain: float) -> None:
    dataset = misread(TRICYCLE, gain)
    run = calibrate(dataset, cost="trajectory", steering="fit")
    assert fitted(run)["g"] == pytest.approx(gain - 1, abs=0.02 * gain)
    assert any("the steering was fitted first (steering gain" in warning for warning in run.warnings)
    paths = run.calibration.model.poses([each.reference_log for each in dataset.trajectories])
    errors = [poses[-1] - each.poses[-1] for poses, each in zip(paths, dataset.trajectories, strict=True)]
    assert np.abs(errors).mean() < 0.005


def test_the_zero_of_a_car_s_steering_is_found() -> None:
    run = calibrate(misread(CAR, 1.0, 0.03), cost="trajectory", steering="fit")
    assert fitted(run)["c"] == pytest.approx(0.03, abs=0.003)


def test_a_steering_that_turns_its_wheel_along_is_found_and_no_bound_is_warned_of() -> None:
    run = calibrate(weaving(0.4), cost="trajectory", steering="fit")
    assert fitted(run)["k"] == pytest.approx(0.4, abs=0.02)
    assert not any("lies on the bound" in warning for warning in run.warnings)


def test_a_coupling_beyond_what_is_searched_is_warned_of() -> None:
    beyond = 1.2 / float(TRICYCLE.radii[0])
    run = calibrate(weaving(beyond), cost="trajectory", steering="fit")
    assert fitted(run)["k"] == pytest.approx(beyond / 1.5)
    assert [warning for warning in run.warnings if "lies on the bound" in warning] == [
        f"steering coupling {beyond / 1.5:.3g} lies on the bound of what is searched, so that these runs hardly tell "
        "it, or it stands for something else; take the fit only for drives that steer as these do"
    ]


@pytest.mark.parametrize("cost", ["trajectory", "final_pose"])
@pytest.mark.parametrize("jumped", [(), (1, 4)])
def test_the_slopes_of_the_search_are_those_of_its_cost_where_starts_have_jumped_too(
    cost: str, jumped: tuple[int, ...]
) -> None:
    runs = list(weaving(0.4).trajectories)
    for place in jumped:
        poses = runs[place].poses.copy()
        poses[0] += [0.6, -0.8, 0.3]
        runs[place] = replace(runs[place], poses=poses)
    fit = SteeringFit(TRICYCLE, tuple(runs), PERIOD, costs.create(cost), "row", None, "arc", 1)
    vector, step = np.array([0.5, 0.1, 0.2]), 1e-3
    around = [(fit.cost(vector + moved)[0], fit.cost(vector - moved)[0]) for moved in step * np.eye(3)]
    expected = [(above - below) / (2 * step) for above, below in around]
    slopes = fit.cost(vector)[1]
    np.testing.assert_allclose(slopes, expected, rtol=0, atol=2e-3 * np.abs(expected).max())


def test_a_steering_is_fitted_by_pose_errors() -> None:
    with pytest.raises(ConfigError, match="steering: fit needs a cost that is a sum of norms, which worst is not"):
        SteeringFit(TRICYCLE, tuple(misread(TRICYCLE).trajectories), PERIOD, Worst(None), "row", None, "arc", 1).terms()


def test_a_robot_that_does_not_steer_has_no_steering_to_fit() -> None:
    runs = recorded(DIFFERENTIAL, DIFFERENTIAL.inverse_kinematic_matrix, np.random.default_rng(3))
    dataset = make_dataset("diff", DIFFERENTIAL, PERIOD, runs, simulated=True)
    with pytest.raises(ConfigError, match="steering: fit is for wheels that steer; robot diff has none"):
        calibrate(dataset, steering="fit")


def mean_distance(run: CalibrationRun, drive: Trajectory) -> float:
    (poses,) = run.calibration.model.poses([drive.reference_log])
    return float(np.hypot(*(poses - drive.poses[1:])[:, :2].T).mean())


def test_a_real_tricycle_with_a_steering_gain_far_off_errs_less_than_its_authors_say() -> None:
    dataset = corelli_dataset()
    (drive,) = dataset.trajectories
    run = calibrate(dataset, steering="fit")
    assert run.calibration.provenance is not None
    assert run.calibration.provenance.cost == "trajectory"
    assert mean_distance(run, drive) <= 0.071


def test_the_first_half_of_a_real_drive_predicts_the_second() -> None:
    dataset = corelli_dataset()
    (drive,) = dataset.trajectories
    middle, end = float(drive.pose_times[-1] / 2), float(drive.pose_times[-1])
    first = replace(dataset, trajectories=(half(drive, 0.0, middle),))
    assert mean_distance(calibrate(first, steering="fit"), half(drive, middle, end)) <= 0.15
