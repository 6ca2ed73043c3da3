"""The flower benchmark and hidden effects: what is simulated, how noisy, and that its truth stays hidden."""

import math
import re
from collections.abc import Mapping
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from commands import refused
from config_robots import NAMES, QUIET, apr02, apr02_settings, experiment, robot, settings
from driven_path import DrivenPath
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from sample_robots import APR_02, DIFFERENTIAL, SWERVE, TRICYCLE, fixed, make_robot

from omnibench.data.dataset import Dataset, Split, Trajectory
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError, OmnibenchError
from omnibench.fit.evaluate import ModelErrors, final_errors
from omnibench.progress import Progress
from omnibench.robot.calibration import EffectTerm
from omnibench.robot.kinematics import Array, Mount, Robot, moved_to, published_matrix, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.simulate import mechanics
from omnibench.simulate.commands import Command, Variation
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.robot_simulator import commanded_rates, true_steering
from omnibench.simulate.source import simulate_dataset
from omnibench.simulate.truth import Simulation, true_matrix


def small(**changes: Any) -> FlowerConfig:
    """A few short runs, in one session."""
    commands = {"speeds": [0.2], "directions_deg": [0, 120, 240], "turn_rates": [-0.35, 0.0, 0.35]}
    given = {"commands": commands, "repetitions": 2, "train": {"seed": 1, "distance": 0.3}, "validation": None}
    return apr02(**(given | changes))


@cache
def benchmark() -> Simulation:
    return simulate_dataset(apr02())


def noise_of(repetitions: int, **noise: float) -> tuple[list[Array], Dataset]:
    """The noise (K, 3) of every run's poses, by comparison with the same runs without noise."""
    session = {"seed": 1, "distance": 1.2}
    noisy, quiet = (
        simulate_dataset(small(noise=QUIET | levels, repetitions=repetitions, train=session)).dataset
        for levels in (noise, {})
    )
    return [a.poses - b.poses for a, b in zip(noisy.trajectories, quiet.trajectories, strict=True)], noisy


@pytest.mark.parametrize("split", ["train", "validation"])
def test_each_session_has_36_commands_five_times_one_after_the_other(split: Split) -> None:
    runs = benchmark().dataset.split(split)
    repetitions: dict[str, list[int]] = {}
    for run in runs:
        repetitions.setdefault(run.command, []).append(run.repetition)
    assert len(repetitions) == 36
    assert all(sorted(numbers) == [1, 2, 3, 4, 5] for numbers in repetitions.values())
    assert {run.session for run in runs} == {split}
    assert runs[0].started_at == 0.0
    for before, after in pairwise(runs):
        assert after.started_at > before.started_at + before.times[-1]


def test_runs_have_samples_at_multiples_of_the_period_and_poses_at_the_start_every_250_ms_and_at_the_end() -> None:
    lengths = {"train": 1.116, "validation": 1.128}
    for run in benchmark().dataset.trajectories:
        assert len(run.times) == round(lengths[run.split] / 0.2 / 0.01)
        np.testing.assert_array_equal(run.times, 0.01 * np.arange(1, len(run.times) + 1))
        assert run.duration == run.times[-1] == run.pose_times[-1]
        assert run.distance == pytest.approx(lengths[run.split], abs=1e-9)
        np.testing.assert_allclose(run.pose_times[:-1], 0.25 * np.arange(len(run.pose_times) - 1), atol=1e-12)
        assert 0 < run.pose_times[-1] - run.pose_times[-2] <= 0.25 + 1e-12
        np.testing.assert_array_equal(run.start, np.zeros(3))
        assert (run.targets == run.targets[0]).all()
        assert (run.rates != run.targets).all()


@pytest.mark.parametrize(("distance", "stamps"), [(0.1, [0, 0.25, 0.5]), (0.04, [0, 0.2]), (0.052, [0, 0.25, 0.26])])
def test_the_last_reference_pose_is_never_doubled(distance: float, stamps: list[float]) -> None:
    dataset = simulate_dataset(small(train={"seed": 1, "distance": distance})).dataset
    for run in dataset.trajectories:
        np.testing.assert_allclose(run.pose_times, stamps, atol=1e-12)


def test_the_order_of_the_runs_is_shuffled_unless_sorted_is_asked_for() -> None:
    given = [command.name for command in small().driven for _ in range(2)]
    orders = {
        order: [run.command for run in simulate_dataset(small(order=order)).dataset.trajectories]
        for order in ("sorted", "shuffled")
    }
    assert orders["sorted"] == given
    assert orders["shuffled"] != given
    assert sorted(map(str, orders["shuffled"])) == sorted(given)


def test_the_data_set_says_that_it_is_simulated_and_has_no_warnings() -> None:
    assert benchmark().dataset.simulated
    assert benchmark().dataset.source == "simulated by omnibench"
    assert benchmark().dataset.warnings == ()


def test_every_run_is_told_of_while_it_is_simulated() -> None:
    told: list[Progress] = []
    count = len(simulate_dataset(small(), watch=told.append).dataset.trajectories)
    assert [(event.done, event.total) for event in told[:-1]] == [(done, count) for done in range(1, count + 1)]
    assert told[-1].over


def test_the_same_config_gives_the_same_bits_on_disk_too(tmp_path: Path) -> None:
    dataset = simulate_dataset(small()).dataset
    assert simulate_dataset(small()).dataset.hash == dataset.hash
    save_dataset(dataset, tmp_path / "flower")
    assert load_dataset(tmp_path / "flower").hash == dataset.hash


def test_the_truth_record_holds_eq_8_and_how_it_was_driven() -> None:
    truth = benchmark().truth
    np.testing.assert_array_equal(truth.matrix, published_matrix("palacin2023_eq8"))
    assert (truth.dataset, truth.integration, truth.noise) == ("flower", "arc", apr02().noise)


