"""``omnibench example`` and the sample recording in the package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
import yaml
from commands import CONFIGS, Command, assert_refused, succeeded
from real_recordings import OPTIODOM
from report_page import on_terminal
from typed_pages import parse

import omnibench
from omnibench.cli import examples
from omnibench.cli.examples import EXAMPLES, SAMPLES, Example, find_example, write_example
from omnibench.cli.terminal.calibration_tables import print_calibration
from omnibench.compare.config import read_compare_config
from omnibench.config import read_model
from omnibench.study.config import StudyConfig

TYPED = [(example, command) for example in EXAMPLES for command in example.commands]


def test_every_example_is_listed_with_one_line(command: Command) -> None:
    lines = command("example").stdout.splitlines()
    assert [line.split()[0] for line in lines] == [example.name for example in EXAMPLES]
    assert all(len(line) <= 80 for line in lines)


def test_every_config_of_the_repository_is_in_an_example() -> None:
    shown = {file for example in EXAMPLES for file in example.files}
    assert {f"configs/{file.name}" for file in CONFIGS.glob("*.yaml")} <= shown


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.name)
def test_an_example_brings_every_file_that_its_configs_name(example: Example, tmp_path: Path) -> None:
    written = write_example(example, tmp_path)
    for config in (tmp_path / "configs").glob("*.yaml"):
        content = yaml.safe_load(config.read_text(encoding="utf-8"))
        if "calibrators" in content and config.name == Path(example.files[0]).name:
            assert all(folder.is_dir() for folder in read_compare_config(config).plugins)
        if "methods" in content and config.name == Path(example.files[0]).name:
            assert all(folder.is_dir() for folder in read_model(StudyConfig, config).plugins)
            continue
        for robot in content.get("robots", ()):
            assert (config.parent / robot["calibration"]).is_file()
        if "replay" in content:
            assert (config.parent / content["replay"]["dataset"]).is_file()
    assert written


@pytest.mark.parametrize(("example", "command"), TYPED, ids=lambda value: getattr(value, "name", value))
def test_what_an_example_says_to_type_next_can_be_typed(example: Example, command: str, tmp_path: Path) -> None:
    if not command.startswith("omnibench"):
        return
    parse(command)
    write_example(example, tmp_path)
    for word in command.split():
        if word.startswith(("configs/", "plugins/")) and "." in word:
            assert (tmp_path / word).is_file()


def test_an_example_says_what_to_type_next_and_is_as_good_as_written_where_it_is(command: Command) -> None:
    printed = command("example", "apr02", "-o", "demo").stdout.splitlines()
    assert printed[-2:] == ["  cd demo", "  omnibench compare configs/apr02.yaml"]
    assert any(line.startswith("written: demo/plugins (") for line in printed)
    assert command("example", "live", "-o", "demo").stdout.startswith("written: demo/configs/live.yaml\n")
    again = succeeded(command("example", "apr02", "-o", "demo"))
    assert again.stdout.startswith("nothing is written")


def test_a_file_that_differs_is_not_overwritten(command: Command) -> None:
    Path("configs").mkdir()
    Path("configs/apr02.yaml").write_text("name: mine\n", encoding="utf-8")
    assert_refused(command("example", "apr02", "-o", "."), "configs/apr02.yaml is there already")
    assert Path("configs/apr02.yaml").read_text(encoding="utf-8") == "name: mine\n"
    assert not Path("plugins").exists()


def test_a_recording_that_is_there_is_not_simulated_again(command: Command) -> None:
    assert command("example", "recording", "-o", "demo").returncode == 0
    assert_refused(command("example", "recording", "-o", "demo"), "is there already", "choose another folder")


def test_a_wrong_name_and_no_folder_are_refused(command: Command) -> None:
    assert_refused(command("example", "apr2", "-o", "demo"), "'apr2'", "'apr02'")
    assert_refused(command("example", "apr02"), "-o DIR")


def test_an_installed_package_has_its_own_copies(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "example_files" / "configs").mkdir(parents=True)
    (tmp_path / "example_files" / "configs" / "small.yaml").write_text("name: bundled\n", encoding="utf-8")
    monkeypatch.setattr(examples, "__file__", str(tmp_path / "examples.py"))
    assert write_example(find_example("small"), tmp_path / "demo") == [tmp_path / "demo" / "configs" / "small.yaml"]
    assert write_example(find_example("small"), tmp_path / "demo") == []


ROBOT = SAMPLES / "robot"
# Session of each kind of path, and its first run of each command.
SOURCES = {
    "circle_right": ("circular/231220200134", 1),
    "circle_left": ("circular/231220200134", 4),
    "straight": ("ivanjko/231220200102", 1),
    "turn_right": ("ivanjko/231220200102", 4),
    "turn_left": ("ivanjko/231220200102", 7),
    "square_right": ("square/231220200029", 1),
    "square_left": ("square/231220200029", 4),
}
RUNS = [(f"{command}_{repetition}", command) for command in SOURCES for repetition in (1, 2, 3)]


def test_the_sample_is_small_and_brings_its_licence() -> None:
    files = [file for file in ROBOT.rglob("*") if file.is_file()]
    assert sum(file.stat().st_size for file in files) <= 300_000
    assert (ROBOT / "LICENSE").read_text(encoding="utf-8").startswith("MIT License")
    runs = pl.read_csv(ROBOT / "log" / "runs.csv").rows()
    assert sorted(runs) == sorted(RUNS)
    assert {file.stem for file in files if file.suffix == ".csv"} == {"runs", *(run for run, _ in runs)}


@pytest.mark.skipif(not OPTIODOM.is_dir(), reason=f"{OPTIODOM} is absent: the recordings that the sample is made of")
@pytest.mark.parametrize("command", SOURCES)
def test_the_sample_holds_every_second_row_of_its_source(command: str) -> None:
    session, first = SOURCES[command]
    folder = OPTIODOM / "diff" / session
    for repetition in (1, 2, 3):
        sample = pl.read_csv(ROBOT / "log" / f"{command}_{repetition}.csv")
        file = folder / f"{folder.name}_run-{first + repetition - 1:02d}.csv"
        source = np.genfromtxt(file, delimiter=",", usecols=(0, 4, 5))  # t, ticks of the right and of the left wheel
        rows = slice(0, 2 * len(sample) - 1, 2)
        np.testing.assert_allclose(sample["t"], source[rows, 0], rtol=0, atol=0.006)
        ticks = sample.select("ticks_right", "ticks_left").to_numpy()
        np.testing.assert_array_equal(ticks.cumsum(axis=0), (source[:, 1:].cumsum(axis=0) - source[0, 1:])[rows])


def test_a_row_that_is_zero_by_design_is_called_so_and_warned_of_nowhere() -> None:
    options = {"wheel_unit": "ticks/sample", "ticks_per_turn": 2796.8}
    run = omnibench.calibrate(omnibench.import_dataset("csv", ROBOT / "log", options))
    assert on_terminal(print_calibration, run, width=100).count("by design") == 2
    assert run.result.held == ("m21", "m22")
    assert run.untouched == ()
