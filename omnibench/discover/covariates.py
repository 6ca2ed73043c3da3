"""Generic bases: columns by which the residuals may depend on a covariate, with no physics in them.

A basis is a set of small changes of the motion, or of the reported pose, that vary with one covariate. The functions
are those of the smooth effects (omnibench.robot.effects.smooth) by which such a dependence can be added to a model;
only for commands, sessions and wheels that differ there is more to try than a model can use.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise, product

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.discover.paths import Paths, slopes_by, slopes_by_delay
from omnibench.robot.effects import smooth
from omnibench.robot.effects.effect import MotionEffect, ReferenceEffect, Stage
from omnibench.robot.kinematics import Array

# tests/studies/constants.py varies each number by 0.5 and 2: on a small set with heading drift no verdict and no
# name changes.
_ORDERS = 6  # smooth functions of time
_FREQUENCIES = 32  # frequencies at which errors of a clock are tried: about as many as 80 stamps a run tell apart
_GRID = 5  # patches along each side of the area
_WIDE = 0.7  # radius of a patch, of the distance between two: half the diagonal of a cell, so that no place is left out
_SEEN = 0.002  # share of the samples that must lie in a patch
_NARROW = 0.02  # share of the largest motion: least width of a bump about one motion
_TOP = 0.999  # quantile of the wheel rates up to which functions of them reach
_SMALL = 1e-9  # range below which a covariate does not vary


Columns = Callable[[Paths], Array]  # the columns (S, 3, n) along some paths


@dataclass(frozen=True, eq=False)
class Basis:
    """Columns: slopes of the poses by n generic changes that vary with a covariate.

    detail: words that complete "the residual depends on ...", and tell several bases of a covariate apart. columns:
    None where they are not computed along paths. tries: bases of this kind, of which the best is taken. term: the
    smooth effect that adds these changes to a model, or nothing. shapes: the values that shape it. parts: shapes of the
    term's functions, by default the basis's own.
    """

    covariate: str
    stage: Stage
    detail: str
    columns: Columns | None = None
    tries: int = 1
    term: str = ""
    shapes: Mapping[str, float] = field(default_factory=dict)
    parts: tuple[Mapping[str, float], ...] | None = None


def generic_bases(paths: Paths, trajectories: Sequence[Trajectory]) -> Iterator[Basis]:
    """All bases that these recordings allow: of each covariate that varies and was recorded."""
    yield from _elapsed(paths)
    yield from _heading()
    yield from _place(paths)
    yield from _order(paths, trajectories)
    yield from _wheel_rate(paths)
    yield from _wheel_angle(paths)
    yield from _acceleration(paths)
    yield from _stamps(paths)
    yield from _command(paths, trajectories)


def _of_effect(
    effect: MotionEffect | ReferenceEffect,
    detail: str,
    columns: Columns,
    shapes: Mapping[str, float] | None = None,
    *,
    stage: Stage | None = None,
    tries: int = 1,
) -> Basis:
    """The basis of a smooth effect's columns. stage: where they count as acting, by default where the effect acts."""
    return Basis(effect.shows_in, stage or effect.stage, detail, columns, tries, effect.name, shapes or {})


def _in_modes(along: Paths, modes: Sequence[str], shares: Array) -> Array:
    """Slopes (S, 3, m J) by changes of the twist in m of the modes in which smooth effects act, times shares (F, J)."""
    return np.concatenate([along.respond(along.by_modes[mode], shares) for mode in modes], axis=2)


def _smooth(
    effect: smooth.SmoothEffect, shapes: Mapping[str, float] | None = None, functions: int | None = None
) -> Columns:
    """Slopes by a smooth effect, of its first so many functions, or of all, in each of its modes."""
    return lambda along: _in_modes(along, effect.modes, effect.shares(along.signals, shapes or {})[:, :functions])


def _elapsed(paths: Paths) -> Iterator[Basis]:
    effect, shapes = smooth.smooth_elapsed_time(), {"duration": max(float(paths.signals.elapsed.max()), _SMALL)}
    yield _of_effect(effect, "the time since the start of a run", _smooth(effect, shapes, _ORDERS), shapes)


def _heading() -> Iterator[Basis]:
    heading, course = smooth.smooth_heading(), smooth.SmoothCourse()
    yield _of_effect(heading, "the robot's heading", _smooth(heading))

    def steady_and_course(along: Paths) -> Array:
        speed = np.hypot(along.signals.twists[:, 0], along.signals.twists[:, 1])
        steady = [along.summed(along.in_world(speed[:, None] * axis)[:, :, None]) for axis in np.eye(2)]
        return np.concatenate([*steady, _smooth(course)(along)], axis=2)

    yield _of_effect(course, "the direction of travel in the world", steady_and_course, stage="world")


