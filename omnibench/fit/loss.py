"""Robust losses of pose errors, with a scale that is estimated from the same errors.

Errors have the norms r_i of d coordinates, with shares p_i that sum to one. A scale s turns them into x_i = r_i / s.

``huber``, with rho(x) = x^2/2 up to c and c x - c^2/2 beyond, takes the scale and the numbers fitted that minimise

    Q(s) = s (sum_i p_i rho(x_i) + b / 2),   b = E min(R, c)^2,   R^2 ~ chi2(d),                            (1)

the concomitant scale of Huber's Proposal 2 (Huber, Robust Statistics, 1981, sections 7.7 and 7.8): at the minimum

    sum_i p_i min(x_i, c)^2 = b,                                                                          (2)

so that s is the standard deviation of a coordinate of normal errors. Q is convex in s and the errors at once.

``student_t`` takes errors for multivariate t with n = 4 degrees of freedom, which serves unless their number is
estimated (Lange, Little and Taylor, J. Am. Stat. Assoc. 84:881, 1989, section 5). Minus the log-likelihood of one
coordinate, up to a constant, and its minimum over s are

    L(s) = ln s + (n + d) / (2 d) sum_i p_i ln(1 + x_i^2 / n),                                            (3)
    sum_i p_i (n + d) x_i^2 / (n + x_i^2) = d.                                                            (4)

The cost of a candidate is min Q or exp(min L), in the unit of the errors: a function of the candidate alone, as smooth
as the errors. Its derivatives by the errors are those of a weighted sum of squares with the weights

    w(x) = min(1, c / x)   and   w(x) = (n + d) / (n + x^2).                                              (5)

Both sides of (2) and (4) that depend on q = 1/s^2 are concave in it and grow, so that Newton's steps from q = 0
approach the root from one side, without fail.

A start that has jumped shifts or turns every pose of its run, and no weight of single poses mends that:
with_ends_from_others takes such starts, and ends, from the poses beside them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr

from omnibench.data.dataset import Trajectory
from omnibench.errors import ConfigError
from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.robot.kinematics import Array, Robot, compose, relative
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration

LossName = Literal["squares", "huber", "student_t"]

# Smallest scale, m or rad: smaller errors are rounding, of which the likelihood of Eq. (3) could grow without bound. A
# tenth of NO_ERROR in fit/cost.py, so that the costs of such errors are rounding, too.
LEAST_SCALE = 1e-10
# Norms of d coordinates beyond which Huber's loss is linear. Each leaves 95 % of the efficiency of squares for normal
# errors, as 1.345 does for one coordinate (Holland and Welsch, Comm. Stat. A 6:813, 1977; Huber 1981, section 4.2).
CORNERS: Mapping[int, float] = MappingProxyType({1: 1.345, 2: 1.501, 3: 1.628})
# Share of the weight of a small error below which a pose counts as one that has jumped, and is left out of estimates
# that have no loss: errors of more than 8 (huber) or 4 (student_t) of their scales.
OFF = 0.2
DEGREES_OF_FREEDOM = 4.0  # Lange, Little and Taylor 1989
# Newton's steps for the scale; errors of one size take 5, with a twentieth of them 100 times as large 15.
_MOST_STEPS = 100
_SAMPLE = 2000  # norms of which more are not needed to find where Newton's steps begin: they then take two or three
_SETTLED = 1e-13  # relative change of 1/s^2 that ends them
_BESIDE = 3  # poses beside an end that tell where it was: the fewest of which one may be off, too
_FEWEST_RUNS = 5  # fewer ends do not tell how far an end usually is from what the poses beside it say


class Loss:
    """A loss of the norms of errors of ``coordinates`` d coordinates: squares, whose cost is their root mean square."""

    name: LossName = "squares"

    def __init__(self, coordinates: int) -> None:
        self.coordinates = coordinates

    def scales(self, norms: Array, shares: Array) -> Array:  # noqa: ARG002 (squares need none)
        """Scales (P,) of P sets of norms (P, S) with shares (S,)."""
        return np.ones(len(norms))

    def costs(self, norms: Array, shares: Array) -> Array:
        """Costs (P,), in the unit of the norms (P, S), at the scales that minimise them; NaN of norms that are NaN."""
        return np.asarray(np.sqrt(np.square(norms) @ shares))

    def weights(self, ratios: Array) -> Array:
        """Weights w (...), Eq. (5), of ratios x (...) of norms to their scale."""
        return np.ones(ratios.shape)

    def slopes(self, ratios: Array) -> Array:
        """Derivatives x w'(x) (...) of the weights by the logarithm of the ratios x (...)."""
        return np.zeros(ratios.shape)

    def is_near(self, norms: Array, shares: Array) -> NDArray[np.bool_]:
        """True (S,) for the norms (S,) that are not far off the others, by their weights."""
        ratios = norms / self.scales(norms[None], shares)[0]
        return np.asarray(self.weights(ratios) >= OFF * self.weights(np.zeros(1)))


