"""Effects of the motors: what measured wheel rates differ from their targets by.

With f(b) the changes of the rates by all selected effects, e the rates less their targets and J the derivatives of f,
the parameters minimise |e - f(b)|^2. Their covariance is that of the scatter between the Z runs z, with n parameters,

    (J'J)^+ (sum over runs of s_z s_z') (J'J)^+ Z / (Z - n),    s_z = J_z' (e_z - f_z)                             (1)

(MacKinnon and White, "Some heteroskedasticity-consistent covariance matrix estimators", J. Econometrics 29, 1985).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from omnibench.data.dataset import Trajectory
from omnibench.discover.covariates import Basis
from omnibench.discover.held_out import folds_of_repetitions
from omnibench.discover.screening import Groups, Screening, catalogue
from omnibench.discover.significance import ColumnStore, Group
from omnibench.fit.trajectory_fit import Whitened
from omnibench.robot.effects.effect import ActuatorEffect, Parameter
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.physical import EstimatedCovariance

# tests/studies/constants.py varies each number by 0.5 and 2: on a small set with motor lag no verdict and no name
# changes.
_MEDIAN = 0.6745  # standard deviations: the median of the size of a normal number
_LEAST = 0.1  # share of the mean difference of neighbouring samples that the noise is at least: ramps take few samples
_STEP = 0.2  # share of the plausible range: step of a parameter for its slope, wide enough to leave a dead band
_KNOTS = 7  # knots of the functions of target rates
_ORDERS = 5  # orders of the functions of time
_EQUAL = 1e-9  # rad/s: rates nearer to their targets are copies of them
_Slopes = Callable[[Trajectory], Array]  # slopes (F, N, n) of a run's wheel rates


@dataclass(frozen=True, eq=False)
class MotorScreening:
    """Columns of all motor effects against the errors (F, N) of the rates of the runs that have targets."""

    screening: Screening
    runs: tuple[Trajectory, ...]
    errors: tuple[Array, ...]


def screen_motors(runs: Sequence[Trajectory], robot: Robot, without: Sequence[str]) -> MotorScreening | None:
    """Screen the errors of the motors; None where no targets were recorded, or copies of the rates."""
    with_targets = tuple(run for run in runs if run.targets is not None)
    errors = tuple(run.rates - _targets(run) for run in with_targets)
    if not with_targets or max(float(np.abs(of_run).max()) for of_run in errors) < _EQUAL:
        return None
    if max(float(np.abs(_targets(run)).max()) for run in with_targets) < _EQUAL:
        return None  # a column that was never filled
    return MotorScreening(_screen(with_targets, errors, robot, without), with_targets, errors)


def _screen(runs: Sequence[Trajectory], errors: Sequence[Array], robot: Robot, without: Sequence[str]) -> Screening:
    """All motor effects and generic bases as columns against the errors (F, N) of the rates."""
    groups, sources = _groups(runs, robot, without)
    # White noise of the rates, rad/s, from the differences of neighbouring samples: ramps and offsets do not count
    steps = np.concatenate([np.diff(of_run, axis=0).ravel() for of_run in errors])
    noise = max(float(np.median(np.abs(steps))) / _MEDIAN / np.sqrt(2), _LEAST * float(np.abs(steps).mean()), _EQUAL)
    columns = ColumnStore()
    residuals = [of_run.ravel() / noise for of_run in errors]
    scores, information = [], np.zeros(())
    for run, of_run in zip(runs, residuals, strict=True):
        slopes = np.concatenate([source(run) for source in sources], axis=-1).reshape(len(of_run), -1) / noise
        scores.append(slopes.T @ of_run)
        information = information + slopes.T @ slopes
        columns.append(slopes, [len(slopes)])
    data = Whitened(residuals, columns, information, np.array(scores))
    return Screening(groups, data, folds_of_repetitions(runs))


def _targets(run: Trajectory) -> Array:
    assert run.targets is not None
    return run.targets


def _groups(runs: Sequence[Trajectory], robot: Robot, without: Sequence[str]) -> tuple[Groups, list[_Slopes]]:
    """All groups, and the slopes (F, N, n) of a run's rates by each group in turn."""
    named, bases, sources, count = list[Group](), list[Group](), list[_Slopes](), 0

    def add(slopes: _Slopes) -> tuple[int, ...]:
        nonlocal count
        sources.append(slopes)
        width = slopes(runs[0]).shape[-1]
        count += width
        return tuple(range(count - width, count))

    for effect in catalogue(without):
        if not isinstance(effect, ActuatorEffect):
            continue
        parameters = effect.parameters(robot)
        named.append(Group("effect", effect.name, add(_slopes_of(effect, parameters)), effect, parameters))
    for covariate, detail, slopes in _bases(runs):
        basis = Basis(covariate, "actuator", detail)
        bases.append(Group("covariate", covariate, add(slopes), basis=basis))
    return Groups(Group("matrix", "matrix", ()), tuple(named), tuple(bases), ColumnStore(), ()), sources


