"""How odometry that wanders moves what references say: covariances for a random walk of position and of heading.

While a robot drives, its odometry errs by small independent steps: of the position, by as much in any direction, and of
the heading. A step dW of the heading at the time s turns all of the path that follows about the place p(s),

    dp(t) = dW J (p(t) - p(s)),   J = (0, -1; 1, 0),                                                      (1)

so that the end of a long straight run is known far worse to the side than ahead. With the derivatives S of the numbers
that a run's references measure by all steps, walks of 1 m and 1 rad per sqrt s give them the covariances S S' dt.
"""

from __future__ import annotations

import numpy as np

from omnibench.fit.observations.reference_batch import ReferenceBatch
from omnibench.fit.observations.reference_rows import ReferenceRows
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, OdometryBatch
from omnibench.robot.planar import interpolated, rotation

_STEPS = 60  # steps of a run: variances at its end come out to a thousandth


def wander_of(batch: ReferenceBatch, matrix: Array, integration: Integration) -> list[tuple[Array, Array]]:
    """Covariances (k, k) of the numbers of each run's references, row by row, for unit walks of position and heading.

    matrix (3, M): whose paths count.
    """
    rows = batch.rows
    reach = [max(float(rows.t1[rows.trajectory == run].max()), 1e-9) for run in range(len(rows.runs))]
    ends = [np.linspace(0.0, until, _STEPS + 1) for until in reach]
    logs = [run.log(stamps) for run, stamps in zip(rows.runs, ends, strict=True)]
    poses = OdometryBatch(logs, integration).poses(matrix[None])[0].reshape(len(logs), _STEPS + 1, 3)
    turns = batch.start_turns(matrix)
    return [_of_run(rows, run, ends[run], poses[run], float(turns[run])) for run in range(len(rows.runs))]


def _of_run(rows: ReferenceRows, run: int, ends: Array, ends_of_steps: Array, turn: float) -> tuple[Array, Array]:
    """The covariances (k, k) of one run, whose path has poses (_STEPS + 1, 3) at ``ends``, s, turned by ``turn``."""
    own = np.flatnonzero(rows.trajectory == run)
    times, width = (ends[1:] + ends[:-1]) / 2, float(ends[1])
    path = interpolated(times, ends, ends_of_steps)
    moved = np.diff(ends_of_steps[:, :2], axis=0)
    along = moved / np.maximum(np.linalg.norm(moved, axis=1), 1e-12)[:, None]
    by_position, by_heading = [], []
    for row in own:
        begin = 0.0 if rows.begins_at_start[row].any() else float(rows.t0[row])
        inside = (times > begin) & (times < rows.t1[row])
        first, last = interpolated(np.array([begin, rows.t1[row]]), ends, ends_of_steps)
        frame = rotation(-first[2] if rows.lengths[row] == "displacement" else turn)[:2, :2]
        lever = (last[:2] - path[:, :2]) @ rotation(np.pi / 2)[:2, :2].T @ frame.T * inside[:, None]  # Eq. (1)
        nothing = np.zeros((len(times), 2))
        if rows.lengths[row] == "distance":
            by_position.append((along * inside[:, None]).ravel())
            by_heading.append(np.zeros(len(times)))
        elif rows.lengths[row]:
            by_position += [(nothing + frame[axis] * inside[:, None]).ravel() for axis in range(2)]
            by_heading += list(lever.T)
        if rows.measured[row, 2]:
            by_position.append(nothing.ravel())
            by_heading.append(inside.astype(float))
    position, heading = np.array(by_position), np.array(by_heading)
    return width * position @ position.T, width * heading @ heading.T
