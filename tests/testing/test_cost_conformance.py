"""The cases of costs pass what keeps the contract and fail, case by case, what does not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conformance_suites import failures

from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.robot.kinematics import Array
from omnibench.testing import (
    CostConformance,
)


class GoodCost(SumOfNorms):
    """The norm of Eq. (6)."""


class ScalarCost(GoodCost):
    """One number for all candidates."""

    def combine(self, errors: Array, trajectory: Array) -> Any:
        return super().combine(errors, trajectory).mean()


class NegativeCost(GoodCost):
    """A logarithm."""

    def combine(self, errors: Array, trajectory: Array) -> Array:
        return np.log(super().combine(errors, trajectory) + 1e-300)


class OffsetCost(GoodCost):
    """Something for nothing."""

    def combine(self, errors: Array, trajectory: Array) -> Array:
        return super().combine(errors, trajectory) + 1


class FreeCost(GoodCost):
    """Nothing for anything."""

    weights = (0.0, 0.0, 0.0)


class IgnoresNan(GoodCost):
    """Leaves out what it cannot add."""

    def combine(self, errors: Array, trajectory: Array) -> Array:
        return super().combine(np.nan_to_num(errors), trajectory)


class RaisesOnNan(GoodCost):
    """Insists."""

    def combine(self, errors: Array, trajectory: Array) -> Array:
        if np.isnan(errors).any():
            raise ValueError("NaN")
        return super().combine(errors, trajectory)


class RelativeCost(GoodCost):
    """Relative to the worst of the batch."""

    def combine(self, errors: Array, trajectory: Array) -> Array:
        values = super().combine(errors, trajectory)
        return values / max(values.max(), 1e-300)


class InPlaceCost(GoodCost):
    """Squares where it stands."""

    def combine(self, errors: Array, trajectory: Array) -> Array:
        errors *= errors
        return np.sqrt(errors.sum(axis=-1)) @ self.shares(trajectory)


CASES_OF_COSTS = [
    (ScalarCost, "every candidate has one cost", "shape ()"),
    (NegativeCost, "costs are finite and not negative", "negative"),
    (OffsetCost, "no error costs nothing", "errors of zero cost 1"),
    (OffsetCost, "exact recordings cost nothing", "the true matrix costs 1"),
    (FreeCost, "errors cost something", "cost nothing"),
    (IgnoresNan, "nan stays with its candidate", "they must cost NaN"),
    (RaisesOnNan, "nan stays with its candidate", "ValueError: NaN"),
    (RelativeCost, "costs do not depend on the batch", "depends on the others"),
    (RelativeCost, "nan stays with its candidate", "spoils another's cost"),
    (InPlaceCost, "inputs are left unchanged", "combine changed its arguments"),
]


def test_a_good_cost_passes_every_case() -> None:
    assert failures(CostConformance, GoodCost) == {}


@pytest.mark.parametrize(("cls", "case", "message"), CASES_OF_COSTS)
def test_a_cost_fails_the_case_it_breaks(cls: type[Cost], case: str, message: str) -> None:
    assert message in failures(CostConformance, cls)[case]
