"""The commands for whoever begins: the handbook, and examples to run."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

guide_app = typer.Typer()

_READING_WIDTH = 100  # columns: longer lines are hard to follow


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


def _list_topics() -> None:
    from omnibench.cli.handbook_topics import topics

    listed = topics()
    width = max(len(topic.name) for topic in listed)
    group = ""
    for topic in listed:
        if topic.group != group:
            group = topic.group
            typer.echo(f"\n{group}")
        typer.echo(f"  {topic.name:{width}}  {topic.summary}")
    typer.echo("\nread one: omnibench guide getting-started")


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
