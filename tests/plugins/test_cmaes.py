"""The calibrator cmaes of ``plugins/``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Outcome, run_calibrator
from omnibench.registry import calibrators
from omnibench.testing import CalibratorConformance, load_plugin, synthetic_problem


@pytest.fixture(autouse=True, scope="module")
def plugin(registries_as_before_the_module: None) -> None:  # noqa: ARG001
    load_plugin(Path(__file__).parents[2] / "plugins" / "cmaes.py")


class TestCmaes(CalibratorConformance):
    """The cases of every calibrator."""

    name = "cmaes"
    solved = 1e-7


def test_cmaes_says_which_package_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cma", None)  # what Python itself does for a module that cannot be imported
    result = run_calibrator(calibrators.create("cmaes"), synthetic_problem())
    assert result.outcome is Outcome.FAILED
    assert result.reason == "calibrator 'cmaes' needs the package cma; install it: pip install cma"


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


def test_cmaes_names_the_nearest_option_for_a_misspelt_one() -> None:
    with pytest.raises(ConfigError, match="unknown key 'popsize'"):
        calibrators.create("cmaes", {"popsize": 10})
