"""Compilation of inner loops to machine code by numba, which keeps the result on disk for the next process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Decorator: compile a function of numbers and arrays at its first call, for the types of its arguments."""
    machine_code: F = numba.njit(cache=True)(function)
    return machine_code
