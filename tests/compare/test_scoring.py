"""From an answer to its row and file: gaps within one box, costs of plug-ins, effects beside the matrix."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import compared_here, flower, prepare, refused, small, write_plugin
from numpy.typing import NDArray

from omnibench.compare.config import CompareConfig, effective_config
from omnibench.compare.plan import PlannedRun, load_datasets, make_plan
from omnibench.compare.result import RunRecord
from omnibench.compare.scoring import SplitScorer, heading_error, position_error, score
from omnibench.data.dataset import make_dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import PluginError
from omnibench.fit.calibrator import Outcome, RunResult, run_calibrator
from omnibench.fit.cost import Cost
from omnibench.fit.evaluate import evaluate
from omnibench.registry import calibrators, costs, effects
from omnibench.robot.calibration import EffectTerm, ModelExtension, read_calibration
from omnibench.robot.kinematics import Array, Robot, published_matrix
from omnibench.robot.model import OdometryModel

TRUE = published_matrix("palacin2023_eq8")
WIDE = {"lower": [[-1.0] * 3] * 3, "upper": [[1.0] * 3] * 3}
WIDER = {"lower": [[-2.0] * 3] * 3, "upper": [[2.0] * 3] * 3}


def records(
    entries: Sequence[dict[str, Any] | str],
    shares: Sequence[float | None],
    outcome: Outcome = Outcome.CONVERGED,
    **changes: Any,
) -> dict[str, RunRecord]:
    """Rows of entries whose answers lie a share of the way from the true matrix to the design; None: no answer."""
    config = CompareConfig.model_validate(small(calibrators=entries, **changes))
    datasets = load_datasets(config)
    plan = make_plan(config, datasets)
    results = [answer(run, share, outcome) for run, share in zip(plan, shares, strict=True)]
    return {run.record.label: run.record for run in score(config, plan, results, datasets)}


def answer(run: PlannedRun, share: float | None, outcome: Outcome) -> RunResult:
    if share is None:
        return RunResult(Outcome.FAILED, "because", None, None, None, 0, 0.0, ())
    matrix = TRUE + share * (run.dataset.robot.inverse_kinematic_matrix - TRUE)
    return RunResult(outcome, "so", matrix.ravel(), matrix, 0.0, 1, 0.1, ())


def test_gap_and_improvement_are_shares_of_cost_above_the_optimum_and_below_the_design() -> None:
    rows = records(["closed_form", "crs"], (0.0, 0.1))
    assert rows["closed_form"].gap == 0.0
    assert rows["crs"].train_cost is not None
    assert rows["closed_form"].train_cost is not None
    assert rows["crs"].gap == pytest.approx(rows["crs"].train_cost / rows["closed_form"].train_cost - 1)
    assert rows["crs"].train_improvement == pytest.approx(
        1 - rows["crs"].train_cost / rows["crs"].theoretical_train_cost
    )


def test_neither_gap_nor_improvement_is_measured_from_a_cost_without_error() -> None:
    exact = {"flower": {"simulate": flower(noise={}, validation=None)}}
    rows = records(["closed_form", "crs"], (0.0, 0.1), datasets=exact)
    assert rows["closed_form"].train_cost == pytest.approx(0.0, abs=1e-12)
    assert (rows["closed_form"].gap, rows["crs"].gap) == (None, None)
    truth = {"matrix": Robot.model_validate(flower()["robot"]).inverse_kinematic_matrix.tolist()}
    as_designed = {"flower": {"simulate": flower(noise={}, truth=truth, validation=None)}}
    (row,) = records(["crs"], (0.0,), datasets=as_designed).values()
    assert (row.theoretical_train_cost, row.train_improvement) == (pytest.approx(0.0, abs=1e-12), None)


def entry(name: str, box: Any) -> dict[str, Any]:
    return {"name": name, "box": box}


@pytest.mark.parametrize(
    ("entries", "shares", "gap_boxes"),
    [
        (["closed_form", "crs"], (0.0, 0.1), ("row", "row")),
        (["closed_form", "parametric"], (0.0, 0.1), ("row", "row")),  # the box contains the geometry's matrix
        ([entry("closed_form", "paper"), "crs"], (0.0, 0.1), ("paper", None)),  # of another box
        (["closed_form", "crs"], (None, 0.1), (None, None)),  # no optimum was found
        (
            [entry("closed_form", WIDE), entry("crs", WIDER), entry("isres", WIDE)],
            (0.0, 0.1, 0.1),
            ("custom", None, "custom"),
        ),
        # An answer without a box: the design is in the paper's, the true matrix outside it.
        (
            [entry("closed_form", "paper"), "closed_form", "theoretical", "published"],
            (0.5, 0.0, 1.0, 0.0),
            ("paper", "row", "paper", "row"),
        ),
    ],
)
def test_a_gap_is_measured_from_the_optimum_of_the_same_box_or_of_one_that_contains_the_answer(
    entries: list[Any], shares: tuple[float | None, ...], gap_boxes: tuple[str | None, ...]
) -> None:
    rows = records(entries, shares).values()
    assert tuple(row.gap_box for row in rows) == gap_boxes
    assert all((row.gap is None) == (row.gap_box is None) for row in rows)


def test_each_box_has_its_own_optimum() -> None:
    entries = ["closed_form", entry("closed_form", "paper"), "crs", entry("crs", "paper")]
    rows = records(entries, (0.0, 0.05, 0.1, 0.1))
    assert (rows["crs"].gap_box, rows["crs (paper box)"].gap_box) == ("row", "paper")
    assert rows["crs"].gap != rows["crs (paper box)"].gap


def test_no_gap_is_measured_against_an_optimum_that_was_not_reached() -> None:
    rows = records(["closed_form", "crs"], (0.0, 0.1), Outcome.BUDGET)
    assert [row.gap for row in rows.values()] == [None, None]


def test_a_run_without_an_answer_has_no_figures_but_the_theoretical_ones() -> None:
    row = records(["crs"], (None,))["crs"]
    assert row.theoretical_train_cost > 0
    assert {row.train_cost, row.validation_cost, row.train_position_m, row.matrix, row.gap} == {None}


def test_final_errors_are_mean_distances_and_mean_absolute_headings() -> None:
    errors = np.array([[3.0, 4.0, -0.1], [0.0, 0.0, 0.3]])
    assert position_error(errors) == pytest.approx(2.5)
    assert heading_error(errors) == pytest.approx(0.2)


class Mine(Cost):
    name = "mine"

    def __init__(self, combined: Callable[[int], Array]) -> None:
        super().__init__(None)
        self.combined = combined

    def combine(self, errors: Array, trajectory: NDArray[np.intp]) -> Array:  # noqa: ARG002
        return self.combined(len(errors))


def raising(_: int) -> Array:
    raise ZeroDivisionError("no\nway")


@pytest.mark.parametrize(
    ("combined", "complaint"),
    [
        (raising, "'mine' raised ZeroDivisionError: no way"),
        (lambda count: np.full(count, np.nan), "'mine' gave NaN or infinity"),
        (lambda _: np.array(3.0), "'mine' gave an array of shape ()"),
    ],
)
def test_a_cost_that_is_no_cost_is_one_line(combined: Callable[[int], Array], complaint: str) -> None:
    dataset = load_dataset(prepare().data)
    scorer = SplitScorer(dataset.split("train"), Mine(combined), "arc")
    for measure in (scorer.cost, scorer.costs) if "shape" not in complaint else (scorer.cost,):
        with refused(PluginError, complaint):
            measure(TRUE)


ROOT_MEAN_SQUARE = """
from omnibench.fit.cost import Cost
from omnibench.registry import costs

