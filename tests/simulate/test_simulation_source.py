"""Simulated data sets of a YAML: which is meant, what may be asked of it, and robots simulated from command to SLAM."""

import json
import math
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import CONFIGS, Command, Prepared, assert_refused, flower, refused, small, write_effect
from config_robots import settings

from omnibench.config import validate
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.storage import load_dataset
from omnibench.data.true_poses import read_true_poses
from omnibench.errors import ConfigError, DataError, OmnibenchError
from omnibench.fit.calibrate import calibrate
from omnibench.robot.calibration import Calibration, EffectTerm, Noise, matrix_rows
from omnibench.robot.kinematics import Robot, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import OdometryBatch
from omnibench.simulate.commands import Command as MotionCommand
from omnibench.simulate.commands import MotionGrid
from omnibench.simulate.config import RobotConfig, Truth
from omnibench.simulate.motors import Motor, check_reach
from omnibench.simulate.source import read_simulation, simulate_dataset, simulate_like
from omnibench.simulate.truth import Simulation, true_matrix
from omnibench.testing import synthetic_robot, synthetic_trajectories

DRIFT = "heading_drift: {b: 0.01}"
AGAIN = ("--like", "DATA", "--model", "CALIBRATION")


def write(folder: Path, **content: Any) -> Path:
    file = folder / "simulation.yaml"
    file.write_text(yaml.safe_dump(content))
    return file


def only(folder: Path, **changes: Any) -> Path:
    """A config of one simulated data set, and no comparison."""
    return write(folder, name="mine", description="Hidden.", datasets={"flower": {"simulate": flower(**changes)}})


# Reading


def test_a_comparison_and_a_config_of_data_sets_alone_are_read_alike(tmp_path: Path) -> None:
    alone = read_simulation(only(tmp_path))
    compared = read_simulation(write(tmp_path, **small(description="Hidden.")))
    assert (alone.name, alone.description) == ("flower", "Hidden.")
    assert alone == compared


def test_one_of_several_data_sets_is_chosen_by_its_name(tmp_path: Path) -> None:
    sets = {name: {"simulate": flower(train={"seed": 1, "distance": way})} for name, way in (("a", 1), ("b", 2))}
    file = write(tmp_path, datasets=sets)
    assert [read_simulation(file, name).config.train.distance for name in "ab"] == [1, 2]
    with pytest.raises(ConfigError, match="several simulated data sets; choose one with --dataset: a, b"):
        read_simulation(file)


def test_a_misspelt_key_of_a_config_without_a_comparison_is_refused(tmp_path: Path) -> None:
    file = write(tmp_path, descripton="x", datasets={"flower": {"simulate": flower()}})
    with pytest.raises(ConfigError, match=r"unknown key 'descripton'; did you mean 'description'\?"):
        read_simulation(file)


def test_folders_of_plugins_are_beside_the_config_and_matter_for_effects_alone(tmp_path: Path) -> None:
    file = write(tmp_path, plugins=["mine"], datasets={"flower": {"simulate": flower()}})
    source = read_simulation(file)
    assert source.effect_plugins == ()
    assert source.with_effects([DRIFT]).effect_plugins == (tmp_path.resolve() / "mine",)


@pytest.mark.parametrize(("config", "name"), [("apr02", "flower"), ("mecanum", "mecanum"), ("hidden_effect", "hidden")])
def test_the_simulated_data_sets_of_the_configs_are_found(config: str, name: str) -> None:
    assert read_simulation(CONFIGS / f"{config}.yaml").name == name


# Effects of the command line


