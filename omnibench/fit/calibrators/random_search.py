"""Random search: the baseline that any other search must beat, and the shortest example of a calibrator."""

import numpy as np
from pydantic import Field

from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators


class RandomSearchOptions(Options):
    """Number of candidates."""

    candidates: int | None = Field(None, gt=0, description="candidates in all; default: the whole budget")
    batch: int = Field(100, gt=0, description="candidates evaluated at once")


@calibrators.register("random_search")
class RandomSearch(Calibrator):
    """Uniform random candidates in the box; the best is kept."""

    Options = RandomSearchOptions
    options: RandomSearchOptions

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Draw candidates until their number is reached or the budget is spent."""
        problem.cost(problem.start[None])  # so that the answer is never worse than the start
        total = self.options.candidates or problem.budget.evaluations
        for first in range(0, total, self.options.batch):
            count = min(self.options.batch, total - first)
            problem.cost(problem.from_unit(problem.rng.uniform(size=(count, np.count_nonzero(problem.free)))))
        return Solution(problem.best_vector, f"{total} candidates tried", converged=False)
