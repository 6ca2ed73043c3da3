"""Terms without a name, where no name is sure: functions of the covariate that the residuals depend on most surely.

They are kept if motions gain by them that are held out, whole kinds at a time. With Q the chi-square difference of a
basis of d columns beyond those that were taken before it, and v what chance makes of Q / d, a further basis is put to
them if

    Q > 2 v d                                                                                                       (1)

(Akaike, "A new look at the statistical model identification", IEEE Trans. Automatic Control 19, 1974). Of all P
functions of these bases, one after another is fitted that lowers the chi-square of Z runs by more than

    ln Z + ln P                                                                                                     (2)

(the extended Bayesian information criterion with gamma = 1/2, which makes up for the choice among many: J. Chen and
Z. Chen, "Extended Bayesian information criteria for model selection with large model spaces", Biometrika 95, 2008).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray

from omnibench.discover.covariates import Basis
from omnibench.discover.fit import Extended, Fit, columns_of, extend, without_runs
from omnibench.discover.held_out import folds_of_kinds, is_gain
from omnibench.discover.locate import weights_of_covariates
from omnibench.discover.result import CHANCE
from omnibench.discover.screening import Screening
from omnibench.discover.significance import Group, Significance, best_shapes
from omnibench.fit.trajectory_fit import Given, Whitened, given
from omnibench.registry import effects
from omnibench.robot.effects.smooth import smooth_joint
from omnibench.robot.kinematics import Array, Robot
from omnibench.words import plural

# tests/studies/constants.py varies each number by 0.5 and 2, also where nothing has a name: what is said of gaps on
# held-out runs changes only at half the price, where none of the wet patch's counts as closed.
_GRID = 6  # patches of the map along each side of the area
_MOST = 5  # bases that are put together, at most
_FINE = 8  # bases of fine structure, at most: neighbours of the surest are among them
# Kinds of motion without which a gain on those held out says nothing of other paths. On recordings of real robots terms
# gained where 36 kinds were driven (robotino: a quarter of Eq. (6)), and lost with 4 to 8 of them (omni3's circles:
# 107 mm to 112 mm on squares; diff: 7 mm to 17 mm), see tests/studies/real_discovery.py.
KINDS = 12
_FAMILIES = 2  # effects of the catalogue that are tried
_ROUNDS = 3  # most terms that are added one after another: as many as effects are named
_COVARIATES = 2  # covariates that are tried for a term: as many as a headline names
_PRICE = 2.0  # times v d, Eq. (1)
_DETERMINED = 0.01  # share of a function that must be left beyond the others: its standard error is 10 times its own
_LARGEST = 3.0  # times the plausible range: a larger coefficient stands for something else


@dataclass(frozen=True, eq=False)
class SmoothTerm:
    """Terms without a name, the model with these, or as it was where there are none; what is left then; and notes."""

    terms: tuple[Group, ...]
    model: Extended
    left: Significance
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Trial:
    """A term over a covariate, and the chi-square difference (Z,) that it makes for each run when it is held out."""

    covariate: str
    terms: tuple[Group, ...]
    gains: Array

    @property
    def words(self) -> str:
        details = dict.fromkeys(term.basis.detail for term in self.terms if term.basis is not None)
        return f"an unnamed term over {self.covariate} ({'; '.join(details)})"

    @property
    def gained(self) -> str:
        mean, error = float(self.gains.mean()), float(self.gains.std()) / np.sqrt(len(self.gains))
        return f"{mean:.2g} +- {error:.1g} of whitened chi2 a run"


def add_smooth_terms(
    plain: Fit,
    screening: Screening,
    model: Extended,
    left: Significance,
    looking_again: Callable[[Extended], Significance],
    folds: NDArray[np.intp],
) -> SmoothTerm:
    """Add terms without a name to a model, as long as runs that are held out gain by them.

    A term is a set of smooth functions of a covariate that the residuals depend on most surely, or an effect of the
    catalogue that explains most and whose name is not sure. left: what the residuals depend on after the effects;
    looking_again: what they depend on after more. Matrix, named effects and terms are fitted together. Functions of one
    covariate are of one stage, of several stages that which gains most: what happens at one stage can be imitated at
    another, badly. folds (Z,): the fold in which each run is held out where no kind of motion can be, as a function of
    the command says nothing of others.
    """
    kinds, notes, terms = folds_of_kinds(plain), list[str](), list[Group]()
    if (count := screening.kinds or 0) < KINDS:
        few = f"No unnamed term was tried: {plural(count, 'kind')} of motion cannot tell whether it holds for others."
        return SmoothTerm((), model, left, (few,))
    for _ in range(_ROUNDS):
        # The covariates that are most likely what the residuals depend on, if that is no chance
        significant = {
            group.name for index, group in enumerate(left.groups) if left.p_value(index) < CHANCE and _term_of(group)
        }
        weights = weights_of_covariates(left)
        covariates = sorted(significant, key=lambda name: -weights[name])[:_COVARIATES]
        trials = [
            trial
            for name in covariates
            for trial in _trials(screening, model, left, name, folds if name == "command" else kinds)
        ]
        trials += _of_families(screening, model, kinds) if covariates and not notes else ()
        best = max(trials, key=lambda trial: float(trial.gains.mean()), default=None)
        if best is None or not is_gain(best.gains):
            if not covariates:
                tried = "No unnamed term was tried: nothing that is left depends on what a model could use."
            elif best is None:
                names = " or ".join(covariates)
                tried = f"No unnamed term was added: no function of {names} is plainly there by itself."
            else:
                words = best.words[0].upper() + best.words[1:]
                tried = f"{words} was tried and left out: on motions held out it gains {best.gained}."
            notes = notes or [tried]
            break
        terms += best.terms
        model = extend(plain, [*model.groups, *best.terms])
        notes.append(f"The extended model holds {best.words}: on motions held out it gains {best.gained}.")
        left = looking_again(model)
    return SmoothTerm(tuple(terms), model, left, tuple(notes))


def _trials(
    screening: Screening, base: Extended, left: Significance, covariate: str, folds: NDArray[np.intp]
) -> Iterator[_Trial]:
    """Functions of one covariate: those of whole columns, by stage, and those of fine structure."""
    for bases in surest_bases(screening, base, left, covariate):
        groups = list(_groups_of(bases, base.fit.model.robot))
        data = _linearised(base, groups)
        limits = _LARGEST * np.array([parameter.high for group in groups for parameter in group.parameters])
        choose = partial(_kept_functions, limits=limits)
        if kept := choose(given(data, [])):
            gains = _held_out_gains(data, len(limits), choose, folds)
            yield _Trial(covariate, tuple(_restricted(groups, kept)), gains)


def _of_families(screening: Screening, base: Extended, folds: NDArray[np.intp]) -> Iterator[_Trial]:
    """Each of the effects that explain most beyond a model."""
    beyond = given(screening.data, screening.index_with(base.groups))
    names = {group.name for group in base.groups}
    groups = [group for group in screening.groups.effects if group.name not in names]
    gains = [beyond.chi_square(group.index) - _PRICE * beyond.rank(group.index) for group in groups]
    best = best_shapes(groups, gains)
    for index in sorted(best, key=lambda row: -gains[row])[:_FAMILIES]:
        group, effect = groups[index], groups[index].effect
        if effect is not None and gains[index] > 0:
            unnamed = replace(group, basis=Basis(effect.shows_in, effect.stage, f"as {group.name} would be"))
            every = range(len(unnamed.parameters))
            held_out = _held_out_gains(_linearised(base, [unnamed]), len(every), partial(_all_of, every), folds)
            yield _Trial(effect.shows_in, (unnamed,), held_out)


def surest_bases(screening: Screening, base: Extended, left: Significance, covariate: str) -> list[list[Basis]]:
    """Bases of a covariate that a model can use: those of each stage apart, and those of each term of fine structure.

    Of a stage, each gains beyond those before it.
    """
    excess = left.excess - left.rank * left.spread  # Eq. (1) with v of each basis
    of_covariate = [index for index, group in enumerate(left.groups) if group.name == covariate and _term_of(group)]
    price = _PRICE * max(float(np.median(left.spread)), 1.0)  # Eq. (1)
    before = screening.index_with(base.groups)
    of_stages: dict[str, list[Group]] = {}
    of_terms: dict[str, list[int]] = {}
    for index in of_covariate:
        group = left.groups[index]
        if not group.index:
            of_terms.setdefault(_term_of(group), []).append(index)
        elif group.basis is not None:
            of_stages.setdefault(group.basis.stage, []).append(group)
    found = [_together(screening.data, groups, before, price) for groups in of_stages.values()]
    for term, fine in of_terms.items():
        if term == smooth_joint.name:
            best = min(fine, key=left.surest.index)
            found.append([left.groups[best]] if left.p_value(best) < CHANCE else [])
        else:
            surest = sorted(fine, key=lambda index: -excess[index])
            found.append([left.groups[index] for index in surest[:_FINE] if excess[index] > 0])
    return [[group.basis for group in groups if group.basis is not None] for groups in found if groups]


def _term_of(group: Group) -> str:
    """The smooth effect that adds a basis to a model, or nothing."""
    return group.basis.term if group.basis is not None else ""


def _together(data: Whitened, groups: Sequence[Group], before: Sequence[int], price: float) -> list[Group]:
    """Groups that gain more than a price per degree of freedom, each beyond those before it; at least the best one."""
    groups, fitted, chosen = list(groups), list(before), list[Group]()
    while groups and len(chosen) < _MOST:
        now = given(data, fitted)
        beyond = [now.chi_square(group.index) - price * now.rank(group.index) for group in groups]
        best = groups.pop(int(np.argmax(beyond)))
        if chosen and max(beyond) <= 0:
            break
        chosen.append(best)
        fitted += best.index
    return chosen


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
    """The terms whose functions are candidates: the basis's own, and finer ones."""
    own = (basis.shapes,) if basis.parts is None else basis.parts
    yield from ((basis.term, shapes) for shapes in own)
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


