"""Designs for a robot alone: runs within its limits and the room, words to drive by, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from commands import Command
from config_robots import NAMES, robot, settings

from omnibench.config import validate
from omnibench.design.candidates import CandidatePool, RobotCommands, RobotOptions, candidates_of_config, design_source
from omnibench.design.config import DesignConfig
from omnibench.design.design import design_experiment
from omnibench.design.report.design_figures import plan_in_words
from omnibench.errors import ConfigError

AREA = (4.5, 3.5)


def file_of(folder: Path, name: str) -> Path:
    file = folder / f"{name}.yaml"
    file.write_text(yaml.safe_dump(settings(name)["robot"]), encoding="utf-8")
    return file


def pool_of(name: str, **limits: object) -> CandidatePool:
    return RobotCommands.model_validate({"robot": robot(name), "area": AREA, **limits}).pool(name)


@pytest.mark.parametrize("name", NAMES)
def test_candidates_stay_within_speed_wheels_steering_and_the_area(name: str) -> None:
    limits = {"max_speed": 0.4, "max_turn_rate": 0.8, "max_wheel_rate": 9.0}
    pool = pool_of(name, **limits)
    half = max(math.hypot(*wheel.position) + wheel.radius for wheel in pool.robot.wheels)
    turns = np.exp(1j * np.radians(np.arange(0, 180, 7.5)))[:, None]
    for candidate in pool.candidates:
        (run,) = candidate.runs
        assert (run.v or 0) <= 0.4
        assert abs(run.omega or 0) <= 0.8
        assert np.abs(run.rates).max() <= 9.0 + 1e-9
        assert candidate.duration <= 60.1
        if run.steering is not None:
            assert np.degrees(np.abs(run.steering)).max() <= {"tricycle": 80, "car": 35, "swerve": 90}[name] + 1e-4
        places = (run.poses[:, 0] + 1j * run.poses[:, 1]) * turns
        sides = np.ptp(places.real, axis=1), np.ptp(places.imag, axis=1)
        assert ((sides[0] <= AREA[0] - 2 * half + 0.01) & (sides[1] <= AREA[1] - 2 * half + 0.01)).any()


@pytest.mark.parametrize("name", ["diff", "tricycle", "car"])
def test_a_few_runs_are_chosen_and_told_as_a_person_drives_them(name: str) -> None:
    design = design_experiment(pool_of(name))
    (chosen,) = design.sets
    assert chosen.reached
    assert not design.recorded
    assert design.parameters == 6
    plan = plan_in_words(design, chosen)
    assert any(
        line.startswith("forward ") and ", turning left by " in line and " with radius " in line for line in plan
    )
    assert any(line.startswith("backward ") for line in plan)
    assert any(line.startswith("on the spot 3 full turns to the ") for line in plan) == (name == "diff")
    assert all(line.endswith((" time", " times")) for line in plan)
    assert [each.motion for each in chosen.step.motions] == ["1 m", "a full turn"]


def test_what_the_matrix_leaves_grows_with_the_noise_of_the_reference() -> None:
    noise = {"pose_position": 0.005, "pose_heading": 0.005}
    once, twice = (
        design_experiment(pool_of("diff", noise={key: scale * value for key, value in noise.items()}), runs=6)
        for scale in (1, 2)
    )
    for small, large in zip(once.sets[0].step.motions, twice.sets[0].step.motions, strict=True):
        assert large.position_mm == pytest.approx(2 * small.position_mm)
        assert large.heading_deg == pytest.approx(2 * small.heading_deg)


def test_the_command_prints_what_to_drive_and_how_precise_it_will_be(command: Command, tmp_path: Path) -> None:
    printed = command(
        "design", "--robot", file_of(tmp_path, "swerve"), "--max-speed", 0.5, "--area", "3x3", "--runs", 8,
        "--position-noise", 0.01, "-o", "design",
    ).stdout  # fmt: skip
    assert "What to drive:\n  forward " in printed
    assert "sideways to the left " in printed
    assert "Calibrated from these runs, the matrix leaves an error of" in printed
    assert "noise assumed: 10 mm and 0.29 deg of each reference pose" in printed
    report = Path("design/report.html").read_text(encoding="utf-8")
    assert 0 < report.index("<h4>What to drive</h4>") < report.index("<h2>Chosen commands")


def test_a_design_config_lists_commands_for_a_robot_that_steers_within_its_limit() -> None:
    given = {
        "name": "car",
        "robot": settings("car")["robot"],
        "noise": {"pose_position": 0.005, "pose_heading": 0.005},
        "sets": {"curves": {"speeds": [0.5], "turn_rates": [-0.3, 0, 0.3], "distance": 2}},
        "baseline": {"set": "curves"},
    }
    design = design_experiment(candidates_of_config(DesignConfig.model_validate(given)))
    assert (len(design.candidates), design.parameters) == (6, 6)
    with pytest.raises(ConfigError, match=r"sets.curves: v0.5_a0_w-0.3 needs more than steering_limit_deg 15"):
        validate(DesignConfig, given | {"steering_limit_deg": 15}, "car.yaml")


REFUSED: dict[str, tuple[str, dict[str, object], str]] = {
    "an area in words": ("diff", {"area": "3by3"}, "--area 3by3: give two sides in m, like --area 3x2.5"),
    "an area without floor": ("diff", {"area": "0x3"}, "--area 0x3: give two sides in m"),
    "an area for no robot": ("diff", {"area": "0.5x3"}, "--area 0.5x3: the robot alone takes 0.4 m; give both sides"),
    "a speed beyond the wheels": (
        "diff",
        {"max_speed": 5.0, "max_wheel_rate": 20.0},
        "--max-speed 5: at --max-wheel-rate 20 rad/s the wheels drive at most 1 m/s",
    ),
    "a speed backward": ("diff", {"max_speed": -1.0}, "--max-speed -1: must be above 0"),
    "a steering limit of no steering": ("diff", {"steering_limit": 30.0}, "--steering-limit: no wheel of this robot"),
    "a room in which a car cannot turn": (
        "car",
        {"area": "2x2"},
        "no curve that it can drive within 60 s fits an area",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused_by_the_name_of_its_option(case: str, tmp_path: Path) -> None:
    name, given, words = REFUSED[case]
    with pytest.raises(ConfigError) as refusal:
        design_source(None, file_of(tmp_path, name), RobotOptions(**given))  # type: ignore[arg-type]
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_robot_and_a_recording_exclude_each_other() -> None:
    file = Path("robot.yaml")
    with pytest.raises(ConfigError, match=r"--robot robot.yaml: designs without data; give one of them"):
        design_source(Path("data"), file, RobotOptions())
    with pytest.raises(ConfigError, match=r"--max-speed: is for --robot FILE"):
        design_source(Path("data"), None, RobotOptions(max_speed=1.0))
    with pytest.raises(ConfigError, match=r"name a DATASET or a CONFIG, or a robot's file with --robot FILE"):
        design_source(None, None, RobotOptions())
