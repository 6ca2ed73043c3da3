"""What a newcomer reads first: the help, the version, and options that mean the same everywhere."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import typer
from commands import Command, flower, write_config

from omnibench.cli.app import FAMILIES, app


def commands() -> dict[str, Any]:
    """Every command by what is typed for it."""
    group: Any = typer.main.get_command(app)
    named: dict[str, Any] = dict(group.commands)
    plugin = named.pop("plugin")
    return named | {f"plugin {name}": command for name, command in plugin.commands.items()}


def test_the_help_lists_every_command_under_a_heading(command: Command) -> None:
    shown = command("--help").stdout
    positions = [shown.index(f"\n{heading}:\n") for heading, _ in FAMILIES]
    assert positions == sorted(positions)
    assert "\nCommands:" not in shown
    for name in {name.split()[0] for name in commands()}:
        assert f"\n  {name} " in shown


def test_the_help_of_no_command_is_cut_in_a_terminal_of_eighty_columns(
    command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    shown = command("--help").stdout
    assert "..." not in shown.split("Options:")[1]
    assert max(len(line) for line in shown.splitlines()) <= 80


@pytest.mark.parametrize("name", commands())
def test_every_command_and_each_of_its_options_says_what_it_is(name: str) -> None:
    described = commands()[name]
    assert described.help
    assert [parameter.name for parameter in described.params if not parameter.help and parameter.name != "help"] == []


@pytest.mark.parametrize("name", commands())
def test_an_output_can_be_written_short_or_long(name: str) -> None:
    spellings = [{*parameter.opts} for parameter in commands()[name].params]
    for options in spellings:
        assert ("-o" in options) == ("--output" in options)
    writes = {"compare", "calibrate", "export", "discover", "import", "fetch", "design", "slam", "simulate", "record"}
    assert any("-o" in options for options in spellings) == (name in {*writes, "example", "plugin new"})


def test_the_version_is_printed_and_nothing_else(command: Command) -> None:
    printed = command("--version")
    assert (printed.returncode, printed.stdout, printed.stderr) == (0, f"omnibench {version('omnibench')}\n", "")


def test_one_run_is_not_said_to_be_several(command: Command, tmp_path: Path) -> None:
    motion = {"speeds": [0.2], "directions_deg": [0], "turn_rates": [0.35]}
    config = write_config(
        tmp_path, datasets={"flower": {"simulate": flower(commands=motion)}}, calibrators=["theoretical"]
    )
    compared = command("compare", config, "-o", tmp_path / "out")
    assert "\nCost of 1 training run\n" in compared.stdout
    assert ", 1 evaluation, " in compared.stderr
    assert command("simulate", config, "-o", tmp_path / "data").stdout.startswith("2 simulated trajectories: ")
