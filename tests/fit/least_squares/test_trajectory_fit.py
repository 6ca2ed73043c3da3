"""Runs made ready, the steps of a fit (derivatives, nuisances, the box, weights), and the noise of references."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from discovery_samples import simulated
from fit_samples import make_problem
from hypothesis import given
from hypothesis import strategies as st

from omnibench.data.dataset import Trajectory
from omnibench.discover.fit import fit_matrix, with_noise
from omnibench.errors import DataError
from omnibench.fit.linear_fit import bounded_step
from omnibench.fit.noise import (
    Difference,
    Differences,
    Whitener,
    differences_between_repetitions,
    estimate_noise,
    repeating_runs,
    repetitions_of_commands,
    whiteners,
)
from omnibench.fit.trajectory_fit import (
    OFFSET,
    SLOPE,
    TURN,
    Nuisances,
    SeparateNoise,
    TrajectoryFit,
    Whitened,
    log_of,
    separate_nuisances,
    usable_runs,
    whitened,
)
from omnibench.fit.trajectory_fit import given as after_fitting
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import simulate_dataset

NOISE = Noise(pose_position=0.01, pose_heading=0.01, walk_position=0.005, walk_heading=0.005, bias_position=0.01)
PROBLEM = make_problem()
RUNS = len(PROBLEM.trajectories)


def with_deviations(deviations: Array, values: Array | None = None, vector: Array = PROBLEM.start) -> TrajectoryFit:
    """The fit of a vector, by default the start, with nuisances that have these standard deviations."""
    model = OdometryModel(PROBLEM.robot, PROBLEM.matrix(vector), PROBLEM.integration)
    nuisances = Nuisances(np.zeros((RUNS, 3)) if values is None else values, deviations)
    return TrajectoryFit(model, PROBLEM.trajectories, nuisances)


START = with_deviations(np.zeros(3))
WEIGHTINGS = whiteners(NOISE, START.stamps)


def chi2(fit: TrajectoryFit) -> Array:
    return fit.chi_square(WEIGHTINGS)


def linearised(fit: TrajectoryFit) -> Whitened:
    return fit.linearised(fit.matrix_jacobian(), WEIGHTINGS)


def test_the_scores_are_the_slopes_of_the_objective() -> None:
    data = linearised(START)
    assert np.square(data.residuals).sum() == pytest.approx(chi2(START).sum())
    for index, step in enumerate(1e-6 * np.eye(PROBLEM.size)):
        after, before = (
            chi2(with_deviations(np.zeros(3), None, PROBLEM.start + sign * step)).sum() for sign in (1, -1)
        )
        assert data.scores.sum(axis=0)[index] == pytest.approx(-(after - before) / 4e-6, rel=1e-4)


@pytest.mark.parametrize(
    ("nuisance", "deviation", "kinks"),
    # The recorded path has a kink at every sample, and so has the objective as a function of a clock.
    [(TURN, 0.05, 0.0), (OFFSET, 0.2, 1e-3), (SLOPE, 0.01, 1e-3)],
    ids=["turn", "offset", "slope"],
)
def test_steps_of_a_nuisance_lead_to_where_no_run_can_do_better(nuisance: int, deviation: float, kinks: float) -> None:
    deviations = np.where(np.arange(3) == nuisance, deviation, 0.0)
    values = np.zeros((RUNS, 3))
    for _ in range(4):
        values = with_deviations(deviations, values).likeliest_nuisances(WEIGHTINGS)
    assert not np.delete(values, nuisance, axis=1).any()
    there = chi2(with_deviations(deviations, values))
    assert there.sum() < 0.9 * chi2(with_deviations(deviations)).sum()
    for away in (-0.05, 0.05):
        moved = values + away * (np.abs(values) + deviations)
        assert (chi2(with_deviations(deviations, moved)) > (1 - kinks) * there).all()


def test_what_nuisances_take_up_is_no_information() -> None:
    held = linearised(START).information
    free = linearised(with_deviations(np.array([0.05, 0.2, 0.01]))).information
    assert np.linalg.eigvalsh(held - free).min() >= -1e-9 * np.linalg.eigvalsh(held).max()
    assert np.trace(free) < 0.99 * np.trace(held)


@given(seed=st.integers(0, 2**31), reach=st.floats(0.01, 10.0))
def test_a_step_within_the_box_is_the_best_there_is(seed: int, reach: float) -> None:
    rng = np.random.default_rng(seed)
    unit = PROBLEM.upper - PROBLEM.lower
    slopes = rng.standard_normal((20, PROBLEM.size)) / unit
    information, score = slopes.T @ slopes, reach * 20 * rng.standard_normal(PROBLEM.size) / unit
    vector = PROBLEM.lower + rng.uniform(0, 1, PROBLEM.size) * unit
    step = bounded_step(PROBLEM, vector, information, score)
    room = 1e-8 * unit
    assert (vector + step >= PROBLEM.lower - room).all()
    assert (vector + step <= PROBLEM.upper + room).all()
    slope = (information @ step + score) * unit  # of the objective: > 0 only at a lower bound, < 0 only at an upper one
    small = 1e-5 * np.abs(score * unit).max()
    assert (slope[vector + step > PROBLEM.lower + 10 * room] < small).all()
    assert (slope[vector + step < PROBLEM.upper - 10 * room] > -small).all()


def fit_of(runs, dataset):
    return fit_matrix(usable_runs(runs), dataset.robot, dataset.sample_period, dataset.robot.inverse_kinematic_matrix)


def test_poses_that_contradict_their_neighbours_are_left_out_and_no_others_and_noise_found_again_changes_none() -> None:
    dataset = simulated((), repetitions=4)
    rng = np.random.default_rng(4)
    runs, moved = [], set()
    for run in dataset.split("train"):
        poses = run.poses.copy()
        if rng.random() < 0.3:
            at = int(rng.integers(1, len(poses)))
            poses[at, :2] += rng.choice([-0.08, 0.08], 2)
            moved.add((run.id, float(run.pose_times[at])))
        runs.append(replace(run, poses=poses))
    fit = fit_of(runs, dataset)
    kept = {(run.id, float(stamp)) for run in fit.at_inliers.runs for stamp in run.pose_times}
    gone = {(run.id, float(stamp)) for run in runs for stamp in run.pose_times} - kept
    assert gone >= moved
    assert len(gone - moved) <= 1
    assert fit.jumps == len(gone)
    np.testing.assert_array_equal(np.concatenate(with_noise(fit).masks), np.concatenate(fit.masks))


def test_dense_references_are_thinned_and_keep_their_ends() -> None:
    run = simulated(()).trajectories[0]
    times = np.linspace(0, run.times[-1], 2000)
    poses = np.column_stack([np.interp(times, run.pose_times, each) for each in run.poses.T])
    dense = replace(run, pose_times=times, poses=poses)
    (thinned,) = usable_runs([dense])
    assert len(thinned.pose_times) <= 151
    assert (thinned.pose_times[0], thinned.pose_times[-1]) == (0.0, times[-1])


def test_clocks_that_are_off_run_by_run_are_found_out_and_do_not_move_the_matrix() -> None:
    dataset = simulated((), repetitions=4)
    rng = np.random.default_rng(5)
    exact = fit_of(dataset.split("train"), dataset)
    late = []
    for run in dataset.split("train"):
        offset = 0.15 * rng.standard_normal()
        poses = np.column_stack([np.interp(run.pose_times - offset, run.pose_times, each) for each in run.poses.T])
        poses[0] = run.poses[0]
        late.append(replace(run, poses=poses))
    fit = fit_of(late, dataset)
    assert 0.08 < fit.nuisances.deviations[1] < 0.25
    assert np.abs(fit.model.matrix - exact.model.matrix).max() < 0.01 * np.abs(exact.model.matrix).max()


def test_a_pose_after_the_last_sample_is_reached_by_going_on() -> None:
    run = simulated(()).trajectories[0]
    log = log_of(run, np.array([0.0, -0.5, 0.0]))
    assert log.times[-1] == pytest.approx(run.pose_times[-1] + 0.5)
    assert len(log.wheel_angles) == len(log.times) == len(log.rates)


# Noise of the reference: whitening, variances from repetitions, start headings and clocks, and heavy tails.

DEVIATIONS = {
    "pose_position": 0.006,
    "pose_heading": 0.004,
    "walk_position": 0.004,
    "walk_heading": 0.003,
    "bias_position": 0.009,
    "bias_heading": 0.007,
}
NOISES = st.builds(Noise, **dict.fromkeys(DEVIATIONS, st.floats(1e-3, 1.0)))
STAMPS = st.lists(st.floats(0.01, 2.0), min_size=1, max_size=12).map(np.cumsum)


def dense(white: float, walk: float, bias: float, stamps: Array) -> Array:
    """The covariance (K, K) of one coordinate."""
    shared = walk**2 * np.minimum(stamps[:, None], stamps) + bias**2
    covariance: Array = white**2 * np.eye(len(stamps)) + shared
    return covariance


@given(noise=NOISES, stamps=STAMPS, seed=st.integers(0, 2**31))
def test_whitened_residuals_are_those_of_the_dense_covariance(noise: Noise, stamps: Array, seed: int) -> None:
    residuals = np.random.default_rng(seed).standard_normal((len(stamps), 3))
    whitener = Whitener(noise, stamps)
    position = dense(noise.pose_position, noise.walk_position, noise.bias_position, stamps)
    heading = dense(noise.pose_heading, noise.walk_heading, noise.bias_heading, stamps)
    squares = sum(
        float(column @ np.linalg.solve(covariance, column))
        for column, covariance in zip(residuals.T, (position, position, heading), strict=True)
    )
    assert np.square(whitener(residuals)).sum() == pytest.approx(squares, rel=1e-6)
    determinant = 2 * np.linalg.slogdet(position)[1] + np.linalg.slogdet(heading)[1]
    assert whitener.log_determinant == pytest.approx(determinant, rel=1e-6, abs=1e-6)


def test_derivatives_are_whitened_column_by_column_and_a_bias_alone_can_be_whitened() -> None:
    stamps = np.array([0.2, 0.5, 1.1])
    slopes = np.random.default_rng(0).standard_normal((3, 3, 4))
    whitener = Whitener(Noise(**DEVIATIONS), stamps)
    for index in range(4):
        assert whitener(slopes)[..., index] == pytest.approx(whitener(slopes[..., index]))
    assert np.isfinite(Whitener(Noise(bias_position=0.01, bias_heading=0.01), stamps)(np.zeros((3, 3)))).all()


@pytest.mark.parametrize("stamps", [[0.0, 1.0], [1.0, 0.5], []])
def test_stamps_must_increase_from_above_zero(stamps: list[float]) -> None:
    with pytest.raises(ValueError, match="increasing"):
        Whitener(Noise(**DEVIATIONS), np.array(stamps))


def recorded(repetitions: int, seed: int = 0) -> tuple[list[Trajectory], list[Array]]:
    """Simulated runs whose residuals about the true motion are the reference's noise alone."""
    wheels = [
        {"name": name, "radius": 0.1, "distance": 0.2, "angle": angle}
        for name, angle in zip("abc", (1, 3, 5), strict=True)
    ]
    shared = {
        "robot": {"name": "three", "wheels": wheels},
        "sample_period": 0.05,
        "commands": {"directions_deg": [0, 60, 120, 180, 240, 300], "turn_rates": [-0.3, 0.3]},
        "repetitions": repetitions,
        "truth": {"tolerances": {}},
        "train": {"seed": seed, "distance": 1.2},
    }
    noisy = simulate_dataset(FlowerConfig.model_validate(shared | {"noise": DEVIATIONS})).dataset.trajectories
    exact = simulate_dataset(FlowerConfig.model_validate(shared)).dataset.trajectories
    residuals = [there.poses[1:] - here.poses[1:] for here, there in zip(noisy, exact, strict=True)]
    return list(noisy), residuals


