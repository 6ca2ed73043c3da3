"""The adapter by which an optimiser of another library becomes a calibrator in a few lines."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

import numpy as np

from omnibench.errors import PluginError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.robot.kinematics import Array

UnitCost = Callable[[Array], Array]
"""Costs (P,) of points (P, f) of the unit cube, or of one point (f,): finite, with a large value for what is not."""

_WORST = 1e6  # times the start's cost: what a candidate costs that cannot be evaluated (chosen)


class LibrarySearch(Calibrator):
    """A calibrator by a library's optimiser, which searches the unit cube of the free elements.

    package: that must be installed. A subclass writes ``search``; whether the library is asked for candidates and told
    their costs, or calls a function, is its own affair. The budget of the problem ends it.

    >>> @calibrators.register("dual_annealing")
    ... class DualAnnealing(LibrarySearch):
    ...     package = "scipy"
    ...
    ...     def search(self, cost, start, rng):
    ...         box = [(0.0, 1.0)] * len(start)
    ...         return dual_annealing(lambda x: cost(x)[0], box, x0=start, rng=rng).message[0]
    """

    package: ClassVar[str]

    @abstractmethod
    def search(self, cost: UnitCost, start: Array, rng: np.random.Generator) -> str:
        """Search from a start (f,) for points of low cost; the reason why the search ended by itself.

        rng: where all random numbers come from; libraries that take a seed get one drawn from it.
        """

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """The best candidate that the search evaluated. PluginError: the package is not installed."""
        if not problem.free.any():
            return Solution(problem.start, "the box leaves no element free")
        (of_start,) = problem.cost(problem.start[None])  # so that the answer is never worse than the start
        worst = _WORST * max(float(of_start), 1.0) if np.isfinite(of_start) else _WORST

        def cost(points: Array) -> Array:
            values = problem.cost(problem.from_unit(points))
            return np.where(np.isfinite(values), values, worst)

        start = problem.to_unit(problem.start)[0]
        try:
            reason = self.search(cost, start, problem.rng)
        except ImportError as error:
            raise PluginError(f"calibrator {self.name!r} needs {self.package}: pip install {self.package}") from error
        return Solution(problem.best_vector, f"{self.package}: {reason}")
