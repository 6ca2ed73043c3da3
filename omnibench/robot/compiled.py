"""Sums along the paths of runs, in one pass over their samples, compiled by numba and kept on disk as machine code.

The equations are those of odometry.py. The sums serve runs that are read from their file where they are used, of which
an array of every intermediate value would not fit in memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

import numpy as np

F = TypeVar("F", bound=Callable[..., Any])

_WAITING: dict[str, list[Callable[..., Any]]] = {}  # functions that are not compiled yet, by their modules

# h, rad, below which sin(h)/h and its derivative are summed by their series: the first term left out is 1e-17 there.
_SMALL = 0.03


def compiled(function: F) -> F:
    """Decorator: compile a function of numbers and arrays at its first call, for the types of its arguments.

    Numba, which loads slowly, is imported then; it takes the place of all functions of the module, as one may call
    another. ``recompile`` is that of numba, for constants that were changed.
    """
    waiting = _WAITING.setdefault(function.__module__, [])
    waiting.append(function)
    names = function.__globals__

    def machine_code() -> Any:
        import numba

        for python in waiting:
            names[python.__name__] = numba.njit(cache=True)(python)
        waiting.clear()
        return names[function.__name__]

    @wraps(function)
    def call(*arguments: Any) -> Any:
        return machine_code()(*arguments)

    call.recompile = lambda: machine_code().recompile()  # type: ignore[attr-defined]
    return cast(F, call)


@compiled
def path_sums(
    times: Any, signals: Any, edges: Any, stamps: Any, stamp_edges: Any, matrix: Any, arc: bool, with_slopes: bool,
    moved: Any, row_12: Any, row_3: Any, driven: Any,
) -> None:  # fmt: skip
    """Positions, their derivatives and the integrals of the signals at the stamps of runs, from their start on.

    times (F,), signals (F, M): of all runs. edges, stamp_edges (Z + 1,): the first sample and the first stamp of each
    run. stamps (S,): s, increasing within a run. The rest is filled: moved (S, 2), m, in the frame of the start;
    row_12, row_3 (S, M), complex: derivatives of x + iy by m1 + i m2 and by m3, if ``with_slopes``; driven (S, M), rad.
    """
    size = signals.shape[1]
    before, piece = np.zeros(size), np.zeros(size)
    along, across = np.zeros(size, dtype=np.complex128), np.zeros(size, dtype=np.complex128)
    for run in range(len(edges) - 1):
        before[:], along[:], across[:] = 0.0, 0.0, 0.0
        x = y = begin = 0.0
        stamp, last = stamp_edges[run], stamp_edges[run + 1]
        for sample in range(edges[run], edges[run + 1]):
            if stamp == last:
                break
            end = times[sample]
            final = sample == edges[run + 1] - 1
            while True:
                at_stamp = stamp < last and (stamps[stamp] <= end or final)
                share = min(max((stamps[stamp] - begin) / (end - begin), 0.0), 1.0) if at_stamp else 1.0
                psi = half = forward = sideways = 0.0
                for wheel in range(size):
                    piece[wheel] = signals[sample, wheel] * (end - begin) * share
                    psi += matrix[2, wheel] * before[wheel]
                    half += matrix[2, wheel] * piece[wheel] / 2
                    forward += matrix[0, wheel] * piece[wheel]
                    sideways += matrix[1, wheel] * piece[wheel]
                chord, bend = 1.0, 0.0
                if arc:
                    psi += half
                    square = half * half
                    if abs(half) < _SMALL:
                        chord = 1 - square / 6 * (1 - square / 20 * (1 - square / 42))
                        bend = -half / 3 * (1 - square / 10 * (1 - square / 28))
                    else:
                        chord = math.sin(half) / half
                        bend = (half * math.cos(half) - math.sin(half)) / square
                turn = complex(math.cos(psi), math.sin(psi))
                step = complex(forward, sideways) * turn
                moved_x, moved_y = x + (chord * step).real, y + (chord * step).imag
                if at_stamp:
                    moved[stamp, 0], moved[stamp, 1] = moved_x, moved_y
                    for wheel in range(size):
                        driven[stamp, wheel] = before[wheel] + piece[wheel]
                else:
                    x, y = moved_x, moved_y
                if with_slopes:
                    for wheel in range(size):
                        phase = before[wheel] + (piece[wheel] / 2 if arc else 0.0)
                        of_12 = along[wheel] + piece[wheel] * chord * turn
                        of_3 = across[wheel] + step * complex(bend * piece[wheel] / 2, chord * phase)
                        if at_stamp:
                            row_12[stamp, wheel], row_3[stamp, wheel] = of_12, of_3
                        else:
                            along[wheel], across[wheel] = of_12, of_3
                if not at_stamp:
                    for wheel in range(size):
                        before[wheel] += piece[wheel]
                    break
                stamp += 1
            begin = end
