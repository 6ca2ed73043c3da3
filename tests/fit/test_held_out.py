"""The verdict of held-out runs: better, worse, undecided or unknown, and what it rests on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from fit_samples import noisy_trajectories

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.fit.calibrate import calibrate
from omnibench.fit.evaluate import evaluate
from omnibench.fit.held_out import judge
from omnibench.robot.calibration import Calibration, HeldOutVerdict
from omnibench.robot.kinematics import Array
from omnibench.testing.synthetic import synthetic_robot

ROBOT = synthetic_robot()


def runs(commands: int, repetitions: int = 1) -> list[Trajectory]:
    """Runs of commands, each driven some times."""
    (run, *_) = noisy_trajectories()
    return [
        replace(run, id=f"c{command}-{repetition}", command=f"c{command}", repetition=repetition)
        for command in range(commands)
        for repetition in range(repetitions)
    ]


def errors(sizes: Sequence[float]) -> Array:
    """Final pose errors (Z, 3) of some lengths, m, with a heading of a tenth of them, rad."""
    return np.outer(sizes, [0.6, 0.8, 0.1])


def recordings(validating: int, name: str = "synthetic") -> Dataset:
    """Twelve runs, the last of which validate."""
    every = noisy_trajectories()
    split = len(every) - validating
    held_out = (replace(run, split="validation") for run in every[split:])
    return make_dataset(name, ROBOT, 0.2, [*every[:split], *held_out], simulated=True)


def verdict(calibration: Calibration) -> HeldOutVerdict:
    """The verdict in a calibration file."""
    assert calibration.provenance is not None
    assert calibration.provenance.held_out is not None
    return calibration.provenance.held_out


def test_a_calibration_that_raises_the_errors_of_held_out_runs_is_not_to_be_used() -> None:
    found = judge(errors([0.020, 0.022, 0.024]), errors([0.031, 0.033, 0.036]), runs(3))
    assert found.verdict == "worse"
    assert (
        found.sentence == "held out (3 runs): 22 mm -> 33 mm, 0.13 deg -> 0.19 deg, worse than the design: do not use"
    )
    assert "rises by 51.5 % (95 % interval" in found.detail
    assert found.detail.endswith("Student's t over 3 runs); runs: c0-0, c1-0, c2-0")


def test_a_calibration_that_lowers_the_errors_of_held_out_runs_is_better() -> None:
    found = judge(errors(np.linspace(0.1, 0.2, 12)), errors(np.linspace(0.02, 0.06, 12)), runs(12))
    assert (found.verdict, found.method, found.unit, found.units) == ("better", "bootstrap", "run", 12)
    assert 0 < (found.low or 0) < (found.improvement or 0) < (found.high or 0) < 1
    assert found.sentence.endswith("better than the design")


def test_differences_that_chance_can_explain_are_undecided() -> None:
    found = judge(errors([0.02, 0.03, 0.04, 0.05]), errors([0.03, 0.01, 0.06, 0.03]), runs(4))
    assert found.verdict == "undecided"
    assert "chance alone can explain" in found.sentence


@pytest.mark.parametrize("commands", [1, 2])
def test_many_runs_of_one_or_two_commands_leave_it_undecided_without_an_interval(commands: int) -> None:
    number = 20 * commands
    found = judge(errors(np.full(number, 0.2)), errors(np.linspace(0.01, 0.02, number)), runs(commands, 20))
    assert (found.verdict, found.unit, found.units, found.low) == ("undecided", "command", commands, None)
    assert f"no interval from {commands} command" in found.detail


def test_without_held_out_runs_it_cannot_be_said_and_how_to_get_some_is() -> None:
    found = verdict(calibrate(recordings(validating=0)).calibration)
    assert (found.verdict, found.runs) == ("unknown", ())
    assert "cannot be said" in found.sentence
    assert "--set validation=" in found.detail
    assert "omnibench evaluate" in found.detail


def test_calibrate_and_evaluate_end_with_the_same_verdict() -> None:
    dataset = recordings(validating=6)
    calibration = calibrate(dataset).calibration
    found = verdict(calibration)
    assert found == evaluate(calibration, dataset).held_out
    assert found.verdict == "better"
    assert found.runs == tuple(each.id for each in dataset.split("validation"))


def test_all_runs_of_another_recording_are_held_out() -> None:
    calibration = calibrate(recordings(validating=0)).calibration
    found = evaluate(calibration, recordings(validating=0, name="another day")).held_out
    assert found.verdict == "unknown"  # the same content: these runs were fitted
    every = [replace(run, poses=run.poses + 0.001) for run in noisy_trajectories()]
    other = make_dataset("another day", ROBOT, 0.2, every, simulated=True)
    assert len(evaluate(calibration, other).held_out.runs) == 12


def test_runs_of_a_recording_that_was_changed_since_do_not_count_as_held_out() -> None:
    dataset = recordings(validating=0)
    calibration = calibrate(dataset).calibration
    changed = [replace(run, poses=run.poses + 0.001) for run in dataset.trajectories]
    found = evaluate(calibration, make_dataset("synthetic", ROBOT, 0.2, changed, simulated=True)).held_out
    assert found.verdict == "unknown"
    assert "is not known" in found.sentence


def test_fitted_runs_that_are_made_validation_runs_after_the_fit_are_not_called_held_out() -> None:
    dataset = recordings(validating=6)
    calibration = calibrate(dataset).calibration
    swapped = [
        replace(run, split="train" if run.split == "validation" else "validation") for run in dataset.trajectories
    ]
    found = evaluate(calibration, make_dataset("synthetic", ROBOT, 0.2, swapped, simulated=True)).held_out
    assert (found.verdict, found.runs) == ("unknown", ())
    assert "the data set synthetic or its split was changed after the fit" in found.sentence


def test_the_design_values_themselves_are_the_same_as_the_design() -> None:
    same = errors([0.02, 0.03, 0.04, 0.05])
    assert judge(same, same, runs(4)).sentence.endswith("the same as the design")


def test_a_design_without_errors_leaves_nothing_to_improve() -> None:
    found = judge(np.zeros((4, 3)), errors([0.01, 0.01, 0.02, 0.01]), runs(4))
    assert (found.verdict, found.improvement) == ("undecided", None)
    assert "no error there to be improved" in found.sentence
