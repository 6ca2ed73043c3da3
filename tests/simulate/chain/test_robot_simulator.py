"""A robot that is simulated from command to SLAM: what its recordings hold, and what may not be asked of it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import CONFIGS, Command, assert_refused, flower

from omnibench.config import validate
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.data.true_poses import read_true_poses
from omnibench.fit.calibrate import calibrate
from omnibench.robot.kinematics import wheel_equations
from omnibench.robot.odometry import OdometryBatch
from omnibench.simulate.commands import MotionGrid
from omnibench.simulate.config import Truth
from omnibench.simulate.robot_config import RobotConfig
from omnibench.simulate.simulate import simulate_dataset
from omnibench.simulate.source import read_simulation
from omnibench.simulate.truth import Simulation, true_matrix

TOLERANCES = {"tolerances": {"radius": 0.02, "distance": 0.05, "angle_deg": 1.0, "seed": 249}}
BLIND = {"plan": "corridor"}


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


class TestWhatIsRecorded:
    def test_every_link_of_table_1_is_there(self, simulation: Simulation) -> None:
        dataset = simulation.dataset
        assert dataset.simulated
        assert [len(dataset.split("train")), len(dataset.split("validation"))] == [8, 8]
        assert dataset.scans is not None
        for run in dataset.trajectories:
            assert run.v == 0.2
            assert run.distance == 0.4
            assert run.targets is not None
            assert run.angles is not None
            assert run.pose_covariances is not None
            scans = dataset.scans.of(run.id)
            assert scans.ranges.shape == (len(run.pose_times), 1080)
            np.testing.assert_array_equal(scans.times, run.pose_times)

    def test_scans_come_every_200_to_300_ms_the_first_at_rest(self, simulation: Simulation) -> None:
        for run in simulation.dataset.trajectories:
            periods = np.diff(run.pose_times)
            assert run.pose_times[0] == 0
            assert periods.min() >= 0.2 - 1e-9
            assert periods.max() <= 0.3 + 1e-9
            assert periods.std() > 0.01

    def test_wheel_angles_go_on_from_run_to_run_of_a_session(self, simulation: Simulation) -> None:
        runs = simulation.dataset.split("train")
        for before, after in pairwise(runs):
            assert before.angles is not None
            assert after.angles is not None
            np.testing.assert_allclose(after.angles[0] - 0.01 * after.rates[0], before.angles[-1], atol=1e-9)

    def test_measured_rates_are_whole_ticks_and_follow_the_targets(self, simulation: Simulation) -> None:
        tick = 2 * np.pi / 12800
        for run in simulation.dataset.trajectories:
            ticks = run.rates * 0.01 / tick
            np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-6)
            assert run.targets is not None
            turned, wanted = (0.01 * each.sum(axis=0) for each in (run.rates, run.targets))
            np.testing.assert_allclose(turned, wanted, atol=0.02)  # rad; the controller gives up its integral at rest

    def test_targets_are_the_commands_by_the_design_matrix(self, simulation: Simulation) -> None:
        for run in simulation.dataset.trajectories:
            assert run.v is not None
            assert run.alpha is not None
            assert run.targets is not None
            twist = [run.v * np.cos(run.alpha), run.v * np.sin(run.alpha), run.omega]
            cruising = run.targets[len(run.targets) // 3]
            np.testing.assert_allclose(cruising, wheel_equations(simulation.dataset.robot.wheels) @ twist, atol=1e-9)

    def test_the_robots_odometry_is_eq_1_by_the_design_at_every_sample(self, simulation: Simulation) -> None:
        design = simulation.dataset.robot.inverse_kinematic_matrix
        for run in simulation.dataset.trajectories:
            pose = np.zeros(3)
            for number, rates in enumerate(run.rates):
                c, s = np.cos(pose[2]), np.sin(pose[2])
                pose = pose + 0.01 * np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ design @ rates
                assert run.odometry is not None
                np.testing.assert_allclose(run.odometry[number], pose, atol=1e-9)

    def test_commands_are_sent_every_300_ms_and_the_last_is_valid_until_the_way_is_driven(
        self, simulation: Simulation
    ) -> None:
        for run in simulation.dataset.trajectories:
            assert run.sent is not None
            times, *command, validity = run.sent.T
            np.testing.assert_allclose(times, 0.3 * np.arange(len(times)), atol=1e-12)
            np.testing.assert_array_equal(np.unique(np.transpose(command), axis=0), [[run.v, run.alpha, run.omega]])
            np.testing.assert_array_equal(validity[:-1], 0.5)
            # At 0.2 m/s, reached and left at 0.5 m/s2: the set point covers v times the time of validity.
            assert 0.2 * (times[-1] + validity[-1]) == pytest.approx(0.4, abs=0.01)

    def test_it_survives_the_disk_in_both_formats(self, simulation: Simulation, tmp_path: Path) -> None:
        assert simulation.dataset.scans is not None
        for table_format in ("parquet", "csv"):
            save_dataset(simulation.dataset, tmp_path / table_format, table_format)
            read = load_dataset(tmp_path / table_format)
            assert read.hash == simulation.dataset.hash
            for run, recorded in zip(read.trajectories, simulation.dataset.trajectories, strict=True):
                np.testing.assert_array_equal(run.odometry, recorded.odometry)
                np.testing.assert_array_equal(run.sent, recorded.sent)
            assert read.scans is not None
            assert read.scans.scanner == simulation.dataset.scans.scanner
            for name, scans in simulation.dataset.scans:
                np.testing.assert_array_equal(read.scans.of(name).ranges, scans.ranges)

    def test_the_same_seed_gives_the_same_recordings(self) -> None:
        few = {"commands": {"directions_deg": [0], "turn_rates": [0.35]}, "repetitions": 1}
        first, again = made(**few).dataset, made(**few).dataset
        other = made(**few, truth=TOLERANCES, train={"seed": 2, "distance": 0.4}).dataset
        assert first.hash == again.hash != other.hash


class TestTheTruth:
    def test_true_wheel_angles_through_the_true_matrix_give_the_true_path(self, simulation: Simulation) -> None:
        config = validate(RobotConfig, robot(), "config")
        matrix = true_matrix(config.truth, config.robot)
        runs = simulation.dataset.trajectories
        ends = OdometryBatch([run.log(run.times[-1:]) for run in runs], "arc").poses(matrix[None])[0]
        for run, end in zip(runs, ends, strict=True):
            truth = simulation.paths[run.id].at(run.times[-1:])[0]
            assert np.hypot(*(end - truth)[:2]) < 2e-3  # ticks of 2 mrad, 0.148 m
            assert abs(end - truth)[2] < 2e-3

    def test_an_effect_bends_the_true_path_and_not_the_encoders(self) -> None:
        few = {"commands": {"directions_deg": [0], "turn_rates": [0.0]}, "repetitions": 1}
        drift = [{"name": "heading_drift", "parameters": {"b": 0.02}}]
        plain, bent = made(**few), made(**few, truth=TOLERANCES | {"effects": drift})
        (run,), (other,) = plain.dataset.trajectories, bent.dataset.trajectories
        np.testing.assert_array_equal(run.rates, other.rates)
        end = run.times[-1:]
        turned = bent.paths[run.id].at(end)[0, 2] - plain.paths[run.id].at(end)[0, 2]
        assert turned == pytest.approx(0.02 * 2.4, rel=0.25)  # s in motion
        assert other.final_pose[2] - run.final_pose[2] == pytest.approx(turned, abs=2e-3)  # and SLAM sees it

    @pytest.mark.parametrize(
        ("effect", "parameters"),
        [
            ("wheel_eccentricity", {"a_a": 0.04, "b_b": -0.04, "a_c": 0.04}),
            ("speed_dependent_radius", {"k": 0.02}),
            ("thermal_radius_drift", {"k": 4e-3}),
            ("floor_drift", {"dx": 0.02, "dy": -0.01}),
            ("centripetal_slip", {"k": 0.1}),
            ("reference_time_offset", {"tau": 0.15}),
            ("motor_gain", {"g": 0.05}),
        ],
    )
    def test_an_effect_of_any_stage_acts_on_the_true_robot(self, effect: str, parameters: dict[str, float]) -> None:
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
            targets = [run.targets for run in runs]
            for run, target in zip(runs, targets, strict=True):
                assert target is not None
                turned = np.abs(run.rates).sum() / np.abs(target).sum()
                assert turned == pytest.approx(1.05, abs=0.02)
        else:
            assert plain > 1.5 * off

    def test_runs_begin_ten_seconds_apart_and_not_quite_on_their_mark(self, simulation: Simulation) -> None:
        runs = simulation.dataset.split("train")
        for before, after in pairwise(runs):
            assert before.started_at is not None
            assert after.started_at == pytest.approx(before.started_at + before.times[-1] + 10)
        starts = np.array([simulation.starts[run.id] for run in runs])
        assert simulation.plan is not None
        spread = starts - simulation.plan.start
        assert np.all(spread.std(axis=0) > [0.005, 0.005, 0.01])
        assert np.all(np.abs(spread) < [0.1, 0.1, 0.2])

    def test_a_computer_that_hangs_is_told_and_the_run_is_short(self) -> None:
        few = {"commands": {"directions_deg": [0], "turn_rates": [0.0]}, "repetitions": 1}
        stalled = made(**few, link={"stalls_at": 0.5})
        (run,) = stalled.dataset.trajectories
        assert any("watchdog" in warning for warning in stalled.dataset.warnings)
        assert stalled.paths[run.id].at(run.times[-1:])[0, 0] < 0.25

    def test_latency_makes_the_reference_late(self) -> None:
        few = {"commands": {"directions_deg": [0], "turn_rates": [0.0]}, "repetitions": 1}
        late = made(**few, lidar={"latency": 0.2})
        (run,) = late.dataset.trajectories
        cruising = (run.pose_times > 0.8) & (run.pose_times < 1.8)
        true = late.paths[run.id].at(run.pose_times)
        np.testing.assert_allclose((true - run.poses)[cruising, 0], 0.2 * 0.2, atol=6e-3)
        assert abs((true - run.poses)[-1, 0]) < 6e-3

    def test_the_command_writes_it_apart_from_the_data(self, command: Command, tmp_path: Path) -> None:
        file = file_of(tmp_path, repetitions=1, commands={"directions_deg": [0], "turn_rates": [0.0]})
        printed = command("simulate", file, "-o", "data", "--truth", "truth")
        assert printed.returncode == 0, printed.stderr
        assert "1 simulated trajectory: data" in printed.stdout
        paths = read_true_poses(tmp_path / "truth")
        assert list(paths) == ["train-001"]
        assert (tmp_path / "truth" / "slam_accuracy.json").is_file()
        assert {file.name for file in (tmp_path / "data").iterdir()} == {
            "dataset.yaml",
            "trajectories.parquet",
            "commands.parquet",
            "wheels.parquet",
            "poses.parquet",
            "scans.parquet",
        }


class TestWhatIsRefused:
    @pytest.mark.parametrize(
        ("changes", "said"),
        [
            pytest.param(
                {"commands": {"speeds": [5.0], "directions_deg": [30], "turn_rates": [0.0]}},
                ["5 m/s", "rad/s"],
                id="a command faster than the motors",
            ),
            pytest.param({"room": {"plan": "furnished_rom"}}, ["furnished_room"], id="an unknown room"),
            pytest.param(
                {"room": {"boundary": [[0, 0], [2, 0], [4, 0]], "start": [1, 0, 0]}},
                ["room", "boundary"],
                id="a degenerate polygon",
            ),
            pytest.param(
                {"room": {"boundary": [[0, 0], [4, 0], [4, 4], [0, 4]], "start": [9, 1, 0]}},
                ["room", "start"],
                id="a start outside the room",
            ),
            pytest.param(
                {"train": {"seed": 1, "distance": 9.0}}, ["command v0.2", "hits"], id="a way through the wall"
            ),
            pytest.param({"train": {"seed": 1, "distance": 1e6}}, ["check the distances"], id="millimetres for metres"),
            pytest.param({"link": {"refresh": 1e-9}}, ["link.refresh"], id="commands without end"),
            pytest.param({"generator": "robt"}, ["generator must be 'flower' or 'robot'"], id="an unknown generator"),
            pytest.param({"sample_period": 0.0105}, ["sample_period"], id="a period between milliseconds"),
            pytest.param({"lidar": {"rays": 0}}, ["lidar.rays"], id="a LIDAR without rays"),
            pytest.param({"motor": {"volts": 1}}, ["motor.volts", "supply_voltage"], id="a misspelt key"),
        ],
    )
    def test_it_is_one_line_that_names_it(
        self, command: Command, tmp_path: Path, changes: dict[str, Any], said: list[str]
    ) -> None:
        printed = command("simulate", file_of(tmp_path, **changes), "-o", "data")
        told = printed.stderr.splitlines()  # progress, and the line
        assert_refused(printed._replace(stderr=told[-1] + "\n"), *said)
        assert all(": " in line for line in told[:-1])
        assert not (tmp_path / "data").exists()

    def test_a_design_from_a_simulated_robot_asks_for_its_recordings(self, command: Command) -> None:
        assert_refused(command("design", CONFIGS / "apr02_robot.yaml"), "omnibench simulate", "folder")


def test_the_papers_experiment_is_36_commands_5_times_in_two_sessions() -> None:
    config = read_simulation(CONFIGS / "apr02_robot.yaml").config
    assert isinstance(config, RobotConfig)
    assert len(config.driven) == 36
    assert config.repetitions == 5
    assert config.validation is not None


def test_floor_and_slip_of_the_shipped_config_leave_about_the_papers_calibrated_cost() -> None:
    config = read_simulation(CONFIGS / "apr02_floor.yaml").config
    assert isinstance(config, RobotConfig)
    few = MotionGrid(directions_deg=(0, 60, 120, 180, 240, 300), turn_rates=(-0.35, 0.35))
    small = {"commands": few, "repetitions": 1, "validation": None}

    def calibrated(truth: Truth) -> float:
        effects = tuple(term for term in truth.effects if term.name != "tyre_wear")  # one session
        changes = {**small, "truth": truth.model_copy(update={"effects": effects})}
        result = calibrate(simulate_dataset(config.model_copy(update=changes), "robot").dataset).result
        assert result.cost is not None
        return result.cost

    assert calibrated(config.truth) == pytest.approx(0.0215, rel=0.2)
    assert calibrated(config.truth.model_copy(update={"effects": ()})) < 0.002


def test_the_schema_for_editors_knows_a_robot(command: Command) -> None:
    assert "RobotConfig" in command("schema", "simulate").stdout
