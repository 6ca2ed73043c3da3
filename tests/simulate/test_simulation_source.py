"""Which simulated data set of a YAML is meant, what may be added to it, and recordings that a model drives again."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import CONFIGS, Command, Prepared, assert_refused, flower, refused, small, write_effect

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.storage import load_dataset
from omnibench.errors import ConfigError, DataError, OmnibenchError
from omnibench.robot.calibration import Calibration, EffectTerm, Noise, matrix_rows
from omnibench.simulate.simulation_request import simulate_like
from omnibench.simulate.source import read_simulation
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