def _linearised(base: Extended, groups: Sequence[Group]) -> Whitened:
    """Columns of a model and then of all functions of some groups, about the model's fit."""
    return base.fit.whitened(columns_of(base.fit, [*base.groups, *groups]))


def _kept_functions(columns: Given, limits: Array) -> Sequence[int]:
    """The functions that are chosen, by their numbers.

    columns: of a model, then of all functions. limits (P,): the largest sizes that these may have.
    """
    first = len(columns.information) - len(limits)
    left, kept = columns.given(range(first)), list[int]()
    while len(kept) < len(limits):
        size, score = np.diag(left.information)[first:], left.scores[:, first:].sum(axis=0)
        allowed = (size > _DETERMINED * left.total[first:]) & (np.abs(score) < limits * size)
        gain = np.where(allowed, np.square(score) / np.maximum(size, 1e-300), 0.0)
        best = int(gain.argmax())
        if gain[best] <= np.log(len(columns.scores)) + np.log(len(limits)):  # Eq. (2)
            break
        kept.append(best)
        left = left.given([first + best])
    return kept


def _all_of(functions: Sequence[int], _: Given) -> Sequence[int]:
    return functions


def _restricted(groups: Sequence[Group], kept: Sequence[int]) -> list[Group]:
    """Groups with the functions of these numbers alone, all others 0; those without any are left out."""
    restricted, number = [], 0
    for group in groups:
        numbers = range(number, number + len(group.parameters))
        number = numbers.stop
        parameters = tuple(each for row, each in zip(numbers, group.parameters, strict=True) if row in kept)
        fixed = {each.name: 0.0 for row, each in zip(numbers, group.parameters, strict=True) if row not in kept}
        if parameters:
            restricted.append(replace(group, parameters=parameters, shapes=fixed | dict(group.shapes)))
    return restricted


def _held_out_gains(
    data: Whitened, functions: int, choose: Callable[[Given], Sequence[int]], folds: NDArray[np.intp]
) -> Array:
    """Chi-square difference (Z,) that functions make for each held-out run, chosen and fitted by the other folds.

    data: columns of a model, then of so many functions.
    """
    first, gains = len(data.information) - functions, np.zeros(len(folds))
    for fold in np.unique(folds):
        inside = np.flatnonzero(folds == fold).tolist()
        others = without_runs(data, folds == fold)
        chosen = [*range(first), *(first + row for row in choose(others))]
        for index, sign in ((list(range(first)), 1), (chosen, -1)):
            values, _ = others.estimate(index)
            for run in inside:
                left = data.residuals[run] - data.columns[run][:, index] @ values
                gains[run] += sign * float(np.square(left).sum())
    return gains
