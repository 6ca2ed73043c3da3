"""Experiments that tell the members of a class of effects apart: the cheapest runs, chosen for this robot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.data.dataset import Dataset
from omnibench.discover.experiments.candidate_runs import CandidateRun, candidate_runs, coarse, placed_seconds
from omnibench.discover.experiments.driving_plan import commands_in_words, description_of, plan_config
from omnibench.discover.experiments.run_choice import Choice, choose_runs
from omnibench.discover.experiments.separation import Members, Separation
from omnibench.discover.fitting.extend import Extended, columns_of
from omnibench.discover.fitting.model_fit import at_runs
from omnibench.discover.regressors.column_group import Group
from omnibench.discover.result import Experiment, NamedEffect
from omnibench.fit.least_squares.whitened import Whitened


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