@pytest.mark.parametrize("table_format", ["csv", "parquet"])
def test_the_truth_is_nowhere_in_the_files_of_the_data_set(tmp_path: Path, table_format: Any) -> None:
    save_dataset(simulate_dataset(small()).dataset, tmp_path / "flower", table_format)
    elements = np.abs(published_matrix("palacin2023_eq8").ravel())
    digits = [f"{element:.16f}"[2:].lstrip("0")[:7].encode() for element in elements]
    assert digits[0].decode() in repr(float(elements[0]))  # the search would find it
    for file in (tmp_path / "flower").iterdir():
        content = file.read_bytes()
        hidden = [b"eq8", b"published", b"truth", *(digits if file.suffix != ".parquet" else [])]
        assert not [each for each in hidden if each in content], file
        if file.suffix == ".parquet":
            for column in pl.read_parquet(file).select(pl.selectors.float()).iter_columns():
                values = np.abs(column.drop_nulls().to_numpy())
                assert np.abs(values[:, None] - elements).min(initial=1.0) > 1e-9, (file, column.name)


def test_encoder_noise_is_as_strong_as_configured_and_does_not_move_the_robot() -> None:
    noise, dataset = noise_of(5, encoder=0.02)
    errors = np.concatenate([run.rates - run.targets for run in dataset.trajectories])
    assert errors.std() == pytest.approx(0.02, rel=0.02)
    assert abs(errors.mean()) < 0.02 * 5 / math.sqrt(errors.size)
    assert max(np.abs(run).max() for run in noise) == 0.0


# Sizes of position and heading that differ: what one got of the other would show in its deviation.
AXES = ([0, 1], 0.01), ([2], 0.002)


def test_white_noise_is_as_strong_as_configured_and_independent() -> None:
    noise, _ = noise_of(40, pose_position=0.01, pose_heading=0.002)
    runs = np.array([run[1:] for run in noise])
    for columns, size in AXES:
        assert runs[..., columns].std() == pytest.approx(size, rel=0.03)
        neighbours = np.corrcoef(runs[:, :-1, columns].ravel(), runs[:, 1:, columns].ravel())[0, 1]
        assert abs(neighbours) < 0.05


def test_a_random_walk_grows_with_the_root_of_time() -> None:
    noise, dataset = noise_of(40, walk_position=0.01, walk_heading=0.002)
    runs, times = np.array(noise), dataset.trajectories[0].pose_times
    for columns, size in AXES:
        steps = np.diff(runs[..., columns], axis=1) / np.sqrt(np.diff(times))[:, None]
        assert steps.std() == pytest.approx(size, rel=0.03)
        assert runs[:, -1, columns].std() == pytest.approx(size * math.sqrt(times[-1]), rel=0.1)


def test_a_bias_is_the_same_along_a_run_and_another_in_the_next() -> None:
    noise, _ = noise_of(40, bias_position=0.01, bias_heading=0.002)
    runs = np.array(noise)[:, 1:]
    np.testing.assert_allclose(runs, np.broadcast_to(runs[:, :1], runs.shape), atol=1e-12)
    for columns, size in AXES:
        assert runs[:, 0, columns].std() == pytest.approx(size, rel=0.15)


def test_the_noise_scale_of_a_session_multiplies_the_references_noise_only() -> None:
    levels = QUIET | {"encoder": 0.02, "pose_position": 0.01, "walk_heading": 0.01, "bias_position": 0.01}
    quiet, single, double = (
        simulate_dataset(
            small(noise=levels, train={"seed": 1, "distance": 0.3, "noise_scale": scale})
        ).dataset.trajectories
        for scale in (0.0, 1.0, 2.0)
    )
    for none, once, twice in zip(quiet, single, double, strict=True):
        assert np.abs(once.poses[1:, :2] - none.poses[1:, :2]).min() > 0
        np.testing.assert_allclose(twice.poses - none.poses, 2 * (once.poses - none.poses), atol=1e-12)
        np.testing.assert_array_equal(once.rates, twice.rates)


def test_turns_on_the_spot_last_as_long_as_configured() -> None:
    commands = {"speeds": [0.0], "directions_deg": [0, 90], "turn_rates": [-0.5, 0.0, 0.5], "turn_duration": 2.0}
    dataset = simulate_dataset(small(commands=commands)).dataset
    assert {run.command for run in dataset.trajectories} == {"v0_a0_w-0.5", "v0_a0_w0.5"}
    assert {run.times[-1] for run in dataset.trajectories} == {2.0}


LISTED = [
    {"speed": 0.1, "duration": 6.0, "repetitions": 2},
    {"speed": 0.1, "duration": 9.0, "heading_deg": 90},
    {"turn_rate": 0.5, "duration": 4.0, "repetitions": 3},
]


def test_listed_commands_are_driven_as_long_as_often_and_from_where_each_says() -> None:
    given = small(commands={"listed": LISTED, "ramp": 0.3}, noise=QUIET)
    runs = simulate_dataset(given).dataset.trajectories
    driven = sorted((run.command, float(run.times[-1]), round(math.degrees(run.start[2]))) for run in runs)
    assert driven == [*[("v0.1_a0_w0_t6", 6.0, 0)] * 2, ("v0.1_a0_w0_t9_h90", 9.0, 90), *[("v0_a0_w0.5", 4.0, 0)] * 3]
    assert given.runs == len(runs)
    (northward,) = (run for run in runs if run.command == "v0.1_a0_w0_t9_h90")
    assert northward.poses[-1, 1] > 0.8 > 0.1 > abs(northward.poses[-1, 0])


