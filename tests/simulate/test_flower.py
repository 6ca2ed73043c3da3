"""The flower benchmark, also of robots that steer: what is simulated, how noisy, and that its truth stays hidden."""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from commands import refused
from config_robots import NAMES, QUIET, apr02, apr02_settings, experiment, robot

from omnibench.data.dataset import Dataset, Split
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError
from omnibench.fit.evaluate import ModelErrors
from omnibench.progress import Progress
from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter, Values
from omnibench.robot.kinematics import Array, published_matrix
from omnibench.robot.model import OdometryModel
from omnibench.robot.signals import Signals
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.flower import true_steering
from omnibench.simulate.simulate import simulate_dataset
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


def test_the_commands_are_12_directions_with_3_rates_at_one_speed() -> None:
    found = {(round(math.degrees(c.direction)), c.turn_rate, c.speed) for c in apr02().driven}
    assert found == {(30 * i, rate, 0.2) for i in range(12) for rate in (-0.35, 0.0, 0.35)}


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


def test_wheel_angles_are_the_sum_of_the_rates_through_the_whole_session() -> None:
    before = np.zeros(3)
    for run in benchmark().dataset.split("train"):
        np.testing.assert_allclose(run.angles, before + np.cumsum(run.rates * 0.01, axis=0), atol=1e-9)
        before = run.angles[-1]


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


def test_another_seed_gives_other_noise_and_the_same_commands_and_validation_has_its_own() -> None:
    session = {"seed": 1, "distance": 0.3}
    dataset = simulate_dataset(small(order="sorted", train=session, validation={**session, "seed": 2})).dataset
    for one, other in zip(dataset.split("train"), dataset.split("validation"), strict=True):
        assert one.command == other.command
        assert (one.rates != other.rates).all()
        assert (one.poses[1:] != other.poses[1:]).all()


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


@pytest.mark.parametrize(("kind", "columns"), [("position", [0, 1]), ("heading", [2])])
def test_white_noise_is_as_strong_as_configured_and_independent(kind: str, columns: list[int]) -> None:
    noise, _ = noise_of(40, **{f"pose_{kind}": 0.01})
    runs = np.array([run[1:] for run in noise])
    others = [column for column in range(3) if column not in columns]
    assert runs[..., columns].std() == pytest.approx(0.01, rel=0.03)
    assert np.abs(runs[..., others]).max() < 1e-12
    neighbours = np.corrcoef(runs[:, :-1, columns].ravel(), runs[:, 1:, columns].ravel())[0, 1]
    assert abs(neighbours) < 0.05


@pytest.mark.parametrize(("kind", "columns"), [("position", [0, 1]), ("heading", [2])])
def test_a_random_walk_grows_with_the_root_of_time(kind: str, columns: list[int]) -> None:
    noise, dataset = noise_of(40, **{f"walk_{kind}": 0.003})
    runs, times = np.array(noise), dataset.trajectories[0].pose_times
    steps = np.diff(runs[..., columns], axis=1) / np.sqrt(np.diff(times))[:, None]
    assert steps.std() == pytest.approx(0.003, rel=0.03)
    assert runs[:, -1, columns].std() == pytest.approx(0.003 * math.sqrt(times[-1]), rel=0.1)


@pytest.mark.parametrize(("kind", "columns"), [("position", [0, 1]), ("heading", [2])])
def test_a_bias_is_the_same_along_a_run_and_another_in_the_next(kind: str, columns: list[int]) -> None:
    noise, _ = noise_of(40, **{f"bias_{kind}": 0.01})
    runs = np.array(noise)[:, 1:, columns]
    np.testing.assert_allclose(runs, np.broadcast_to(runs[:, :1], runs.shape), atol=1e-12)
    assert runs[:, 0].std() == pytest.approx(0.01, rel=0.15)


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


def test_a_matrix_may_be_the_truth() -> None:
    rows = [[-0.09, 0.0, 0.09], [0.05, -0.1, 0.05], [0.25, 0.25, 0.25]]
    given = apr02(truth={"matrix": rows})
    np.testing.assert_array_equal(true_matrix(given.truth, given.robot), rows)


def commands_with(**changes: Any) -> dict[str, Any]:
    return {"commands": {**apr02_settings()["commands"], **changes}}


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "a misspelt key": ({"repetition": 5}, "'repetitions'"),
    "a misspelt noise": ({"noise": {"pose_positon": 0.1}}, "'pose_position'"),
    "negative noise": ({"noise": {"encoder": -0.1}}, "noise.encoder: "),
    "noise that is NaN": ({"noise": {"walk_heading": math.nan}}, "noise.walk_heading: "),
    "no truth": ({"truth": {}}, "given: none"),
    "two truths": (
        {"truth": {"published": "palacin2023_eq8", "tolerances": {"radius": 0.1}}},
        "given: published, tolerances",
    ),
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


@pytest.fixture
def misread_steering() -> str:
    """The name of an effect that is known in one test alone."""
    return effects.register("misread_steering")(MisreadSteering).name


class MisreadSteering(MotionEffect):
    """The true steering angle is the measured one times 1 + g."""

    stage = "steering"
    physics, source, shows_in = "Gain of the angle's encoder.", "first principles", "steering angle"
    fixed_parameters = (Parameter("g", "1", -0.1, 0.1, "gain"),)

    def correction(self, signals: Signals, values: Values) -> Array:
        return values["g"] * signals.steering


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


def test_a_cars_rear_wheels_turn_at_different_rates_in_a_curve() -> None:
    made = simulate_dataset(experiment("car", truth={"tolerances": {}}))
    for run in made.dataset.trajectories:
        turn = (run.rates[:, 1] - run.rates[:, 0]) * 0.1 / 0.4
        np.testing.assert_allclose(turn, run.omega, atol=1e-9)


def test_an_effect_on_the_steering_angle_hides_in_the_motion_and_not_in_what_is_measured(misread_steering: str) -> None:
    hidden = [{"name": misread_steering, "parameters": {"g": 0.05}}]
    plain, made = (
        simulate_dataset(experiment("tricycle", truth={"tolerances": {}, "effects": effect})) for effect in ([], hidden)
    )
    model = made.truth.true_robot().model
    for with_effect, without in zip(made.dataset.trajectories, plain.dataset.trajectories, strict=True):
        np.testing.assert_array_equal(with_effect.steering, without.steering)
        (poses,) = model.poses([with_effect.log(with_effect.pose_times)])
        np.testing.assert_allclose(with_effect.poses, poses, atol=1e-9)
        assert (np.abs(with_effect.poses - without.poses).max() > 1e-3) == (with_effect.omega != 0)


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
