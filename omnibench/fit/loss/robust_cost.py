"""A cost with a robust loss in the place of its mean norm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnibench.errors import ConfigError
from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.fit.loss.losses import Loss, LossName, make_loss
from omnibench.robot.kinematics import Array


class RobustCost(Cost):
    """The norms of a cost's pose errors under a loss with an estimated scale, Eq. (1) to (4) of losses.py.

    base: the cost, whose stamps, norms and shares these are. Single poses that are far off have a bounded influence. A
    start that is off, or at costs of the final pose an end, spoils a run: its poses then are far off together.
    """

    def __init__(self, base: SumOfNorms, loss: Loss) -> None:
        super().__init__(base.options)
        self.base, self.loss = base, loss
        self.name, self.stamps, self.rounding = base.name, base.stamps, base.rounding

    @property
    def coordinates(self) -> tuple[float, float, float]:
        """The weights of the cost."""
        return self.base.weights

    @property
    def of_poses(self) -> Loss:
        """The same loss of whole poses, m, m, rad."""
        return type(self.loss)(3)

    def combine(self, errors: Array, trajectory: NDArray[np.intp]) -> Array:
        """Costs (P,), m: at the scale of each candidate's own errors."""
        return self.loss.costs(self.base.norms(errors), self.base.shares(trajectory))

    def weights(self, errors: Array, trajectory: NDArray[np.intp]) -> Array:
        """Weights (S,), Eq. (5), of errors (S, 3) of one candidate; 1 or less for Huber's, for t up to (n + d) / n."""
        return self.loss.weights(self.ratios(errors, trajectory))

    def ratios(self, errors: Array, trajectory: NDArray[np.intp]) -> Array:
        """Norms (S,) of errors (S, 3) of one candidate over their scale."""
        norms = self.base.norms(errors)
        ratios: Array = norms / self.loss.scales(norms[None], self.base.shares(trajectory))[0]
        return ratios


def with_loss(cost: Cost, loss: LossName) -> Cost:
    """The cost with a loss; itself for squares. ConfigError: another loss, and the cost is no sum of norms."""
    if loss == "squares":
        return cost
    if not isinstance(cost, SumOfNorms):
        raise ConfigError(f"loss: {loss} weighs norms of pose errors, and the cost {cost.name} is no sum of norms")
    chosen = make_loss(loss, sum(map(bool, cost.weights)))
    assert chosen is not None  # only squares have none
    return RobustCost(cost, chosen)


def loss_of(cost: Cost) -> LossName:
    """The loss of a cost."""
    return cost.loss.name if isinstance(cost, RobustCost) else "squares"


def norms_of(cost: Cost) -> SumOfNorms | None:
    """The sum of norms that a cost is, or whose norms a robust loss weighs; None for other costs."""
    base = cost.base if isinstance(cost, RobustCost) else cost
    return base if isinstance(base, SumOfNorms) else None
