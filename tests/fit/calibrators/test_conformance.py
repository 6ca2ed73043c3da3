"""Everything that is built in keeps the contract that plug-ins are held to."""

from __future__ import annotations

from typing import Any

import pytest

from omnibench.fit.parameterisation import ParameterisationName
from omnibench.registry import Registry, calibrators, costs
from omnibench.testing import CalibratorConformance, Conformance, CostConformance
from omnibench.testing.synthetic import ObservedProblem

# The share of the start's cost at which a claim of convergence is believed. Those that are not named here are
# baselines: they need only not be worse than the start.
SOLVED = {
    "closed_form": 1e-6,
    "least_squares": 1e-2,  # its headings are interpolated between the few poses of the synthetic reference
    "trajectory_ml": 1e-6,
    "crs": 1e-5,
    "isres": 1e-3,
    "genetic": 1e-1,
    "parametric": 1e-5,
    "posterior": 2e-1,  # it draws to the design, and does not minimise the cost
}


SLOW = ("isres", "parametric")  # relatives of crs


def cases(registry: Registry[Any], base: type[Conformance]) -> list[Any]:
    methods = [name for cls in base.__mro__ for name in vars(cls) if name.startswith("test_")]
    names = [entry.name for entry in registry.entries() if entry.origin == "built in"]
    return [
        pytest.param(name, method, id=f"{name}-{method[5:]}", marks=[pytest.mark.slow] * (name in SLOW))
        for name in names
        for method in methods
    ]


class Short(CalibratorConformance):
    """The cases with a third of their usual budget: what is built in shows the same with it."""

    def problem(self, parameterisation: ParameterisationName | None = None, **changes: Any) -> ObservedProblem:
        return super().problem(parameterisation, **{"evaluations": 700, **changes})


@pytest.mark.parametrize(("name", "case"), cases(calibrators, CalibratorConformance))
def test_a_calibrator_that_is_built_in_conforms(name: str, case: str) -> None:
    attributes = {"name": name, "solved": SOLVED.get(name, 1.0)}
    getattr(type("Suite", (Short,), attributes)(), case)()


@pytest.mark.parametrize(("name", "case"), cases(costs, CostConformance))
def test_a_cost_that_is_built_in_conforms(name: str, case: str) -> None:
    getattr(type("Suite", (CostConformance,), {"name": name})(), case)()


def test_every_search_that_claims_convergence_is_held_to_a_share() -> None:
    built_in = {entry.name for entry in calibrators.entries() if entry.origin == "built in"}
    assert built_in - {"theoretical", "published", "random_search"} <= set(SOLVED)
