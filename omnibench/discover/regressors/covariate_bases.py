"""Generic bases: columns by which the residuals may depend on a covariate, with no physics in them.

A basis is a set of small changes of the motion, or of the reported pose, that vary with one covariate. The functions
are those of the smooth effects (omnibench.robot.effects.smooth) by which such a dependence can be added to a model;
only for commands, sessions and wheels that differ there is more to try than a model can use.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.discover.regressors.paths import Paths
from omnibench.robot.effects.effect import MotionEffect, ReferenceEffect, Stage
from omnibench.robot.effects.reference_time import ReferenceTimeOffset
from omnibench.robot.effects.smooth import (
    MODES,
    SmoothCommand,
    SmoothCourse,
    SmoothEffect,
    SmoothElapsedTime,
    SmoothHeading,
    SmoothOrderOfRuns,
    SmoothPatch,
    SmoothPlace,
    bump,
    direction,
    lever,
)
from omnibench.robot.effects.smooth_reference import SmoothMap, SmoothStamps, SmoothStampWave
from omnibench.robot.effects.smooth_wheels import (
    HARMONICS,
    SmoothAcceleration,
    SmoothWheelAngle,
    SmoothWheelRate,
    hat_functions,
)
from omnibench.robot.effects.wheel_angle import mean_waves
from omnibench.robot.kinematics import Array

# tests/benchmarks/constants.py varies each number by 0.5 and 2: on a small set with heading drift no verdict and no
# name changes.
_ORDERS = 6  # smooth functions of time
_FREQUENCIES = 32  # frequencies at which errors of a clock are tried: about as many as 80 stamps a run tell apart
_GRID = 5  # patches along each side of the area
_WIDE = 0.7  # radius of a patch, of the distance between two: half the diagonal of a cell, so that no place is left out
_SEEN = 0.002  # share of the samples that must lie in a patch
_NARROW = 0.02  # share of the largest motion: least width of a bump about one motion
_TOP = 0.999  # quantile of the wheel rates up to which functions of them reach
_SMALL = 1e-9  # range below which a covariate does not vary


@dataclass(frozen=True, eq=False)
class Basis:
    """Columns (S, 3, n): slopes of the poses by n generic changes that vary with a covariate.

    detail: words that complete "the residual depends on ...", and tell several bases of a covariate apart. tries: bases
    of this kind, of which the best is taken. term: the smooth effect that adds these changes to a model, or nothing.
    shapes: the values that shape it.
    """

    covariate: str
    stage: Stage
    detail: str
    columns: Array
    tries: int = 1
    term: str = ""
    shapes: Mapping[str, float] = field(default_factory=dict)


def generic_bases(paths: Paths, trajectories: Sequence[Trajectory]) -> Iterator[Basis]:
    """All bases that these recordings allow: of each covariate that varies and was recorded."""
    twists = _Twists(paths)
    yield from _elapsed(paths, twists)
    yield from _heading(paths, twists)
    yield from _place(paths, twists)
    yield from _order(paths, twists, trajectories)
    yield from _wheel_rate(paths)
    yield from _wheel_angle(paths)
    yield from _acceleration(paths)
    yield from _stamps(paths)
    yield from _command(paths, twists, trajectories)


def _of_effect(
    effect: MotionEffect | ReferenceEffect,
    detail: str,
    columns: Array,
    shapes: Mapping[str, float] | None = None,
    *,
    stage: Stage | None = None,
    tries: int = 1,
) -> Basis:
    """The basis of a smooth effect's columns. stage: where they count as acting, by default where the effect acts."""
    return Basis(effect.shows_in, stage or effect.stage, detail, columns, tries, effect.name, shapes or {})


class _Twists:
    """Slopes of the poses by changes of the twist in each of the modes in which a smooth effect acts."""

    def __init__(self, paths: Paths) -> None:
        self._paths = paths
        self._changes = {mode: paths.changes(paths.tracked(direction(mode, paths.signals))) for mode in MODES}

    def slopes(self, modes: Sequence[str], shares: Array) -> Array:
        """Slopes (S, 3, m J) by changes in m modes, each times shares (F, J)."""
        return np.concatenate([self._paths.respond(self._changes[mode], shares) for mode in modes], axis=2)

    def of_effect(
        self, effect: SmoothEffect, shapes: Mapping[str, float] | None = None, functions: int | None = None
    ) -> Array:
        """Slopes by a smooth effect, of its first so many functions, or of all, in each of its modes."""
        return self.slopes(effect.modes, effect.shares(self._paths.signals, shapes or {})[:, :functions])


