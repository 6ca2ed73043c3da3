"""Designs from configs, recordings and robots alone: how good, against what, and what is refused."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import CONFIGS, RECORDINGS, Command, refused
from config_robots import NAMES, robot, settings
from lanes import slow
from report_samples import APR02, flower

from omnibench.config import validate
from omnibench.data.dataset import Dataset, make_dataset
from omnibench.data.storage import save_dataset
from omnibench.design import candidates
from omnibench.design.candidates import DesignConfig
from omnibench.design.design import Design, SetDesign, design_experiment
from omnibench.design.report import what_to_drive
from omnibench.errors import ConfigError, DataError, OmnibenchError
from omnibench.fit.trajectory_fit import information_of_runs
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import simulate_dataset

NOISE = {"pose_position": 0.005, "pose_heading": 0.005, "bias_position": 0.008, "bias_heading": 0.008}


def small(**changes: Any) -> dict[str, Any]:
    """A design config with few candidates."""
    return {
        "name": "small",
        "robot": APR02,
        "sample_period": 0.05,
        "noise": NOISE,
        "sets": {
            "star": {
                "speeds": [0.2],
                "directions_deg": [0, 90, 180, 270],
                "turn_rates": [-0.35, 0, 0.35],
                "distance": 1,
            },
            "more": [{"set": "star"}, {"speed": 0, "turn_rate": 1.0, "duration": 6}],
        },
        "baseline": {"set": "star", "repetitions": 2},
        **changes,
    }


def written(folder: Path, **changes: Any) -> Path:
    file = folder / "small.yaml"
    file.write_text(yaml.safe_dump(small(**changes), sort_keys=False), encoding="utf-8")
    return file


def simulated(**changes: Any) -> Dataset:
    config = flower(**{"noise": {**NOISE, "encoder": 0.02}, "repetitions": 3, **changes})
    config.pop("validation")
    return simulate_dataset(FlowerConfig.model_validate(config)).dataset


def without(dataset: Dataset, **fields: Any) -> Dataset:
    """The data set with fields of its trajectories replaced."""
    runs = [replace(run, **fields) for run in dataset.trajectories]
    return make_dataset(dataset.name, dataset.robot, dataset.sample_period, runs)


def set_of(design: Design, name: str) -> SetDesign:
    return next(found for found in design.sets if found.name == name)


def runs_equal(design: Design, name: str, use: str) -> tuple[int, float]:
    """Runs that equal the baseline, and the bound."""
    equal = next(each for each in set_of(design, name).equivalents if each.use == use)
    return equal.effort.runs, equal.least


@pytest.fixture(scope="module")
def papers() -> Design:
    """The 36 commands and the richer set, as delivered."""
    return design_experiment(CONFIGS / "design.yaml")


def information_of(path: Path, names: tuple[str, ...]) -> Array:
    """Information (C, 9, 9) of a run of some candidates, from every reference pose."""
    pool = candidates.read_candidates(path)
    runs = {each.name: each.runs[0] for each in pool.candidates}
    matrix = pool.robot.inverse_kinematic_matrix
    return information_of_runs([runs[name] for name in names], matrix, pool.integration, pool.noise)


@pytest.mark.parametrize("name", ["flower", "richer"])
def test_the_chosen_set_is_within_1_percent_of_the_d_optimum(papers: Design, name: str) -> None:
    """By the theorem of Kiefer and Wolfowitz, worked out here from the shares that the design reports."""
    found = set_of(papers, name)
    information = information_of(CONFIGS / "design.yaml", found.commands)
    shares = np.array([found.optimum.shares.get(command, 0.0) for command in found.commands])
    moment = np.tensordot(shares / shares.sum(), information, 1)
    gains = [np.linalg.solve(moment, each).trace() for each in information]
    bound = math.exp(np.linalg.slogdet(moment)[1] / 9) * max(gains) / 9
    counts = np.array([{each.command: each.runs for each in found.chosen}.get(name, 0) for name in found.commands])
    reached = math.exp(np.linalg.slogdet(np.tensordot(counts, information, 1))[1] / 9) / counts.sum()
    assert found.reached
    assert reached >= 0.99 * bound
    assert max(gains) / 9 <= 1.005
    assert found.step.efficiency == pytest.approx(reached / bound, rel=0.005)


def test_about_167_runs_of_the_36_commands_equal_the_papers_180_by_their_final_poses(papers: Design) -> None:
    assert papers.baseline.precision.effort.runs == 180
    assert len(set_of(papers, "flower").commands) == 36
    runs, least = runs_equal(papers, "flower", "final")
    assert (runs, math.ceil(least)) == (167, 167)


@pytest.mark.parametrize("use", ["final", "trajectory"])
def test_a_richer_set_needs_fewer_runs(papers: Design, use: str) -> None:
    few, least = runs_equal(papers, "richer", use)
    many, _ = runs_equal(papers, "flower", use)
    assert least <= few < 0.6 * many
    assert few <= least + 2


def test_an_equal_design_is_as_precise_as_the_baseline_and_one_run_less_is_not(papers: Design) -> None:
    runs, _ = runs_equal(papers, "flower", "trajectory")
    relative = {step.effort.runs: step.relative for step in set_of(papers, "flower").steps}
    assert relative[runs] <= 1 < relative[runs - 1]
    assert [step.effort.runs for step in set_of(papers, "richer").steps] == list(range(3, 181))
    assert all(step.efficiency <= 1 + 1e-9 for found in papers.sets for step in found.steps)


def test_deviations_are_those_of_the_covariance_of_the_elements(papers: Design) -> None:
    found = set_of(papers, "flower")
    counts = {each.command: each.runs for each in found.chosen}
    information = information_of(CONFIGS / "design.yaml", tuple(counts))
    covariance = np.linalg.inv(np.tensordot(list(counts.values()), information, 1))
    deviations = np.sqrt(np.diagonal(covariance)).reshape(3, 3).max(axis=1)
    largest = np.abs(candidates.read_candidates(CONFIGS / "design.yaml").robot.inverse_kinematic_matrix).max(axis=1)
    assert found.step.row_percent == pytest.approx(100 * deviations / largest, rel=1e-6)


def test_four_wheels_are_designed_for_on_the_span_that_they_drive() -> None:
    design = design_experiment(CONFIGS / "mecanum.yaml")
    assert design.parameters == 9
    assert design.sets[0].reached
    assert design.baseline.precision.physical is None


def test_recordings_give_candidates_their_noise_and_their_baseline(tmp_path: Path) -> None:
    save_dataset(simulated(), tmp_path / "data")
    design = design_experiment(tmp_path / "data")
    in_memory = design_experiment(simulated())
    assert [found.steps for found in in_memory.sets] == [found.steps for found in design.sets]
    assert (design.recorded, design.simulated) == (True, True)
    assert len(design.candidates) == 8
    assert design.baseline.precision.effort.runs == 24
    assert "of 8 commands" in design.noise_source
    assert design.noise.pose_position == pytest.approx(0.005, rel=0.3)
    assert design.sets[0].reached


@pytest.mark.slow
def test_recordings_tell_the_same_as_the_config_that_they_were_simulated_from(tmp_path: Path) -> None:
    """But for the estimate of the noise model; encoder noise would add to the walk."""
    changes = {"noise": NOISE, "repetitions": 20}
    config = {"name": "same", "datasets": {"flower": {"simulate": flower(**changes)}}, "calibrators": ["theoretical"]}
    (tmp_path / "same.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    save_dataset(simulated(**changes), tmp_path / "data")
    assumed, recorded = design_experiment(tmp_path / "same.yaml"), design_experiment(tmp_path / "data")
    for use in ("final", "trajectory"):
        assert runs_equal(recorded, "flower", use)[1] == pytest.approx(runs_equal(assumed, "flower", use)[1], rel=0.02)
    assert recorded.baseline.precision.row_percent == pytest.approx(assumed.baseline.precision.row_percent, rel=0.15)


@pytest.mark.slow
def test_real_recordings_are_designed_for() -> None:
    if not (RECORDINGS / "optiodom").is_dir():
        pytest.skip(f"the recordings of optiodom are not at {RECORDINGS}")
    design = design_experiment(CONFIGS / "omni3.yaml")
    assert (design.recorded, design.simulated) == (True, False)
    assert design.sets[0].reached
    assert runs_equal(design, "optiodom", "trajectory")[0] < 44


def test_repetitions_of_a_command_can_be_limited(tmp_path: Path) -> None:
    design = design_experiment(written(tmp_path), runs=10, repetitions=1)
    assert all(each.runs == 1 for found in design.sets for each in found.chosen)
    equal = {found.name: found.equivalents[1] for found in design.sets}
    assert equal["star"].effort is None
    assert equal["star"].least is not None


@pytest.mark.slow
def test_time_is_saved_when_information_per_second_is_asked_for(tmp_path: Path) -> None:
    grid = {"directions_deg": [0, 60, 120, 180, 240, 300], "turn_rates": [-0.35, 0.35]}
    slow = [{**grid, "speeds": [0.1, 0.2], "distance": length} for length in (1, 2)]
    config = written(
        tmp_path,
        sets={"slow": slow, "all": [{"set": "slow"}, {**grid, "speeds": [0.4], "distance": 1}]},
        baseline={"set": "slow", "repetitions": 1},
    )
    by_run, by_time = (design_experiment(config, per=per) for per in ("run", "second"))
    for use in (0, 1):
        long, short = (set_of(design, "all").equivalents[use] for design in (by_run, by_time))
        assert short.effort.seconds < long.effort.seconds
        assert short.effort.runs > long.effort.runs
        assert short.least <= short.effort.seconds


def test_way_of_the_wheels_can_be_spared_too(tmp_path: Path) -> None:
    design = design_experiment(written(tmp_path), per="metre")
    effort = design.baseline.precision.effort
    assert runs_equal(design, "star", "trajectory")[1] < effort.wheel_metres
    assert effort.metres == pytest.approx(12 * 2 * 1.0)
    assert set_of(design, "more").step.effort.wheel_metres > 0


SPOTS = [{"speed": 0, "turn_rate": rate, "duration": 6} for rate in (-1, 1)]


def star(*commands: dict[str, Any], **others: Any) -> dict[str, Any]:
    return {"sets": {"star": list(commands), **others}}


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        (star({"speeds": [0.2], "directions_deg": [0, 90], "turn_rates": [0], "distance": 1}), "star a + b + c"),
        (star(*SPOTS), "star x y"),
        (star({"speed": 0.2, "turn_rate": 1, "duration": 6}), "star one command"),
        ({"noise": {"pose_position": 0.01}}, "noise heading"),
        ({"baseline": {"set": "stars"}}, "baseline: 'stars' 'star'"),
        (star({"set": "sta"}), "sets.star: 'sta' 'star'"),
        (star({"set": "other"}, other=[{"set": "star"}]), "sets. includes"),
        (star({"directions_deg": [0], "turn_rates": [0]}), "distance duration"),
        (star({"speed": 1, "duration": 2, "direction": 3}), "'direction_deg'"),
        (star({"speed": 0, "duration": 2}), "move"),
        (star(), "sets.star:"),
        (star({"speed": 1, "duration": 1e9}), "sets.star durations"),
        ({"sets": ["star"]}, "sets"),
    ],
)
def test_a_config_that_cannot_be_is_refused_in_a_line(tmp_path: Path, changes: dict[str, Any], parts: str) -> None:
    with refused(ConfigError, str(tmp_path / "small.yaml"), *parts.split()):
        design_experiment(written(tmp_path, **changes))


def test_final_poses_of_full_turns_are_said_to_leave_the_matrix_undetermined(tmp_path: Path) -> None:
    turn = {"turn_rate": math.tau / 6, "duration": 6}
    turns = [
        {"speed": 0.2, "direction_deg": 0, **turn},
        {"speed": 0.2, "direction_deg": 90, **turn},
        {"speed": 0, **turn},
    ]
    path = written(tmp_path, sets={"star": turns})
    with pytest.raises(ConfigError, match=r"the final poses of star leave row [12] of the matrix undetermined along"):
        design_experiment(path, use="final")
    design = design_experiment(path, use="trajectory")
    assert set_of(design, "star").equivalents[0].least is None
    assert set_of(design, "star").reached


@pytest.mark.parametrize(
    ("changes", "fields", "words"),
    [
        ({"commands": {"directions_deg": [0, 45, 90, 135], "turn_rates": [0.0]}}, {}, "turning on the spot"),
        # As slow as slip may make them.
        ({"commands": {"directions_deg": [0, 45, 90, 135], "turn_rates": [0.02]}}, {}, "turning on the spot"),
        ({"noise": {}}, {}, "without any noise"),
        ({}, {"command": None}, "no training run has a command"),
        ({}, {"command": "only"}, "only is its only command"),
    ],
)
def test_recordings_without_a_choice_are_refused(changes: dict[str, Any], fields: dict[str, Any], words: str) -> None:
    with pytest.raises(DataError, match=words):
        candidates.candidates_of_dataset(without(simulated(**changes), **fields))


def test_runs_without_a_command_are_left_out_and_said_so() -> None:
    dataset = simulated()
    runs = [replace(run, command=None) if index < 2 else run for index, run in enumerate(dataset.trajectories)]
    pool = candidates.candidates_of_dataset(make_dataset("some", dataset.robot, dataset.sample_period, runs))
    assert pool.baseline.sum() == len(runs) - 2
    assert any("2 of 24 training runs" in note for note in pool.notes)


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ({"use": "finals"}, "'finals' 'final'"),
        ({"per": "hour"}, "'hour' metre, run, second"),
        ({"runs": 0}, "runs:"),
        ({"repetitions": -1}, "repetitions:"),
        ({"runs": 2}, "star: 2 3"),
        ({"runs": 13, "repetitions": 1}, "star: 13 12"),
        ({"dataset": "flower"}, "--dataset small.yaml"),
    ],
)
def test_arguments_that_cannot_be_are_refused(tmp_path: Path, arguments: dict[str, Any], parts: str) -> None:
    with refused(OmnibenchError, *parts.split()):
        design_experiment(written(tmp_path), **arguments)


def test_a_source_must_be_there_and_one_with_several_data_sets_needs_a_choice(tmp_path: Path) -> None:
    sets = {name: {"simulate": flower()} for name in ("one", "two")}
    config = {"name": "two", "datasets": sets, "calibrators": ["theoretical"]}
    (tmp_path / "two.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    with pytest.raises(OmnibenchError, match="no such file"):
        design_experiment(tmp_path / "nothing")
    with pytest.raises(ConfigError, match="--dataset: one, two"):
        design_experiment(tmp_path / "two.yaml")
    assert design_experiment(tmp_path / "two.yaml", dataset="two").sets[0].name == "two"
    with pytest.raises(ConfigError, match="did you mean 'two'"):
        design_experiment(tmp_path / "two.yaml", dataset="twoo")


def test_a_command_with_two_durations_is_two_candidates() -> None:
    sets = {"two": [{"speed": 0.2, "turn_rate": 0.3, "duration": seconds} for seconds in (3, 6, 6.0)]}
    config = validate(DesignConfig, small(sets=sets, baseline={"set": "two"}), "small")
    assert [each.duration for each in config.commands("two")] == [3, 6]


AREA = "4.5x3.5"
SIDES = (4.5, 3.5)  # m


def file_of(folder: Path, name: str) -> Path:
    file = folder / f"{name}.yaml"
    file.write_text(yaml.safe_dump(settings(name)["robot"]), encoding="utf-8")
    return file


def pool_of(name: str, **limits: object) -> candidates.CandidatePool:
    config = candidates.RobotLimits.model_validate({"area": AREA, **limits}).config(robot(name), name)
    return candidates.candidates_of_config(config)


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
        assert ((sides[0] <= SIDES[0] - 2 * half + 0.01) & (sides[1] <= SIDES[1] - 2 * half + 0.01)).any()


@pytest.mark.parametrize("name", ["diff", *slow("tricycle", "car")])
def test_a_few_runs_are_chosen_and_told_as_a_person_drives_them(name: str) -> None:
    design = design_experiment(pool_of(name))
    (chosen,) = design.sets
    assert chosen.reached
    assert not design.recorded
    assert design.parameters == 6
    plan = what_to_drive(design, chosen)
    assert any(row.startswith("forward ") and ", turning left by " in row and " with radius " in row for row in plan)
    assert any(line.startswith("backward ") for line in plan)
    assert any(line.startswith("on the spot 3 full turns to the ") for line in plan) == (name == "diff")
    assert all(line.endswith((" time", " times")) for line in plan)
    assert [each.motion for each in chosen.step.motions] == ["1 m", "a full turn"]


def test_what_the_matrix_leaves_grows_with_the_noise_of_the_reference() -> None:
    once, twice = (
        design_experiment(replace(pool_of("diff"), noise=Noise(pose_position=size, pose_heading=size)), runs=6)
        for size in (0.005, 0.01)
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
    assert "noise assumed: positions white 10 mm, walk 3.0 mm/√s, headings white 0.29°" in printed
    report = Path("design/report.html").read_text(encoding="utf-8")
    assert 0 < report.index("<h4>What to drive of ") < report.index("<h2>Chosen commands")


def test_a_design_config_lists_commands_for_a_robot_that_steers_within_its_limit() -> None:
    given = {
        "name": "car",
        "robot": settings("car")["robot"],
        "noise": {"pose_position": 0.005, "pose_heading": 0.005},
        "sets": {"curves": {"speeds": [0.5], "turn_rates": [-0.3, 0, 0.3], "distance": 2}},
        "baseline": {"set": "curves"},
    }
    design = design_experiment(candidates.candidates_of_config(DesignConfig.model_validate(given)))
    assert (len(design.candidates), design.parameters) == (6, 6)
    with pytest.raises(ConfigError, match=r"sets.curves: v0.5_a0_w-0.3 needs more than steering_limit_deg 15"):
        validate(DesignConfig, given | {"steering_limit_deg": 15}, "car.yaml")


@pytest.mark.parametrize(
    ("name", "given", "words"),
    [
        ("diff", {"area": "3by3"}, "--area 3by3"),
        ("diff", {"area": "0x3"}, "--area 0x3"),
        ("diff", {"area": "0.5x3"}, "--area 0.5x3: the robot alone takes 0.4 m"),
        ("diff", {"max_speed": 5.0, "max_wheel_rate": 20.0}, "--max-speed 5: at --max-wheel-rate 20 rad/s"),
        ("diff", {"max_speed": -1.0}, "max_speed: Input should be greater than 0"),
        ("diff", {"steering_limit": 30.0}, "--steering-limit"),
        ("car", {"area": "2x2"}, "no curve that it can drive"),
    ],
)
def test_what_cannot_be_is_refused_by_name(name: str, given: dict[str, object], words: str, tmp_path: Path) -> None:
    with refused(ConfigError, words):
        candidates.DesignRequest(robot=file_of(tmp_path, name), limits=given).candidates()


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ({"source": "data", "robot": "robot.yaml"}, "--robot robot.yaml"),
        ({"source": "data", "limits": {"max_speed": 1.0}}, "--max-speed"),
        ({}, "--robot FILE"),
    ],
)
def test_a_robot_excludes_a_recording(given: dict[str, Any], name: str) -> None:
    with pytest.raises(ConfigError, match=name):
        candidates.DesignRequest(**given).candidates()
