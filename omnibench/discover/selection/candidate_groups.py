"""Groups of columns that are tried on the residuals: the matrix, the catalogue's effects, the generic bases."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import product

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.discover.regressors.column_group import Group
from omnibench.discover.regressors.covariate_bases import generic_bases
from omnibench.discover.regressors.paths import Paths
from omnibench.registry import effects
from omnibench.robot.effects.effect import Effect, MotionEffect, ReferenceEffect
from omnibench.robot.effects.forms import Forms, forms_of
from omnibench.robot.kinematics import Array, Robot

# Shapes of an effect: with more of them, one comes near enough to any other form. tests/benchmarks/constants.py varies
# it by 0.5 and 2: on a small set with heading drift no verdict and no name changes.
_FEW = 6


class Missing(Enum):
    """Data that recordings lack, so that an effect cannot be looked for; each value is the reason in words."""

    WHEEL_ANGLES = "the wheels' absolute angles were not recorded (columns phi_*)"
    START_TIMES = "when the runs were driven was not recorded (column started_at)"
    SESSIONS = "the session of some runs was not recorded (column session)"
    SECOND_SESSION = "all runs are of one session"


@dataclass(frozen=True, eq=False)
class Groups:
    """All groups with their columns (S, 3, p), and the effects that cannot be looked for in these recordings."""

    matrix: Group
    effects: tuple[Group, ...]
    bases: tuple[Group, ...]
    columns: Array
    not_looked_for: tuple[tuple[str, Missing], ...]


def make_groups(paths: Paths, trajectories: Sequence[Trajectory], without: Sequence[str]) -> Groups:
    """Groups and columns along paths. without: names of effects that are not to be tried."""
    columns: list[Array] = [_of_matrix(paths)]
    count = columns[0].shape[2]
    matrix = Group("matrix", "matrix", tuple(range(count)))
    named: list[Group] = []
    not_looked_for: list[tuple[str, Missing]] = []

    def add(new: Array) -> tuple[int, ...]:
        nonlocal count
        columns.append(new)
        count += new.shape[2]
        return tuple(range(count - new.shape[2], count))

    sessions = tuple(dict.fromkeys(run.session for run in trajectories if run.session is not None))
    for effect in _candidates(paths.robot, without):
        if missing := _lacks(effect, paths, sessions):
            not_looked_for.append((effect.name, missing))
            continue
        parameters = effect.parameters(paths.robot, sessions)
        linear = tuple(each for each in parameters if not each.choices)
        shaping = tuple(each for each in parameters if each.choices)
        shapes = [dict(zip((each.name for each in shaping), values, strict=True)) for values in
                  product(*(each.choices for each in shaping))]  # fmt: skip
        for shape in shapes:
            base = {each.name: 0.0 for each in linear} | shape
            index = add(np.concatenate([paths.of_effect(effect, each.name, base) for each in linear], axis=2))
            family = None if len(shapes) > _FEW else _family(paths, effect, [each.name for each in linear], base)
            forms: tuple[int, ...] = ()
            if family is not None:
                zero = base | dict.fromkeys((each.name for each in family.parameters), 0.0) | dict(family.scales)
                forms = add(
                    np.concatenate([paths.of_effect(effect, each.name, zero) for each in family.parameters], axis=2)
                )
            named.append(Group("effect", effect.name, index, effect, linear, shape, len(shapes), forms, family))
    bases = [
        Group("covariate", basis.covariate, add(basis.columns), tries=basis.tries, basis=basis)
        for basis in generic_bases(paths, trajectories)
    ]
    return Groups(matrix, tuple(named), tuple(bases), np.concatenate(columns, axis=2), tuple(not_looked_for))


def _of_matrix(paths: Paths) -> Array:
    """Slopes (S, 3, 3M) by the elements of the matrix, of the samples of the other columns."""
    driven = paths.driven
    return np.concatenate([paths.of_twist(np.tile(row, (len(driven), 1)), driven) for row in np.eye(3)], axis=2)


def _candidates(robot: Robot, without: Sequence[str]) -> Iterator[MotionEffect | ReferenceEffect]:
    for entry in effects.entries():
        if entry.name in without:
            continue
        effect: Effect = effects.create(entry.name)
        if not isinstance(effect, MotionEffect | ReferenceEffect) or effect.run_nuisance:
            continue
        if effect.in_catalogue and effect.applies(robot):
            yield effect


def _lacks(effect: Effect, paths: Paths, sessions: tuple[str, ...]) -> Missing | None:
    """Why an effect cannot be looked for; None if it can."""
    if "wheel_angles" in effect.needs and paths.signals.wheel_angles is None:
        return Missing.WHEEL_ANGLES
    if "session_time" in effect.needs and paths.signals.session_time is None:
        return Missing.START_TIMES
    if "session" in effect.needs and any(log.session is None for log in paths.logs):
        return Missing.SESSIONS
    if not effect.parameters(paths.robot, sessions):
        return Missing.SECOND_SESSION
    return None


def _family(paths: Paths, effect: Effect, names: Sequence[str], values: Mapping[str, float]) -> Forms | None:
    """The forms of an effect, which these recordings can tell; None for one that has no others."""
    if not isinstance(effect, MotionEffect):
        return None
    corrections = {name: paths.correction(effect, {**values, name: 1.0}) for name in names}
    forms = forms_of(effect, paths.signals, corrections)
    return forms if forms.parameters else None


def check_names(names: Sequence[str]) -> None:
    """Raises UnknownNameError for a name that is no effect's."""
    for name in names:
        effects.entry(name, "without")
