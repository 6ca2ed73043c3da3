"""Parametric calibration (paper, section 4.2): search of the physical parameters of Eq. (3) within limits."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators


class ParametricOptions(Options):
    """The search and its options; the limits are those of the entry in the config."""

    search: str = Field("crs", description="a calibrator that searches")
    search_options: dict[str, Any] = Field({}, description="options of that search")


@calibrators.register("parametric")
class Parametric(Calibrator):
    """Radius, distance and angle of every wheel within physical limits, by one of the searches."""

    Options = ParametricOptions
    options: ParametricOptions
    parameterisation = "geometry"

    def __init__(self, options: ParametricOptions) -> None:
        super().__init__(options)
        if options.search == self.name:
            raise ConfigError("parametric: search must be another calibrator, for example crs")
        self.search: Calibrator = calibrators.create(options.search, options.search_options, "parametric: search")

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Search the geometry. ConfigError when the problem has another parameterisation."""
        if problem.parameterisation.name != "geometry":
            raise ConfigError("parametric searches the geometry parameterisation; remove the entry's parameterisation")
        solution = self.search.calibrate(problem)
        return Solution(solution.vector, f"{self.options.search}: {solution.reason}", solution.converged)
