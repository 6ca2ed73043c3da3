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
from omnibench.data.references import KINDS, UNITS, ReferenceKind, References
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, RunSamples, WheelLog
from omnibench.robot.stored_odometry import odometry_of

_GRID = 16  # headings among which Newton's steps begin: Eq. (2) has two waves a turn
_STEPS = 12  # Newton's steps; four settle
_FARTHEST, _SETTLED = 0.3, 1e-13  # rad: the longest step, and one that is rounding
_LEAST = 1e-12  # share of the weights: less curvature is rounding, and the heading is not determined
PoseRows = Literal["final", "reference", "none"]
_SINCE = ("turn", "gyro")  # angles that count from t0
# Squares of distances from their mean, in standard deviations and less what noise adds, that positions of a run need to
# tell its start heading: to 0.1 rad, which makes lengths 0.5 % wrong. Chosen.
_TELLING = 100.0
_NAMES = {(True, True, False): "position", (False, False, True): "heading"}
_BLOCK = 200_000  # speeds at a time (candidates x samples), 2 MB, as in odometry.py
_STANDING = 1e-12  # m: a sample that is shorter has no direction, and its length no derivative


@dataclass(frozen=True, eq=False)
class StartPoses:
    """Unknown start poses of Z runs, numbered from 0, in the frame of their positions and headings: the profile.

    Let q_i be the odometry's positions from the origin, f_k its headings, z_i and h_k what was measured, with the
    weights u_i, v_i (of x and y) and w_k. The start (p, s) minimises

        F = 1/2 sum_i |p + R(s) q_i - z_i|^2_(u, v) + 1/2 sum_k w_k (s + f_k - h_k)^2.                        (1)

    For a given s the likeliest p makes the weighted means of x and y agree, so that q and z count from their means, x
    and y each with its own weights. With c = cos s, n = sin s and sums such as A_xx = sum u q_x^2, what is left is

        F(s) = 1/2 (c^2 A + n^2 B - 2 c n C) - c a + n b + 1/2 W s^2 - s d + const,                           (2)

    of one variable: the lowest of a grid, then Newton's steps. Its derivatives by the q and f are those of an implicit
    function, F_ss ds = -dF_s.

    placed (I,), headed (J,): their positions and headings among all rows; of_placed (I,), of_headed (J,): the run of
    each. positions (I, 2), headings (J,): what was measured. position_weights (I, 2), heading_weights (J,): 1/sigma^2.
    """

    count: int
    placed: NDArray[np.intp]
    headed: NDArray[np.intp]
    of_placed: NDArray[np.intp]
    of_headed: NDArray[np.intp]
    positions: Array
    headings: Array
    position_weights: Array
    heading_weights: Array

    @property
    def spread(self) -> Array:
        """Squares (Z,) of the measured positions about their means and of heading's information, in units of sigma."""
        squares = self.position_weights * np.square(self._centred(self.positions))
        return self._sum_placed(squares.sum(axis=1)) + self._sum_headings(self.heading_weights)

    def fitted(self, positions: Array, headings: Array) -> tuple[Array, Array]:
        """Positions (P, I, 2) and headings (P, J) of odometry from the origin, seen from the likeliest starts."""
        turns = self.turns(positions, headings)
        of_positions = turns[:, self.of_placed]
        cosine, sine = np.cos(of_positions), np.sin(of_positions)
        x, y = positions[..., 0], positions[..., 1]
        moved = np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
        errors = moved - self.positions
        for axis in range(2):
            errors[..., axis] -= self._means(errors[..., axis], axis)
        return self.positions + errors, headings + turns[:, self.of_headed]

    def slopes(self, positions: Array, headings: Array, moving: Array, turning: Array) -> tuple[Array, Array]:
        """Derivatives (I, 2, n) and (J, n) of what ``fitted`` gives for one candidate.

        moving (I, 2, n), turning (J, n): those of positions (I, 2) and headings (J,).
        """
        turns = self.turns(positions[None], headings[None])[0]
        cosine, sine = np.cos(turns[self.of_placed]), np.sin(turns[self.of_placed])
        rotation = np.array([[cosine, -sine], [sine, cosine]])  # (2, 2, I)
        quarter = np.array([[-sine, -cosine], [cosine, -sine]])  # its derivative by the heading
        path = np.einsum("abi,ib->ia", rotation, positions)
        errors, centred = self._centred(path - self.positions), self._centred(path)
        by_turn = self._centred(np.einsum("abi,ib->ia", quarter, positions))
        direct = self._centred(np.einsum("abi,ibn->ian", rotation, moving))
        turned = self._centred(np.einsum("abi,ibn->ian", quarter, moving))
        weights = self.position_weights
        bend = (weights * (np.square(by_turn) - errors * centred)).sum(axis=1)
        of_headings = self._sum_headings(self.heading_weights)
        curvature = self._sum_placed(bend) + of_headings
        total = self._sum_placed((weights * np.square(centred)).sum(axis=1)) + of_headings
        by_positions = (weights * by_turn)[..., None] * direct + (weights * errors)[..., None] * turned
        change = self._sum_placed(by_positions.sum(axis=1).T) + self._sum_headings(self.heading_weights * turning.T)
        determined = curvature > _LEAST * total
        by_candidate = np.where(determined, -change / np.where(determined, curvature, 1.0), 0.0).T  # (Z, n)
        of_positions = direct + by_turn[..., None] * by_candidate[self.of_placed][:, None]
        return of_positions, turning + by_candidate[self.of_headed]

    def turns(self, positions: Array, headings: Array) -> Array:
        """Likeliest start headings (P, Z), Eq. (2)."""
        u, v = self.position_weights[:, 0], self.position_weights[:, 1]
        along = [self._about(positions[..., axis], 0) for axis in range(2)]
        across = [self._about(positions[..., axis], 1) for axis in range(2)]
        seen_x, seen_y = self._about(self.positions[:, 0], 0), self._about(self.positions[:, 1], 1)
        a_term = self._sum_placed(u * along[0] ** 2 + v * across[1] ** 2)
        b_term = self._sum_placed(u * along[1] ** 2 + v * across[0] ** 2)
        mixed = self._sum_placed(u * along[0] * along[1] - v * across[0] * across[1])
        forward = self._sum_placed(u * along[0] * seen_x + v * across[1] * seen_y)
        sideways = self._sum_placed(u * along[1] * seen_x - v * across[0] * seen_y)
        weight = self._sum_headings(self.heading_weights)
        pull = self._sum_headings((self.headings - headings) * self.heading_weights)

        def value(turn: Array) -> Array:
            c, n = np.cos(turn), np.sin(turn)
            waves: Array = (c**2 * a_term + n**2 * b_term) / 2 - c * n * mixed - c * forward + n * sideways
            return waves + weight * turn**2 / 2 - turn * pull

        middle = pull / np.where(weight > 0, weight, 1.0)
        grid = np.append(np.linspace(-np.pi, np.pi, _GRID, endpoint=False), 0.0)
        tries = middle + grid[:, None, None]
        turn = np.take_along_axis(tries, np.argmin(value(tries), axis=0)[None], axis=0)[0]
        for _ in range(_STEPS):
            c, n = np.cos(turn), np.sin(turn)
            slope = c * n * (b_term - a_term) - (c**2 - n**2) * mixed + n * forward + c * sideways
            slope += weight * turn - pull
            bend = (c**2 - n**2) * (b_term - a_term) + 4 * c * n * mixed + c * forward - n * sideways + weight
            step = np.where(bend > 0, slope / np.maximum(bend, np.finfo(float).tiny), 0.0)
            turn = turn - np.maximum(np.minimum(step, _FARTHEST), -_FARTHEST)
            if np.abs(step).max(initial=0.0) < _SETTLED:
                break
        return turn

    def _sum_placed(self, values: Array) -> Array:
        """Sums (..., Z) of values (..., I) over the positions of each run."""
        return np.asarray(values @ self._indicators[0])

    def _sum_headings(self, values: Array) -> Array:
        """Sums (..., Z) of values (..., J) over the headings of each run."""
        return np.asarray(values @ self._indicators[1])

    @cached_property
    def _indicators(self) -> tuple[Array, Array]:
        """1 where a position (I, Z), and a heading (J, Z), is of a run."""
        runs = np.arange(self.count)
        return (self.of_placed[:, None] == runs).astype(float), (self.of_headed[:, None] == runs).astype(float)

    def _means(self, values: Array, axis: int) -> Array:
        """Values (..., I) replaced by their run's mean with the weights of x (axis 0) or y (1)."""
        weights = self.position_weights[:, axis]
        totals = np.maximum(self._sum_placed(weights), np.finfo(float).tiny)
        return np.asarray((self._sum_placed(values * weights) / totals)[..., self.of_placed])

    def _about(self, values: Array, axis: int) -> Array:
        """Values (..., I) less their run's mean with the weights of x (axis 0) or y (1)."""
        return np.asarray(values - self._means(values, axis))

    def _centred(self, values: Array) -> Array:
        """Values (I, 2) or (I, 2, n) less their run's means, those of x with the weights of x, of y with y's."""
        parts = [np.moveaxis(self._about(np.moveaxis(values[:, axis], 0, -1), axis), -1, 0) for axis in range(2)]
        return np.stack(parts, axis=1)


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
        """Observed values (S, 3), 0 where nothing was measured."""
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

    @cached_property
    def logs(self) -> list[WheelLog]:
        """The runs' logs, with stamps at all times of their rows."""
        logs = []
        for index, run in enumerate(self.runs):
            rows = self.trajectory == index
            logs.append(run.log(np.unique(np.concatenate([self.t0[rows], self.t1[rows]]))))
        return logs

    @cached_property
    def needs_lengths(self) -> bool:
        """True if a distance was measured."""
        return bool((self.lengths == "distance").any())

    @cached_property
    def tells_no_heading(self) -> NDArray[np.bool_]:
        """True (S,) for positions of a run that hardly leaves its place, so that they do not tell its start heading.

        A heading that is fitted to noise makes the path longer than it was: such positions say nothing of lengths.
        """
        untold = np.zeros(len(self.trajectory), dtype=bool)
        if (start := self._unknown_starts) is None:
            return untold
        squares = start.spread - 2 * np.maximum(np.bincount(start.of_placed, minlength=start.count) - 1, 0)
        untold[start.placed] = (squares < _TELLING)[start.of_placed]
        return untold

    def predicted(self, poses: Array, lengths: Array) -> Array:
        """Predictions (P, S, 3) of a model from its poses (P, T, 3) and distances driven (P, T) at the logs' stamps."""
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
        # Displacements are seen in the frame of the first pose.
        first, last = begin[moved], end[moved]
        cosine, sine = np.cos(poses[first, 2])[:, None], np.sin(poses[first, 2])[:, None]
        across, by = poses[last, :2] - poses[first, :2], moving[last, :2] - moving[first, :2]
        forward = cosine * across[:, :1] + sine * across[:, 1:]
        left = cosine * across[:, 1:] - sine * across[:, :1]
        result[moved, 0] = cosine * by[:, 0] + sine * by[:, 1] + left * moving[first, 2]
        result[moved, 1] = cosine * by[:, 1] - sine * by[:, 0] - forward * moving[first, 2]
        absolute = (self.angles == "pose") | (self.angles == "heading")
        result[absolute, 2] = moving[end[absolute], 2]
        turned = np.isin(self.angles, _SINCE)
        result[turned, 2] = moving[end[turned], 2] - moving[begin[turned], 2]
        if (start := self._unknown_starts) is not None:
            places, headings = poses[end[start.placed], :2], poses[end[start.headed], 2]
            columns = start.slopes(places, headings, result[start.placed, :2], result[start.headed, 2])
            result[start.placed, :2], result[start.headed, 2] = columns
        return result

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

    @cached_property
    def _stamp_of_rows(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Indices (S,) among all stamps, run after run, of the rows' t0 and t1."""
        begin, end = (np.zeros(len(self.trajectory), dtype=np.intp) for _ in range(2))
        before = 0
        for index, log in enumerate(self.logs):
            rows = self.trajectory == index
            begin[rows] = before + np.searchsorted(log.stamps, self.t0[rows])
            end[rows] = before + np.searchsorted(log.stamps, self.t1[rows])
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
        rows = []
        if run.has_poses and poses != "none":
            for number in [len(run.poses) - 1] if poses == "final" else range(1, len(run.poses)):
                time = float(run.pose_times[number])
                rows.append(_Row(time, time, "pose", "pose", run.poses[number], np.full(3, np.nan)))
        rows += _rows_of(run.references)
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


def _rows_of(references: References | None) -> list[_Row]:
    """The references' rows; an angle joins the first row of the same span that has none."""
    rows: list[_Row] = []
    free: dict[tuple[float, float], list[_Row]] = {}  # rows without an angle by their span, the first one last
    if references is None:
        return rows
    measured = zip(
        references.kinds.tolist(), references.t0, references.t1, references.values, references.sigmas, strict=True
    )
    for kind, t0, t1, value, sigma in sorted(measured, key=lambda one: (one[2], one[1], UNITS[one[0]])):
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


class ReferenceBatch:
    """Predictions of some rows for any number of candidate matrices, in the place of an OdometryBatch's poses.

    trajectory (S,): index of the run of each row.
    """

    def __init__(self, rows: ReferenceRows, integration: Integration) -> None:
        self.rows = rows
        self.trajectory = rows.trajectory
        self._odometry = odometry_of(rows.logs, integration)
        self._ways = [_Ways(log) for log in rows.logs] if rows.needs_lengths else []

    def poses(self, matrices: Array) -> Array:
        """Predictions (P, S, 3) in m, m, rad of candidate matrices (P, 3, M)."""
        poses = self._odometry.poses(matrices)
        lengths = np.zeros((len(matrices), len(self._odometry.trajectory)))  # driven at the logs' stamps
        if self._ways:
            lengths = np.concatenate([way.lengths(matrices) for way in self._ways], axis=1)
        return self.rows.predicted(poses, lengths)

    def jacobian(self, matrix: Array) -> Array:
        """Derivatives (S, 3, 3, M) of the predictions with respect to the elements of one matrix (3, M)."""
        moving = self._odometry.jacobian(matrix)
        moving = moving.reshape(*moving.shape[:2], -1)
        driving = np.zeros((len(moving), moving.shape[2]))
        if self._ways:
            of_rows_12 = np.concatenate([way.slopes(matrix) for way in self._ways])  # (T, 2M)
            driving[:, : of_rows_12.shape[1]] = of_rows_12
        slopes = self.rows.slopes(self._odometry.poses(matrix[None])[0], moving, driving)
        return slopes.reshape(len(slopes), 3, *matrix.shape)


class _Ways:
    """The way along the path of one run, up to its stamps, which depends on rows 1 and 2 alone."""

    def __init__(self, log: WheelLog) -> None:
        self._log = log
        self._sample, self._share = RunSamples.of([log.times]).locate([log.stamps])

    @property
    def _angles(self) -> Array:
        """Integrals (F, M) of the signals over each sample, rad."""
        return self._log.signals * np.diff(self._log.times, prepend=0.0)[:, None]

    def lengths(self, matrices: Array) -> Array:
        """Distances (P, T) of matrices (P, 3, M), m."""
        result, angles = np.empty((len(matrices), len(self._sample))), self._angles
        step = max(1, _BLOCK // len(angles))
        for first in range(0, len(matrices), step):
            part = slice(first, first + step)
            moved = np.einsum("fm,pam->paf", angles, matrices[part, :2])
            result[part] = self._at_stamps(np.hypot(moved[:, 0], moved[:, 1]).T).T
        return result

    def slopes(self, matrix: Array) -> Array:
        """Derivatives (T, 2M) of the distances by rows 1 and 2 of one matrix."""
        angles = self._angles
        moved = angles @ matrix[:2].T
        length = np.linalg.norm(moved, axis=1)
        units = moved / np.where(length > _STANDING, length, np.inf)[:, None]
        by_elements = units[:, :, None] * angles[:, None]
        return self._at_stamps(by_elements.reshape(len(moved), -1))

    def _at_stamps(self, of_samples: Array) -> Array:
        """Sums (T, n) up to the stamps of values of samples (F, n)."""
        before = np.vstack([np.zeros(of_samples.shape[1]), np.cumsum(of_samples, axis=0)])
        return np.asarray(before[self._sample] + self._share[:, None] * of_samples[self._sample])


def predicted_by(model: OdometryModel, rows: ReferenceRows) -> Array:
    """Predictions (S, 3) of some rows by a model with its effects. DataError: a run lacks what an effect needs."""
    poses = np.concatenate(model.reported(rows.logs))
    lengths = np.concatenate(model.lengths(rows.logs)) if rows.needs_lengths else np.zeros(len(poses))
    return rows.predicted(poses[None], lengths[None])[0]


def with_mean_errors(errors: Array, matrix: Array, runs: Sequence[Trajectory], integration: Integration) -> Array:
    """Final pose errors (Z, 3) of a matrix, those of runs without poses replaced by their ``mean_errors``."""
    for index, run in enumerate(runs):
        if not run.has_poses and run.references is not None:
            rows = reference_rows([run], "none")
            errors[index] = _means(rows, ReferenceBatch(rows, integration).poses(matrix[None])[0])
    return errors


def mean_errors(model: OdometryModel, run: Trajectory) -> Array:
    """Mean error (3,) of a model at the lengths and places of a run (m), 0, and at its angles (rad); 0 of none."""
    rows = reference_rows([run], "none")
    return _means(rows, predicted_by(model, rows))


def _means(rows: ReferenceRows, predicted: Array) -> Array:
    errors, placed, turned = predicted - rows.observed, rows.lengths != "", rows.angles != ""
    length = np.linalg.norm(errors[placed, :2], axis=1).mean() if placed.any() else 0.0
    return np.array([length, 0.0, np.abs(errors[turned, 2]).mean() if turned.any() else 0.0])


def measured_parts(runs: Sequence[Trajectory]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """True (Z,) for runs of which a length or place was measured, and (Z,) for those of which an angle was."""
    every = ("position", "heading")  # of runs with poses
    kinds = [every if run.has_poses or run.references is None else run.references.kinds.tolist() for run in runs]
    placed, turned = (
        np.array([any(UNITS[kind] == unit for kind in of_run) for of_run in kinds]) for unit in ("m", "rad")
    )
    return placed, turned


def errors_by_kind(model: OdometryModel, runs: Sequence[Trajectory]) -> dict[ReferenceKind, Array]:
    """Magnitudes (n, 2) of a model's errors at the references of each kind: m or rad, and in sigmas."""
    measured = [run for run in runs if run.references is not None]
    if not measured:
        return {}
    rows = reference_rows(measured, "none")
    errors = predicted_by(model, rows) - rows.observed
    ratios = np.square(errors / np.where(rows.measured, rows.whole_sigmas, np.inf))
    magnitudes: dict[ReferenceKind, Array] = {}
    for kind in KINDS:
        angle = UNITS[kind] == "rad"
        kinds = ("heading", "gyro") if kind == "heading" else (kind,)  # headings from the start are headings
        of_kind = np.isin(rows.angles if angle else rows.lengths, kinds)
        if not of_kind.any():
            continue
        part = slice(2, 3) if angle else slice(0, 2)
        size = np.linalg.norm(errors[of_kind][:, part], axis=1)
        counts = rows.measured[of_kind][:, part].sum(axis=1)
        magnitudes[kind] = np.column_stack([size, np.sqrt(ratios[of_kind][:, part].sum(axis=1) / counts)])
    return magnitudes
