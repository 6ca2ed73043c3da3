"""Designs from configs and recordings: how good, against what, and what is refused."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import CONFIGS, RECORDINGS
from report_samples import APR02, flower

from omnibench.config import to_json, validate
from omnibench.data.dataset import Dataset, make_dataset
from omnibench.data.storage import save_dataset
from omnibench.design.candidates import candidates_of_dataset, read_candidates
from omnibench.design.config import DesignConfig
from omnibench.design.design import design_experiment
from omnibench.design.report.design_figures import equal_in_words
from omnibench.design.result import Design, SetDesign
from omnibench.errors import ConfigError, DataError, OmnibenchError
from omnibench.fit.information import information_of_runs
from omnibench.robot.kinematics import Array
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset

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
    assert equal.effort is not None
    assert equal.least is not None
    return equal.effort.runs, equal.least


@pytest.fixture(scope="module")
def papers() -> Design:
    """The 36 commands and the richer set, as delivered."""
    return design_experiment(CONFIGS / "design.yaml")


def information_of(path: Path, names: tuple[str, ...]) -> Array:
    """Information (C, 9, 9) of a run of some candidates, from every reference pose."""
    pool = read_candidates(path)
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


def test_the_richer_set_has_what_it_is_said_to_have(papers: Design) -> None:
    candidates = [papers.candidate(name) for name in set_of(papers, "richer").commands]
    assert {0.0, 0.1, 0.2, 0.4} == {each.speed for each in candidates}
    assert any(each.speed == 0 and each.turn_rate for each in candidates)
    assert max(abs(each.turn_rate or 0) for each in candidates) > 0.35
    assert max(each.distance_m for each in candidates) > 2 * 1.1


def test_an_equal_design_is_as_precise_as_the_baseline_and_one_run_less_is_not(papers: Design) -> None:
    runs, _ = runs_equal(papers, "flower", "trajectory")
    relative = {step.effort.runs: step.relative for step in set_of(papers, "flower").steps}
    assert relative[runs] <= 1 < relative[runs - 1]


def test_deviations_fall_with_the_root_of_the_runs(papers: Design) -> None:
    steps = {step.effort.runs: step for step in set_of(papers, "flower").steps}
    assert steps[12].relative == pytest.approx(steps[6].relative / math.sqrt(2), rel=1e-3)
    assert steps[12].row_percent == pytest.approx([value / math.sqrt(2) for value in steps[6].row_percent], rel=0.05)


def test_deviations_are_those_of_the_covariance_of_the_elements(papers: Design) -> None:
    found = set_of(papers, "flower")
    counts = {each.command: each.runs for each in found.chosen}
    information = information_of(CONFIGS / "design.yaml", tuple(counts))
    covariance = np.linalg.inv(np.tensordot(list(counts.values()), information, 1))
    deviations = np.sqrt(np.diagonal(covariance)).reshape(3, 3).max(axis=1)
    largest = np.abs(read_candidates(CONFIGS / "design.yaml").robot.inverse_kinematic_matrix).max(axis=1)
    assert found.step.row_percent == pytest.approx(100 * deviations / largest, rel=1e-6)


def test_the_list_of_steps_goes_from_what_identifies_the_matrix_to_the_baselines_size(papers: Design) -> None:
    assert [step.effort.runs for step in set_of(papers, "richer").steps] == list(range(3, 181))
    assert all(step.efficiency <= 1 + 1e-9 for found in papers.sets for step in found.steps)


def test_a_comparison_config_gives_the_commands_of_its_simulated_data() -> None:
    design = design_experiment(CONFIGS / "apr02.yaml")
    assert design.baseline.name == "36 commands of flower x 5"
    assert not design.recorded
    assert design.noise.bias_position == pytest.approx(0.993 * 0.0088)
    assert runs_equal(design, "flower", "final")[0] == 167


def test_four_wheels_are_designed_for_on_the_span_that_they_drive() -> None:
    design = design_experiment(CONFIGS / "mecanum.yaml")
    assert design.parameters == 9
    assert design.sets[0].reached
    assert design.baseline.precision.physical is None


def test_recordings_give_candidates_their_noise_and_their_baseline(tmp_path: Path) -> None:
    save_dataset(simulated(), tmp_path / "data")
    design = design_experiment(tmp_path / "data")
    assert (design.recorded, design.simulated) == (True, True)
    assert len(design.candidates) == 8
    assert design.baseline.precision.effort.runs == 24
    assert "of 8 commands" in design.noise_source
    assert design.noise.pose_position == pytest.approx(0.005, rel=0.3)
    assert design.sets[0].reached


def test_a_data_set_in_memory_is_designed_for_as_its_folder_is(tmp_path: Path) -> None:
    dataset = simulated()
    save_dataset(dataset, tmp_path / "data")
    chosen = [found.steps for found in design_experiment(dataset, runs=9).sets]
    assert chosen == [found.steps for found in design_experiment(tmp_path / "data", runs=9).sets]


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


def test_real_recordings_are_designed_for() -> None:
    if not (RECORDINGS / "optiodom").is_dir():
        pytest.skip(f"the recordings of optiodom are not at {RECORDINGS}")
    design = design_experiment(CONFIGS / "omni3.yaml")
    assert (design.recorded, design.simulated) == (True, False)
    assert design.sets[0].reached
    assert runs_equal(design, "optiodom", "trajectory")[0] < 44


def test_a_number_of_runs_can_be_asked_for(tmp_path: Path) -> None:
    design = design_experiment(written(tmp_path), runs=11)
    assert [found.step.effort.runs for found in design.sets] == [11, 11]
    assert sum(each.runs for each in design.sets[0].chosen) == 11


def test_repetitions_of_a_command_can_be_limited(tmp_path: Path) -> None:
    design = design_experiment(written(tmp_path), runs=10, repetitions=1)
    assert all(each.runs == 1 for found in design.sets for each in found.chosen)
    equal = {found.name: found.equivalents[1] for found in design.sets}
    assert equal["star"].effort is None
    assert equal["star"].least is not None


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
        assert long.effort is not None
        assert short.effort is not None
        assert short.effort.seconds < long.effort.seconds
        assert short.effort.runs > long.effort.runs
        assert short.least is not None
        assert short.least <= short.effort.seconds


def test_way_of_the_wheels_can_be_spared_too(tmp_path: Path) -> None:
    design = design_experiment(written(tmp_path), per="metre")
    effort = design.baseline.precision.effort
    assert runs_equal(design, "star", "trajectory")[1] < effort.wheel_metres
    assert effort.metres == pytest.approx(12 * 2 * 1.0)
    assert set_of(design, "more").step.effort.wheel_metres > 0


def test_the_document_holds_everything_but_the_drawings(papers: Design) -> None:
    document = json.loads(to_json(papers))
    assert set(document["candidates"][0]) == {
        "name", "speed", "direction", "turn_rate", "duration_s", "distance_m", "rolled_m",
    }  # fmt: skip
    assert [found["name"] for found in document["sets"]] == ["flower", "richer"]
    assert document["noise_source"] == "assumed: as the config says"


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"sets": {"star": {"speeds": [0.2], "directions_deg": [0, 90], "turn_rates": [0], "distance": 1}}},
         ("star", "a + b + c (turning on the spot)", "add commands")),
        ({"sets": {"star": [{"speed": 0, "turn_rate": rate, "duration": 6} for rate in (-1, 1)]}},
         ("star", "moving along x", "moving along y")),
        ({"sets": {"star": [{"speed": 0.2, "turn_rate": 1, "duration": 6}]}}, ("star", "one command only")),
        ({"noise": {"pose_position": 0.01}}, ("noise", "heading")),
        ({"baseline": {"set": "stars"}}, ("baseline: unknown set 'stars'; did you mean 'star'?",)),
        ({"sets": {"star": [{"set": "sta"}]}}, ("sets.star: unknown set 'sta'; did you mean 'star'?",)),
        ({"sets": {"star": [{"set": "other"}], "other": [{"set": "star"}]}}, ("sets.", "includes")),
        ({"sets": {"star": {"directions_deg": [0], "turn_rates": [0]}}}, ("distance (m) or duration",)),
        ({"sets": {"star": [{"speed": 1, "duration": 2, "direction": 3}]}}, ("did you mean 'direction_deg'?",)),
        ({"sets": {"star": [{"speed": 0, "duration": 2}]}}, ("does not move the robot",)),
        ({"sets": {"star": []}}, ("sets.star: no command moves the robot",)),
        ({"sets": {"star": [{"speed": 1, "duration": 1e9}]}}, ("sets.star", "durations and periods")),
        ({"sets": ["star"]}, ("sets",)),
    ],
)  # fmt: skip
def test_a_config_that_cannot_be_is_refused_in_a_line(
    tmp_path: Path, changes: dict[str, Any], parts: tuple[str, ...]
) -> None:
    with pytest.raises(ConfigError) as refused:
        design_experiment(written(tmp_path, **changes))
    for part in (str(tmp_path / "small.yaml"), *parts):
        assert part in str(refused.value)


def test_final_poses_of_full_turns_are_said_to_leave_the_matrix_undetermined(tmp_path: Path) -> None:
    turn = {"turn_rate": math.tau / 6, "duration": 6}
    turns = [
        {"speed": 0.2, "direction_deg": 0, **turn},
        {"speed": 0.2, "direction_deg": 90, **turn},
        {"speed": 0, **turn},
    ]
    path = written(tmp_path, sets={"star": turns})
    with pytest.raises(ConfigError, match="the final poses of star leave row 1 of the matrix undetermined along"):
        design_experiment(path, use="final")
    design = design_experiment(path, use="trajectory")
    assert equal_in_words(design, set_of(design, "star"), "final").startswith("none: they leave part")
    assert set_of(design, "star").reached


def test_recordings_that_never_turn_are_refused_and_the_motion_is_named() -> None:
    straight = simulated(commands={"directions_deg": [0, 45, 90, 135], "turn_rates": [0.0]})
    with pytest.raises(DataError, match=r"a \+ b \+ c \(turning on the spot\).*add commands that do"):
        candidates_of_dataset(straight)


def test_turns_as_slow_as_slip_may_make_them_do_not_count() -> None:
    straight = simulated(commands={"directions_deg": [0, 45, 90, 135], "turn_rates": [0.02]})
    with pytest.raises(DataError, match="turning on the spot"):
        candidates_of_dataset(straight)


@pytest.mark.parametrize(
    ("fields", "words"),
    [({"command": None}, "no training run has a command"), ({"command": "only"}, "only is its only command")],
)
def test_recordings_without_a_choice_of_commands_are_refused(fields: dict[str, Any], words: str) -> None:
    with pytest.raises(DataError, match=words):
        candidates_of_dataset(without(simulated(), **fields))


def test_runs_without_a_command_are_left_out_and_said_so() -> None:
    dataset = simulated()
    runs = [replace(run, command=None) if index < 2 else run for index, run in enumerate(dataset.trajectories)]
    pool = candidates_of_dataset(make_dataset("some", dataset.robot, dataset.sample_period, runs))
    assert pool.baseline.sum() == len(runs) - 2
    assert any("2 of 24 training runs" in note for note in pool.notes)


def test_recordings_without_noise_are_refused() -> None:
    with pytest.raises(DataError, match="without any noise"):
        candidates_of_dataset(simulated(noise={}))


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ({"use": "finals"}, ("unknown use 'finals'; did you mean 'final'?",)),
        ({"per": "hour"}, ("unknown per 'hour'", "metre, run, second")),
        ({"runs": 0}, ("runs: must be a whole number, from 1",)),
        ({"repetitions": -1}, ("repetitions: must be a whole number, from 1",)),
        ({"runs": 2}, ("star: 2 runs cannot", "from 3 to")),
        ({"runs": 13, "repetitions": 1}, ("star: 13 runs cannot", "to 12 can")),
        ({"dataset": "flower"}, ("--dataset", "small.yaml is none")),
    ],
)
def test_arguments_that_cannot_be_are_refused(
    tmp_path: Path, arguments: dict[str, Any], parts: tuple[str, ...]
) -> None:
    with pytest.raises(OmnibenchError) as refused:
        design_experiment(written(tmp_path), **arguments)
    for part in parts:
        assert part in str(refused.value)


def test_a_comparison_with_several_data_sets_needs_a_choice(tmp_path: Path) -> None:
    config = {
        "name": "two",
        "datasets": {name: {"simulate": flower()} for name in ("one", "two")},
        "calibrators": ["theoretical"],
    }
    (tmp_path / "two.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    with pytest.raises(ConfigError, match="choose one with --dataset: one, two"):
        design_experiment(tmp_path / "two.yaml")
    assert design_experiment(tmp_path / "two.yaml", dataset="two").sets[0].name == "two"
    with pytest.raises(ConfigError, match="did you mean 'two'"):
        design_experiment(tmp_path / "two.yaml", dataset="twoo")


def test_a_source_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OmnibenchError, match="no such file"):
        design_experiment(tmp_path / "nothing")


def test_a_command_with_two_durations_is_two_candidates() -> None:
    sets = {"two": [{"speed": 0.2, "turn_rate": 0.3, "duration": seconds} for seconds in (3, 6, 6.0)]}
    config = validate(DesignConfig, small(sets=sets, baseline={"set": "two"}), "small")
    assert [each.duration for each in config.commands("two")] == [3, 6]
