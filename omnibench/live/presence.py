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
from threading import Event
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
    return tuple(sorted({robot for robot, _ in _tokens(session, _ALIVE, timeout, stop)}))


def _tokens(session: zenoh.Session, key: str, timeout: float, stop: Event | None = None) -> list[tuple[str, str]]:
    """Robot and last part of the key of each token that is declared now."""
    tokens = answers(lambda handler, s: session.liveliness().get(key, handler, timeout=s), timeout, stop)
    parts = [str(token.key_expr).split("/") for token in tokens]
    return [(robot, last) for _, robot, last in parts]


class Claim:
    """A node's claim to its robots, which no other node runs or claims before it. ``close`` withdraws it.

    others: robots of other nodes. timeout: s for one look at the tokens. ConfigError: another node has a robot.
    """

    def __init__(self, session: zenoh.Session, robots: Collection[str], timeout: float) -> None:
        own = f"claim-{session.zid()}"
        self._tokens = [session.liveliness().declare_token(f"omnibench/{robot}/{own}") for robot in robots]
        deadline = time.monotonic() + _PATIENCE
        try:
            while True:
                claims = _tokens(session, _CLAIMS, timeout)
                rivals = {robot: claim for robot, claim in claims if robot in robots and claim != own}
                self.others = alive_robots(session, timeout)  # after the claims: one that has gone may run by now
                overdue = time.monotonic() > deadline
                first = {robot for robot, claim in claims if robot in rivals and (claim < own or overdue)}
                why = dict.fromkeys(first, "is being started by another node at this moment; leave it to that")
                why |= dict.fromkeys(set(robots) & set(self.others), "is run by another node already; stop that")
                for robot, reason in why.items():  # two nodes for one robot would publish every stamp twice
                    raise ConfigError(f"robot {robot!r} {reason}, or give this one's another name")
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
        self._subscriber = session.liveliness().declare_subscriber(_ALIVE, direct(self._changed), history=True)

    @property
    def alive(self) -> tuple[str, ...]:
        """The names of the robots whose tokens are declared, sorted."""
        return tuple(sorted(robot for robot, is_alive in self._is_alive.copy().items() if is_alive))

    @property
    def left(self) -> tuple[str, ...]:
        """The names of the robots whose tokens were declared and are not any more, sorted."""
        return tuple(sorted(robot for robot, is_alive in self._is_alive.copy().items() if not is_alive))

    def close(self) -> None:
        """Stop tracking."""
        self._subscriber.undeclare()

    def _changed(self, sample: zenoh.Sample) -> None:
        self._is_alive[str(sample.key_expr).split("/")[1]] = sample.kind == zenoh.SampleKind.PUT
