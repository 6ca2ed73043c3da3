"""Recognition of reference poses that are the robot's own odometry, against which a calibration finds nothing wrong.

Odometry has the heading k . C(t) for the angles C (M,) that the drive signals count up to its stamp and some row k,
whatever radii, distances and rule of integration were put into it. So headings over intervals of a second are fitted by
least squares to the signals' increments, with free k, and to the change of their rates, as odometry may be stamped
late; once with C between two wheel samples, and once with C of the last sample, or of one of those before. A driver may
take the newest steering angle in the place of the one amid a sample, and read it from another zero and by another
scale; the signals' derivatives by these count, too.

What remains of an independent reference is its noise and the wheels' slip: 2.9 mrad at least in each of 239 runs of
four robots under motion capture (OptiOdom), and about 1 mrad of the noise alone of markers 0.4 m apart that are seen to
0.3 mm. Of odometry remains rounding, and up to 0.4 mrad where its stamps are 30 ms late (simulated of these runs).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.robot.kinematics import Array, in_the_middle, interpolated

_INTERVAL = 1.0  # s
_COPIED = 5e-4  # rad; chosen between the two above, and nearer to odometry: to refuse a good reference is worse
_DRIVEN = 0.1  # rad; in intervals in which no wheel turns by more all headings agree
_MOST_BEHIND = 3  # samples; by rates of samples alone odometry that is late would be told to their noise
_FEWEST = 8  # degrees of freedom, from which the residual of an independent reference is never that small by chance


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
        if driven.sum() - rank >= _FEWEST:
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
