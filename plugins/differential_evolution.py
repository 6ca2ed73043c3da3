"""Differential evolution by SciPy: Storn and Price, Journal of Global Optimization 11:341 (1997)."""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy
from pydantic import Field, model_validator

from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.kinematics import Array

Strategy = Literal["best1bin", "rand1bin", "currenttobest1bin", "best2bin", "randtobest1bin", "rand2bin"]


class DifferentialEvolutionOptions(Options):
    """Population, variation and stopping rule, named as SciPy names them."""

    strategy: Strategy = Field("best1bin", description="how a candidate is made from others")
    popsize: int = Field(5, gt=0, description="candidates of a generation, for each free element")
    mutation: tuple[float, float] = Field((0.4, 0.9), description="range of the differential weight F")
    recombination: float = Field(0.9, ge=0, le=1, description="probability of crossover CR")
    tol: float = Field(
        1e-7, gt=0, description="stop when the costs of a generation spread less than this share of mean"
    )

    @model_validator(mode="after")
    def _weights_are_ordered(self) -> DifferentialEvolutionOptions:
        low, high = self.mutation
        if not 0 <= low <= high < 2:
            raise ValueError(f"mutation is [{low:g}, {high:g}], expected 0 <= low <= high < 2")
        return self


@calibrators.register("differential_evolution")
class DifferentialEvolution(Calibrator):
    """SciPy's differential evolution in the unit cube of the free elements, evaluated by whole generations."""

    Options = DifferentialEvolutionOptions
    options: DifferentialEvolutionOptions

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Evolve until the costs of a generation agree; SciPy's final polish is off, since it evaluates one by one."""
        free = int(np.count_nonzero(problem.free))
        if free == 0:
            return Solution(problem.start, "the box leaves no element free")

        def cost(points: Array) -> Array:
            values = problem.cost(problem.from_unit(points.T))
            return np.where(np.isfinite(values), values, np.inf)

        result = scipy.optimize.differential_evolution(
            cost,
            bounds=[(0.0, 1.0)] * free,
            x0=np.clip(problem.to_unit(problem.start)[0], 0.0, 1.0),
            strategy=self.options.strategy,
            popsize=self.options.popsize,
            mutation=self.options.mutation,
            recombination=self.options.recombination,
            tol=self.options.tol,
            maxiter=problem.budget.evaluations,  # never reached: the problem limits the evaluations
            rng=problem.rng,
            polish=False,
            updating="deferred",
            vectorized=True,
        )
        return Solution(problem.best_vector, f"SciPy: {result.message}", converged=bool(result.success))
