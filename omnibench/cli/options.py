"""The option ``--plugins`` of the commands that need calibrators, effects, costs or importers of one's own."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Annotated

import typer

from omnibench.registry import PluginFailure, load_plugins

Plugins = Annotated[
    list[Path] | None,
    typer.Option("--plugins", help="Folder of plug-ins; may be repeated. Default: ./plugins, if it is there."),
]


def plugin_folders(given: Sequence[Path] | None) -> list[Path]:
    """The folders that were given, or else the default, if it is there."""
    if given:
        return list(given)
    return [Path("plugins")] if given is None and Path("plugins").is_dir() else []


def load_given_plugins(given: Sequence[Path] | None) -> list[PluginFailure]:
    """Load their plug-ins; one that cannot be imported is a warning on standard error. PluginError: no such folder."""
    with redirect_stdout(sys.stderr):  # what a plug-in prints is not our output
        failures = load_plugins(plugin_folders(given))
    for failure in failures:
        typer.echo(f"warning: plug-in {failure.origin} cannot be imported: {failure.error}", err=True)
    return failures
