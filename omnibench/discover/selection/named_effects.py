"""Named effects: those that were selected, with 95 % intervals, probabilities and doubts; and all that were tried.

The intervals are those of the fit's covariance by Student's t, fit/information.py.
"""

from __future__ import annotations

from dataclasses import replace

from omnibench.discover.regressors.columns import Group
from omnibench.discover.regressors.significance import Significance
from omnibench.discover.result import Candidate, EstimatedParameter, NamedEffect
from omnibench.discover.selection.competing_models import CompetingModels
from omnibench.discover.selection.model_selection import SURE, Selection
from omnibench.discover.selection.motor_effects import MotorEffects
from omnibench.robot.effects.effect import form_in_words
from omnibench.robot.kinematics import Array, Robot


def named_effects(models: CompetingModels, motors: MotorEffects | None) -> tuple[NamedEffect, ...]:
    """The effects of the model that is used, then those of the motors."""
    used, model = models.used, models.used.fit.model
    effects = _effects(models.selection, model.robot, used.values, used.covariance.reach[model.matrix.size :])
    effects = tuple(
        replace(effect, in_doubt="; ".join(filter(None, (effect.in_doubt, reason))))
        if effect.confusable_with
        else effect
        for effect, reason in zip(effects, models.preferred, strict=True)
    )
    if motors is None:
        return effects
    return effects + _effects(motors.selection, model.robot, motors.values, motors.covariance.reach)


def candidates_of(selection: Selection) -> tuple[tuple[Candidate, ...], ...]:
    """The effects that were tried at each step, each in its best shape, the largest chi-square difference first."""
    return tuple(_candidates(step, selection) for step in selection.steps)


def _effects(selection: Selection, robot: Robot, values: Array, reach: Array) -> tuple[NamedEffect, ...]:
    """The chosen effects. reach (n,): half-widths of the intervals of their linear parameters."""
    tried = {
        group.name: (chi_square, rank)
        for step in selection.steps[::-1]
        for group, chi_square, rank in zip(step.groups, step.chi_square, step.rank, strict=True)
        if any(group.index[:1] == each.index[:1] for each in selection.chosen)
    }
    doubt = ""
    if not selection.known > SURE:
        doubt = (
            f"generic bases still find {selection.left_share:.0%} of what was there, which a right name seldom leaves"
        )
    effects, row = [], 0
    for group, confusable in zip(selection.chosen, selection.confusable, strict=True):
        assert group.effect is not None
        rows = slice(row, row + len(group.parameters))
        row = rows.stop
        weight = selection.weights.get(group.name, 0.0)
        chi_square, rank = tried.get(group.name, (0.0, 0.0))
        names = [parameter.name for parameter in group.parameters]
        assert group.effect is not None
        shapes = []
        for each in group.effect.parameters(robot):
            if each.name in group.shapes:
                value = group.shapes[each.name]
                shapes.append(EstimatedParameter(each.name, value, each.unit, value, value, shape=True))
        effects.append(
            NamedEffect(
                name=group.name,
                stage=group.effect.stage,
                weight=weight,
                form=form_in_words(dict(group.shapes) | dict(zip(names, values[rows].tolist(), strict=True))),
                parameters=(*_estimates(group, values[rows], reach[rows]), *shapes),
                confusable_with=confusable,
                physics=group.effect.physics,
                source=group.effect.source,
                chi_square=float(chi_square),
                degrees_of_freedom=int(rank),
                in_doubt=doubt,
                class_weight=weight + sum(selection.weights.get(name, 0.0) for name in confusable),
            )
        )
    return tuple(effects)


def _estimates(group: Group, values: Array, margins: Array) -> list[EstimatedParameter]:
    return [
        EstimatedParameter(parameter.name, float(value), parameter.unit, float(value - margin), float(value + margin))
        for parameter, value, margin in zip(group.parameters, values, margins, strict=True)
    ]


def _candidates(step: Significance, selection: Selection) -> tuple[Candidate, ...]:
    ordered = sorted(step.best_shapes, key=lambda index: -step.chi_square[index])
    names = [step.groups[index].name for index in ordered]
    return tuple(
        Candidate(name, float(step.chi_square[index]), int(step.rank[index]), selection.weights.get(name, 0.0))
        for name, index in zip(names, ordered, strict=True)
    )
