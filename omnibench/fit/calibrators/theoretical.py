"""The baseline: no calibration at all."""

from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators


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
