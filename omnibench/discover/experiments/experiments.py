"""Experiments that tell the members of a class of effects apart: the cheapest runs, chosen for this robot.

The plan of an experiment: in words that a person can drive by, and as a config that can be simulated.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.config import to_yaml
from omnibench.data.dataset import Dataset
from omnibench.discover.experiments.candidate_runs import (
    PLACING,
    RAMP,
    CandidateRun,
    candidate_runs,
    coarse,
    placed_seconds,
)
from omnibench.discover.experiments.run_choice import LONGEST, Choice, choose_runs
from omnibench.discover.experiments.separation import Members, Separation
from omnibench.discover.fitting.extend import Extended, columns_of
from omnibench.discover.fitting.model_fit import Fit, at_runs
from omnibench.discover.regressors.column_group import Group
from omnibench.discover.result import Experiment, ExperimentCommand, NamedEffect
from omnibench.fit.trajectory_fit import Whitened
from omnibench.report.numbers import listing
from omnibench.robot.calibration import matrix_rows
from omnibench.simulate.config import FlowerConfig
from omnibench.words import plural

_WAYS = {0: "ahead", 90: "left", 180: "backward", 270: "right"}  # directions of travel, deg
_SHORTEST_POSES = 0.02  # s between the reference poses that are simulated: denser ones take long and tell little more


def commands_in_words(chosen: Sequence[tuple[CandidateRun, int]]) -> tuple[ExperimentCommand, ...]:
    """Commands of chosen runs in words, with their numbers."""
    return tuple(
        ExperimentCommand(_in_words(candidate), count, candidate.timed.duration) for candidate, count in chosen
    )


def description_of(
    names: Sequence[str], runs: int, minutes: float, choice: Choice, inseparable: Sequence[tuple[str, str]]
) -> str:
    """How much to drive, and what it tells, in a few sentences."""
    hour = f"within {LONGEST / 60:.0f} minutes"
    if not runs:
        return f"Nothing that this robot can drive {hour} surely tells {listing(list(names), last='from')}."
    from_first = {first: [second for one, second in inseparable if one == first] for first, _ in inseparable}
    pairs = "; nor ".join(f"{first} from {listing(others, last='or')}" for first, others in from_first.items())
    alike = f" Nothing that it can drive {hour} surely tells {pairs}." if pairs else ""
    settled = "the right name" if not inseparable else "the right name, as far as it can be told,"
    return (
        f"Drive {plural(runs, 'run')}, {minutes:.1f} minutes with {PLACING:.0f} s before each to place the robot. On "
        f"both recordings together, discover then gives {settled} a weight of 95 % or more in "
        f"{_cases(choice.chance)}; after {minutes:.1f} more minutes of the commands that were recorded, in "
        f"{_cases(choice.chance_recorded)}.{alike}"
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
    variation = chosen[0][0].timed.variation
    angles = [abs(angle) for candidate, _ in chosen for angle in _steering(candidate)]
    config = FlowerConfig.model_validate(
        {
            "robot": dataset.robot.model_dump() | {"name": dataset.robot.name or "robot"},
            "sample_period": dataset.sample_period,
            "pose_period": max(between, dataset.sample_period, _SHORTEST_POSES),
            "commands": {
                "listed": [_listed(candidate, count) for candidate, count in chosen],
                "ramp": RAMP,
            }
            | ({} if variation.is_none else {"variation": variation}),
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
        "turn_rate": round(command.turn_rate, 4),
        "duration": candidate.timed.duration,
        "repetitions": count,
        "heading_deg": candidate.heading,
    }


def _steering(candidate: CandidateRun) -> list[float]:
    steering = candidate.run.steering
    return [] if steering is None else [float(angle) for angle in steering.ravel()]


def _in_words(candidate: CandidateRun) -> str:
    """A run in words: where to, how fast, and how it turns."""
    command = candidate.timed.command
    end = "" if candidate.heading is None else f", from a heading of {candidate.heading:.0f}°"
    variation = candidate.timed.variation
    if variation.weave:
        end += f", weaving by {variation.weave:g} rad/s every {variation.period:g} s"
    if variation.reversals:
        end += ", turning back halfway"
    side = "left" if command.turn_rate > 0 else "right"
    if not command.speed:
        return f"turning {side} on the spot at {abs(command.turn_rate):.3g} rad/s{end}"
    degrees = round(math.degrees(command.direction)) % 360
    beside = f"{degrees}° left of ahead" if degrees < 180 else f"{360 - degrees}° right of ahead"
    way = f"{_WAYS.get(degrees, beside)} at {command.speed:.3g} m/s"
    if not command.turn_rate:
        return f"{way}, straight{end}"
    return f"{way}, curving {side} (radius {command.speed / abs(command.turn_rate):.2g} m){end}"


def _cases(chance: float) -> str:
    return f"{min(round(100 * chance), 99)} of 100 cases"


def experiments_for(
    dataset: Dataset, effects: Sequence[NamedEffect], models: Sequence[tuple[float, Extended]]
) -> tuple[Experiment, ...]:
    """One experiment for each effect that is confusable with others.

    models: that the recordings cannot tell apart, with their weights.
    """
    experiments = []
    for effect in effects:
        if effect.confusable_with and effect.stage == "actuator":
            experiments.append(Experiment((effect.name, *effect.confusable_with), _OF_MOTORS, ""))
        elif (rivals := _Rivals.of(effect, [model for _, model in models])) is not None:
            experiments.append(_experiment(dataset, effects, effect, rivals))
    return tuple(experiments)


# Effects of the motors need no reference, and no choice of commands: any others show them (chosen).
_OF_MOTORS = "Drive at other speeds, from rest to rest: what motors make of their targets depends on nothing else."


@dataclass(frozen=True, eq=False)
class _Rivals:
    """The members of a class, and the model in which one of them is.

    weight: of the class. others: effects of that model beside the member.
    """

    weight: float
    model: Extended
    others: tuple[Group, ...]
    members: tuple[Group, ...]

    @staticmethod
    def of(effect: NamedEffect, models: Sequence[Extended]) -> _Rivals | None:
        """The class of an effect; None where the models hold no other member."""
        names = (effect.name, *effect.confusable_with)
        groups = {group.name: group for model in reversed(models) for group in model.groups}
        members = tuple(groups[name] for name in names if name in groups)
        model = next((each for each in models if any(group.name == effect.name for group in each.groups)), None)
        if model is None or len(members) < 2:
            return None
        return _Rivals(
            effect.class_weight, model, tuple(group for group in model.groups if group.name != effect.name), members
        )

    @property
    def groups(self) -> tuple[Group, ...]:
        return (*self.others, *self.members)

    @property
    def separation(self) -> Separation:
        """Expected separation of the members, by the recorded runs."""
        fit = self.model.fit
        recorded = fit.whitened(columns_of(fit, self.groups), self.model.residuals_without_effects)
        return Separation(recorded, Members.of(fit.model.matrix, self.others, self.members), self.weight)

    def of_runs(self, candidates: Sequence[CandidateRun]) -> Whitened:
        """The columns of runs that could be driven."""
        fit = at_runs(coarse(self.model.fit), [candidate.run for candidate in candidates])
        columns = columns_of(fit, self.groups)
        return fit.whitened(columns, [np.zeros(of_run.shape[:2]) for of_run in columns])


def _experiment(dataset: Dataset, effects: Sequence[NamedEffect], effect: NamedEffect, rivals: _Rivals) -> Experiment:
    fit = rivals.model.fit
    candidates = candidate_runs(fit, [group.effect for group in rivals.members if group.effect is not None])
    seconds = np.array([candidate.seconds for candidate in candidates])
    information = rivals.of_runs(candidates).information_of_runs
    choice = choose_runs(rivals.separation, information, seconds, placed_seconds(fit.runs))
    chosen = [(candidates[index], int(choice.counts[index])) for index in np.flatnonzero(choice.counts)]
    runs, minutes = int(choice.counts.sum()), float(choice.counts @ seconds) / 60
    names = [group.name for group in rivals.members]
    inseparable = tuple(_inseparable(names, choice))
    return Experiment(
        separates=(effect.name, *effect.confusable_with),
        description=description_of(names, runs, minutes, choice, inseparable),
        config=plan_config(dataset, fit, effects, effect, chosen) if chosen else "",
        commands=commands_in_words(chosen),
        runs=runs,
        minutes=minutes,
        chance=choice.chance if chosen else 0.0,
        chance_recorded=choice.chance_recorded if chosen else 0.0,
        inseparable=inseparable,
    )


def _inseparable(names: Sequence[str], choice: Choice) -> Iterator[tuple[str, str]]:
    """Pairs of members that no runs tell apart."""
    for first, second in zip(*np.nonzero(np.triu(~choice.sure)), strict=True):
        yield names[first], names[second]
