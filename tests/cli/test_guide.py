"""The handbook, the README and the examples: every topic is found, and whatever they say to type exists."""

import ast
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import yaml
from commands import CONFIGS, ROOT, Command, Prepared, assert_refused, run_here, succeeded
from markdown_it import MarkdownIt
from newcomer import ELSEWHERE, lines_of, typed_here
from newcomer import PAGES as TYPED_PAGES
from pydantic import TypeAdapter
from real_recordings import OPTIODOM
from report_page import on_terminal
from typed_pages import commands_in, parse

import omnibench
from omnibench.cli import examples
from omnibench.cli.examples import EXAMPLES, SAMPLES, Example, find_example, write_example
from omnibench.cli.handbook_topics import HANDBOOK, topics
from omnibench.compare.config import CompareConfig, read_compare_config
from omnibench.config import read_model
from omnibench.data.recording_options import RobotOption
from omnibench.report.calibration_report import CalibrationResult
from omnibench.report.terminal import print_result

PAGES = [ROOT / "README.md", *sorted(HANDBOOK.rglob("*.md"))]
BY_NAME = {topic.name: topic for topic in topics()}
TYPED = sorted({command for page in PAGES for command in commands_in(page.read_text(encoding="utf-8"))})

_LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)")
_IN_THE_CLONE = re.compile(r"\b((?:tests/studies|configs)/[\w./-]+\.(?:py|yaml))")
_PYTHON = re.compile(r"```python\n(.*?)```", re.DOTALL)


def relative(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path) -> list[str]:
    """The indented blocks of a page."""
    found = re.findall(r"(?:^    .*\n(?:\n(?=    ))?)+", page.read_text(encoding="utf-8"), re.MULTILINE)
    return [block.replace("\n    ", "\n")[4:] for block in found]


def test_the_list_of_topics_fits_a_terminal(command: Command) -> None:
    lines = command("guide").stdout.splitlines()
    assert all(len(line) <= 80 for line in lines)
    assert {line.split()[0] for line in lines if line.startswith("  ")} == set(BY_NAME)


def test_every_page_of_the_handbook_is_listed_once() -> None:
    listed = [topic.file for topic in topics()]
    assert sorted(listed) == [page for page in PAGES[1:] if page.name != "README.md"]
    assert all(topic.name == topic.file.stem for topic in topics())


@pytest.mark.parametrize("name", BY_NAME)
def test_a_topic_is_plain_markdown_when_piped_and_its_code_fits_a_narrow_terminal(command: Command, name: str) -> None:
    printed = succeeded(command("guide", name))
    assert printed.stdout.startswith("# ")
    assert ".md" not in printed.stdout  # links to topics are commands there
    assert [line for block in blocks(BY_NAME[name].file) for line in block.splitlines() if len(line) > 76] == []


@pytest.mark.parametrize("name", BY_NAME)
def test_a_topic_has_no_words_that_markdown_takes_for_html(name: str) -> None:
    tokens = [token for block in MarkdownIt().parse(BY_NAME[name].text) for token in (block, *(block.children or ()))]
    assert [token.content for token in tokens if token.type.startswith("html")] == []


def test_a_link_to_a_topic_keeps_its_words_beside_the_command(command: Command) -> None:
    assert (
        "what was measured without motion capture → `omnibench guide references`"
        in command("guide", "importing").stdout
    )