def test_the_variances_are_found_from_the_repetitions() -> None:
    runs, residuals = recorded(20)
    estimate = estimate_noise(differences_between_repetitions(runs, residuals))
    assert estimate.source == "repetitions"
    for name, value in DEVIATIONS.items():
        assert getattr(estimate.noise, name) == pytest.approx(value, rel=0.15), name


def test_what_the_model_gets_wrong_of_a_command_is_no_noise() -> None:
    runs, residuals = recorded(20)
    wrong = {run.command: 0.1 * np.random.default_rng(index).standard_normal(3) for index, run in enumerate(runs)}
    bent = [part + wrong[run.command] for run, part in zip(runs, residuals, strict=True)]
    plain, found = (estimate_noise(differences_between_repetitions(runs, values)).noise for values in (residuals, bent))
    assert found.bias_position == pytest.approx(plain.bias_position, rel=0.01)


def test_without_repetitions_the_residuals_are_taken_and_that_is_said() -> None:
    runs, residuals = recorded(1)
    alone = [replace(run, command=None) for run in runs]
    estimate = estimate_noise(differences_between_repetitions(alone, residuals))
    assert estimate.source == "within runs"
    assert "no command is repeated" in estimate.description
    assert estimate.noise.pose_position == pytest.approx(DEVIATIONS["pose_position"], rel=0.2)
    with pytest.raises(DataError, match="no trajectory"):
        estimate_noise(differences_between_repetitions([], []))


