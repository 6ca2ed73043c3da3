"""Intervals by Student's t, of ratios and of the sandwich: units, coverage, and where there is none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import improvement_coverage
import numpy as np
import pytest
from fit_samples import noisy_trajectories
from scipy import stats

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.information import EstimatedCovariance
from omnibench.fit.ratio_intervals import Bootstrap, RatioIntervals, Units, units_of
from omnibench.fit.sandwich import Scores, sandwich, scores_of_runs
from omnibench.registry import costs
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch

MATRIX = np.array([[4.0, 1.0], [1.0, 9.0]])


def test_half_widths_are_quantiles_of_students_or_the_normal_distribution_times_the_standard_deviations() -> None:
    covariance = EstimatedCovariance(MATRIX, np.array([3.0, 10.0]))
    np.testing.assert_allclose(covariance.reach, [3.182 * 2, 2.228 * 3], rtol=2e-4)
    np.testing.assert_allclose(EstimatedCovariance(MATRIX).reach, [1.960 * 2, 1.960 * 3], rtol=2e-4)
    kept = EstimatedCovariance(np.zeros((2, 2)), np.array([1.0, 4.0])).of(np.ones((1, 2)))
    assert kept.reach == pytest.approx([0.0])  # a function of nothing that varies


def test_one_number_of_degrees_of_freedom_holds_for_all_functions() -> None:
    functions = EstimatedCovariance(MATRIX, 5).of(np.array([[1.0, 1.0], [2.0, -1.0]]))
    np.testing.assert_allclose(functions.matrix, [[15.0, 0.0], [0.0, 21.0]], atol=1e-12)
    np.testing.assert_allclose(functions.degrees_of_freedom, 5.0)


def test_the_degrees_of_freedom_of_a_sum_lie_between_those_of_its_terms() -> None:
    independent = EstimatedCovariance(np.diag([1.0, 3.0]), np.array([2.0, 6.0]))
    functions = independent.of(np.array([[1.0, 0.0], [1.0, 1.0]]))
    assert functions.degrees_of_freedom == pytest.approx([2.0, 1 / (0.25 / 2 + 0.75 / 6)])


BOOTSTRAP = Bootstrap(resamples=2000, seed=1)


def units(commands: int, repetitions: int = 1) -> Units:
    return Units("command", np.repeat(np.arange(commands), repetitions))


def test_commands_are_the_unit_where_runs_repeat_them_and_runs_elsewhere() -> None:
    (run, *_) = noisy_trajectories()
    named = [replace(run, id=f"{index}", command=name) for index, name in enumerate(["a", "b", "a", None, None])]
    assert units_of(named).name == "command"
    assert units_of(named).of_run.tolist() == [0, 1, 0, 2, 3]  # a run without a command is its own unit
    assert units_of(named, "run").of_run.tolist() == [0, 1, 2, 3, 4]
    assert (units_of(named[:2]).name, units_of(named[:2]).count) == ("run", 2)


@pytest.mark.parametrize(
    ("count", "words"),
    [
        (1, "no interval from 1 command"),
        (2, "no interval from 2 commands"),
        (3, "Student's t over 3 commands"),
        (9, "Student's t over 9 commands"),
        (10, "bootstrap over 10 commands"),
    ],
)
def test_the_number_of_units_decides_the_method_and_is_said(count: int, words: str) -> None:
    of = units(count, 2)
    costs = np.random.default_rng(0).uniform(1.0, 2.0, 2 * count)
    found = RatioIntervals(BOOTSTRAP).mean(costs, of)
    assert of.words == words
    assert (found.known is None) == words.startswith("no interval")
    assert found.value == pytest.approx(costs.mean())


@pytest.mark.parametrize(
    "differences",
    [
        np.random.default_rng(3).normal(0.2, 0.4, 7),
        *(sign * np.array([1e-4, 2e-4, 1e-4, 3e-4, 0.05]) for sign in (1, -1)),
    ],
)
def test_a_difference_over_few_units_has_the_interval_of_the_t_test_even_of_one_sign(differences: Array) -> None:
    found = RatioIntervals(BOOTSTRAP).difference(differences, units(len(differences)))
    expected = stats.ttest_1samp(differences, 0.0).confidence_interval(0.95)
    assert found.known == pytest.approx((expected.low, expected.high))
    assert found.holds(0.0) == (expected.low < 0 < expected.high)


@pytest.mark.parametrize("count", [3, 4, 9])
def test_a_true_difference_of_zero_is_left_out_in_five_per_cent_of_the_sets(count: int) -> None:
    rng = np.random.default_rng(count)
    intervals, of = RatioIntervals(BOOTSTRAP), units(count)
    left_out = sum(not intervals.difference(rng.standard_normal(count), of).holds(0.0) for _ in range(2000))
    assert 70 <= left_out <= 130  # binomial: 100 +- 9.7; on the logarithm's scale 288 of 3 units


def test_twenty_runs_of_a_command_tell_no_more_than_one_of_their_mean() -> None:
    rng = np.random.default_rng(4)
    costs, before = rng.uniform(1, 2, 12), rng.uniform(2, 4, 12)
    intervals = RatioIntervals(BOOTSTRAP)
    once = intervals.improvement(costs, before, units(12))
    repeated = intervals.improvement(np.repeat(costs, 20), np.repeat(before, 20), units(12, 20))
    assert repeated.known == pytest.approx(once.known)


def test_the_interval_of_an_improvement_leaves_out_zero_where_the_mean_paired_difference_does() -> None:
    intervals = RatioIntervals(BOOTSTRAP)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        before = rng.uniform(1, 2, 14)
        after = before * rng.normal(0.9, 0.2, 14)
        gain = intervals.improvement(after, before, units(14))
        difference = intervals.difference(after - before, units(14))
        edge = min(abs(end) for end in gain.known or (1.0,))
        assert gain.holds(0.0) == difference.holds(0.0) or edge < 0.02  # resamples of another statistic, at the edge


def test_an_improvement_is_below_one_and_a_mean_cost_above_zero_over_few_units() -> None:
    intervals = RatioIntervals(BOOTSTRAP)
    costs, before = np.array([0.01, 0.5, 0.02]), np.array([1.0, 1.1, 0.9])
    gain, mean = intervals.improvement(costs, before, units(3)), intervals.mean(costs, units(3))
    assert gain.known[0] < gain.value < gain.known[1] < 1
    assert mean.known[0] > 0


def test_the_ends_are_where_the_paired_t_statistic_reaches_its_bootstrapped_quantiles() -> None:
    """Resampled here anew, by another generator: 2 % of noise in each quantile."""
    rng = np.random.default_rng(8)
    before = rng.uniform(1, 2, 14)
    after = before * rng.gamma(4.0, 0.2, 14)  # skewed, so that the two quantiles differ
    found = RatioIntervals(Bootstrap(resamples=20_000)).ratio(after, before, units(14))
    left = after - after.sum() / before.sum() * before
    low, high = np.percentile(stats.ttest_1samp(rng.choice(left, (20_000, 14)), 0.0, axis=1).statistic, [2.5, 97.5])
    reached = [stats.ttest_1samp(after - end * before, 0.0).statistic for end in found.known]
    assert reached == pytest.approx([high, low], rel=0.06)


def test_one_command_that_outweighs_all_others_has_no_interval_and_equal_shares_have_one_without_width() -> None:
    before = np.append(np.full(11, 1e-3), 100.0)
    gain = RatioIntervals(BOOTSTRAP).improvement(np.append(np.full(11, 2e-3), 90.0), before, units(12))
    assert (gain.known, gain.holds(0.0)) == (None, True)
    equal = RatioIntervals(BOOTSTRAP).improvement(0.25 * np.arange(1.0, 5.0), np.arange(1.0, 5.0), units(4))
    assert equal.known == pytest.approx((0.75, 0.75))


@pytest.mark.parametrize("kind", ["usual", "none", "unequal"])
@pytest.mark.parametrize(
    "commands", [pytest.param(30, marks=pytest.mark.slow), pytest.param(12, marks=pytest.mark.slow), 5]
)
def test_intervals_over_commands_that_share_an_error_cover_the_improvement(kind: str, commands: int) -> None:
    rng = np.random.default_rng(commands)
    truth = improvement_coverage.improvement_of(improvement_coverage.KINDS[kind])
    hits = [
        improvement_coverage.ours(
            improvement_coverage.drawn(improvement_coverage.KINDS[kind], commands, rng), seed
        ).holds(truth)
        for seed in range(200)
    ]
    # Binomial: 95 % of 200 leaves fewer than 179 inside with a probability of 4e-4, 92 % fewer than 171 with 2e-4.
    assert sum(hits) >= (171 if (kind, commands) == ("unequal", 5) else 179)


@pytest.mark.slow
def test_the_verdict_of_a_calibration_covers_what_its_matrix_improves_on_fresh_commands() -> None:
    found = [improvement_coverage.whole_way(12, seed) for seed in range(12)]
    # Binomial: 95 % of 12 leaves fewer than 9 inside with a probability of 2e-4.
    assert sum(interval.holds(truth) for interval, truth in found) >= 9


def runs_of(commands: Sequence[str | None], sessions: Sequence[str | None] | None = None) -> list[Trajectory]:
    """Runs of one second with a pose at its end, of the commands given."""
    sessions = sessions or ["s"] * len(commands)
    times, poses = np.array([1.0]), np.zeros((2, 3))
    return [
        Trajectory(str(index), "train", times, np.zeros((1, 3)), np.array([0.0, 1.0]), poses, command, session=session)
        for index, (command, session) in enumerate(zip(commands, sessions, strict=True))
    ]


def scores_of_a_mean(values: Array, runs: Sequence[Trajectory]) -> Scores:
    """Scores of the mean (n,) of values (Z, n): the minimiser of sum_i |x_i - m|^2 / 2Z."""
    count, size = values.shape
    hessians = np.tile(np.eye(size) / count, (count, 1, 1))
    return Scores((values.mean(axis=0) - values) / count, hessians, runs, np.zeros(size), hessians)


VALUES = np.random.default_rng(3).standard_normal((12, 2)) @ np.array([[1.0, 0.5], [0.0, 2.0]])


def test_without_repetitions_a_mean_has_the_sample_covariance_over_the_number_of_runs() -> None:
    found = sandwich(scores_of_a_mean(VALUES, runs_of([None] * 12)))
    np.testing.assert_allclose(found.covariance, np.cov(VALUES.T) / 12, rtol=1e-12)
    np.testing.assert_allclose(found.effective_freedom, 11.0)
    assert not found.lack_of_fit


def test_with_repetitions_a_mean_has_the_scatter_within_its_commands_alone() -> None:
    apart = VALUES + np.repeat([[0.0, 0.0], [50.0, 0.0], [0.0, 90.0]], 4, axis=0)
    found = sandwich(scores_of_a_mean(apart, runs_of(["a"] * 4 + ["b"] * 4 + ["c"] * 4)))
    within = sum(4 * np.cov(VALUES[first : first + 4].T) for first in (0, 4, 8))
    np.testing.assert_allclose(found.covariance, within / 12**2, rtol=1e-12)
    np.testing.assert_allclose(found.effective_freedom, 9.0)
    assert "3 commands are too few" in found.words  # to tell whether they scatter more


@pytest.mark.parametrize(
    ("scatter", "words"), [(0.01, "6 commands"), (0.0, "more than the repetitions, which agree exactly")]
)
def test_commands_that_scatter_more_than_their_repetitions_are_the_clusters(scatter: float, words: str) -> None:
    values = np.repeat([-30.0, -7.0, 2.0, 5.0, 11.0, 19.0], 2)[:, None] + scatter * VALUES[:, :1]
    found = sandwich(scores_of_a_mean(values, runs_of([name for name in "abcdef" for _ in range(2)])))
    means = values.reshape(6, 2).mean(axis=1)
    np.testing.assert_allclose(found.covariance, [[means.var(ddof=1) / 6]], rtol=1e-9)
    assert found.lack_of_fit
    assert words in found.words


def test_sessions_are_the_clusters_where_they_scatter_most() -> None:
    drift = np.repeat([-9.0, -2.0, 4.0, 7.0], 6)
    values = (drift + 0.01 * np.random.default_rng(1).standard_normal(24))[:, None]
    runs = runs_of(["a", "b", "c"] * 8, [name for name in "stuv" for _ in range(6)])
    found = sandwich(scores_of_a_mean(values, runs))
    np.testing.assert_allclose(found.covariance, [[values.reshape(4, 6).mean(axis=1).var(ddof=1) / 4]], rtol=1e-9)
    assert "4 sessions" in found.words


def test_clusters_that_may_scatter_more_count_for_the_interval_and_are_no_lack_of_fit() -> None:
    """Six means of two: their F ratio of 12 has a chance of 0.4 %."""
    values = (np.repeat([-2.0, -1.0, 0.0, 0.0, 1.0, 2.0], 2) + np.tile([0.58, -0.58], 6))[:, None]
    found = sandwich(scores_of_a_mean(values, runs_of([name for name in "abcdef" for _ in range(2)])))
    np.testing.assert_allclose(found.covariance, [[2.0 / 6]], rtol=1e-9)
    assert (found.clustered, found.lack_of_fit) == (True, False)
    assert found.effective_freedom == pytest.approx([5.0])


def test_in_no_direction_clusters_make_the_covariance_smaller_than_repetitions_do() -> None:
    """Commands scatter along x and repetitions along y: the one is taken from commands, the other from repetitions."""
    centres = np.array([-30.0, -7.0, 2.0, 5.0, 11.0, 19.0])
    values = np.column_stack([np.repeat(centres, 2), np.tile([3.0, -3.0], 6)]) + 0.01 * VALUES
    commands = [name for name in "abcdef" for _ in range(2)]
    covariance = sandwich(scores_of_a_mean(values, runs_of(commands))).covariance
    within = sum(2 * np.cov(values[first : first + 2].T) for first in range(0, 12, 2)) / 12**2
    assert np.linalg.eigvalsh(covariance - within).min() > -1e-9
    np.testing.assert_allclose(np.diag(covariance), [centres.var(ddof=1) / 6, within[1, 1]], rtol=1e-2)


def test_a_direction_in_which_the_cost_is_flat_has_no_variance() -> None:
    flat = np.array([[1.0, 1.0], [1.0, 1.0]]) / 12
    scores = (VALUES[:, :1].mean() - VALUES[:, :1]) * np.array([[1.0, 1.0]]) / 12
    hessians = np.tile(flat, (12, 1, 1))
    found = sandwich(Scores(scores, hessians, runs_of([None] * 12), np.zeros(2), hessians))
    difference = np.array([1.0, -1.0])
    assert difference @ found.covariance @ difference == pytest.approx(0.0, abs=1e-15)
    total = np.array([1.0, 1.0])
    assert total @ found.covariance @ total == pytest.approx(VALUES[:, 0].var(ddof=1) / 12)


def test_commands_repeated_unequally_have_the_degrees_of_freedom_of_welch_and_satterthwaite() -> None:
    """Groups of 2 and 6 runs with weights 2/8 and 6/8: 1 / (0.25^2 / 1 + 0.75^2 / 5)."""
    found = sandwich(scores_of_a_mean(VALUES[:8, :1], runs_of(["a"] * 2 + ["b"] * 6)))
    assert found.effective_freedom == pytest.approx([1 / (0.25**2 + 0.75**2 / 5)])


def test_a_line_with_one_far_point_has_the_degrees_of_freedom_of_bell_and_mccaffrey() -> None:
    """From the residual maker I - X (X'X)^-1 X' of a line through five points, as Imbens and Kolesar write it."""
    columns = np.column_stack([np.ones(5), [0.0, 1.0, 2.0, 3.0, 9.0]])
    inverse = np.linalg.inv(columns.T @ columns)
    values = np.array([0.3, -0.2, 0.5, 0.1, -0.4])
    maker = np.eye(5) - columns @ inverse @ columns.T
    scores = -columns * (maker @ values)[:, None]
    hessians = np.einsum("zi,zj->zij", columns, columns)
    found = sandwich(Scores(scores, hessians, runs_of([None] * 5), np.zeros(2), hessians))
    corrected = (maker @ values) / np.sqrt(np.diag(maker))
    weights = inverse @ columns.T
    np.testing.assert_allclose(np.diag(found.covariance), np.square(weights) @ np.square(corrected), rtol=1e-9)
    for number in range(2):
        shares = weights[number] / np.sqrt(np.diag(maker))
        spread = np.outer(shares, shares) * maker
        freedom = np.trace(spread) ** 2 / np.square(spread).sum()
        assert found.effective_freedom[number] == pytest.approx(max(freedom, 1.0))
    assert found.effective_freedom.max() < 3


def fitted(columns: Sequence[Array], values: Sequence[Array], commands: Sequence[str | None]) -> tuple[Array, Scores]:
    """The least-squares estimate (n,) of runs with columns (k, n) and values (k,), and its scores."""
    hessians = np.array([of_run.T @ of_run for of_run in columns])
    answer = np.linalg.solve(hessians.sum(axis=0), sum(a.T @ b for a, b in zip(columns, values, strict=True)))
    scores = np.array([a.T @ (a @ answer - b) for a, b in zip(columns, values, strict=True)])
    return answer, Scores(scores, hessians, runs_of(commands), np.zeros(len(answer)), hessians)


@pytest.mark.parametrize("commands", [[None] * 8, ["turn", *"aabbccd"]])
@pytest.mark.parametrize("weak", [0.0, 0.05])
def test_a_direction_of_one_run_alone_has_the_variance_of_noise(commands: Sequence[str | None], weak: float) -> None:
    """Unit noise: the mean of the stated variances is that of least squares, with and without a bounded correction."""
    rng = np.random.default_rng(7)
    columns = [np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])] + [np.array([[1.0, 0.0], [1.0, weak]])] * 7
    stated, hits = [], []
    for _ in range(600):
        answer, scores = fitted(columns, [rng.standard_normal(len(of_run)) for of_run in columns], commands)
        found = sandwich(scores)
        stated.append(np.diag(found.covariance))
        hits.append(np.abs(answer) < EstimatedCovariance(found.covariance, found.effective_freedom).reach)
    truth = np.diag(np.linalg.inv(scores.hessians.sum(axis=0)))
    np.testing.assert_allclose(np.mean(stated, axis=0), truth, rtol=0.08)
    assert (np.mean(hits, axis=0) > 0.93).all()
    assert found.effective_freedom.max() <= 7.0
    assert "directions that one run alone determines" in found.words


WITHOUT_SCATTER = [
    (fitted([np.eye(2)[:1], np.eye(2)[1:]], [np.ones(1), np.ones(1)], [None, None])[1], "one run alone"),
    (scores_of_a_mean(np.repeat([1.0, 2.0, 6.0], 2)[:, None], runs_of([*"aabbcc"])), "repetitions agree exactly"),
    (scores_of_a_mean(np.random.default_rng(0).standard_normal((2, 6)), runs_of([None] * 2)), r"too few \(2\)"),
]


@pytest.mark.parametrize(
    ("scores", "reason"), WITHOUT_SCATTER, ids=["one run a direction", "exact repetitions", "two runs"]
)
def test_runs_that_cannot_scatter_have_no_covariance(scores: Scores, reason: str) -> None:
    with pytest.raises(DataError, match=reason):
        sandwich(scores)


def scores_of_norms(cost: str, errors: Array, jacobian: Array) -> Scores:
    """Scores of a cost of final poses with known errors (Z, 3) and derivatives (Z, 3, n)."""
    runs = runs_of([None] * len(errors))
    odometry = OdometryBatch([run.final_log for run in runs], "arc")
    objective = costs.create(cost)
    return scores_of_runs(objective, odometry, errors, jacobian, runs, Noise(pose_position=0.1, pose_heading=0.1))


def test_the_scores_are_the_gradient_and_the_hessians_the_curvature_of_the_norms() -> None:
    rng = np.random.default_rng(2)
    errors, jacobian = rng.standard_normal((7, 3)) + 2.0, rng.standard_normal((7, 3, 2))
    found = scores_of_norms("final_pose", errors, jacobian)
    smooth = np.median(np.linalg.norm(errors, axis=1)) * 7**-0.5

    def share(run: int, numbers: Array) -> float:
        return float(np.hypot(np.linalg.norm(errors[run] + jacobian[run] @ numbers), smooth)) / 7

    step = 1e-4 * np.eye(2)
    for run in range(7):
        gradient = [(share(run, one) - share(run, -one)) / 2e-4 for one in step]
        np.testing.assert_allclose(found.scores[run], gradient, rtol=1e-6)
        curvature = [
            [(share(run, a + b) - share(run, a - b) - share(run, b - a) + share(run, -a - b)) / 4e-8 for a in step]
            for b in step
        ]
        np.testing.assert_allclose(found.hessians[run], curvature, rtol=1e-4, atol=1e-6)


def test_the_hessian_of_headings_alone_is_twice_the_density_of_their_errors_at_zero() -> None:
    """For normal errors of unit variance the median of n has the variance 1 / (4 n f(0)^2) = pi / 2n."""
    count = 4_001
    errors = np.zeros((count, 3))
    errors[:, 2] = np.random.default_rng(5).standard_normal(count)
    errors[:, 2] -= np.median(errors[:, 2])
    jacobian = np.zeros((count, 3, 1))
    jacobian[:, 2] = 1.0
    found = scores_of_norms("final_heading", errors, jacobian)
    assert found.hessians.sum() == pytest.approx(2 / np.sqrt(2 * np.pi), rel=0.05)
    assert sandwich(found).covariance[0, 0] == pytest.approx(np.pi / 2 / count, rel=0.1)


def test_commands_that_scatter_as_their_repetitions_do_are_seldom_taken_for_a_lack_of_fit() -> None:
    """Planes through five commands of unequal leverage: two are left over, and the level of the test is 0.1 %."""
    rng = np.random.default_rng(11)
    commands = [name for name in "abcde" for _ in range(3)]
    misfits = 0
    for _ in range(400):
        columns = np.repeat(rng.standard_normal((5, 3)), 3, axis=0)
        values = rng.standard_normal(15)
        left = values - columns @ np.linalg.lstsq(columns, values)[0]
        hessians = np.einsum("zi,zj->zij", columns, columns)
        misfits += sandwich(
            Scores(-columns * left[:, None], hessians, runs_of(commands), np.zeros(3), hessians)
        ).lack_of_fit
    assert misfits <= 4


def test_poses_that_the_answer_passes_through_do_not_make_the_cost_sharper_and_may_not_be_half() -> None:
    rng = np.random.default_rng(4)
    errors, jacobian = rng.standard_normal((9, 3)), rng.standard_normal((9, 3, 2))
    errors[:2] = 1e-13
    found = scores_of_norms("final_pose", errors, jacobian)
    width = np.median(np.linalg.norm(errors[2:], axis=1)) * 9**-0.5
    np.testing.assert_allclose(found.hessians[0], jacobian[0].T @ jacobian[0] / width / 9, rtol=1e-6)
    errors[:5] = 0.0
    with pytest.raises(DataError, match="half of the poses"):
        scores_of_norms("final_pose", errors, jacobian)
