"""CMA-ES: the covariance matrix adaptation evolution strategy, by the package ``cma``.

Hansen, "The CMA evolution strategy: a tutorial" (arXiv:1604.00772); options are named as pycma names them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field

from omnibench.errors import PluginError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.kinematics import Array

# Criteria of pycma that mean convergence; all others mean that the search was stopped.
_CONVERGED = {"tolx", "tolfun", "tolfunhist", "tolfunrel", "tolxstagnation", "tolflatfitness"}


class CmaesOptions(Options):
    """Population, first step and stopping rule."""

    population: int | None = Field(None, gt=3, description="candidates of a generation; default 4 + 3 ln n")
    step: float = Field(
        0.2, gt=0, le=1, description="standard deviation of the first generation, as a share of the box"
    )
    tolfun: float = Field(1e-10, gt=0, description="stop when the cost varies less than this over the last generations")
    tolx: float = Field(1e-9, gt=0, description="stop when the candidates vary less than this share of the box")


@calibrators.register("cmaes")
class Cmaes(Calibrator):
    """CMA-ES in the unit cube of the free elements, from the start, by the package cma."""

    Options = CmaesOptions
    options: CmaesOptions

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Ask and tell, whole generations at once, until pycma's own criteria stop it.

        PluginError when the package is not installed, or when fewer than two elements are free.
        """
        try:
            from cma import CMAEvolutionStrategy
        except ImportError:
            raise PluginError("calibrator 'cmaes' needs the package cma; install it: pip install cma") from None
        free = int(np.count_nonzero(problem.free))
        if free < 2:
            raise PluginError(f"calibrator 'cmaes' needs two free elements or more, the box leaves {free}; widen it")
        start = np.clip(problem.to_unit(problem.start)[0], 0.0, 1.0)
        problem.cost(problem.start[None])  # so that the answer is never worse than the start
        strategy = CMAEvolutionStrategy(start, self.options.step, self._settings(problem))
        while not (stop := strategy.stop()):
            points = strategy.ask()
            strategy.tell(points, _finite(problem.cost(problem.from_unit(np.array(points)))).tolist())
        reason = ", ".join(f"{name} {value:g}" for name, value in stop.items())
        return Solution(problem.best_vector, f"pycma: {reason}", converged=not stop.keys().isdisjoint(_CONVERGED))

    def _settings(self, problem: CalibrationProblem) -> dict[str, Any]:
        settings: dict[str, Any] = {
            "bounds": [0.0, 1.0],
            # All random numbers come from problem.rng; pycma would pass a seed to NumPy's global generator.
            "randn": lambda *shape: problem.rng.standard_normal(shape),
            "seed": np.nan,
            "maxiter": np.inf,  # the problem limits the evaluations
            "tolfun": self.options.tolfun,
            "tolx": self.options.tolx,
            "verbose": -10,  # prints nothing, reads and writes no files
            "verb_log": 0,
            "verb_disp": 0,
        }
        return settings if self.options.population is None else settings | {"popsize": self.options.population}


def _finite(values: Array) -> Array:
    """Costs (P,) with NaN and infinity replaced by a value above all others; pycma uses their ranks only."""
    ok = np.isfinite(values)
    return np.where(ok, values, 2 * values[ok].max() + 1 if ok.any() else 1.0)
