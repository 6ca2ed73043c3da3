"""The calibrators ``learned`` and ``learned_alone`` of ``plugins/``."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import ROOT, python
from slipping_robot import PERIOD, slipping

from omnibench.data.dataset import Dataset, make_dataset
from omnibench.errors import ConfigError
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.fit.calibrator import Outcome
from omnibench.fit.evaluate import evaluate, final_errors
from omnibench.fit.problem import Budget
from omnibench.progress import Progress
from omnibench.robot.calibration import read_calibration, write_calibration
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.testing import CalibratorConformance

PLUGINS = ("learned",)
pytestmark = pytest.mark.slow
SMALL = {"layers": (8,), "epochs": 60, "decays": (0.3,)}


class TestLearned(CalibratorConformance):
    """The cases of every calibrator."""

    name = "learned"
    options = SMALL | {"epochs": 5}


class TestLearnedAlone(TestLearned):
    """The same without the matrix."""

    name = "learned_alone"


@cache
def dataset() -> Dataset:
    return slipping()


def learned(name: str = "learned", options: dict[str, Any] | None = None, **given: Any) -> CalibrationRun:
    return calibrate(given.pop("data", dataset()), calibrator=name, options=SMALL | (options or {}), **given)


@cache
def fitted(name: str = "learned") -> CalibrationRun:
    return learned(name)


def mean_errors(model: OdometryModel) -> tuple[float, float]:
    """Mean error of the last poses of the validation runs, m and rad."""
    errors = final_errors(model, dataset().split("validation"))
    return float(np.hypot(errors[:, 0], errors[:, 1]).mean()), float(np.abs(errors[:, 2]).mean())


@pytest.mark.parametrize(("name", "share"), [("learned", 0.7), ("learned_alone", 0.8)])
def test_it_predicts_a_slip_that_no_matrix_has(name: str, share: float) -> None:
    plain = mean_errors(calibrate(dataset(), "closed_form").calibration.model)
    better = mean_errors(fitted(name).calibration.model)
    assert better[0] < share * plain[0]
    assert better[1] < share * plain[1]


@pytest.mark.parametrize("unidentified", ["keep", "fit"])
def test_the_matrix_is_that_of_closed_form(unidentified: Any) -> None:
    run, plain = learned(unidentified=unidentified), calibrate(dataset(), "closed_form", unidentified=unidentified)
    np.testing.assert_array_equal(run.calibration.matrix_array, plain.calibration.matrix_array)
    assert run.calibration.plain == plain.calibration.matrix


def test_a_run_gives_the_same_file_again_with_the_same_seed() -> None:
    again = learned()
    assert again.calibration.model_copy(update={"created": fitted().calibration.created}) == fitted().calibration
    assert learned(seed=2).calibration.effects != again.calibration.effects


def test_the_costs_of_the_file_are_those_that_evaluate_finds(tmp_path: Path) -> None:
    calibration = fitted().calibration
    write_calibration(calibration, tmp_path / "c.yaml")
    found = evaluate(read_calibration(tmp_path / "c.yaml"), dataset())
    assert calibration.provenance.training_cost == pytest.approx(found.splits["train"].cost, rel=1e-12)
    assert calibration.provenance.validation_cost == pytest.approx(found.splits["validation"].cost, rel=1e-12)
    assert fitted().result.cost == pytest.approx(found.splits["train"].cost, rel=1e-12)


def test_no_interval_of_the_matrix_is_stated_and_a_warning_says_so() -> None:
    assert fitted().uncertainty is None
    assert "no intervals: those of a matrix do not hold beside learned, by which it is corrected" in fitted().warnings


def test_where_the_matrix_explains_the_runs_it_is_the_answer() -> None:
    """The poses are the design's odometry but for noise, so that nothing is left to learn."""
    rng, runs = np.random.default_rng(1), []
    model = OdometryModel.of_design(dataset().robot, "arc")
    for run in dataset().trajectories:
        (poses,) = model.poses([run.log(run.pose_times)])
        noise = rng.normal(0, 1, poses.shape) * [1e-3, 1e-3, 2e-3]
        runs.append(replace(run, poses=poses + np.vstack([np.zeros(3), noise[1:]])))
    data = make_dataset("exact", dataset().robot, PERIOD, runs)
    run, plain = learned(data=data), calibrate(data, "closed_form")
    assert not run.calibration.effects
    assert "the matrix alone: no gain on held-out runs is sure" in run.result.reason
    assert run.calibration.matrix == plain.calibration.matrix
    assert run.uncertainty is not None


def test_far_from_what_was_driven_the_matrix_alone_is_left() -> None:
    calibration = fitted().calibration
    fast = np.linalg.solve(calibration.matrix_array, [2.0, 0.0, 0.0])
    twist = one_second(calibration.model, fast)
    np.testing.assert_allclose(twist, [2.0, 0.0, 0.0], atol=1e-12)


def one_second(model: OdometryModel, rates: Array) -> Array:
    """The pose after one second of constant rates."""
    stream = model.stream()
    for _ in range(20):
        stream.drive(rates * PERIOD, PERIOD)
    return stream.pose


def test_spent_seconds_end_the_training_with_the_best_so_far() -> None:
    run = learned(options={"epochs": 100_000, "learning_rate": 1e-5}, budget=Budget(seconds=2.0))
    assert run.result.outcome is Outcome.BUDGET
    assert "epochs on 5 sessions, when the time was spent" in run.result.reason
    assert run.result.seconds < 6.0


def test_progress_is_told_in_epochs() -> None:
    events: list[Progress] = []
    learned(watch=events.append)
    told = [event for event in events if event.unit == "epoch"]
    assert told
    assert all(event.total == SMALL["epochs"] and event.done <= SMALL["epochs"] for event in told)


def test_too_few_runs_are_not_for_it() -> None:
    few = make_dataset("few", dataset().robot, PERIOD, dataset().split("train")[:3])
    with pytest.raises(ConfigError, match="for which 3 are too few; record more"):
        learned(data=few)


def test_without_jax_one_line_says_what_to_install() -> None:
    code = f"""
import sys
sys.modules["jax"] = None
sys.path.insert(0, {str(Path(__file__).parent)!r})
from slipping_robot import slipping
from omnibench import calibrate
from omnibench.registry import load_plugins
assert not load_plugins({str(ROOT / "plugins")!r})
try:
    calibrate(slipping(), calibrator="learned")
except Exception as error:
    print(error)
"""
    done = python(code)
    assert 'needs JAX and optax; pip install "omnibench[learned]"' in done.stdout
    assert done.stdout.count("\n") == 1


def test_steering_is_not_fitted_beside_it() -> None:
    with pytest.raises(ConfigError, match="calibrator 'learned' adds effects of its own; leave out steering: fit"):
        learned(steering="fit")