@costs.register("root_mean_square")
class RootMeanSquare(Cost):
    "Root of the mean square."

    def combine(self, errors, trajectory):
        return np.sqrt(np.square(errors).sum(axis=-1).mean(axis=-1))
"""


def test_a_cost_that_is_no_mean_over_trajectories_is_warned_of(tmp_path: Path) -> None:
    plugins = write_plugin(tmp_path / "plugins", "root_mean_square", ROOT_MEAN_SQUARE)
    result = compared_here(
        tmp_path / "out", plugins=[str(plugins)], cost="root_mean_square", calibrators=["theoretical"]
    )
    assert [warning for warning in result.warnings if "the cost is no mean over trajectories" in warning]


def test_what_the_runs_do_not_identify_is_warned_of_for_everything_that_is_fitted(tmp_path: Path) -> None:
    straight = flower(commands={"speeds": [0.2], "directions_deg": [0, 120, 240], "turn_rates": [0.0]})
    entries = ["theoretical", "closed_form"]
    result = compared_here(tmp_path / "out", datasets={"flower": {"simulate": straight}}, calibrators=entries)
    (warning,) = result.warnings
    assert warning.startswith("data set flower, fit of the matrix:")
    assert "(turning on the spot)" in warning


def test_copies_of_training_runs_are_not_held_out(tmp_path: Path) -> None:
    dataset = load_dataset(prepare().data)
    train = dataset.split("train")
    copies = [replace(run, id=f"copy-{run.id}", split="validation") for run in train]
    save_dataset(make_dataset("copied", dataset.robot, dataset.sample_period, [*train, *copies]), tmp_path / "data")
    entries = ["theoretical", "closed_form"]
    result = compared_here(tmp_path / "out", datasets={"copied": {"path": tmp_path / "data"}}, calibrators=entries)
    assert result.held_out["copied"].verdict.verdict == "unknown"


# Answers with effects beside the matrix

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
    dataset = load_dataset(prepare().data)
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
