"""Slopes of the poses along paths by the parameters of effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from omnibench.discover.regressors.paths import Paths, along_ends, part_of
from omnibench.errors import PluginError
from omnibench.robot.effects.drift import ReferenceTimeOffset
from omnibench.robot.effects.effect import MotionEffect, ReferenceEffect, correction_of
from omnibench.robot.effects.smooth import BentMap, SmoothEffect
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import RunSamples
from omnibench.robot.signals import Signals

# tests/studies/constants.py varies it by 0.5 and 2: on a small set with heading drift no verdict and no name
# changes.
_STEP = 0.1  # share of the plausible range: step of a reference effect's parameter for its slope


def slopes_by(
    paths: Paths, effect: MotionEffect | ReferenceEffect, names: Sequence[str], values: Mapping[str, float]
) -> Array:
    """Slopes (S, 3, J) by J parameters of an effect. values: its shapes, and 0 for all else."""
    if isinstance(effect, SmoothEffect):
        # Slopes (S, 3, 1) by the coefficients of a smooth effect that are asked for; its functions are computed once
        shares, of_functions = effect.shares(paths.signals, values), dict[str, Array]()
        for mode in effect.modes:
            asked = [number for number, label in enumerate(effect.labels) if f"{mode}_{label}" in names]
            if asked:
                of_mode = paths.respond(paths.by_modes[mode], shares[:, asked])
                of_functions |= {f"{mode}_{effect.labels[number]}": of_mode[..., [j]] for j, number in enumerate(asked)}
    elif isinstance(effect, BentMap):
        # Slopes (S, 3, 1) by the coefficients of a bent map, in which the reported pose is linear
        starts = np.array([log.start for log in paths.logs])
        there, first = (effect.functions(poses[:, :2], values) for poses in (paths.poses, starts))
        shifted = there - first[paths.run]
        axes = zip(effect.axes, np.eye(3), strict=True)
        of_functions = {
            f"{axis}_{label}": (shifted[:, [number]] * unit)[..., None]
            for axis, unit in axes
            for number, label in enumerate(effect.labels)
        }
    else:
        of_functions = {}
    return np.concatenate(
        [of_functions[name] if name in of_functions else _by_unit(paths, effect, name, values) for name in names],
        axis=2,
    )


def slopes_by_corrections(paths: Paths, effect: MotionEffect, changes: Sequence[Array]) -> Array:
    """Slopes (S, 3, J) by J corrections (F, n) at the stage of an effect."""
    return paths.summed(np.stack([_changes(paths, effect, change) for change in changes], axis=2))


def correction_along(paths: Paths, effect: MotionEffect, values: Mapping[str, float]) -> Array:
    """Correction of every sample by an effect, (F, n) as its stage has it: of rates, angles, twist or velocity.

    Raises PluginError where it fails, has another shape, or is not finite.
    """
    return np.concatenate(
        [_corrected(effect, part_of(paths.signals, part, session), values) for session, part in paths.sessions]
    )


def slopes_by_delay(paths: Paths) -> Array:
    """Slopes (S, 3, 1) by a delay of the reference, s."""
    return _by_unit(paths, ReferenceTimeOffset(), "tau", {"tau": 0.0})


def _by_unit(paths: Paths, effect: MotionEffect | ReferenceEffect, name: str, values: Mapping[str, float]) -> Array:
    """Slopes (S, 3, 1) by one parameter: by its correction at 1, or between two poses that the reference reports."""
    if isinstance(effect, MotionEffect):
        return slopes_by_corrections(paths, effect, [correction_along(paths, effect, {**values, name: 1.0})])
    step = _STEP * next(each.largest for each in effect.parameters(paths.robot) if each.name == name)
    after, before = (_reported(paths, effect, {**values, name: sign * step}) for sign in (1, -1))
    return ((after - before) / (2 * step))[..., None]


def _changes(paths: Paths, effect: MotionEffect, change: Array) -> Array:
    """Changes (F, 3) of (z, theta) in each sample by a correction (F, n) at the stage of an effect."""
    if effect.stage == "body":
        return paths.changes(paths.tracked(change))
    if effect.stage == "world":
        return paths.in_world(change)
    return paths.changes(paths.by_angles(change) if effect.stage == "steering" else paths.by_rates(change))


def _reported(paths: Paths, effect: ReferenceEffect, values: Mapping[str, float]) -> Array:
    """Poses (S, 3) that the reference would report with an effect."""
    delays = [effect.delays(log.stamps, values) for log in paths.logs]
    samples, ends = RunSamples.of([log.times for log in paths.logs]), np.concatenate(paths.ends)
    of_position, of_heading = (
        along_ends(samples, ends, [log.stamps - delay for log, delay in zip(paths.logs, of_runs, strict=True)])
        for of_runs in zip(*delays, strict=True)
    )
    taken = np.column_stack([of_position[:, :2], of_heading[:, 2]])
    runs = zip(paths.logs, paths.parts, strict=True)
    return np.concatenate([effect.reported(taken[part], log.start, values) for log, part in runs])


def _corrected(effect: MotionEffect, signals: Signals, values: Mapping[str, float]) -> Array:
    steered = len(signals.robot.drive.steered)
    width = {"body": 3, "world": 2, "steering": steered}.get(effect.stage, signals.rates.shape[1])
    way_out = f"try omnibench plugin check, or leave it out: --without {effect.name}"
    try:
        correction = np.asarray(correction_of(effect, signals, values), dtype=float)
    except Exception as error:  # a plug-in may raise anything
        said = f"{type(error).__name__}: {error}"
        raise PluginError(f"effect {effect.name!r}: its correction ended in {said}; {way_out}") from error
    if correction.shape != (len(signals.rates), width) or not np.isfinite(correction).all():
        expected = f"{(len(signals.rates), width)} finite values"
        raise PluginError(f"effect {effect.name!r}: its correction is not {expected} but {correction.shape}; {way_out}")
    return correction
