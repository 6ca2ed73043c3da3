"""The actuator stage: from the wheel rates that the motors were told to those that were measured."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from omnibench.data.dataset import Trajectory
from omnibench.discover.held_out.gaps import confirmation, folds_of
from omnibench.discover.regressors.covariate_bases import Basis
from omnibench.discover.regressors.significance import Gains, gains_of
from omnibench.discover.regressors.whitened import Whitened
from omnibench.discover.selection.candidate_groups import Group, Groups
from omnibench.discover.selection.model_selection import Named, name_effects
from omnibench.registry import effects
from omnibench.robot.effects.effect import ActuatorEffect
from omnibench.robot.kinematics import Array, Robot

_STEP = 0.2  # of the plausible range: by so much a parameter is moved to see what it does
_KNOTS = 7  # of target rates
_ORDERS = 5  # of functions of time
_QUANTISED = 1e-9  # rad/s


@dataclass(frozen=True, eq=False)
class Actuators:
    """What was found between targets and measured wheel rates.

    values, covariance: of the parameters of the effects that were named, in turn.
    """

    named: Named
    places: Gains
    values: Array
    covariance: Array


def look_at_actuators(
    runs: Sequence[Trajectory], robot: Robot, without: Sequence[str], rng: np.random.Generator
) -> Actuators | None:
    """What measured wheel rates differ from their targets by; None where no targets were recorded, or are copies."""
    told = [run for run in runs if run.targets is not None]
    errors = [run.rates - _targets(run) for run in told]
    if not told or max(float(np.abs(each).max()) for each in errors) < _QUANTISED:
        return None
    if max(float(np.abs(run.targets).max()) for run in told if run.targets is not None) < _QUANTISED:
        return None  # a column that was never filled
    groups, columns = _groups(told, robot, without)
    noise = _noise_of(errors)
    residuals = tuple(each.ravel() / noise for each in errors)
    scaled = tuple(each.reshape(-1, each.shape[-1]) / noise for each in columns)
    data = Whitened(
        residuals, scaled, np.sum([each.T @ each for each in scaled], axis=0),
        np.array([each.T @ own for each, own in zip(scaled, residuals, strict=True)]),
    )  # fmt: skip
    folds = folds_of(told)
    named = name_effects(data, groups, confirmation(data, folds), rng)
    places = gains_of(data, (), groups.places, rng)
    values, covariance = _fitted(told, errors, named.chosen)
    return Actuators(named, places, values, covariance)


def _targets(run: Trajectory) -> Array:
    assert run.targets is not None
    return run.targets


def _noise_of(errors: Sequence[Array]) -> float:
    """White noise of the rates, by what neighbours differ, which ramps and offsets do not."""
    steps = np.concatenate([np.diff(each, axis=0).ravel() for each in errors])
    return max(float(np.median(np.abs(steps))) / 0.6745 / np.sqrt(2), float(np.abs(steps).mean()) / 10, _QUANTISED)


def _groups(runs: Sequence[Trajectory], robot: Robot, without: Sequence[str]) -> tuple[Groups, list[Array]]:
    columns: list[list[Array]] = [[] for _ in runs]
    count = 0

    def add(each_run: Sequence[Array]) -> tuple[int, ...]:
        nonlocal count
        for own, new in zip(columns, each_run, strict=True):
            own.append(new)
        count += each_run[0].shape[-1]
        return tuple(range(count - each_run[0].shape[-1], count))

    named, places = [], []
    for effect in _candidates(without):
        parameters = effect.parameters(robot)
        nothing = {each.name: 0.0 for each in parameters}
        steps = {each.name: _STEP * each.largest for each in parameters}
        slopes = [
            np.stack([_driven(effect, run, {**nothing, name: step}) / step for name, step in steps.items()], axis=-1)
            for run in runs
        ]
        named.append(Group("effect", effect.name, add(slopes), effect, parameters))
    for covariate, detail, slopes in _bases(runs):
        basis = Basis(covariate, "actuator", detail, np.zeros((0, 3, 0)))
        places.append(Group("place", covariate, add(slopes), basis=basis))
    matrix = Group("matrix", "matrix", ())
    stacked = [np.concatenate(own, axis=-1) for own in columns]
    return Groups(matrix, tuple(named), tuple(places), np.zeros((0, 3, 0)), ()), stacked


def _candidates(without: Sequence[str]) -> Iterator[ActuatorEffect]:
    for entry in effects.entries():
        if entry.name not in without:
            effect = effects.create(entry.name)
            if isinstance(effect, ActuatorEffect) and effect.in_catalogue:
                yield effect


def _driven(effect: ActuatorEffect, run: Trajectory, values: Mapping[str, float]) -> Array:
    """By how much an effect changes the rates (F, N)."""
    targets = _targets(run)
    return effect.driven(np.diff(run.times, prepend=0.0), targets, values) - targets


def _bases(runs: Sequence[Trajectory]) -> Iterator[tuple[str, str, list[Array]]]:
    top = max(float(np.abs(_targets(run)).max()) for run in runs)
    longest = max(float(run.times[-1]) for run in runs)
    knots = np.linspace(-top, top, _KNOTS)
    spacing = float(knots[1] - knots[0]) or 1.0
    yield (
        "wheel rate",
        "the wheel rate that the motors were told",
        [np.maximum(0.0, 1 - np.abs(_targets(run)[..., None] - knots) / spacing) for run in runs],
    )
    waves = [np.cos(np.pi * np.arange(_ORDERS) * run.times[:, None] / longest) for run in runs]
    yield (
        "elapsed time",
        "the time since the start of a run",
        [np.sign(_targets(run))[..., None] * wave[:, None, :] for run, wave in zip(runs, waves, strict=True)],
    )
    yield (
        "acceleration",
        "how the targets change",
        [np.gradient(_targets(run), axis=0)[..., None] / np.median(np.diff(run.times)) for run in runs],
    )


def _fitted(runs: Sequence[Trajectory], errors: Sequence[Array], chosen: Sequence[Group]) -> tuple[Array, Array]:
    """The parameters of some effects together (n,), whose corrections add up, and their covariance by the scatter."""
    parameters = [each for group in chosen for each in group.parameters]
    if not parameters:
        return np.zeros(0), np.zeros((0, 0))
    scale = np.array([_STEP * each.largest for each in parameters])

    def left(scaled: Array) -> Array:
        values, first, changes = scaled * scale, 0, [np.zeros_like(each) for each in errors]
        for group in chosen:
            own = {each.name: float(value) for each, value in zip(group.parameters, values[first:], strict=False)}
            first += len(group.parameters)
            assert isinstance(group.effect, ActuatorEffect)
            for row, run in enumerate(runs):
                changes[row] = changes[row] + _driven(group.effect, run, own)
        return np.concatenate([(own - change).ravel() for own, change in zip(errors, changes, strict=True)])

    answer = least_squares(left, np.full(len(parameters), 0.1), method="trf", diff_step=1e-3)
    bread = np.linalg.pinv(answer.jac.T @ answer.jac)
    ends = np.cumsum([each.size for each in errors])[:-1]
    scores = np.array(
        [slopes.T @ own for slopes, own in zip(np.split(answer.jac, ends), np.split(answer.fun, ends), strict=True)]
    )
    covariance = bread @ scores.T @ scores @ bread * len(runs) / max(len(runs) - len(parameters), 1)
    return answer.x * scale, covariance * np.outer(scale, scale)
