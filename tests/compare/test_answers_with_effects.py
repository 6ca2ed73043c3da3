"""Answers with effects beside the matrix: rows, files and certificates are of the model with these."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import compared_here, small, write_plugin

from omnibench.compare.config import CompareConfig, effective_config
from omnibench.compare.plan import load_datasets, make_plan
from omnibench.compare.scoring import SplitScorer, score
from omnibench.fit.calibrator import Outcome, run_calibrator
from omnibench.fit.evaluate import evaluate
from omnibench.registry import calibrators, costs, effects
from omnibench.robot.calibration import EffectTerm, ModelExtension, read_calibration
from omnibench.robot.kinematics import published_matrix
from omnibench.robot.model import OdometryModel

DRIFTING = """
import numpy as np
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.registry import calibrators
from omnibench.robot.calibration import EffectTerm, ModelExtension, Noise

@calibrators.register("drifting")
class Drifting(Calibrator):
    "The start, with a drift of the heading."

    stochastic = False
    extends = True

    def calibrate(self, problem):
        term = EffectTerm(name="heading_drift", parameters={"b": 0.03})
        covariance = np.diag([1e-8] * problem.size + [1e-4])
        extension = ModelExtension(
            effects=(term,),
            driven=((0.2, 0.0, 0.0),),
            plain=tuple(map(tuple, problem.matrix(problem.start).tolist())),
            covariance=tuple(map(tuple, covariance.tolist())),
        )
        return Solution(problem.start, "so", noise=Noise(walk_heading=0.01), extension=extension)
"""


@pytest.mark.parametrize("name", ["final_pose", "trajectory"])
def test_a_model_without_effects_has_the_score_of_its_matrix(name: str) -> None:
    dataset = load_datasets(CompareConfig.model_validate(small()))["flower"]
    scorer = SplitScorer(dataset.split("train"), costs.create(name), "arc")
    matrix = published_matrix("palacin2023_eq8")
    of_matrix = scorer.score(matrix)
    of_model = scorer.score_of_model(OdometryModel(dataset.robot, matrix, "arc"))
    assert of_model.cost == pytest.approx(of_matrix.cost, rel=1e-9)
    np.testing.assert_allclose(of_model.costs, of_matrix.costs, rtol=1e-9)
    np.testing.assert_allclose(of_model.errors, of_matrix.errors, atol=1e-12)


def test_row_and_file_are_of_the_model_with_its_effects(tmp_path: Path) -> None:
    plugins = write_plugin(tmp_path / "plugins", "drifting", DRIFTING)
    result = compared_here(
        tmp_path / "out", plugins=[str(plugins)], calibrators=["theoretical", "closed_form", "drifting"]
    )
    rows = {run.record.label: run.record for run in result.runs}
    file = read_calibration(tmp_path / "out" / "calibrations" / "flower-drifting.yaml")
    (term,) = file.effects
    assert (term.name, dict(term.parameters)) == ("heading_drift", {"b": 0.03})
    assert file.plain is not None
    assert file.driven is not None
    assert file.covariance is not None
    assert np.array(file.covariance)[-1, -1] == 1e-4
    assert file.noise is not None
    found = evaluate(file, result.datasets["flower"]).splits["train"]
    assert rows["drifting"].train_cost == pytest.approx(found.cost, rel=1e-9)
    assert rows["drifting"].train_position_m == pytest.approx(found.position_mean_m, rel=1e-9)
    assert rows["drifting"].train_cost != pytest.approx(rows["theoretical"].train_cost, rel=1e-3)
    assert rows["drifting"].gap is None
    assert rows["theoretical"].gap is not None


def test_an_effect_that_does_not_act_on_a_run_is_a_failed_row() -> None:
    config = effective_config(CompareConfig.model_validate(small(calibrators=["theoretical"])))
    datasets = load_datasets(config)
    (run,) = make_plan(config, datasets)
    result = run_calibrator(calibrators.create("theoretical"), run.problem())
    robot = run.dataset.robot
    names = [parameter.name for parameter in effects.create("wheel_eccentricity").parameters(robot)]
    term = EffectTerm(name="wheel_eccentricity", parameters=dict.fromkeys(names, 0.01))
    bare = replace(run.dataset, trajectories=tuple(replace(each, angles=None) for each in run.training))
    extended = replace(result, extension=ModelExtension(effects=(term,)))
    (scored,) = score(config, [replace(run, dataset=bare)], [extended], datasets | {run.dataset_name: bare})
    assert scored.record.outcome == Outcome.FAILED
    assert "effect 'wheel_eccentricity' needs" in scored.record.reason
