"""The command line, put together from its families of commands. __main__ runs it and prints what a mistake ends in.

``omnibench --help`` imports every file of commands, so these import what they need inside their functions, and do
without ``from __future__ import annotations``: Typer evaluates such annotations from their text, twice.
"""

import warnings
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from omnibench.cli.calibration_commands import calibration_app
from omnibench.cli.exam_commands import exam_app
from omnibench.cli.guide_commands import guide_app
from omnibench.cli.live_commands import live_app
from omnibench.cli.recording_commands import recording_app

# Headings of the help and the family of commands under each, in the order in which a newcomer needs them.
FAMILIES = (
    ("Calibrate and compare", calibration_app),
    ("Recordings", recording_app),
    ("Live", live_app),
    ("Learn and extend", guide_app),
)
calibration_app.add_typer(exam_app, name="exam")


class CommandsByFamily(TyperGroup):
    """A group of commands whose help lists them under the headings of their families."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a section for each heading; names take the same width in all of them."""
        width = max(len(name) for name in self.list_commands(ctx))
        room = formatter.width - width - 6
        sections: dict[str, list[tuple[str, str]]] = {}
        for name, command in self.commands.items():
            row = (name.ljust(width), command.get_short_help_str(room))
            sections.setdefault(getattr(command, "rich_help_panel", None) or "Commands", []).append(row)
        for heading, rows in sections.items():
            with formatter.section(heading):
                formatter.write_dl(rows)


def _print_version(asked: bool) -> None:
    if not asked:
        return
    from omnibench import __version__

    installed = __version__ != "unknown"
    typer.echo(f"omnibench {__version__}" if installed else "omnibench, version unknown: it is not installed")
    raise typer.Exit


def _show_renamings_once() -> None:
    """Let a FutureWarning, such as of a former name, come out as one line of the command, once for each text."""
    show_others, said = warnings.showwarning, set[str]()

    def show(message: Warning | str, category: type[Warning], *rest: Any, **others: Any) -> None:
        from omnibench.cli.terminal.console import warn

        if not issubclass(category, FutureWarning):
            show_others(message, category, *rest, **others)
        elif (text := str(message)) not in said:
            said.add(text)
            warn([text])

    warnings.showwarning = show


app = typer.Typer(
    name="omnibench",
    cls=CommandsByFamily,
    help="Calibrate the odometry of wheeled robots, compare calibrators, find missing physics, run the result live.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.callback()
def options_of_all(
    version: Annotated[  # noqa: ARG001 (printed by its callback)
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Options of omnibench itself, before any command."""
    _show_renamings_once()


for heading, family in FAMILIES:
    for command in family.registered_commands:
        command.rich_help_panel = heading
    for group in family.registered_groups:
        group.rich_help_panel = heading
    app.add_typer(family)
