"""A matrix from the literature, scored beside the calibrations."""

from __future__ import annotations

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.kinematics import PUBLISHED, published_matrix


@calibrators.register("theoretical")
class Theoretical(Calibrator):
    """The design values, unchanged, against which every calibration is measured."""

    bounded = False
    fitted = False
    stochastic = False

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """The start vector."""
        problem.cost(problem.start[None])
        return Solution(problem.start, "the design values")


class PublishedOptions(Options):
    """The matrix, by name or by its rows."""

    matrix: str | tuple[tuple[FiniteFloat, ...], ...] = Field(
        "palacin2023_eq9", description=f"{' or '.join(PUBLISHED)}, or 3 rows of N values"
    )

    @model_validator(mode="after")
    def _is_a_matrix(self) -> PublishedOptions:
        if isinstance(self.matrix, str):
            if self.matrix not in PUBLISHED:
                raise ValueError(f"matrix {self.matrix!r} is not one of {', '.join(PUBLISHED)}")
        elif len(self.matrix) != 3 or len({len(row) for row in self.matrix}) != 1:
            raise ValueError(f"matrix must have 3 rows of N values, found {[len(row) for row in self.matrix]}")
        return self


@calibrators.register("published")
class Published(Calibrator):
    """A published matrix, unchanged: the paper's Eq. (8) or (9), or one given in the config."""

    Options = PublishedOptions
    options: PublishedOptions
    bounded = False
    as_is = True
    fitted = False
    stochastic = False

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """The published matrix as a vector; ConfigError if it is for another number of wheels."""
        given = self.options.matrix
        matrix = published_matrix(given) if isinstance(given, str) else np.array(given)
        if problem.parameterisation.name != "matrix" or matrix.size != problem.size:
            raise ConfigError(f"a published {matrix.shape} matrix does not fit a problem of {problem.size} values")
        problem.cost(matrix.reshape(1, -1))
        return Solution(matrix.ravel(), "as published")