def test_effects_of_the_command_line_are_hidden_beside_those_of_the_config(tmp_path: Path) -> None:
    hidden = {"published": "palacin2023_eq8", "effects": [{"name": "floor_drift", "parameters": {"dx": 0.01}}]}
    source = read_simulation(only(tmp_path, truth=hidden)).with_effects([DRIFT, "motor_gain: {g: 0.1}"])
    assert [term.name for term in source.config.truth.effects] == ["floor_drift", "heading_drift", "motor_gain"]
    assert source.simulate().truth.effects[1] == EffectTerm(name="heading_drift", parameters={"b": 0.01})


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("heading_drift", "--effect heading_drift: "),
        ("heading_drift: 0.1", "{parameter: value}"),
        ("{a: {b: 1}, c: {d: 1}}", "{parameter: value}"),
        ("heading_drift: {b", "--effect heading_drift: {b: not valid YAML"),
        ("heading_drift: {b: fast}", "--effect heading_drift: {b: fast}: parameters.b: "),
        ("heading_drift: {b: .nan}", "parameters.b: "),
        ("3: {b: 1}", "--effect 3: {b: 1}: name: "),
    ],
)
def test_an_effect_that_cannot_be_read_is_refused_in_one_line(given: str, words: str, tmp_path: Path) -> None:
    with refused(OmnibenchError, words):
        read_simulation(only(tmp_path)).with_effects([given])


def test_an_effect_given_twice_is_refused_and_without_any_nothing_changes(tmp_path: Path) -> None:
    source = read_simulation(only(tmp_path))
    with pytest.raises(ConfigError, match=r"--effect: .*heading_drift"):
        source.with_effects([DRIFT, DRIFT])
    assert source.with_effects([]) == source


# The command


def test_the_command_hides_an_effect_and_writes_the_truth_elsewhere(command: Command, tmp_path: Path) -> None:
    made = command("simulate", only(tmp_path), "-o", "data", "--truth", "truth", "--effect", DRIFT)
    assert made.returncode == 0, made.stderr
    assert made.stdout == "truth: truth/truth.yaml\n12 simulated trajectories: data\n"
    truth = yaml.safe_load(Path("truth/truth.yaml").read_text())
    assert truth["effects"] == [{"name": "heading_drift", "parameters": {"b": 0.01}}]
    assert not any(b"drift" in file.read_bytes() for file in Path("data").iterdir())


def test_the_command_hides_an_effect_of_a_plugin(command: Command, tmp_path: Path) -> None:
    across = 'np.tile([0.0, values["v"]], (len(signals.durations), 1))'
    write_effect(tmp_path / "mine" / "side_wind.py", "world", '"v", "m/s", -0.01, 0.01, "wind"', across)
    wind = [{"name": "side_wind", "parameters": {"v": 0.005}}]
    sets = {"flower": {"simulate": flower(truth={"published": "palacin2023_eq8", "effects": wind}, noise={})}}
    by_config = write(tmp_path, plugins=["mine"], datasets=sets)
    assert command("simulate", by_config, "-o", "one").returncode == 0
    plain = write(tmp_path, datasets={"flower": {"simulate": flower(noise={})}})
    asked = ("--effect", "side_wind: {v: 0.005}", "--plugins", "mine")
    assert command("simulate", plain, "-o", "two", *asked).returncode == 0
    assert command("simulate", plain, "-o", "three").returncode == 0
    one, two, three = (load_dataset(Path(name)) for name in ("one", "two", "three"))
    assert one.hash == two.hash
    moved = one.trajectories[0].final_pose - three.trajectories[0].final_pose
    assert moved == pytest.approx([0.0, 0.005 * one.trajectories[0].times[-1], 0.0], abs=1e-9)


