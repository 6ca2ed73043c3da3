"""From fits and gains to what is told: effects with intervals, places, steps, gaps."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.discover.actuators import Actuators
from omnibench.discover.calibrations import calibration_of
from omnibench.discover.experiments import experiments_for
from omnibench.discover.extend import Extended, extend
from omnibench.discover.groups import Group
from omnibench.discover.held_out import compare_residuals, folds_of, held_out_residuals
from omnibench.discover.identify import absorbed_effects, classes_of, hidden_sizes, sums_of
from omnibench.discover.look import Look
from omnibench.discover.model_fit import Fit, at_model
from omnibench.discover.naming import Named
from omnibench.discover.novelty import novelties_of
from omnibench.discover.recording import usable_runs, without_jumps
from omnibench.discover.result import (
    Candidate,
    Discovery,
    EstimatedParameter,
    HeldOut,
    NamedEffect,
    Place,
    Step,
)
from omnibench.discover.rivals import Rivals
from omnibench.discover.significance import Gains
from omnibench.discover.verdict import headline_of, verdict_of
from omnibench.fit.noise import Whitener
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel

_SHOWN = 0.01  # chance up to which a place is mentioned


def told(
    dataset: Dataset, plain: Fit, look: Look, rivals: Rivals, motors: Actuators | None, seed: int,
    unknown_term: bool, began: float,
) -> Discovery:  # fmt: skip
    """All that is said of a discovery."""
    extended, fit = rivals.used, rivals.used.fit
    bare = extend(at_model(fit, plain.model), ())
    effects, sure = _named_effects(rivals, motors)
    where, left = places_of(look.places, "before"), places_of(look.named.left, "left")
    if motors is not None:
        where = where + places_of(motors.places, "before")
    where = tuple(sorted(where, key=lambda place: (place.p_value, -place.excess)))
    verdict = verdict_of(effects, sure, left, where)
    validation = _validation(dataset, fit)
    held_out = _held_out(extended, bare, validation)
    steps = _steps(plain, bare, extended, validation)
    options = {"without": [], "unknown_term": unknown_term}
    headline = headline_of(verdict, effects, where, left)
    before, after = bare.fit.residuals, fit.residuals
    return Discovery(
        dataset=replace(dataset, trajectories=(*fit.runs, *validation)),
        verdict=verdict,
        headline=headline,
        effects=effects,
        candidates=tuple(_candidates(each, look.named) for each in look.named.steps),
        where=where,
        left=left,
        absorbed=absorbed_effects(look),
        not_looked_for=look.groups.not_looked_for,
        classes=classes_of(look),
        hidden=hidden_sizes(look, rivals.named),
        gap=held_out[-1].eq6,
        held_out=held_out,
        steps=steps,
        novelties=novelties_of(validation, bare, rivals.models) if validation else (),
        experiments=experiments_for(dataset, effects, classes_of(look), fit),
        notes=_notes(look, fit),
        noise=fit.noise,
        outliers=fit.jumps,
        poses=sum(len(own) for own in fit.residuals),
        plain=calibration_of(dataset, bare, "plain", options, seed, _costs(steps[0]), headline),
        extended=calibration_of(dataset, extended, "extended", options, seed, _costs(steps[-1]), headline),
        trajectories=tuple(run.id for run in fit.runs),
        before=before,
        after=after,
        whitened_before=_white(fit, before),
        whitened_after=_white(fit, after),
        seconds=time.monotonic() - began,
    )


def places_of(gains: Gains, when: str) -> tuple[Place, ...]:
    """The places that are no chance, the surest first; of each covariate one."""
    best: dict[tuple[str, str], int] = {}
    for index in np.argsort(-gains.evidence, kind="stable"):
        best.setdefault((gains.groups[index].name, "covariate"), int(index))
    found = []
    for index in sorted(best.values(), key=lambda each: -gains.evidence[each]):
        group, p_value = gains.groups[index], gains.p_value(index)
        assert group.basis is not None
        if p_value < _SHOWN:
            share = float(gains.excess[index])
            words = f"what is {when} depends on {group.basis.detail}" if when == "left" else (
                f"the residual depends on {group.basis.detail}"
            )  # fmt: skip
            found.append(Place(group.name, group.basis.stage, p_value, share, int(gains.rank[index]), words))
    return tuple(found)


def _named_effects(rivals: Rivals, motors: Actuators | None) -> tuple[tuple[NamedEffect, ...], tuple[float, ...]]:
    extended, model, runs = rivals.used, rivals.used.fit.model, len(rivals.used.fit.runs)
    effects, sure = _of_names(rivals.named, model.robot, extended.values, extended.covariance, model.matrix.size, runs)
    effects = tuple(
        replace(effect, in_doubt="; ".join(filter(None, (effect.in_doubt, reason)))) if effect.confusable_with
        else effect
        for effect, reason in zip(effects, rivals.preferred, strict=True)
    )  # fmt: skip
    if motors is None or not motors.named.chosen:
        return effects, sure
    more, of_more = _of_names(motors.named, model.robot, motors.values, motors.covariance, 0, runs)
    return effects + more, sure + of_more


def _of_names(
    named: Named, robot: Robot, values: Array, covariance: Array, first: int, runs: int
) -> tuple[tuple[NamedEffect, ...], tuple[float, ...]]:
    """Effects with their intervals, and how sure their classes are; first: where the covariance of effects begins."""
    deviations = np.sqrt(np.diag(covariance))[first:]
    quantile = float(stats.t.ppf(0.975, max(runs - len(deviations) - first, 1)))
    gains = {group.name: (gain, rank) for step in named.steps[::-1] for group, gain, rank in
             zip(step.groups, step.gain, step.rank, strict=True) if group in named.chosen}  # fmt: skip
    effects, sure, at = [], [], 0
    for group, confusable in zip(named.chosen, named.confusable, strict=True):
        assert group.effect is not None
        estimates = [
            EstimatedParameter(
                each.name,
                float(values[at + row]),
                each.unit,
                float(values[at + row] - quantile * deviations[at + row]),
                float(values[at + row] + quantile * deviations[at + row]),
            )
            for row, each in enumerate(group.parameters)
        ]
        estimates += _shapes(group, robot)
        at += len(group.parameters)
        weight = named.weights.get(group.name, 0.0)
        gain, rank = gains.get(group.name, (0.0, 0.0))
        doubt = "" if named.known > 0.95 else (
            f"generic bases still find {named.left_share:.0%} of what was there, which a right name seldom leaves"
        )  # fmt: skip
        effects.append(
            NamedEffect(group.name, group.effect.stage, weight, tuple(estimates), confusable, group.effect.physics,
                        group.effect.source, float(gain), int(rank), doubt)
        )  # fmt: skip
        sure.append(weight + sum(named.weights.get(name, 0.0) for name in confusable))
    return tuple(effects), tuple(sure)


def _shapes(group: Group, robot: Robot) -> list[EstimatedParameter]:
    assert group.effect is not None
    chosen = [(each, group.shapes[each.name]) for each in group.effect.parameters(robot) if each.name in group.shapes]
    return [EstimatedParameter(each.name, value, each.unit, value, value, shape=True) for each, value in chosen]


def _candidates(step: Gains, named: Named) -> tuple[Candidate, ...]:
    best: dict[str, Candidate] = {}
    for group, gain, rank in zip(step.groups, step.gain, step.rank, strict=True):
        if rank and (group.name not in best or gain > best[group.name].gain):
            best[group.name] = Candidate(group.name, float(gain), int(rank), named.weights.get(group.name, 0.0))
    return tuple(sorted(best.values(), key=lambda each: -each.gain))


def _validation(dataset: Dataset, fit: Fit) -> tuple[Trajectory, ...]:
    """The validation runs without poses that jump."""
    found = dataset.split("validation")
    if not any(len(run.pose_times) > 1 for run in found):
        return ()
    runs = usable_runs(found)
    kept, _ = without_jumps(runs, _residuals(fit.model, runs), fit.noise.noise)
    return kept


def _residuals(model: OdometryModel, runs: Sequence[Trajectory]) -> list[Array]:
    """Reference minus model (K, 3) of each run."""
    poses = model.reported([run.reference_log for run in runs])
    return [run.poses[1:] - own for run, own in zip(runs, poses, strict=True)]


def _held_out(extended: Extended, bare: Extended, validation: Sequence[Trajectory]) -> tuple[HeldOut, ...]:
    runs, noise = extended.fit.runs, extended.fit.noise.noise
    folds = folds_of(runs)
    before, after = (held_out_residuals(own, folds) for own in (bare, extended))
    found = [compare_residuals("repetitions", runs, before, after, noise)]
    if validation:
        before, after = (_residuals(own.fit.model, validation) for own in (bare, extended))
        found.append(compare_residuals("session", validation, before, after, noise))
    return tuple(found)


def _steps(plain: Fit, bare: Extended, extended: Extended, validation: Sequence[Trajectory]) -> tuple[Step, ...]:
    fits = [("plain matrix", bare)]
    for count in range(1, len(extended.groups) + 1):
        partial = extended if count == len(extended.groups) else extend(plain, extended.groups[:count])
        fits.append((f"+ {extended.groups[count - 1].name}", partial))
    return tuple(_step(name, each.fit, extended.fit.noise.noise, validation) for name, each in fits)


def _step(name: str, fit: Fit, noise: Noise, validation: Sequence[Trajectory]) -> Step:
    held = _residuals(fit.model, validation) if validation else []
    return Step(
        name,
        _chi2(noise, fit.runs, fit.residuals),
        _chi2(noise, validation, held) if held else None,
        _eq6(fit.residuals),
        _eq6(held) if held else None,
    )


def _chi2(noise: Noise, runs: Sequence[Trajectory], residuals: Sequence[Array]) -> float:
    white = [Whitener(noise, run.pose_times[1:])(own) for run, own in zip(runs, residuals, strict=True)]
    return float(sum(np.square(each).sum() for each in white) / sum(each.size for each in white))


def _eq6(residuals: Sequence[Array]) -> float:
    return float(np.mean([np.linalg.norm(own[-1]) for own in residuals]))


def _costs(step: Step) -> tuple[float, float | None]:
    return step.eq6_train, step.eq6_held_out


def _white(fit: Fit, residuals: Sequence[Array]) -> tuple[Array, ...]:
    return tuple(
        Whitener(fit.noise.noise, run.pose_times[1:])(own) for run, own in zip(fit.runs, residuals, strict=True)
    )


def _notes(look: Look, fit: Fit) -> tuple[str, ...]:
    notes = [f"Noise: {fit.noise.description}."]
    if fit.jumps:
        poses = "pose that contradicts its" if fit.jumps == 1 else "poses that contradict their"
        notes.append(f"{fit.jumps} reference {poses} neighbours left out.")
    heading, offset, slope = fit.nuisances.deviations
    for size, words in (
        (heading, f"start headings scatter from run to run by {np.degrees(heading):.2g} deg"),
        (offset, f"offsets of the reference's clock scatter from run to run by {1e3 * offset:.2g} ms"),
        (slope, f"the reference's clock gains or loses {60e3 * slope:.2g} ms a minute, differently from run to run"),
    ):
        if size:
            notes.append(f"{words[0].upper()}{words[1:]}; estimated for each run.")
    notes += [f"{name} could be imitated by {' and '.join(others)} together." for name, others in sums_of(look)]
    return tuple(notes)
