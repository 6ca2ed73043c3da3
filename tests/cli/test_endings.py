"""Commands on a terminal: help, endings with what came out and what to do next, and no cut word in 60 columns."""

import re
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import typer
from commands import Command, Prepared, flower, run_here, succeeded, write_config
from lanes import slow
from shared_results import made_once, shared_folder
from typed_pages import parse

from omnibench.cli.app import FAMILIES, app
from omnibench.cli.examples import bundled_folder
from omnibench.cli.terminal.console import print_ending

_ENDING = re.compile(r"^[^;\n]+(?:; [^;\n]+)*; next, [^\n]+(?::\n  omnibench [^\n]+|\.)\n\Z", re.MULTILINE)
_PATHS = ("report: ", "calibration: ", "plain calibration", "extended calibration")
_WITHOUT_TABLES = (
    ("schema",),
    ("schema", "live"),
    ("example", "small", "-o", "demo"),
    ("keys", "secrets"),
    ("plugin", "new", "mine"),
    ("calibrate", "{data}", "-o", "mine.yaml"),
    ("export", "{calibration}", "--to", "c_header"),
    ("export", "{calibration}", "--to", "c_header", "-o", "odometry.h"),
    ("check", "{data}"),
    ("simulate", "{config}", "-o", "simulated"),
    ("exam", "make", "exam", "--sets", "1", "--robots", "omni", "--runs", "12"),
)
_QUICK = (
    ("list", "--plugins", "none"),
    ("list", "effects", "--plugins", "none"),
    ("calibrate", "{data}"),
    ("evaluate", "{calibration}", "{data}"),
    ("inspect", "{swerve}"),
    ("guide",),
    ("guide", "data"),
    ("example",),
)
_LONG = (
    ("inspect", "{data}"),
    ("calibrate", "{swerve}"),
    ("calibrate", "{data}", "--calibrator", "parametric", "--evaluations", "300"),
    ("certify", "{calibration}", "{data}", "--gap", "0.5"),
    ("design", "{data}"),
    ("compare", "{config}", "-o", "compared"),
    ("discover", "{data}", "-o", "found"),
)


@made_once
def swerve() -> Path:
    """Simulated recordings of a robot whose matrix has eight columns."""
    folder = shared_folder() / "swerve"
    succeeded(run_here("simulate", bundled_folder() / "configs/swerve.yaml", "-o", folder, cwd=shared_folder()))
    return folder


def filled_in(typed: tuple[str, ...], prepared: Prepared) -> list[str]:
    places = {**prepared._asdict(), "swerve": swerve() if "{swerve}" in typed else None}
    return [word.format_map(places) for word in typed]


def assert_ends_with_a_sentence(stderr: str) -> None:
    """Assert that the last sentence on standard error names a command that can be typed, or none."""
    lines = stderr.splitlines(keepends=True)
    ending = "".join(lines[-2:] if lines[-1].startswith("  ") else lines[-1:])
    assert _ENDING.match(ending), stderr
    if "\n  " in ending:
        parse(ending.splitlines()[-1].strip())


def words(text: str) -> set[str]:
    return set(re.findall(r"[A-Za-z]+", text))


@pytest.mark.parametrize("typed", _WITHOUT_TABLES, ids=" ".join)
def test_a_command_ends_with_a_sentence(command: Command, prepared: Prepared, typed: tuple[str, ...]) -> None:
    printed = command(*filled_in(typed, prepared))
    assert printed.returncode == (1 if typed[0] == "check" else 0), printed.stderr  # of which more is to be recorded
    assert_ends_with_a_sentence(printed.stderr)
    assert "; next, " not in printed.stdout