def test_a_component_that_differences_hardly_show_is_the_likeliest_one_and_not_zero() -> None:
    """Twice the log-likelihood of a bias beside none is near 1 here: no proof of it, and yet zero is less likely."""
    stamps, rng = np.array([1.0, 2.0, 3.0, 4.0]), np.random.default_rng(5)
    values = rng.standard_normal((20, 4, 3)) + 0.3 * rng.standard_normal((20, 1, 3))
    differences = tuple(Difference(stamps, of_run, np.zeros((4, 3, 0))) for of_run in values)
    noise = estimate_noise(Differences(differences, "repetitions", "")).noise

    def loss(white: float, walk: float, bias: float) -> float:
        covariance, headings = dense(white, walk, bias, stamps), values[:, :, 2].T
        squares = float((headings * np.linalg.solve(covariance, headings)).sum())
        return 20 * float(np.linalg.slogdet(covariance)[1]) + squares

    grid = np.linspace(0.0, 0.6, 13)
    losses = np.array([[loss(w, k, b) for w in np.linspace(0.8, 1.2, 21) for k in grid] for b in grid])
    assert 0.3 < losses[0].min() - losses.min() < 2.0
    assert loss(noise.pose_heading, noise.walk_heading, noise.bias_heading) <= losses.min() + 0.01


