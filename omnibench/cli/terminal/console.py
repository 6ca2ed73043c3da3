"""The console that commands print on, and what all of them print alike: warnings, JSON documents, the last sentence."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping
from textwrap import fill
from typing import TYPE_CHECKING, Any

import typer

from omnibench.errors import visible

if TYPE_CHECKING:
    from pydantic import BaseModel
    from rich.console import Console
    from rich.segment import Segment

    from omnibench.report.result import Result

_MOST_ALIKE = 3  # warnings that differ by places and numbers alone and are shown one by one
_PIPED_WIDTH = 160  # columns of a table in a pipe or a file, where nobody's window is too narrow


def make_console(error: bool = False) -> Console:
    """A console that shows texts as they are, and does not squeeze tables into 80 columns when it is piped.

    Texts may come from files and the network: their control characters, which could command the terminal, become ?.
    On a terminal text wraps between words; in a pipe a text with ``soft_wrap`` stays one line.
    error: on standard error, where progress goes; work goes on in silence when nobody reads it any more.
    """
    from rich.console import Console as RichConsole

    class Console(RichConsole):
        def render(self, *arguments: Any, **settings: Any) -> Iterator[Segment]:
            for segment in super().render(*arguments, **settings):
                yield segment if segment.control else segment._replace(text=visible(segment.text))

        def print(self, *objects: Any, soft_wrap: bool | None = None, **settings: Any) -> None:
            super().print(*objects, soft_wrap=bool(soft_wrap) and not self.is_terminal, **settings)

        def on_broken_pipe(self) -> None:
            if not error:
                super().on_broken_pipe()
            self.quiet = True

    stream = sys.stderr if error else sys.stdout
    width = None if stream.isatty() else _PIPED_WIDTH
    return Console(file=stream, width=width, markup=False, emoji=False, highlight=False)


def warn(messages: Iterable[str]) -> None:
    """Print the messages on standard error, of many that differ by places and numbers alone only the first."""
    alike: dict[str, list[str]] = {}
    for message in messages:
        alike.setdefault(re.sub(r"\d[\d.,]*", "#", message.partition(": ")[2] or message), []).append(message)
    for several in alike.values():
        if len(several) > _MOST_ALIKE:
            several = [f"{several[0]} (and {len(several) - 1} more such warnings)"]
        for message in several:
            make_console(error=True).print(f"warning: {message}", soft_wrap=True)


def say(text: str) -> None:
    """Running text on standard output, wrapped between words on a terminal and as one line in a pipe."""
    make_console().print(text, soft_wrap=True)


def print_names(summaries: Mapping[str, str], width: int) -> None:
    """Print names, each with its summary beside it. width: of the column of names, in characters."""
    for name, summary in summaries.items():
        head, hang = f"  {name:{width}}", " " * (width + 2)
        typer.echo(fill(summary, make_console().width, initial_indent=head, subsequent_indent=hang))


def print_json(document: Mapping[str, Any] | BaseModel) -> None:
    """The document as strict JSON on standard output."""
    from omnibench.config import to_json

    typer.echo(to_json(document))


def show(result: Result, as_json: bool = False) -> None:
    """Print a result: its warnings, then its JSON document, or its tables, its remarks and what to do next."""
    warn(dict.fromkeys(result.warnings))
    if as_json:
        return print_json(result.json())
    from omnibench.report.terminal import print_result

    print_result(make_console(), result)
    return print_next(result)


def print_next(result: Result) -> None:
    """Print what came out and what to do next."""
    step = result.next_step()
    print_ending(step.outcome, step.then, *step.command)


def print_ending(outcome: str, then: str = "", *command: object) -> None:
    """The sentence that a command ends with, on standard error, so that what is piped stays clean.

    outcome: what came out, without a full stop. then: what to do next, as an imperative. command: the words to type
    for it, which stand on a line of their own, quoted for a shell. Not for ``--json``, which a program reads.

    >>> print_ending("data/robot holds 24 runs", "see what they tell", "omnibench", "inspect", "data/robot")
    ... # data/robot holds 24 runs; next, see what they tell:
    ... #   omnibench inspect data/robot
    """
    console = make_console(error=True)
    if not then:
        console.print(f"{outcome}.", soft_wrap=True)
        return
    console.print(f"{outcome}; next, {then}{':' if command else '.'}", soft_wrap=True)
    if command:
        typer.echo(f"  {visible(shlex.join(map(str, command)))}", err=True)
