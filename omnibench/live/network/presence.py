"""Who is there: each robot that a node carries has a liveliness token, ``omnibench/<robot>/alive``."""

from __future__ import annotations

import re
from threading import Lock
from typing import Any, Final

import zenoh
from zenoh.handlers import Callback

from omnibench.errors import ConfigError, nearest

_ALIVE: Final = "omnibench/*/alive"
_NAME = re.compile(r"[^\s/*$?#@]+")


def checked_robot(name: str) -> str:
    """A robot's name that can be one part of a key. ConfigError when it cannot."""
    if not _NAME.fullmatch(name):
        raise ConfigError(f"robot {name!r}: a robot's name is one word without / * $ ? # or @, as apr02")
    return name


def alive_robots(session: zenoh.Session, timeout: float = 1.0) -> tuple[str, ...]:
    """The robots whose tokens are there now, by name. timeout: s."""
    replies = session.liveliness().get(_ALIVE, timeout=timeout)
    return tuple(sorted({_robot(reply.ok.key_expr) for reply in replies if reply.ok is not None}))


def nothing_received(robot: str, seconds: float, alive: tuple[str, ...]) -> str:
    """One line for a robot from which nothing came in ``seconds``, with those that are there and the nearest name."""
    if robot in alive:
        return (
            f"robot {robot!r} is alive, but nothing was heard of it in {seconds:.0f} s; perhaps no wheel samples come, "
            f"or its profile is another: omnibench/{robot}/info tells"
        )
    others = f"alive: {', '.join(alive)}" if alive else "no robot is alive; is its node running, and connected to here?"
    return f"robot {robot!r}: nothing was heard of it in {seconds:.1f} s; {nearest(robot, alive)}{others}"


class Presence:
    """The robots that are there and those that have left, as their tokens come and go. ``close`` when done."""

    def __init__(self, session: zenoh.Session) -> None:
        self._there: dict[str, bool] = {}
        self._lock = Lock()
        direct: Any = Callback(self._changed, indirect=False)
        self._subscriber = session.liveliness().declare_subscriber(_ALIVE, direct, history=True)

    @property
    def alive(self) -> tuple[str, ...]:
        """The robots whose tokens are there, by name."""
        return self._names(True)

    @property
    def left(self) -> tuple[str, ...]:
        """The robots whose tokens were there and are not, by name."""
        return self._names(False)

    def close(self) -> None:
        """Stop looking."""
        self._subscriber.undeclare()

    def _changed(self, sample: zenoh.Sample) -> None:
        with self._lock:
            self._there[_robot(sample.key_expr)] = sample.kind == zenoh.SampleKind.PUT

    def _names(self, there: bool) -> tuple[str, ...]:
        with self._lock:
            return tuple(sorted(name for name, is_there in self._there.items() if is_there is there))


def _robot(key: zenoh.KeyExpr) -> str:
    return str(key).split("/")[1]
