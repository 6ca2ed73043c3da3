"""References that tell little of the robot: poses that jump, and the robot's own odometry in the place of a reference.

Motion capture that takes one marker for another turns or shifts single poses; a SLAM that closes a loop moves its poses
at once, and for good. Between two poses the odometry of the design tells the motion, up to a share of the way. Poses
that agree make a track, of which the longest is the robot's; others are alone, and where the track goes on elsewhere
the reference has shifted.

Against the robot's own odometry a calibration finds nothing wrong. Odometry has the heading k . C(t) for the angles
C (M,) that the drive signals count up to its stamp and some row k, whatever radii, distances and rule of integration
were put into it. So headings over intervals of a second are fitted by least squares to the signals' increments, with
free k, and to the change of their rates, as odometry may be stamped late; once with C between two wheel samples, and
once with C of the last sample, or of one of those before. A driver may take the newest steering angle in the place of
the one amid a sample, and read it from another zero and by another scale; the signals' derivatives by these count, too.

What remains of an independent reference is its noise and the wheels' slip: 2.9 mrad at least in each of 239 runs of
four robots under motion capture (OptiOdom), and about 1 mrad of the noise alone of markers 0.4 m apart that are seen to
0.3 mm. Of odometry remains rounding, and up to 0.4 mrad where its stamps are 30 ms late (simulated of these runs).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.robot.kinematics import Array, Robot, in_the_middle, interpolated, relative, wrapped
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

# A step is a jump if it differs from the odometry's by more than this, m and rad, and by more than the share of the
# way; chosen: above the scatter of motion capture and of matched scans, and the errors of a design.
_LEAST, _SHARE = np.array([0.05, 0.1]), 0.5
# It differs by so many standard deviations of the usual scatter; chosen. That is told by a quantile of the deviations,
# as by their median (Hampel 1974), but by one that 60 % of the steps cannot spoil, since each lone pose spoils two; its
# factor is 1 / 0.524, the quantile's of a normal deviation. Of fewer poses it cannot be said what is usual.
_DEVIATIONS, _QUANTILE, _PER_QUANTILE, _FEWEST = 6.0, 0.4, 1.91, 20
_MOST_AWAY = 8  # poses that a reference may be elsewhere before it counts as shifted; chosen


def reference_jumps(robot: Robot, log: WheelLog, poses: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The jumps of reference poses (K, 3), m, m, rad, at the stamps of a log of the wheels.

    Lone poses that are elsewhere, and those after which it goes on apart (shifts), by their indices.
    """
    none = np.empty(0, dtype=np.intp)
    if len(poses) <= _FEWEST:
        return none, none
    (odometry,) = OdometryModel.of_design(robot, "arc").poses([log])
    # The odometry of coarse counters is late by up to a tick of every wheel.
    angles = np.abs(log.signals) * np.diff(log.times, prepend=0.0)[:, None]
    ticks = np.where(angles > 1e-9 * angles.max(axis=0, initial=0.0), angles, np.inf).min(axis=0, initial=np.inf)
    x, y, turn = np.abs(robot.inverse_kinematic_matrix) @ np.where(np.isfinite(ticks), ticks, 0.0)
    least = _LEAST + np.array([np.hypot(x, y), turn])
    steps = np.arange(len(poses) - 1)
    usual = _PER_QUANTILE * np.quantile(_misfits(odometry, poses, steps, steps + 1), _QUANTILE, axis=0)

    def agree(first: NDArray[np.intp], last: NDArray[np.intp]) -> NDArray[np.bool_]:
        driven = np.abs(relative(odometry[first], odometry[last]))
        way = np.hypot(driven[:, 0], driven[:, 1]) + robot.reach * driven[:, 2]
        allowed = least + _SHARE * np.column_stack([way, driven[:, 2]])
        within = _misfits(odometry, poses, first, last) <= np.maximum(allowed, _DEVIATIONS * usual)
        return np.asarray(within.all(axis=1))

    if agree(steps, steps + 1).all():
        return none, none

    # The longest track of poses that agree, each with the one before; it goes on elsewhere at the price of some poses.
    near = [agree(np.arange(len(poses) - lag), np.arange(lag, len(poses))).tolist() for lag in range(1, _MOST_AWAY + 2)]
    scores, before, longest = list[int](), list[int](), -1  # of the longest track that ends with each pose
    for pose in range(len(poses)):
        lags = [lag for lag, agrees in enumerate(near[:pose], 1) if agrees[pose - lag]]
        score, previous = max(((scores[pose - lag], pose - lag) for lag in lags), default=(0, -1))
        if longest >= 0 and scores[longest] - _MOST_AWAY > score:
            score, previous = scores[longest] - _MOST_AWAY, longest
        scores.append(score + 1)
        before.append(previous)
        longest = pose if longest < 0 or scores[pose] > scores[longest] else longest
    track = [longest]
    while before[track[-1]] >= 0:
        track.append(before[track[-1]])
    track.reverse()
    apart = [first for first, last in pairwise(track) if last - first > len(near) or not near[last - first - 1][first]]
    return np.setdiff1d(np.arange(len(poses)), track), np.array(apart, dtype=np.intp)


