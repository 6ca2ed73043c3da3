"""A smooth term where no effect has a name: functions of the covariate that the residuals depend on most surely.

They are kept if held-out runs gain by them. With Q the chi-square difference of a basis of d columns beyond those that
were taken before it, and v what chance makes of Q / d, a further basis is put to them if

    Q > 2 v d                                                                                                       (1)

(Akaike, "A new look at the statistical model identification", IEEE Trans. Automatic Control 19, 1974). Of all functions
of these bases, one after another is fitted that lowers the chi-square of Z runs by more than

    ln Z                                                                                                            (2)

(Schwarz, "Estimating the dimension of a model", Annals of Statistics 6, 1978).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from omnibench.discover.fitting.extend import Extended, columns_of, extend
from omnibench.discover.fitting.model_fit import Fit
from omnibench.discover.held_out.cross_validation import held_out_chi_square, is_gain
from omnibench.discover.regressors.column_group import Group
from omnibench.discover.regressors.covariate_bases import Basis
from omnibench.discover.regressors.significance import Significance
from omnibench.discover.selection.competing_models import CompetingModels
from omnibench.discover.selection.model_selection import CHANCE, Selection
from omnibench.discover.selection.screening import Screening
from omnibench.fit.least_squares.whitened import Whitened, given
from omnibench.registry import effects
from omnibench.robot.kinematics import Array, Robot

# tests/benchmarks/constants.py varies each number by 0.5 and 2, also where nothing has a name: what is said of gaps on
# held-out runs changes only at half the price, where none of the wet patch's counts as closed.
_GRID = 6  # patches of the map along each side of the area
_MOST = 5  # bases that are put together, at most
_PRICE = 2.0  # times v d, Eq. (1)
_DETERMINED = 0.01  # share of a function that must be left beyond the others: its standard error is 10 times its own
_LARGEST = 3.0  # times the plausible range: a larger coefficient stands for something else


@dataclass(frozen=True, eq=False)
class SmoothTerm:
    """The competing models with a smooth term, or as they were where it is left out, and a note on it."""

    models: CompetingModels
    note: str


@dataclass(frozen=True, eq=False)
class _Trial:
    """A model with functions, and the chi-square difference (Z,) that they make for each run when it is held out."""

    terms: tuple[Group, ...]
    used: Extended
    gains: Array


def add_smooth_term(
    plain: Fit, screening: Screening, selection: Selection, models: CompetingModels, folds: NDArray[np.intp]
) -> SmoothTerm:
    """Add smooth functions of the covariate that the residuals depend on most surely to all competing models.

    The residuals are those after the selected effects, if there are any. Matrix, named effects and functions are fitted
    together. They stay only if held-out runs gain. All are of one stage, of several stages the one that gains most:
    what happens at one stage can be imitated at another, badly. folds (Z,): the fold in which each run is held out.
    """
    stages = surest_bases(screening, selection)
    if not stages:
        return SmoothTerm(models, "No smooth term was tried: nothing that is left depends on what a model could use.")
    covariate = stages[0][0].covariate
    trials = [trial for bases in stages for trial in _tried(plain, models.used, bases, folds)]
    if not trials:
        return SmoothTerm(
            models, f"No smooth term was added: no function of the {covariate} is plainly there by itself."
        )
    best = max(trials, key=lambda trial: float(trial.gains.mean()))
    details = dict.fromkeys(term.basis.detail for term in best.terms if term.basis is not None)
    what = f"a smooth term over {covariate} ({'; '.join(details)})"
    mean, error = float(best.gains.mean()), float(best.gains.std()) / np.sqrt(len(best.gains))
    gained = f"{mean:.2g} +- {error:.1g} of whitened chi2 a run"
    if not is_gain(best.gains):
        return SmoothTerm(models, f"{_capital(what)} was tried and left out: on runs held out it gains {gained}.")
    others = tuple((weight, extend(plain, [*model.groups, *best.terms])) for weight, model in models.weighted[1:])
    note = f"The extended model holds {what}, which is no name: on runs held out it gains {gained}."
    return SmoothTerm(replace(models, used=best.used, weighted=((models.weighted[0][0], best.used), *others)), note)


def _tried(plain: Fit, base: Extended, bases: Sequence[Basis], folds: NDArray[np.intp]) -> Iterator[_Trial]:
    """The model with functions of some bases; none where no function gains enough."""
    terms = chosen_functions(base, list(_groups_of(bases, plain.model.robot)))
    if terms:
        used = extend(plain, [*base.groups, *terms])
        yield _Trial(tuple(terms), used, _held_out_gain(used, len(base.groups), folds))


def surest_bases(screening: Screening, selection: Selection) -> list[list[Basis]]:
    """Bases of the most significant covariate that a model can use, those of each stage apart.

    Each gains beyond those before it.
    """
    significance = selection.left if selection.chosen else selection.where
    groups = _of_surest_covariate(significance)
    before = screening.index_with(selection.chosen)
    price = _PRICE * max(float(np.median(significance.spread)), 1.0)  # Eq. (1)
    stages = dict.fromkeys(group.basis.stage for group in groups if group.basis is not None)
    of_stages = [[group for group in groups if group.basis and group.basis.stage == stage] for stage in stages]
    return [
        [group.basis for group in _together(screening.data, of_stage, before, price) if group.basis is not None]
        for of_stage in of_stages
    ]


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


def _of_surest_covariate(bases: Significance) -> list[Group]:
    """All bases of the most significant covariate that have a term; none where it may be chance."""
    beyond = (bases.chi_square - bases.rank * bases.spread) / np.sqrt(2 * np.maximum(bases.rank, 1.0)) / bases.spread
    surest = int(np.lexsort((-beyond, -bases.evidence))[0])
    if bases.p_value(surest) >= CHANCE:
        return []
    name = bases.groups[surest].name
    return [group for group in bases.groups if group.name == name and group.basis is not None and group.basis.term]


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
    """Groups with only those functions that gain more than ln(runs) beyond matrix, effects and each other (BIC).

    All other parameters are 0; groups without any function are left out. Functions are chosen one after another, the
    largest gain first. Those that the data hardly determine beyond the chosen ones are passed over, and those that
    would need a coefficient far outside its plausible range.
    """
    data = base.fit.whitened(columns_of(base.fit, [*base.groups, *groups]))
    owner = np.repeat(np.arange(len(groups)), [len(group.parameters) for group in groups])
    names = [parameter.name for group in groups for parameter in group.parameters]
    limits = _LARGEST * np.array([parameter.high for group in groups for parameter in group.parameters])
    first = data.information.shape[0] - len(owner)
    left = given(data, range(first))
    kept: set[int] = set()
    while len(kept) < len(owner):
        size, score = np.diag(left.information)[first:], left.scores[:, first:].sum(axis=0)
        allowed = (size > _DETERMINED * left.total[first:]) & (np.abs(score) < limits * size)
        gain = np.where(allowed, np.square(score) / np.maximum(size, 1e-300), 0.0)
        best = int(gain.argmax())
        if gain[best] <= np.log(len(data.scores)):  # Eq. (2)
            break
        kept.add(best)
        left = left.given([first + best])
    chosen = []
    for number, group in enumerate(groups):
        names_kept = {names[row] for row in kept if owner[row] == number}
        parameters = tuple(each for each in group.parameters if each.name in names_kept)
        fixed = {each.name: 0.0 for each in group.parameters if each.name not in names_kept}
        if parameters:
            chosen.append(replace(group, parameters=parameters, shapes=fixed | dict(group.shapes)))
    return chosen


def _held_out_gain(extended: Extended, named: int, folds: NDArray[np.intp]) -> Array:
    """Chi-square difference (Z,) of each held-out run by all groups after the first ``named``."""
    elements = extended.fit.model.matrix.size
    before = range(elements + sum(len(group.parameters) for group in extended.groups[:named]))
    after = range(elements + len(extended.values))
    data = extended.fit.whitened(extended.columns, extended.residuals_without_effects)
    return held_out_chi_square(data, before, after, folds)


def _capital(text: str) -> str:
    return text[0].upper() + text[1:]