def test_the_command_drives_a_recording_again(command: Command, prepared: Prepared) -> None:
    asked = ("simulate", "--like", prepared.data, "--model", prepared.calibration, "-o", "like")
    made = command(*asked, "--format", "csv")
    assert made.stdout == "12 simulated trajectories: like\n", made.stderr
    evaluated = command("evaluate", prepared.calibration, "like", "--json")
    assert yaml.safe_load(evaluated.stdout)["splits"]["all"]["cost"] < 1e-9


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "CONFIG"),
        (["--like", "DATA"], "--model CALIBRATION"),
        (["--model", "CALIBRATION"], "--like DATASET"),
        (["CONFIG", *AGAIN], "--like"),
        ([*AGAIN, "--truth", "t"], "--truth: "),
        ([*AGAIN, "--dataset", "t"], "--dataset: "),
        ([*AGAIN, "--effect", DRIFT], "--effect: "),
        ([*AGAIN, "--seed", "3"], "--seed: "),
        (["CONFIG", "--noise"], "--noise: "),
        (["CONFIG", "--seed", "1"], "--seed: "),
        (["--like", "CONFIG", "--model", "CALIBRATION"], "folder"),
        (["--like", "DATA", "--model", "CONFIG"], "calibration file"),
        (["CONFIG", "--effect", "heading_drft: {b: 1}"], "unknown effect 'heading_drft'"),
    ],
)
def test_arguments_that_do_not_go_together_are_refused(
    arguments: list[str], words: str, command: Command, prepared: Prepared
) -> None:
    names = {"CONFIG": prepared.config, "DATA": prepared.data, "CALIBRATION": prepared.calibration}
    printed = command("simulate", *(names.get(each, each) for each in arguments), "-o", "made")
    assert_refused(printed, words)
    assert not Path("made").exists()


def test_a_recording_is_not_written_over_by_its_own_simulation(command: Command, prepared: Prepared) -> None:
    before = load_dataset(prepared.data).hash
    asked = ("simulate", "--like", prepared.data, "--model", prepared.calibration, "-o", prepared.data)
    assert_refused(command(*asked), "is the recording itself; name another folder")
    assert load_dataset(prepared.data).hash == before


ROBOT = synthetic_robot()
NOISE = Noise(pose_position=0.02, pose_heading=0.01, bias_position=0.03)


def recording(**changes: Any) -> Dataset:
    """Twelve runs with all that a recording may know of them."""
    runs = []
    for number, run in enumerate(synthetic_trajectories(ROBOT)):
        known: dict[str, Any] = {
            "split": "train" if number % 2 else "validation",
            "command": f"c{number // 2}",
            "repetition": number % 2,
            "session": "morning",
            "started_at": 20.0 * number,
            "angles": np.cumsum(run.rates, axis=0) * 0.2,
            "targets": run.rates,
            "pose_covariances": np.tile(np.eye(3), (len(run.poses), 1, 1)),
            "poses": run.poses + np.array([1.0, 2.0, 0.5]),
        }
        runs.append(replace(run, **(known | changes)))
    return make_dataset("recorded", ROBOT, 0.2, runs, description="A robot drove.", source="here", licence="CC0")


def calibration(*effects: EffectTerm, **changes: Any) -> Calibration:
    matrix = 1.02 * ROBOT.inverse_kinematic_matrix
    plain: dict[str, Any] = {"name": "mine", "robot": ROBOT, "sample_period": 0.2, "integration": "arc"}
    return Calibration(**(plain | {"matrix": matrix_rows(matrix), "effects": effects} | changes))


def eccentric() -> EffectTerm:
    values = dict.fromkeys(("a_a", "b_a", "a_b", "b_b", "a_c", "b_c"), 0.01)
    return EffectTerm(name="wheel_eccentricity", parameters=values)


def test_everything_but_the_poses_is_as_recorded() -> None:
    dataset = recording()
    simulated = simulate_like(dataset, calibration())
    for made, run in zip(simulated.trajectories, dataset.trajectories, strict=True):
        assert made.pose_covariances is None
        for item in {field.name for field in fields(Trajectory)} - {"poses", "pose_covariances"}:
            assert np.array_equal(getattr(made, item), getattr(run, item)), item
    assert (simulated.name, simulated.robot, simulated.sample_period) == ("recorded", ROBOT, 0.2)


