"""Jackknife over clusters: what the clusters are, and the covariance by one Gauss-Newton step a cluster."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from fit_samples import make_problem, noisy_trajectories
from hypothesis import given
from hypothesis import strategies as st
from motions import FLOWER, driven

from omnibench.fit.calibrator import run_calibrator
from omnibench.fit.intervals import Clusters, jackknife
from omnibench.fit.uncertainty import sum_of_norms, uncertainty_of
from omnibench.registry import calibrators, costs
from omnibench.robot.kinematics import Array


def clusters_of(keys: Sequence[tuple[str | None, str | None]]) -> Clusters:
    """Clusters of runs with these sessions and commands."""
    (run, *_) = noisy_trajectories()
    return Clusters.of(
        [replace(run, id=str(n), session=session, command=command) for n, (session, command) in enumerate(keys)]
    )


def test_three_sessions_are_the_clusters() -> None:
    found = clusters_of([(name, "go") for name in "aabcb"])
    assert (found.name, found.of_run.tolist()) == ("session", [0, 0, 1, 2, 1])
    assert found.words == "jackknife over 3 sessions"


def test_commands_that_sessions_share_are_clusters_beside_them_and_it_is_said() -> None:
    found = clusters_of([(session, command) for session in "abc" for command in ("go", "turn")])
    assert found.across is not None
    assert (found.across.name, found.across.of_run.tolist()) == ("command", [0, 1, 0, 1, 0, 1])
    assert found.words == "jackknife over 3 sessions and 2 commands"
    nested = clusters_of([(session, session + command) for session in "abc" for command in ("go", "go", "turn")])
    assert nested.across is None


@pytest.mark.parametrize("sizes", [(1.0, 0.0), (0.0, 1.0), (1.0, 1.0)], ids=["sessions", "commands", "both"])
def test_an_interval_holds_what_sessions_and_commands_shift_alike_in_all_their_runs(sizes: tuple[float, float]) -> None:
    """The mean of 4 sessions of 6 commands, each driven twice; every session, command and run is off by chance."""
    rng, keys = np.random.default_rng(1), [(s, c) for s in "abcd" for c in "012345" for _ in range(2)]
    clusters = clusters_of(keys)
    of_session, of_command = (
        np.array([names.index(key[which]) for key in keys]) for which, names in enumerate(("abcd", "012345"))
    )
    held = []
    for _ in range(1000):
        values = sizes[0] * rng.standard_normal(4)[of_session] + sizes[1] * rng.standard_normal(6)[of_command]
        values = values + 0.5 * rng.standard_normal(len(keys))
        scores = (values.mean() - values)[:, None]
        held.append(abs(values.mean()) <= jackknife(np.ones((len(keys), 1, 1)), scores, clusters).reach[0])
    assert 0.93 <= np.mean(held) <= 0.99


def test_commands_are_the_clusters_where_runs_repeat_some_and_sessions_are_two() -> None:
    found = clusters_of([("a", "go"), ("a", "turn"), ("b", "go"), ("b", None)])
    assert (found.name, found.of_run.tolist()) == ("command", [0, 1, 0, 2])
    assert found.words == "jackknife over 3 commands, of two sessions alone"


def test_runs_are_the_clusters_where_no_command_is_repeated() -> None:
    found = clusters_of([("a", "go"), ("a", "turn"), ("a", None)])
    assert (found.name, found.count) == ("run", 3)
    assert found.words == "jackknife over 3 runs, of one session alone"


def test_a_single_run_has_the_curvature_and_it_is_said() -> None:
    found = clusters_of([(None, None)])
    assert found.words == "curvature of a single run, of one session alone"
    information = np.array([[4.0, 1.0], [1.0, 9.0]])
    answer = jackknife(information[None], np.zeros((1, 2)), found)
    np.testing.assert_allclose(answer.matrix, np.linalg.inv(information))


def each_alone(count: int) -> Clusters:
    return Clusters("run", np.arange(count))


def least_squares(columns: Array, values: Array) -> Array:
    answer: Array = np.linalg.lstsq(columns.reshape(-1, columns.shape[-1]), values.ravel())[0]
    return answer


@given(seed=st.integers(0, 10**6), count=st.integers(3, 9), size=st.integers(1, 3))
def test_of_linear_least_squares_it_is_the_scatter_of_refits_without_each_cluster(
    seed: int, count: int, size: int
) -> None:
    rng = np.random.default_rng(seed)
    columns, values = rng.standard_normal((count, 8, size)), rng.standard_normal((count, 8))
    best = least_squares(columns, values)
    information = np.einsum("cri,crj->cij", columns, columns)
    scores = np.einsum("cri,cr->ci", columns, columns @ best - values)
    others = [np.arange(count) != left_out for left_out in range(count)]
    moved = np.array([least_squares(columns[kept], values[kept]) - best for kept in others])
    expected = (count - 1) / count * moved.T @ moved
    found = jackknife(information, scores, each_alone(count))
    np.testing.assert_allclose(found.matrix, expected, rtol=1e-6, atol=1e-12)


@given(seed=st.integers(0, 10**6), count=st.integers(3, 9), size=st.integers(1, 3))
def test_degrees_of_freedom_are_those_of_the_scatter_of_equal_independent_errors(
    seed: int, count: int, size: int
) -> None:
    """The refits are linear in the errors, so that their covariance M is known, and (tr M)^2 / tr M^2 with it."""
    rng = np.random.default_rng(seed)
    columns = rng.standard_normal((count, 8, size)) * rng.uniform(0.3, 1.0, (count, 1, 1))
    of_all, moved = np.linalg.pinv(columns.reshape(-1, size)), np.zeros((count, size, count * 8))
    for left_out in range(count):
        kept = np.repeat(np.arange(count) != left_out, 8)
        moved[left_out, :, kept] = np.linalg.pinv(columns.reshape(-1, size)[kept]).T
        moved[left_out] -= of_all
    wanted = []
    for of_number in np.swapaxes(moved, 0, 1):
        covariance = of_number @ of_number.T
        wanted.append(np.trace(covariance) ** 2 / np.trace(covariance @ covariance))
    information = np.einsum("cri,crj->cij", columns, columns)
    values = rng.standard_normal((count, 8))
    scores = np.einsum("cri,cr->ci", columns, columns @ least_squares(columns, values) - values)
    found = jackknife(information, scores, each_alone(count))
    np.testing.assert_allclose(found.degrees_of_freedom, np.clip(wanted, 1, count - 1), rtol=1e-6)


def test_a_prior_adds_its_own_part_and_has_no_scatter() -> None:
    information, scores = np.full((4, 1, 1), 2.0), np.array([[0.5], [-0.5], [0.25], [-0.25]])
    found = jackknife(information, scores, each_alone(4), np.array([[8.0]]))
    moved = scores[:, 0] / (16.0 - 2.0)
    of_scatter = 3 / 4 * np.square(moved).sum()
    assert found.matrix[0, 0] == pytest.approx(of_scatter + 8.0 / 16.0**2)
    # M of four equal clusters is 2 / 14^2 (1 - 2/16 (1 + 8/16)) on its diagonal, less the rest elsewhere
    alike = 2.0 * np.eye(4) - 4.0 * (1 / 16 + 8 / 16**2)
    freedom = np.trace(alike) ** 2 / np.trace(alike @ alike)
    # Satterthwaite: the exact part adds no variance to that of the variance
    assert found.degrees_of_freedom[0] == pytest.approx(min(freedom, 3) * (found.matrix[0, 0] / of_scatter) ** 2)


def test_what_neither_runs_nor_prior_tell_has_no_variance() -> None:
    information = np.zeros((3, 2, 2))
    information[:, 0, 0] = 1.0
    found = jackknife(information, np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 0.0]]), each_alone(3))
    np.testing.assert_allclose(found.matrix[1], 0.0)
    assert found.matrix[0, 0] > 0


def test_a_direction_that_one_cluster_carries_takes_the_curvature_by_the_scatter_of_the_others() -> None:
    information = np.zeros((5, 2, 2))
    information[:, 0, 0], information[0, 1, 1] = 1.0, 4.0
    scores = np.column_stack([[1.0, -0.5, 0.25, -0.25, -0.5], np.zeros(5)])
    found = jackknife(information, scores, each_alone(5)).matrix
    of_first = 4 / 5 * np.square(scores[:, 0] / 4).sum()
    assert found[0, 0] == pytest.approx(of_first)
    assert found[1, 1] == pytest.approx(of_first / (1 / 5) / 4)  # times the same ratio to the curvature's


def test_one_step_a_cluster_agrees_with_refits_of_a_calibration_without_it() -> None:
    runs = driven(FLOWER, repetitions=1, noise=0.005)
    problem = make_problem(runs, cost="trajectory", loss="huber")

    def solved(some: list) -> Array:
        chosen = problem if some is runs else make_problem(some, cost="trajectory", loss="huber")
        return run_calibrator(calibrators.create("closed_form"), chosen).vector

    best = solved(runs)
    moved = np.array([solved([each for each in runs if each is not left_out]) - best for left_out in runs])
    expected = np.sqrt((len(runs) - 1) / len(runs) * np.square(moved).sum(axis=0))
    result = run_calibrator(calibrators.create("closed_form"), problem)
    stated = uncertainty_of(problem, result).standard_deviations.ravel()
    np.testing.assert_allclose(stated / expected, 1.0, atol=0.25)


# The slopes and Hessians of a sum of norms.


def test_the_slopes_are_the_gradient_and_the_hessians_the_curvature_of_the_smoothed_norms() -> None:
    rng = np.random.default_rng(2)
    errors, jacobian = rng.standard_normal((7, 3)) + 2.0, rng.standard_normal((7, 3, 2))
    slopes, hessians = sum_of_norms(costs.create("final_pose"), np.arange(7), errors, jacobian)
    smooth = np.median(np.linalg.norm(errors, axis=1)) * 7**-0.5

    def share(run: int, numbers: Array) -> float:
        return float(np.hypot(np.linalg.norm(errors[run] + jacobian[run] @ numbers), smooth)) / 7

    step = 1e-4 * np.eye(2)
    for run in range(7):
        gradient = [(share(run, one) - share(run, -one)) / 2e-4 for one in step]
        np.testing.assert_allclose(slopes[run], gradient, rtol=1e-6)
        curvature = [
            [(share(run, a + b) - share(run, a - b) - share(run, b - a) + share(run, -a - b)) / 4e-8 for a in step]
            for b in step
        ]
        np.testing.assert_allclose(hessians[run], curvature, rtol=1e-4, atol=1e-6)


def test_a_median_of_headings_has_its_variance_by_the_density_of_their_errors() -> None:
    """For normal errors of unit variance the median of n has the variance 1 / (4 n f(0)^2) = pi / 2n."""
    count = 4_001
    errors = np.zeros((count, 3))
    errors[:, 2] = np.random.default_rng(5).standard_normal(count)
    errors[:, 2] -= np.median(errors[:, 2])
    jacobian = np.zeros((count, 3, 1))
    jacobian[:, 2] = 1.0
    slopes, hessians = sum_of_norms(costs.create("final_heading"), np.arange(count), errors, jacobian)
    assert jackknife(hessians, slopes, each_alone(count)).matrix[0, 0] == pytest.approx(np.pi / 2 / count, rel=0.1)
