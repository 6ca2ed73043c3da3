"""Expected separation of competing effects, and the choice of runs that separate them, on columns made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from omnibench.discover.experiments import Members, Separation, choose_runs
from omnibench.discover.selection.evidence import DISCREPANCY, log_evidence
from omnibench.fit.trajectory_fit import Whitened
from omnibench.robot.kinematics import Array

# One column that is fitted in any case, and one for each of three effects, which look alike in the recorded runs.
RECORDED = np.array([[4.0, 1.0, 1.0, 1.0], [1.0, 4.0, 3.99, 3.99], [1.0, 3.99, 4.0, 3.99], [1.0, 3.99, 3.99, 4.0]])
VALUES = np.array([0.5, 9.0, 0.0, 0.0])  # the first effect is right
BOTH = np.array([[True, True], [True, True]])


def separation(effects: int = 2) -> Separation:
    """Effects after recorded runs whose scores are as expected of the first."""
    size = 1 + effects
    information = RECORDED[:size, :size]
    recorded = Whitened((), (), information, (information @ VALUES[:size])[None])
    columns = tuple((1 + number,) for number in range(effects))
    prior = np.array([0.0, *np.full(effects, 1 / 900.0)])
    return Separation(recorded, Members((0,), columns, np.ones(effects), prior, np.zeros((size, 1))))


def run_that_shows(*columns: int, size: int = 3, strength: float = 1.0) -> Array:
    """The information of a run in which only these columns show, each by itself."""
    information = np.zeros((size, size))
    information[list(columns), list(columns)] = strength
    return information


def test_the_chance_of_a_sure_name_is_how_often_noise_lets_it_be_sure() -> None:
    further, rng, sure = 0.3 * run_that_shows(1) + 0.2 * run_that_shows(0, 2), np.random.default_rng(1), []
    chance = separation().prospect(further).chances[0, 1]
    posterior = np.linalg.inv(RECORDED[:2, :2] + np.diag([0.0, 1 / 900.0]))
    known = posterior @ (RECORDED[:2, :2] @ VALUES[:2])
    for _ in range(4000):
        values = np.append(rng.multivariate_normal(known, posterior), 0.0)
        noise = np.sqrt(np.diag(further)) * rng.standard_normal(3)
        scores = RECORDED[:3, :3] @ VALUES[:3] + further @ values
        sure.append(odds(RECORDED[:3, :3] + further, scores, noise) > math.log(19))
    assert chance == pytest.approx(np.mean(sure), abs=0.05)


def odds(information: Array, scores: Array, noise: Array) -> float:
    """Log odds of the first effect against the second. noise: of the scores, larger by the discrepancy."""

    def explained(seen: Array) -> Array:
        of = [
            seen[index] @ np.linalg.solve(information[np.ix_(index, index)], seen[index]) for index in ([0, 1], [0, 2])
        ]
        return np.array(of) - seen[0] ** 2 / information[0, 0]

    tempered = 1 + DISCREPANCY**2 * (explained(scores).max() - 1)
    right, wrong = log_evidence(explained(scores + math.sqrt(tempered) * noise) / tempered, np.ones(2), 0.0)
    return float(right - wrong)


def test_runs_in_which_effects_differ_raise_the_chance_and_others_do_not() -> None:
    apart = separation()
    nothing, alike, different = (
        float(apart.prospect(information).chance(BOTH))
        for information in (np.zeros((3, 3)), 50 * run_that_shows(0), 50 * run_that_shows(1))
    )
    assert nothing < 0.01
    assert alike < 0.05
    assert different > 0.95


def test_the_fewest_seconds_that_suffice_are_driven() -> None:
    candidates = np.array([run_that_shows(0), run_that_shows(1, strength=0.5), run_that_shows(1, strength=0.4)])
    seconds = np.array([5.0, 20.0, 10.0])
    choice = choose_runs(separation(), candidates, seconds, recorded=20.0)
    assert choice.sure.all()
    assert choice.counts[0] == choice.counts[1] == 0
    needed = [number for number in range(2, 60)
              if separation().prospect(number * candidates[2]).chances.min() >= 0.95]  # fmt: skip
    assert choice.counts[2] == needed[0]


def test_a_pair_that_nothing_separates_is_said_and_the_others_are_separated() -> None:
    candidates = np.array([run_that_shows(0, size=4), run_that_shows(3, size=4)])
    choice = choose_runs(separation(3), candidates, np.array([20.0, 20.0]), recorded=20.0)
    assert choice.sure.tolist() == [[True, False, True], [False, True, True], [True, True, True]]
    assert choice.counts[1] >= 2


def test_where_nothing_separates_any_pair_nothing_is_driven() -> None:
    choice = choose_runs(separation(), np.array([run_that_shows(0)]), np.array([20.0]), recorded=20.0)
    assert not choice.counts.any()
