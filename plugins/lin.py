"""Kinematic correction after Lin et al.: a robot's matrix by two linear least-squares fits, headings first.

P. Lin, D. Liu, D. Yang, Q. Zou, Y. Du, M. Cong, "Calibration for odometry of omnidirectional mobile robots based on
kinematic correction", Proc. 14th Int. Conf. on Computer Science & Education (ICCSE), 139-144 (2019).

For omni robots with three wheels and mecanum bases with four, on any paths on which all wheels turn. Let d(k) (N,) be
the angles by which the wheels turn in sample k, rad, and D(k) their sum up to its end. Row 3 of the matrix, j (N,) in
rad per rad, follows from the headings theta of the reference at the ends s of path segments that all begin at the start
of their run:

    theta(s) - theta(0) = j . D(s).                                                            (1)

With it the heading in sample k is known, psi(k) = theta(0) + j . (D(k-1) + D(k)) / 2. Rows 1 and 2 keep of every wheel
the direction c_i = c_x + i c_y (m per rad) of its column in the design and get a factor g_i, linear in the positions:

    (x + i y)(s) - (x + i y)(0) = sum_i g_i c_i sum_{k <= s} exp(i psi(k)) d_i(k).                  (2)

A segment ends at the first reference pose after every 0.5 m of the path that the design drives, and at the end of the
run. So the method fits 2 N numbers of 3 N.

Reconstructed here. The article itself was not at hand; what is known of it is what its competitors made of it: R. B.
Sousa, M. R. Petry, P. G. Costa and A. P. Moreira compare OptiOdom with it (2022) and publish their program, from which
the segments and the two fits are taken; whether the article cuts paths in this way is not known. They take psi at the
end of a sample, which turns every step by half of the sample's turn; here it is taken in the middle, as the odometry
does that judges the outcome (with Euler steps: at the begin), which changes their mean errors by less than 1 %. Along
wheel rates that the paths do not drive at all, as those of four wheels without slip, the design is kept.
"""

from __future__ import annotations

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.errors import NotApplicableError
from omnibench.fit.article_methods import SegmentMethod, SegmentOptions, segment_ends
from omnibench.fit.calibrator import Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array, Robot, class_of
from omnibench.robot.odometry import Complex, Integration, OdometryBatch

_UNDRIVEN = 1e-6  # of the largest singular value: smaller ones are rounding
# The same, for the third one of the wheels' angles: below it the paths lack a motion, which noise alone would fit.
# Chosen: it is 0.5 on OptiOdom's circles.
_MISSING = 0.01


@calibrators.register("lin")
class Lin(SegmentMethod):
    """Row 3, then a factor on each wheel's column of rows 1 and 2, each by linear least squares (Lin et al. 2019)."""

    options: SegmentOptions
    only_for = "omni robots with three wheels and mecanum bases with four"

    def applies(self, robot: Robot) -> bool:
        return (class_of(robot), len(robot.measured)) in (("omni", 3), ("mecanum", 4))

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Solve Eq. (1) for row 3 and Eq. (2) for the factors."""
        runs = self.runs_with_paths(problem)
        design = problem.robot.inverse_kinematic_matrix
        ends = [segment_ends(run, design, self.options.segment) for run in runs]
        batch = OdometryBatch([run.log(run.pose_times[end]) for run, end in zip(runs, ends, strict=True)], "arc")
        poses = np.concatenate([run.poses[end] for run, end in zip(runs, ends, strict=True)])
        moved = poses - np.array([run.start for run in runs])[batch.trajectory]
        strengths = np.linalg.svd(batch.driven, compute_uv=False)
        if len(strengths) < 3 or strengths[2] < _MISSING * strengths[0]:
            raise NotApplicableError("it is for paths that drive ahead, aside and turn, and these do not do all of it")

        turning = design[2] + _least_squares(batch.driven, moved[:, 2] - batch.driven @ design[2])  # Eq. (1)
        steps = batch.position_design([_headings(run, turning, problem.integration) for run in runs])
        columns: Complex = steps * (design[0] + 1j * design[1])
        position = moved[:, 0] + 1j * moved[:, 1]
        factors = 1 + _least_squares(_real(columns), _real(position - columns.sum(axis=1)))  # Eq. (2)
        matrix = np.vstack([design[:2] * factors, turning])
        vector = matrix.ravel()
        reason = f"on {len(poses)} segments: factors of rows 1 and 2 {_listed(factors, problem.robot)}; "
        return Solution(vector, f"{reason}row 3 {_listed(problem.matrix(vector)[2], problem.robot)}")


def _headings(run: Trajectory, turning: Array, integration: Integration) -> Array:
    """Headings psi (F,) by row 3 of the matrix (N,), rad: in the middle of a sample, for Euler steps at its begin."""
    turns = (run.signals @ turning) * np.diff(run.times, prepend=0.0)
    headings: Array = run.start[2] + np.cumsum(turns) - turns * (0.5 if integration == "arc" else 1.0)
    return headings


def _real(values: Complex) -> Array:
    """Real parts above imaginary ones, (2 S, ...) of (S, ...)."""
    return np.concatenate([values.real, values.imag])


def _least_squares(columns: Array, values: Array) -> Array:
    """The shortest solution (N,) of columns (S, N) for values (S,): 0 along what the columns do not drive."""
    solution: Array = np.linalg.lstsq(columns, values, rcond=_UNDRIVEN)[0]
    return solution


def _listed(values: Array, robot: Robot) -> str:
    """Values (N,) with the names of their wheels."""
    return ", ".join(f"{wheel} {value:.4f}" for wheel, value in zip(robot.wheel_names, values, strict=True))
