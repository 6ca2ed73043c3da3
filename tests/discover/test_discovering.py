"""Discovering hidden effects in small simulations, in odd recordings of them, and the missing one of a real robot."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from config_robots import NAMES, settings
from discovery_samples import COUPLING, DELAY, SMALL, lagging, named, nothing, plain_fit, repeated, shorn, simulated
from lanes import slow
from page_figures import assert_printed, discovery_figures, plan_lines, printed_plan
from real_recordings import diff, tricyc
from recording_samples import in_room

from omnibench.config import validate
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.splits import joined
from omnibench.discover import discover, select
from omnibench.discover.discover import discover_effects
from omnibench.discover.held_out import validation_runs
from omnibench.discover.report.discovery_report import discovery_report
from omnibench.discover.result import Discovery
from omnibench.discover.screening import Screening
from omnibench.discover.select import Selection
from omnibench.errors import DataError, UnknownNameError
from omnibench.fit.evaluate import evaluate
from omnibench.progress import Progress
from omnibench.report.render import render
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import read_simulation, simulate_dataset, simulate_like


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
    assert session.chi2.closed > 0.9
    first, last = coupling.steps[0], coupling.steps[-1]
    assert (first.held_out, last.held_out) == pytest.approx((session.chi2.before, session.chi2.after), rel=1e-9)
    assert (first.eq6_held_out, last.eq6_held_out) == pytest.approx((session.eq6.before, session.eq6.after), rel=1e-9)


@pytest.mark.slow
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


@pytest.mark.slow
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


def test_every_stage_that_was_recorded_is_looked_at() -> None:
    found = lagging()
    assert [(effect.name, effect.stage) for effect in found.effects] == [("motor_lag", "actuator")]
    (tau,) = found.effects[0].parameters
    assert tau.low < 0.15 < tau.high


def test_what_cannot_be_is_refused_in_one_line() -> None:
    with pytest.raises(UnknownNameError, match="heading_drift"):
        discover_effects(simulated(), without=["heading_drif"])
    with pytest.raises(DataError, match="wheels stand"):
        discover_effects(with_runs(simulated(), lambda run: replace(run, rates=0 * run.rates)))
    with pytest.raises(DataError, match="plain"):
        discover_effects(simulated(), calibration=named().extended.model_copy(update={"plain": None}))


@pytest.fixture(scope="module")
def recorded(omni3: Dataset) -> Discovery:
    """What is discovered in circles, and on squares held out."""
    return discover_effects(omni3)


@pytest.mark.slow
def test_what_a_real_robot_lacks_is_found_on_circles_and_holds_on_squares(recorded: Discovery) -> None:
    assert recorded.verdict in ("named", "class", "incomplete")
    names = {recorded.effects[0].name, *recorded.effects[0].confusable_with}
    assert "wheel_dead_zone" in names
    square = recorded.held_out[-1]
    assert square.position_m[1] <= 0.045
    assert np.degrees(square.heading_rad[1]) <= 1.8
    assert recorded.extrapolations
    assert all(each.after_m > square.position_m[1] for each in recorded.extrapolations)
    assert any("turning on the spot" in each.description for each in recorded.extrapolations)


@pytest.mark.slow
def test_the_readme_and_the_page_on_discover_print_its_figures_and_its_driving_plan(recorded: Discovery) -> None:
    assert_printed("discovery", discovery_figures(recorded))
    assert printed_plan().group() == plan_lines(recorded)


@pytest.mark.slow
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


def test_the_six_steps_come_in_order() -> None:
    events: list[Progress] = []
    assert discover_effects(simulated(commands=SMALL), watch=events.append).verdict == "named"
    steps = [
        "fitting the plain matrix",
        "locating what it leaves",
        "proposing effects that these recordings can show",
        "selecting those that explain it",
        "confirming them on runs that were held out",
        "concluding, and choosing what to drive next",
    ]
    assert events == [event for step in steps for event in (Progress(step), Progress(step, result=""))]


@pytest.mark.parametrize(
    ("left_share", "names"),
    [(1.0, ["rotation_translation_coupling"]), pytest.param(0.0, [], marks=pytest.mark.slow)],
    ids=["most", "little"],
)
def test_an_effect_that_was_given_up_is_kept_if_fitted_in_full_it_explains_most_of_what_was_left(
    left_share: float, names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = select.select_effects
    given_up: list[Selection] = []

    def giving_up_at_first(screening: Screening, rng: np.random.Generator) -> Selection:
        selection = usual(screening, rng)
        if given_up:
            return selection
        tentative = selection.chosen
        given_up.append(replace(selection, chosen=(), stand_ins=(), tentative=tentative, left_share=left_share))
        return given_up[0]

    monkeypatch.setattr(select, "select_effects", giving_up_at_first)
    assert [effect.name for effect in discover.discover_effects(simulated(commands=SMALL)).effects] == names


def with_runs(dataset: Dataset, change) -> Dataset:
    return replace(dataset, trajectories=tuple(change(run) for run in dataset.trajectories))


def turned(run: Trajectory, angle: float) -> Trajectory:
    """The run as a start heading that is off by an angle would report it."""
    poses, (x, y) = run.poses.copy(), (run.poses[1:, :2] - run.poses[0, :2]).T
    poses[1:, 0] = poses[0, 0] + np.cos(angle) * x - np.sin(angle) * y
    poses[1:, 1] = poses[0, 1] + np.sin(angle) * x + np.cos(angle) * y
    poses[1:, 2] += angle
    return replace(run, poses=poses)


@pytest.mark.slow
def test_start_headings_that_scatter_are_not_taken_for_clocks_and_hide_no_delay() -> None:
    rng = np.random.default_rng(6)
    dataset = with_runs(simulated(DELAY, repetitions=4, validation=None), lambda run: turned(run, rng.normal(0, 0.03)))
    heading, offset, slope = plain_fit(dataset).nuisances.deviations
    assert 0.02 < heading < 0.04
    assert offset < 0.01
    assert slope < 0.005
    assert [effect.name for effect in discover_effects(dataset).effects] == ["reference_time_offset"]


@pytest.mark.slow
def test_without_repetitions_no_gap_is_said_to_be_closed() -> None:
    found = discover_effects(shorn(simulated(), command=None))
    assert [effect.name for effect in found.effects] == ["rotation_translation_coupling"]
    assert all(gap.closed is None for each in found.held_out for gap in (each.eq6, each.chi2))
    assert any("Without repetitions" in note for note in found.notes)


@pytest.mark.slow
def test_results_do_not_depend_on_where_and_in_which_heading_runs_start() -> None:
    rng = np.random.default_rng(7)

    def moved(run: Trajectory) -> Trajectory:
        angle, shift = rng.uniform(-np.pi, np.pi), rng.uniform(-2, 2, 2)
        return replace(run, poses=in_room(np.array([*shift, angle]), run.poses))

    found = repeated()
    elsewhere = discover_effects(with_runs(simulated(repetitions=4), moved))
    assert elsewhere.noise.noise.model_dump() == pytest.approx(found.noise.noise.model_dump(), rel=1e-3, abs=1e-6)
    assert elsewhere.gap.floor == pytest.approx(found.gap.floor, rel=1e-3)
    ours, theirs = ([each.value for each in own.effects[0].parameters] for own in (found, elsewhere))
    assert theirs == pytest.approx(ours, rel=1e-3)


@pytest.mark.slow
def test_errors_are_those_that_evaluate_finds() -> None:
    rng = np.random.default_rng(8)
    dataset = with_runs(simulated(), lambda run: turned(run, rng.normal(0, 0.02)))
    found = discover_effects(dataset)
    model = found.extended.model
    finals = [run.final_pose - model.reported([run.final_log])[0][-1] for run in dataset.split("validation")]
    assert found.held_out[-1].eq6.after == pytest.approx(float(np.mean(np.linalg.norm(finals, axis=1))), rel=1e-6)
    assert found.extended.provenance.validation_cost == pytest.approx(found.held_out[-1].eq6.after, rel=1e-6)
    assert evaluate(found.extended, dataset).held_out.runs == tuple(run.id for run in dataset.split("validation"))


@pytest.mark.slow
def test_a_warm_up_that_ends_is_not_carried_on_without_a_warning() -> None:
    drift = ({"name": "thermal_radius_drift", "parameters": {"k": 2e-5}},)
    dataset = simulated(drift, repetitions=6)
    late = with_runs(
        dataset, lambda run: replace(run, started_at=run.started_at + 20_000) if run.split == "validation" else run
    )
    found = discover_effects(late)
    assert [effect.name for effect in found.effects] == ["thermal_radius_drift"]
    assert "Beware" in found.headline
    assert any("not known to hold" in note for note in found.notes)


@pytest.mark.slow
def test_final_poses_alone_are_enough_to_look_at() -> None:
    def ends(run: Trajectory) -> Trajectory:
        return replace(run, pose_times=run.pose_times[[0, -1]], poses=run.poses[[0, -1]])

    found = discover_effects(with_runs(simulated(validation=None), ends))
    assert [effect.name for effect in found.effects] == ["rotation_translation_coupling"]


@pytest.mark.slow
def test_validation_runs_that_lack_what_an_effect_needs_are_left_out() -> None:
    wheel = ({"name": "wheel_eccentricity", "parameters": {"a_a": 0.03, "b_b": -0.03}},)
    dataset = simulated(wheel)
    found = discover_effects(
        with_runs(dataset, lambda run: replace(run, angles=None) if run.split == "validation" else run)
    )
    assert [effect.name for effect in found.effects] == ["wheel_eccentricity"]
    assert [each.data for each in found.held_out] == ["repetitions"]
    assert any("left out" in note for note in found.notes)


@pytest.mark.slow
def test_targets_that_were_never_filled_switch_off_the_motors_only() -> None:
    found = discover_effects(with_runs(simulated(validation=None), lambda run: replace(run, targets=0 * run.rates)))
    assert [effect.stage for effect in found.effects] == ["body"]


def thrown_at_the_end() -> Dataset:
    """A recording whose reference jumps by 0.3 m at the end of every ninth run."""
    dataset = simulated((), repetitions=4)
    runs = []
    for number, run in enumerate(dataset.trajectories):
        poses = run.poses.copy()
        poses[-1, 0] += 0.3 * (number % 9 == 0)
        runs.append(replace(run, poses=poses))
    return replace(dataset, trajectories=tuple(runs))


def test_errors_before_are_what_evaluate_says_of_the_plain_calibration_outliers_or_not() -> None:
    dataset = thrown_at_the_end()
    discovery = discover_effects(dataset, unknown_term=False)
    evaluation = evaluate(discovery.plain, dataset)
    assert discovery.outliers >= 8
    assert discovery.steps[0].eq6_train == pytest.approx(evaluation.splits["train"].cost, rel=1e-9)
    repetitions, session = discovery.held_out
    errors = evaluation.splits["validation"]
    assert session.eq6.before == pytest.approx(errors.cost, rel=1e-9)
    assert session.position_m[0] == pytest.approx(errors.position_mean_m, rel=1e-9)
    assert session.heading_rad[0] == pytest.approx(errors.heading_mean_rad, rel=1e-9)
    # Cross-validated: a little more than of the fit to all runs.
    assert repetitions.eq6.before == pytest.approx(evaluation.splits["train"].cost, rel=0.03)
    assert np.isfinite(repetitions.chi2.before)


def test_validation_runs_that_all_stand_are_left_out_with_a_warning() -> None:
    dataset = simulated(())
    standing = with_runs(dataset, lambda run: replace(run, rates=0 * run.rates) if run.split == "validation" else run)
    validation = validation_runs(standing, plain_fit(dataset))
    assert validation.runs == ()
    assert validation.warnings == (
        "the wheels stand in all runs of the split validation; drive some, or check the columns omega_*; "
        "nothing is compared on it.",
    )


# Discovering hidden effects on robots of every class, and on real ones that steer or drive two wheels.

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
