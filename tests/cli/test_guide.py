"""The handbook and the README: every topic is found, and whatever they say to type exists."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from commands import ROOT, Command, Prepared, assert_refused, succeeded
from newcomer import ELSEWHERE, lines_of, typed_here
from newcomer import PAGES as TYPED_PAGES
from pydantic import TypeAdapter
from typed_pages import commands_in, parse

import omnibench
from omnibench.cli.handbook_topics import HANDBOOK, topics
from omnibench.compare.config import CompareConfig
from omnibench.data.recording import RobotOption
from omnibench.study.config import StudyConfig

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
    StudyConfig.model_validate(yaml.safe_load(study))


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