def test_poses_are_what_the_model_reports_from_the_recorded_starts() -> None:
    dataset = recording()
    terms = (eccentric(), EffectTerm(name="reference_time_offset", parameters={"tau": 0.1}))
    given = calibration(*terms)
    expected = given.model.reported([run.reference_log for run in dataset.trajectories])
    simulated = simulate_like(dataset, given)
    for made, run, poses in zip(simulated.trajectories, dataset.trajectories, expected, strict=True):
        np.testing.assert_array_equal(made.start, run.start)
        np.testing.assert_allclose(made.poses[1:], poses, atol=1e-12)


def test_it_is_said_to_be_simulated_like_what_and_by_which_model() -> None:
    simulated = simulate_like(recording(), calibration(eccentric()))
    assert (simulated.simulated, simulated.licence) == (True, "CC0")
    for part in ("like recorded", "calibration mine", "wheel_eccentricity", "without noise", "A robot drove."):
        assert part in simulated.description
    assert "recorded (here)" in simulated.source


def test_a_run_with_its_start_pose_alone_keeps_it() -> None:
    dataset = recording()
    first, *others = dataset.trajectories
    alone = replace(first, pose_times=first.pose_times[:1], poses=first.poses[:1], pose_covariances=None)
    simulated = simulate_like(replace(dataset, trajectories=(alone, *others)), calibration())
    np.testing.assert_array_equal(simulated.trajectories[0].poses, alone.poses)


def test_noise_is_the_calibrations_and_the_seeds() -> None:
    runs = synthetic_trajectories(ROBOT)
    many = [replace(run, id=f"{run.id}-{copy}") for run in runs for copy in range(40)]
    dataset, given = make_dataset("many", ROBOT, 0.2, many), calibration(noise=NOISE)
    plain, noisy, again, other = (simulate_like(dataset, given, seed) for seed in (None, 7, 7, 8))
    assert noisy.hash == again.hash != other.hash
    pairs = zip(noisy.trajectories, plain.trajectories, strict=True)
    errors = np.array([made.poses - run.poses for made, run in pairs])
    np.testing.assert_array_equal(errors[:, 0], 0.0)
    assert errors[:, 1:, :2].std() == pytest.approx(np.hypot(0.02, 0.03), rel=0.1)
    assert errors[:, 1:, 2].std() == pytest.approx(0.01, rel=0.1)
    assert "with its noise, seed 7" in noisy.description


OTHER = synthetic_robot(4)
REFUSED: list[tuple[dict[str, Any], Calibration, int | None, str]] = [
    ({}, calibration(noise=None), 1, "--noise"),
    ({}, calibration(noise=Noise()), 1, "--noise"),
    ({}, calibration(robot=OTHER, matrix=matrix_rows(OTHER.inverse_kinematic_matrix)), None, "fl, fr, rl, rr"),
    ({"angles": None}, calibration(eccentric()), None, r"'wheel_eccentricity' .*phi_"),
]


@pytest.mark.parametrize(("changes", "given", "seed", "named"), REFUSED)
def test_noise_that_is_not_known_other_robots_and_recordings_without_what_an_effect_needs_are_refused(
    changes: dict[str, Any], given: Calibration, seed: int | None, named: str
) -> None:
    with pytest.raises(DataError, match=named):
        simulate_like(recording(**changes), given, seed)


# A robot that is simulated from command to SLAM: what its recordings hold, and what may not be asked of it.

TOLERANCES = {"tolerances": {"radius": 0.02, "distance": 0.05, "angle_deg": 1.0, "seed": 249}}
ONE_RUN: dict[str, Any] = {"commands": {"directions_deg": [0], "turn_rates": [0.0]}, "repetitions": 1}