class ScaledLoss(Loss, ABC):
    """A loss whose scale is estimated with the norms."""

    _target: float  # the right side of Eq. (2) or (4)

    def scales(self, norms: Array, shares: Array) -> Array:
        """Scales (P,) of P sets of norms (P, S) with shares (S,): the roots of Eq. (2) or (4)."""
        squares = np.square(norms)
        start: Array = np.zeros(len(norms))
        with np.errstate(all="ignore"):
            if (every := len(shares) // _SAMPLE) > 1:
                some = shares[::every]
                start = self._precisions(squares[:, ::every], some / some.sum(), start)
            scales = self._precisions(squares, shares, start) ** -0.5
            return np.where((squares > 0).any(axis=1), scales, LEAST_SCALE)

    def _precisions(self, squares: Array, shares: Array, start: Array) -> Array:
        """Roots q (P,) of Eq. (2) or (4) for squared norms (P, S), from a start (P,); 0 where there is none.

        A step to the left of 0, which only a start to the right of the root can lead to, begins again at 0.
        """
        precision: Array = start
        for _ in range(_MOST_STEPS):
            value, slope = self._equation(squares * precision[:, None])
            moved = precision + (self._target - value @ shares) / ((slope * squares) @ shares)
            before = precision
            precision = np.where(np.isfinite(moved) & (moved > 0), np.minimum(moved, LEAST_SCALE**-2), 0.0)
            if (np.abs(precision - before) <= _SETTLED * precision).all():
                break
        return precision

    @abstractmethod
    def _equation(self, squares: Array) -> tuple[Array, Array]:
        """The terms of the left side of Eq. (2) or (4) at squared ratios, and their derivatives by these."""


class Huber(ScaledLoss):
    """Squares of small errors and magnitudes of large ones, Eq. (1)."""

    name = "huber"

    def __init__(self, coordinates: int) -> None:
        super().__init__(coordinates)
        self.corner = CORNERS[coordinates]
        square = self.corner**2
        inside = float(coordinates * chdtr(coordinates + 2, square))  # E R^2 of R < c
        self._target = inside + square * (1 - float(chdtr(coordinates, square)))  # b of Eq. (1)

    def weights(self, ratios: Array) -> Array:
        """min(1, c / x)."""
        return np.asarray(self.corner / np.maximum(ratios, self.corner))

    def slopes(self, ratios: Array) -> Array:
        """-c / x beyond the corner, 0 before."""
        return np.where(ratios > self.corner, -self.weights(ratios), 0.0)

    def _equation(self, squares: Array) -> tuple[Array, Array]:
        return np.minimum(squares, self.corner**2), np.where(squares < self.corner**2, 1.0, 0.0)

    def costs(self, norms: Array, shares: Array) -> Array:
        """Costs (P,), the minima of Eq. (1)."""
        scales = self.scales(norms, shares)
        ratios = norms / scales[:, None]
        small = np.minimum(ratios, self.corner)
        return np.asarray(scales * ((small * (ratios - small / 2)) @ shares + self._target / 2))


class StudentT(ScaledLoss):
    """Minus the log-likelihood of Student's t with four degrees of freedom, Eq. (3)."""

    name = "student_t"

    def __init__(self, coordinates: int) -> None:
        super().__init__(coordinates)
        self._target = float(coordinates)

    def weights(self, ratios: Array) -> Array:
        """(n + d) / (n + x^2)."""
        return np.asarray((DEGREES_OF_FREEDOM + self.coordinates) / (DEGREES_OF_FREEDOM + np.square(ratios)))

    def slopes(self, ratios: Array) -> Array:
        """-2 x^2 (n + d) / (n + x^2)^2."""
        squares = np.square(ratios)
        return np.asarray(-2 * squares / (DEGREES_OF_FREEDOM + squares) * self.weights(ratios))

    def _equation(self, squares: Array) -> tuple[Array, Array]:
        total = DEGREES_OF_FREEDOM + self.coordinates
        left = DEGREES_OF_FREEDOM + squares
        return total * squares / left, total * DEGREES_OF_FREEDOM / np.square(left)

    def costs(self, norms: Array, shares: Array) -> Array:
        """Costs (P,), exp of the minima of Eq. (3)."""
        scales = self.scales(norms, shares)
        logarithms = np.log1p(np.square(norms / scales[:, None]) / DEGREES_OF_FREEDOM) @ shares
        power = (DEGREES_OF_FREEDOM + self.coordinates) / (2 * self.coordinates)
        return np.asarray(scales * np.exp(power * logarithms))


def make_loss(name: LossName, coordinates: int) -> Loss:
    """The loss of that name for errors of some coordinates."""
    return next(kind for kind in (Loss, Huber, StudentT) if kind.name == name)(coordinates)


def with_ends_from_others(
    runs: Sequence[Trajectory], robot: Robot, integration: Integration, loss: Loss, *, last: bool
) -> tuple[tuple[Trajectory, ...], tuple[str, ...]]:
    """The runs, starts that have jumped replaced by what the next poses say, and the names of those runs.

    With the motions of the design robot from pose to pose, each of the three poses beside the end of a run says where
    that end was; the median of the three is what they agree on. An end that differs from it by far more than those of
    other runs do, by their weight under a robust loss, has jumped. Over so short a way the design is good enough; what
    it leaves is left to the loss.

    loss: of three coordinates, m and rad alike. last: the last poses are treated alike, for a cost that uses no others.
    """
    design = OdometryModel.of_design(robot, integration)
    moved, names = list(runs), set()
    long_enough = [index for index, run in enumerate(runs) if len(run.poses) > _BESIDE]
    for end in (0, -1) if last else (0,):
        if len(long_enough) < _FEWEST_RUNS:
            break
        beside = np.arange(1, 1 + _BESIDE) if end == 0 else np.arange(-1 - _BESIDE, -1)
        medians = []
        for run in (runs[index] for index in long_enough):
            (path,) = design.poses([run.reference_log])
            path = np.vstack([run.start, path])
            predicted = compose(run.poses[beside], relative(path[beside], path[end]))
            medians.append(np.median(predicted, axis=0))
        jumps = np.linalg.norm(np.array(medians) - [runs[index].poses[end] for index in long_enough], axis=1)
        near = loss.is_near(jumps, np.full(len(jumps), 1 / len(jumps)))
        for place in np.flatnonzero(~near):
            index = long_enough[place]
            poses = moved[index].poses.copy()
            poses[end] = medians[place]
            moved[index] = replace(moved[index], poses=poses)
            names.add(runs[index].id)
    return tuple(moved), tuple(run.id for run in runs if run.id in names)


class RobustCost(Cost):
    """The norms of a cost's pose errors under a loss with an estimated scale, Eq. (1) to (4).

    base: the cost, whose stamps, norms and shares these are. Single poses that are far off have a bounded influence. A
    start that is off, or at costs of the final pose an end, spoils a run: its poses then are far off together.
    """

    def __init__(self, base: SumOfNorms, loss: Loss) -> None:
        super().__init__(base.options)
        self.base, self.loss = base, loss
        self.name, self.stamps = base.name, base.stamps
        self.rounding, self.coordinates = base.rounding, base.coordinates

    def combine(self, errors: Array, trajectory: NDArray[np.intp]) -> Array:
        """Costs (P,), m: at the scale of each candidate's own errors."""
        return self.loss.costs(self.base.norms(errors), self.base.shares(trajectory))

    def ratios(self, errors: Array, trajectory: NDArray[np.intp]) -> Array:
        """Norms (S,) of errors (S, 3) of one candidate over their scale."""
        norms = self.base.norms(errors)
        return np.asarray(norms / self.loss.scales(norms[None], self.base.shares(trajectory))[0])


def beginning_with_huber(cost: RobustCost) -> list[RobustCost]:
    """Huber's loss, whose minimum is the only one, and then the cost's own, where that is another."""
    huber = RobustCost(cost.base, Huber(cost.loss.coordinates))
    return [huber] if cost.loss.name == "huber" else [huber, cost]


def with_loss(cost: Cost, loss: LossName) -> Cost:
    """The cost with a loss; itself for squares. ConfigError: another loss, and the cost is no sum of norms."""
    if loss == "squares":
        return cost
    if not isinstance(cost, SumOfNorms):
        raise ConfigError(f"loss: {loss} weighs norms of pose errors, and the cost {cost.name} is no sum of norms")
    return RobustCost(cost, make_loss(loss, sum(map(bool, cost.weights))))


def loss_of(cost: Cost) -> LossName:
    """The loss of a cost."""
    return cost.loss.name if isinstance(cost, RobustCost) else "squares"


def norms_of(cost: Cost) -> SumOfNorms | None:
    """The sum of norms that a cost is, or whose norms a robust loss weighs; None for other costs."""
    base = cost.base if isinstance(cost, RobustCost) else cost
    return base if isinstance(base, SumOfNorms) else None
