"""Sums over the samples up to each stamp, of which a lower bound is made, and the error of computing them.

At row 3 = m3 + d, with the angles a_k that sample k drives and c_k before it along the fitted directions,

    S_sj(d) = sum_k a_kj exp(i (m3.C_k + d.c_k)),   dS_sj/dd_l = i sum_k a_kj c_kl exp(...)        (S1)
    |d^2 S_sj / dd_l dd_m| <= sum_k |a_kj c_kl c_km|.                                              (S2)

An Euler step is one sample k. An arc is an integral along the sample, taken by Gauss-Legendre quadrature with enough
nodes that its error (impulses.py) sums up to q = 1e-9 m at most over a run, for every matrix of the box.

Rounding: with u = 2^-53, n additions into one number are wrong by less than 1.01 n u of the largest magnitude that
their partial sums have (Higham, Accuracy and Stability of Numerical Algorithms, 2002, sections 3.1 and 4.2). With L the
longest path of the box (m) and A the largest heading that it allows at any sample (rad), partial sums of phases are at
most A and those of the sums at most L: the phases are wrong by at most 1.01 n u A, hence the sums by 1.01 n u (1 + A)
L. In a part of the box the slopes are multiplied by delta with |delta.c_k| <= C, the bounds of curvature by C^2 / 2.
Offsets and headings are differences of numbers of size P. Altogether the rounding is below

    e = 8 n u (1 + L) (2 + A) (1 + C)^2 (1 + P).                                                   (S3)

The factor 8 covers the few operations on each term; n are the samples, the stamps and 1000 for all else, which are some
dozens.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.errors import ConfigError
from omnibench.fit.evaluator.element_box import ElementBox
from omnibench.fit.evaluator.impulses import Path, cut, impulses, make_path, quadrature
from omnibench.fit.problem import CalibrationProblem
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Complex, Integration, WheelLog
from omnibench.robot.stored.odometry_of_stored import are_many

# m: error of the quadrature of arcs, which bounds subtract: a millionth of the millimetre that poses are known to.
# Half of it and twice move a bound by 6e-6 of the gap that is asked for (tests/studies/constants_fit.py).
QUADRATURE = 1e-9


class StampSums:
    """The sums of Eq. (S1). curvature (S, 1 + r, r, r): bounds of their second derivatives, Eq. (S2).

    fitted (r, N): orthonormal directions of wheel rates. elements: a box that holds all matrices of the problem's box.
    ConfigError where arcs are too long for the quadrature.
    """

    def __init__(self, problem: CalibrationProblem, fitted: Array, elements: ElementBox) -> None:
        design = problem.start.reshape(3, -1)
        logs = problem.objective.logs(problem.trajectories)
        integration = problem.integration
        paths = _Paths(logs, integration) if are_many(logs) else [make_path(log, integration) for log in logs]
        row, speed = elements.largest[2], elements.speed
        nodes = quadrature(paths, row, speed, QUADRATURE, integration)
        if nodes is None:
            raise ConfigError("samples turn too far for a lower bound with arcs; use integration euler")
        self._quadrature = QUADRATURE if integration == "arc" else 0.0
        columns = _Columns(paths, [float(log.start[2]) for log in logs], design, fitted, row, integration, nodes)
        self._runs: Iterable[_RunColumns] = columns if isinstance(paths, _Paths) else list(columns)
        self.curvature = np.concatenate([of_run.curvature for of_run in self._runs])
        reaches = np.array([[(np.abs(path.angles) @ speed).sum(), _most(path.before, row)] for path in paths])
        longest, angle = reaches.max(axis=0).tolist()
        self._farthest = np.max([np.abs(of_run.turns).max(axis=0) for of_run in self._runs], axis=0)  # |c|: (r,)
        additions = nodes * max(len(path.angles) for path in paths) + len(self.curvature) + 1000
        self._rounding = 4 * np.finfo(float).eps * additions * (1 + longest) * (2 + angle)  # eps = 2 u

    def at(self, row_3: Array) -> tuple[Complex, Complex]:
        """Sums (S, 1 + r) and slopes (S, 1 + r, r) at deviations (r,) of row 3, Eq. (S1).

        The first of the 1 + r is the design's displacement, the others are the regressors of rows 1 and 2.
        """
        sums = np.concatenate([of_run.up_to_stamps(row_3) for of_run in self._runs])  # (S, (2 + r)(1 + r))
        size = len(row_3)
        parts = sums.reshape(len(sums), 1 + size, 2 + size)
        whole = np.concatenate([parts[:, :, :1] + 1j * parts[:, :, 1:2], parts[:, :, 2:]], axis=2)
        return whole[:, 0], 1j * np.moveaxis(whole[:, 1:], 1, 2)

    def error(self, reach: Array, size: float) -> float:
        """Error, m or rad, of quadrature and rounding, q + e of Eq. (S3), in a part of half-widths ``reach`` (r,).

        size: magnitude P of poses and references.
        """
        turned = float(self._farthest @ reach)
        return self._quadrature + self._rounding * (1 + turned) ** 2 * (1 + size)


def _most(before: Array, row: Array) -> float:
    """The largest heading, rad, that a row of magnitudes allows at the pieces of a path."""
    return float((np.abs(before) @ row).max(initial=0.0))


@dataclass(frozen=True, eq=False)
class _Paths:
    """The paths of logs, made anew whenever they are gone through, as their samples are read then."""

    logs: Sequence[WheelLog]
    integration: Integration

    def __iter__(self) -> Iterator[Path]:
        return (make_path(log, self.integration) for log in self.logs)


@dataclass(frozen=True, eq=False)
class _Columns:
    """Terms of the sums of each run, computed whenever it is gone through.

    headings: of the runs' starts, rad. row: the largest magnitudes of row 3. Else as in StampSums.
    """

    paths: Iterable[Path]
    headings: Sequence[float]
    design: Array
    fitted: Array
    row: Array
    integration: Integration
    nodes: int

    def __iter__(self) -> Iterator[_RunColumns]:
        for path, heading in zip(self.paths, self.headings, strict=True):
            yield self._of(path, heading)

    def _of(self, path: Path, heading: float) -> _RunColumns:
        design, fitted = self.design, self.fitted
        (whole,) = cut(path, self.row, np.inf)
        # One row of zeros more: the sum up to a stamp at the end, or at t = 0, then begins at a row that exists.
        angles, before = (
            np.vstack([np.reshape(part, (-1, design.shape[1])), np.zeros((1, design.shape[1]))])
            for part in impulses(path, whole, self.integration, self.nodes)
        )
        moved, turns = angles @ (design[0] + 1j * design[1]), before @ fitted.T
        sources = np.column_stack([moved.real, moved.imag, angles @ fitted.T])
        columns = np.concatenate([sources, *(sources * turn[:, None] for turn in turns.T)], axis=1)
        sizes = np.column_stack([np.abs(moved), np.abs(angles @ fitted.T)])
        return _RunColumns(columns, before @ design[2] + heading, turns, path.ends * self.nodes, sizes)


@dataclass(frozen=True, eq=False)
class _RunColumns:
    """A run's impulses, n: columns (n, (2 + r)(1 + r)), phase (n,) at the design, turns (n, r) along the fitted
    directions, sizes (n, 1 + r) of Eq. (S2); ends (S,): the impulses up to each stamp.
    """

    columns: Array
    phase: Array
    turns: Array
    ends: NDArray[np.intp]
    sizes: Array

    @property
    def curvature(self) -> Array:
        """Bounds (S, 1 + r, r, r) of the second derivatives, Eq. (S2)."""
        pairs = np.einsum("ij,il,im->ijlm", self.sizes, np.abs(self.turns), np.abs(self.turns))
        sums: Array = np.cumsum(np.roll(pairs, 1, axis=0), axis=0)[self.ends]  # the row of zeros comes first
        return sums

    def up_to_stamps(self, row_3: Array) -> Complex:
        """Sums (S, c) of columns (n, c) times exp(i (phase + turns.row_3)) up to each stamp."""
        columns, ends = self.columns, self.ends
        angle = self.phase + self.turns @ row_3
        cosine, sine = np.cos(angle), np.sin(angle)
        if len(ends) == 1:
            last = int(ends[0])
            return (cosine[:last] @ columns[:last] + 1j * (sine[:last] @ columns[:last]))[None]
        firsts = np.concatenate([[0], ends[:-1]])
        between: Complex = np.add.reduceat(columns * cosine[:, None], firsts) + 1j * np.add.reduceat(
            columns * sine[:, None], firsts
        )
        between[firsts == ends] = 0.0  # reduceat returns the first row for an empty part
        return np.cumsum(between, axis=0)
