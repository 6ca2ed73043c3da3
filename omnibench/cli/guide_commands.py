"""The commands for whoever begins: the handbook, and examples to run."""

import shlex
import sys
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from textwrap import fill
from typing import Annotated

import typer

from omnibench.cli.options import Force, output_option
from omnibench.cli.terminal.console import make_console, print_ending, say
from omnibench.errors import ConfigError
from omnibench.words import plural

guide_app = typer.Typer()

_READING_WIDTH = 100  # columns: longer lines are hard to follow
_NAME_WIDTH = 15  # columns, of the longest topic
_MOST_LISTED = 10  # files of a folder that are written out by name
_NAMES = _NAME_WIDTH + 4  # columns, with the spaces around it


@guide_app.command()
def guide(
    topic: Annotated[str | None, typer.Argument(help="What to read about. Default: the list of topics.")] = None,
) -> None:
    """Show the handbook: a topic, or the list of topics."""
    from omnibench.cli.handbook_topics import find_topic

    if topic is None:
        _list_topics()
    else:
        _show(find_topic(topic).text)
        print_ending(f"this was the page {topic!r}", "see what else there is to read", "omnibench", "guide")


@guide_app.command()
def example(
    name: Annotated[str | None, typer.Argument(help="One of the list that is shown without it.")] = None,
    output: Annotated[Path | None, output_option("Folder to write to.", metavar="DIR")] = None,
    force: Force = False,
) -> None:
    """Write an example to begin with, or list the examples.

    An example is a config with all that it needs, or a small recording.
    """
    from omnibench.cli.examples import find_example, write_example
    from omnibench.files import resolved

    if name is None:
        return _list_examples()
    chosen = find_example(name)
    if output is None:
        raise ConfigError(f"say where the example goes: omnibench example {name} -o DIR")
    written = write_example(chosen, output, force=force)
    _list_written(written)
    if not written:
        typer.echo("nothing is written: all of it is there already, unchanged")
    if chosen.note:
        say(f"note: {chosen.note}")
    typer.echo("to go on, type:")
    if resolved(output) != Path.cwd():
        typer.echo(f"  cd {shlex.quote(str(output))}")
    for command in chosen.commands:
        typer.echo(f"  {command}")
    return print_ending(f"{output} holds the example {name}", "type the lines above")


def _list_written(files: Sequence[Path]) -> None:
    """A line for each file, and one for a folder of many."""
    for folder, group in groupby(files, lambda file: file.parent):
        listed = list(group)
        if len(listed) > _MOST_LISTED:
            typer.echo(f"written: {folder} ({plural(len(listed), 'file')})")
        else:
            for file in listed:
                typer.echo(f"written: {file}")


def _list_topics() -> None:
    from omnibench.cli.handbook_topics import topics

    listed = topics()
    for group in dict.fromkeys(topic.group for topic in listed):
        typer.echo(f"{group}:")
        _print_names({topic.name: topic.summary for topic in listed if topic.group == group})
    print_ending("these are the pages of the handbook", "read one", "omnibench", "guide", "getting-started")


def _list_examples() -> None:
    from omnibench.cli.examples import EXAMPLES

    _print_names({each.name: each.summary for each in EXAMPLES})
    print_ending("these are the examples", "write one into a folder", "omnibench", "example", "small", "-o", "demo")


def _print_names(summaries: Mapping[str, str]) -> None:
    width = make_console().width
    for name, summary in summaries.items():
        typer.echo(fill(summary, width, initial_indent=f"  {name:{_NAME_WIDTH}}  ", subsequent_indent=" " * _NAMES))


def _show(markdown: str) -> None:
    """Markdown as pages on a terminal, as it stands where it is piped."""
    if not sys.stdout.isatty():
        return typer.echo(markdown, nl=False)
    from rich.console import Console
    from rich.markdown import Markdown
    from rich.theme import Theme

    console = Console(theme=Theme({"markdown.code": "bold cyan"}), emoji=False)
    console.width = min(console.width, _READING_WIDTH)
    return console.print(Markdown(markdown, code_theme="ansi_dark"))
