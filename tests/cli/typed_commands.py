"""Commands as a text shows them, parsed as the command line parses them but not run."""

from __future__ import annotations

import re
import shlex
from typing import Any

import typer

from omnibench.cli.app import app

_APP: Any = typer.main.get_command(app)
_INLINE = re.compile(r"`(omnibench [^`]+)`")


def commands_in(markdown: str) -> list[str]:
    """Every ``omnibench ...`` of the code blocks and of the code within lines."""
    joined = re.sub(r"\\\n +", "", markdown)  # a backslash goes on in the next line
    blocks = [line.strip() for line in joined.splitlines() if line.startswith("    ")]
    typed = [part.strip() for line in [*blocks, *_INLINE.findall(markdown)] for part in line.split("&&")]
    return [line for line in typed if line.startswith("omnibench ")]


def parse(command: str) -> None:
    """Parse a command. Click's UsageError when a command, an option or an argument of it does not exist."""
    _, *arguments = shlex.split(command, comments=True)
    if len(arguments) == 1 and any(arguments[0] in option.opts for option in _APP.params):
        return  # --version
    group, name, context = _APP, "omnibench", None
    while hasattr(group, "commands"):
        context = group.context_class(group, info_name=name, parent=context)
        name, group, arguments = group.resolve_command(context, arguments)
    group.make_context(name, [argument for argument in arguments if argument != "--help"], parent=context)