def test_a_topic_is_set_for_reading_on_a_terminal(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    printed = command("guide", "data").stdout
    assert "# Data" not in printed
    assert "omnibench guide importing" in printed
    assert all(len(line) <= 80 for line in re.sub(r"\x1b[^m]*m", "", printed).splitlines())


def test_an_unknown_topic_is_answered_with_the_nearest(command: Command) -> None:
    assert_refused(command("guide", "calibrator"), "unknown topic 'calibrator'; did you mean 'calibrators'?")


@pytest.mark.parametrize("typed", TYPED)
def test_a_command_that_is_shown_can_be_typed(typed: str) -> None:
    parse(typed)


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of somebody who has typed the README without its comparison."""
    return typed_here(ROOT / "README.md", tmp_path_factory.mktemp("reader"))


def test_the_readme_shows_what_its_commands_say(reader: Path) -> None:
    (shown,) = re.findall(r"^    (held out .*)$", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert shown in run_here("evaluate", "calibration.yaml", "data/robot", cwd=reader).stdout


@pytest.mark.parametrize("name", ["faq", "importing", "references", "ros2"])
def test_the_commands_of_a_page_run_after_those_of_the_readme(name: str, reader: Path) -> None:
    assert typed_here(TYPED_PAGES[name], reader) == reader


def test_what_a_page_leaves_to_another_stands_there_word_for_word() -> None:
    for name, others in ELSEWHERE.items():
        for line, page in others.items():
            assert line in lines_of(TYPED_PAGES[name])
            assert line in lines_of(TYPED_PAGES[page])


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_every_link_every_file_and_every_public_name_of_a_page_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for link in _LINK.findall(text):
        assert (page.parent / link).exists(), link
    for file in _IN_THE_CLONE.findall(text):
        assert (ROOT / file).is_file(), file
    for program in _PYTHON.findall(text):
        compile(program, str(page), "exec")
        assert set(re.findall(r"omnibench\.(\w+)\(", program)) <= set(omnibench.__all__)


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", pytest.param(BY_NAME["python"].file, marks=pytest.mark.slow)], ids=relative
)
def test_the_first_python_runs(page: Path, prepared: Prepared, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, target in {"data/robot": prepared.data, "configs/apr02.yaml": prepared.config}.items():
        link = tmp_path / name
        link.parent.mkdir()
        link.symlink_to(target)
    (program,) = _PYTHON.findall(page.read_text(encoding="utf-8"))
    exec(compile(program, str(page), "exec"), {})  # noqa: S102 (a program of the handbook)
    assert (tmp_path / "calibration.yaml").is_file()


def test_the_example_of_the_page_on_references_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (program,) = _PYTHON.findall(BY_NAME["references"].text)
    exec(compile(program, "references.md", "exec"), {})  # noqa: S102 (a program of the handbook)
    matrix = np.array(ast.literal_eval(capsys.readouterr().out))
    assert matrix[0] @ [6.0, 6.0] * 10 == pytest.approx(3.03, abs=0.01)
    assert matrix[2] @ [-3.0, 3.0] * 10 == pytest.approx(9.7, abs=0.05)


def test_the_handbook_tells_of_every_public_name() -> None:
    text = BY_NAME["python"].text
    assert [name for name in omnibench.__all__ if f"`{name}`" not in text] == []


def test_the_configs_that_are_shown_are_right() -> None:
    config, study = (block for block in blocks(BY_NAME["compare"].file) if block.startswith("name:"))
    CompareConfig.model_validate(yaml.safe_load(config))
    CompareConfig.model_validate(yaml.safe_load(study))


SHOWN = [yaml.safe_load(block[block.index("name:") :]) for block in blocks(BY_NAME["robot"].file) if "name:" in block]
ROBOTS = {robot["name"]: robot for robot in SHOWN}


@pytest.mark.parametrize(("name", "pushed", "turned"), [
    ("two_wheels", [1, 1], [-1, 1]),
    ("omni", [-1, 0, 1], [1, 1, 1]),
    ("mecanum", [1, 1, 1, 1], [-1, 1, -1, 1]),
    ("tracking_wheels", [1, 1, 0], [-1, 1, -1]),
])  # fmt: skip
def test_wheels_count_as_the_page_of_robots_says(name: str, pushed: list[int], turned: list[int]) -> None:
    robot = TypeAdapter(RobotOption).validate_python(ROBOTS[name])
    rates = robot.signal_equations @ np.array([[1.0, 0, 0], [0, 0, 1]]).T
    np.testing.assert_array_equal(np.sign(rates.round(9)).T, [pushed, turned])


def test_robots_that_steer_are_taken_as_the_page_of_robots_writes_them() -> None:
    for name in ("tricycle", "car", "swerve"):
        assert TypeAdapter(RobotOption).validate_python(ROBOTS[name]).drive.steered


# ``omnibench example`` and the sample recording in the package.

EXAMPLE_COMMANDS = [(example, command) for example in EXAMPLES for command in example.commands]


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
            assert all(folder.is_dir() for folder in read_model(CompareConfig, config).plugins)
            continue
        for robot in content.get("robots", ()):
            assert (config.parent / robot["calibration"]).is_file()
        if "replay" in content:
            assert (config.parent / content["replay"]["dataset"]).is_file()
    assert written


@pytest.mark.parametrize(("example", "command"), EXAMPLE_COMMANDS, ids=lambda value: getattr(value, "name", value))
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
    run = omnibench.calibrate(omnibench.import_dataset("csv", ROBOT / "log", options), "closed_form")
    bare = replace(run, calibration=run.calibration.model_copy(update={"parameters": {}}))
    assert on_terminal(print_result, CalibrationResult(bare), width=100).count("by design") == 2
    assert run.result.held == ("m21", "m22")
    assert run.untouched == ()