def _place(paths: Paths) -> Iterator[Basis]:
    places = paths.middle[:, :2]
    area = area_of(places)
    if area["reach"] < _SMALL:
        return
    floor, bent, patch = smooth.smooth_place(), smooth.SmoothMap(), smooth.smooth_patch()
    yield _of_effect(floor, "where on the floor the robot is", _smooth(floor, area), area)

    bent_map = _by_parameters(bent, paths, area)
    yield _of_effect(bent, "where on the map the reference is read", bent_map, area)
    patches = list(patches_on_grid(places, _GRID))

    def of_patches(along: Paths) -> Array:
        shares = np.concatenate([patch.shares(along.signals, shapes) for shapes in patches], axis=1)
        return np.stack([along.respond(along.by_modes[mode], shares) for mode in patch.modes], axis=3)

    for number, shapes in enumerate(patches):
        columns = partial(_part_of, of_patches, number)
        yield _of_effect(patch, "a patch of the floor", columns, shapes, tries=len(patches))


def area_of(places: Array) -> dict[str, float]:
    """The circle that holds positions (F, 2): the values that shape functions of the place on the floor."""
    centre = places.mean(axis=0)
    reach = float(np.linalg.norm(places - centre, axis=1).max())
    return {"centre_x": float(centre[0]), "centre_y": float(centre[1]), "reach": reach}


def _part_of(columns: Columns, number: int, along: Paths) -> Array:
    """The columns (S, 3, n) with this number of columns (S, 3, B, n) of several bases."""
    part: Array = along.once(columns)[:, :, number]
    return part


def patches_on_grid(places: Array, along: int) -> Iterator[dict[str, float]]:
    """Centres and radius of patches on a grid over positions (F, 2), those in which there are positions.

    along: number of patches along each side.
    """
    low = places.min(axis=0)
    spacing = (places.max(axis=0) - low) / (along - 1)
    radius = _WIDE * max(float(spacing.max()), _SMALL)
    for steps in product(range(along), repeat=2):
        x, y = (low + spacing * steps).tolist()
        patch = {"centre_x": x, "centre_y": y, "radius": radius}
        if (smooth.bump(places, patch) > np.exp(-1)).mean() > _SEEN:
            yield patch


def _order(paths: Paths, trajectories: Sequence[Trajectory]) -> Iterator[Basis]:
    time = paths.signals.session_time
    if time is not None and len(paths.logs) > 3:  # any three times lie on a parabola
        effect, shapes = smooth.smooth_order_of_runs(), {"duration": max(float(time.max()), _SMALL)}
        columns = _smooth(effect, shapes, _ORDERS)
        yield _of_effect(effect, "the time since the start of the session", columns, shapes, stage="wheel")
    sessions = list(dict.fromkeys(run.session for run in trajectories))
    if len(sessions) > 1:
        belongs = np.array([[run.session == name for name in sessions[1:]] for run in trajectories], dtype=float)
        yield Basis(
            "order of runs",
            "wheel",
            "the session",
            lambda along: _in_modes(along, ("along", "rotation"), belongs[along.first + along.owner]),
        )


def _wheel_rate(paths: Paths) -> Iterator[Basis]:
    rates = paths.signals.rates
    top = float(np.quantile(np.abs(rates), _TOP))
    if top < _SMALL:
        return
    effect, shapes = smooth.SmoothWheelRate(), {"top": top}

    def of_wheels(along: Paths) -> list[Array]:
        changes = smooth.hat_functions(along.signals.rates, top)
        return [along.of_wheel(wheel, changes[:, wheel]) for wheel in range(changes.shape[1])]

    yield _of_effect(effect, "how fast the wheels turn", lambda along: np.sum(of_wheels(along), axis=0), shapes)
    yield _of_effect(
        effect, "how fast each wheel turns", lambda along: np.concatenate(of_wheels(along), axis=2), shapes
    )


def _wheel_angle(paths: Paths) -> Iterator[Basis]:
    if paths.signals.wheel_angles is None:
        return
    effect = smooth.SmoothWheelAngle()

    def of_waves(along: Paths) -> Array:
        columns = []
        for wheel in range(along.signals.rates.shape[1]):
            waves = [smooth.mean_waves(along.signals, wheel, harmonic) for harmonic in smooth.HARMONICS]
            slopes = along.of_wheel(wheel, np.concatenate(waves, axis=1))
            columns.append(slopes.reshape(*slopes.shape[:2], len(smooth.HARMONICS), -1))
        return np.concatenate(columns, axis=3)

    for number, harmonic in enumerate(smooth.HARMONICS):
        words = f"the angle of the wheels, {harmonic:g} times a turn"
        columns = partial(_part_of, of_waves, number)
        yield _of_effect(effect, words, columns, {"harmonic": harmonic}, tries=len(smooth.HARMONICS))


