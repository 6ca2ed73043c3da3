"""Callbacks that Zenoh calls in its own threads, without a queue in between, and answers collected by them."""

from __future__ import annotations

from collections.abc import Callable
from threading import Event
from typing import Any, Final

import zenoh
from zenoh.handlers import Callback

from omnibench.live.stopping import wait_until

_LOOK: Final = 0.002  # s between two looks at whether all have answered; chosen


def direct(callback: Callable[[Any], None]) -> Any:
    """A handler that calls ``callback`` with each message in the thread that receives it: it must be quick."""
    return Callback(callback, indirect=False)


def answers(get: Callable[[Any, float], object], timeout: float, stop: Event | None = None) -> list[zenoh.Sample]:
    """The answers to a query, but for refusals, as soon as all are there; ``stop`` ends the waiting.

    get: begins the query, given a handler and the timeout (s).
    """
    came: list[zenoh.Sample] = []
    over = Event()

    def take(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            came.append(reply.ok)

    get(Callback(take, over.set, indirect=False), timeout)
    wait_until(over.is_set, 2 * timeout, stop, _LOOK)
    return came
