"""The calibrator differential_evolution of ``plugins/``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from omnibench.errors import ConfigError
from omnibench.fit.calibrator import Outcome, run_calibrator
from omnibench.registry import calibrators
from omnibench.testing import CalibratorConformance, load_plugin, synthetic_problem


@pytest.fixture(autouse=True, scope="module")
def plugin(registries_as_before_the_module: None) -> None:  # noqa: ARG001
    load_plugin(Path(__file__).parents[2] / "plugins" / "differential_evolution.py")


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


def test_differential_evolution_refuses_weights_in_the_wrong_order() -> None:
    with pytest.raises(ConfigError, match="expected 0 <= low <= high < 2"):
        calibrators.create("differential_evolution", {"mutation": [0.9, 0.4]})
