"""The calibrators cmaes and differential_evolution of ``plugins/``."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Outcome, run_calibrator
from omnibench.registry import calibrators
from omnibench.testing import CalibratorConformance, synthetic_problem

PLUGINS = ("cmaes", "differential_evolution")


@pytest.mark.slow
class TestCmaes(CalibratorConformance):
    """The cases of every calibrator."""

    name = "cmaes"
    solved = 1e-7


def test_cmaes_says_which_package_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cma", None)  # what Python itself does for a module that cannot be imported
    result = run_calibrator(calibrators.create("cmaes"), synthetic_problem())
    assert (result.outcome, "pip install cma" in result.reason) == (Outcome.FAILED, True)


def test_cmaes_refuses_a_box_with_one_free_element() -> None:
    problem = synthetic_problem()
    problem.free = np.arange(problem.size) == 0
    result = run_calibrator(calibrators.create("cmaes"), problem)
    assert result.outcome is Outcome.FAILED
    assert "two free elements or more, the box leaves 1" in result.reason


def test_cmaes_evaluates_generations_of_the_size_that_is_asked_for() -> None:
    problem = synthetic_problem(evaluations=101)
    result = run_calibrator(calibrators.create("cmaes", {"population": 50}), problem)
    assert (result.outcome, result.evaluations) == (Outcome.BUDGET, 101)  # the start and two generations


def test_cmaes_says_which_criterion_stopped_it() -> None:
    result = run_calibrator(calibrators.create("cmaes", {"tolx": 1e-3}), synthetic_problem(evaluations=20_000))
    assert result.outcome is Outcome.CONVERGED
    assert result.reason == "pycma: tolx 0.001"


class TestDifferentialEvolution(CalibratorConformance):
    """The cases of every calibrator."""

    name = "differential_evolution"
    solved = 1e-7


def test_differential_evolution_evaluates_whole_generations(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, sizes = synthetic_problem(evaluations=500), []
    counted = problem.cost
    monkeypatch.setattr(problem, "cost", lambda candidates: sizes.append(len(candidates)) or counted(candidates))
    run_calibrator(calibrators.create("differential_evolution", {"popsize": 10}), problem)
    assert set(sizes) == {90}


def test_differential_evolution_stops_by_its_own_rule() -> None:
    result = run_calibrator(
        calibrators.create("differential_evolution", {"tol": 1e-2}), synthetic_problem(evaluations=60_000)
    )
    assert result.outcome is Outcome.CONVERGED
    assert result.reason == "SciPy: Optimization terminated successfully."
    assert result.evaluations < 60_000


def test_differential_evolution_leaves_the_start_where_nothing_is_free() -> None:
    problem = synthetic_problem()
    problem.free = np.zeros(problem.size, dtype=bool)
    result = run_calibrator(calibrators.create("differential_evolution"), problem)
    assert np.array_equal(result.vector, problem.start)


@pytest.mark.parametrize(
    ("name", "options", "named"),
    [
        ("cmaes", {"popsize": 10}, "'popsize'"),
        ("differential_evolution", {"mutation": [0.9, 0.4]}, "0 <= low <= high < 2"),
    ],
)
def test_options_that_cannot_be_are_named(name: str, options: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        calibrators.create(name, options)
