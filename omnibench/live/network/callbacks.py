"""Callbacks that Zenoh calls in its own threads, without a queue in between."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from zenoh.handlers import Callback


def direct(callback: Callable[[Any], None]) -> Any:
    """A handler that calls ``callback`` with each message in the thread that receives it: it must be quick."""
    return Callback(callback, indirect=False)
