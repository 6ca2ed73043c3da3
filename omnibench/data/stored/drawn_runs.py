"""Some of very many runs, by which a whole recording is judged."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np

from omnibench.data.stored.periods import Sampled
from omnibench.data.stored.stored_rows import StoredRows

Run = TypeVar("Run", bound=Sampled)
Data = TypeVar("Data", bound=Any)

MOST_DRAWN = 3_000_000  # wheel samples by which a recording is judged: 500 runs of a minute at 100 Hz (chosen)

_FEWEST = 20  # runs that are drawn at least (chosen)
_OF_EACH = 2  # runs of every command and session that are drawn before others (chosen): a rare one is not missed


def drawn_runs(runs: Sequence[Run], most: int = MOST_DRAWN) -> list[Run]:
    """All runs, or of more than ``most`` wheel samples some that chance has drawn, in memory: the same ones each time.

    They have about so many samples, unless runs are so long that twenty have more. Some of every session and command
    that the runs tell are drawn first, as far as so few runs reach.
    """
    count = count_drawn(runs, most)
    if count == len(runs):
        return list(runs)
    order, seen = np.random.default_rng(0).permutation(len(runs)).tolist(), Counter[object]()
    first, others = list[int](), list[int]()
    for index in order:
        kind = tuple(getattr(runs[index], name, None) for name in ("session", "command"))
        seen[kind] += 1
        (first if seen[kind] <= _OF_EACH else others).append(index)
    return [in_memory(runs[index]) for index in sorted([*first, *others][:count])]


def count_drawn(runs: Sequence[Sampled], most: int = MOST_DRAWN) -> int:
    """How many runs ``drawn_runs`` draws."""
    samples = sum(len(run.times) for run in runs)
    return min(max(_FEWEST, len(runs) * most // max(samples, 1)), len(runs))


def in_memory(run: Data) -> Data:
    """A run, or a log, with copies of the arrays that are read where they are used."""
    stored = {item.name: value for item in fields(run) if isinstance(value := getattr(run, item.name), StoredRows)}
    return replace(run, **{name: np.array(value) for name, value in stored.items()}) if stored else run
