"""Where nothing has a name: smooth functions of what was located, kept if runs that were held out gain by them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from omnibench.discover.fitting.extend import Extended, columns_of, extend
from omnibench.discover.fitting.model_fit import Fit
from omnibench.discover.held_out.gaps import HELD_OUT, folds_by_lot, gains_on_held_out
from omnibench.discover.regressors.covariate_bases import Basis
from omnibench.discover.regressors.significance import Gains
from omnibench.discover.regressors.whitened import given
from omnibench.discover.selection.candidate_groups import Group
from omnibench.discover.selection.competing_models import Rivals
from omnibench.discover.selection.model_selection import CHANCE
from omnibench.discover.selection.screening import Look
from omnibench.registry import effects
from omnibench.robot.kinematics import Array, Robot

_GRID = 6  # patches of the map along each side of the area
_MOST = 5  # bases that are put together
_PRICE = 2.0  # chi2 that a direction of a further basis must gain; single functions are chosen more strictly
_DETERMINED = 0.01  # share of a function that must be left beyond the others, so that coefficients stay small
_LARGEST = 3.0  # times the plausible range: a value beyond stands for something else


@dataclass(frozen=True, eq=False)
class Closed:
    """The models with the term, or as they were, and what is to be told of it."""

    rivals: Rivals
    note: str


@dataclass(frozen=True, eq=False)
class _Trial:
    """A model with functions, and by how much these lower the chi2 of each run (Z,) when it is held out."""

    terms: tuple[Group, ...]
    used: Extended
    gains: Array


def close_without_name(plain: Fit, look: Look, rivals: Rivals) -> Closed:
    """Add smooth functions of the surest place's covariate to all models: of what effects leave, if there are any.

    Matrix, named effects and functions are fitted together. They stay only if runs that are held out gain. All are of
    one stage, of several the one that gains most: what happens at one can be imitated at another, badly.
    """
    found = surest_bases(look)
    if not found:
        return Closed(rivals, "No smooth term was tried: nothing that is left depends on what a model could use.")
    covariate = found[0][0].covariate
    trials = [trial for bases in found for trial in _tried(plain, rivals.used, bases)]
    if not trials:
        return Closed(rivals, f"No smooth term was added: no function of the {covariate} is plainly there by itself.")
    best = max(trials, key=lambda trial: float(trial.gains.mean()))
    details = dict.fromkeys(term.basis.detail for term in best.terms if term.basis is not None)
    what = f"a smooth term over {covariate} ({'; '.join(details)})"
    mean, error = float(best.gains.mean()), float(best.gains.std()) / np.sqrt(len(best.gains))
    gained = f"{mean:.2g} +- {error:.1g} of whitened chi2 a run"
    if not mean > HELD_OUT * error:
        return Closed(rivals, f"{_capital(what)} was tried and left out: on runs held out it gains {gained}.")
    others = tuple((weight, extend(plain, [*each.groups, *best.terms])) for weight, each in rivals.models[1:])
    note = f"The extended model holds {what}, which is no name: on runs held out it gains {gained}."
    return Closed(replace(rivals, used=best.used, models=((rivals.models[0][0], best.used), *others)), note)


def _tried(plain: Fit, base: Extended, bases: Sequence[Basis]) -> Iterator[_Trial]:
    """The model with functions of some bases, if any of them is plainly there."""
    terms = chosen_functions(base, list(_groups_of(bases, plain.model.robot)))
    if terms:
        used = extend(plain, [*base.groups, *terms])
        yield _Trial(tuple(terms), used, _gains(used, len(base.groups)))


def step_name(group: Group) -> str:
    """What a step of the waterfall is called that adds a group."""
    return group.name if group.basis is None else f"smooth term over {group.basis.covariate} (no name)"


def steps_of(groups: Sequence[Group]) -> list[int]:
    """How many groups there are after each step: named effects come one by one, what has no name at once."""
    named = sum(group.basis is None for group in groups)
    return [*range(1, named + 1), *([len(groups)] if len(groups) > named else [])]


def surest_bases(look: Look) -> list[list[Basis]]:
    """Bases of the surest place's covariate that a model can use, those of each stage apart.

    Each gains beyond those before it.
    """
    gains = look.named.left if look.named.chosen else look.places
    groups = _of_surest_covariate(gains)
    before = [*look.groups.matrix.index, *(index for group in look.named.chosen for index in group.index)]
    price = _PRICE * max(float(np.median(gains.spread)), 1.0)
    stages = dict.fromkeys(group.basis.stage for group in groups if group.basis is not None)
    of_stages = [[each for each in groups if each.basis and each.basis.stage == stage] for stage in stages]
    return [
        [group.basis for group in _together(look, own, before, price) if group.basis is not None] for own in of_stages
    ]


def _together(look: Look, groups: Sequence[Group], before: Sequence[int], price: float) -> list[Group]:
    """Groups that gain more than a price for each direction, one beyond the other; at least the best one."""
    groups, fitted, found = list(groups), list(before), list[Group]()
    while groups and len(found) < _MOST:
        now = given(look.data, fitted)
        beyond = [now.gain(group.index) - price * now.rank(group.index) for group in groups]
        best = groups.pop(int(np.argmax(beyond)))
        if found and max(beyond) <= 0:
            break
        found.append(best)
        fitted += best.index
    return found


def _of_surest_covariate(gains: Gains) -> list[Group]:
    beyond = (gains.gain - gains.rank * gains.spread) / np.sqrt(2 * np.maximum(gains.rank, 1.0)) / gains.spread
    surest = int(np.lexsort((-beyond, -gains.evidence))[0])
    if gains.p_value(surest) >= CHANCE:
        return []
    name = gains.groups[surest].name
    return [group for group in gains.groups if group.name == name and group.basis is not None and group.basis.term]


def _groups_of(bases: Sequence[Basis], robot: Robot) -> Iterator[Group]:
    known: list[tuple[str, object]] = []
    for basis in bases:
        for name, shapes in _terms_of(basis):
            if (name, shapes) not in known:
                known.append((name, shapes))
                effect = effects.create(name)
                linear = tuple(each for each in effect.parameters(robot) if not each.choices)
                yield Group("effect", name, (), effect, linear, shapes, basis=basis)


def _terms_of(basis: Basis) -> Iterator[tuple[str, Mapping[str, float]]]:
    """The basis's own term, and finer ones to choose functions from as well."""
    yield basis.term, basis.shapes
    if basis.term == "smooth_wheel_rate":
        yield "smooth_common_rate", basis.shapes
    if basis.term == "smooth_map":
        x, y, reach = (basis.shapes[name] for name in ("centre_x", "centre_y", "reach"))
        for east, north in product(np.linspace(-1, 1, _GRID).tolist(), repeat=2):
            if np.hypot(east, north) < 1 + 1 / _GRID:
                yield "smooth_map_patch", {
                    "centre_x": x + east * reach, "centre_y": y + north * reach, "radius": 2 * reach / (_GRID - 1)
                }  # fmt: skip
    if basis.term == "smooth_patch":
        x, y, radius = (basis.shapes[name] for name in ("centre_x", "centre_y", "radius"))
        for east, north in product((-0.5, 0.5), repeat=2):
            yield "smooth_patch", {
                "centre_x": x + east * radius, "centre_y": y + north * radius, "radius": radius / 2
            }  # fmt: skip


