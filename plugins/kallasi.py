"""Steering offset and driving scale of a tricycle after Kallasi et al., from the headings of path segments.

F. Kallasi, D. Lodi Rizzini, F. Oleari, M. Magnani, S. Caselli, "A novel calibration method for industrial AGVs",
Robotics and Autonomous Systems (2017), doi 10.1016/j.robot.2017.04.019.

For tricycles with one driven and steered wheel, on any paths that turn. The wheel rolls by u(k) in sample k, rad, at
the measured steering angle alpha(k), rad; a is the steering offset, s the driving scale, m per rad (the radius of the
wheel), and L its distance from the axle, m, which is taken from the design. The heading turns by

    theta(k) - theta(k-1) = (s / L) u(k) sin(alpha(k) + a).                                          (1)

Over a segment of the path, from one reference pose to another, this is linear in two numbers,

    theta(j) - theta(i) = p sum u sin(alpha) + q sum u cos(alpha),   p = s cos(a) / L,  q = s sin(a) / L,     (2)

which follow from all segments by linear least squares; then a = atan2(q, p) and s = L hypot(p, q). omnibench's drive
signals are the rates of u cos(alpha) and u sin(alpha), so that Eq. (2) fits row 3 of the matrix K (3, 2). With the
design K0 (3, 2) and the wheel's designed radius r the answer is

    K = (s / r) K0 [[cos a, -sin a], [sin a, cos a]].                                                (3)

Segments follow one another; one ends at the first reference pose after every 0.5 m of the path that the design drives.

Left out, or reconstructed here. The abstract of the article was at hand, and the program of R. B. Sousa, M. R. Petry,
P. G. Costa and A. P. Moreira, who compare OptiOdom with it (2022) and from whom Eq. (2) and the segments of 0.5 m are
taken. The article calibrates the sensor's pose on the robot, too; here it is as the data set says. Its model with
different offsets ahead and astern, which no matrix holds, is left out.
"""

from __future__ import annotations

import math

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.errors import NotApplicableError
from omnibench.fit.article_methods import SegmentMethod, SegmentOptions, segment_ends
from omnibench.fit.calibrator import Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array, Robot, class_of
from omnibench.words import plural

# Of the larger singular value of Eq. (2): below it the steering angle was the same all the time, and noise alone would
# tell offset and scale apart. Chosen: it is 0.2 on OptiOdom's circles.
_MISSING = 0.01
_TURNED = 0.1  # rad: paths that turn by less in all segments are straight; chosen


@calibrators.register("kallasi")
class Kallasi(SegmentMethod):
    """Steering offset and driving scale of a tricycle by linear least squares on headings (Kallasi et al. 2017)."""

    options: SegmentOptions
    only_for = "tricycles with one driven and steered wheel"

    def applies(self, robot: Robot) -> bool:
        return class_of(robot) == "tricycle" and len(robot.measured) == 1

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Solve Eq. (2) over the segments of all runs, and make the matrix of Eq. (3)."""
        design = problem.robot.inverse_kinematic_matrix
        runs = self.runs_with_paths(problem)
        segments = [_segments(run, design, self.options.segment) for run in runs]
        driven, turned = (np.concatenate(values) for values in zip(*segments, strict=True))
        strengths = np.linalg.svd(driven, compute_uv=False)
        if len(strengths) < 2 or strengths[1] < _MISSING * strengths[0] or np.abs(turned).sum() < _TURNED:
            raise NotApplicableError("it is for paths that turn at several steering angles, and these do not")

        by_cosine, by_sine = np.linalg.lstsq(driven, turned, rcond=None)[0].tolist()  # Eq. (2): q, p
        designed = complex(design[2, 1], design[2, 0])
        ratio = complex(by_sine, by_cosine) / designed
        offset, share = math.atan2(ratio.imag, ratio.real), abs(ratio)
        turn = np.array([[math.cos(offset), -math.sin(offset)], [math.sin(offset), math.cos(offset)]])
        matrix = share * design @ turn  # Eq. (3)
        radius = float(problem.robot.radii[0])
        return Solution(
            matrix.ravel(),
            f"steering offset {math.degrees(offset):+.3f} deg, driving scale {share * radius:.5f} m per rad "
            f"({share:.4f} of the design), on {plural(len(turned), 'segment')}",
        )


def _segments(run: Trajectory, design: Array, length: float) -> tuple[Array, Array]:
    """Of each segment of a run the integrals (S, 2) of its signals, rad, and the change (S,) of the heading, rad."""
    driven = np.cumsum(run.signals * np.diff(run.times, prepend=0.0)[:, None], axis=0)
    knots, ends = np.append(0.0, run.times), np.append(0, segment_ends(run, design, length))
    signals = np.stack([np.interp(run.pose_times[ends], knots, np.append(0.0, column)) for column in driven.T], axis=1)
    return np.diff(signals, axis=0), np.diff(run.poses[ends, 2])
