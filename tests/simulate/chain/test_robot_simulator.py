"""A robot that is simulated from command to SLAM: what its recordings hold, and what may not be asked of it."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import CONFIGS, Command, assert_refused, flower
from config_robots import settings

from omnibench.config import validate
from omnibench.data.true_poses import read_true_poses
from omnibench.errors import ConfigError
from omnibench.fit.calibrate import calibrate
from omnibench.robot.kinematics import Robot, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import OdometryBatch
from omnibench.simulate.commands import Command as MotionCommand
from omnibench.simulate.commands import MotionGrid
from omnibench.simulate.config import Truth
from omnibench.simulate.motors import Motor, check_reach
from omnibench.simulate.robot_config import RobotConfig
from omnibench.simulate.source import read_simulation, simulate_dataset
from omnibench.simulate.truth import Simulation, true_matrix

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
    printed = command("simulate", file, "-o", "data", "--truth", "truth")
    assert printed.returncode == 0, printed.stderr
    assert "1 simulated trajectory: data" in printed.stdout
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
        result = calibrate(simulate_dataset(config.model_copy(update=changes), "robot").dataset).result
        return result.cost

    assert calibrated(config.truth) == pytest.approx(0.0215, rel=0.2)
    assert calibrated(config.truth.model_copy(update={"effects": ()})) < 0.002


def test_the_schema_for_editors_knows_a_robot(command: Command) -> None:
    assert "RobotConfig" in command("schema", "simulate").stdout


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
