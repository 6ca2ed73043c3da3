"""Presence of robots: each robot that a node runs has a liveliness token, ``omnibench/<robot>/alive``.

A node claims its robots before it runs them, by tokens ``omnibench/<robot>/claim-<session>``, and only then looks for
others. Of two that start at the same moment at least one sees the other's claim, since each declares its own first. One
that sees a claim of a smaller session gives way; one that sees a claim of a larger session waits until that is
withdrawn, or its node, which may have looked before, runs the robot.
"""

from __future__ import annotations

import re
import time
from collections.abc import Collection
from threading import Event, Lock
from typing import Final

import zenoh

from omnibench.errors import ConfigError, nearest
from omnibench.live.stopping import answers, direct

_ALIVE: Final = "omnibench/*/alive"
_CLAIMS: Final = "omnibench/*/claim-$*"
_PATIENCE: Final = 10.0  # s for a node that starts at the same moment to run its robots, or to give way; chosen
_LOOKING: Final = 0.05  # s between two looks at another node's claim; chosen
_NAME = re.compile(r"[^\s/*$?#@]+")


def checked_robot(name: str) -> str:
    """The name, if it can be a robot's, that is one part of a key. ConfigError otherwise."""
    if not _NAME.fullmatch(name):
        raise ConfigError(f"robot {name!r}: a robot's name is one word without / * $ ? # or @, as apr02")
    return name


def alive_robots(session: zenoh.Session, timeout: float = 1.0, stop: Event | None = None) -> tuple[str, ...]:
    """The names of the robots whose tokens are declared now, sorted. timeout: s for the router; ``stop`` ends it."""
    tokens = answers(lambda handler, s: session.liveliness().get(_ALIVE, handler, timeout=s), timeout, stop)
    return tuple(sorted({_robot(token.key_expr) for token in tokens}))


class Claim:
    """A node's claim to its robots, which no other node runs or claims before it. ``close`` withdraws it.

    others: robots of other nodes. timeout: s for one look at the tokens. ConfigError: another node has a robot.
    """

    def __init__(self, session: zenoh.Session, robots: Collection[str], timeout: float) -> None:
        own = str(session.zid())
        liveliness = session.liveliness()
        self._tokens = [liveliness.declare_token(f"omnibench/{robot}/claim-{own}") for robot in robots]
        try:
            deadline = time.monotonic() + _PATIENCE
            while True:
                # Robots that are claimed, and the sessions that claim them.
                replies = session.liveliness().get(_CLAIMS, timeout=timeout)
                keys = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
                rivals = [
                    (robot, rival)
                    for robot, rival in [(key.split("/")[1], key.rpartition("/claim-")[2]) for key in keys]
                    if robot in robots and rival != own
                ]
                self.others = alive_robots(session, timeout)  # after the claims: one that has gone may run by now
                for robot in robots:
                    if robot in self.others:
                        raise _taken(robot, "is run by another node already; stop that")
                for robot, rival in rivals:
                    if rival < own or time.monotonic() > deadline:
                        raise _taken(robot, "is being started by another node at this moment; leave it to that")
                if not rivals:
                    break
                time.sleep(_LOOKING)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Withdraw the claim."""
        for token in self._tokens:
            token.undeclare()


def _taken(robot: str, why: str) -> ConfigError:
    """Two nodes for one robot would publish every stamp twice."""
    return ConfigError(f"robot {robot!r} {why}, or give this one's another name")


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
