"""What calibrators of published articles share: answers that stand as they are, and paths that are cut into segments.

Methods for two wheels on one axle, and for the squares that these drive, are in differential.py.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from omnibench.data.dataset import Trajectory
from omnibench.errors import NotApplicableError
from omnibench.fit.calibrator import Calibrator
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options
from omnibench.robot.kinematics import Array

_ROUNDING = 1e-9  # share of a segment's length


class ArticleMethod(Calibrator):
    """A method whose matrix is the answer of an article's formulas: no box, no seed, no shrinking to the design."""

    bounded = False
    as_is = True
    stochastic = False


class SegmentOptions(Options):
    """Segments of the paths."""

    segment: float = Field(0.5, gt=0, description="a segment ends after every such length of the path, m")


class SegmentMethod(ArticleMethod):
    """A method that compares the odometry with reference poses at the ends of segments of the path."""

    Options = SegmentOptions

    def runs_with_paths(self, problem: CalibrationProblem, of_what: str = "poses") -> list[Trajectory]:
        """The runs with more than one pose. NotApplicableError: there are none. of_what: poses or positions."""
        self.needs_matrix(problem)
        runs = [run for run in problem.trajectories if run.has_poses and len(run.pose_times) > 1]
        if not runs:
            raise NotApplicableError(f"it fits reference {of_what} along the path, and no run has more than one")
        return runs


def segment_ends(run: Trajectory, design: Array, length: float) -> NDArray[np.intp]:
    """Indices (S,) of the reference poses at which the segments of a run end; the last one ends with the run.

    design (3, M): the matrix that measures the path. length: of a segment, m, at least.
    """
    steps = np.hypot(*(design[:2] @ run.signals.T)) * np.diff(run.times, prepend=0.0)
    at_poses = np.interp(run.pose_times, np.append(0.0, run.times), np.append(0.0, np.cumsum(steps)))
    ends, begun, last = list[int](), 0.0, len(at_poses) - 1
    for index, driven in enumerate(at_poses):
        if driven - begun >= length * (1 - _ROUNDING):
            ends.append(index)
            begun = driven
    return np.array(ends if ends and ends[-1] == last else [*ends, last])