def chosen_functions(base: Extended, groups: Sequence[Group]) -> list[Group]:
    """Groups with those parameters alone that gain more than ln(runs) beyond matrix, effects and the others; 0 for all
    others, and no group that has none.

    One after another, those that gain most first. What the data hardly determine beyond these is no choice, nor is what
    would need a coefficient far outside of its plausible range.
    """
    data = base.fit.whitened(columns_of(base.fit, [*base.groups, *groups]))
    owner = np.repeat(np.arange(len(groups)), [len(group.parameters) for group in groups])
    names = [each.name for group in groups for each in group.parameters]
    limits = _LARGEST * np.array([each.high for group in groups for each in group.parameters])
    first = data.information.shape[0] - len(owner)
    left = given(data, range(first))
    scale = 1 / np.sqrt(np.maximum(left.total[first:], 1e-300))
    information = left.information[first:, first:] * np.outer(scale, scale)
    score = left.scores[:, first:].sum(axis=0) * scale
    kept: set[int] = set()
    while len(kept) < len(owner):
        size = np.diag(information)
        allowed = (size > _DETERMINED) & (np.abs(score) * scale < limits * size)
        gain = np.where(allowed, np.square(score) / np.maximum(size, 1e-300), 0.0)
        best = int(gain.argmax())
        if gain[best] <= np.log(len(data.scores)):
            break
        kept.add(best)
        column = information[:, best] / information[best, best]
        score = score - column * score[best]
        information = information - np.outer(column, information[best])
    found = []
    for number, group in enumerate(groups):
        own = {names[row] for row in kept if owner[row] == number}
        parameters = tuple(each for each in group.parameters if each.name in own)
        fixed = {each.name: 0.0 for each in group.parameters if each.name not in own}
        if parameters:
            found.append(replace(group, parameters=parameters, shapes=fixed | dict(group.shapes)))
    return found


def _gains(extended: Extended, named: int) -> Array:
    """By how much all groups after the first ``named`` lower each run's chi2 (Z,), predicted from the other folds."""
    fit, elements = extended.fit, extended.fit.model.matrix.size
    residuals = [
        own + columns[..., elements:] @ extended.values
        for own, columns in zip(fit.nuisance_free_residuals, extended.columns, strict=True)
    ]
    before = range(elements + sum(len(group.parameters) for group in extended.groups[:named]))
    data = fit.whitened(extended.columns, residuals)
    return gains_on_held_out(data, before, range(elements + len(extended.values)), folds_by_lot(fit.runs))


def _capital(text: str) -> str:
    return text[0].upper() + text[1:]
