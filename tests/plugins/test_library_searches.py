"""Optimisers of other libraries as calibrators."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from commands import refused

from omnibench.errors import PluginError
from omnibench.fit.calibrator import Outcome, run_calibrator
from omnibench.fit.library_search import LibrarySearch, UnitCost
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array
from omnibench.testing import CalibratorConformance, load_plugin, run_cases, synthetic_problem

FOLDER = Path(__file__).parents[2] / "plugins"


class RandomSearch(LibrarySearch):
    """Uniform points of the unit cube."""

    name = "random_search"
    package = "numpy"

    def search(self, cost: UnitCost, start: Array, rng: np.random.Generator) -> str:
        """Half of the cube's points have no cost: they are bad, but finite."""
        assert np.isfinite(cost(rng.uniform(size=(1000, len(start))))).all()
        return "1,000 points"


@pytest.mark.usefixtures("registries_as_before_the_module")
@pytest.mark.parametrize(
    ("plugin", "package"),
    [
        ("dual_annealing", "scipy"),
        ("pymoo_pso", "pymoo"),
        pytest.param("nevergrad_de", "nevergrad", marks=pytest.mark.slow),
        pytest.param("optuna_tpe", "optuna", marks=pytest.mark.slow),
    ],
)
def test_an_optimiser_of_each_library_keeps_the_contract_of_calibrators(plugin: str, package: str) -> None:
    load_plugin(FOLDER / f"{plugin}.py")
    if find_spec(package) is None:
        with refused(PluginError, f"calibrator '{plugin}' needs {package}", f"pip install {package}"):
            calibrators.create(plugin).calibrate(synthetic_problem())
        return
    results = run_cases(type("Suite", (CalibratorConformance,), {"name": plugin})())
    assert [result for result in results if not result.passed] == []


def test_an_optimiser_sees_finite_costs_where_there_are_none_and_answers_no_worse_than_the_start() -> None:
    problem = synthetic_problem(undefined=lambda points: points[:, 0] > 0.5)
    result = run_calibrator(RandomSearch(RandomSearch.Options()), problem)
    assert result.outcome is Outcome.CONVERGED
    assert result.reason == "numpy: 1,000 points"
    assert result.cost <= problem.values(problem.start[None])[0]
