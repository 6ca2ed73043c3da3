"""Presence of robots: each robot that a node runs has a liveliness token, ``omnibench/<robot>/alive``."""

from __future__ import annotations

import re
from threading import Lock
from typing import Final

import zenoh

from omnibench.errors import ConfigError, nearest
from omnibench.live.network.callbacks import direct

_ALIVE: Final = "omnibench/*/alive"
_NAME = re.compile(r"[^\s/*$?#@]+")


def checked_robot(name: str) -> str:
    """The name, if it can be a robot's, that is one part of a key. ConfigError otherwise."""
    if not _NAME.fullmatch(name):
        raise ConfigError(f"robot {name!r}: a robot's name is one word without / * $ ? # or @, as apr02")
    return name


def alive_robots(session: zenoh.Session, timeout: float = 1.0) -> tuple[str, ...]:
    """The names of the robots whose tokens are declared now, sorted. timeout: s."""
    replies = session.liveliness().get(_ALIVE, timeout=timeout)
    return tuple(sorted({_robot(reply.ok.key_expr) for reply in replies if reply.ok is not None}))


def nothing_received(robot: str, seconds: float, alive: tuple[str, ...]) -> str:
    """One line for a robot from which nothing came in ``seconds``: those that are alive, and the nearest name."""
    if robot in alive:
        return (
            f"robot {robot!r} is alive, but nothing was received from it in {seconds:.0f} s; it gets no wheel samples, "
            f"it has another profile (query omnibench/{robot}/info), or its router's `access` does not let us read it"
        )
    nobody = "no robot is alive; is its node running, connected to here, and are we named in its router's `access`?"
    others = f"alive: {', '.join(alive)}" if alive else nobody
    return f"robot {robot!r}: nothing was received from it in {seconds:.1f} s; {nearest(robot, alive)}{others}"


class Presence:
    """Tracks which robots are alive and which have left, by their liveliness tokens. ``close`` when done."""

    def __init__(self, session: zenoh.Session) -> None:
        self._is_alive: dict[str, bool] = {}
        self._lock = Lock()
        self._subscriber = session.liveliness().declare_subscriber(_ALIVE, direct(self._changed), history=True)

    @property
    def alive(self) -> tuple[str, ...]:
        """The names of the robots whose tokens are declared, sorted."""
        return self._names(alive=True)

    @property
    def left(self) -> tuple[str, ...]:
        """The names of the robots whose tokens were declared and are not any more, sorted."""
        return self._names(alive=False)

    def close(self) -> None:
        """Stop tracking."""
        self._subscriber.undeclare()

    def _changed(self, sample: zenoh.Sample) -> None:
        with self._lock:
            self._is_alive[_robot(sample.key_expr)] = sample.kind == zenoh.SampleKind.PUT

    def _names(self, alive: bool) -> tuple[str, ...]:
        with self._lock:
            return tuple(sorted(name for name, is_alive in self._is_alive.items() if is_alive is alive))


def _robot(key: zenoh.KeyExpr) -> str:
    return str(key).split("/")[1]
