"""Experiments that tell look-alikes apart, and how well they do."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from discovery_samples import DEAD_ZONE, Effects, look_alike, plain_fit, simulated
from wheeled_samples import DIFF, SWERVE, TRICYCLE, driven

from omnibench.data.splits import joined
from omnibench.discover.discover import discover_effects
from omnibench.discover.experiments import Choice, Members, Separation, candidate_runs, choose_runs, description_of
from omnibench.discover.fitting import Fit
from omnibench.discover.selection.evidence import DISCREPANCY, log_evidence
from omnibench.fit.trajectory_fit import Whitened
from omnibench.registry import effects
from omnibench.robot.kinematics import Array, Robot
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset
from omnibench.simulate.source import read_simulation

CREEP: Effects = ({"name": "coulomb_creep", "parameters": {"c": 0.022}},)


def proposed(folder: Path) -> FlowerConfig:
    """The config of the experiment that is proposed for the look-alikes."""
    (experiment,) = look_alike().experiments
    (folder / "experiment.yaml").write_text(experiment.config)
    source = read_simulation(folder / "experiment.yaml").config
    assert isinstance(source, FlowerConfig)
    return source


def test_a_proposal_says_what_to_drive_how_long_and_what_it_tells() -> None:
    found = look_alike()
    assert found.verdict == "class"
    (experiment,) = found.experiments
    assert set(experiment.separates) == {"wheel_dead_zone", "coulomb_creep"}
    assert experiment.runs == sum(each.runs for each in experiment.commands) > 1
    driving = sum(each.runs * (each.seconds + 15) for each in experiment.commands) / 60
    assert experiment.minutes == pytest.approx(driving)
    assert experiment.minutes < 10
    assert experiment.chance >= 0.95
    assert experiment.chance_recorded < 0.2
    assert f"Drive {experiment.runs} runs, {experiment.minutes:.1f} minutes" in experiment.description


@pytest.mark.parametrize(
    "truth", [CREEP, pytest.param(DEAD_ZONE, marks=pytest.mark.slow)], ids=lambda truth: truth[0]["name"]
)
def test_whichever_of_the_look_alikes_is_right_is_named_after_the_proposed_runs(truth: Effects, tmp_path: Path) -> None:
    config = proposed(tmp_path).model_dump() | {"truth": {"published": "palacin2023_eq8", "effects": list(truth)}}
    runs = simulate_dataset(FlowerConfig.model_validate(config), "proposed").dataset
    found = discover_effects(joined(simulated(truth, validation=None), [runs]))
    assert found.effects[0].name == truth[0]["name"]
    assert found.effects[0].weight >= 0.95


@pytest.mark.parametrize("robot", [DIFF, TRICYCLE, SWERVE], ids=lambda robot: robot.name)
def test_candidates_are_no_faster_and_steer_no_farther_than_what_was_recorded(robot: Robot) -> None:
    fit = steered_half(plain_fit(driven(robot)))
    candidates = candidate_runs(fit, [effects.create("heading_drift")])
    assert len({candidate.timed.command.speed for candidate in candidates}) > 2
    assert any(candidate.timed.command.turn_rate for candidate in candidates)
    for quantity in ("rates", "steering"):
        done, asked = (
            [np.abs(values).max() for run in runs if (values := getattr(run, quantity)) is not None and values.size]
            for runs in (fit.runs, [candidate.run for candidate in candidates])
        )
        assert not asked or max(asked) <= max(done) * 1.0001


def steered_half(fit: Fit) -> Fit:
    """The fit at runs that were steered half as far."""
    runs = (run if run.steering is None else replace(run, steering=run.steering / 2) for run in fit.runs)
    return replace(fit, runs=tuple(runs))


def test_headings_matter_only_to_effects_that_depend_on_them() -> None:
    fit = plain_fit(driven(DIFF))
    headings = {
        name: {candidate.run.start[2] for candidate in candidate_runs(fit, [effects.create(name)])}
        for name in ("heading_drift", "floor_drift")
    }
    assert len(headings["heading_drift"]) == 1
    assert len(headings["floor_drift"]) == 4


def test_steering_is_turned_within_a_run_where_its_play_is_in_doubt() -> None:
    fit = plain_fit(driven(TRICYCLE))
    steady, weaving = (
        candidate_runs(fit, [effects.create(name)])[0].run.steering for name in ("heading_drift", "steering_play")
    )
    assert steady is not None
    assert weaving is not None
    assert np.ptp(steady) == 0 < np.ptp(weaving)


def test_effects_that_nothing_tells_apart_are_listed_with_all_that_each_looks_like() -> None:
    choice = Choice(np.array([1]), 0.6, 0.0, np.eye(3, dtype=bool))
    said = description_of("abc", 1, 0.5, choice, [("a", "b"), ("a", "c"), ("b", "c")])
    assert said.endswith("surely tells a from b or c; nor b from c.")


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
