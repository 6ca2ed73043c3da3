"""Joining segments: displacements within segments become positions along the whole path."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from omnibench.fit.evaluator.expansion_plan import ExpansionPlan
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Complex


@dataclass(frozen=True, eq=False)
class SegmentJoin:
    """Indices that join the rows of G segments to the S stamps.

    row_of_stamp, log_of_stamp (S,). segment_of_row (R,). anchors (G, N): wheel angles of the segments' anchors, rad.
    last_row, first_of_log (G,): the row at a segment's end, and the first segment of its log.
    """

    row_of_stamp: NDArray[np.intp]
    log_of_stamp: NDArray[np.intp]
    segment_of_row: NDArray[np.intp]
    anchors: Array
    last_row: NDArray[np.intp]
    first_of_log: NDArray[np.intp]

    def positions(self, displacements: Array, matrices: Array) -> Array:
        """x and y (P, 2, S) relative to the start, m, from displacements (P, 2, R) within the rows' segments."""
        if self._uncut:  # the anchors are the starts
            alike = len(self.segment_of_row) == len(self.row_of_stamp)
            return displacements if alike else displacements[:, :, self.row_of_stamp]
        phase = matrices[:, 2] @ self.anchors.T
        turn: Complex = (np.cos(phase) + 1j * np.sin(phase))[:, self.segment_of_row]
        moved = (displacements[:, 0] + 1j * displacements[:, 1]) * turn
        before = np.zeros((len(matrices), len(self.anchors) + 1), dtype=complex)
        np.cumsum(moved[:, self.last_row], axis=1, out=before[:, 1:])
        carried = before[:, :-1] - before[:, self.first_of_log]
        at_rows = moved + carried[:, self.segment_of_row]
        path = at_rows[:, self.row_of_stamp]
        return np.stack([path.real, path.imag], axis=1)

    @cached_property
    def _uncut(self) -> bool:
        return not self.anchors.any()


def join_segments(plan: ExpansionPlan) -> SegmentJoin:
    """The indices of a plan's rows, segments and stamps."""
    row_of_stamp: list[int] = []
    log_of_stamp: list[int] = []
    segment_of_row: list[int] = []
    last_row: list[int] = []
    first_of_log: list[int] = []
    for index, path in enumerate(plan.paths):
        first = len(last_row)
        row_at: dict[int, int] = {}
        for _, ends in plan.row_ends(index):
            row_at |= {end: len(segment_of_row) + offset for offset, end in enumerate(ends)}
            segment_of_row += [len(last_row)] * len(ends)
            last_row.append(len(segment_of_row) - 1)
            first_of_log.append(first)
        row_of_stamp += [row_at[end] for end in path.ends.tolist()]
        log_of_stamp += [index] * len(path.ends)
    anchors = np.array([segment.anchor for segments in plan.segments for segment in segments])
    return SegmentJoin(
        np.array(row_of_stamp),
        np.array(log_of_stamp),
        np.array(segment_of_row),
        anchors,
        np.array(last_row),
        np.array(first_of_log),
    )
