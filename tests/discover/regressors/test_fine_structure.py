"""Fine structure between poses, on the catalogue-free sets of the exam: found, and in the right place."""

from __future__ import annotations

import numpy as np
import pytest
from hidden.sets import make_set

from omnibench.discover.fitting.extend import fit_matrix
from omnibench.discover.regressors.fine_structure import fine_structure
from omnibench.discover.regressors.significance import Significance
from omnibench.fit.least_squares.usable_runs import usable_runs

CHANCE = 0.002


def found_in(kind: str, level: float, seed: int) -> Significance:
    """Fine structure that the plain matrix leaves in 180 runs. kind: of the sets, or nothing."""
    dataset, _ = make_set("outside" if kind else "null", kind, level, seed)
    runs = usable_runs(dataset.split("train"))
    start = dataset.robot.inverse_kinematic_matrix
    fit = fit_matrix(runs, dataset.robot, dataset.sample_period, start)
    found = fine_structure(fit, np.random.default_rng(seed))
    assert found is not None
    return found


def surest(found: Significance) -> tuple[str, str, float]:
    """Covariate and term of the surest group, and its chance."""
    index = min(range(len(found.groups)), key=found.p_value)
    basis = found.groups[index].basis
    assert basis is not None
    return basis.covariate, basis.term, found.p_value(index)


@pytest.mark.parametrize(
    ("kind", "covariate", "term"),
    [
        ("heading_harmonic", "heading", "smooth_heading_wave"),
        ("swinging_heading", "elapsed time", "smooth_time_wave"),
        ("slow_wave", "order of runs", "smooth_session_wave"),
    ],
)
def test_what_happens_within_a_turn_a_run_or_a_session_is_seen_over_it(kind: str, covariate: str, term: str) -> None:
    place, by, chance = surest(found_in(kind, 300.0, 1031))
    assert (place, by) == (covariate, term)
    assert chance < CHANCE


def test_joints_that_knock_the_robot_round_are_seen_in_the_direction_in_which_they_lie() -> None:
    found = found_in("tiles", 300.0, 1022)  # whose joints lie at 84.7 deg
    joints = [index for index, group in enumerate(found.groups) if group.basis and group.basis.term == "smooth_joint"]
    best = max(joints, key=lambda index: found.evidence[index])
    basis = found.groups[best].basis
    assert basis is not None
    assert found.p_value(best) < CHANCE
    assert np.degrees(basis.shapes["normal"]) == pytest.approx(84.7, abs=4)
    assert "turn the robot" in basis.detail


def test_where_nothing_is_missing_no_fine_structure_is_surer_than_chance() -> None:
    found = found_in("", 0.0, 60)
    assert min(found.p_value(index) for index in range(len(found.groups))) > CHANCE