@pytest.mark.parametrize("typed", [*_QUICK, *slow(*_LONG)], ids=" ".join)
def test_a_command_with_tables_ends_with_a_sentence_and_cuts_no_word_on_a_narrow_terminal(
    command: Command, prepared: Prepared, monkeypatch: pytest.MonkeyPatch, typed: tuple[str, ...]
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    shown = {}
    for columns in (80, 60, 500):
        monkeypatch.setenv("COLUMNS", str(columns))
        printed = succeeded(command(*filled_in(typed, prepared), *(["--force"] if "-o" in typed else [])))
        assert "; next, " not in printed.stdout
        shown[columns] = re.sub(r"\x1b\[[^m]*m", "", printed.stdout)
    if typed[0] != "discover":  # which ends with its verdict
        assert_ends_with_a_sentence(re.sub(r"\x1b\[[^m]*m", "", printed.stderr))
    for width in (80, 60):
        assert not [line for line in shown[width].splitlines() if len(line) > width and not line.startswith(_PATHS)]
        left_out = words(" ".join(re.findall(r"left out for want of room: .*", shown[width])))
        left_out |= words("left out for want of room columns show all")
        left_out |= words("not on this screen; --json shows it, -o writes it")
        assert words(shown[width]) - words(shown[500]) - left_out == set()


@pytest.mark.parametrize("typed", [("list",), ("calibrate", "{data}"), ("evaluate", "{calibration}", "{data}")])
def test_with_json_no_sentence_is_printed(command: Command, prepared: Prepared, typed: tuple[str, ...]) -> None:
    printed = succeeded(command(*(word.format_map(prepared._asdict()) for word in typed), "--json"))
    assert "; next, " not in printed.stdout + printed.stderr


def test_a_shown_calibration_says_what_writes_it(command: Command, prepared: Prepared, tmp_path: Path) -> None:
    shown = command("calibrate", prepared.data, "--cost", "trajectory")
    again = shown.stderr.splitlines()[-1].split()
    assert again == ["omnibench", "calibrate", str(prepared.data), "--cost", "trajectory", "-o", "calibration.yaml"]
    assert not (tmp_path / "calibration.yaml").exists()
    assert command(*again[1:]).returncode == 0
    assert (tmp_path / "calibration.yaml").is_file()


def test_a_path_with_a_space_is_quoted_in_the_command_to_type(capfd: pytest.CaptureFixture[str]) -> None:
    print_ending("it is written", "look at it", "omnibench", "inspect", Path("my data"))
    assert capfd.readouterr().err == "it is written; next, look at it:\n  omnibench inspect 'my data'\n"


def commands() -> dict[str, Any]:
    """Every command by what is typed for it."""
    group: Any = typer.main.get_command(app)
    named: dict[str, Any] = dict(group.commands)
    for of_group in ("plugin", "exam"):
        within = named.pop(of_group).commands
        named |= {f"{of_group} {name}": command for name, command in within.items()}
    return named


def test_the_help_lists_every_command_under_a_heading(command: Command) -> None:
    shown = command("--help").stdout
    positions = [shown.index(f"\n{heading}:\n") for heading, _ in FAMILIES]
    assert positions == sorted(positions)
    assert "\nCommands:" not in shown
    for name in {name.split()[0] for name in commands()}:
        assert f"\n  {name} " in shown


def test_the_help_of_no_command_is_cut_in_eighty_columns(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    shown = command("--help").stdout
    assert shown.startswith("Usage: omnibench")
    assert "..." not in shown.split("Options:")[1]
    assert max(len(line) for line in shown.splitlines()) <= 80
    assert command("compare", "--help").stdout.startswith("Usage: omnibench compare")


@pytest.mark.parametrize("name", commands())
def test_every_command_and_each_of_its_options_says_what_it_is(name: str) -> None:
    described = commands()[name]
    assert described.help
    parameters = described.get_params(described.make_context(name, [], resilient_parsing=True))
    assert [parameter.name for parameter in parameters if not parameter.help and parameter.name != "help"] == []


@pytest.mark.parametrize("name", commands())
def test_an_output_can_be_written_short_or_long(name: str) -> None:
    spellings = [{*parameter.opts} for parameter in commands()[name].params]
    for options in spellings:
        assert ("-o" in options) == ("--output" in options)
    writes = {"compare", "calibrate", "export", "discover", "import", "fetch", "design", "slam", "simulate", "record"}
    assert any("-o" in options for options in spellings) == (name in {*writes, "example", "guard", "plugin new"})


def test_the_version_is_printed_and_nothing_else(command: Command) -> None:
    printed = command("--version")
    assert (printed.returncode, printed.stdout, printed.stderr) == (0, f"omnibench {version('omnibench')}\n", "")


def test_one_run_is_not_said_to_be_several(command: Command, tmp_path: Path) -> None:
    motion = {"speeds": [0.2], "directions_deg": [0], "turn_rates": [0.35]}
    config = write_config(
        tmp_path, datasets={"flower": {"simulate": flower(commands=motion)}}, calibrators=["theoretical"]
    )
    compared = command("compare", config, "-o", tmp_path / "out")
    assert "flower (simulated): 1 held-out run, cost" in compared.stdout
    assert ", 1 evaluation, " in compared.stderr
    assert command("simulate", config, "-o", tmp_path / "data").stdout.startswith("2 simulated trajectories: ")
