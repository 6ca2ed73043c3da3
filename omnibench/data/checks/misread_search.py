"""Search for the mistakes that bring a freely fitted matrix nearest to the robot's design.

Readings of the recording are of two kinds. Those in which signals or twists change linearly (wheels exchanged, negated,
scaled; a mirrored or turned reference; its unit of length) transform the fitted matrix. Others need a fit of their own:
headings of another sign or in degrees, and steering angles. Every reading has the score

    d^2 + costs of its mistakes + n log(residual) + n log(contradiction),                           (1)

d^2 being the distance from the design; the residual of the fit tells readings by which the windows contradict each
other, and the share of the signals that no motion gives those by which the wheels do.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omnibench.data.checks.design_distance import DesignDistance, transformed
from omnibench.data.checks.misreading import (
    Misreading,
    Reading,
    Transform,
    headings_in_degrees,
    position_units,
    reference_transforms,
    turned_reference,
    wheel_transforms,
)
from omnibench.data.checks.motion_fit import FreeFit, Windows, continuous
from omnibench.data.checks.steering_readings import steering_readings, steering_transforms
from omnibench.data.stored.drawn_runs import in_memory
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import WheelLog

# d^2 from which on a recording is suspicious, share of it that may remain, and score by which an explanation must be
# better (chosen: untouched recordings have 3.6 at most, a wheel counted 1.5 times too much adds 16 or more).
_SUSPICIOUS, _REMAINS, _BETTER = 7.0, 0.6, 4.0
# Contradiction from which on a recording is suspicious, and what slip and designs make of it: chosen, OptiOdom's
# mecanum base has 0.03.
_CONTRADICTING, _USUAL = 0.1, 0.04
_BADLY = 0.25  # share of the way that no matrix explains, from which on a recording is suspicious; untouched ones: 0.08
_MOST_WEIGHED, _CORRELATED = 60.0, 4.0  # n of Eq. (1) at most, and windows that tell as much as one; chosen
# Share of the way and of the turns that is left where wheels and reference have nothing in common; chosen.
UNRELATED = 0.5
_SIMPLE = 4.5  # cost of wheels' mistakes that are looked for beside one of the reference
_IN_DEGREES = 8.0  # cost of headings in degrees; less where a run begins beyond a whole turn
_TURN = 2 * math.pi
_LEAST_TURNED = math.radians(7.5)  # a smaller turn of the reference is what a calibration is for; chosen
_ALIKE = 3.0  # scores nearer than this are told as a class; chosen
_MOST_SAMPLES = 60_000  # of the runs that are looked at; chosen: half a second


@dataclass(frozen=True, eq=False)
class Recorded:
    """Runs of a robot: logs, and reference poses (K, 3) at their stamps."""

    robot: Robot
    logs: Sequence[WheelLog]
    poses: Sequence[Array]

    def some(self) -> Recorded:
        """Runs from first to last that are looked at, all if they are few or short."""
        samples = sum(len(log.times) for log in self.logs)
        every = max(1, math.ceil(samples / _MOST_SAMPLES)) if len(self.logs) > 3 else 1
        logs = [in_memory(log) for log in self.logs[::every]]
        poses = [continuous(log.stamps, each) for log, each in zip(logs, self.poses[::every], strict=True)]
        return Recorded(self.robot, logs, poses)

    def fit(self) -> FreeFit | None:
        """The matrix that fits freely."""
        windows = Windows.of(self.logs, self.poses)
        return None if windows is None else windows.fit()

    def with_headings(self, factor: float) -> Recorded:
        """With headings times a factor."""
        return replace(self, poses=[_times(each, factor) for each in self.poses])

    def in_degrees(self, row_3: Array) -> Recorded:
        """With headings that were recorded in degrees, and made continuous as if they were radians."""
        return replace(self, poses=[_as_degrees(*pair, row_3) for pair in zip(self.logs, self.poses, strict=True)])

    def steered(self, reading: Reading) -> Recorded:
        """With steering angles, and rates, as a reading takes them."""
        return replace(self, logs=[reading.of(log) for log in self.logs])


@dataclass(frozen=True, eq=False)
class Explained:
    """The best reading: its mistakes, those that fit about as well, and d^2 as recorded and as read so.

    told: False where the reference is too sparse for this search. unexplained: share of the way or of the turns,
    whichever is less, that no matrix explains if it is read so.
    """

    mistakes: tuple[Misreading, ...]
    alike: tuple[tuple[Misreading, ...], ...]
    distance: float
    remains: float
    told: bool = True
    unexplained: float = 0.0


@dataclass(frozen=True, eq=False)
class _Base:
    """A fit, the mistakes under which it was made, and their cost. flipped: with headings of the other sign."""

    fit: FreeFit
    mistakes: tuple[Misreading, ...] = ()
    cost: float = 0.0
    flipped: bool = False
    plain: bool = False  # no other transforms of the reference are tried with it


@dataclass(frozen=True, eq=False)
class _Scored:
    score: float
    distance: float
    contradiction: float
    left: float
    mistakes: tuple[Misreading, ...]


def search(recording: Recorded) -> Explained:
    """The mistakes that explain a recording best; none if its matrix is near enough to the design."""
    some = recording.some()
    fit = some.fit()
    if fit is None or not fit.gram.any():  # too sparse, or the wheels stand
        return Explained((), (), 0.0, 0.0, told=False)
    far = DesignDistance(recording.robot)
    distance = far.of(fit)
    contradiction = float(far.contradictions(fit.gram, np.eye(len(fit.gram))[None])[0])
    if distance < _SUSPICIOUS and contradiction < _CONTRADICTING and fit.left[0] < _BADLY:
        return Explained((), (), distance, distance)
    scored = sorted(_scores(some, fit, far), key=lambda each: each.score)
    best, present = scored[0], next(each for each in scored if not each.mistakes)
    likely = best.score <= present.score - _BETTER and best.left < UNRELATED and _explains(best, present)
    if not best.mistakes or not likely:
        return Explained((), (), distance, distance, unexplained=present.left)
    kinds = {mistake.kind for mistake in best.mistakes}
    alike: dict[frozenset[str], tuple[Misreading, ...]] = {}
    for each in scored[1:]:
        other = frozenset(mistake.kind for mistake in each.mistakes)
        if each.score < best.score + _ALIKE and other != kinds and len(each.mistakes) <= len(best.mistakes):
            alike.setdefault(other, each.mistakes)
    return Explained(best.mistakes, tuple(alike.values()), distance, best.distance, unexplained=best.left)


def _explains(best: _Scored, present: _Scored) -> bool:
    """True if hardly anything remains of what made a recording suspicious."""
    nearer = best.distance <= max(_REMAINS * present.distance, _SUSPICIOUS)
    return nearer and best.contradiction <= max(_REMAINS * present.contradiction, _CONTRADICTING)


def _scores(recording: Recorded, fit: FreeFit, far: DesignDistance) -> Iterator[_Scored]:
    bases = list(_bases(recording, fit))
    weight = min(fit.windows / _CORRELATED, _MOST_WEIGHED)
    wheels = [*wheel_transforms(recording.robot), *steering_transforms(recording.robot)]
    for base in bases:
        cost, left = base.cost + weight * math.log(max(float(base.fit.left[0]), 1e-9)), float(base.fit.left.min())
        for transforms in _combined(base, wheels, far.design):
            rows, columns = (np.array([getattr(each, name) for each in transforms]) for name in ("rows", "columns"))
            distances = far.squared(*transformed(base.fit, rows, columns))
            against = far.contradictions(base.fit.gram, columns)
            scores = cost + distances + weight * np.log(np.hypot(against, _USUAL))
            each = zip(transforms, scores.tolist(), distances.tolist(), against.tolist(), strict=True)
            for transform, score, distance, share in each:
                mistakes = (*base.mistakes, *transform.mistakes)
                yield _Scored(score + transform.cost, distance, share, left, mistakes)


def _combined(base: _Base, wheels: Sequence[Transform], design: Array) -> Iterator[list[Transform]]:
    """Mistakes of the wheels, and of the reference with those; never more than three at once."""
    single = wheels[0]
    units, simple = list(position_units()), [wheel for wheel in wheels if wheel.cost <= _SIMPLE]
    if not base.flipped:
        yield list(wheels)
        if base.plain:
            return
        for unit in units:
            yield [wheel.with_reference(unit) for wheel in simple]
        turned = [single, *(wheel for wheel in simple if wheel.mistakes and wheel.mistakes[0].kind != "wheels_swapped")]
        yield list(_turned(base, turned, design)) or [single]
    for mirrored in reference_transforms(base.flipped):
        yield [wheel.with_reference(mirrored) for wheel in simple]


def _turned(base: _Base, wheels: Sequence[Transform], design: Array) -> Iterator[Transform]:
    """References that are turned by the angle that fits best."""
    for wheel in wheels:
        matrix = base.fit.matrix @ wheel.columns
        inverse = np.linalg.pinv(wheel.columns @ np.linalg.pinv(base.fit.covariance[0]) @ wheel.columns.T)
        weights = np.linalg.pinv(inverse) if np.isfinite(inverse).all() else np.eye(matrix.shape[1])
        fitted, meant = matrix[0] + 1j * matrix[1], design[0] + 1j * design[1]
        angle = float(np.angle(fitted @ weights @ meant.conj()))
        if abs(angle) >= _LEAST_TURNED:
            yield wheel.with_reference(turned_reference(angle))


def _bases(recording: Recorded, fit: FreeFit) -> Iterator[_Base]:
    yield _Base(fit)
    flipped = recording.with_headings(-1.0).fit()
    if flipped is not None:
        yield _Base(flipped, flipped=True)
    in_degrees = recording.in_degrees(recording.robot.inverse_kinematic_matrix[2])
    cost = 0.0 if _beyond_a_turn(recording.poses) else _IN_DEGREES
    for factor in (1.0, -1.0):
        base = in_degrees.with_headings(factor).fit()
        if base is not None:
            yield _Base(base, (headings_in_degrees(),), cost, flipped=factor < 0)
    for reading in steering_readings(recording.robot, recording.logs):
        base = recording.steered(reading).fit()
        if base is not None:
            yield _Base(base, reading.mistakes, reading.cost, plain=True)


def _beyond_a_turn(poses: Sequence[Array]) -> bool:
    """True if a run begins with a heading beyond a whole turn, which radians hardly do."""
    return any(abs(float(each[0, 2])) > 1.01 * _TURN for each in poses)


def _times(poses: Array, factor: float) -> Array:
    return poses * (1.0, 1.0, factor)


def _as_degrees(log: WheelLog, poses: Array, row_3: Array) -> Array:
    """Poses (K, 3) with headings in rad, of headings in degrees that were unwrapped as if they were rad.

    A step of theirs is the one recorded but for whole turns of 2 pi "degrees", of which the wheels tell the number by
    row_3 (M,) of their matrix. Where the recording wrapped at 360, a step is up to 3 degrees off, as an outlier.
    """
    edges = np.append(0.0, log.times)
    turned = np.append(0.0, np.cumsum((log.signals @ row_3) * np.diff(edges)))
    expected, steps = np.diff(np.degrees(np.interp(log.stamps, edges, turned))), np.diff(poses[:, 2])
    steps = steps + _TURN * np.round((expected - steps) / _TURN)
    headings = math.radians(poses[0, 2]) + np.append(0.0, np.cumsum(np.radians(steps)))
    return np.column_stack([poses[:, :2], headings])
