"""Fits of robots on every kind of wheel and of their steering, on simulated recordings and on real ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from corelli import corelli_dataset, half
from lanes import slow
from numpy.typing import NDArray
from real_recordings import mean_errors
from sample_robots import CAR, DIFFERENTIAL, TRICYCLE, WHEELED
from wheeled_recordings import PERIOD, path, recorded

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.errors import ConfigError
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.fit.cost import Cost
from omnibench.fit.geometry import WheelGeometry
from omnibench.fit.settings import CompleteSettings
from omnibench.fit.steering_fit import SteeringFit
from omnibench.registry import costs
from omnibench.robot.kinematics import Array, Mount, Robot

EVERY = [pytest.param(robot, id=robot.name) for robot in WHEELED]


def recording(robot: Robot, matrix: Array, noise: float = 1.0) -> Dataset:
    runs = recorded(robot, matrix, np.random.default_rng(5), noise)
    return make_dataset(robot.name, robot, PERIOD, runs, simulated=True)


def off_design(robot: Robot) -> Array:
    """A matrix (3, M) a few per cent off the design, in which no fixed wheel slides."""
    deviation = 0.02 * robot.row_scales[:, None] * np.random.default_rng(6).standard_normal((3, len(robot.drive.names)))
    return robot.inverse_kinematic_matrix + (deviation if robot.slides else robot.allowed_twists @ deviation)


MOUNTED = DIFFERENTIAL.model_copy(update={"name": "mounted", "mount": Mount(x=0.2, y=0.1, yaw=0.3)})


@pytest.mark.parametrize("robot", [*EVERY, pytest.param(MOUNTED, id="mounted")])
def test_recordings_without_noise_give_the_true_motions(robot: Robot) -> None:
    """A known tracked point is no slide."""
    truth = off_design(robot)
    found = calibrate(recording(robot, truth, 0.0), unidentified="keep").calibration.matrix_array
    driven = robot.signal_equations @ robot.motions.T
    np.testing.assert_allclose(found @ driven, truth @ driven, rtol=0, atol=1e-6)


def test_a_differential_drive_does_not_slide_unless_its_tracked_point_may_be_elsewhere() -> None:
    moved = DIFFERENTIAL.model_copy(update={"mount": Mount(x=0.02, y=0.0, yaw=0.02)}).inverse_kinematic_matrix
    dataset = recording(DIFFERENTIAL, moved, 0.3)
    known, fitted = (calibrate(dataset, mount=mount) for mount in ("known", "fit"))
    assert known.result.held == ("m21", "m22")
    assert not known.calibration.matrix_array[1].any()
    np.testing.assert_allclose(fitted.calibration.matrix_array[1], moved[1], rtol=0, atol=2e-4)


@pytest.mark.parametrize("robot", [DIFFERENTIAL, *slow(TRICYCLE, CAR)], ids=lambda robot: robot.name)
def test_the_geometry_is_found_by_a_search(robot: Robot) -> None:
    geometry = WheelGeometry(robot)
    hidden = geometry.start + geometry.scale * 0.02 * np.random.default_rng(7).standard_normal(len(geometry.start))
    dataset = recording(robot, geometry.matrices(hidden[None])[0], 0.0)
    run = calibrate(dataset, "parametric", unidentified="keep", mount="known")
    assert run.parameters is not None
    driven = robot.signal_equations @ robot.motions.T
    np.testing.assert_allclose(
        run.calibration.matrix_array @ driven, geometry.matrices(hidden[None])[0] @ driven, rtol=0, atol=1e-5
    )


def of_group(dataset: Dataset, *groups: str) -> Dataset:
    """The runs of some groups, to train."""
    runs = (run for run in dataset.trajectories if run.id.startswith(groups))
    return replace(dataset, trajectories=tuple(replace(run, split="train") for run in runs))


@pytest.mark.parametrize(
    ("name", "trained", "published"),
    [
        ("diff", "circular", {"circular": (0.0090, 1.10), "square": (0.028, 1.9), "ivanjko": (0.0055, 0.95)}),
        pytest.param("diff", "square", {"square": (0.0108, 1.05), "circular": (0.0297, 4.06)}, marks=pytest.mark.slow),
        pytest.param("tricyc", "circular", {"circular": (0.042, 3.7), "square": (0.084, 3.2)}, marks=pytest.mark.slow),
        pytest.param("omni4", "circular", {"": (0.031, 3.4)}, marks=pytest.mark.slow),
    ],
)
def test_a_real_robot_errs_less_than_by_published_methods(
    request: pytest.FixtureRequest, name: str, trained: str, published: dict[str, tuple[float, float]]
) -> None:
    dataset = request.getfixturevalue(name)
    matrix = calibrate(of_group(dataset, trained)).calibration.matrix_array
    for judged, limits in published.items():
        assert (np.array(mean_errors(matrix, of_group(dataset, judged).trajectories)) <= limits).all()


def misread(robot: Robot, gain: float = 1.0, zero: float = 0.0) -> Dataset:
    """Simulated runs whose true steering angle is gain times the measured one plus a zero, rad."""
    exact = recorded(robot, robot.inverse_kinematic_matrix, np.random.default_rng(3), 0.1)
    runs = [replace(run, steering=(run.steering - zero) / gain) for run in exact]
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


# What the search for a steering fits.
MATRIX = {"calibrator": "closed_form", "parameterisation": "matrix", "unidentified": "keep"}


class Worst(Cost):
    """The largest pose error."""

    name = "worst"

    def combine(self, errors: Array, trajectory: NDArray[np.intp]) -> Array:  # noqa: ARG002
        worst: Array = np.abs(errors).max(axis=(1, 2))
        return worst


def fitted(run: CalibrationRun) -> dict[str, float]:
    return {name: value for term in run.calibration.effects for name, value in term.parameters.items()}


@pytest.mark.slow
@pytest.mark.parametrize("gain", [0.4, 1.1, 5.5])
def test_the_gain_of_a_steering_is_found_even_where_it_is_far_off_and_predicts_the_runs(gain: float) -> None:
    dataset = misread(TRICYCLE, gain)
    run = calibrate(dataset, cost="trajectory", steering="fit")
    assert fitted(run)["g"] == pytest.approx(gain - 1, abs=0.02 * gain)
    assert any("the steering was fitted first (steering gain" in warning for warning in run.warnings)
    paths = run.calibration.model.poses([each.reference_log for each in dataset.trajectories])
    errors = [poses[-1] - each.poses[-1] for poses, each in zip(paths, dataset.trajectories, strict=True)]
    assert np.abs(errors).mean() < 0.005


@pytest.mark.slow
def test_the_zero_of_a_car_s_steering_is_found() -> None:
    run = calibrate(misread(CAR, 1.0, 0.03), cost="trajectory", steering="fit")
    assert fitted(run)["c"] == pytest.approx(0.03, abs=0.003)


def test_a_steering_that_turns_its_wheel_along_is_found_and_no_bound_is_warned_of() -> None:
    run = calibrate(weaving(0.4), cost="trajectory", steering="fit")
    assert fitted(run)["k"] == pytest.approx(0.4, abs=0.02)
    assert not any("lies on the bound" in warning for warning in run.warnings)


@pytest.mark.slow
def test_a_coupling_beyond_what_is_searched_is_warned_of() -> None:
    beyond = 1.2 / float(TRICYCLE.radii[0])
    run = calibrate(weaving(beyond), cost="trajectory", steering="fit")
    assert fitted(run)["k"] == pytest.approx(beyond / 1.5)
    (warning,) = [each for each in run.warnings if "lies on the bound" in each]
    assert f"steering coupling {beyond / 1.5:.3g}" in warning


@pytest.mark.parametrize("cost", ["trajectory", "final_pose"])
@pytest.mark.parametrize("jumped", [(), (1, 4)])
def test_slopes_of_a_search_are_those_of_its_cost_where_starts_jumped_too(cost: str, jumped: tuple[int, ...]) -> None:
    runs = list(weaving(0.4).trajectories)
    for place in jumped:
        poses = runs[place].poses.copy()
        poses[0] += [0.6, -0.8, 0.3]
        runs[place] = replace(runs[place], poses=poses)
    fit = SteeringFit(TRICYCLE, tuple(runs), PERIOD, CompleteSettings(cost=cost, loss="huber", **MATRIX))
    vector, step = np.array([0.5, 0.1, 0.2]), 1e-3
    around = [(fit.cost(vector + moved)[0], fit.cost(vector - moved)[0]) for moved in step * np.eye(3)]
    expected = [(above - below) / (2 * step) for above, below in around]
    slopes = fit.cost(vector)[1]
    np.testing.assert_allclose(slopes, expected, rtol=0, atol=2e-3 * np.abs(expected).max())


def test_a_steering_is_fitted_by_pose_errors_of_a_robot_that_steers() -> None:
    costs.register("worst")(Worst)
    with pytest.raises(ConfigError, match="worst"):
        calibrate(misread(TRICYCLE), cost="worst", steering="fit")
    runs = recorded(DIFFERENTIAL, DIFFERENTIAL.inverse_kinematic_matrix, np.random.default_rng(3))
    dataset = make_dataset("diff", DIFFERENTIAL, PERIOD, runs, simulated=True)
    with pytest.raises(ConfigError, match="robot diff"):
        calibrate(dataset, steering="fit")


def mean_distance(run: CalibrationRun, drive: Trajectory) -> float:
    (poses,) = run.calibration.model.poses([drive.reference_log])
    return float(np.hypot(*(poses - drive.poses[1:])[:, :2].T).mean())


def test_a_real_tricycle_with_a_steering_gain_far_off_errs_less_than_its_authors_say() -> None:
    dataset = corelli_dataset()
    (drive,) = dataset.trajectories
    run = calibrate(dataset, steering="fit")
    assert run.calibration.provenance.cost == "trajectory"
    assert mean_distance(run, drive) <= 0.071


@pytest.mark.slow
def test_the_first_half_of_a_real_drive_predicts_the_second() -> None:
    dataset = corelli_dataset()
    (drive,) = dataset.trajectories
    middle, end = float(drive.pose_times[-1] / 2), float(drive.pose_times[-1])
    first = replace(dataset, trajectories=(half(drive, 0.0, middle),))
    assert mean_distance(calibrate(first, steering="fit"), half(drive, middle, end)) <= 0.15