def robot(**changes: Any) -> dict[str, Any]:
    """Four short commands, twice: what a config says under ``simulate``."""
    given: dict[str, Any] = {
        "generator": "robot",
        "robot": flower()["robot"],
        "commands": {"speeds": [0.2], "directions_deg": [0, 120], "turn_rates": [0.0, 0.35]},
        "repetitions": 2,
        "truth": TOLERANCES,
        "room": {"plan": "furnished_room"},
        "train": {"seed": 1, "distance": 0.4},
    }
    return given | changes


def made(**changes: Any) -> Simulation:
    return simulate_dataset(validate(RobotConfig, robot(**changes), "config"), "robot")


def file_of(folder: Path, **changes: Any) -> Path:
    file = folder / "robot.yaml"
    file.write_text(yaml.safe_dump({"datasets": {"robot": {"simulate": robot(**changes)}}}))
    return file


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return made(validation={"seed": 2, "distance": 0.4})


# What is recorded


def test_every_link_of_table_1_is_there(simulation: Simulation) -> None:
    dataset = simulation.dataset
    assert dataset.simulated
    assert [len(dataset.split("train")), len(dataset.split("validation"))] == [8, 8]
    for run in dataset.trajectories:
        assert (run.v, run.distance) == (0.2, 0.4)
        assert all(each is not None for each in (run.targets, run.angles, run.pose_covariances))
        scans = dataset.scans.of(run.id)
        assert scans.ranges.shape == (len(run.pose_times), 1080)
        np.testing.assert_array_equal(scans.times, run.pose_times)
        periods = np.diff(run.pose_times)  # from the first scan, at rest
        assert run.pose_times[0] == 0
        assert periods.min() >= 0.2 - 1e-9
        assert periods.max() <= 0.3 + 1e-9
        assert periods.std() > 0.01


def test_wheel_angles_go_on_from_run_to_run_of_a_session(simulation: Simulation) -> None:
    runs = simulation.dataset.split("train")
    for before, after in pairwise(runs):
        np.testing.assert_allclose(after.angles[0] - 0.01 * after.rates[0], before.angles[-1], atol=1e-9)


