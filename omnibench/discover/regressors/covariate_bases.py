"""Generic bases: columns by which the residuals may depend on a covariate, with no physics in them.

A basis is a set of small changes of the motion, or of the reported pose, that vary with one covariate: changes along
the direction of travel, across it and in turning, each times smooth functions of the covariate. A change in turning is
proportional to the way of the wheels, so that a robot that stands is never changed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import chebyshev

from omnibench.data.dataset import Trajectory
from omnibench.discover.regressors.paths import Paths
from omnibench.robot.effects.effect import Stage
from omnibench.robot.effects.smooth import lever, surfaces, waves
from omnibench.robot.effects.smooth_wheels import HARMONICS, hat_functions
from omnibench.robot.kinematics import Array

_ORDERS = 6  # smooth functions of time; chosen
_FREQUENCIES = 32  # frequencies at which errors of a clock are tried; chosen
_GRID = 5  # patches along each side of the area; chosen
_NARROW = 0.02  # share of the largest motion: least width of a bump about one motion; chosen
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
    modes = _Modes(paths)
    yield from _elapsed(paths, modes)
    yield from _heading(paths, modes)
    yield from _place(paths, modes)
    yield from _order(paths, modes, trajectories)
    yield from _wheel_rate(paths)
    yield from _wheel_angle(paths)
    yield from _acceleration(paths, modes)
    yield from _stamps(paths)
    yield from _command(paths, modes, trajectories)


class _Modes:
    """Changes (F, 3) of the twist: along the direction of travel, across it, in turning, and of the rotation alone."""

    def __init__(self, paths: Paths) -> None:
        twists = paths.signals.twists
        nothing = np.zeros(len(twists))
        self.speed: Array = np.hypot(twists[:, 0], twists[:, 1])
        self.along = np.column_stack([twists[:, :2], nothing])
        self.across = np.column_stack([-twists[:, 1], twists[:, 0], nothing])
        self.turn = np.column_stack([nothing, nothing, np.abs(twists[:, 2]) + self.speed / lever(paths.robot)])
        self.rotation = np.column_stack([nothing, nothing, twists[:, 2]])

        self._changes = [paths.changes(mode) for mode in (self.along, self.across, self.turn)]

    def all_of(self, paths: Paths, shares: Array) -> Array:
        """Slopes (S, 3, 3 J) by changes along, across and in turning, times shares (F, J)."""
        return np.concatenate([paths.respond(changes, shares) for changes in self._changes], axis=2)

    def each_of(self, paths: Paths, shares: Array) -> list[Array]:
        """J slopes (S, 3, 3) by changes along, across and in turning, one for each column of shares (F, J)."""
        count = shares.shape[1]
        columns = self.all_of(paths, shares)
        return [columns[..., column::count] for column in range(count)]


def _elapsed(paths: Paths, modes: _Modes) -> Iterator[Basis]:
    elapsed = paths.signals.elapsed
    longest = max(float(elapsed.max()), _SMALL)
    columns = modes.all_of(paths, np.cos(np.pi * np.arange(_ORDERS) * elapsed[:, None] / longest))
    yield Basis("elapsed time", "body", "the time since the start of a run", columns, term="smooth_elapsed_time",
                shapes={"duration": longest})  # fmt: skip


def _heading(paths: Paths, modes: _Modes) -> Iterator[Basis]:
    heading = paths.middle[:, 2]
    columns = modes.all_of(paths, waves(heading, (1, 2, 3)))
    yield Basis("heading", "body", "the robot's heading", columns, term="smooth_heading")
    twists = paths.signals.twists
    course = heading + np.arctan2(twists[:, 1], twists[:, 0])
    steady = [paths.of_velocity(modes.speed[:, None] * np.eye(2)[axis]) for axis in range(2)]
    turned = [paths.of_twist(mode, waves(course, (1, 2))) for mode in (modes.along, modes.across, modes.turn)]
    columns = np.concatenate([*steady, *turned], axis=2)
    yield Basis("heading", "world", "the direction of travel in the world", columns, term="smooth_course")


def _place(paths: Paths, modes: _Modes) -> Iterator[Basis]:
    centre = paths.middle[:, :2].mean(axis=0)
    reach = float(np.abs(paths.middle[:, :2] - centre).max())
    if reach < _SMALL:
        return
    inside = (paths.middle[:, :2] - centre) / reach
    middle = {"centre_x": float(centre[0]), "centre_y": float(centre[1])}
    area = {**middle, "reach": reach * float(np.linalg.norm(inside, axis=1).max())}
    yield Basis("place", "body", "where on the floor the robot is", modes.all_of(paths, surfaces(inside)),
                term="smooth_place", shapes=area)  # fmt: skip
    starts = np.array([log.start for log in paths.logs])[paths.run]
    there, first = (surfaces((poses[:, :2] - centre) / reach) for poses in (paths.poses, starts))
    shifts = (there - first)[:, None, :]
    columns = np.concatenate([np.eye(3)[None, :, [axis]] * shifts for axis in range(3)], axis=2)
    yield Basis("place", "reference", "where on the map the reference is read", columns, term="smooth_map", shapes=area)
    low, high = inside.min(axis=0), inside.max(axis=0)
    spacing = (high - low) / (_GRID - 1)
    width = float(max(spacing.max(), _SMALL))
    bumps, patches = [], []
    for east in range(_GRID):
        for north in range(_GRID):
            away = np.linalg.norm(inside - low - spacing * [east, north], axis=1) / width
            if (away < 0.7).mean() > 0.002:
                bumps.append(np.exp(-(away**2) / 0.7**2))
                x, y = centre + reach * (low + spacing * [east, north])
                patches.append({"centre_x": float(x), "centre_y": float(y), "radius": 0.7 * width * reach})
    for columns, shapes in zip(modes.each_of(paths, np.column_stack(bumps)), patches, strict=True):
        yield Basis("place", "body", "a patch of the floor", columns, len(bumps), "smooth_patch", shapes)


def _order(paths: Paths, modes: _Modes, trajectories: Sequence[Trajectory]) -> Iterator[Basis]:
    time = paths.signals.session_time
    if time is not None and len(paths.logs) > 3:
        longest = max(float(time.max()), _SMALL)
        shares = chebyshev.chebvander(2 * time / longest - 1, _ORDERS)[:, 1:]
        columns = [paths.of_twist(mode, shares) for mode in (modes.along, modes.rotation, modes.turn)]
        yield Basis("order of runs", "wheel", "the time since the start of the session",
                    np.concatenate(columns, axis=2), term="smooth_order_of_runs",
                    shapes={"duration": longest})  # fmt: skip
    sessions = list(dict.fromkeys(run.session for run in trajectories))
    if len(sessions) > 1:
        belongs = np.array([[run.session == name for name in sessions[1:]] for run in trajectories], dtype=float)
        columns = [paths.of_twist(mode, belongs[paths.owner]) for mode in (modes.along, modes.rotation)]
        yield Basis("order of runs", "wheel", "the session", np.concatenate(columns, axis=2))


def _wheel_rate(paths: Paths) -> Iterator[Basis]:
    rates = paths.signals.rates
    top = float(np.quantile(np.abs(rates), 0.999))
    if top < _SMALL:
        return
    changes, shapes = hat_functions(rates, top), {"top": top}
    of_wheels = [paths.of_wheel(wheel, changes[:, wheel]) for wheel in range(rates.shape[1])]
    yield Basis("wheel rate", "wheel", "how fast the wheels turn", np.sum(of_wheels, axis=0), term="smooth_wheel_rate",
                shapes=shapes)  # fmt: skip
    yield Basis("wheel rate", "wheel", "how fast each wheel turns", np.concatenate(of_wheels, axis=2),
                term="smooth_wheel_rate", shapes=shapes)  # fmt: skip


def _wheel_angle(paths: Paths) -> Iterator[Basis]:
    angles = paths.signals.wheel_angles
    if angles is None:
        return
    rates = paths.signals.rates
    for harmonic in HARMONICS:
        half = harmonic / 2 * paths.signals.durations[:, None]
        mean = np.sin(half * rates) / half  # amplitude of rate times wave, as a mean over a sample
        columns = [
            paths.of_wheel(wheel, mean[:, [wheel]] * waves(angles[:, wheel], (harmonic,)))
            for wheel in range(rates.shape[1])
        ]
        words = f"the angle of the wheels, {harmonic:g} times a turn"
        yield Basis("wheel angle", "wheel", words, np.concatenate(columns, axis=2), len(HARMONICS),
                    "smooth_wheel_angle", {"harmonic": harmonic})  # fmt: skip


def _acceleration(paths: Paths, modes: _Modes) -> Iterator[Basis]:
    forward, left, angular = paths.signals.accelerations.T
    size = np.hypot(forward, left)
    if max(float(size.max()), float(np.abs(angular).max())) < _SMALL:
        return
    nothing = np.zeros(len(size))
    straight = np.column_stack([forward, left, nothing])
    aside = np.column_stack([-left, forward, nothing])
    about = np.column_stack([nothing, nothing, np.ones(len(size))])
    one = np.ones((len(size), 1))
    columns = [
        paths.of_twist(straight, one),
        paths.of_twist(aside, one),
        paths.of_twist(about, np.column_stack([forward, left, angular, size, np.abs(angular)])),
        paths.of_twist(modes.along, size[:, None]),
        paths.of_twist(modes.across, size[:, None]),
        paths.of_twist(modes.rotation, size[:, None]),
    ]
    largest = {"top": max(float(size.max()), _SMALL), "top_turning": max(float(np.abs(angular).max()), _SMALL)}
    yield Basis("acceleration", "body", "how the robot accelerates", np.concatenate(columns, axis=2),
                term="smooth_acceleration", shapes=largest)  # fmt: skip


def _stamps(paths: Paths) -> Iterator[Basis]:
    velocity = _pose_velocity(paths)
    stamps = paths.stamps
    number = np.concatenate([np.arange(part.stop - part.start) for part in paths.parts])
    shares = np.column_stack([np.ones(len(stamps)), stamps / stamps.max(), (-1.0) ** number])
    position, heading = velocity * [1.0, 1.0, 0.0], velocity * [0.0, 0.0, 1.0]
    columns = [moving[:, :, None] * shares[:, None, :] for moving in (position, heading)]
    steps = [np.diff(log.stamps) for log in paths.logs if len(log.stamps) > 1]
    finest = float(np.median(np.concatenate(steps)) if steps else stamps.max())
    yield Basis("stamps", "reference", "when the reference's poses are stamped", np.concatenate(columns, axis=2),
                term="smooth_stamps", shapes={"duration": float(stamps.max()), "period": finest})  # fmt: skip
    if not steps:
        return
    frequencies = np.arange(1, _FREQUENCIES + 1) / (2 * finest * _FREQUENCIES)
    for frequency in frequencies:
        swings = waves(2 * np.pi * frequency * stamps, (1,))
        words = f"the stamps' place in a period of {1 / frequency:.2g} s"
        yield Basis("stamps", "reference", words, velocity[:, :, None] * swings[:, None, :], _FREQUENCIES,
                    "smooth_stamp_wave", {"frequency": float(frequency)})  # fmt: skip


def _command(paths: Paths, modes: _Modes, trajectories: Sequence[Trajectory]) -> Iterator[Basis]:
    commands = list(dict.fromkeys(run.command for run in trajectories if run.command is not None))
    if len(commands) < 4:
        return
    belongs = np.array([[run.command == command for command in commands] for run in trajectories], dtype=float)
    twists, of_samples = paths.signals.twists, belongs[paths.owner] > 0
    motions = np.array([np.median(twists[samples], axis=0) for samples in of_samples.T])
    of_commands = modes.each_of(paths, belongs[paths.owner])
    for command, columns, shapes in zip(commands, of_commands, _near_motions(paths, motions), strict=True):
        yield Basis("command", "body", f"the command {command}", columns, len(commands), "smooth_command", shapes)


def _near_motions(paths: Paths, motions: Array) -> Iterator[dict[str, float]]:
    """For each of several motions (n, 3): centre and width of a bump that ends before the nearest other motion."""
    at_wheels = motions * [1.0, 1.0, lever(paths.robot)]
    away = np.linalg.norm(at_wheels[:, None] - at_wheels, axis=2) + np.diag(np.full(len(motions), np.inf))
    least = _SMALL + _NARROW * float(np.linalg.norm(at_wheels, axis=1).max())
    for (forward, left, turn), nearest in zip(motions.tolist(), away.min(axis=1).tolist(), strict=True):
        yield {"vx": forward, "vy": left, "omega": turn, "width": max(nearest / 3, least)}


def _pose_velocity(paths: Paths) -> Array:
    """Velocities (S, 3) of the poses in the world, m/s, m/s, rad/s, means over 100 ms."""
    velocities = []
    for log, path in zip(paths.logs, paths.ends, strict=True):
        times = np.concatenate([[0.0], log.times])
        after, before = (
            np.column_stack([np.interp(log.stamps + shift, times, path[:, axis]) for axis in range(3)])
            for shift in (0.05, -0.05)
        )
        velocities.append((after - before) / 0.1)
    return np.concatenate(velocities)