def _elapsed(paths: Paths, twists: _Twists) -> Iterator[Basis]:
    effect, shapes = SmoothElapsedTime(), {"duration": max(float(paths.signals.elapsed.max()), _SMALL)}
    yield _of_effect(effect, "the time since the start of a run", twists.of_effect(effect, shapes, _ORDERS), shapes)


def _heading(paths: Paths, twists: _Twists) -> Iterator[Basis]:
    heading, course = SmoothHeading(), SmoothCourse()
    yield _of_effect(heading, "the robot's heading", twists.of_effect(heading))
    speed = np.hypot(paths.signals.twists[:, 0], paths.signals.twists[:, 1])
    steady = [paths.of_velocity(speed[:, None] * axis) for axis in np.eye(2)]
    columns = np.concatenate([*steady, twists.of_effect(course)], axis=2)
    yield _of_effect(course, "the direction of travel in the world", columns, stage="world")


def _place(paths: Paths, twists: _Twists) -> Iterator[Basis]:
    places = paths.middle[:, :2]
    centre = places.mean(axis=0)
    reach = float(np.linalg.norm(places - centre, axis=1).max())
    if reach < _SMALL:
        return
    area = {"centre_x": float(centre[0]), "centre_y": float(centre[1]), "reach": reach}
    floor, bent, patch = SmoothPlace(), SmoothMap(), SmoothPatch()
    yield _of_effect(floor, "where on the floor the robot is", twists.of_effect(floor, area), area)
    starts = np.array([log.start for log in paths.logs])[paths.run]
    there, first = (bent.functions(poses[:, :2], area) for poses in (paths.poses, starts))
    columns = np.concatenate([axis[:, None] * (there - first)[:, None, :] for axis in np.eye(3)], axis=2)
    yield _of_effect(bent, "where on the map the reference is read", columns, area)
    patches = list(_patches(places))
    for shapes in patches:
        yield _of_effect(patch, "a patch of the floor", twists.of_effect(patch, shapes), shapes, tries=len(patches))


def _patches(places: Array) -> Iterator[dict[str, float]]:
    """Centres and radius of patches on a grid over positions (F, 2), those in which there are positions."""
    low = places.min(axis=0)
    spacing = (places.max(axis=0) - low) / (_GRID - 1)
    radius = _WIDE * max(float(spacing.max()), _SMALL)
    for steps in product(range(_GRID), repeat=2):
        x, y = (low + spacing * steps).tolist()
        patch = {"centre_x": x, "centre_y": y, "radius": radius}
        if (bump(places, patch) > np.exp(-1)).mean() > _SEEN:
            yield patch


def _order(paths: Paths, twists: _Twists, trajectories: Sequence[Trajectory]) -> Iterator[Basis]:
    time = paths.signals.session_time
    if time is not None and len(paths.logs) > 3:  # any three times lie on a parabola
        effect, shapes = SmoothOrderOfRuns(), {"duration": max(float(time.max()), _SMALL)}
        columns = twists.of_effect(effect, shapes, _ORDERS)
        yield _of_effect(effect, "the time since the start of the session", columns, shapes, stage="wheel")
    sessions = list(dict.fromkeys(run.session for run in trajectories))
    if len(sessions) > 1:
        belongs = np.array([[run.session == name for name in sessions[1:]] for run in trajectories], dtype=float)
        yield Basis("order of runs", "wheel", "the session", twists.slopes(("along", "rotation"), belongs[paths.owner]))


def _wheel_rate(paths: Paths) -> Iterator[Basis]:
    rates = paths.signals.rates
    top = float(np.quantile(np.abs(rates), _TOP))
    if top < _SMALL:
        return
    effect, shapes, changes = SmoothWheelRate(), {"top": top}, hat_functions(rates, top)
    of_wheels = [paths.of_wheel(wheel, changes[:, wheel]) for wheel in range(rates.shape[1])]
    yield _of_effect(effect, "how fast the wheels turn", np.sum(of_wheels, axis=0), shapes)
    yield _of_effect(effect, "how fast each wheel turns", np.concatenate(of_wheels, axis=2), shapes)


