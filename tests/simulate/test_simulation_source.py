"""Which simulated data set of a YAML is meant, and what may be added to it; the command that makes data sets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from commands import CONFIGS, Command, Prepared, assert_refused, flower, small

from omnibench.data.storage import load_dataset
from omnibench.errors import ConfigError, OmnibenchError
from omnibench.robot.calibration import EffectTerm
from omnibench.simulate.simulate import simulate_dataset
from omnibench.simulate.source import read_simulation

DRIFT = "heading_drift: {b: 0.01}"
PLUGIN = """
import numpy as np
from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Parameter


@effects.register("side_wind")
class SideWind(MotionEffect):
    '''Wind from the left.'''

    stage = "world"
    physics = "Wind."
    source = "first principles"
    shows_in = "heading"

    def parameters(self, robot, sessions=()):
        return (Parameter("v", "m/s", -0.01, 0.01, "wind"),)

    def correction(self, signals, values):
        return np.tile([0.0, values["v"]], (len(signals.durations), 1))
"""


def write(folder: Path, **content: Any) -> Path:
    file = folder / "simulation.yaml"
    file.write_text(yaml.safe_dump(content))
    return file


def only(folder: Path, **changes: Any) -> Path:
    """A config of one simulated data set, and no comparison."""
    return write(folder, name="mine", description="Hidden.", datasets={"flower": {"simulate": flower(**changes)}})


class TestReading:
    def test_a_comparison_and_a_config_of_data_sets_alone_are_read_alike(self, tmp_path: Path) -> None:
        alone = read_simulation(only(tmp_path))
        compared = read_simulation(write(tmp_path, **small(description="Hidden.")))
        assert (alone.name, alone.description) == ("flower", "Hidden.")
        assert alone == compared

    def test_one_of_several_is_chosen_by_its_name(self, tmp_path: Path) -> None:
        sets = {name: {"simulate": flower(train={"seed": 1, "distance": way})} for name, way in (("a", 1), ("b", 2))}
        file = write(tmp_path, datasets=sets)
        assert [read_simulation(file, name).config.train.distance for name in "ab"] == [1, 2]
        with pytest.raises(ConfigError, match="several simulated data sets; choose one with --dataset: a, b"):
            read_simulation(file)

    def test_a_misspelt_key_of_a_config_without_a_comparison_is_refused(self, tmp_path: Path) -> None:
        file = write(tmp_path, descripton="x", datasets={"flower": {"simulate": flower()}})
        with pytest.raises(ConfigError, match=r"unknown key 'descripton'; did you mean 'description'\?"):
            read_simulation(file)

    def test_folders_of_plugins_are_beside_the_config_and_matter_for_effects_alone(self, tmp_path: Path) -> None:
        file = write(tmp_path, plugins=["mine"], datasets={"flower": {"simulate": flower()}})
        source = read_simulation(file)
        assert source.effect_plugins == ()
        assert source.with_effects([DRIFT]).effect_plugins == (tmp_path.resolve() / "mine",)

    @pytest.mark.parametrize(
        ("config", "name"), [("apr02", "flower"), ("mecanum", "mecanum"), ("hidden_effect", "hidden")]
    )
    def test_the_simulated_data_sets_of_the_configs_are_found(self, config: str, name: str) -> None:
        assert read_simulation(CONFIGS / f"{config}.yaml").name == name


class TestEffectsOfTheCommandLine:
    def test_they_are_hidden_beside_those_of_the_config(self, tmp_path: Path) -> None:
        hidden = {"published": "palacin2023_eq8", "effects": [{"name": "floor_drift", "parameters": {"dx": 0.01}}]}
        source = read_simulation(only(tmp_path, truth=hidden)).with_effects([DRIFT, "motor_gain: {g: 0.1}"])
        assert [term.name for term in source.config.truth.effects] == ["floor_drift", "heading_drift", "motor_gain"]
        assert source.simulate().truth.effects[1] == EffectTerm(name="heading_drift", parameters={"b": 0.01})

    def test_without_any_nothing_changes(self, tmp_path: Path) -> None:
        source = read_simulation(only(tmp_path))
        assert source.with_effects([]) == source
        assert source.simulate().dataset.hash == simulate_dataset(source.config).dataset.hash

    @pytest.mark.parametrize(
        ("given", "words"),
        [
            ("heading_drift", "--effect heading_drift: expected 'name: {parameter: value}'"),
            ("heading_drift: 0.1", "expected 'name: {parameter: value}'"),
            ("{a: {b: 1}, c: {d: 1}}", "expected 'name: {parameter: value}'"),
            ("heading_drift: {b", "--effect heading_drift: {b: not valid YAML"),
            ("heading_drift: {b: fast}", "--effect heading_drift: {b: fast}: parameters.b: "),
            ("heading_drift: {b: .nan}", "parameters.b: "),
            ("3: {b: 1}", "--effect 3: {b: 1}: name: "),
        ],
    )
    def test_one_that_cannot_be_read_is_refused_in_one_line(self, given: str, words: str, tmp_path: Path) -> None:
        with pytest.raises(OmnibenchError) as refusal:
            read_simulation(only(tmp_path)).with_effects([given])
        assert words in str(refusal.value)
        assert "\n" not in str(refusal.value)

    def test_one_given_twice_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match="--effect: effects: heading_drift is given twice"):
            read_simulation(only(tmp_path)).with_effects([DRIFT, DRIFT])


class TestTheCommand:
    def test_it_hides_an_effect_and_writes_the_truth_elsewhere(self, command: Command, tmp_path: Path) -> None:
        made = command("simulate", only(tmp_path), "-o", "data", "--truth", "truth", "--effect", DRIFT)
        assert made.returncode == 0, made.stderr
        assert made.stdout == "truth: truth/truth.yaml\n12 simulated trajectories: data\n"
        truth = yaml.safe_load(Path("truth/truth.yaml").read_text())
        assert truth["effects"] == [{"name": "heading_drift", "parameters": {"b": 0.01}}]
        assert not any(b"drift" in file.read_bytes() for file in Path("data").iterdir())

    def test_it_hides_an_effect_of_a_plugin(self, command: Command, tmp_path: Path) -> None:
        (tmp_path / "mine").mkdir()
        (tmp_path / "mine" / "side_wind.py").write_text(PLUGIN)
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

    def test_it_drives_a_recording_again(self, command: Command, prepared: Prepared) -> None:
        asked = ("simulate", "--like", prepared.data, "--model", prepared.calibration, "-o", "like")
        made = command(*asked, "--format", "csv")
        assert made.stdout == "12 simulated trajectories: like\n", made.stderr
        evaluated = command("evaluate", prepared.calibration, "like", "--json")
        assert yaml.safe_load(evaluated.stdout)["splits"]["all"]["cost"] < 1e-9

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            ([], "name a CONFIG with a simulated data set, or a recording with --like DATASET --model CALIBRATION"),
            (["--like", "DATA"], "say with --model CALIBRATION by which model"),
            (["--model", "CALIBRATION"], "say with --like DATASET which recording it is to drive again"),
            (["CONFIG", "--like", "DATA", "--model", "CALIBRATION"], "does not go with --like"),
            (["--like", "DATA", "--model", "CALIBRATION", "--truth", "t"], "--truth: does not go with --like"),
            (["--like", "DATA", "--model", "CALIBRATION", "--dataset", "t"], "--dataset: does not go with --like"),
            (["--like", "DATA", "--model", "CALIBRATION", "--effect", DRIFT], "--effect: does not go with --like"),
            (["--like", "DATA", "--model", "CALIBRATION", "--seed", "3"], "--seed: is for --noise"),
            (["CONFIG", "--noise"], "--noise: is for --like; a config has its own noise and seeds; leave it out"),
            (["CONFIG", "--seed", "1"], "--seed: is for --like"),
            (["--like", "CONFIG", "--model", "CALIBRATION"], "a data set is a folder"),
            (["--like", "DATA", "--model", "CONFIG"], "is this a calibration file?"),
            (
                ["CONFIG", "--effect", "heading_drft: {b: 1}"],
                "--effect heading_drft: {b: 1}: unknown effect 'heading_drft'",
            ),
        ],
    )
    def test_what_does_not_go_together_is_refused(
        self, arguments: list[str], words: str, command: Command, prepared: Prepared
    ) -> None:
        names = {"CONFIG": prepared.config, "DATA": prepared.data, "CALIBRATION": prepared.calibration}
        refused = command("simulate", *(names.get(each, each) for each in arguments), "-o", "made")
        assert_refused(refused, words)
        assert not Path("made").exists()

    def test_a_recording_is_not_written_over_by_its_own_simulation(self, command: Command, prepared: Prepared) -> None:
        before = load_dataset(prepared.data).hash
        asked = ("simulate", "--like", prepared.data, "--model", prepared.calibration, "-o", prepared.data)
        assert_refused(command(*asked), "is the recording itself; name another folder")
        assert load_dataset(prepared.data).hash == before


def test_the_hidden_effect_of_the_readme_is_in_its_truth(command: Command, tmp_path: Path) -> None:
    config = CONFIGS / "hidden_effect.yaml"
    made = command("simulate", config, "-o", tmp_path / "data", "--truth", tmp_path / "truth")
    assert made.stdout.endswith(f"360 simulated trajectories: {tmp_path / 'data'}\n"), made.stderr
    truth = yaml.safe_load((tmp_path / "truth" / "truth.yaml").read_text())
    assert len(truth["effects"]) == 1
    assert truth["effects"][0]["name"] not in (tmp_path / "data" / "dataset.yaml").read_text()