def _acceleration(paths: Paths) -> Iterator[Basis]:
    forward, left, angular = paths.signals.accelerations.T
    top, turning = float(np.hypot(forward, left).max()), float(np.abs(angular).max())
    if max(top, turning) < _SMALL:
        return
    effect, shapes = smooth.SmoothAcceleration(), {"top": max(top, _SMALL), "top_turning": max(turning, _SMALL)}
    yield _of_effect(effect, "how the robot accelerates", _by_parameters(effect, paths, shapes), shapes)


def _stamps(paths: Paths) -> Iterator[Basis]:
    stamps = paths.stamps

    def by_delays(effect: ReferenceEffect, shapes: Mapping[str, float]) -> Columns:
        names = _linear(effect, paths)
        units = [dict.fromkeys(names, 0.0) | dict(shapes) | {name: 1.0} for name in names]

        def columns(along: Paths) -> Array:
            delays = [effect.delays(along.stamps, values) for values in units]
            of_axes = np.stack([[position, position, heading] for position, heading in delays]).T
            return along.once(slopes_by_delay) * of_axes

        return columns

    steps = [np.diff(log.stamps) for log in paths.logs if len(log.stamps) > 1]
    finest = float(np.median(np.concatenate(steps)) if steps else stamps.max())
    effect, shapes = smooth.SmoothStamps(), {"duration": float(stamps.max()), "period": finest}
    yield _of_effect(effect, "when the reference's poses are stamped", by_delays(effect, shapes), shapes)
    frequencies = np.arange(1, _FREQUENCIES + 1) / (2 * finest * _FREQUENCIES) if steps else np.zeros(0)
    wave = smooth.SmoothStampWave()
    for frequency in frequencies.tolist():
        words = f"the stamps' place in a period of {1 / frequency:.2g} s"
        shapes = {"frequency": frequency}
        yield _of_effect(wave, words, by_delays(wave, shapes), shapes, tries=_FREQUENCIES)


def _by_parameters(effect: MotionEffect | ReferenceEffect, paths: Paths, shapes: Mapping[str, float]) -> Columns:
    """Slopes by all linear parameters of an effect."""
    names = _linear(effect, paths)
    return lambda along: slopes_by(along, effect, names, dict.fromkeys(names, 0.0) | dict(shapes))


def _linear(effect: MotionEffect | ReferenceEffect, paths: Paths) -> list[str]:
    return [each.name for each in effect.parameters(paths.robot) if not each.choices]


def _command(paths: Paths, trajectories: Sequence[Trajectory]) -> Iterator[Basis]:
    names = list(dict.fromkeys(run.command for run in trajectories if run.command is not None))
    if len(names) < 4:  # three motions are what some matrix makes of any wheel rates
        return
    number = {name: index for index, name in enumerate(names)}
    commands = np.array([-1 if run.command is None else number[run.command] for run in trajectories])
    of_samples, effect, count = commands[paths.owner], smooth.smooth_command(), len(names)
    order = np.argsort(of_samples, kind="stable")
    ends = np.searchsorted(of_samples[order], np.arange(count + 1))
    motions = np.array(
        [np.median(paths.signals.twists[order[low:high]], axis=0) for low, high in pairwise(ends.tolist())]
    )

    def of_commands(along: Paths) -> Array:
        of_runs = commands[along.first : along.first + len(along.logs)]
        slopes = np.zeros((len(along.poses), 3, count, len(effect.modes)))
        for mode, of_mode in enumerate(effect.modes):  # of a run, other commands have slopes of 0
            of_all = along.respond(along.by_modes[of_mode], np.ones((len(along.owner), 1)))[..., 0]
            driven = of_runs[along.run]
            rows = np.flatnonzero(driven >= 0)
            slopes[rows, :, driven[rows], mode] = of_all[rows]
        return slopes

    for number_of, (name, shapes) in enumerate(zip(names, _near_motions(paths, motions), strict=True)):
        columns = partial(_part_of, of_commands, number_of)
        yield _of_effect(effect, f"the command {name}", columns, shapes, tries=count)


def _near_motions(paths: Paths, motions: Array) -> Iterator[dict[str, float]]:
    """Centre and width of a bump about each of several motions (n, 3), which ends before the nearest other motion."""
    at_wheels = motions * [1.0, 1.0, paths.robot.reach]
    away = np.linalg.norm(at_wheels[:, None] - at_wheels, axis=2) + np.diag(np.full(len(motions), np.inf))
    least = _SMALL + _NARROW * float(np.linalg.norm(at_wheels, axis=1).max())
    for (forward, left, turn), nearest in zip(motions.tolist(), away.min(axis=1).tolist(), strict=True):
        width = max(nearest / 3, least)  # 1 % of a bump is left at three widths
        yield {"vx": forward, "vy": left, "omega": turn, "width": width}