def test_targets_are_commands_by_the_design_and_measured_rates_whole_ticks(simulation: Simulation) -> None:
    tick = 2 * np.pi / 12800
    for run in simulation.dataset.trajectories:
        ticks = run.rates * 0.01 / tick
        np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-6)
        turned, wanted = (0.01 * each.sum(axis=0) for each in (run.rates, run.targets))
        np.testing.assert_allclose(turned, wanted, atol=0.02)  # rad; the controller gives up its integral at rest
        twist = [run.v * np.cos(run.alpha), run.v * np.sin(run.alpha), run.omega]
        cruising = run.targets[len(run.targets) // 3]
        np.testing.assert_allclose(cruising, wheel_equations(simulation.dataset.robot.wheels) @ twist, atol=1e-9)


def test_the_robots_odometry_is_eq_1_by_the_design_at_every_sample(simulation: Simulation) -> None:
    design = simulation.dataset.robot.inverse_kinematic_matrix
    for run in simulation.dataset.trajectories:
        pose = np.zeros(3)
        for number, rates in enumerate(run.rates):
            c, s = np.cos(pose[2]), np.sin(pose[2])
            pose = pose + 0.01 * np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ design @ rates
            np.testing.assert_allclose(run.odometry[number], pose, atol=1e-9)


def test_commands_are_sent_every_300_ms_and_the_last_is_valid_to_the_end(simulation: Simulation) -> None:
    for run in simulation.dataset.trajectories:
        times, *command, validity = run.sent.T
        np.testing.assert_allclose(times, 0.3 * np.arange(len(times)), atol=1e-12)
        np.testing.assert_array_equal(np.unique(np.transpose(command), axis=0), [[run.v, run.alpha, run.omega]])
        np.testing.assert_array_equal(validity[:-1], 0.5)
        # At 0.2 m/s, reached and left at 0.5 m/s2: the set point covers v times the time of validity.
        assert 0.2 * (times[-1] + validity[-1]) == pytest.approx(0.4, abs=0.01)


def test_the_same_seed_gives_the_same_recordings() -> None:
    few = {"commands": {"directions_deg": [0], "turn_rates": [0.35]}, "repetitions": 1}
    first, again = made(**few).dataset, made(**few).dataset
    other = made(**few, truth=TOLERANCES, train={"seed": 2, "distance": 0.4}).dataset
    assert first.hash == again.hash != other.hash


# The truth


def test_true_wheel_angles_through_the_true_matrix_give_the_true_path(simulation: Simulation) -> None:
    config = validate(RobotConfig, robot(), "config")
    matrix = true_matrix(config.truth, config.robot)
    runs = simulation.dataset.trajectories
    ends = OdometryBatch([run.log(run.times[-1:]) for run in runs], "arc").poses(matrix[None])[0]
    for run, end in zip(runs, ends, strict=True):
        truth = simulation.paths[run.id].at(run.times[-1:])[0]
        assert np.hypot(*(end - truth)[:2]) < 2e-3  # ticks of 2 mrad, 0.148 m
        assert abs(end - truth)[2] < 2e-3


@pytest.mark.parametrize(
    ("effect", "parameters"),
    [
        ("wheel_eccentricity", {"a_a": 0.04, "b_b": -0.04, "a_c": 0.04}),
        ("speed_dependent_radius", {"k": 0.02}),
        pytest.param("thermal_radius_drift", {"k": 4e-3}, marks=pytest.mark.slow),
        pytest.param("floor_drift", {"dx": 0.02, "dy": -0.01}, marks=pytest.mark.slow),
        pytest.param("centripetal_slip", {"k": 0.1}, marks=pytest.mark.slow),
        ("reference_time_offset", {"tau": 0.15}),
        ("motor_gain", {"g": 0.05}),
    ],
)
def test_an_effect_of_any_stage_acts_on_the_true_robot(effect: str, parameters: dict[str, float]) -> None:
    few = {"commands": {"directions_deg": [45], "turn_rates": [0.35]}, "lidar": {"rays": 540}, "repetitions": 2}
    hidden = [{"name": effect, "parameters": parameters}]
    train = {"seed": 1, "distance": 0.8}
    simulated = made(**few, train=train, truth={"tolerances": {}, "effects": hidden})
    model = simulated.truth.true_robot().model
    runs = simulated.dataset.trajectories
    logs = [run.log(run.pose_times) for run in runs]
    with_it, without = model.reported(logs), replace(model, terms=()).poses(logs)
    off, plain = (
        max(np.hypot(*(own - run.poses)[:, :2].T).max() for own, run in zip(poses, runs, strict=True))
        for poses in (with_it, without)
    )
    assert off < 0.006
    if effect == "motor_gain":  # it acts before the encoders, which see it
        for run in runs:
            assert np.abs(run.rates).sum() / np.abs(run.targets).sum() == pytest.approx(1.05, abs=0.02)
    else:
        assert plain > 1.5 * off


def test_runs_begin_ten_seconds_apart_and_not_quite_on_their_mark(simulation: Simulation) -> None:
    runs = simulation.dataset.split("train")
    for before, after in pairwise(runs):
        assert after.started_at == pytest.approx(before.started_at + before.times[-1] + 10)
    starts = np.array([simulation.starts[run.id] for run in runs])
    spread = starts - simulation.plan.start
    assert np.all(spread.std(axis=0) > [0.005, 0.005, 0.01])
    assert np.all(np.abs(spread) < [0.1, 0.1, 0.2])


def test_a_computer_that_hangs_is_told_and_the_run_is_short() -> None:
    stalled = made(**ONE_RUN, link={"stalls_at": 0.5})
    (run,) = stalled.dataset.trajectories
    assert any("watchdog" in warning for warning in stalled.dataset.warnings)
    assert stalled.paths[run.id].at(run.times[-1:])[0, 0] < 0.25


def test_latency_makes_the_reference_late() -> None:
    late = made(**ONE_RUN, lidar={"latency": 0.2})
    (run,) = late.dataset.trajectories
    cruising = (run.pose_times > 0.8) & (run.pose_times < 1.8)
    true = late.paths[run.id].at(run.pose_times)
    np.testing.assert_allclose((true - run.poses)[cruising, 0], 0.2 * 0.2, atol=6e-3)
    assert abs((true - run.poses)[-1, 0]) < 6e-3


def test_the_command_writes_it_apart_from_the_data(command: Command, tmp_path: Path) -> None:
    file = file_of(tmp_path, repetitions=1, commands={"directions_deg": [0], "turn_rates": [0.0]})
    printed = command("simulate", file, "-o", "data", "--truth", "truth", "--report", "page.html", "--json")
    assert printed.returncode == 0, printed.stderr
    told = json.loads(printed.stdout)
    assert (told["dataset"], told["trajectories"]) == ("data", 1)
    assert told["accuracy"] == json.loads(Path("truth/slam_accuracy.json").read_text())
    assert "omnibench inspect data" in Path("page.html").read_text()
    paths = read_true_poses(tmp_path / "truth")
    assert list(paths) == ["train-001"]
    assert (tmp_path / "truth" / "slam_accuracy.json").is_file()
    tables = {f"{name}.parquet" for name in ("trajectories", "commands", "wheels", "poses", "scans")}
    assert {file.name for file in (tmp_path / "data").iterdir()} == {"dataset.yaml", *tables}


# What is refused


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"commands": {"speeds": [5.0], "directions_deg": [30], "turn_rates": [0.0]}}, ["5 m/s", "rad/s"]),
        ({"room": {"plan": "furnished_rom"}}, ["furnished_room"]),
        ({"room": {"boundary": [[0, 0], [2, 0], [4, 0]], "start": [1, 0, 0]}}, ["room", "boundary"]),
        ({"room": {"boundary": [[0, 0], [4, 0], [4, 4], [0, 4]], "start": [9, 1, 0]}}, ["room", "start"]),
        ({"train": {"seed": 1, "distance": 9.0}}, ["command v0.2", "hits"]),
        ({"train": {"seed": 1, "distance": 1e6}}, ["check the distances"]),
        ({"link": {"refresh": 1e-9}}, ["link.refresh"]),
        ({"generator": "robt"}, ["'flower'", "'robot'"]),
        ({"sample_period": 0.0105}, ["sample_period"]),
        ({"lidar": {"rays": 0}}, ["lidar.rays"]),
        ({"motor": {"volts": 1}}, ["motor.volts", "supply_voltage"]),
    ],
    ids=lambda value: "" if isinstance(value, dict) else value[0],
)
def test_a_config_that_cannot_be_is_one_line_that_names_it(
    command: Command, tmp_path: Path, changes: dict[str, Any], said: list[str]
) -> None:
    printed = command("simulate", file_of(tmp_path, **changes), "-o", "data")
    told = printed.stderr.splitlines()  # progress, and the line
    assert_refused(printed._replace(stderr=told[-1] + "\n"), *said)
    assert not (tmp_path / "data").exists()


