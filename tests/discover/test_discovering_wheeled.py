"""Discovering hidden effects on robots of every class, and on real ones that steer or drive two wheels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from config_robots import NAMES, settings
from lanes import slow
from real_recordings import diff, tricyc

from omnibench.config import validate
from omnibench.data.dataset import Dataset, make_dataset
from omnibench.discover.discover import discover_effects
from omnibench.discover.report.discovery_report import discovery_report
from omnibench.report.render import render
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import simulate_dataset

WEAVE = {"variation": {"weave": 0.3, "period": 3.0}}
RAMP = {"ramp": 0.5}
_SPARSE = 32  # one of so many reference poses is kept
# A car of which the steering angle and the rate of one rear wheel are known. With both rear wheels their difference
# measures the turn, and little of an offset is left to see.
PLAIN_CAR = [
    {"name": "front", "type": "steered", "driven": False, "radius": 0.1, "x": 0.6, "y": 0.0},
    {"name": "left", "type": "fixed", "radius": 0.1, "x": 0.0, "y": 0.2},
    {"name": "right", "type": "fixed", "radius": 0.1, "x": 0.0, "y": -0.2, "measured": False},
]
# Robot, effect, its parameters, how commands vary, and by how much the first parameter may be off.
HIDDEN: dict[str, tuple[str, str, dict[str, float], dict[str, Any], float]] = {
    "gain of a tricycle": ("tricycle", "steering_gain", {"g": 0.02}, WEAVE, 0.1),
    "play of a tricycle": ("tricycle", "steering_play", {"b": 0.015}, WEAVE, 0.1),
    "lag of a tricycle": ("tricycle", "steering_lag", {"tau": 0.03}, WEAVE, 0.1),
    "coupling of a tricycle": ("tricycle", "steering_coupling", {"k": 0.08}, WEAVE, 0.1),
    "coupling of a swerve drive": ("swerve", "steering_coupling", {"k": 0.3}, WEAVE, 0.3),
    "offset of a car": ("car", "steering_offset", {"c": 0.02}, {}, 0.25),
    "shift of a skid-steered robot": ("skid", "icr_shift", {"x": 0.04}, {}, 0.1),
    "a light mecanum wheel": ("mecanum", "light_wheel", {"k_fl": 0.03}, RAMP, 0.15),
    "a caster of a differential drive": ("diff", "caster_pull", {"k": 0.02}, {"variation": {"reversals": 1}}, 0.3),
}


def recordings(
    name: str,
    effects: list[dict[str, Any]],
    commands: dict[str, Any],
    validation: dict[str, Any] | None = None,
    seed: int = 1,
) -> Dataset:
    """Noisy recordings of a config's robot, drawn about its design, each command twice."""
    given = settings(name)
    if name == "car" and effects:
        given["robot"] = given["robot"] | {"wheels": PLAIN_CAR}
    changed = given | {
        "commands": given["commands"] | commands,
        "truth": given["truth"] | {"effects": effects},
        "repetitions": 2,
        "train": given["train"] | {"seed": seed},
        "validation": validation,
    }
    return simulate_dataset(validate(FlowerConfig, changed, f"{name}.yaml")).dataset


FIRST, *OTHERS = HIDDEN


@pytest.mark.parametrize("case", [FIRST, *slow(*OTHERS)])
def test_an_effect_of_a_robots_class_is_named_with_its_size(case: str) -> None:
    robot, name, parameters, commands, share = HIDDEN[case]
    found = discover_effects(recordings(robot, [{"name": name, "parameters": parameters}], commands))
    effect = next(each for each in found.effects if each.stage != "actuator")
    assert effect.name == name
    assert effect.weight >= 0.95
    assert found.verdict in ("named", "incomplete")
    ((sought, value),) = parameters.items()
    estimates = {each.name: each.value for each in effect.parameters}
    assert estimates[sought] == pytest.approx(value, rel=share)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NAMES if name != "car"])
def test_nothing_is_named_on_a_robot_of_any_class_where_nothing_is_hidden(name: str) -> None:
    found = discover_effects(recordings(name, [], WEAVE))
    assert (found.verdict, found.effects) == ("none", ())


@pytest.mark.slow
def test_a_car_whose_axles_are_not_square_has_a_steering_offset_or_nothing() -> None:
    found = discover_effects(recordings("car", [], {}))
    assert {each.name for each in found.effects} <= {"steering_offset"}


@pytest.mark.slow
def test_only_effects_that_apply_are_tried_and_absorbed_ones_have_a_measurement() -> None:
    swerve, skid = (discover_effects(recordings(name, [], {})) for name in ("swerve", "skid"))
    tried = [{each.name for each in (*found.hidden, *found.measurements)} for found in (swerve, skid)]
    assert {"steering_coupling", "light_wheel"} <= tried[0]
    assert not {"icr_shift", "steering_offset", "caster_pull", "coulomb_creep", "wheel_position"} & tried[0]
    assert {"icr_shift", "light_wheel"} <= tried[1]
    assert not {"steering_gain", "steering_coupling", "caster_pull", "roller_ripple"} & tried[1]
    assert {"wheel_radius", "driven_steering_offset"} <= set(swerve.absorbed)
    assert {"wheel_radius", "wheel_position"} <= set(skid.absorbed)
    assert all(each.measurement for each in (*swerve.measurements, *skid.measurements))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tricycle", "car"])
def test_the_extended_model_and_the_report_are_made_for_robots_that_steer(name: str) -> None:
    term = [{"name": "steering_play", "parameters": {"b": 0.02}}]
    data = recordings(name, term, WEAVE | {"speeds": [0.5]}, validation={"seed": 2, "distance": 2.0})
    found = discover_effects(data)
    assert [each.name for each in found.extended.effects] == ["steering_play"]
    session = found.held_out[-1]
    assert session.chi2.closed > 0.8
    assert "steering_play" in render(discovery_report(found, ""))


@pytest.mark.slow
@pytest.mark.parametrize("recording", [tricyc, diff], ids=["tricyc", "diff"])
def test_real_recordings_go_through_and_what_is_said_of_them_is_consistent(recording: Callable[[], Dataset]) -> None:
    # Fewer runs and poses, for time; tests/studies/wheeled_discovery.py takes all.
    runs = [
        replace(run, pose_times=run.pose_times[::_SPARSE], poses=run.poses[::_SPARSE])
        for run in recording().trajectories[::5]
    ]
    found = discover_effects(make_dataset("sparse", recording().robot, recording().sample_period, runs))
    assert found.verdict in ("none", "named", "class", "incomplete", "unknown")
    assert {each.split for each in found.dataset.trajectories} == {"train", "validation"}
    assert len(found.held_out) == 2
    for held_out in found.held_out:
        assert np.isfinite([held_out.eq6.before, held_out.eq6.after]).all()
    assert found.effects or found.where
