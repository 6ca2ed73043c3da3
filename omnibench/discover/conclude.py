"""From fits and gains to what is told: effects with intervals, places, steps, gaps."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy import stats

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.discover.calibrations import Request, calibration_of
from omnibench.discover.experiments import experiments_for
from omnibench.discover.fitting.extend import Extended, extend
from omnibench.discover.fitting.model_fit import Fit, at_model, at_runs
from omnibench.discover.fitting.usable_runs import in_start_frames, usable_runs, without_jumps
from omnibench.discover.held_out.gaps import compared, errors_of_repetitions, errors_on, floor_of
from omnibench.discover.regressors.significance import Gains
from omnibench.discover.result import (
    Candidate,
    Discovery,
    EstimatedParameter,
    HeldOut,
    NamedEffect,
    Place,
    Step,
)
from omnibench.discover.selection.candidate_groups import Group
from omnibench.discover.selection.competing_models import Rivals
from omnibench.discover.selection.detectability import absorbed_effects, classes_of, hidden_sizes, sums_of
from omnibench.discover.selection.extrapolation import novelties_of
from omnibench.discover.selection.model_selection import Named
from omnibench.discover.selection.motor_effects import Actuators
from omnibench.discover.selection.screening import Look
from omnibench.discover.selection.unknown_term import close_without_name, step_name, steps_of
from omnibench.discover.verdict import headline_of, verdict_of
from omnibench.fit.least_squares.noise import Whitener
from omnibench.report.numbers import plural
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel

_FEW_RUNS, _FEW_COMMANDS = 10, 4
_WORSE = 1.05  # times the plain matrix's error: more than chance makes of it
_SHOWN = 0.01  # chance up to which a place is mentioned


def told(
    dataset: Dataset,
    plain: Fit,
    look: Look,
    rivals: Rivals,
    motors: Actuators | None,
    request: Request,
    began: float,
) -> Discovery:
    """All that is said of a discovery."""
    effects, sure = _named_effects(rivals, motors)
    fitted = [*look.groups.matrix.index, *(index for group in look.named.chosen for index in group.index)]
    where = places_of(look.places, ticks=partial(look.rounding.gain, beyond=look.groups.matrix.index))
    left = places_of(look.named.left, left=True, ticks=partial(look.rounding.gain, beyond=fitted))
    if motors is not None:
        where, left = where + places_of(motors.places), left + places_of(motors.named.left, left=True)
    where = tuple(sorted(where, key=lambda place: (place.p_value, -place.excess)))
    verdict = verdict_of(effects, sure, left, where)
    notes: tuple[str, ...] = ()
    if request.unknown_term and verdict in ("unknown", "incomplete"):
        closed = close_without_name(plain, look, rivals)
        rivals, notes = closed.rivals, (closed.note,)
        effects, _ = _named_effects(rivals, motors)  # fitted anew, with the term
    extended, fit = rivals.used, rivals.used.fit
    bare = extend(at_model(fit, plain.model), ()) if extended.groups else extended
    validation, doubts = _validation(dataset, fit)
    held_out = _held_out(extended, bare, validation)
    steps = _steps(plain, bare, extended, validation.kept)
    headline = " ".join([headline_of(verdict, effects, where, left), *_worse(held_out)])
    of_session = any("session" in term.effect.needs for term in fit.model.terms)
    before, after = bare.fit.residuals, fit.residuals
    return Discovery(
        dataset=replace(dataset, trajectories=(*fit.runs, *validation.kept)),
        dataset_hash=dataset.hash,
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
        gap=held_out[0 if of_session else -1].eq6,
        held_out=held_out,
        steps=steps,
        novelties=novelties_of(validation.kept, bare, rivals.models) if validation.kept else (),
        experiments=experiments_for(dataset, effects, fit),
        notes=_notes(look, fit) + notes + doubts,
        noise=fit.noise,
        outliers=fit.jumps,
        poses=sum(len(own) for own in fit.residuals),
        plain=calibration_of(dataset, bare, "plain", request, headline),
        extended=calibration_of(dataset, extended, "extended", request, headline),
        trajectories=tuple(run.id for run in fit.runs),
        before=before,
        after=after,
        whitened_before=_white(fit, before),
        whitened_after=_white(fit, after),
        seconds=time.monotonic() - began,
    )


def places_of(
    gains: Gains, *, left: bool = False, ticks: Callable[[Sequence[int]], float] | None = None
) -> tuple[Place, ...]:
    """The places that are no chance, the surest first; of each covariate one.

    left: after effects were added. ticks: how much rounding to encoder ticks could make columns gain.
    """
    best: dict[str, int] = {}
    for index in np.argsort(-gains.evidence, kind="stable"):
        best.setdefault(gains.groups[index].name, int(index))
    found = []
    for index in sorted(best.values(), key=lambda each: -gains.evidence[each]):
        group, p_value = gains.groups[index], gains.p_value(index)
        assert group.basis is not None
        if p_value < _SHOWN:
            words = f"the residual {'still ' if left else ''}depends on {group.basis.detail}"
            excess, rank = float(gains.excess[index]), int(gains.rank[index])
            small = ticks is not None and excess <= ticks(group.index)
            words += ", by no more than rounding to encoder ticks can make it" if small else ""
            found.append(Place(group.name, group.basis.stage, p_value, excess, rank, words, small))
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


@dataclass(frozen=True, eq=False)
class _HeldOutRuns:
    """Runs of the validation split: all, and the same without poses that jump."""

    runs: tuple[Trajectory, ...]
    kept: tuple[Trajectory, ...]


def _validation(dataset: Dataset, fit: Fit) -> tuple[_HeldOutRuns, tuple[str, ...]]:
    """The runs that the model can predict, and what is to be said of them."""
    found = [run for run in dataset.split("validation") if len(run.pose_times) > 1]
    able = [run for run in found if not _lacking(fit.model, run)]
    doubts = list(_beyond_training(fit, able))
    if len(able) < len(found):
        doubts.append(f"{len(found) - len(able)} validation runs lack what an effect of the model needs: left out.")
    if not able:
        return _HeldOutRuns((), ()), tuple(doubts)
    runs = usable_runs(able)
    kept, jumps = without_jumps(runs, in_start_frames(runs, at_runs(fit, runs).residuals), fit.noise.noise)
    if jumps:
        doubts.append(f"{jumps} validation poses contradict their neighbours; chi2 is without them.")
    return _HeldOutRuns(runs, kept), tuple(doubts)


def _lacking(model: OdometryModel, run: Trajectory) -> bool:
    needs = {need for term in model.terms for need in term.effect.needs}
    missing = {
        "wheel_angles": run.angles is None,
        "session_time": run.started_at is None,
        "session": run.session is None,
    }
    return any(missing.get(need, False) for need in needs)


def _beyond_training(fit: Fit, runs: Sequence[Trajectory]) -> Iterator[str]:
    """Sessions, and times in a session, of which the training runs say nothing."""
    needs = {need: term.name for term in fit.model.terms for need in term.effect.needs}
    known = {run.session for run in fit.runs}
    if "session" in needs and (new := sorted({str(run.session) for run in runs} - {str(each) for each in known})):
        yield f"{needs['session']} says nothing of sessions that were not trained on: {', '.join(new[:3])}."
    latest = max((run.started_at or 0.0 for run in fit.runs), default=0.0)
    late = [run.id for run in runs if (run.started_at or 0.0) > 1.1 * latest + 60]
    if "session_time" in needs and late:
        yield (
            f"{needs['session_time']} was fitted to the first {latest:.0f} s of a session; {len(late)} validation runs "
            "are later, where it is not known to hold."
        )


def _worse(held_out: Sequence[HeldOut]) -> Iterator[str]:
    """A warning where the extended model predicts worse than the plain matrix."""
    for each in held_out:
        where = "the held-out session" if each.data == "session" else "repetitions that were held out"
        sizes: list[tuple[str, float, float, str]] = [
            ("in the cost of Eq. (6)", each.eq6.before, each.eq6.after, ""),
            ("in position", 1e3 * each.position_m[0], 1e3 * each.position_m[1], " mm"),
            ("in heading", math.degrees(each.heading_rad[0]), math.degrees(each.heading_rad[1]), " deg"),
        ]
        worse = [
            f"{name} ({after:.3g}{unit}, {before:.3g}{unit} before)"
            for name, before, after, unit in sizes
            if after > _WORSE * before
        ]
        if worse:
            yield f"Beware: on {where} the extended model is worse than the plain matrix {' and '.join(worse)}."


def _held_out(extended: Extended, bare: Extended, validation: _HeldOutRuns) -> tuple[HeldOut, ...]:
    floor = floor_of(extended.fit)
    found = [compared("repetitions", errors_of_repetitions(bare), errors_of_repetitions(extended), floor)]
    if validation.kept:
        before, after = (errors_on(each, validation.runs, validation.kept) for each in (bare, extended))
        own = floor_of(at_runs(extended.fit, validation.kept))
        found.append(compared("session", before, after, own or floor))
    return tuple(found)


def _steps(plain: Fit, bare: Extended, extended: Extended, validation: Sequence[Trajectory]) -> tuple[Step, ...]:
    fits = [("plain matrix", bare)]
    for count in steps_of(extended.groups):
        partial = extended if count == len(extended.groups) else extend(plain, extended.groups[:count])
        fits.append((f"+ {step_name(extended.groups[count - 1])}", partial))
    return tuple(_step(name, each.fit, extended.fit.noise.noise, validation) for name, each in fits)


def _step(name: str, fit: Fit, noise: Noise, validation: Sequence[Trajectory]) -> Step:
    held = at_runs(fit, validation).residuals if validation else ()
    return Step(
        name,
        _chi2(noise, fit.runs, fit.residuals),
        _chi2(noise, validation, held) if held else None,
        _eq6(fit.nuisance_free_residuals),
        _eq6(held) if held else None,
    )


def _chi2(noise: Noise, runs: Sequence[Trajectory], residuals: Sequence[Array]) -> float:
    white = [Whitener(noise, run.pose_times[1:])(own) for run, own in zip(runs, residuals, strict=True)]
    return float(sum(np.square(each).sum() for each in white) / sum(each.size for each in white))


def _eq6(residuals: Sequence[Array]) -> float:
    return float(np.mean([np.linalg.norm(own[-1]) for own in residuals]))


def _white(fit: Fit, residuals: Sequence[Array]) -> tuple[Array, ...]:
    return tuple(
        Whitener(fit.noise.noise, run.pose_times[1:])(own) for run, own in zip(fit.runs, residuals, strict=True)
    )


def _notes(look: Look, fit: Fit) -> tuple[str, ...]:
    notes = []
    commands = len({run.command for run in fit.runs if run.command is not None})
    if len(fit.runs) < _FEW_RUNS or 0 < commands < _FEW_COMMANDS:
        few = f"{plural(len(fit.runs), 'run')}" + (f" of {plural(commands, 'command')}" if commands else "")
        notes.append(f"These are {few}: so little can show hardly anything, and that nothing was found says little.")
    notes.append(f"Noise: {fit.noise.description}.")
    if fit.noise.source != "repetitions":
        notes.append("Without repetitions of a command nothing says how small the errors could be: no gap is closed.")
    if fit.jumps:
        poses = (
            "pose that contradicts its neighbours was"
            if fit.jumps == 1
            else "poses that contradict their neighbours were"
        )
        notes.append(f"{fit.jumps} reference {poses} left out.")
    if look.rounding.ticks.any():
        notes.append(
            f"The wheels were read in ticks of {np.degrees(look.rounding.ticks.max()):.2g} deg; what is left by "
            "no more than rounding to them can make counts as nothing missing."
        )
    heading, offset, slope = fit.nuisances.deviations
    for size, words in (
        (heading, f"start headings scatter from run to run by {np.degrees(heading):.2g} deg"),
        (offset, f"offsets of the reference's clock scatter from run to run by {1e3 * offset:.2g} ms"),
        (slope, f"the reference's clock gains or loses {60e3 * slope:.0f} ms a minute, differently from run to run"),
    ):
        if size:
            notes.append(f"{words[0].upper()}{words[1:]}; estimated for each run.")
    notes += [f"{name} could be imitated by {' and '.join(others)} together." for name, others in sums_of(look)]
    return tuple(notes)
