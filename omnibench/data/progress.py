"""Those who are told how long work gets on."""

from __future__ import annotations

from typing import Protocol


class Watch(Protocol):
    """Told how long work gets on: what is being done, and how many of how many steps are done."""

    def __call__(self, what: str, done: int, total: int) -> None: ...


def unwatched(what: str, done: int, total: int) -> None:
    """Nobody watches."""
