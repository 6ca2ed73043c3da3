"""Options that several commands share."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

if TYPE_CHECKING:
    from omnibench.registry import PluginFailure


def output_option(text: str) -> Any:
    """``-o`` and ``--output``, which mean the same on every command that writes something."""
    return typer.Option("-o", "--output", help=text)


Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="An option, value in YAML; may be repeated.")
]
TableFormat = Annotated[Literal["parquet", "csv"], typer.Option("--format", help="Format of the tables.")]
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
    from omnibench.registry import load_plugins

    with redirect_stdout(sys.stderr):  # what a plug-in prints is not our output
        failures = load_plugins(plugin_folders(given))
    for failure in failures:
        typer.echo(f"warning: plug-in {failure.origin} cannot be imported: {failure.error}", err=True)
    return failures
