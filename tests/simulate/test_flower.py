"""The flower benchmark: what is simulated, how noisy, and that its truth stays hidden."""

from __future__ import annotations

import math
import struct
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml

from omnibench.config import validate
from omnibench.data.dataset import Dataset, Split
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError
from omnibench.fit.evaluate import ModelErrors
from omnibench.robot.kinematics import Array, published_matrix
from omnibench.robot.model import OdometryModel
from omnibench.simulate.config import EncoderNoise, FlowerConfig
from omnibench.simulate.simulate import simulate_dataset
from omnibench.simulate.truth import Simulation, true_matrix

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
QUIET = dict.fromkeys(EncoderNoise.model_fields, 0.0)


def settings(**changes: Any) -> dict[str, Any]:
    """The benchmark's own settings, changed."""
    content = yaml.safe_load((CONFIGS / "apr02.yaml").read_text())
    return {**content["datasets"]["flower"]["simulate"], **changes}


def config(**changes: Any) -> FlowerConfig:
    return validate(FlowerConfig, settings(**changes), "flower.yaml")


def small(**changes: Any) -> FlowerConfig:
    """A few short runs, in one session."""
    commands = {"speeds": [0.2], "directions_deg": [0, 120, 240], "turn_rates": [-0.35, 0.0, 0.35]}
    given = {"commands": commands, "repetitions": 2, "train": {"seed": 1, "distance": 0.3}, "validation": None}
    return config(**(given | changes))


@cache
def benchmark() -> Simulation:
    return simulate_dataset(config())


def noise_of(repetitions: int, **noise: float) -> tuple[list[Array], Dataset]:
    """The noise (K, 3) of every run's poses, by comparison with the same runs without noise."""
    session = {"seed": 1, "distance": 1.2}
    noisy, quiet = (
        simulate_dataset(small(noise=QUIET | levels, repetitions=repetitions, train=session)).dataset
        for levels in (noise, {})
    )
    return [a.poses - b.poses for a, b in zip(noisy.trajectories, quiet.trajectories, strict=True)], noisy


@pytest.mark.parametrize("split", ["train", "validation"])
def test_each_session_has_36_commands_five_times(split: Split) -> None:
    names = [run.command for run in benchmark().dataset.split(split)]
    assert len(names) == 180
    assert len(set(names)) == 36
    assert {names.count(name) for name in names} == {5}


def test_repetitions_are_numbered_from_1_to_5() -> None:
    runs = benchmark().dataset.split("train")
    for command in {run.command for run in runs}:
        assert sorted(run.repetition or 0 for run in runs if run.command == command) == [1, 2, 3, 4, 5]


def test_the_commands_are_12_directions_with_3_rates_at_one_speed() -> None:
    found = {(round(math.degrees(c.direction)), c.turn_rate, c.speed) for c in config().driven}
    assert found == {(30 * i, rate, 0.2) for i in range(12) for rate in (-0.35, 0.0, 0.35)}


def test_samples_end_at_multiples_of_the_period() -> None:
    for run in benchmark().dataset.trajectories:
        np.testing.assert_array_equal(run.times, 0.01 * np.arange(1, len(run.times) + 1))


def test_a_run_is_as_long_as_its_session_says() -> None:
    lengths = {"train": 1.116, "validation": 1.128}
    for run in benchmark().dataset.trajectories:
        assert len(run.times) == round(lengths[run.split] / 0.2 / 0.01)
        assert run.duration == run.times[-1]
        assert run.distance == pytest.approx(lengths[run.split], abs=1e-9)


def test_reference_poses_are_at_the_start_every_250_ms_and_at_the_end() -> None:
    for run in benchmark().dataset.trajectories:
        np.testing.assert_allclose(run.pose_times[:-1], 0.25 * np.arange(len(run.pose_times) - 1), atol=1e-12)
        assert run.pose_times[-1] == run.times[-1]
        assert 0 < run.pose_times[-1] - run.pose_times[-2] <= 0.25 + 1e-12


