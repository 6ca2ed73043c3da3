"""Step 5, confirm: matrix and effects fitted anew with the noise, held-out runs, and whether anything is left.

Where several effects explain the same residuals, each in its place makes a model of its own. The one that best predicts
commands that its fit did not see, in the paper's cost, is used; what the models disagree on is not known.

Their average is weighed by all that is known of them. Member c of a class has the name's probability p_c, parameters
b_ci of which s_ci is the largest plausible size, and errs by e_cz in the final pose of run z of Z when the run's
command is held out. With the plausible size as the standard deviation of a parameter about 0, and errors that are
normal with an unknown variance, its weight is in proportion to

    p_c exp(-1/2 sum over i of (b_ci / s_ci)^2) (sum over z of |e_cz|^2)^(-3 Z / 2)                                 (1)

(pseudo-Bayesian model averaging: Geisser and Eddy, J. Am. Stat. Assoc. 74, 1979; Yao, Vehtari, Simpson and Gelman,
"Using stacking to average Bayesian predictive distributions", Bayesian Analysis 13, 2018). |e|^2 is in the units of
Eq. (6) of the paper. Folds of whole kinds of motions (one turn rate, one direction) are left out: without one of its
four kinds the matrix of omni3's circles is not determined, whatever the effect, and what these folds prefer errs by
5.2 deg on its squares, where Eq. (1) errs by 1.4 (tests/studies/real_discovery.py).

All corrections are linear in their parameters. So the average of models with matrices K_c and parameters b_c, of
covariance S_c where both are one vector t_c that is 0 for what a member does not hold, is a model with the terms of
all, and with the first two moments of the mixture:

    t = sum of w_c t_c,    S = sum of w_c (S_c + (t_c - t)(t_c - t)').                                              (2)

Named effects have 95 % intervals by the fit's covariance and Student's t, fit/intervals.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.discover.fine_structure import fine_structure
from omnibench.discover.fit import (
    Extended,
    Fit,
    at_model,
    columns_of,
    extend,
    model_with,
    most_probable,
    terms_of,
    without_effects,
)
from omnibench.discover.held_out import (
    faded,
    folds_of_commands,
    folds_of_kinds,
    held_out_residuals,
    is_confirmed,
    is_gain,
    random_folds_of_repetitions,
)
from omnibench.discover.locate import dependences_on, remaining
from omnibench.discover.result import (
    SURE,
    Candidate,
    CovariateDependence,
    EstimatedParameter,
    NamedEffect,
    lacks_a_name,
    verdict_of,
)
from omnibench.discover.screening import Screening, screen
from omnibench.discover.select import MotorEffects, Selected, Selection, select_effects
from omnibench.discover.significance import Group, significance_of, together
from omnibench.discover.spline_term import KINDS, add_smooth_terms
from omnibench.fit.estimate import LOST_RATE
from omnibench.fit.prior import physical_tolerance
from omnibench.fit.trajectory_fit import given
from omnibench.robot.effects.effect import form_in_words
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.physical import EstimatedCovariance


@dataclass(frozen=True, eq=False)
class Confirmed:
    """The models that held-out runs confirm, and what is left.

    screening, models: what the effects were selected by with the noise that they leave, and the models with them.
    effects: those with a name. where, left: what the residuals depend on without effects and beside all that the model
    in use holds. average: of the estimates of the competing models, of which ``likeliest`` is one. baseline, extended:
    the plain matrix, and the average, which fades outside the training domain where it is doubtful, under the same
    noise. folds (Z,): in which each run was held out. notes: on terms without a name.
    """

    selected: Selected
    screening: Screening
    models: CompetingModels
    effects: tuple[NamedEffect, ...]
    where: tuple[CovariateDependence, ...]
    left: tuple[CovariateDependence, ...]
    average: AveragedModel
    likeliest: Extended
    baseline: Extended
    extended: Extended
    folds: NDArray[np.intp]
    notes: tuple[str, ...]


def confirm(selected: Selected, rng: np.random.Generator, *, unknown_term: bool = True) -> Confirmed:
    """Confirm the selected effects. unknown_term: add a term without a name where no name is sure."""
    located = selected.proposal.located
    plain, whole = located.plain.fit, located.plain.whole
    screening, selection, extended = selected.screening, selected.selection, selected.extended
    if selection.chosen:  # once more, now that the noise is known better
        screening = screen(extended.fit, extended.residuals_without_effects, screening.groups)
        again = select_effects(screening, rng)
        if not again.is_same_as(selection):
            extended = extend(plain, again.chosen)
        selection = again
    models = with_fitted_forms(plain, screening, competing_models(plain, selection, extended))
    selection, carried = carried_over(screening, models.selection, folds_of_kinds(plain))
    models, chosen = replace(models, selection=selection), selection.chosen
    weighted = models.weighted
    if len(carried) < len(chosen):
        weighted = ((1.0, extend(plain, [group for group in chosen if group.name in carried])),)
    used = weighted[0][1]

    # What the residuals depend on, before the effects and after them
    baseline = without_effects(plain, used)
    bases = located.where
    if screening is not located.screening:
        bases = significance_of(screening.data, screening.groups.matrix.index, screening.groups.bases, rng)
    without = together(bases, fine_structure(baseline.fit, rng))
    beside = remaining(used, screening, rng) if used.groups else without
    where = dependences_on(without, "", screening.quantisation_chi_square)
    left = dependences_on(beside, "still ", lambda group: screening.quantisation_chi_square(group, used.groups))

    # Where no name is sure, terms without one are added
    motors, notes = selected.motors, tuple[str, ...]()
    folds = random_folds_of_repetitions(plain.runs, rng)
    verdict = verdict_of(named_effects(models, motors), where, left)
    if unknown_term and lacks_a_name(verdict):
        term = add_smooth_terms(plain, screening, used, beside, lambda model: remaining(model, screening, rng), folds)
        notes = term.notes
        if term.terms:
            left = dependences_on(
                term.left, "still ", lambda group: screening.quantisation_chi_square(group, used.groups)
            )
            others = [(weight, extend(plain, [*model.groups, *term.terms])) for weight, model in weighted[1:]]
            weighted = ((weighted[0][0], term.model), *others)
    if motors is not None:
        where += dependences_on(motors.where)
        left += dependences_on(motors.selection.left, "still ")

    # The estimates, of the plain matrix and of the average of all models; where something has no name, the effect that
    # robots of the class usually have is in these, too, as in what ``calibrate`` gives
    explained = verdict in ("named", "class") and len(carried) == len(chosen)
    usual = None if explained or verdict == "none" else usual_effect(screening, plain.model.robot)
    estimates = [(weight, _estimated(model, usual, whole)) for weight, model in weighted]
    average = averaged(estimates)
    baseline = average.extended
    if baseline.groups:
        baseline = most_probable(baseline.fit, (), np.zeros(0), whole)
    if explained:
        models = replace(models, used=estimates[0][1])
    # Where models disagree, or functions have no physics, they are not followed to motions that were not driven
    doubtful = len(average.members) > 1 or any(group.basis is not None for group in average.extended.groups)
    return Confirmed(
        selected=selected,
        screening=screening,
        models=models,
        effects=named_effects(models, motors),
        where=tuple(sorted(where, key=lambda dependence: (dependence.p_value, -dependence.excess))),
        left=tuple(left),
        average=average,
        likeliest=estimates[0][1],
        baseline=baseline,
        extended=faded(average.extended, baseline) if doubtful else average.extended,
        folds=folds,
        notes=notes,
    )


def carried_over(
    screening: Screening, selection: Selection, folds: NDArray[np.intp]
) -> tuple[Selection, frozenset[str]]:
    """The selection, and the names of its effects by which kinds of motion that were held out gain.

    Effects of which not even the class is sure count where so many kinds were driven that functions without a name do.
    Of effects by which they do not, the names have even odds at most: on recordings of real robots no such effect held
    for another kind of path (tests/studies/real_discovery.py). folds (Z,): of whole kinds.
    """
    carried, weights = set[str](), dict(selection.weights)
    for group, alike in zip(selection.chosen, selection.confusable, strict=True):
        others = screening.index_with([other for other in selection.chosen if other is not group])
        whole = sum(weights.get(name, 0.0) for name in (group.name, *alike))
        if is_confirmed(screening.data, others, group.index, folds):
            if whole >= SURE or (screening.kinds or 0) >= KINDS:
                carried.add(group.name)
            continue
        for name in (group.name, *alike):
            weights[name] = weights.get(name, 0.0) * min(1.0, _UNCONFIRMED / max(whole, 1e-300))
    return replace(selection, weights=weights), frozenset(carried)


def usual_effect(screening: Screening, robot: Robot) -> Group | None:
    """The effect that robots of the class usually have, by what ``calibrate`` takes for granted; None if left out."""
    groups = (group for group in screening.groups.effects if group.name == LOST_RATE[0])
    return next(groups, None) if physical_tolerance(robot).lost_rate else None


def _estimated(model: Extended, usual: Group | None, whole: Sequence[Trajectory] | None) -> Extended:
    """The most probable values of a model, with the usual effect after the effects that have a name."""
    if usual is None or any(group.name == usual.name for group in model.groups):
        return most_probable(model.fit, model.groups, model.values, whole)
    named = [group for group in model.groups if group.basis is None]
    count = sum(len(group.parameters) for group in named)
    values = np.concatenate([model.values[:count], np.zeros(len(usual.parameters)), model.values[count:]])
    return most_probable(model.fit, [*named, usual, *model.groups[len(named) :]], values, whole)


_UNCONFIRMED = 0.5  # probability, at most, of names by which held-out kinds of motion do not gain
# Share of a column that must be left beyond the others, as in spline_term.py: much of a form is another matrix.
_DETERMINED = 0.01


def with_fitted_forms(plain: Fit, screening: Screening, models: CompetingModels) -> CompetingModels:
    """The competing models, the used one with the forms of its effects by which held-out runs gain."""
    chosen = models.selection.chosen
    formed = [_formed(screening, chosen, position) for position in range(len(chosen))]
    if all(group is before for group, before in zip(formed, chosen, strict=True)):
        return models
    used = extend(plain, formed)
    weighted = ((models.weighted[0][0], used), *models.weighted[1:])
    return replace(models, used=used, selection=replace(models.selection, chosen=tuple(formed)), weighted=weighted)


def _formed(screening: Screening, chosen: Sequence[Group], position: int) -> Group:
    """An effect with those parameters of its forms that gain more than ln(runs) each (BIC), if all are confirmed."""
    group = chosen[position]
    if group.family is None or not group.forms:
        return group
    left, kept = given(screening.data, screening.index_with(chosen)), list[int]()
    columns = np.array(group.forms)
    while len(kept) < len(columns):
        free = np.diag(left.information)[columns] > _DETERMINED * left.total[columns]
        gains = [left.chi_square([int(column)]) if there else 0.0 for column, there in zip(columns, free, strict=True)]
        best = int(np.argmax(gains))
        if gains[best] <= np.log(len(screening.data.scores)):
            break
        kept.append(best)
        left = left.given([int(columns[best])])
    index = tuple(int(columns[row]) for row in sorted(kept))
    if not index or not screening.confirms(chosen, replace(group, index=index)):
        return group
    parameters = tuple(group.family.parameters[row] for row in sorted(kept))
    varied = {parameter.name.split(":")[1] for parameter in parameters}
    scales = {name: value for name, value in group.family.scales.items() if name.partition(":")[0] in varied}
    return replace(
        group,
        index=(*group.index, *index),
        parameters=(*group.parameters, *parameters),
        shapes=dict(group.shapes) | scales,
        forms=tuple(column for column in group.forms if column not in index),
    )


@dataclass(frozen=True, eq=False)
class CompetingModels:
    """The model that is used, the selection of its effects, and all competing models.

    weighted: all models with the weights of their names, the used one first. preferred: for each chosen effect, why it
    is used where another is as likely, or nothing.
    """

    used: Extended
    selection: Selection
    weighted: tuple[tuple[float, Extended], ...]
    preferred: tuple[str, ...]


def competing_models(plain: Fit, selection: Selection, extended: Extended) -> CompetingModels:
    """Fit all models that the data cannot tell apart, and use the best of them on commands that are held out."""
    used = extended
    preferred = ["" for _ in selection.chosen]
    others: list[tuple[float, Extended]] = []
    for position, stand_ins in enumerate(selection.stand_ins):
        for stand_in in stand_ins:
            chosen = selection.chosen
            model = extend(plain, [*chosen[:position], stand_in, *chosen[position + 1 :]])
            weight = selection.weights.get(stand_in.name, 0.0)
            difference = _costs(used) - _costs(model)
            if difference.mean() > 0:
                others.append((selection.weights.get(chosen[position].name, 0.0), used))
                preferred[position] = _reason(stand_in, difference)
                # The stand-in takes the place, and the effect that stood there is among the stand-ins.
                exchanged = tuple(
                    chosen[position] if group is stand_in else group for group in selection.stand_ins[position]
                )
                selection = replace(
                    selection,
                    chosen=(*chosen[:position], stand_in, *chosen[position + 1 :]),
                    stand_ins=(*selection.stand_ins[:position], exchanged, *selection.stand_ins[position + 1 :]),
                )
                used = model
            else:
                others.append((weight, model))
                preferred[position] = preferred[position] or _reason(chosen[position], -difference)
    weight = min((selection.weights.get(group.name, 0.0) for group in selection.chosen), default=1.0)
    return CompetingModels(used, selection, ((weight, used), *others), tuple(preferred))


def _reason(group: Group, difference: Array) -> str:
    how = "better" if is_gain(difference) else "no worse"
    return f"{group.name} is used: it predicts commands that were held out {how} in the cost of Eq. (6)"


def _costs(extended: Extended) -> Array:
    """Eq. (6) of every run (Z,), its command held out of the fit."""
    residuals = held_out_residuals(extended, folds_of_commands(extended.fit.runs))
    return np.array([float(np.linalg.norm(of_run[-1])) for of_run in residuals])


# Prior odds of the effect that robots of a class usually have against its look-alikes: of models that fit omni3's
# circles as well, creep errs on its squares by 5.9 deg, coupling by 2.6, the lost rate by 1.55.
_ODDS_OF_USUAL = 9.0
_LEAST = 0.01  # weight below which a member is left out: a term less, for a hundredth of its correction; chosen


@dataclass(frozen=True, eq=False)
class AveragedModel:
    """The average of some models, and these with their weights, which add up to 1, the largest first."""

    extended: Extended
    members: tuple[tuple[float, Extended], ...]

    @property
    def note(self) -> str:
        """A sentence on the members, empty for a single one."""
        if len(self.members) == 1:
            return ""
        shares = ", ".join(f"{100 * weight:.0f} % {_own_names(model, self.members)}" for weight, model in self.members)
        return (
            f"The extended model is the average of models that these recordings cannot tell apart ({shares}); where "
            "they disagree on motions that were not driven it fades to the plain matrix."
        )


def averaged(models: Sequence[tuple[float, Extended]]) -> AveragedModel:
    """The average of models with the probabilities of their names, the one in use first."""
    weights = _weights(models)
    kept = sorted(
        ((float(weight), model) for weight, (_, model) in zip(weights, models, strict=True) if weight >= _LEAST),
        key=lambda member: -member[0],
    )
    total = sum(weight for weight, _ in kept)
    members = tuple((weight / total, model) for weight, model in kept)
    return AveragedModel(members[0][1] if len(members) == 1 else _average(members), members)


def _weights(models: Sequence[tuple[float, Extended]]) -> Array:
    """Weights of models that add up to 1, Eq. (1)."""
    if len(models) == 1:
        return np.ones(1)
    logs = []
    for probability, model in models:
        sizes = np.array([parameter.largest for group in model.groups for parameter in group.parameters])
        residuals = held_out_residuals(model, folds_of_commands(model.fit.runs))
        squares = sum(float(np.square(of_run[-1]).sum()) for of_run in residuals)
        plausible = -np.square(model.values / sizes).sum() / 2
        probability *= _ODDS_OF_USUAL if any(group.name == LOST_RATE[0] for group in model.groups) else 1.0
        logs.append(np.log(max(probability, 1e-300)) + plausible - 1.5 * len(residuals) * np.log(max(squares, 1e-300)))
    weights = np.exp(np.array(logs) - max(logs))
    return weights / weights.sum()


def _average(members: Sequence[tuple[float, Extended]]) -> Extended:
    """The average of members with weights that add up to 1, Eq. (2); groups that several share are in it once."""
    groups: list[Group] = []
    for _, model in members:
        groups += [group for group in model.groups if not any(group is other for other in groups)]
    places = [_places(model, groups) for _, model in members]
    size = members[0][1].fit.model.matrix.size + sum(len(group.parameters) for group in groups)
    vectors = np.zeros((len(members), size))
    for vector, place, (_, model) in zip(vectors, places, members, strict=True):
        vector[place] = np.concatenate([model.fit.model.matrix.ravel(), model.values])
    weights = np.array([weight for weight, _ in members])
    mean = weights @ vectors
    spread = vectors - mean
    covariance = np.einsum("c,ci,cj->ij", weights, spread, spread)
    freedom = np.inf
    for place, (weight, model) in zip(places, members, strict=True):
        covariance[np.ix_(place, place)] += weight * model.covariance.matrix
        freedom = min(freedom, float(np.min(model.covariance.degrees_of_freedom)))
    first = members[0][1].fit
    elements = first.model.matrix.size
    matrix, values = mean[:elements].reshape(first.model.matrix.shape), mean[elements:]
    fit = at_model(first, model_with(first.model, matrix, terms_of(groups, values)))
    columns = columns_of(fit, groups)

    def without_folds(folds: NDArray[np.intp]) -> Array:
        steps = np.zeros((len(folds), size))
        for place, (weight, model) in zip(places, members, strict=True):
            steps[:, place] += weight * model.steps_without(folds)
        return steps

    of_members = EstimatedCovariance(covariance, freedom)
    return Extended(fit, tuple(groups), fit.whitened(columns), columns, values, of_members, without_folds)


def _places(model: Extended, groups: Sequence[Group]) -> list[int]:
    """Where the matrix elements and parameters of a model are among those of some groups."""
    count = model.fit.model.matrix.size
    places, firsts = list(range(count)), []
    for group in groups:
        firsts.append(count)
        count += len(group.parameters)
    for group in model.groups:
        first = next(first for first, other in zip(firsts, groups, strict=True) if other is group)
        places += range(first, first + len(group.parameters))
    return places


def _own_names(model: Extended, members: Sequence[tuple[float, Extended]]) -> str:
    """The names of the effects that not all members have."""
    others = [other for _, other in members if other is not model]
    shared = [group for group in model.groups if all(any(group is each for each in other.groups) for other in others)]
    return " with ".join(group.name for group in model.groups if not any(group is each for each in shared))


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
    candidates = []
    for step in selection.steps:
        ordered = sorted(step.best_shapes, key=lambda index: -step.chi_square[index])
        names = [step.groups[index].name for index in ordered]
        of_step = (
            Candidate(name, float(step.chi_square[index]), int(step.rank[index]), selection.weights.get(name, 0.0))
            for name, index in zip(names, ordered, strict=True)
        )
        candidates.append(tuple(of_step))
    return tuple(candidates)


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
        estimates = [
            EstimatedParameter(each.name, float(value), each.unit, float(value - margin), float(value + margin))
            for each, value, margin in zip(group.parameters, values[rows], reach[rows], strict=True)
        ]
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
                parameters=(*estimates, *shapes),
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
