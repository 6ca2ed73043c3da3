"""Controlled random search with local mutation: NLopt GN_CRS2_LM."""

from __future__ import annotations

import nlopt

from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.nlopt_search import NloptOptions, search
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators


@calibrators.register("crs")
class Crs(Calibrator):
    """Controlled random search with local mutation: NLopt GN_CRS2_LM."""

    Options = NloptOptions
    options: NloptOptions

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Search until NLopt's tolerances are met or the budget is spent."""
        return search(problem, nlopt.GN_CRS2_LM, self.options)
