"""The noise of start headings and clocks comes out of the paths that they turn and shift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from omnibench.data.dataset import Trajectory
from omnibench.fit.noise import Differences, differences_between_repetitions
from omnibench.fit.trajectory_fit import TURN, SeparateNoise, separate_nuisances
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array

STAMPS = np.array([1.0, 2.0, 3.0, 4.0])
COMPONENTS = ("pose_position", "walk_position", "bias_position", "pose_heading", "walk_heading", "bias_heading")
WHITE = Noise(pose_position=0.01, pose_heading=0.01)


def runs_with_residuals(
    turned: float, biased: float, seed: int = 0, late: float = 0.0
) -> tuple[list[Trajectory], list[Array], Array]:
    """150 runs along x at 1 m/s in pairs of one command, their residuals, and u, derivatives by the start heading.

    turned: standard deviation of the start headings, rad. biased: of the reference's headings alone, rad. late: of the
    reference's clock, s.
    """
    rng = np.random.default_rng(seed)
    turning = np.column_stack([np.zeros(4), STAMPS, np.ones(4)])
    times, pose_times = np.array([4.0]), np.append(0.0, STAMPS)
    runs, residuals = [], []
    for index in range(150):
        runs.append(
            Trajectory(
                str(index), "train", times, np.zeros((1, 3)), pose_times, np.zeros((5, 3)), str(index // 2), session="s"
            )
        )
        bias = np.array([0.0, 0.0, biased * rng.standard_normal()])
        residuals.append(0.01 * rng.standard_normal((4, 3)) + turned * rng.standard_normal() * turning + bias)
        if late:
            residuals[-1][:, 0] -= late * rng.standard_normal()
    return runs, residuals, turning


def separated(
    runs: list[Trajectory], residuals: list[Array], turning: Array, noise: Noise, kinds: Sequence[int] = (TURN,)
) -> SeparateNoise:
    """The noise and the deviations of nuisances, by default of the start headings, begun at a noise without these."""
    return separate_nuisances(of_pairs(runs, residuals, turning), noise, kinds)


def of_pairs(runs: list[Trajectory], residuals: list[Array], turning: Array) -> Differences:
    shifting = np.tile([-1.0, 0.0, 0.0], (4, 1))
    slopes = np.stack([turning, shifting, shifting * STAMPS[:, None]], axis=2)
    return differences_between_repetitions(runs, residuals, [slopes] * len(runs))


def test_white_noise_is_told_from_turned_starts_as_by_the_closed_form() -> None:
    """Of y ~ N(0, s^2 I + d^2 u u') the likeliest d^2 is (mean (u'y)^2 / |u|^2 - s^2) / |u|^2."""
    runs, residuals, turning = runs_with_residuals(turned=0.02, biased=0.0)
    found = separated(runs, residuals, turning, WHITE)
    pairs = [(one - other) / np.sqrt(2) for one, other in zip(residuals[::2], residuals[1::2], strict=True)]
    squares = np.square(turning).sum()
    along = np.mean([float((turning * pair).sum()) ** 2 for pair in pairs]) / squares
    assert found.deviations[TURN] == pytest.approx(np.sqrt((along - 0.01**2) / squares), rel=0.01)
    assert found.noise.pose_position == pytest.approx(0.01, rel=0.1)
    assert found.noise.pose_heading == pytest.approx(0.01, rel=0.15)
    assert found.noise.bias_heading < 0.004


def test_a_biased_heading_does_not_turn_the_path_and_is_no_turned_start() -> None:
    runs, residuals, turning = runs_with_residuals(turned=0.0, biased=0.02)
    noise = WHITE.model_copy(update={"bias_heading": 0.02})
    found = separated(runs, residuals, turning, noise)
    assert found.deviations[TURN] == 0.0
    assert found.noise == noise


def test_turned_starts_and_biased_headings_are_told_apart() -> None:
    runs, residuals, turning = runs_with_residuals(turned=0.015, biased=0.03)
    noise = Noise(pose_position=0.02, pose_heading=0.01, bias_heading=0.03)
    found = separated(runs, residuals, turning, noise)
    assert found.deviations[TURN] == pytest.approx(0.015, rel=0.2)
    assert found.noise.bias_heading == pytest.approx(0.03, rel=0.2)


def test_late_clocks_shift_poses_along_the_path_alone_and_come_out_beside_turned_starts() -> None:
    runs, residuals, turning = runs_with_residuals(turned=0.015, biased=0.0, late=0.05)
    noise = Noise(pose_position=0.02, pose_heading=0.01, bias_position=0.03, bias_heading=0.015)
    found = separated(runs, residuals, turning, noise, range(3))
    assert found.deviations == pytest.approx([0.015, 0.05, 0.0], rel=0.2)
    assert found.noise.pose_position == pytest.approx(0.01, rel=0.15)
    assert found.noise.bias_position < 0.004


def test_exact_starts_are_called_noisy_in_one_set_of_twenty() -> None:
    """The level of the test, with 40 sets: 7 or more false ones have a probability of 0.3 %."""
    noisy = [runs_with_residuals(0.0, 0.0, seed) for seed in range(40)]
    found = [separated(runs, residuals, turning, WHITE) for runs, residuals, turning in noisy]
    assert sum(each.deviations[TURN] > 0 for each in found) < 7


def test_the_level_is_shared_by_the_nuisances_that_are_asked_about() -> None:
    noisy = [runs_with_residuals(0.0, 0.0, seed) for seed in range(40)]
    found = [separated(runs, residuals, turning, WHITE, range(3)) for runs, residuals, turning in noisy]
    assert sum(each.deviations.any() for each in found) < 7


@pytest.mark.parametrize("deviations", [(0.0, 0.0, 0.0), (0.02, 0.0, 0.003), (0.03, 0.1, 0.01)])
def test_the_slopes_of_the_likelihood_are_those_of_its_values(deviations: tuple[float, ...]) -> None:
    differences = of_pairs(*runs_with_residuals(turned=0.02, biased=0.01, late=0.02))
    components = np.array([0.01, 0.004, 0.006, 0.012, 0.003, 0.02, *deviations])

    def likelihood(logarithms: Array) -> SeparateNoise:
        values = components * np.exp(logarithms)
        return SeparateNoise.of(
            differences, Noise(**dict(zip(COMPONENTS, values[:6].tolist(), strict=True))), values[6:]
        )

    steps = 1e-5 * np.eye(9)
    by_values = [
        (likelihood(step).minus_log_likelihood - likelihood(-step).minus_log_likelihood) / 2e-5 for step in steps
    ]
    assert likelihood(np.zeros(9)).slopes == pytest.approx(by_values, rel=1e-5, abs=1e-4)