def _slopes_of(effect: ActuatorEffect, parameters: Sequence[Parameter]) -> _Slopes:
    nothing = {each.name: 0.0 for each in parameters}
    steps = {each.name: _STEP * each.largest for each in parameters}
    return lambda run: np.stack(
        [_change(effect, run, {**nothing, name: step}) / step for name, step in steps.items()], axis=-1
    )


def _change(effect: ActuatorEffect, run: Trajectory, values: Mapping[str, float]) -> Array:
    """Change (F, N) of the rates by an effect, rad/s."""
    targets = _targets(run)
    return effect.driven(np.diff(run.times, prepend=0.0), targets, values) - targets


def _bases(runs: Sequence[Trajectory]) -> Iterator[tuple[str, str, _Slopes]]:
    top = max(float(np.abs(_targets(run)).max()) for run in runs)
    longest = max(float(run.times[-1]) for run in runs)
    knots = np.linspace(-top, top, _KNOTS)
    spacing = float(knots[1] - knots[0]) or 1.0
    yield (
        "wheel rate",
        "the wheel rate that the motors were told",
        lambda run: np.maximum(0.0, 1 - np.abs(_targets(run)[..., None] - knots) / spacing),
    )
    yield (
        "elapsed time",
        "the time since the start of a run",
        lambda run: (
            np.sign(_targets(run))[..., None]
            * np.cos(np.pi * np.arange(_ORDERS) * run.times[:, None] / longest)[:, None, :]
        ),
    )
    yield (
        "acceleration",
        "how the targets change",
        lambda run: np.gradient(_targets(run), axis=0)[..., None] / np.median(np.diff(run.times)),
    )


def fit_motors(motors: MotorScreening, chosen: Sequence[Group]) -> tuple[Array, EstimatedCovariance]:
    """Parameters (n,) of all chosen effects, whose changes add up, and their covariance by the scatter of the runs."""
    runs, errors = motors.runs, motors.errors
    parameters = [each for group in chosen for each in group.parameters]
    if not parameters:
        return np.zeros(0), EstimatedCovariance(np.zeros((0, 0)), 1)
    scale = np.array([_STEP * each.largest for each in parameters])

    def residuals(scaled: Array) -> Array:
        values, first, changes = scaled * scale, 0, [np.zeros_like(of_run) for of_run in errors]
        for group in chosen:
            of_group = {each.name: float(value) for each, value in zip(group.parameters, values[first:], strict=False)}
            first += len(group.parameters)
            assert isinstance(group.effect, ActuatorEffect)
            for row, run in enumerate(runs):
                changes[row] = changes[row] + _change(group.effect, run, of_group)
        return np.concatenate([(error - change).ravel() for error, change in zip(errors, changes, strict=True)])

    start = np.full(len(parameters), 0.1)  # steps: off 0, where a dead band has no slope
    answer = least_squares(residuals, start, method="trf", diff_step=1e-3)
    bread = np.linalg.pinv(answer.jac.T @ answer.jac)
    ends = np.cumsum([of_run.size for of_run in errors])[:-1]
    of_runs = zip(np.split(answer.jac, ends), np.split(answer.fun, ends), strict=True)
    scores = np.array([slopes.T @ remaining for slopes, remaining in of_runs])
    freedom = max(len(runs) - len(parameters), 1)
    covariance = bread @ scores.T @ scores @ bread * len(runs) / freedom  # Eq. (1)
    return answer.x * scale, EstimatedCovariance(covariance * np.outer(scale, scale), freedom)
