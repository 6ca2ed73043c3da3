"""Searches of a calibration problem by NLopt's algorithms, in the unit cube of its free elements."""

from __future__ import annotations

import nlopt
import numpy as np
from pydantic import Field

from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.kinematics import Array

# m, rad: replaces a cost that is not finite, since NLopt's searches cannot compare NaN. Any number above all costs will
# do; half of it and twice change nothing (tests/studies/constants_fit.py).
_LARGE = 1e10
_REASONS = {
    nlopt.SUCCESS: "done",
    nlopt.STOPVAL_REACHED: "stop value reached",
    nlopt.FTOL_REACHED: "relative change of the cost below {tolerance:g}",
    nlopt.XTOL_REACHED: "change of the candidates below {step:g} of the box",
    nlopt.MAXEVAL_REACHED: "evaluations spent",
}


class NloptOptions(Options):
    """Stopping rule and population of an NLopt search."""

    population: int | None = Field(None, gt=0, description="default: NLopt's own")
    tolerance: float = Field(1e-9, ge=0, description="stop at this relative change of the cost")
    step: float = Field(1e-8, ge=0, description="stop at this change of the candidates, as a share of the box")


class _NloptSearch(Calibrator):
    """A search by an NLopt algorithm."""

    Options = NloptOptions
    options: NloptOptions
    algorithm: int

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Search until NLopt's tolerances are met or the budget is spent: BudgetSpent passes through."""
        options, variables = self.options, int(problem.free.sum())
        if variables == 0:  # NLopt would call that an invalid argument
            problem.cost(problem.start[None])
            return Solution(problem.start, "the box leaves nothing to search")
        spent: list[BaseException] = []
        optimiser = nlopt.opt(self.algorithm, variables)

        def cost(point: Array, _: Array) -> float:
            try:
                value = float(problem.cost(problem.from_unit(point))[0])
            except BaseException as reason:
                spent.append(reason)
                optimiser.force_stop()
                return _LARGE
            return value if np.isfinite(value) else _LARGE

        optimiser.set_min_objective(cost)
        optimiser.set_lower_bounds(np.zeros(variables))
        optimiser.set_upper_bounds(np.ones(variables))
        optimiser.set_ftol_rel(options.tolerance)
        optimiser.set_xtol_abs(np.full(variables, options.step))
        if options.population is not None:
            optimiser.set_population(options.population)
        nlopt.srand(int(problem.rng.integers(2**31)))
        try:
            optimiser.optimize(problem.to_unit(problem.start)[0])
        except nlopt.ForcedStop:
            if not spent:
                raise
        if spent:
            raise spent[0]
        code = optimiser.last_optimize_result()
        text = _REASONS.get(code, f"NLopt ended with code {code}")
        reason = text.format(tolerance=options.tolerance, step=options.step)
        return Solution(problem.best_vector, reason, converged=code != nlopt.MAXEVAL_REACHED)


@calibrators.register("crs")
class Crs(_NloptSearch):
    """Controlled random search with local mutation: NLopt GN_CRS2_LM."""

    algorithm = nlopt.GN_CRS2_LM


@calibrators.register("isres")
class Isres(_NloptSearch):
    """Improved stochastic ranking evolution strategy: NLopt GN_ISRES."""

    algorithm = nlopt.GN_ISRES