@pytest.mark.parametrize(("distance", "stamps"), [(0.1, [0, 0.25, 0.5]), (0.04, [0, 0.2]), (0.052, [0, 0.25, 0.26])])
def test_the_last_reference_pose_is_never_doubled(distance: float, stamps: list[float]) -> None:
    dataset = simulate_dataset(small(train={"seed": 1, "distance": distance})).dataset
    for run in dataset.trajectories:
        np.testing.assert_allclose(run.pose_times, stamps, atol=1e-12)


def test_start_poses_are_exact() -> None:
    for run in benchmark().dataset.trajectories:
        np.testing.assert_array_equal(run.start, np.zeros(3))


def test_targets_are_constant_and_rates_are_noisy_about_them() -> None:
    for run in benchmark().dataset.trajectories[:20]:
        assert run.targets is not None
        assert (run.targets == run.targets[0]).all()
        assert (run.rates != run.targets).all()


def test_wheel_angles_are_the_sum_of_the_rates_through_the_whole_session() -> None:
    before = np.zeros(3)
    for run in benchmark().dataset.split("train"):
        assert run.angles is not None
        np.testing.assert_allclose(run.angles, before + np.cumsum(run.rates * 0.01, axis=0), atol=1e-9)
        before = run.angles[-1]


def test_the_runs_of_a_session_follow_each_other() -> None:
    for split in ("train", "validation"):
        runs = benchmark().dataset.split(split)
        assert {run.session for run in runs} == {split}
        assert runs[0].started_at == 0.0
        for before, after in pairwise(runs):
            assert (after.started_at or 0) > (before.started_at or 0) + before.times[-1]


def test_the_order_of_the_runs_is_shuffled_unless_sorted_is_asked_for() -> None:
    given = [command.name for command in small().driven for _ in range(2)]
    orders = {
        order: [run.command for run in simulate_dataset(small(order=order)).dataset.trajectories]
        for order in ("sorted", "shuffled")
    }
    assert orders["sorted"] == given
    assert orders["shuffled"] != given
    assert sorted(map(str, orders["shuffled"])) == sorted(given)


def test_the_data_set_says_that_it_is_simulated() -> None:
    assert benchmark().dataset.simulated
    assert benchmark().dataset.source == "simulated by omnibench"


def test_nothing_about_the_benchmark_looks_wrong() -> None:
    assert benchmark().dataset.warnings == ()


def test_the_same_config_gives_the_same_bits() -> None:
    assert simulate_dataset(small()).dataset.hash == simulate_dataset(small()).dataset.hash


def test_another_seed_gives_other_noise_and_the_same_commands() -> None:
    first, second = (
        simulate_dataset(small(order="sorted", train={"seed": seed, "distance": 0.3})).dataset for seed in (1, 2)
    )
    for one, other in zip(first.trajectories, second.trajectories, strict=True):
        assert one.command == other.command
        assert (one.rates != other.rates).all()
        assert (one.poses[1:] != other.poses[1:]).all()


def test_validation_has_noise_of_its_own() -> None:
    session = {"seed": 1, "distance": 0.3}
    dataset = simulate_dataset(small(order="sorted", train=session, validation={**session, "seed": 2})).dataset
    for one, other in zip(dataset.split("train"), dataset.split("validation"), strict=True):
        assert one.command == other.command
        assert (one.rates != other.rates).all()


@pytest.mark.parametrize("integration", ["euler", "arc"])
def test_without_noise_the_truth_scores_nothing(integration: Any) -> None:
    simulation = simulate_dataset(small(noise=QUIET, integration=integration))
    truth = OdometryModel(simulation.dataset.robot, np.array(simulation.truth.matrix), simulation.truth.integration)
    assert ModelErrors.of(truth, simulation.dataset.trajectories).on(simulation.dataset.trajectories).cost < 1e-14
    design = OdometryModel.of_design(simulation.dataset.robot, integration)
    assert ModelErrors.of(design, simulation.dataset.trajectories).on(simulation.dataset.trajectories).cost > 0.02