FOUR_STAMPS = np.array([1.0, 2.0, 3.0, 4.0])
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
    turning = np.column_stack([np.zeros(4), FOUR_STAMPS, np.ones(4)])
    times, pose_times = np.array([4.0]), np.append(0.0, FOUR_STAMPS)
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
    slopes = np.stack([turning, shifting, shifting * FOUR_STAMPS[:, None]], axis=2)
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


@pytest.mark.parametrize(
    ("made", "begun", "kinds", "deviations", "noise"),
    [
        ({"turned": 0.015, "biased": 0.03}, {"bias_heading": 0.03}, [TURN], [0.015], {"bias_heading": 0.03}),
        (
            {"turned": 0.015, "biased": 0.0, "late": 0.05},
            {"bias_position": 0.03, "bias_heading": 0.015},
            range(3),
            [0.015, 0.05, 0.0],
            {"pose_position": 0.01, "bias_position": 0.0},
        ),
    ],
)
def test_turned_starts_are_told_from_biased_headings_and_late_clocks_which_shift_poses_along_the_path(
    made: dict[str, float],
    begun: dict[str, float],
    kinds: Sequence[int],
    deviations: list[float],
    noise: dict[str, float],
) -> None:
    start = Noise(**{"pose_position": 0.02, "pose_heading": 0.01} | begun)
    found = separated(*runs_with_residuals(**made), start, kinds)
    assert found.deviations[: len(deviations)] == pytest.approx(deviations, rel=0.2)
    for name, value in noise.items():
        assert getattr(found.noise, name) == pytest.approx(value, rel=0.2, abs=0.004), name


def test_a_biased_heading_does_not_turn_the_path_and_is_no_turned_start() -> None:
    noise = WHITE.model_copy(update={"bias_heading": 0.02})
    found = separated(*runs_with_residuals(turned=0.0, biased=0.02), noise)
    assert found.deviations[TURN] == 0.0
    assert found.noise == noise


