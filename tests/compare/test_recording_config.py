"""A comparison of a data set without a config."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import yaml
from commands import Command, Prepared, assert_refused, registries_restored, summary, write_plugin
from config_robots import NAMES, experiment

from omnibench.compare.config import CompareConfig
from omnibench.compare.recording_config import recording_config, suitable_calibrators
from omnibench.simulate.simulate import simulate_dataset

SEARCHES = {"crs", "genetic", "isres", "random_search", "parametric"}


def test_a_data_set_is_compared_by_all_calibrators_that_suit_it(
    command: Command, prepared: Prepared, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("omnibench.compare.recording_config._EVALUATIONS", 300)
    printed = command("compare", prepared.data, "-o", "out")
    assert printed.returncode == 0, printed.stderr
    first = printed.stderr.splitlines()[0]
    assert first.startswith("no config is given: theoretical, closed_form, crs, ")
    labels = {run["label"] for run in summary(Path("out"))["runs"]}
    assert labels == {"theoretical", "closed_form", "least_squares", "posterior", "trajectory_ml", *SEARCHES}
    config = CompareConfig.model_validate(yaml.safe_load(Path("out/config.yaml").read_text()))
    assert config.budget.evaluations == 300
    assert config.unidentified == "keep"


@pytest.mark.parametrize("name", NAMES)
def test_every_kind_of_robot_has_calibrators_that_suit(name: str) -> None:
    dataset = simulate_dataset(experiment(name), name).dataset
    names = suitable_calibrators(dataset)
    assert names[0] == "theoretical"
    assert {"closed_form", "trajectory_ml"} <= set(names)
    assert "published" not in names


def test_a_plugins_calibrator_takes_part(prepared: Prepared, tmp_path: Path) -> None:
    body = """
class Mine(Calibrator):
    '''Starts and stays.'''
    def calibrate(self, problem):
        return Solution(problem.start, "stays")
calibrators.register("mine")(Mine)
"""
    with registries_restored():
        config = recording_config(prepared.data, [write_plugin(tmp_path / "plugins", "mine", body)])
    assert "mine" in [entry.name for entry in config.calibrators]


def test_folders_of_a_data_set_are_compared_as_one(
    command: Command, prepared: Prepared, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("omnibench.compare.recording_config.suitable_calibrators", lambda _: ["theoretical"])
    for day in ("day1", "day2"):
        shutil.copytree(prepared.data, day)
    by_glob = command("compare", "day*", "-o", "by_glob")
    one_by_one = command("compare", "day1", "day2", "-o", "one_by_one")
    assert (by_glob.returncode, one_by_one.returncode) == (0, 0), by_glob.stderr + one_by_one.stderr
    (named,) = yaml.safe_load(Path("by_glob/config.yaml").read_text())["datasets"].values()
    assert [Path(path).name for path in named["path"]] == ["day1", "day2"]
    assert summary(Path("by_glob"))["runs"][0]["train_cost"] == summary(Path("one_by_one"))["runs"][0]["train_cost"]


def test_one_config_is_compared_at_a_time(command: Command, prepared: Prepared) -> None:
    printed = command("compare", prepared.config, prepared.data)
    assert_refused(printed, f"unexpected extra argument {prepared.data}; compare takes one config, or the folders of")


def test_a_folder_that_is_not_there_is_named_beside_one_that_is(command: Command, prepared: Prepared) -> None:
    assert_refused(command("compare", prepared.data, "nope"), "nope: no such folder; compare takes one config")


def test_no_plugins_may_be_asked_for_as_of_other_commands(
    command: Command, prepared: Prepared, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("omnibench.compare.recording_config.suitable_calibrators", lambda _: ["theoretical"])
    printed = command("compare", prepared.data, "--plugins", "none", "-o", "out")
    assert printed.returncode == 0, printed.stderr


def test_data_is_for_a_config(command: Command, prepared: Prepared) -> None:
    printed = command("compare", prepared.data, "--data", prepared.data)
    assert_refused(printed, "--data is for a config", "leave it out")


def test_a_folder_that_is_no_data_set_is_named(command: Command, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert_refused(command("compare", tmp_path / "empty"), "is a folder without dataset.yaml")
