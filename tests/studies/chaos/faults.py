"""Faults at random: which, when, for how long, and how each is ended."""

from __future__ import annotations

import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

_MEAN_PAUSE: Final = 1.5  # s between two faults; chosen
_HOG = "while True: pass"


@dataclass(frozen=True)
class Fault:
    """A kind of fault.

    begin: does it; its result, if it has one, ends it. target: what no other fault may befall meanwhile, "" for none.
    shortest, longest: s. weight: how often it comes, relative to others.
    """

    name: str
    target: str
    begin: Callable[[], Callable[[], object] | None]
    shortest: float = 0.0
    longest: float = 0.0
    weight: float = 1.0


@dataclass
class Faults:
    """Faults that come at random; ``step`` begins and ends them, ``heal`` ends all."""

    kinds: list[Fault]
    rng: np.random.Generator
    count: Counter[str] = field(default_factory=Counter)
    log: list[tuple[float, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._under_way: dict[str, tuple[float, Callable[[], object], str]] = {}
        self._next = 0.0

    def step(self, elapsed: float, weights: Mapping[str, float]) -> None:
        """End what is over, and begin another one if it is time. weights: factors, by name."""
        now = time.monotonic()
        for target, (until, end, _) in list(self._under_way.items()):
            if now >= until:
                del self._under_way[target]
                end()
        if now < self._next:
            return
        self._next = now + float(self.rng.exponential(_MEAN_PAUSE))
        weight = np.array([kind.weight * weights.get(kind.name, 1.0) for kind in self.kinds])
        kind = self.kinds[int(self.rng.choice(len(self.kinds), p=weight / weight.sum()))]
        length = float(self.rng.uniform(kind.shortest, kind.longest))
        if kind.target in self._under_way:
            return
        end = kind.begin()
        self.count[kind.name] += 1
        self.log.append((elapsed, f"{kind.name} for {length:.1f} s"))
        if end is not None:
            key = kind.target or f"{kind.name} {now}"
            self._under_way[key] = now + length, end, kind.name

    def heal(self) -> None:
        """End all faults."""
        under_way, self._under_way = self._under_way, {}
        for _, end, _ in under_way.values():
            end()

    @property
    def targets(self) -> set[str]:
        """What is under a fault now."""
        return set(self._under_way)

    def recent(self, count: int = 8) -> list[str]:
        """The latest faults, for who looks for the cause of a failure."""
        return [f"{at:.1f} s: {what}" for at, what in self.log[-count:]]


def hog() -> Callable[[], object]:
    """A process that keeps a processor busy; the function that ends it."""
    process = subprocess.Popen([sys.executable, "-c", _HOG], start_new_session=True)

    def end() -> None:
        process.kill()
        process.wait()

    return end
