"""Words that agree with numbers, for messages of every room."""

from __future__ import annotations

from collections.abc import Sequence


def plural(number: int, noun: str) -> str:
    """A number with its noun: ``1 run``, ``2 runs``, ``2,000 trajectories``."""
    return f"{number:,} {noun_for(number, noun)}"


def some(names: Sequence[str], most: int = 12) -> str:
    """Names in a sentence; of many the first ones, and how many more there are."""
    more = f" and {len(names) - most:,} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def kind_of_data(simulated: bool) -> str:
    """The origin of a recording, in the headings of tables."""
    return "simulated data" if simulated else "recorded data"


def noun_for(number: int, noun: str) -> str:
    """The noun alone, for numbers written without groups of digits: ``run``, ``runs``, ``trajectories``."""
    several = f"{noun[:-1]}ies" if noun[-1] == "y" and noun[-2] not in "aeo" else f"{noun}s"
    return noun if number == 1 else several
