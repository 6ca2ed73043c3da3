"""The console that commands print on, and what all of them print alike: warnings and JSON documents."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from pydantic import BaseModel
    from rich.console import Console

    from omnibench.robot.calibration import HeldOutVerdict

_PIPED_WIDTH = 160  # columns of a table in a pipe or a file, where nobody's window is too narrow


def make_console(error: bool = False) -> Console:
    """A console that shows texts as they are, and does not squeeze tables into 80 columns when it is piped.

    error: on standard error, where progress goes; work goes on in silence when nobody reads it any more.
    """
    from rich.console import Console as RichConsole

    class Console(RichConsole):
        def on_broken_pipe(self) -> None:
            if not error:
                super().on_broken_pipe()
            self.quiet = True

    stream = sys.stderr if error else sys.stdout
    width = None if stream.isatty() else _PIPED_WIDTH
    return Console(file=stream, width=width, markup=False, emoji=False, highlight=False)


def warn(messages: Iterable[str]) -> None:
    """A line on standard error for each message."""
    for message in messages:
        typer.echo(f"warning: {message}", err=True)


def print_json(document: Mapping[str, Any] | BaseModel) -> None:
    """The document as strict JSON on standard output."""
    from omnibench.config import to_json

    typer.echo(to_json(document))


def print_verdict(verdict: HeldOutVerdict, subject: str = "", sessions: Iterable[str] = ()) -> None:
    """The last lines of ``calibrate``, ``evaluate`` and ``compare``: what held-out runs say, and which these are.

    sessions: sentences on sessions that differ from the others or could not be compared.
    """
    typer.echo(f"{subject}{verdict.sentence}")
    typer.echo(verdict.detail)
    for sentence in sessions:
        typer.echo(sentence)