def test_the_truth_record_holds_eq_8_and_how_it_was_driven() -> None:
    truth = benchmark().truth
    np.testing.assert_array_equal(truth.matrix, published_matrix("palacin2023_eq8"))
    assert (truth.dataset, truth.integration, truth.noise) == ("flower", "arc", config().noise)


@pytest.mark.parametrize("table_format", ["csv", "parquet"])
def test_the_truth_is_nowhere_in_the_files_of_the_data_set(tmp_path: Path, table_format: Any) -> None:
    save_dataset(simulate_dataset(small()).dataset, tmp_path / "flower", table_format)
    elements = published_matrix("palacin2023_eq8").ravel()
    digits = [f"{abs(element):.16f}"[2:].lstrip("0")[:7].encode() for element in elements]
    binary = [struct.pack("<d", sign * element) for element in elements for sign in (1, -1)]
    for file in (tmp_path / "flower").iterdir():
        content = file.read_bytes()
        assert not [each for each in (b"eq8", b"published", b"truth") if each in content], file
        assert not [each for each in binary if each in content], file
        if file.suffix != ".parquet":
            assert not [each for each in digits if each in content], file


def test_no_number_of_the_data_set_is_an_element_of_the_truth(tmp_path: Path) -> None:
    save_dataset(simulate_dataset(small()).dataset, tmp_path / "flower")
    elements = np.abs(published_matrix("palacin2023_eq8").ravel())
    for name in ("trajectories", "wheels", "poses"):
        frame = pl.read_parquet(tmp_path / "flower" / f"{name}.parquet").select(pl.selectors.float())
        for column in frame.iter_columns():
            values = np.abs(column.drop_nulls().to_numpy())
            assert np.abs(values[:, None] - elements).min() > 1e-9, (name, column.name)


def test_the_search_for_the_truth_would_find_it() -> None:
    element = published_matrix("palacin2023_eq8")[0, 0]
    assert f"{abs(element):.16f}"[2:].lstrip("0")[:7] in repr(float(element))


def test_a_saved_simulation_comes_back_the_same(tmp_path: Path) -> None:
    dataset = simulate_dataset(small()).dataset
    save_dataset(dataset, tmp_path / "flower")
    assert load_dataset(tmp_path / "flower").hash == dataset.hash


def test_encoder_noise_is_as_strong_as_configured() -> None:
    _, dataset = noise_of(5, encoder=0.02)
    errors = np.concatenate([run.rates - run.targets for run in dataset.trajectories if run.targets is not None])
    assert errors.std() == pytest.approx(0.02, rel=0.02)
    assert abs(errors.mean()) < 0.02 * 5 / math.sqrt(errors.size)


def test_encoder_noise_does_not_move_the_robot() -> None:
    noise, _ = noise_of(2, encoder=0.02)
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
    assert driven == [
        *[("v0.1_a0_w0_t6", 6.0, 0)] * 2,
        ("v0.1_a0_w0_t9_h90", 9.0, 90),
        *[("v0_a0_w0.5", 4.0, 0)] * 3,
    ]
    assert given.runs == len(runs)
    (northward,) = (run for run in runs if run.command == "v0.1_a0_w0_t9_h90")
    assert northward.poses[-1, 1] > 0.8 > 0.1 > abs(northward.poses[-1, 0])


def test_tolerances_draw_a_robot_about_its_design() -> None:
    tolerances = {"radius": 0.02, "distance": 0.03, "angle_deg": 0.5, "seed": 7}
    given = config(truth={"tolerances": tolerances})
    truth, design = true_matrix(given.truth, given.robot), given.robot.inverse_kinematic_matrix
    deviation = np.abs(truth - design).max() / np.abs(design).max()
    assert 1e-3 < deviation < 0.2
    other = config(truth={"tolerances": {**tolerances, "seed": 8}})
    assert not np.array_equal(true_matrix(other.truth, other.robot), truth)


