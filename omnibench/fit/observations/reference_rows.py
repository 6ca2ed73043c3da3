"""Rows of what was observed of runs: poses and references, each a row of three coordinates in m, m and rad.

A reference of a length stands in the first coordinate, one of a place in the first two, one of an angle in the third;
references of one span of time share a row where they can. A coordinate that was not measured is 0 in what is observed
and in what a model predicts, so that a cost of pose errors takes rows of every kind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.data.references.run_references import UNITS, ReferenceKind, References
from omnibench.errors import DataError
from omnibench.fit.observations.start_pose import StartPoses
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import WheelLog

PoseRows = Literal["final", "reference", "none"]
_SINCE = ("turn", "gyro")  # angles that count from t0
# Squares of distances from their mean, in standard deviations and less what noise adds, that positions of a run need to
# tell its start heading: to 0.1 rad, which makes lengths 0.5 % wrong. Chosen.
_TELLING = 100.0
_NAMES = {(True, True, False): "position", (False, False, True): "heading"}


@dataclass(frozen=True, eq=False)
class ReferenceRows:
    """S rows of some runs, by run: its poses, then its references.

    trajectory (S,): index of each row's run. lengths, angles (S,): the kind of what stands in the first two coordinates
    and in the third: ``pose``, a kind of reference, ``gyro`` for a heading from the start, or empty. t0, t1 (S,): s.
    values, sigmas (S, 3): m, m, rad; NaN where nothing was measured, sigmas of poses, too. logs: of each run, with a
    stamp at each time needed.
    """

    runs: tuple[Trajectory, ...]
    trajectory: NDArray[np.intp]
    lengths: NDArray[np.str_]
    angles: NDArray[np.str_]
    t0: Array
    t1: Array
    values: Array
    sigmas: Array

    @cached_property
    def observed(self) -> Array:
        """What was observed (S, 3), 0 where nothing was measured."""
        return np.nan_to_num(self.values)

    @cached_property
    def measured(self) -> NDArray[np.bool_]:
        """True (S, 3) for what was measured."""
        return np.asarray(~np.isnan(self.values))

    @cached_property
    def offset_sigmas(self) -> Array:
        """Standard deviations (S, 3) that a gyro's offset adds to the angles, rad; those of a session err alike."""
        rates = np.array([0.0 if run.references is None else run.references.rate_sigma for run in self.runs])
        counted = np.isin(self.angles, _SINCE)
        sigmas = np.zeros(self.values.shape)
        sigmas[counted, 2] = (rates[self.trajectory] * (self.t1 - self.t0))[counted]
        return sigmas

    @cached_property
    def whole_sigmas(self) -> Array:
        """Standard deviations (S, 3) of each row by itself, a gyro's offset included; NaN as ``sigmas``."""
        return np.hypot(self.sigmas, self.offset_sigmas)

    @cached_property
    def of_references(self) -> NDArray[np.bool_]:
        """True (S,) for rows that are no poses."""
        return np.asarray(self.lengths != "pose")

    def kinds_in(self, kind: ReferenceKind) -> NDArray[np.bool_]:
        """True (S,) for the rows that hold a reference of some kind; headings from the start are headings."""
        kinds = ("heading", "gyro") if kind == "heading" else (kind,)
        return np.asarray(np.isin(self.angles if UNITS[kind] == "rad" else self.lengths, kinds))

    @cached_property
    def logs(self) -> list[WheelLog]:
        """The runs' logs, with stamps at all times of their rows."""
        return [run.log(self._stamps(index)) for index, run in enumerate(self.runs)]

    @cached_property
    def needs_lengths(self) -> bool:
        """True if a distance was measured."""
        return bool((self.lengths == "distance").any())

    @cached_property
    def begins_at_start(self) -> NDArray[np.bool_]:
        """True (S, 3) for what is measured in a fixed frame, so that it counts from the run's start."""
        places = (self.lengths == "pose") | (self.lengths == "position")
        return np.column_stack([places, places, (self.angles == "pose") | (self.angles == "heading")])

    @cached_property
    def tells_no_heading(self) -> NDArray[np.bool_]:
        """True (S,) for positions of a run that hardly leaves its place, so that they do not tell its start heading.

        A heading that is fitted to noise makes the path longer than it was: such positions say nothing of lengths.
        """
        found = np.zeros(len(self.trajectory), dtype=bool)
        if (start := self._unknown_starts) is None:
            return found
        squares = start.spread - 2 * np.maximum(np.bincount(start.of_placed, minlength=start.count) - 1, 0)
        found[start.placed] = (squares < _TELLING)[start.of_placed]
        return found

    def start_columns(self, run: int, predicted: Array) -> Array:
        """Derivatives (K, 3, 3) of the rows of a run by its start x, y and heading, (K, 3, 0) where that is known.

        predicted (S, 3): of all rows.
        """
        own = self.trajectory == run
        fixed = self.begins_at_start[own]
        if self.runs[run].start_known or not fixed.any():
            return np.zeros((*fixed.shape, 0))
        x, y = (predicted[own] - predicted[own].mean(axis=0))[:, :2].T
        nothing, one = np.zeros(len(fixed)), np.ones(len(fixed))
        columns = np.array([[one, nothing, -y], [nothing, one, x], [nothing, nothing, one]])  # (3, 3, K)
        return np.moveaxis(columns, 2, 0) * fixed[..., None]

    @property
    def numbers_of_starts(self) -> int:
        """Numbers that unknown start poses take: three of a run with positions and one of a run with headings alone."""
        if (start := self._unknown_starts) is None:
            return 0
        places, headings = (np.bincount(of, minlength=start.count) for of in (start.of_placed, start.of_headed))
        return int(np.where(places > 0, np.minimum(3, 2 * places + headings), 1).sum())

    def predicted(self, poses: Array, lengths: Array) -> Array:
        """What a model predicts (P, S, 3), from its poses (P, T, 3) and distances driven (P, T) at the logs' stamps."""
        begin, end = self._stamp_of_rows
        first, last = poses[:, begin], poses[:, end]
        result = np.zeros((len(poses), len(self.trajectory), 3))
        world = (self.lengths == "pose") | (self.lengths == "position")
        result[:, world, :2] = last[:, world, :2]
        driven = self.lengths == "distance"
        result[:, driven, 0] = lengths[:, end[driven]] - lengths[:, begin[driven]]
        moved = self.lengths == "displacement"
        cosine, sine = np.cos(first[:, moved, 2]), np.sin(first[:, moved, 2])
        across = last[:, moved, :2] - first[:, moved, :2]
        result[:, moved, 0] = cosine * across[..., 0] + sine * across[..., 1]
        result[:, moved, 1] = cosine * across[..., 1] - sine * across[..., 0]
        absolute = (self.angles == "pose") | (self.angles == "heading")
        result[:, absolute, 2] = last[:, absolute, 2]
        turned = np.isin(self.angles, _SINCE)
        result[:, turned, 2] = last[:, turned, 2] - first[:, turned, 2]
        if (start := self._unknown_starts) is not None:
            places, headings = start.fitted(result[:, start.placed, :2], result[:, start.headed, 2])
            result[:, start.placed, :2], result[:, start.headed, 2] = places, headings
        return result

    def slopes(self, poses: Array, moving: Array, driving: Array) -> Array:
        """Derivatives (S, 3, n) of what a model predicts.

        poses (T, 3): its poses at the logs' stamps. moving (T, 3, n), driving (T, n): derivatives of these and of the
        distances driven.
        """
        begin, end = self._stamp_of_rows
        result = np.zeros((len(self.trajectory), 3, moving.shape[2]))
        world = (self.lengths == "pose") | (self.lengths == "position")
        result[world, :2] = moving[end[world], :2]
        driven = self.lengths == "distance"
        result[driven, 0] = driving[end[driven]] - driving[begin[driven]]
        moved = self.lengths == "displacement"
        result[moved, :2] = _displacement_slopes(poses, moving, begin[moved], end[moved])
        absolute = (self.angles == "pose") | (self.angles == "heading")
        result[absolute, 2] = moving[end[absolute], 2]
        turned = np.isin(self.angles, _SINCE)
        result[turned, 2] = moving[end[turned], 2] - moving[begin[turned], 2]
        if (start := self._unknown_starts) is not None:
            places, headings = poses[end[start.placed], :2], poses[end[start.headed], 2]
            columns = start.slopes(places, headings, result[start.placed, :2], result[start.headed, 2])
            result[start.placed, :2], result[start.headed, 2] = columns
        return result

    def start_turns(self, poses: Array) -> Array:
        """Likeliest headings (Z,) of the runs' unknown starts, for poses (T, 3) at the logs' stamps; 0 of others."""
        turns = np.zeros(len(self.runs))
        if (start := self._unknown_starts) is not None:
            _, end = self._stamp_of_rows
            found = start.turns(poses[None, end[start.placed], :2], poses[None, end[start.headed], 2])[0]
            runs = np.unique(self.trajectory[np.concatenate([start.placed, start.headed])])
            turns[runs] = found
        return turns

    @cached_property
    def _unknown_starts(self) -> StartPoses | None:
        """The start poses of the runs that have positions or headings in a frame in which their start is not known."""
        unknown = np.array([not run.start_known for run in self.runs], dtype=bool)[self.trajectory]
        placed = np.flatnonzero(unknown & (self.lengths == "position"))
        headed = np.flatnonzero(unknown & (self.angles == "heading"))
        if not len(placed) and not len(headed):
            return None
        runs = np.unique(self.trajectory[np.concatenate([placed, headed])])
        of_placed, of_headed = (np.searchsorted(runs, self.trajectory[rows]) for rows in (placed, headed))
        position_weights, heading_weights = self.sigmas[placed, :2] ** -2.0, self.sigmas[headed, 2] ** -2.0
        measured = self.values[placed, :2], self.values[headed, 2]
        return StartPoses(len(runs), placed, headed, of_placed, of_headed, *measured, position_weights, heading_weights)

    def _stamps(self, index: int) -> Array:
        own = self.trajectory == index
        return np.unique(np.concatenate([self.t0[own], self.t1[own]]))

    @cached_property
    def _stamp_of_rows(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Indices (S,) among all stamps, run after run, of the rows' t0 and t1."""
        begin, end = (np.zeros(len(self.trajectory), dtype=np.intp) for _ in range(2))
        before = 0
        for index, log in enumerate(self.logs):
            own = self.trajectory == index
            begin[own] = before + np.searchsorted(log.stamps, self.t0[own])
            end[own] = before + np.searchsorted(log.stamps, self.t1[own])
            before += len(log.stamps)
        return begin, end


def reference_rows(
    runs: Sequence[Trajectory], poses: PoseRows, weights: Sequence[float] = (1.0, 1.0, 1.0), cost: str = ""
) -> ReferenceRows:
    """The rows of some runs: the last pose, all poses after the start, or none; and all references.

    weights (3,): of the coordinates in a cost, whose name is ``cost``; rows of which none counts are left out.
    DataError: a run then has no row.
    """
    used = np.array(weights, dtype=bool)
    parts = []
    for index, run in enumerate(runs):
        rows = [*_pose_rows(run, poses), *_rows_of(run.references)]
        rows = [row for row in rows if (used & ~np.isnan(row.values)).any()]
        if not rows and poses != "none":
            what = _NAMES.get(tuple(used.tolist()), "motion")
            raise DataError(f"trajectory {run.id} has no reference of its {what}, which the cost {cost} needs")
        parts += [(index, row) for row in rows]
    return ReferenceRows(
        tuple(runs),
        np.array([index for index, _ in parts], dtype=np.intp),
        np.array([row.length for _, row in parts], dtype=str),
        np.array([row.angle for _, row in parts], dtype=str),
        np.array([row.t0 for _, row in parts]),
        np.array([row.t1 for _, row in parts]),
        np.array([row.values for _, row in parts]).reshape(-1, 3),
        np.array([row.sigmas for _, row in parts]).reshape(-1, 3),
    )


@dataclass(eq=False)
class _Row:
    """A row that is being made."""

    t0: float
    t1: float
    length: str
    angle: str
    values: Array
    sigmas: Array


def _pose_rows(run: Trajectory, poses: PoseRows) -> list[_Row]:
    if not run.has_poses or poses == "none":
        return []
    chosen = [len(run.poses) - 1] if poses == "final" else range(1, len(run.poses))
    nothing = np.full(3, np.nan)
    return [_Row(t, t, "pose", "pose", run.poses[row], nothing) for row in chosen for t in [float(run.pose_times[row])]]


def _rows_of(references: References | None) -> list[_Row]:
    """The references' rows; an angle joins the first row of the same span that has none."""
    rows: list[_Row] = []
    free: dict[tuple[float, float], list[_Row]] = {}  # rows without an angle by their span, the first one last
    if references is None:
        return rows
    each = zip(
        references.kinds.tolist(), references.t0, references.t1, references.values, references.sigmas, strict=True
    )
    for kind, t0, t1, value, sigma in sorted(each, key=lambda one: (one[2], one[1], UNITS[one[0]])):
        if UNITS[kind] == "m":
            row = _Row(t0, t1, kind, "", np.append(value, np.nan), np.append(sigma, np.nan))
            rows.append(row)
            free.setdefault((t0, t1), []).insert(0, row)
            continue
        angle = "gyro" if kind == "heading" and t0 < t1 else kind
        if waiting := free.get((t0, t1)):
            row = waiting.pop()
        else:
            row = _Row(t0, t1, "", "", np.full(3, np.nan), np.full(3, np.nan))
            rows.append(row)
        row.angle, row.values[2], row.sigmas[2] = angle, value[0], sigma[0]
    return rows


def _displacement_slopes(poses: Array, moving: Array, begin: NDArray[np.intp], end: NDArray[np.intp]) -> Array:
    """Derivatives (D, 2, n) of displacements in the frames of poses ``begin`` (D,)."""
    cosine, sine = np.cos(poses[begin, 2])[:, None], np.sin(poses[begin, 2])[:, None]
    across, by = poses[end, :2] - poses[begin, :2], moving[end, :2] - moving[begin, :2]
    forward = cosine * across[:, :1] + sine * across[:, 1:]
    left = cosine * across[:, 1:] - sine * across[:, :1]
    turning = moving[begin, 2]
    return np.stack(
        [
            cosine * by[:, 0] + sine * by[:, 1] + left * turning,
            cosine * by[:, 1] - sine * by[:, 0] - forward * turning,
        ],
        axis=1,
    )
