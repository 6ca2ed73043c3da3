"""Runs that hold the same wheel samples, also under other names, later in time or with other ends."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from omnibench.data.checks.finding import Finding
from omnibench.data.checks.stream_faults import runs_in_words
from omnibench.data.dataset import Trajectory
from omnibench.words import plural

# Samples in a row that two runs must share, changes of rates among them, and share of the shorter run's rows (chosen:
# encoders' whole ticks repeat themselves for some samples, not for these).
_ROWS, _CHANGES, _SHARED = 24, 12, 0.3
_DIGITS = 6  # of rates that are compared: computed from positions at other epochs they differ in the last ones


def copied_runs(runs: Sequence[Trajectory]) -> Iterator[Finding]:
    """Runs that repeat an earlier one."""
    seen: dict[bytes, str] = {}
    copies: dict[str, str] = {}
    for run in runs:
        keys = set(_keys(run))
        shared = [seen[key] for key in keys if key in seen]
        if keys and len(shared) > _SHARED * len(keys):
            copies[run.id] = max(set(shared), key=shared.count)
        else:
            seen.update(dict.fromkeys(keys, run.id))
    if copies:
        first = next(iter(copies.items()))
        yield Finding(
            kind="copies",
            what=f"{plural(len(copies), 'run')} {'repeats' if len(copies) == 1 else 'repeat'} the wheel samples of "
            f"others, as {first[0]} those of {first[1]}: what validates then was trained on",
            where=runs_in_words(list(copies), len(runs)),
            severity="error",
            changes={"leave_out": list(copies)},
        )


def _keys(run: Trajectory) -> Iterator[bytes]:
    """Digests of every stretch of samples in which the rates change often enough."""
    rates = run.rates if run.steering is None else np.hstack([run.rates, run.steering])
    scale = 10.0 ** np.floor(np.log10(max(float(np.abs(rates).max(initial=0.0)), 1e-12)))
    rounded = np.round(rates / scale * 10**_DIGITS).astype(np.int64) // 10
    changes = np.append(0, np.cumsum(np.any(np.diff(rounded, axis=0) != 0, axis=1)))
    for row in range(len(rounded) - _ROWS):
        if changes[row + _ROWS - 1] - changes[row] >= _CHANGES:
            yield rounded[row : row + _ROWS].tobytes()
