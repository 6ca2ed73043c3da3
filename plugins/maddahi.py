"""Corrective indices after Maddahi, Maddahi and Sepehri, reconstructed from a second-hand description.

Y. Maddahi, A. Maddahi, N. Sepehri, "Calibration of omnidirectional wheeled mobile robots: method and experiments",
Robotica 31:969-980 (2013). The article itself was not at hand. What is known of it here is what Palacin et al. 2023
say in their introduction: two corrective indices are applied to the inverse kinematic matrix; they correct the angular
velocities of the wheels, which is equivalent to a parametric calibration of the wheels' radii; they reduce errors more
on straight trajectories than on curved ones.

Reconstructed here, and not the article's own:

- that the indices are a *longitudinal* one, common to all wheels, which stretches the path, and a *lateral* one for
  each wheel, of mean one, which balances the wheels against each other: M^-1 becomes M^-1 diag(longitudinal * lateral);
- the names of the two;
- how they are found. The article measures them on its own test paths by formulas that we do not know. Here they
  minimise the problem's cost over the training data. So the outcome is the best that any corrective indices of this
  form can do on these data, and an upper bound on what the article's own procedure would reach with them.

Wheel factors cannot lengthen paths and turn headings less at the same time. On a robot whose wheels also stand at
other distances than designed, as the APR-02, they leave most of the error in place; this is a property of the method.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.kinematics import Array, Robot

_LARGE = 1e300  # replaces a cost that is not finite, of which the simplex could not take differences
_REACH = 0.5  # largest change of a wheel's factor where the box does not limit it; chosen


class MaddahiOptions(Options):
    """Stopping rule."""

    tolerance: float = Field(1e-9, gt=0, description="stop when factors and relative cost change by less than this")


@calibrators.register("maddahi")
class Maddahi(Calibrator):
    """Two corrective indices on the wheels' rates (Maddahi et al. 2013, reconstructed): common, and wheel by wheel."""

    Options = MaddahiOptions
    options: MaddahiOptions
    stochastic = False
    only_for = "robots whose wheels do not steer"

    def applies(self, robot: Robot) -> bool:
        """True where each wheel is one column of the matrix."""
        return robot.drive.direct

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Find the wheel factors of least cost by a simplex, restarted while the cost falls, and split them."""
        scaled = _scaled_by_wheel(problem)
        low, high = _factor_limits(problem, scaled)
        factors = np.ones(len(scaled))
        best = start = _cost(problem, _vector(problem, scaled, factors))
        while np.any(high > low):
            result = scipy.optimize.minimize(
                lambda x: _cost(problem, _vector(problem, scaled, x)),
                factors,
                method="Nelder-Mead",
                bounds=list(zip(low, high, strict=True)),
                options={
                    "initial_simplex": _simplex(factors, low, high),
                    "xatol": self.options.tolerance,
                    "fatol": self.options.tolerance * min(start, 1.0),
                    "maxiter": problem.budget.evaluations,  # never reached: the problem limits the evaluations
                },
            )
            decrease = best - result.fun
            if decrease > 0:
                factors, best = np.clip(result.x, low, high), float(result.fun)
            if decrease <= self.options.tolerance * min(start, 1.0):
                break
        longitudinal = factors.mean()
        lateral = ", ".join(
            f"{wheel} {share:.4f}"
            for wheel, share in zip(problem.robot.wheel_names, factors / longitudinal, strict=True)
        )
        return Solution(
            _vector(problem, scaled, factors), f"longitudinal index {longitudinal:.4f}, lateral indices {lateral}"
        )


def _scaled_by_wheel(problem: CalibrationProblem) -> NDArray[np.bool_]:
    """True (N, n) for elements of the vector that a wheel's factor multiplies: its matrix column, or its radius."""
    wheels = len(problem.robot.wheels)
    element = np.arange(problem.size)
    wheel = element % wheels
    scaled: NDArray[np.bool_] = np.equal(wheel, np.arange(wheels)[:, None])
    if problem.parameterisation.name == "geometry":
        scaled[:, wheels:] = False
    return scaled


def _vector(problem: CalibrationProblem, scaled: NDArray[np.bool_], factors: Array) -> Array:
    """The start vector (n,) with the factors (N,) of the wheels applied."""
    vector: Array = problem.start * np.where(scaled, np.asarray(factors)[:, None], 1.0).prod(axis=0)
    return np.clip(vector, problem.lower, problem.upper)  # rounding may leave the box


def _factor_limits(problem: CalibrationProblem, scaled: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Lowest and highest factor (N,) that keep every scaled element in the box; both 1 where the box fixes one."""
    moving = problem.start != 0
    start = np.where(moving, problem.start, 1.0)
    ends = np.sort([problem.lower / start, problem.upper / start], axis=0)
    low = np.where(scaled & moving, ends[0], 1 - _REACH).max(axis=1)
    high = np.where(scaled & moving, ends[1], 1 + _REACH).min(axis=1)
    return np.minimum(low, 1.0), np.maximum(high, 1.0)


def _simplex(factors: Array, low: Array, high: Array) -> Array:
    """A first simplex (N + 1, N) around the factors: each goes a quarter of the way to its farther limit."""
    step = np.where(high - factors >= factors - low, high - factors, low - factors) / 4
    return np.vstack([factors, factors + np.diag(step)])


def _cost(problem: CalibrationProblem, vector: Array) -> float:
    """The cost of one vector, finite in any case."""
    value = float(problem.cost(vector[None])[0])
    return value if np.isfinite(value) else _LARGE
