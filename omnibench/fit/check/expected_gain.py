"""Whether a calibration is needed: the gain on runs that were not fitted, by the verdict of ``calibrate``."""

from __future__ import annotations

from dataclasses import dataclass

from omnibench.data.dataset import Dataset
from omnibench.fit.evaluate import looked_at, verdict_on
from omnibench.fit.quick_fit import quick_fit
from omnibench.robot.model import OdometryModel
from omnibench.words import plural

_SMALL = 0.1  # share of the cost: a larger gain that is not significant is left open; chosen
_ENOUGH = 10  # commands, from which on a gain would have shown if there were one; chosen


@dataclass(frozen=True)
class Gain:
    """needed: as in CheckReport. sentence: the errors before and after."""

    needed: bool | None
    sentence: str


def expected_gain(dataset: Dataset, *, clocks_agree: bool = True) -> Gain:
    """The verdict on a quick fit to the training runs, as ``calibrate`` judges its own.

    clocks_agree: False where the reference's clock is so far off that a gain which is not significant says nothing.
    """
    robot, held_out = dataset.robot, dataset.split("validation")
    training = looked_at(dataset.split("train") or held_out)
    model = OdometryModel(robot, quick_fit(robot, training), "arc")
    verdict = verdict_on(model, training, looked_at(held_out) if dataset.split("train") else ())
    needed = {"better": True, "worse": False}.get(verdict.verdict)
    small = verdict.improvement is not None and abs(verdict.improvement) < _SMALL
    if verdict.verdict == "undecided" and small and verdict.units >= _ENOUGH:
        needed = False
    if needed is None and not clocks_agree:
        return Gain(None, "whether a calibration is needed can be told once the clocks are matched")
    if verdict.verdict == "unknown":
        runs = plural(len(dataset.trajectories), "run")
        return Gain(None, f"whether a calibration is needed cannot be told from {runs}; record four, of three commands")
    return Gain(needed, verdict.sentence)