def test_a_design_from_a_simulated_robot_asks_for_its_recordings(command: Command) -> None:
    assert_refused(command("design", CONFIGS / "apr02_robot.yaml"), "omnibench simulate", "folder")


def test_the_papers_experiment_is_36_commands_5_times_in_two_sessions() -> None:
    config = read_simulation(CONFIGS / "apr02_robot.yaml").config
    assert isinstance(config, RobotConfig)
    assert len(config.driven) == 36
    assert config.repetitions == 5
    assert config.validation is not None


@pytest.mark.slow
def test_floor_and_slip_of_the_shipped_config_leave_about_the_papers_calibrated_cost() -> None:
    config = read_simulation(CONFIGS / "apr02_floor.yaml").config
    assert isinstance(config, RobotConfig)
    few = MotionGrid(directions_deg=(0, 60, 120, 180, 240, 300), turn_rates=(-0.35, 0.35))
    small = {"commands": few, "repetitions": 1, "validation": None}

    def calibrated(truth: Truth) -> float:
        effects = tuple(term for term in truth.effects if term.name != "tyre_wear")  # one session
        changes = {**small, "truth": truth.model_copy(update={"effects": effects})}
        dataset = simulate_dataset(config.model_copy(update=changes), "robot").dataset
        return calibrate(dataset, "closed_form").result.cost  # the paper minimises Eq. (6) alone

    assert calibrated(config.truth) == pytest.approx(0.0215, rel=0.2)
    assert calibrated(config.truth.model_copy(update={"effects": ()})) < 0.002


