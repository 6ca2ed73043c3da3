"""Every command ends with one sentence: what came out, and what to do next."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from commands import Command, Prepared
from typed_commands import parse

from omnibench.cli.terminal.console import print_ending

_ENDING = re.compile(r"^[^;\n]+(?:; [^;\n]+)*; next, [^\n]+(?::\n  omnibench [^\n]+|\.)\n\Z", re.MULTILINE)


def ending(stderr: str) -> str:
    """The last sentence on standard error, with the command that stands below it."""
    lines = stderr.splitlines(keepends=True)
    return "".join(lines[-2:] if lines[-1].startswith("  ") else lines[-1:])


QUICK = (
    ("list",),
    ("schema",),
    ("schema", "live"),
    ("guide",),
    ("guide", "data"),
    ("example",),
    ("example", "small", "-o", "demo"),
    ("keys", "secrets"),
    ("plugin", "new", "mine"),
)


@pytest.mark.parametrize("typed", QUICK, ids=" ".join)
def test_a_command_that_needs_no_data_ends_with_a_sentence(command: Command, typed: tuple[str, ...]) -> None:
    printed = command(*typed)
    assert printed.returncode == 0, printed.stderr
    assert _ENDING.match(ending(printed.stderr)), printed.stderr
    assert "; next, " not in printed.stdout


WORKING = (
    ("calibrate", "{data}"),
    ("calibrate", "{data}", "-o", "mine.yaml"),
    ("evaluate", "{calibration}", "{data}"),
    ("certify", "{calibration}", "{data}", "--gap", "0.5"),
    ("export", "{calibration}", "--to", "c_header"),
    ("export", "{calibration}", "--to", "c_header", "-o", "odometry.h"),
    ("design", "{data}"),
    ("inspect", "{data}"),
    ("check", "{data}"),
    ("simulate", "{config}", "-o", "simulated"),
    ("compare", "{config}", "-o", "compared"),
)


@pytest.mark.parametrize("typed", WORKING, ids=" ".join)
def test_a_command_on_recordings_ends_with_a_sentence_and_a_command_that_can_be_typed(
    command: Command, prepared: Prepared, typed: tuple[str, ...]
) -> None:
    printed = command(*(word.format_map(prepared._asdict()) for word in typed))
    assert printed.returncode == 0, printed.stderr
    last = ending(printed.stderr)
    assert _ENDING.match(last), printed.stderr
    assert "; next, " not in printed.stdout
    if "\n  " in last:
        parse(last.splitlines()[-1].strip())


@pytest.mark.parametrize("typed", [("list",), ("calibrate", "{data}"), ("evaluate", "{calibration}", "{data}")])
def test_with_json_no_sentence_is_printed(command: Command, prepared: Prepared, typed: tuple[str, ...]) -> None:
    printed = command(*(word.format_map(prepared._asdict()) for word in typed), "--json")
    assert printed.returncode == 0
    assert "; next, " not in printed.stdout + printed.stderr


def test_a_calibration_that_was_only_shown_names_the_command_that_writes_it(
    command: Command, prepared: Prepared, tmp_path: Path
) -> None:
    shown = command("calibrate", prepared.data, "--cost", "trajectory")
    again = shown.stderr.splitlines()[-1].split()
    assert again == ["omnibench", "calibrate", str(prepared.data), "--cost", "trajectory", "-o", "calibration.yaml"]
    assert not (tmp_path / "calibration.yaml").exists()
    assert command(*again[1:]).returncode == 0
    assert (tmp_path / "calibration.yaml").is_file()


def test_a_path_with_a_space_is_quoted_in_the_command_to_type(capfd: pytest.CaptureFixture[str]) -> None:
    print_ending("it is written", "look at it", "omnibench", "inspect", Path("my data"))
    assert capfd.readouterr().err == "it is written; next, look at it:\n  omnibench inspect 'my data'\n"
