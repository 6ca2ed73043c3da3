"""Improved stochastic ranking evolution strategy: NLopt GN_ISRES."""

from __future__ import annotations

import nlopt

from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.nlopt_search import NloptOptions, search
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators


@calibrators.register("isres")
class Isres(Calibrator):
    """Improved stochastic ranking evolution strategy: NLopt GN_ISRES."""

    Options = NloptOptions
    options: NloptOptions

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Search until NLopt's tolerances are met or the budget is spent."""
        return search(problem, nlopt.GN_ISRES, self.options)
