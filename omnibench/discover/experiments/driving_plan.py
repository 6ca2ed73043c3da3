"""The plan of an experiment: in words that a person can drive by, and as a config that can be simulated."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from omnibench.config import to_yaml
from omnibench.data.dataset import Dataset
from omnibench.discover.experiments.candidate_runs import PLACING, RAMP, CandidateRun
from omnibench.discover.experiments.run_choice import LONGEST, Choice
from omnibench.discover.fitting.model_fit import Fit
from omnibench.discover.result import ExperimentCommand, NamedEffect
from omnibench.report.numbers import listing
from omnibench.robot.calibration import matrix_rows
from omnibench.simulate.command import Command
from omnibench.simulate.config import FlowerConfig
from omnibench.words import plural

_WAYS = {0: "ahead", 90: "to the left", 180: "backward", 270: "to the right"}  # directions, deg
_SHORTEST_POSES = 0.02  # s between the reference poses that are simulated: denser ones take long and tell little more


def commands_in_words(chosen: Sequence[tuple[CandidateRun, int]]) -> tuple[ExperimentCommand, ...]:
    """Commands of chosen runs in words, with their numbers."""
    return tuple(
        ExperimentCommand(_in_words(candidate), count, candidate.timed.duration) for candidate, count in chosen
    )


def description_of(
    names: Sequence[str], commands: Sequence[ExperimentCommand], minutes: float, choice: Choice, recorded: float
) -> str:
    """What to drive, and what it tells, in a few sentences. recorded: chance after as long of the recorded commands."""
    hour = f"within {LONGEST / 60:.0f} minutes"
    if not commands:
        return f"Nothing that this robot can drive {hour} tells {listing(list(names), last='or')} apart."
    runs = sum(command.runs for command in commands)
    each = "; ".join(f"{command.motion}, {_times(command.runs)}" for command in commands)
    pairs = [(names[first], names[second]) for first, second in zip(*np.nonzero(np.triu(~choice.sure)), strict=True)]
    alike = "".join(f" Nothing that it can drive {hour} tells {first} from {second}." for first, second in pairs)
    same = f"after {minutes:.1f} more minutes of the commands that were recorded it does so in {_cases(recorded)}"
    return (
        f"Drive {plural(runs, 'run')}, {minutes:.1f} minutes with {PLACING:.0f} s before each to place the robot: "
        f"{each}. On both recordings together, discover then names the right one of {listing(list(names))} with a "
        f"weight of 95 % or more in {_cases(choice.chance)}; {same}.{alike}"
    )


def plan_config(
    dataset: Dataset,
    fit: Fit,
    effects: Sequence[NamedEffect],
    effect: NamedEffect,
    chosen: Sequence[tuple[CandidateRun, int]],
) -> str:
    """The experiment as a config for ``omnibench simulate``, with the effects that were found as its truth."""
    between = float(np.median(np.concatenate([np.diff(run.pose_times) for run in dataset.split("train")])))
    angles = [abs(angle) for candidate, _ in chosen for angle in _steering(candidate)]
    config = FlowerConfig.model_validate(
        {
            "robot": dataset.robot.model_dump() | {"name": dataset.robot.name or "robot"},
            "sample_period": dataset.sample_period,
            "pose_period": max(between, dataset.sample_period, _SHORTEST_POSES),
            "commands": {"listed": [_listed(candidate, count) for candidate, count in chosen], "ramp": RAMP},
            "steering_limit_deg": min(math.degrees(max(angles)) + 1, 180.0) if angles else None,
            "truth": {
                "matrix": matrix_rows(fit.model.matrix),
                "effects": [
                    {"name": each.name, "parameters": {value.name: value.value for value in each.parameters}}
                    for each in effects
                    if each.stage != "actuator"
                ],
            },
            "noise": fit.noise.noise.model_dump(),
            "train": {"seed": 1, "distance": 1.0},
        }
    )
    members = ", ".join((effect.name, *effect.confusable_with))
    return to_yaml(
        {
            "name": f"{dataset.name}_experiment",
            "description": f"Tells {members} apart; simulated with the first.",
            "datasets": {"experiment": {"simulate": config.model_dump(mode="json", exclude_defaults=True)}},
        }
    )


def _listed(candidate: CandidateRun, count: int) -> dict[str, float | int | None]:
    command = candidate.timed.command
    return {
        "speed": command.speed,
        "direction_deg": round(math.degrees(command.direction), 6),
        "turn_rate": command.turn_rate,
        "duration": candidate.timed.duration,
        "repetitions": count,
        "heading_deg": candidate.heading,
    }


def _steering(candidate: CandidateRun) -> list[float]:
    steering = candidate.run.steering
    return [] if steering is None else [float(angle) for angle in steering.ravel()]


def _in_words(candidate: CandidateRun) -> str:
    """A run in words: how it moves, how fast and how long."""
    command, seconds = candidate.timed.command, f"for {candidate.timed.duration:.3g} s"
    begin = "" if candidate.heading is None else f", begun at a heading of {candidate.heading:.0f} deg"
    side = "left" if command.turn_rate > 0 else "right"
    if not command.speed:
        return f"turn to the {side} on the spot at {abs(command.turn_rate):.3g} rad/s {seconds}{begin}"
    speed = f"at {command.speed:.3g} m/s {seconds}{begin}"
    if not command.turn_rate:
        return f"straight {_way(command)} {speed}"
    radius = command.speed / abs(command.turn_rate)
    return f"{_way(command)} in a curve to the {side} with a radius of {radius:.2g} m {speed}"


def _way(command: Command) -> str:
    """The direction of a command in the robot's frame, in words."""
    degrees = round(math.degrees(command.direction)) % 360
    return _WAYS.get(degrees, f"at {degrees} deg to the left of ahead")


def _times(count: int) -> str:
    return {1: "once", 2: "twice"}.get(count, f"{count} times")


def _cases(chance: float) -> str:
    return f"{min(math.floor(100 * chance + 0.5), 99)} of 100 cases"
