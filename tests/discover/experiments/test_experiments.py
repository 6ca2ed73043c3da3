"""Experiments that are proposed where effects look alike: what they drive, and that they tell the effects apart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from discovery_samples import DEAD_ZONE, Effects, look_alike, simulated
from wheeled_samples import DIFF, SWERVE, TRICYCLE, driven

from omnibench.data.splits import joined
from omnibench.discover.discover import discover_effects
from omnibench.discover.experiments import Choice, candidate_runs, description_of
from omnibench.discover.fitting import Fit, fit_matrix
from omnibench.fit.trajectory_fit import usable_runs
from omnibench.registry import effects
from omnibench.robot.kinematics import Robot
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset
from omnibench.simulate.source import read_simulation

CREEP: Effects = ({"name": "coulomb_creep", "parameters": {"c": 0.022}},)


def fit_of(robot: Robot) -> Fit:
    """The plain matrix fitted to runs of a robot."""
    runs = usable_runs(driven(robot).split("train"))
    return fit_matrix(runs, robot, 0.1, robot.inverse_kinematic_matrix)


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


@pytest.mark.parametrize("truth", [DEAD_ZONE, CREEP], ids=lambda truth: truth[0]["name"])
def test_whichever_of_the_look_alikes_is_right_is_named_after_the_proposed_runs(truth: Effects, tmp_path: Path) -> None:
    config = proposed(tmp_path).model_dump() | {"truth": {"published": "palacin2023_eq8", "effects": list(truth)}}
    runs = simulate_dataset(FlowerConfig.model_validate(config), "proposed").dataset
    found = discover_effects(joined(simulated(truth, validation=None), [runs]))
    assert found.effects[0].name == truth[0]["name"]
    assert found.effects[0].weight >= 0.95


@pytest.mark.parametrize("robot", [DIFF, TRICYCLE, SWERVE], ids=lambda robot: robot.name)
def test_candidates_are_no_faster_and_steer_no_farther_than_what_was_recorded(robot: Robot) -> None:
    fit = steered_half(fit_of(robot))
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
    fit = fit_of(DIFF)
    headings = {
        name: {candidate.run.start[2] for candidate in candidate_runs(fit, [effects.create(name)])}
        for name in ("heading_drift", "floor_drift")
    }
    assert len(headings["heading_drift"]) == 1
    assert len(headings["floor_drift"]) == 4


def test_steering_is_turned_within_a_run_where_its_play_is_in_doubt() -> None:
    fit = fit_of(TRICYCLE)
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
