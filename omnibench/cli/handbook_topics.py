"""The handbook: Markdown files of the package, one a topic. Its README.md lists them, here and in a browser."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from omnibench.errors import require_choice

HANDBOOK = Path(__file__).with_name("handbook")

_GROUP = re.compile(r"^## (.+)$")
_ENTRY = re.compile(r"^- \[([a-z0-9-]+)\]\(([a-z0-9/-]+\.md)\): (.+)$")
_LINK = re.compile(r"\[([^\]]+)\]\((?:[./a-z-]*/)?([a-z0-9-]+)\.md(?:#[a-z-]+)?\)")


@dataclass(frozen=True)
class Topic:
    """One page of the handbook.

    group: the heading it stands under in the list. summary: what it is about, in one line. file: its Markdown.
    """

    name: str
    group: str
    summary: str
    file: Path

    @property
    def text(self) -> str:
        """The page's Markdown, in which a link to another topic reads as its words and the command that shows it."""

        def with_command(link: re.Match[str]) -> str:
            words = "" if link[1].strip("`") == link[2] else f"{link[1]} → "
            return f"{words}`omnibench guide {link[2]}`"

        return _LINK.sub(with_command, self.file.read_text(encoding="utf-8"))


def topics() -> list[Topic]:
    """All topics, in the order of the handbook's list."""
    listed, group = [], ""
    for line in (HANDBOOK / "README.md").read_text(encoding="utf-8").splitlines():
        if heading := _GROUP.match(line):
            group = heading[1]
        elif entry := _ENTRY.match(line):
            listed.append(Topic(entry[1], group, entry[3], HANDBOOK / entry[2]))
    return listed


def find_topic(name: str) -> Topic:
    """The topic called ``name``. UnknownNameError names the nearest one and lists all."""
    known = {topic.name: topic for topic in topics()}
    require_choice("topic", name, known, "guide")
    return known[name]