def test_the_schema_for_editors_knows_a_robot(command: Command) -> None:
    schema = json.loads(command("schema", "simulate").stdout)
    assert (schema["title"], schema["required"]) == ("SimulationConfig", ["datasets"])
    assert {"RobotConfig", "FlowerConfig", "EffectTerm"} <= {*schema["$defs"]}


def steered_runs(name: str, **changes: Any) -> Simulation:
    """A run straight on and one in a curve."""
    given = {
        "generator": "robot",
        "robot": settings(name)["robot"],
        "sample_period": 0.02,
        "commands": {"speeds": [0.3], "directions_deg": [0], "turn_rates": [0.0, 0.2]},
        "repetitions": 1,
        "order": "sorted",
        "truth": settings(name)["truth"],
        "motor": {"gear_ratio": 25},
        "steering": {"noise_deg": 0},
        "room": {"plan": "hall"},
        "train": {"seed": 1, "distance": 0.5},
    }
    return simulate_dataset(validate(RobotConfig, given | changes, "config"), name)


@pytest.mark.parametrize("name", ["tricycle", "car", "swerve"])
def test_what_is_measured_tells_the_true_path_by_the_true_matrix(name: str) -> None:
    simulation = steered_runs(name)
    truth = OdometryModel(simulation.dataset.robot, np.array(simulation.truth.matrix), "arc")
    for run in simulation.dataset.trajectories:
        log = replace(run.log(run.pose_times), start=np.zeros(3))
        path = simulation.paths[run.id].at(run.pose_times)
        np.testing.assert_allclose(truth.poses([log])[0], path, atol=2e-3)
        assert np.abs(run.poses - path).max() < 0.02  # by SLAM


def test_a_tricycle_steers_while_it_drives_at_the_rate_of_its_motor_in_whole_ticks() -> None:
    straight, curve = steered_runs("tricycle").dataset.trajectories
    assert not straight.steering.any()
    ticks = curve.steering * 8192 / (2 * math.pi)
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-9)
    wanted = math.atan(0.2 * 0.6 / 0.3)
    expected = np.minimum(math.pi * curve.times, wanted)
    np.testing.assert_allclose(curve.steering[:, 0], expected, atol=1e-3)
    assert curve.rates[: int(wanted / math.pi / 0.02)].any()


def test_a_swerve_drive_steers_before_it_drives() -> None:
    _, curve = steered_runs("swerve").dataset.trajectories
    steering = np.abs(np.diff(curve.steering, axis=0)).max(axis=1) > 1e-9
    driving = np.abs(curve.rates).max(axis=1) > 0
    assert steering.any()
    assert driving.argmax() > np.flatnonzero(steering)[-1]


def test_a_steered_command_beyond_the_motors_is_refused_with_the_speed_that_is_not() -> None:
    tricycle = validate(Robot, settings("tricycle")["robot"], "config")
    with pytest.raises(ConfigError, match=r"wheel front .* 0.927 m/s"):
        check_reach(tricycle, [MotionCommand(2.0, 0.0, 0.5)], Motor())
