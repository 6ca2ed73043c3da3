"""Groups of columns that are tried on the residuals: the matrix, the catalogue's effects, the generic bases."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import accumulate, pairwise, product

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.discover.regressors.column_group import Group
from omnibench.discover.regressors.column_store import ColumnStore
from omnibench.discover.regressors.covariate_bases import Columns, generic_bases
from omnibench.discover.regressors.effect_slopes import correction_along, slopes_by, slopes_by_corrections
from omnibench.discover.regressors.paths import Paths
from omnibench.registry import effects
from omnibench.robot.effects.effect import (
    Effect,
    Forms,
    MotionEffect,
    Parameter,
    ReferenceEffect,
    form_profile,
    forms_of,
)
from omnibench.robot.kinematics import Array, Robot

# Shapes of an effect: with more of them, one comes near enough to any other form. tests/studies/constants.py varies
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
    """All groups, their columns, and the effects that cannot be looked for in these recordings.

    columns (K, 3, p): for each run, the differences of the columns from one stamp to the next, the first from 0, which
    lose nothing by being rounded.
    """

    matrix: Group
    effects: tuple[Group, ...]
    bases: tuple[Group, ...]
    columns: ColumnStore
    not_looked_for: tuple[tuple[str, Missing], ...]


def make_groups(paths: Paths, trajectories: Sequence[Trajectory], without: Sequence[str]) -> Groups:
    """Groups and columns along paths. without: names of effects that are not to be tried."""
    named: list[Group] = []
    sources: list[Columns] = [_of_matrix]
    not_looked_for: list[tuple[str, Missing]] = []
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
            family = None if len(shapes) > _FEW else _family(paths, effect, [each.name for each in linear], base)
            named.append(Group("effect", effect.name, (), effect, linear, shape, len(shapes), family=family))
            sources.append(_of_effect(effect, linear, named[-1]))
    bases = list(generic_bases(paths, trajectories))
    sources += [basis.columns or _none for basis in bases]
    columns, widths = _stored(paths, sources)
    ends = accumulate(widths, initial=0)
    matrix, *others = (tuple(range(low, high)) for low, high in pairwise(ends))
    return Groups(
        Group("matrix", "matrix", matrix),
        tuple(
            replace(group, index=index[: len(group.parameters)], forms=index[len(group.parameters) :])
            for group, index in zip(named, others, strict=False)
        ),
        tuple(
            Group("covariate", basis.covariate, index, tries=basis.tries, basis=basis)
            for basis, index in zip(bases, others[len(named) :], strict=True)
        ),
        columns,
        tuple(not_looked_for),
    )


def _stored(paths: Paths, sources: Sequence[Columns]) -> tuple[ColumnStore, list[int]]:
    """The columns of all sources along the paths, some runs at a time, and how many each source has."""
    store, widths = ColumnStore(), list[int]()
    for part in paths.in_parts():
        columns = [source(part) for source in sources]
        widths = [of_source.shape[2] for of_source in columns]
        together = np.concatenate(columns, axis=2)
        steps = np.diff(together, axis=0, prepend=0.0)
        firsts = [stamps.start for stamps in part.parts]
        steps[firsts] = together[firsts]
        store.append(steps, [stamps.stop - stamps.start for stamps in part.parts])
    return store, widths


def _none(along: Paths) -> Array:
    return np.zeros((len(along.poses), 3, 0))


def _of_effect(effect: MotionEffect | ReferenceEffect, linear: Sequence[Parameter], group: Group) -> Columns:
    """Slopes by the parameters of an effect, then by those of its forms, if it has any."""
    values, forms = {each.name: 0.0 for each in linear} | dict(group.shapes), group.family
    varied = [] if forms is None else [each.name.partition(":")[::2] for each in forms.parameters]

    def columns(along: Paths) -> Array:
        if isinstance(effect, ReferenceEffect):
            return slopes_by(along, effect, [each.name for each in linear], values)
        units = {each.name: correction_along(along, effect, {**values, each.name: 1.0}) for each in linear}
        scales = {} if forms is None else forms.scales
        profiles = {key: form_profile(key, effect, along.signals, scales) for _, key in varied}
        every = [*units.values(), *(units[name] * profiles[key] for name, key in varied)]
        return slopes_by_corrections(along, effect, every)

    return columns


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
    corrections = {name: correction_along(paths, effect, {**values, name: 1.0}) for name in names}
    forms = forms_of(effect, paths.signals, corrections)
    return forms if forms.parameters else None


def check_names(names: Sequence[str]) -> None:
    """Raises UnknownNameError for a name that is no effect's."""
    for name in names:
        effects.entry(name, "without")
