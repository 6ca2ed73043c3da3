"""Fine structure between poses, on sets of the exam that no catalogue has a name for: found, and in the right place."""

from __future__ import annotations

import numpy as np
import pytest
from discovery_samples import APR02, plain_fit, shorn, simulated
from hidden.sets import make_set

from omnibench.discover.fitting import Fit, paths_of
from omnibench.discover.regressors.fine_structure import fine_structure
from omnibench.discover.regressors.significance import Significance

CHANCE = 0.002


def found_in(fit: Fit) -> Significance:
    found = fine_structure(fit, np.random.default_rng(0))
    assert found is not None
    return found


def found_beside(kind: str, seed: int) -> Significance:
    """Fine structure that the plain matrix leaves in 180 runs with something of a non-centrality of 300."""
    dataset, _ = make_set("outside", kind, 300.0, seed)
    return found_in(plain_fit(dataset))


@pytest.mark.parametrize(
    ("kind", "covariate", "term"),
    [
        ("heading_harmonic", "heading", "smooth_heading_wave"),
        pytest.param("swinging_heading", "elapsed time", "smooth_time_wave", marks=pytest.mark.slow),
        pytest.param("slow_wave", "order of runs", "smooth_session_wave", marks=pytest.mark.slow),
    ],
)
def test_what_happens_within_a_turn_a_run_or_a_session_is_seen_over_it(kind: str, covariate: str, term: str) -> None:
    found = found_beside(kind, 1031)
    basis = found.groups[found.best].basis
    assert basis is not None
    assert (basis.covariate, basis.term) == (covariate, term)
    assert found.p_value(found.best) < CHANCE


@pytest.mark.slow
def test_joints_that_knock_the_robot_round_are_seen_in_the_direction_in_which_they_lie() -> None:
    found = found_beside("tiles", 1022)  # whose joints lie at 84.7 deg
    joints = [index for index, group in enumerate(found.groups) if group.basis and group.basis.term == "smooth_joint"]
    best = max(joints, key=lambda index: found.evidence[index])
    basis = found.groups[best].basis
    assert basis is not None
    assert found.p_value(best) < CHANCE
    assert np.degrees(basis.shapes["normal"]) == pytest.approx(84.7, abs=4)
    assert "turn the robot" in basis.detail


@pytest.mark.slow
def test_a_belt_is_seen_at_the_number_of_times_that_it_turns_with_its_wheel() -> None:
    found = found_beside("belt", 1030)  # which turns half as often
    basis = found.groups[found.best].basis
    assert basis is not None
    assert basis.term == "smooth_wheel_angle"
    assert basis.shapes["harmonic"] == pytest.approx(0.5, abs=0.01)
    assert found.p_value(found.best) < CHANCE


def test_without_absolute_angles_of_the_wheels_none_of_their_waves_are_looked_for() -> None:
    dataset = shorn(simulated(), angles=None)
    groups = found_in(plain_fit(dataset)).groups
    assert not any(group.name == "wheel angle" for group in groups)


@pytest.mark.parametrize(
    "commands", [pytest.param(3, marks=pytest.mark.slow), 6, pytest.param(12, marks=pytest.mark.slow)]
)
def test_where_nothing_is_missing_no_fine_structure_is_surer_than_chance_however_few_runs(commands: int) -> None:
    dataset, _ = make_set("null", "", 0.0, 1003, design="small")
    kept = sorted({run.command or "" for run in dataset.trajectories})[:commands]
    found = found_in(plain_fit(dataset, [run for run in dataset.split("train") if run.command in kept]))
    assert found.p_value(found.best) > CHANCE


def test_few_runs_have_no_fine_structure() -> None:
    dataset = simulated()
    assert fine_structure(plain_fit(dataset, dataset.split("train")[:14]), np.random.default_rng(0)) is None


def test_a_wave_scores_as_its_slopes_do_where_the_tracked_point_is_off_the_robots_centre() -> None:
    dataset = simulated(robot=APR02 | {"mount": {"x": 0.2, "y": -0.1, "yaw": 0.3}})
    fit = plain_fit(dataset)
    found, paths = found_in(fit), paths_of(fit, 0.0)
    number = next(row for row, group in enumerate(found.groups) if group.name == "heading")  # once a turn
    heading = paths.middle[:, 2]
    shares = np.column_stack([np.cos(heading), np.sin(heading)])
    shares -= shares.mean(axis=0)
    slopes = np.concatenate([paths.respond(changes, shares) for changes in paths.by_modes.values()], axis=2)
    gradient = fit.weighted_residuals
    scores = np.array([np.einsum("ka,kaj->j", of_run, slopes[part]) for of_run, part in
                       zip(gradient, paths.parts, strict=True)])  # fmt: skip
    square = scores.sum(axis=0) @ np.linalg.solve(scores.T @ scores, scores.sum(axis=0))
    assert found.chi_square[number] == pytest.approx(square / (1 - square / len(scores)), rel=0.1)
