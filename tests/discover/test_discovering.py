"""Discovering hidden effects in small simulations, and the missing one of a real robot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from discovery_samples import COUPLING, lagging, nameless, nothing, repeated, simulated
from page_figures import assert_printed, discovery_figures, plan_lines, printed_plan

from omnibench.data.dataset import Dataset
from omnibench.data.splits import joined
from omnibench.discover.discover import discover_effects
from omnibench.discover.result import Discovery
from omnibench.errors import UnknownNameError
from omnibench.fit.evaluate import evaluate
from omnibench.robot.calibration import read_calibration, write_calibration
from omnibench.simulate.simulation_request import simulate_like
from omnibench.simulate.source import read_simulation


def test_a_hidden_effect_is_named_with_its_parameters() -> None:
    coupling = repeated()
    assert coupling.verdict == "named"
    (effect,) = coupling.effects
    assert effect.name == "rotation_translation_coupling"
    assert effect.weight >= 0.95
    truth = COUPLING[0]["parameters"]
    assert all(each.low < each.value < each.high for each in effect.parameters)
    assert {each.name: each.value for each in effect.parameters} == pytest.approx(truth, rel=0.03)


def test_the_gap_on_the_held_out_session_closes_from_step_to_step() -> None:
    coupling = repeated()
    session = coupling.held_out[-1]
    assert session.data == "session"
    assert session.chi2.closed is not None
    assert session.chi2.closed > 0.9
    first, last = coupling.steps[0], coupling.steps[-1]
    assert (first.held_out, last.held_out) == pytest.approx((session.chi2.before, session.chi2.after), rel=1e-9)
    assert (first.eq6_held_out, last.eq6_held_out) == pytest.approx((session.eq6.before, session.eq6.after), rel=1e-9)


def test_the_extended_calibration_runs_what_was_found(tmp_path: Path) -> None:
    coupling = repeated()
    write_calibration(coupling.extended, tmp_path / "model.yaml")
    model = read_calibration(tmp_path / "model.yaml")
    assert [term.name for term in model.effects] == ["rotation_translation_coupling"]
    cost = {name: evaluate(each, simulated(repetitions=4)).splits["validation"].cost
            for name, each in (("plain", coupling.plain), ("extended", model))}  # fmt: skip
    assert cost["extended"] < 0.7 * cost["plain"]


def test_the_validation_split_changes_nothing_that_is_found() -> None:
    coupling = repeated()
    other = simulated(repetitions=4, validation={"seed": 77, "distance": 0.6, "noise_scale": 5.0})
    again = discover_effects(other)
    assert [(each.name, each.parameters) for each in again.effects] == [
        (each.name, each.parameters) for each in coupling.effects
    ]
    assert (again.extended.matrix, again.where) == (coupling.extended.matrix, coupling.where)


def test_nothing_is_named_where_nothing_is_hidden_and_limits_are_told() -> None:
    found = nothing()
    assert (found.verdict, found.effects) == ("none", ())
    assert {"heading_drift", "wheel_eccentricity"} <= {each.name for each in found.hidden}
    assert all(each.limit > 0 for each in found.hidden)


def test_neither_euler_steps_nor_arcs_are_taken_for_centripetal_slip() -> None:
    for integration in ("euler", "arc"):
        found = discover_effects(simulated((), validation=None, integration=integration, sample_period=0.01))
        assert "centripetal_slip" not in [effect.name for effect in found.effects if effect.weight >= 0.95]


def test_absorbed_effects_are_listed_and_not_named() -> None:
    lever = ({"name": "lidar_lever_arm", "parameters": {"x": 0.05, "y": -0.03}},)
    found = discover_effects(simulated(lever, validation=None))
    assert found.effects == ()
    absorbed = {"lidar_lever_arm", "lidar_yaw", "reference_scale", "sample_period_scale"}
    assert absorbed <= set(found.absorbed)
    assert [each.name for each in found.measurements] == list(found.absorbed)


def test_a_name_that_is_left_out_is_not_found_under_another_with_confidence() -> None:
    found = nameless()
    assert found.verdict in ("unknown", "class")
    assert all(effect.weight < 0.95 for effect in found.effects)


def test_an_unknown_name_among_those_to_leave_out_gets_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="heading_drift"):
        discover_effects(simulated(), without=["heading_drif"])


def test_every_stage_that_was_recorded_is_looked_at() -> None:
    found = lagging()
    assert [(effect.name, effect.stage) for effect in found.effects] == [("motor_lag", "actuator")]
    (tau,) = found.effects[0].parameters
    assert tau.low < 0.15 < tau.high


@pytest.fixture(scope="module")
def recorded(omni3: Dataset) -> Discovery:
    """What is discovered in circles, and on squares held out."""
    return discover_effects(omni3)


def test_what_a_real_robot_lacks_is_found_on_circles_and_holds_on_squares(recorded: Discovery) -> None:
    assert recorded.verdict in ("named", "class", "incomplete")
    names = {recorded.effects[0].name, *recorded.effects[0].confusable_with}
    assert "wheel_dead_zone" in names
    square = recorded.held_out[-1]
    assert square.position_m[1] <= 0.045
    assert np.degrees(square.heading_rad[1]) <= 1.8


def test_the_readme_and_the_page_on_discover_print_its_figures_and_its_driving_plan(recorded: Discovery) -> None:
    assert_printed("discovery", discovery_figures(recorded))
    assert printed_plan().group() == plan_lines(recorded)


def test_squares_are_told_to_hold_motions_that_circles_had_not(recorded: Discovery) -> None:
    assert recorded.extrapolations
    assert all(each.after_m > recorded.held_out[-1].position_m[1] for each in recorded.extrapolations)
    assert any("turning on the spot" in each.description for each in recorded.extrapolations)


def test_the_runs_that_are_proposed_tell_the_class_apart_together_with_the_recorded_ones(
    recorded: Discovery, omni3: Dataset, tmp_path: Path
) -> None:
    (experiment,) = recorded.experiments
    assert experiment.chance >= 0.95 > experiment.chance_recorded
    (tmp_path / "experiment.yaml").write_text(experiment.config)
    proposed = read_simulation(tmp_path / "experiment.yaml").simulate().dataset
    assert len(proposed.trajectories) == experiment.runs
    circles = replace(omni3, trajectories=omni3.split("train"))
    found = discover_effects(joined(simulate_like(circles, recorded.extended, noise_seed=1), [proposed]))
    assert found.effects[0].name == recorded.effects[0].name
    assert found.effects[0].weight >= 0.95
