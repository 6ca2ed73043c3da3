"""The sandwich covariance of estimates whose covariance is known by hand: means, medians and lines through points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.information import EstimatedCovariance
from omnibench.fit.sandwich import Scores, sandwich, scores_of_runs
from omnibench.registry import costs
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch


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
    apart = VALUES + np.repeat([[0.0, 0.0], [50.0, 0.0], [0.0, 90.0]], 4, axis=0)  # three clusters are too few to count
    found = sandwich(scores_of_a_mean(apart, runs_of(["a"] * 4 + ["b"] * 4 + ["c"] * 4)))
    within = sum(4 * np.cov(VALUES[first : first + 4].T) for first in (0, 4, 8))
    np.testing.assert_allclose(found.covariance, within / 12**2, rtol=1e-12)
    np.testing.assert_allclose(found.effective_freedom, 9.0)


def test_commands_that_scatter_more_than_their_repetitions_are_the_clusters() -> None:
    centres = np.array([-30.0, -7.0, 2.0, 5.0, 11.0, 19.0])
    values = np.repeat(centres, 2)[:, None] + 0.01 * VALUES[:, :1]
    found = sandwich(scores_of_a_mean(values, runs_of([name for name in "abcdef" for _ in range(2)])))
    means = values.reshape(6, 2).mean(axis=1)
    np.testing.assert_allclose(found.covariance, [[means.var(ddof=1) / 6]], rtol=1e-9)
    assert found.lack_of_fit
    assert "the scatter between 6 commands" in found.words


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
def test_a_direction_that_one_run_alone_determines_has_the_variance_of_the_noise(
    commands: Sequence[str | None], weak: float
) -> None:
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


def test_runs_that_each_determine_a_direction_alone_do_not_scatter() -> None:
    _, scores = fitted([np.eye(2)[:1], np.eye(2)[1:]], [np.ones(1), np.ones(1)], [None, None])
    with pytest.raises(DataError, match="every direction is determined by one run alone"):
        sandwich(scores)


def test_commands_scatter_more_than_repetitions_that_agree_exactly() -> None:
    values = np.repeat([-30.0, -7.0, 2.0, 5.0, 11.0, 19.0], 2)[:, None]
    found = sandwich(scores_of_a_mean(values, runs_of([name for name in "abcdef" for _ in range(2)])))
    np.testing.assert_allclose(found.covariance, [[values[::2].var(ddof=1) / 6]], rtol=1e-9)
    assert "6 commands, more than the repetitions, which agree exactly" in found.words
    assert found.lack_of_fit


def test_repetitions_of_few_commands_that_agree_exactly_do_not_scatter() -> None:
    with pytest.raises(DataError, match="the repetitions agree exactly"):
        sandwich(scores_of_a_mean(np.repeat([1.0, 2.0, 6.0], 2)[:, None], runs_of([*"aabbcc"])))


def test_too_few_commands_to_tell_whether_they_scatter_are_named() -> None:
    found = sandwich(scores_of_a_mean(VALUES, runs_of(["a"] * 4 + ["b"] * 4 + ["c"] * 4)))
    assert found.words.endswith("; 3 commands are too few to tell whether they scatter more")


def test_as_many_numbers_as_the_runs_can_hold_have_no_scatter() -> None:
    with pytest.raises(DataError, match=r"runs are too few \(2\) for the scatter of 6 fitted numbers"):
        sandwich(scores_of_a_mean(np.random.default_rng(0).standard_normal((2, 6)), runs_of([None] * 2)))


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


def test_poses_that_the_answer_passes_through_do_not_make_the_cost_sharper() -> None:
    rng = np.random.default_rng(4)
    errors, jacobian = rng.standard_normal((9, 3)), rng.standard_normal((9, 3, 2))
    errors[:2] = 1e-13
    found = scores_of_norms("final_pose", errors, jacobian)
    width = np.median(np.linalg.norm(errors[2:], axis=1)) * 9**-0.5
    np.testing.assert_allclose(found.hessians[0], jacobian[0].T @ jacobian[0] / width / 9, rtol=1e-6)


def test_an_answer_that_passes_through_half_of_the_poses_has_no_scatter() -> None:
    errors = np.vstack([np.zeros((3, 3)), np.ones((2, 3))])
    with pytest.raises(DataError, match="passes exactly through half of the poses"):
        scores_of_norms("final_pose", errors, np.ones((5, 3, 2)))