@pytest.mark.parametrize("kinds", [[TURN], [0, 1, 2]])
def test_exact_starts_and_clocks_are_called_noisy_in_one_set_of_twenty(kinds: Sequence[int]) -> None:
    """The level of the test, which all nuisances share, with 40 sets: 7 or more false ones: 0.3 %."""
    noisy = [runs_with_residuals(0.0, 0.0, seed) for seed in range(40)]
    found = [separated(runs, residuals, turning, WHITE, kinds) for runs, residuals, turning in noisy]
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
    ends = [[likelihood(sign * step).minus_log_likelihood for sign in (1, -1)] for step in steps]
    by_values = [(after - before) / 2e-5 for after, before in ends]
    assert likelihood(np.zeros(9)).slopes == pytest.approx(by_values, rel=1e-5, abs=1e-4)


HEAVY_NOISE = Noise(
    pose_position=0.01, walk_position=0.02, bias_position=0.03, pose_heading=0.02, walk_heading=0.01, bias_heading=0.005
)
HEAVY_STAMPS = np.array([0.3, 0.5, 1.1, 1.2, 2.0])


def covariance(kind: str) -> Array:
    return dense(*(getattr(HEAVY_NOISE, f"{part}_{kind}") for part in ("pose", "walk", "bias")), HEAVY_STAMPS)


@given(seed=st.integers(0, 10**6))
def test_what_the_others_say_of_a_pose_is_that_of_the_dense_inverse(seed: int) -> None:
    residuals = np.random.default_rng(seed).standard_normal((5, 3))
    errors, variances = Whitener(HEAVY_NOISE, HEAVY_STAMPS).left_out(residuals)
    dense = covariance("position")
    others = [0, 1, 3, 4]
    gain = np.linalg.solve(dense[np.ix_(others, others)], dense[others, 2])
    assert errors[2, 0] == pytest.approx(residuals[2, 0] - gain @ residuals[others, 0], rel=1e-9)
    assert variances[2, 1] == pytest.approx(dense[2, 2] - gain @ dense[others, 2], rel=1e-9)


Split = Literal["train", "validation"]


def run(split: Split, session: str | None, command: str | None) -> Trajectory:
    return Trajectory(
        id=f"{split} {session} {command}",
        split=split,
        command=command,
        session=session,
        times=np.array([0.1, 0.2]),
        rates=np.ones((2, 3)),
        pose_times=np.array([0.0, 0.2]),
        poses=np.zeros((2, 3)),
    )


def groups(runs: Sequence[Trajectory]) -> list[tuple[int, ...]]:
    return list(repetitions_of_commands(runs).groups)


def test_runs_of_different_sessions_are_no_repetitions() -> None:
    runs = [run("train", "A", "go"), run("train", "B", "go")]
    assert groups(runs) == []
    assert repetitions_of_commands(runs).words == "no session repeats a command"
    every = [*runs, run("validation", "A", "go"), run("validation", "B", "go")]
    assert groups(every) == [(0, 2), (1, 3)]  # across splits where no split repeats a command in a session
    assert repetitions_of_commands(every).description == "4 runs of 1 command"
    assert groups([*every, run("train", "A", "go")]) == [(0, 4)]


def test_runs_of_a_split_are_repetitions_where_sessions_are_not_known() -> None:
    runs = [run("train", None, "go"), run("train", None, "go"), run("validation", None, "go"), run("train", None, None)]
    assert groups(runs) == [(0, 1)]
    assert repetitions_of_commands(runs).words == "each within one split"
    assert groups(runs[1:]) == []


def test_runs_of_the_validation_serve_the_noise_only_where_no_training_run_is_repeated() -> None:
    train, others = [run("train", "A", "go")], [run("validation", "A", "go"), run("validation", "B", "go")]
    assert repeating_runs(train, others) == others[:1]
    assert repeating_runs([*train, *train], others) == []
    assert repeating_runs([run("train", None, "go")], [run("validation", None, "go")]) == []


OWN_NOISE = Noise(pose_position=0.01, pose_heading=0.02, walk_position=0.005, walk_heading=0.01, bias_position=0.02)


def random_data(seed: int, count: int, deviations: np.ndarray):
    rng = np.random.default_rng(seed)
    stamps = [np.cumsum(rng.uniform(0.1, 0.4, size)) for size in rng.integers(3, 9, count)]
    residuals = [rng.normal(0, 0.03, (len(each), 3)) for each in stamps]
    columns = [rng.normal(0, 1, (len(each), 3, 6)) for each in stamps]
    nuisances = [rng.normal(0, 1, (len(each), 3, 3)) for each in stamps]
    known = deviations > 0
    data = whitened(
        residuals, columns, whiteners(OWN_NOISE, stamps), [each[..., known] for each in nuisances], deviations[known]
    )
    return data, residuals, columns, stamps, nuisances


