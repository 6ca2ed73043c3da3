"""Recordings of a real chain, blind sets, and effects in other forms than the textbook's do not mislead discover."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chain_study import config_of, false_names
from discovery_samples import COUPLING, simulated
from hidden.disturbances import PLAIN
from hidden.experiment import DESIGNS, ROBOT, SAMPLE, plan, true_matrix
from hidden.judging import Judgement, judge
from hidden.motion import Correction, Grid
from hidden.sets import LEVELS, Kind, make_set, recorded

from omnibench.data.dataset import Dataset, make_dataset
from omnibench.discover.discover import discover_effects
from omnibench.robot.calibration import read_calibration, write_calibration
from omnibench.simulate.source import simulate_dataset

FEW: dict[str, Any] = {
    "commands": {"speeds": [0.2], "directions_deg": [0, 120, 240], "turn_rates": [-0.35, 0.0, 0.35]},
    "repetitions": 2,
}


def of_chain(variant: str) -> Dataset:
    return simulate_dataset(config_of(variant, 5, **FEW), variant).dataset


@pytest.mark.slow
def test_no_effect_is_named_that_the_simulated_robot_does_not_have() -> None:
    found = discover_effects(of_chain("coarse"))
    assert not false_names(found)
    assert {effect.stage for effect in found.effects} <= {"actuator"}
    assert all(place.stage == "actuator" or place.within_ticks for place in found.left if place.p_value < 0.002)


@pytest.mark.slow
def test_a_late_lidar_is_named_as_the_offset_of_the_reference() -> None:
    found = discover_effects(of_chain("latency"))
    assert not false_names(found)
    (offset,) = [effect for effect in found.effects if effect.name == "reference_time_offset"]
    assert offset.weight > 0.95
    assert offset.parameters[0].value == pytest.approx(0.03, abs=0.002)


@pytest.mark.slow
def test_rounding_to_ticks_is_told_apart_from_an_effect_many_times_as_large() -> None:
    made = simulated(COUPLING)
    tick, period = 2 * np.pi / 3200, made.sample_period
    runs = []
    for run in made.trajectories:
        angles = tick * np.floor(np.vstack([np.zeros(3), np.cumsum(run.rates, axis=0) * period]) / tick)
        runs.append(replace(run, rates=np.diff(angles, axis=0) / period, angles=angles[1:]))
    found = discover_effects(make_dataset("ticks", made.robot, period, runs, simulated=True))
    assert [effect.name for effect in found.effects] == ["rotation_translation_coupling"]


STRONG, MEDIUM = LEVELS["strong"], LEVELS["medium"]


def judged(
    kind: Kind,
    *effects: str,
    level: float = STRONG,
    design: str = "small",
    noise: str = "plain",
    without: Sequence[str] = (),
) -> Judgement:
    dataset, truth = make_set(kind, effects, level, 1000, design=design, noise=noise)
    return judge(discover_effects(dataset, without=without), truth, seconds=0.0)


@pytest.mark.slow
def test_a_strong_effect_gets_its_name_and_no_other_and_its_size() -> None:
    found = judged("single", "thermal_radius_drift")
    assert (found.outcome, found.confident_wrong) == ("right", False)
    assert found.parameter_error < 0.2


@pytest.mark.slow
def test_a_strong_effect_between_sessions_gets_its_name_and_no_other() -> None:
    found = judged("single", "tyre_wear", design="small_sessions")
    assert (found.outcome, found.confident_wrong) == ("right", False)


@pytest.mark.slow
def test_a_medium_effect_gets_its_name_or_its_class() -> None:
    found = judged("single", "body_velocity_bias", level=MEDIUM)
    assert found.outcome in ("right", "class")
    assert not found.confident_wrong


@pytest.mark.slow
def test_where_nothing_or_a_nuisance_is_hidden_nothing_is_named() -> None:
    for found in (judged("null", level=0.0, noise="mixed"), judged("nuisance", "reference_clock_drift")):
        assert found.outcome in ("none", "unknown")


@pytest.mark.slow
def test_two_strong_effects_both_get_their_names() -> None:
    assert judged("pair", "thermal_radius_drift", "wheel_eccentricity").both_right


@pytest.mark.slow
def test_what_no_catalogue_has_is_unknown_and_its_place_is_found() -> None:
    found = judged("outside", "belt")
    assert (found.verdict, found.where_right, found.confident_wrong) == ("unknown", True, False)


@pytest.mark.slow
def test_without_the_true_name_no_other_is_stated_with_confidence() -> None:
    found = judged("single", "floor_drift", without=["floor_drift"])
    assert not [name for name in found.names if name.wrong or name.weight >= 0.95]


def lagging_behind(limit: float) -> Dataset:
    """60 + 60 runs of a robot that falls behind while it accelerates. limit: where its slip saturates, m/s2."""
    rng = np.random.default_rng(12)
    runs, matrix = plan(DESIGNS["small"], rng), true_matrix(rng)
    grid = Grid(runs, matrix)
    size = np.linalg.norm(grid.acceleration, axis=1, keepdims=True)
    slip = -0.8 * grid.acceleration / (1 + size / limit)
    correction = Correction(body=np.column_stack([slip, np.zeros(len(slip))]))
    return make_dataset("lagging", ROBOT, SAMPLE, recorded(grid, correction, PLAIN, rng), simulated=True)


@pytest.mark.slow
def test_a_slip_that_saturates_has_the_name_of_its_family_and_its_member_is_held_by_the_model(tmp_path: Path) -> None:
    found = discover_effects(lagging_behind(0.15))
    (effect,) = found.effects
    assert effect.name == "acceleration_slip"
    assert effect.weight > 0.95
    assert effect.form.startswith("0.")
    write_calibration(found.extended, tmp_path / "model.yaml")
    (term,) = (each for each in read_calibration(tmp_path / "model.yaml").effects if each.name == effect.name)
    assert {"k", "k:acceleration:1", "acceleration:high"} <= set(term.parameters)