def _wheel_angle(paths: Paths) -> Iterator[Basis]:
    signals, effect = paths.signals, SmoothWheelAngle()
    if signals.wheel_angles is None:
        return
    for harmonic in HARMONICS:
        wheels = range(signals.rates.shape[1])
        columns = [paths.of_wheel(wheel, mean_waves(signals, wheel, harmonic)) for wheel in wheels]
        words = f"the angle of the wheels, {harmonic:g} times a turn"
        yield _of_effect(effect, words, np.concatenate(columns, axis=2), {"harmonic": harmonic}, tries=len(HARMONICS))


def _acceleration(paths: Paths) -> Iterator[Basis]:
    forward, left, angular = paths.signals.accelerations.T
    top, turning = float(np.hypot(forward, left).max()), float(np.abs(angular).max())
    if max(top, turning) < _SMALL:
        return
    effect, shapes = SmoothAcceleration(), {"top": max(top, _SMALL), "top_turning": max(turning, _SMALL)}
    columns = [paths.of_effect(effect, name, values) for name, values in _units(effect, paths, shapes)]
    yield _of_effect(effect, "how the robot accelerates", np.concatenate(columns, axis=2), shapes)


def _stamps(paths: Paths) -> Iterator[Basis]:
    stamps = paths.stamps
    later = paths.of_effect(ReferenceTimeOffset(), "tau", {"tau": 0.0})

    def by_delays(effect: ReferenceEffect, shapes: Mapping[str, float]) -> Array:
        delays = [effect.delays(stamps, values) for _, values in _units(effect, paths, shapes)]
        return later * np.stack([[position, position, heading] for position, heading in delays]).T

    steps = [np.diff(log.stamps) for log in paths.logs if len(log.stamps) > 1]
    finest = float(np.median(np.concatenate(steps)) if steps else stamps.max())
    effect, shapes = SmoothStamps(), {"duration": float(stamps.max()), "period": finest}
    yield _of_effect(effect, "when the reference's poses are stamped", by_delays(effect, shapes), shapes)
    frequencies = np.arange(1, _FREQUENCIES + 1) / (2 * finest * _FREQUENCIES) if steps else np.zeros(0)
    wave = SmoothStampWave()
    for frequency in frequencies.tolist():
        words = f"the stamps' place in a period of {1 / frequency:.2g} s"
        shapes = {"frequency": frequency}
        yield _of_effect(wave, words, by_delays(wave, shapes), shapes, tries=_FREQUENCIES)


def _units(
    effect: MotionEffect | ReferenceEffect, paths: Paths, shapes: Mapping[str, float]
) -> Iterator[tuple[str, dict[str, float]]]:
    """Each linear parameter of an effect, and the values in which it is 1 and the others are 0."""
    names = [each.name for each in effect.parameters(paths.robot) if not each.choices]
    for name in names:
        yield name, dict.fromkeys(names, 0.0) | dict(shapes) | {name: 1.0}


def _command(paths: Paths, twists: _Twists, trajectories: Sequence[Trajectory]) -> Iterator[Basis]:
    commands = list(dict.fromkeys(run.command for run in trajectories if run.command is not None))
    if len(commands) < 4:  # three motions are what some matrix makes of any wheel rates
        return
    belongs = np.array([[run.command == command for command in commands] for run in trajectories], dtype=float)
    shares = belongs[paths.owner]
    motions = np.array([np.median(paths.signals.twists[samples], axis=0) for samples in (shares > 0).T])
    columns, effect, count = twists.slopes(SmoothCommand.modes, shares), SmoothCommand(), len(commands)
    for number, (command, shapes) in enumerate(zip(commands, _near_motions(paths, motions), strict=True)):
        yield _of_effect(effect, f"the command {command}", columns[..., number::count], shapes, tries=count)


def _near_motions(paths: Paths, motions: Array) -> Iterator[dict[str, float]]:
    """Centre and width of a bump about each of several motions (n, 3), which ends before the nearest other motion."""
    at_wheels = motions * [1.0, 1.0, lever(paths.robot)]
    away = np.linalg.norm(at_wheels[:, None] - at_wheels, axis=2) + np.diag(np.full(len(motions), np.inf))
    least = _SMALL + _NARROW * float(np.linalg.norm(at_wheels, axis=1).max())
    for (forward, left, turn), nearest in zip(motions.tolist(), away.min(axis=1).tolist(), strict=True):
        width = max(nearest / 3, least)  # 1 % of a bump is left at three widths
        yield {"vx": forward, "vy": left, "omega": turn, "width": width}