def test_tolerances_draw_a_robot_about_its_design() -> None:
    tolerances = {"radius": 0.02, "distance": 0.03, "angle_deg": 0.5, "seed": 7}
    given = apr02(truth={"tolerances": tolerances})
    truth, design = true_matrix(given.truth, given.robot), given.robot.inverse_kinematic_matrix
    deviation = np.abs(truth - design).max() / np.abs(design).max()
    assert 1e-3 < deviation < 0.2
    other = apr02(truth={"tolerances": {**tolerances, "seed": 8}})
    assert not np.array_equal(true_matrix(other.truth, other.robot), truth)


def commands_with(**changes: Any) -> dict[str, Any]:
    return {"commands": {**apr02_settings()["commands"], **changes}}


PUBLISHED = "palacin2023_eq8"
DRIFTS = [{"name": "heading_drift", "parameters": {"b": 0.1}}] * 2
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "an effect given twice": ({"truth": {"published": PUBLISHED, "effects": DRIFTS}}, "heading_drift"),
    "a ramp longer than a run": (commands_with(ramp=6), "commands.ramp: 6 s"),
    "a ramp longer than a turn": (commands_with(ramp=1.5, speeds=[0.0, 0.2], turn_duration=1.0), "1 s"),
    "a negative ramp": (commands_with(ramp=-1), "commands.ramp: "),
    "an unknown start": ({"start": "anywhere"}, "start: "),
    "an area without size": ({"start": "random", "start_area": 0}, "start"),
    "a misspelt key": ({"repetition": 5}, "'repetitions'"),
    "a misspelt noise": ({"noise": {"pose_positon": 0.1}}, "'pose_position'"),
    "negative noise": ({"noise": {"encoder": -0.1}}, "noise.encoder: "),
    "noise that is NaN": ({"noise": {"walk_heading": math.nan}}, "noise.walk_heading: "),
    "no truth": ({"truth": {}}, "given: none"),
    "two truths": ({"truth": {"published": PUBLISHED, "tolerances": {"radius": 0.1}}}, "given: published, tolerances"),
    "an unknown truth": ({"truth": {"published": "palacin2023_eq7"}}, "'palacin2023_eq"),
    "a truth of another shape": ({"truth": {"matrix": [[1.0, 2.0]] * 3}}, "truth.matrix"),
    "no commands that move": (commands_with(speeds=[0], turn_rates=[0]), "commands: "),
    "neither a grid nor a list": ({"commands": {"speeds": [0.2]}}, "turn_rates"),
    "a listed command that stands": ({"commands": {"listed": [{"duration": 1.0}]}}, "commands.listed.0: "),
    "a ramp longer than a listed run": (
        {"commands": {"listed": [{"speed": 0.1, "duration": 1.0}], "ramp": 0.8}},
        "commands.ramp: 0.8 s",
    ),
    "no directions": (commands_with(directions_deg=[]), "commands.directions_deg: "),
    "a negative speed": (commands_with(speeds=[-0.2]), "commands.speeds.0: "),
    "an infinite rate of turn": (commands_with(turn_rates=[math.inf]), "commands.turn_rates.0: "),
    "no repetitions": ({"repetitions": 0}, "repetitions: "),
    "a period of zero": ({"sample_period": 0}, "sample_period: "),
    "runs shorter than a sample": ({"sample_period": 60}, "one sample"),
    "no seed": ({"train": {"distance": 1.0}}, "'train.seed'"),
    "no training session": ({"train": None}, "train: "),
    "an unknown order": ({"order": "random"}, "order: "),
    "another generator": ({"generator": "spiral"}, "generator: "),
    "a robot without a name": ({"robot": {**apr02_settings()["robot"], "name": ""}}, "name"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_config_that_is_wrong_is_refused_in_one_line(case: str) -> None:
    changes, words = REFUSED[case]
    with refused(ConfigError, words, start="flower.yaml: "):
        apr02(**changes)


@pytest.mark.parametrize("name", NAMES)
def test_without_noise_the_truth_scores_nothing_and_the_design_does_not(name: str) -> None:
    made = simulate_dataset(experiment(name))
    runs, truth = made.dataset.trajectories, OdometryModel(made.dataset.robot, np.array(made.truth.matrix), "arc")
    assert made.dataset.warnings == ()
    # A car's wheels out of place make it turn by what is not quite linear in its signals: 2 to 3 mm over 4 m here.
    assert ModelErrors.of(truth, runs).on(runs).cost < (5e-3 if name == "car" else 1e-9)
    assert ModelErrors.of(OdometryModel.of_design(made.dataset.robot, "arc"), runs).on(runs).cost > 1e-2


def test_robots_that_cannot_go_sideways_drive_forward_and_backward_and_turn_on_the_spot() -> None:
    commands = experiment("diff").driven
    assert {(each.speed, round(math.degrees(each.direction))) for each in commands} == {(0.0, 0), (0.3, 0), (0.3, 180)}
    assert len(commands) == 14
    assert {math.degrees(each.direction) for each in experiment("swerve").driven} == set(range(0, 360, 45))


def test_a_robot_whose_axle_is_not_at_its_centre_turns_about_its_axle() -> None:
    wheels = [wheel | {"x": -0.3} for wheel in robot("diff").model_dump()["wheels"]]
    made = simulate_dataset(experiment("diff", robot={"name": "rear axle", "wheels": wheels}))
    for run in made.dataset.trajectories:
        twist = made.dataset.robot.inverse_kinematic_matrix @ run.targets[0]
        np.testing.assert_allclose(
            twist, [(run.v or 0) * math.cos(run.alpha or 0), 0.3 * run.omega, run.omega], atol=1e-9
        )


@pytest.mark.parametrize("name", ["tricycle", "swerve"])
def test_steering_angles_are_those_of_the_commands_within_a_quarter_turn_and_noisy(name: str) -> None:
    quiet, noisy = (
        simulate_dataset(experiment(name, noise=QUIET | {"steering": noise})).dataset.trajectories
        for noise in (0.0, 0.002)
    )
    for plain, measured in zip(quiet, noisy, strict=True):
        assert measured.steering is not None
        assert np.abs(plain.steering).max() <= math.pi / 2 + 1e-6
        assert (plain.steering == plain.steering[0]).all()
        np.testing.assert_array_equal(measured.poses, plain.poses)
        np.testing.assert_array_equal(true_steering(robot(name), measured), plain.steering)
    errors = np.concatenate([m.steering - p.steering for m, p in zip(noisy, quiet, strict=True)])  # type: ignore[operator]
    assert errors.std() == pytest.approx(0.002, rel=0.05)


def test_an_effect_on_the_steering_angle_hides_in_the_motion_and_not_in_what_is_measured() -> None:
    hidden = [{"name": "driven_steering_offset", "parameters": {"c_front": 0.05}}]
    plain, made = (
        simulate_dataset(experiment("tricycle", truth={"tolerances": {}, "effects": effect})) for effect in ([], hidden)
    )
    model = made.truth.true_robot().model
    for with_effect, without in zip(made.dataset.trajectories, plain.dataset.trajectories, strict=True):
        np.testing.assert_array_equal(with_effect.steering, without.steering)
        (poses,) = model.poses([with_effect.log(with_effect.pose_times)])
        np.testing.assert_allclose(with_effect.poses, poses, atol=1e-9)
        assert np.abs(with_effect.poses - without.poses).max() > 1e-3


def test_an_effect_on_a_cars_wheels_leaves_them_rolling() -> None:
    hidden = [{"name": "wheel_eccentricity", "parameters": {"a_rl": 0.02}}]
    made = simulate_dataset(experiment("car", truth={"tolerances": {}, "effects": hidden}))
    true = made.truth.true_robot()
    assert true.contacts is not None
    for run in made.dataset.trajectories[:4]:
        again = true.log(run.times, run.rates, run.start, run.times, run.angles[0] - run.rates[0] * run.times[0],  # type: ignore[index]
                         run.started_at, run.session, run.steering)  # fmt: skip
        np.testing.assert_allclose(again.rates, run.rates, atol=1e-4)


def test_commands_beyond_the_steering_limit_are_left_out_and_said() -> None:
    commands = {"speeds": [0.0, 0.5], "turn_rates": [0.0, 0.2, 1.0]}
    given = experiment("car", commands=commands)
    assert [each.name for each in given.driven] == ["v0.5_a0_w0", "v0.5_a180_w0", "v0.5_a0_w0.2", "v0.5_a180_w0.2"]
    (warning,) = simulate_dataset(given).dataset.warnings
    assert "4 of 8 commands" in warning
    assert "v0_a0_w0.2" in warning
    sharper = experiment("tricycle", commands=commands, steering_limit_deg=90)
    assert len(sharper.driven) == 8


MANY: dict[str, tuple[str, dict[str, Any], str]] = {
    "a direction aside": ("diff", {"commands": {"directions_deg": [0, 90], "turn_rates": [0]}}, "directions_deg"),
    "commands that are all too sharp": ("car", {"commands": {"speeds": [0.5], "turn_rates": [1.0]}}, "0.473 rad/s"),
    "turns on the spot of a car": ("car", {"commands": {"speeds": [0], "turn_rates": [1.0]}}, "v0_a0_w1"),
    "a steering limit without steering": ("diff", {"steering_limit_deg": 30}, "no wheel of this robot steers"),
    "a matrix of the wheels": ("tricycle", {"truth": {"matrix": [[0.1]] * 3}}, "(front_cos, front_sin)"),
    "a relative distance": ("diff", {"truth": {"tolerances": {"distance": 0.1}}}, "tolerances.distance"),
    "a place of wheels without": ("mecanum", {"truth": {"tolerances": {"position": 0.1}}}, "tolerances.position"),
    "an offset of no steering": ("diff", {"truth": {"tolerances": {"steering_deg": 1}}}, "tolerances.steering_deg"),
    "friction without sliding": ("diff", {"truth": {"tolerances": {}, "lateral_friction": 1}}, "lateral_friction"),
}


@pytest.mark.parametrize("case", MANY)
def test_what_a_robot_cannot_do_is_refused_in_one_line(case: str) -> None:
    name, changes, words = MANY[case]
    with refused(ConfigError, words):
        experiment(name, **changes)


# Effects that are hidden in simulated recordings, ramps and random starts; and what was simulated before stays.


def few(effects: Mapping[str, Mapping[str, float]] | None = None, **changes: Any) -> FlowerConfig:
    """Six short runs without noise, in the order of the commands, by a robot with these effects."""
    hidden = [{"name": name, "parameters": dict(values)} for name, values in (effects or {}).items()]
    commands = {"speeds": [0.2], "directions_deg": [0, 120, 240], "turn_rates": [-0.35, 0.35]}
    plain = {
        "truth": {"published": PUBLISHED, "effects": hidden},
        "commands": commands | changes.pop("commands", {}),
        "repetitions": 1,
        "order": "sorted",
        "noise": QUIET,
        "train": {"seed": 1, "distance": 0.6},
        "validation": None,
    }
    return apr02(**(plain | changes))


def runs(effects: Mapping[str, Mapping[str, float]] | None = None, **changes: Any) -> tuple[Trajectory, ...]:
    return simulate_dataset(few(effects, **changes)).dataset.trajectories


def test_the_benchmark_stays_what_it_was() -> None:
    """Sums over its 360 runs, by the version that drew noise as the published comparisons have it."""
    runs = simulate_dataset(apr02()).dataset.trajectories
    drawn = [sum(float(np.abs(getattr(run, name)).sum()) for run in runs) for name in ("rates", "angles", "poses")]
    # rad/s, rad, m and rad
    assert drawn == pytest.approx([540843.680886297, 18067279.735240657, 11605.562333690346], rel=1e-12)


# Effects


def test_what_motors_lag_behind_is_seen_by_encoders_and_reference() -> None:
    for lagging, plain in zip(runs({"motor_lag": {"tau": 0.2}}), runs(), strict=True):
        missing = (plain.rates - lagging.rates).sum(axis=0) * 0.01
        np.testing.assert_allclose(missing, 0.2 * plain.rates[0], rtol=1e-5)
        turned = published_matrix(PUBLISHED)[2] @ missing
        assert plain.poses[-1, 2] - lagging.poses[-1, 2] == pytest.approx(turned, rel=1e-6)


@pytest.mark.parametrize(
    "effects",
    [
        {"wheel_eccentricity": {"a_a": 0.02, "b_c": -0.01}},
        {"acceleration_slip": {"k": 0.05}, "heading_latency": {"tau": 0.05}},
        {"floor_drift": {"dx": 0.02, "dy": -0.01}, "thermal_radius_drift": {"k": 1e-5}},
        {"start_transient": {"k": 0.2, "length": 0.1}, "lidar_lever_arm": {"x": 0.05, "y": 0.02}},
        {"motor_lag": {"tau": 0.1}, "tyre_wear": {"radius_validation": 0.01}},
        {"heading_drift": {"b": 0.01}, "reference_time_offset": {"tau": 0.1}},
    ],
)
def test_without_noise_the_recording_is_what_the_true_model_reports(effects: dict[str, Any]) -> None:
    shape = {"start": "random", "commands": {"ramp": 0.3}, "validation": {"seed": 2, "distance": 0.5}}
    made = simulate_dataset(few(effects, **shape))
    model = made.truth.true_robot().model
    assert {term.name for term in model.terms} == set(effects)
    found = model.reported([run.reference_log for run in made.dataset.trajectories])
    for run, poses in zip(made.dataset.trajectories, found, strict=True):
        np.testing.assert_allclose(run.poses[1:], poses, atol=1e-12)


def test_encoder_noise_does_not_move_the_wheels_away_from_their_recorded_angles() -> None:
    noisy = {"noise": QUIET | {"encoder": 0.02}, "repetitions": 20}
    errors = []
    for hidden in ({"wheel_eccentricity": {"a_a": 0.02}}, {}):
        made = simulate_dataset(few(hidden, **noisy))
        errors.append(final_errors(made.truth.true_robot().model, made.dataset.trajectories))
    assert np.abs(errors[1]).max() > 1e-3  # what the noise itself does
    assert np.abs(errors[0] - errors[1]).max() < 5e-5


def test_what_is_hidden_is_in_the_truth_with_all_its_parameters_and_not_in_the_data() -> None:
    made = simulate_dataset(few({"wheel_eccentricity": {"a_b": 0.02}}))
    zeros = dict.fromkeys(("a_a", "b_a", "a_b", "b_b", "a_c", "b_c"), 0.0)
    assert made.truth.effects == (EffectTerm(name="wheel_eccentricity", parameters=zeros | {"a_b": 0.02}),)
    said = (made.dataset.name, made.dataset.description, made.dataset.source, *made.dataset.warnings)
    assert not any("eccentric" in text for text in said)


REFUSED_EFFECTS: dict[str, tuple[dict[str, Any], str]] = {
    "an unknown effect": ({"heading_drft": {"b": 0.1}}, "'heading_drift'"),
    "an unknown parameter": ({"heading_drift": {"bb": 0.1}}, "'bb'"),
    "a wheel that is not there": ({"wheel_eccentricity": {"a_d": 0.1}}, "'a_d'"),
    "a session that is not driven": ({"tyre_wear": {"radius_validation": 0.01}}, "'radius_validation'"),
    "no parameter": ({"heading_drift": {}}, "'b' (rad/s)"),
    "no shape": ({"start_transient": {"k": 0.1}}, "'length' (m)"),
    "a shape out of range": ({"start_transient": {"k": 0.1, "length": 99}}, "'length' is 99"),
}


@pytest.mark.parametrize("case", REFUSED_EFFECTS)
def test_an_effect_that_cannot_be_hidden_is_refused_in_one_line(case: str) -> None:
    effects, words = REFUSED_EFFECTS[case]
    with refused(OmnibenchError, match=f"truth.effects: .*{re.escape(words)}"):
        simulate_dataset(few(effects))


# Ramps


def test_wheels_rise_linearly_to_their_speed_take_longer_and_keep_their_way() -> None:
    for run, plain in zip(runs(commands={"ramp": 0.5}), runs(), strict=True):
        full = plain.rates[0]
        np.testing.assert_allclose(run.rates[0], 0.01 * full, rtol=1e-9)  # mean of the first of 50 samples
        np.testing.assert_allclose(run.rates[-1], 0.01 * full, rtol=1e-9)
        np.testing.assert_allclose(run.rates[50:-50], np.tile(full, (len(run.rates) - 100, 1)), rtol=1e-9)
        steps = np.diff(run.rates[:50], axis=0)
        np.testing.assert_allclose(steps, np.tile(steps[0], (49, 1)), rtol=1e-6)
        assert run.times[-1] == pytest.approx(plain.times[-1] + 0.5)
        np.testing.assert_allclose((run.rates * 0.01).sum(axis=0), (plain.rates * 0.01).sum(axis=0), rtol=1e-9)
        assert (run.distance, run.duration) == (pytest.approx(0.6), run.times[-1])


def test_turns_on_the_spot_are_ramped_too() -> None:
    commands = {"speeds": [0.0], "turn_duration": 2.0, "ramp": 1.0}
    for run in runs(commands=commands):
        assert run.times[-1] == pytest.approx(3.0)
        assert abs(run.omega or 0) == 0.35
        heading = published_matrix(PUBLISHED)[2] @ wheel_equations(few().robot.wheels)[:, 2] * (run.omega or 0) * 2
        assert run.poses[-1, 2] == pytest.approx(heading)


@given(st.floats(0.05, 2.0), st.floats(0.5, 5.0), st.lists(st.floats(1e-3, 0.3), min_size=1, max_size=40))
def test_samples_of_any_length_add_up_to_the_same_way(ramp: float, full: float, lengths: list[float]) -> None:
    end = 2 * ramp + full
    times = np.append(np.cumsum(lengths)[np.cumsum(lengths) < end - 1e-3], end)
    robot = few().robot
    command = Command(0.2, 0.3, 0.1)
    rates = commanded_rates(robot, command, times, ramp)
    driven = (rates * np.diff(times, prepend=0.0)[:, None]).sum(axis=0)
    np.testing.assert_allclose(driven, (full + ramp) * wheel_equations(robot.wheels) @ command.twist, rtol=1e-9)


# Random starts


def test_starts_lie_anywhere_in_the_square_with_any_heading() -> None:
    starts = np.array([run.start for run in runs(repetitions=60, start="random", start_area=3.0)])
    assert np.abs(starts[:, :2]).max() <= 1.5
    assert (np.abs(starts[:, :2]).max(axis=0) > 1.4).all()
    assert [starts[:, 2].min(), starts[:, 2].max()] == pytest.approx([-math.pi, math.pi], abs=0.15)


def test_a_run_is_the_same_from_wherever_it_starts() -> None:
    for moved, plain in zip(runs(start="random"), runs(), strict=True):
        np.testing.assert_allclose(moved.poses, moved_to(moved.start, plain.poses), atol=1e-9)


def test_starts_are_those_of_the_seed() -> None:
    again = [simulate_dataset(few(start="random", train={"seed": seed, "distance": 0.6})).dataset for seed in (1, 1, 2)]
    assert again[0].hash == again[1].hash != again[2].hash


def test_a_record_of_the_truth_says_what_it_lacks() -> None:
    truth = simulate_dataset(few()).truth
    broken = truth.model_copy(update={"effects": (EffectTerm(name="heading_drift"),)})
    with pytest.raises(DataError, match=r"data set flower: truth.effects: effect 'heading_drift': parameter 'b'"):
        broken.true_robot()


# True mechanics of steering, casters, grip and wheel contacts: by hand, in data, and near the effects' models.

WEAVE = {"weave": 0.2, "period": 3.0}
# An effect on a robot with a variation of its commands, how small its model's errors are to be, as a share of those of
# the model without it (to first order only, where the mechanics are not linear), and the parameters.
HIDDEN: dict[str, tuple[str, dict[str, Any], float, dict[str, float]]] = {
    "steering_gain": ("tricycle", WEAVE, 1e-6, {"g": 0.05}),
    "steering_play": ("tricycle", WEAVE, 0.5, {"b": 0.015}),
    "steering_lag": ("tricycle", WEAVE, 0.2, {"tau": 0.03}),
    "steering_offset": ("car", WEAVE, 0.1, {"c": 0.02}),
    "steering_coupling": ("swerve", WEAVE | {"weave": 0.6}, 1e-6, {"k": 0.2}),
    "icr_shift": ("skid", {}, 1e-6, {"x": 0.05}),
    "caster_pull": ("diff", {"reversals": 1}, 0.7, {"k": 0.02}),
    "light_wheel": ("mecanum", {}, 0.1, {"k_fl": 0.05}),
}


def recorded(name: str, *effects: dict[str, Any]) -> Simulation:
    """Quiet recordings of a robot as designed but for these effects, by the commands of a case."""
    robot, variation, _, _ = HIDDEN[name]
    commands = settings(robot)["commands"] | {"variation": variation, "ramp": 0.5}
    return simulate_dataset(experiment(robot, commands=commands, truth={"tolerances": {}, "effects": list(effects)}))


@pytest.mark.parametrize("name", HIDDEN)
def test_the_effect_explains_to_first_order_what_the_mechanics_do_and_what_is_measured_tells_nothing(name: str) -> None:
    robot, _, share, parameters = HIDDEN[name]
    made = recorded(name, {"name": name, "parameters": parameters})
    model, runs = made.truth.true_robot().model, made.dataset.trajectories
    plain = ModelErrors.of(OdometryModel(model.robot, model.matrix, "arc"), runs).on(runs).cost
    assert plain > 1e-3
    assert ModelErrors.of(model, runs).on(runs).cost < share * plain
    for one, other in zip(runs, recorded(name).dataset.trajectories, strict=True):
        if robot != "car":  # whose rear wheels turn as they roll
            np.testing.assert_array_equal(one.rates, other.rates)
        np.testing.assert_array_equal(one.steering, other.steering)


def test_mechanics_act_on_a_robot_of_a_given_matrix_as_well() -> None:
    commands = settings("tricycle")["commands"] | {"variation": WEAVE}
    effects = [{"name": "steering_gain", "parameters": {"g": 0.05}}]
    matrix = experiment("tricycle").robot.inverse_kinematic_matrix.tolist()
    by_matrix, by_contacts = (
        simulate_dataset(experiment("tricycle", commands=commands, truth=truth | {"effects": effects})).dataset
        for truth in ({"matrix": matrix}, {"tolerances": {}})
    )
    for one, other in zip(by_matrix.trajectories, by_contacts.trajectories, strict=True):
        np.testing.assert_allclose(one.poses, other.poses, atol=1e-9)


def test_an_effect_of_another_kind_of_robot_is_refused() -> None:
    truth = {"tolerances": {}, "effects": [{"name": "icr_shift", "parameters": {"x": 0.1}}]}
    with pytest.raises(DataError, match=r"truth\.effects: effect 'icr_shift'.*diff"):
        simulate_dataset(experiment("diff", truth=truth))


def of_steering(name: str, ends: list[float], duration: float = 0.1, **values: float) -> Array:
    return mechanics.steering_truth(name, values, np.array(ends)[:, None], np.full(len(ends), duration))[:, 0]


def test_a_flank_of_the_gear_pushes_the_wheel_and_the_other_one_comes_after_the_play() -> None:
    found = of_steering("steering_play", [0.0, 0.05, 0.3, 0.25, 0.1, -0.1, 0.0], b=0.1)
    np.testing.assert_allclose(found, [0.0, 0.0, 0.2, 0.2, 0.2, 0.0, 0.0])


def test_a_wheel_follows_a_ramp_late_by_the_time_constant_and_comes_to_rest_exponentially() -> None:
    ends = [min(0.1 * step, 2.0) for step in range(1, 41)]  # 1 rad/s for 2 s
    found = of_steering("steering_lag", ends, tau=0.2)
    assert found[19] == pytest.approx(2.0 - 0.2 * (1 - math.exp(-1.9 / 0.2)), abs=1e-12)
    assert found[29] == pytest.approx(2.0 - (2.0 - found[19]) * math.exp(-1.0 / 0.2), abs=1e-12)
    early = of_steering("steering_lag", ends, tau=-0.1)
    np.testing.assert_allclose(early[:-1], ends[1:], atol=1e-12)


def test_a_module_turns_its_own_wheel_only() -> None:
    ends = np.array([[0.0, 0.0, 0.0, 0.0], [0.1, 0.0, -0.2, 0.0]])
    found = mechanics.turned_by_steering({"k": 0.5}, SWERVE.wheels, ends, np.array([0.1, 0.1]))
    np.testing.assert_allclose(found, [[0, 0, 0, 0], [0.5, 0, -1.0, 0]])
    alone = mechanics.turned_by_steering({"k": 0.5}, TRICYCLE.wheels, ends[:, :1], np.array([0.1, 0.1]))
    np.testing.assert_allclose(alone, [[0.0], [0.5]])


def test_a_robot_on_a_circle_is_accelerated_towards_its_centre() -> None:
    twists = np.tile([0.5, 0.0, 1.0], (4000, 1))
    values = {f"k_{name}": 0.1 for name in SWERVE.wheel_names}
    steering = np.tile([0.0, math.pi / 2, math.pi, 0.0], (4000, 1))
    lost = mechanics.lost_by_light_wheels(values, SWERVE.wheels, steering, twists, np.full(4000, 0.001))
    np.testing.assert_allclose(lost[-1], [0, 0.1 * 0.5 / 0.05, 0, 0], atol=1e-3)


@hypothesis_settings(max_examples=6)  # each of 2400 steps
@given(turn=st.floats(-1.0, 1.0).filter(lambda turn: abs(turn) > 0.02))
def test_a_caster_hands_on_its_whole_swing_when_the_robot_turns_back(turn: float) -> None:
    ahead, back = np.tile([0.3, 0.0, turn], (400, 1)), np.tile([-0.3, 0.0, turn], (2000, 1))
    twists = np.vstack([ahead, back])
    added = mechanics.body_truth("caster_pull", {"k": 0.01}, DIFFERENTIAL, twists, np.full(2400, 0.005))[:, 2]
    swung = (added[400:] - added[399]).sum() * 0.005
    # From trailing behind one course it goes to trail behind the other, by the side on which the turn lies.
    lag = math.asin(0.05 * turn / math.hypot(0.3, 0.15 * turn))
    whole = math.pi - 2 * abs(math.atan2(0.15 * turn, 0.3))
    assert swung == pytest.approx(-0.01 * math.copysign(whole, turn), abs=0.01 * (2 * abs(lag) + 1e-3))


# Variation


def test_a_weave_swings_the_rate_of_turn_about_the_commands() -> None:
    commands = settings("diff")["commands"] | {"variation": {"weave": 0.3, "period": 2.0}}
    for run in simulate_dataset(experiment("diff", commands=commands)).dataset.trajectories:
        turns = run.rates @ experiment("diff").robot.inverse_kinematic_matrix[2]
        middles = run.times - 0.5 * run.times[0]
        np.testing.assert_allclose(turns, (run.omega or 0) + 0.3 * np.sin(math.pi * middles), atol=1e-12)


def test_the_speed_is_reversed_and_the_turn_goes_on() -> None:
    commands = settings("diff")["commands"] | {"variation": {"reversals": 2}}
    for run in simulate_dataset(experiment("diff", commands=commands)).dataset.trajectories:
        twists = run.rates @ experiment("diff").robot.inverse_kinematic_matrix.T
        ahead = (run.v or 0.0) * math.cos(run.alpha or 0.0)
        third = len(twists) // 3
        for row, sign in ((0, 1), (third + 2, -1), (len(twists) - 1, 1)):
            np.testing.assert_allclose(twists[row], [sign * ahead, 0.0, run.omega or 0.0], atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_without_noise_the_truth_still_scores_nothing(name: str) -> None:
    commands = settings(name)["commands"] | {"variation": {"weave": 0.1, "reversals": 1}}
    made = simulate_dataset(experiment(name, commands=commands, truth={"tolerances": {}}))
    # An angle in the middle of a sample is the mean of those at its ends, which differ where the speed is reversed.
    missed = {"car": 2e-6, "swerve": 2e-3}.get(name, 1e-8)
    runs = made.dataset.trajectories
    assert ModelErrors.of(OdometryModel.of_design(made.dataset.robot, "arc"), runs).on(runs).cost < missed


@pytest.mark.parametrize("name", ["tricycle", "swerve"])
def test_steering_angles_can_be_told_again_from_the_truth(name: str) -> None:
    commands = settings(name)["commands"] | {"variation": {"weave": 0.1, "period": 2.5, "reversals": 1}}
    made = simulate_dataset(experiment(name, commands=commands))
    for run in made.dataset.trajectories:
        np.testing.assert_array_equal(true_steering(made.dataset.robot, run, made.truth.variation), run.steering)


def test_between_reversals_a_module_turns_on_past_a_right_angle() -> None:
    times = 0.02 * np.arange(1, 201)
    _, steering = Variation(weave=1.0).wheels(SWERVE, Command(0.3, math.pi / 2, 0.0), times, ends=True)
    assert np.abs(np.diff(steering, axis=0)).max() < 0.1
    assert np.abs(steering).max() > math.pi / 2


def test_commands_that_weave_beyond_the_steering_limit_are_left_out() -> None:
    commands = {"speeds": [0.5], "turn_rates": [0.0, 0.4], "variation": {"weave": 0.2}}
    given_config = experiment("car", commands=commands)
    assert [each.name for each in given_config.driven] == ["v0.5_a0_w0", "v0.5_a180_w0"]
    (warning,) = given_config.left_out
    assert warning.startswith("2 of 4 commands")
    assert "v0.5_a0_w0.6" in warning
    with pytest.raises(ConfigError, match=r"v0.5_a0_w0.6 .*steering_limit_deg"):
        experiment("car", commands=commands | {"turn_rates": [0.4]})


@pytest.mark.parametrize("wrong", [{"weave": -1}, {"period": 0}, {"reversals": -1}, {"reversals": 0.5}])
def test_a_variation_that_cannot_be_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=r"commands.variation"):
        experiment("diff", commands=settings("diff")["commands"] | {"variation": wrong})


REAR = make_robot(
    "behind its centre, and rolling to its side",
    *(fixed(name, x, -0.3, angle=math.pi / 2) for name, x in (("a", 0.2), ("b", -0.2))),
    mount=Mount(x=0.1, y=-0.05, yaw=0.3),
)
rates_of_wheels = st.floats(-10, 10).filter(lambda rate: abs(rate) > 0.1)


@pytest.mark.parametrize("design", [*map(robot, NAMES), APR_02, REAR], ids=lambda design: design.name)
def test_wheels_as_designed_move_the_robot_by_the_design_matrix(design: Robot) -> None:
    matrix = mechanics.WheelContacts(design, design.wheels, (), design.mount).matrix
    np.testing.assert_allclose(matrix, design.inverse_kinematic_matrix, atol=1e-9)


@given(rates_of_wheels, st.floats(-1.3, 1.3), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_no_wheel_of_a_tricycle_ever_slides(rate: float, angle: float, aside: float, offset: float) -> None:
    design = robot("tricycle")
    front, *rear = design.wheels
    contacts = mechanics.WheelContacts(design, [front.model_copy(update={"y": aside}), *rear], [offset])
    vx, vy, turn = contacts.twists(np.array([[rate]]), np.array([[angle]]))[0]
    assert vy == pytest.approx(0, abs=1e-12)
    over_front = complex(vx - aside * turn, 0.6 * turn)
    assert over_front == pytest.approx(0.1 * rate * complex(math.cos(angle + offset), math.sin(angle + offset)))


@given(st.floats(0.0, 5.0))
def test_lateral_friction_widens_the_track_of_a_skid_steered_robot(friction: float) -> None:
    design = robot("skid")
    rates = np.array([[-1.0, 1.0, -1.0, 1.0]])  # on the spot, at 0.1 m/s on each side
    turn = mechanics.WheelContacts(design, design.wheels, lateral_friction=friction).twists(rates, None)[0, 2]
    assert turn == pytest.approx(0.1 / (0.25 + friction * 0.2**2 / 0.25), rel=1e-8)


@given(st.floats(0.1, 10), st.floats(-0.5, 0.5))
def test_the_axles_of_a_car_meet_in_one_point_and_its_rear_wheels_turn_as_they_roll(rate: float, turned: float) -> None:
    design = robot("car")
    contacts = mechanics.WheelContacts(design, design.wheels)
    signals = np.array([[rate, rate * math.tan(turned), 0.0]])
    rates, steering = design.drive.commands(signals)
    (twist,) = contacts.twists(rates, steering)
    assert twist[2] == pytest.approx(twist[0] * math.tan(turned) / 0.6, abs=1e-12)
    rolling = contacts.rolling_rates(twist[None])[0]
    assert rolling.mean() == pytest.approx(rate)
    assert rolling[1] - rolling[0] == pytest.approx(twist[2] * 0.4 / 0.1, abs=1e-9)


@pytest.mark.parametrize("integration", ["arc", "euler"])
@given(twists=st.lists(st.tuples(*[st.floats(-3, 3)] * 5), min_size=1, max_size=5))
def test_the_true_motion_is_that_of_odometry_on_other_code(integration: str, twists: list[tuple[float, ...]]) -> None:
    moved, drift = np.array(twists)[:, :3], np.array(twists)[:, 3:]
    times = 0.3 * np.arange(1, len(twists) + 1)
    start, stamps = np.array([1.0, -2.0, 0.5]), np.linspace(-0.1, times[-1] + 0.1, 11)
    way = "arc" if integration == "arc" else "euler"
    true = mechanics.TrueMotion(times, start, moved, way, drift).poses(stamps)
    np.testing.assert_allclose(true, DrivenPath(times, start, 0.3 * moved, way, 0.3 * drift).poses(stamps), atol=1e-12)


@given(st.floats(-1e-3, 1e-3))
def test_a_slow_turn_loses_no_digits(turn: float) -> None:
    second = np.array([1.0])
    (pose,) = mechanics.TrueMotion(second, np.zeros(3), np.array([[1.0, 0.0, turn]]), "arc").poses(second)
    assert pose == pytest.approx([1 - turn**2 / 6 + turn**4 / 120, turn / 2 - turn**3 / 24, turn], abs=1e-15, rel=1e-14)