def test_a_matrix_may_be_the_truth() -> None:
    rows = [[-0.09, 0.0, 0.09], [0.05, -0.1, 0.05], [0.25, 0.25, 0.25]]
    given = config(truth={"matrix": rows})
    np.testing.assert_array_equal(true_matrix(given.truth, given.robot), rows)


def test_mecanum_wheels_are_simulated_too() -> None:
    content = yaml.safe_load((CONFIGS / "mecanum.yaml").read_text())["datasets"]["mecanum"]["simulate"]
    given = validate(FlowerConfig, {**content, "repetitions": 1, "validation": None, "noise": QUIET}, "mecanum.yaml")
    simulation = simulate_dataset(given)
    truth = OdometryModel(given.robot, np.array(simulation.truth.matrix), "arc")
    assert truth.matrix.shape == (3, 4)
    assert ModelErrors.of(truth, simulation.dataset.trajectories).on(simulation.dataset.trajectories).cost < 1e-14


def commands_with(**changes: Any) -> dict[str, Any]:
    return {"commands": {**settings()["commands"], **changes}}


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "a misspelt key": ({"repetition": 5}, "unknown key 'repetition'; did you mean 'repetitions'?"),
    "a misspelt noise": ({"noise": {"pose_positon": 0.1}}, "did you mean 'pose_position'?"),
    "negative noise": ({"noise": {"encoder": -0.1}}, "noise.encoder: "),
    "noise that is NaN": ({"noise": {"walk_heading": math.nan}}, "noise.walk_heading: "),
    "no truth": ({"truth": {}}, "truth: give one of published, matrix, tolerances (given: none)"),
    "two truths": (
        {"truth": {"published": "palacin2023_eq8", "tolerances": {"radius": 0.1}}},
        "truth: give one of published, matrix, tolerances (given: published, tolerances)",
    ),
    "an unknown truth": (
        {"truth": {"published": "palacin2023_eq7"}},
        "truth: unknown published matrix 'palacin2023_eq7'; did you mean 'palacin2023_eq",
    ),
    "a truth of another shape": ({"truth": {"matrix": [[1.0, 2.0]] * 3}}, "truth.matrix must have 3 rows of 3 values"),
    "no commands that move": (commands_with(speeds=[0], turn_rates=[0]), "commands: no command moves the robot"),
    "neither a grid nor a list": ({"commands": {"speeds": [0.2]}}, "commands: give turn_rates (rad/s) of a grid"),
    "a listed command that stands": (
        {"commands": {"listed": [{"duration": 1.0}]}},
        "commands.listed.0: this command does not move the robot",
    ),
    "a ramp longer than a listed run": (
        {"commands": {"listed": [{"speed": 0.1, "duration": 1.0}], "ramp": 0.8}},
        "commands.ramp: 0.8 s; the shortest run",
    ),
    "no directions": (commands_with(directions_deg=[]), "commands.directions_deg: "),
    "a negative speed": (commands_with(speeds=[-0.2]), "commands.speeds.0: "),
    "an infinite rate of turn": (commands_with(turn_rates=[math.inf]), "commands.turn_rates.0: "),
    "no repetitions": ({"repetitions": 0}, "repetitions: "),
    "a period of zero": ({"sample_period": 0}, "sample_period: "),
    "runs shorter than a sample": ({"sample_period": 60}, "runs are shorter than one sample"),
    "no seed": ({"train": {"distance": 1.0}}, "key 'train.seed' is missing"),
    "no training session": ({"train": None}, "train: "),
    "an unknown order": ({"order": "random"}, "order: "),
    "another generator": ({"generator": "spiral"}, "generator: "),
    "a robot without a name": ({"robot": {**settings()["robot"], "name": ""}}, "robot: give the robot a name"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_config_that_is_wrong_is_refused_in_one_line(case: str) -> None:
    changes, words = REFUSED[case]
    with pytest.raises(ConfigError) as refusal:
        config(**changes)
    message = str(refusal.value)
    assert words in message
    assert message.startswith("flower.yaml: ")
    assert "\n" not in message