def _misfits(odometry: Array, poses: Array, first: NDArray[np.intp], last: NDArray[np.intp]) -> Array:
    """By how much (n, 2), m and rad, the motions between poses differ from the odometry's."""
    off = relative(poses[first], poses[last]) - relative(odometry[first], odometry[last])
    return np.column_stack([np.hypot(off[:, 0], off[:, 1]), np.abs(wrapped(off[:, 2]))])


_INTERVAL = 1.0  # s
_COPIED = 5e-4  # rad; chosen between the two above, and nearer to odometry: to refuse a good reference is worse
_DRIVEN = 0.1  # rad; in intervals in which no wheel turns by more all headings agree
_MOST_BEHIND = 3  # samples; by rates of samples alone odometry that is late would be told to their noise
_FREEDOM = 8  # degrees of freedom, from which the residual of an independent reference is never that small by chance


def follows_the_wheels(runs: Sequence[Trajectory]) -> float | None:
    """The residual of the headings, rad in a second, of reference poses that are odometry; None for independent ones.

    None, too, where the runs are too short or turn too little to tell. Runs without poses are left out.
    """
    runs = [run for run in runs if run.has_poses]
    if not runs:
        return None
    headings = np.concatenate([np.diff(run.poses[_about_a_second(run), 2]) for run in runs])
    if float(np.abs(headings).max(initial=0.0)) < _COPIED:  # of a reference that stands still
        return None
    residuals = []
    readings = [_readings(run) for run in runs]
    for reading, behind in product(range(len(readings[0])), (None, *range(_MOST_BEHIND + 1))):
        counted = [_counted(run, signals[reading], behind) for run, signals in zip(runs, readings, strict=True)]
        design = np.concatenate([np.diff(counts, axis=0) for counts in counted])
        driven = np.abs(design[:, : design.shape[1] // 2]).max(axis=1) > _DRIVEN
        row, _, rank, _ = np.linalg.lstsq(design[driven], headings[driven])
        if driven.sum() - rank >= _FREEDOM:
            left = headings[driven] - design[driven] @ row
            residuals.append(float(np.sqrt(left @ left / (driven.sum() - rank))))
    least = min(residuals, default=np.inf)
    return least if least < _COPIED else None


def _about_a_second(run: Trajectory) -> slice:
    """Reference poses of a run, from one to another about an interval later."""
    return slice(None, None, max(1, round(_INTERVAL / float(np.median(np.diff(run.pose_times))))))


def _counted(run: Trajectory, signals: Array, behind: int | None) -> Array:
    """Integrals of signals (F, Q) up to reference poses about a second apart, and rates (K, 2 Q).

    behind: up to the last sample before the pose, or so many samples earlier.
    """
    edges, stamps = np.append(0.0, run.times), run.pose_times[_about_a_second(run)]
    counted = np.vstack([np.zeros(signals.shape[1]), np.cumsum(signals * np.diff(edges)[:, None], axis=0)])
    last = np.searchsorted(edges, stamps + 1e-6, side="right") - 1
    rates = signals[np.minimum(last, len(signals) - 1)]
    if behind is None:
        return np.hstack([interpolated(stamps, edges, counted), rates])
    return np.hstack([counted[np.maximum(last - behind, 0)], rates])


def _readings(run: Trajectory) -> list[Array]:
    """Drive signals (F, Q), and, of a robot that steers, those of drivers that read its angles otherwise."""
    if run.drive is None or run.steering is None:
        return [run.signals]
    _, somewhere = run.drive.slopes(np.ones_like(run.rates[:1]), np.full_like(run.steering[:1], 0.5))
    signal, angle = np.nonzero(somewhere[0])
    readings = []
    for angles in (in_the_middle(run.steering), run.steering):
        signals = run.drive.signals(run.rates, angles)
        slopes = run.drive.slopes(run.rates, angles)[1][:, signal, angle]
        readings += [signals, np.hstack([signals, slopes, slopes * angles[:, angle]])]
    return readings