@given(seed=st.integers(0, 10**6), count=st.integers(2, 6))
def test_a_gain_is_what_least_squares_lowers_chi2_by(seed: int, count: int) -> None:
    data, *_ = random_data(seed, count, np.zeros(3))
    columns, residuals = np.concatenate(data.columns), np.concatenate(data.residuals)

    def left(index: list[int]) -> float:
        answer, *_ = np.linalg.lstsq(columns[:, index], residuals, rcond=None)
        return float(np.square(residuals - columns[:, index] @ answer).sum())

    assert np.isclose(
        after_fitting(data, [0, 1]).chi_square([2, 3]), left([0, 1]) - left([0, 1, 2, 3]), rtol=1e-6, atol=1e-8
    )


@given(seed=st.integers(0, 10**6))
def test_estimates_beyond_other_columns_are_those_of_the_joint_fit(seed: int) -> None:
    data, *_ = random_data(seed, 4, np.zeros(3))
    columns, residuals = np.concatenate(data.columns), np.concatenate(data.residuals)
    joint, *_ = np.linalg.lstsq(columns, residuals, rcond=None)
    values, covariance = after_fitting(data, [0, 1, 2]).estimate([3, 4, 5])
    assert np.allclose(values, joint[3:], rtol=1e-6, atol=1e-9)
    assert np.allclose(covariance, np.linalg.inv(columns.T @ columns)[3:, 3:], rtol=1e-6)


@given(seed=st.integers(0, 10**6))
def test_nuisances_of_a_run_count_as_noise_that_its_poses_share(seed: int) -> None:
    deviations = np.array([0.02, 0.0, 0.05])
    data, residuals, columns, stamps, nuisances = random_data(seed, 3, deviations)
    for row, (own, slopes, times, extra) in enumerate(zip(residuals, columns, stamps, nuisances, strict=True)):
        noise = np.zeros((3 * len(times), 3 * len(times)))
        for axis, components in enumerate([(0.01, 0.005, 0.02)] * 2 + [(0.02, 0.01, 0.0)]):
            noise[axis::3, axis::3] = dense(*components, times)
        spread = extra.reshape(-1, 3) * deviations
        inverse = np.linalg.inv(noise + spread @ spread.T)
        flat, target = slopes.reshape(-1, 6), own.ravel()
        assert np.allclose(data.columns[row].T @ data.columns[row], flat.T @ inverse @ flat, rtol=1e-6, atol=1e-6)
        assert np.allclose(data.scores[row], flat.T @ inverse @ target, rtol=1e-5, atol=1e-6)


def with_a_column(data: Whitened, extra: Sequence[Array]) -> Whitened:
    """The data with one column more."""
    columns = tuple(np.column_stack([each, more]) for each, more in zip(data.columns, extra, strict=True))
    scores = [each.T @ own for each, own in zip(columns, data.residuals, strict=True)]
    return Whitened(data.residuals, columns, sum(each.T @ each for each in columns), np.array(scores))


def test_a_direction_that_others_make_is_no_direction() -> None:
    data, *_ = random_data(1, 5, np.zeros(3))
    twice = with_a_column(data, [each[:, 0] + each[:, 1] for each in data.columns])
    assert after_fitting(twice, [0, 1]).rank([6]) == 0
    assert after_fitting(twice, [0, 1]).chi_square([6]) == 0.0


@pytest.mark.parametrize("size", [1e-17, 1e-140])
def test_a_signal_that_no_motion_drives_is_not_estimated_from_its_rounding(size: float) -> None:
    """As of two wheels that share an encoder: DART's car got a matrix of 1e137, and discover a traceback."""
    data, *_ = random_data(1, 5, np.zeros(3))
    rounding = np.random.default_rng(2)
    undriven = with_a_column(data, [size * rounding.normal(0, 1, len(each)) for each in data.columns])
    values, covariance = after_fitting(undriven, []).estimate(range(7))
    assert values[:6] == pytest.approx(after_fitting(data, []).estimate(range(6))[0], rel=1e-9)
    assert abs(values[6] * size) < 1e-12
    assert np.isfinite(covariance).all()
    assert after_fitting(undriven, []).rank([6]) == 0
