"""Runs that hold the same reference poses, also under other names, later in time or with other ends."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from xxhash import xxh3_64_intdigest

from omnibench.data.checks.finding import Finding
from omnibench.data.checks.stream_faults import runs_in_words
from omnibench.data.dataset import Trajectory
from omnibench.words import plural

# Poses in a row that two runs must share, changes among them, and share of the later run's rows (chosen: a reference
# scatters, so that no two drives share any; wheel rates as commanded are alike in all repetitions).
_ROWS, _CHANGES, _SHARED = 12, 8, 0.3
_MOST_KEYS = 2_000_000  # stretches of poses that are kept, some 0.2 GB; of more every second, or third... (chosen)
_DIGIT = 1e-7  # m, to which positions are compared; below the noise of any reference


def copied_runs(runs: Sequence[Trajectory]) -> Iterator[Finding]:
    """Runs that repeat an earlier one."""
    every = -(-sum(len(run.pose_times) for run in runs) // _MOST_KEYS)
    seen: dict[int, str] = {}
    copies: dict[str, str] = {}
    for run in runs:
        keys = {key for key in _keys(run) if key % every == 0}
        shared = [seen[key] for key in keys if key in seen]
        if keys and len(shared) > _SHARED * len(keys):
            copies[run.id] = max(set(shared), key=shared.count)
        else:
            seen.update(dict.fromkeys(keys, run.id))
    if copies:
        first = next(iter(copies.items()))
        yield Finding(
            kind="copies",
            what=f"{plural(len(copies), 'run')} {'repeats' if len(copies) == 1 else 'repeat'} the poses of "
            f"others, as {first[0]} those of {first[1]}: what validates then was trained on",
            where=runs_in_words(list(copies), len(runs)),
            severity="error",
            changes={"leave_out": list(copies)},
        )


def _keys(run: Trajectory) -> Iterator[int]:
    """Digests of every stretch of reference positions that change often enough."""
    rounded = np.round(run.poses[:, :2] / _DIGIT).astype(np.int64)
    changes = np.append(0, np.cumsum(np.any(np.diff(rounded, axis=0) != 0, axis=1)))
    for row in range(len(rounded) - _ROWS + 1):
        if changes[row + _ROWS - 1] - changes[row] >= _CHANGES:
            yield xxh3_64_intdigest(rounded[row : row + _ROWS].tobytes())
