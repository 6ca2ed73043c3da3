"""The paths of many runs by one matrix, and the slopes of their poses by small changes of the motion.

With z = x + iy and theta along a path, a change (dv, dw) of the twist, dv = dvx + i dvy in the robot's frame, moves the
pose at time t, to first order, by

    d theta(t) = int dw dt',    d z(t) = int (exp(i theta) dv - i z dw) dt' + i z(t) d theta(t),                    (1)

integrals from 0 to t: a turn by dw at t' swings the rest of the path, z(t) - z(t'), about where the robot is then. One
sum over the samples is enough for each change.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from omnibench.errors import PluginError
from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, ReferenceEffect
from omnibench.robot.effects.forms import correction_of
from omnibench.robot.effects.reference_time import ReferenceTimeOffset
from omnibench.robot.effects.smooth import MODES, direction
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import RunSamples, WheelLog
from omnibench.robot.path import PathBatch
from omnibench.robot.signals import Signals, signals_of_runs

# tests/benchmarks/constants.py varies both by 0.5 and 2: on a small set with heading drift no verdict and no name
# changes.
_STEP = 0.1  # share of the plausible range: step of a reference effect's parameter for its slope
_LAST = 5  # samples at the end of a run whose mean velocity leads on to stamps after it, as WheelLog.continued does
_NUMBERS = 8_000_000  # numbers that are summed at once: 64 MB
# Samples in a part, a stamp counting as 8: a part's numbers stay in the processor's cache, and its columns are few
# enough to be held as 64 bits, 25 MB of a thousand (chosen).
_BLOCK, _STAMPS = 10_000, 8


@dataclass(frozen=True, eq=False)
class Paths:
    """Paths of runs one after another: F samples, S stamps.

    signals: signals of all samples. sessions: the samples of each session. owner (F,): the run of each sample. middle
    (F, 3): pose in the middle of each sample. poses (S, 3): poses at the stamps. run (S,): the run of each stamp.
    parts: the stamps of each run. ends: for each run, poses at the start and at the end of each sample. first: number
    of the first run, not 0 in a part of longer paths.
    """

    robot: Robot
    matrix: Array
    logs: tuple[WheelLog, ...]
    signals: Signals
    sessions: tuple[tuple[str | None, slice], ...]
    owner: NDArray[np.intp]
    middle: Array
    poses: Array
    run: NDArray[np.intp]
    parts: tuple[slice, ...]
    ends: tuple[Array, ...]
    first: int
    _turns: Array  # (F, 4): cosine, sine, x and y from the run's start, each times the sample's duration
    _lever: Array  # (S, 2): from the run's start

    def in_parts(self) -> Iterator[Paths]:
        """The paths of some runs at a time, few enough that a thousand columns fit into memory."""
        edges = np.searchsorted(self.owner, np.arange(len(self.logs) + 1))
        for first, last in blocks_of([_STAMPS * len(log.stamps) + len(log.times) for log in self.logs], _BLOCK):
            samples = slice(int(edges[first]), int(edges[last]))
            stamps = slice(self.parts[first].start, self.parts[last - 1].stop)
            within = [(name, _overlap(part, samples)) for name, part in self.sessions]
            yield replace(
                self,
                logs=self.logs[first:last],
                signals=_part(self.signals, samples, self.signals.session),
                sessions=tuple((name, part) for name, part in within if part.start < part.stop),
                owner=self.owner[samples] - first,
                middle=self.middle[samples],
                poses=self.poses[stamps],
                run=self.run[stamps] - first,
                parts=tuple(_moved(part, -stamps.start) for part in self.parts[first:last]),
                ends=self.ends[first:last],
                first=self.first + first,
                _turns=self._turns[samples],
                _lever=self._lever[stamps],
            )

    @property
    def stamps(self) -> Array:
        """Times (S,) of the stamps, s."""
        return np.concatenate([log.stamps for log in self.logs])

    @cached_property
    def driven(self) -> Array:
        """Drive signals (F, M) of all samples, rad/s."""
        return self.robot.drive.signals(self.signals.rates, self.signals.steering)

    def of_twist(self, direction: Array, shares: Array) -> Array:
        """Slopes (S, 3, J) by changes direction (F, 3) times shares (F, J) of the tracked point's twist."""
        return self.respond(self.changes(direction), shares)

    def of_body(self, direction: Array, shares: Array) -> Array:
        """Slopes (S, 3, J) by changes direction (F, 3) times shares (F, J) of the twist of the robot's centre."""
        return self.of_twist(self.tracked(direction), shares)

    def tracked(self, twists: Array) -> Array:
        """Twists (F, 3) of the tracked point from those of the robot's centre."""
        mount = self.robot.mount
        return twists if mount is None else twists @ mount.twist.T

    def of_wheel(self, wheel: int, changes: Array) -> Array:
        """Slopes (S, 3, J) of the poses by changes (F, J) of one wheel's rate, rad/s."""
        direct = self.robot.drive.direct
        return self.respond(self.changes(self.matrix[:, wheel] if direct else self._by_rate[..., wheel]), changes)

    def of_rates(self, change: Array) -> Array:
        """Slopes (S, 3, 1) by a change (F, N) of all wheel rates."""
        if self.robot.drive.direct:
            return self.respond(self.changes(change @ self.matrix.T), None)
        return self.respond(self.changes(np.einsum("fin,fn->fi", self._by_rate, change)), None)

    def of_steering(self, change: Array) -> Array:
        """Slopes (S, 3, 1) by a change (F, S) of all steering angles, rad."""
        return self.respond(self.changes(np.einsum("fin,fn->fi", self._slopes[1], change)), None)

    @property
    def _by_rate(self) -> Array:
        return self._slopes[0]

    @cached_property
    def _slopes(self) -> tuple[Array, Array]:
        """Derivatives (F, 3, N) and (F, 3, S) of the twists by the wheel rates and by the steering angles."""
        by_rate, by_angle = self.robot.drive.slopes(self.signals.rates, self.signals.steering)
        return self.matrix @ by_rate, self.matrix @ by_angle

    def of_velocity(self, change: Array) -> Array:
        """Slopes (S, 3, 1) by a change (F, 2) of the velocity in the reference's frame, m/s."""
        column = np.zeros((len(change), 3))
        column[:, :2] = change * self.signals.durations[:, None]
        return self.respond(column, None)

    def correction(self, effect: MotionEffect, values: Mapping[str, float]) -> Array:
        """Correction of every sample by an effect, (F, n) as its stage has it: of rates, angles, twist or velocity."""
        parts = []
        for session, part in self.sessions:
            parts.append(_corrected(effect, _part(self.signals, part, session), values))
        return np.concatenate(parts)

    def of_effect(self, effect: MotionEffect | ReferenceEffect, unit: str, values: Mapping[str, float]) -> Array:
        """Slopes (S, 3, 1) by the parameter called ``unit`` of an effect. values: its shapes, and 0 for all else."""
        if isinstance(effect, ReferenceEffect):
            return self._of_reference(effect, unit, values)
        return self.of_correction(effect, self.correction(effect, {**values, unit: 1.0}))

    def of_correction(self, effect: MotionEffect, change: Array) -> Array:
        """Slopes (S, 3, 1) by a correction (F, n) at the stage of an effect."""
        if effect.stage == "body":
            return self.of_body(change, np.ones((len(change), 1)))
        if effect.stage == "world":
            return self.of_velocity(change)
        return self.of_steering(change) if effect.stage == "steering" else self.of_rates(change)

    def _of_reference(self, effect: ReferenceEffect, unit: str, values: Mapping[str, float]) -> Array:
        step = _STEP * next(each.largest for each in effect.parameters(self.robot) if each.name == unit)
        after, before = (self.reported(effect, {**values, unit: sign * step}) for sign in (1, -1))
        return ((after - before) / (2 * step))[..., None]

    def reported(self, effect: ReferenceEffect, values: Mapping[str, float]) -> Array:
        """Poses (S, 3) that the reference would report with an effect."""
        reported = []
        for log, path in zip(self.logs, self.ends, strict=True):
            position, heading = effect.delays(log.stamps, values)
            times = np.concatenate([[0.0], log.times])
            poses = np.column_stack(
                [
                    *(_along(log.stamps - position, times, path[:, axis]) for axis in (0, 1)),
                    _along(log.stamps - heading, times, path[:, 2]),
                ]
            )
            reported.append(effect.reported(poses, log.start, values))
        return np.concatenate(reported)

    def respond(self, column: Array, shares: Array | None) -> Array:
        """Slopes (S, 3, J) by column (F, 3), changes of (z, theta) in each sample, times shares (F, J)."""
        if shares is None:
            return self._summed(column[:, :, None])
        width = max(1, _NUMBERS // (3 * len(column)))
        blocks = [
            self._summed(column[:, :, None] * shares[:, None, low : low + width])
            for low in range(0, shares.shape[1], width)
        ]
        return blocks[0] if len(blocks) == 1 else np.concatenate(blocks, axis=2)

    def changes(self, twist: Array) -> Array:
        """Integrals (F, 3) of exp(i theta) dv - i z dw and of dw over each sample. twist: changes (3,) or (F, 3)."""
        cosine, sine, east, north = self._turns.T
        forward, left, turn = twist.T
        changes = np.empty((len(cosine), 3))
        changes[:, 0] = cosine * forward - sine * left + north * turn
        changes[:, 1] = sine * forward + cosine * left - east * turn
        changes[:, 2] = self.signals.durations * turn
        return changes

    @cached_property
    def by_modes(self) -> dict[str, Array]:
        """Changes (F, 3) of (z, theta) in each sample by each of the modes in which a smooth effect acts."""
        return {mode: self.changes(self.tracked(direction(mode, self.signals))) for mode in MODES}

    @cached_property
    def by_delay(self) -> Array:
        """Slopes (S, 3, 1) by a delay of the reference, s."""
        return self.of_effect(ReferenceTimeOffset(), "tau", {"tau": 0.0})

    @cached_property
    def _sums(self) -> csr_array:
        return _sums(self.logs)

    def _summed(self, changes: Array) -> Array:
        """Slopes (S, 3, J) by changes (F, 3, J) of (z, theta) in each sample."""
        steps = np.asarray(self._sums @ changes.reshape(len(changes), -1)).reshape(-1, *changes.shape[1:])
        np.cumsum(steps, axis=0, out=steps)
        firsts = [part.start for part in self.parts[1:]]
        before = np.concatenate([np.zeros((1, *steps.shape[1:])), steps[[first - 1 for first in firsts]]])
        steps -= before[self.run]
        turned = steps[:, 2]
        steps[:, 0] -= self._lever[:, 1, None] * turned
        steps[:, 1] += self._lever[:, 0, None] * turned
        return steps


def blocks_of(sizes: Sequence[int], most: int) -> Iterator[tuple[int, int]]:
    """First and last, exclusive, of consecutive runs whose sizes add up to ``most`` at most, or of a single one."""
    first, total = 0, 0
    for index, size in enumerate(sizes):
        if total and total + size > most:
            yield first, index
            first, total = index, 0
        total += size
    yield first, len(sizes)


def _overlap(part: slice, other: slice) -> slice:
    """The samples that are in both, counted from the first of the other."""
    return _moved(slice(max(part.start, other.start), max(min(part.stop, other.stop), other.start)), -other.start)


def _moved(part: slice, by: int) -> slice:
    return slice(part.start + by, part.stop + by)


def make_paths(
    robot: Robot,
    matrix: Array,
    logs: Sequence[WheelLog],
    sample_period: float,
    needs: Collection[str] | None = None,
    first: int = 0,
) -> Paths:
    """The paths of runs by a matrix alone, with exact arcs.

    needs: signals to compute that only some effects need, by default those that any effect needs which applies to the
    robot. first: number of the first run.
    """
    order = sorted(range(len(logs)), key=lambda index: str(logs[index].session))
    assert order == list(range(len(logs))), "runs come by session"
    samples = RunSamples.of([log.times for log in logs])
    sessions, starts = _sessions(logs, samples.edges), np.array([log.start for log in logs])
    needs = frozenset(_needs(robot) if needs is None else needs) - {"poses"}  # which are computed in any case
    of_sessions = [
        signals_of_runs(
            logs[low:high], RunSamples.of([log.times for log in logs[low:high]]), robot, matrix, sample_period, needs
        )
        for _, (low, high), _ in sessions
    ]
    signals = _joined(of_sessions)
    driven = robot.drive.signals(signals.rates, signals.steering)
    path = PathBatch(samples, starts, (driven @ matrix.T) * signals.durations[:, None], "arc")
    edges = np.cumsum([0, *(len(log.stamps) for log in logs)])
    parts = tuple(slice(int(low), int(high)) for low, high in pairwise(edges))
    middle, ends = path.middles, path.ends
    poses = np.concatenate([_poses_along(log, path) for log, path in zip(logs, ends, strict=True)])
    run = np.repeat(np.arange(len(logs)), np.diff(edges))
    from_start = middle[:, :2] - starts[samples.run, :2]
    turns = np.column_stack([np.cos(middle[:, 2]), np.sin(middle[:, 2]), from_start]) * signals.durations[:, None]
    return Paths(
        robot=robot,
        matrix=matrix,
        logs=tuple(logs),
        signals=replace(signals, poses=middle),
        sessions=tuple((name, part) for name, _, part in sessions),
        owner=samples.run,
        middle=middle,
        poses=poses,
        run=run,
        parts=parts,
        ends=tuple(ends),
        first=first,
        _turns=turns,
        _lever=poses[:, :2] - starts[run, :2],
    )


def _needs(robot: Robot) -> frozenset[str]:
    """Signals that effects which apply to a robot need."""
    trial = [effects.create(entry.name) for entry in effects.entries()]
    return frozenset().union(*(effect.needs for effect in trial if effect.applies(robot)))


def _along(times: Array, ends: Array, values: Array) -> Array:
    """A coordinate of a path at any times: at rest before the start, straight on after the last sample."""
    along: Array = np.interp(times, ends, values)
    late = times > ends[-1]
    if late.any():
        back = max(len(ends) - 1 - _LAST, 0)
        slope = (values[-1] - values[back]) / (ends[-1] - ends[back])
        along[late] = values[-1] + slope * (times[late] - ends[-1])
    return along


def _poses_along(log: WheelLog, path: Array) -> Array:
    """Poses (S, 3) at a log's stamps, by straight lines between the poses (F + 1, 3) of its path."""
    times = np.concatenate([[0.0], log.times])
    return np.column_stack([_along(log.stamps, times, path[:, axis]) for axis in range(3)])


def _sums(logs: Sequence[WheelLog]) -> csr_array:
    """The matrix (S, F) that adds up what samples do between one stamp and the next."""
    rows, columns, weights = [], [], []
    stamp, first = 0, 0
    for log in logs:
        times = np.concatenate([[0.0], log.times])
        edges = np.unique(np.concatenate([times, np.clip(log.stamps, 0.0, times[-1])]))
        middles = (edges[1:] + edges[:-1]) / 2
        sample = np.searchsorted(log.times, middles)
        interval = np.searchsorted(log.stamps, middles)
        inside = interval < len(log.stamps)
        share = np.diff(edges) / np.diff(times)[np.minimum(sample, len(log.times) - 1)]
        rows.append(stamp + interval[inside])
        columns.append(first + sample[inside])
        weights.append(share[inside])
        stamp, first = stamp + len(log.stamps), first + len(log.times)
    entries = (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns)))
    return csr_array(entries, shape=(stamp, first))


def _sessions(logs: Sequence[WheelLog], edges: NDArray[np.intp]) -> list[tuple[str | None, tuple[int, int], slice]]:
    """The name, the first and last runs and the samples of each session; its runs come one after another."""
    names = [log.session for log in logs]
    firsts = [index for index, name in enumerate(names) if not index or name != names[index - 1]]
    return [
        (names[first], (first, last), slice(int(edges[first]), int(edges[last])))
        for first, last in pairwise([*firsts, len(logs)])
    ]


def _corrected(effect: MotionEffect, signals: Signals, values: Mapping[str, float]) -> Array:
    """Correction by an effect. Raises PluginError where it fails, has another shape, or is not finite."""
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


def _part(signals: Signals, part: slice, session: str | None) -> Signals:
    """The signals of some samples, which are of one session."""
    values = {item.name: getattr(signals, item.name) for item in fields(signals)}
    chosen: dict[str, Any] = {name: value[part] for name, value in values.items() if isinstance(value, np.ndarray)}
    chosen["session"] = session
    return replace(signals, **chosen)


def _joined(signals: Sequence[Signals]) -> Signals:
    """The signals of all runs one after another; a signal that one run lacks is left out for all."""
    joined: dict[str, Any] = {}
    for item in fields(Signals):
        values = [getattr(each, item.name) for each in signals]
        if isinstance(values[0], np.ndarray) or item.name in ("wheel_angles", "session_time"):
            joined[item.name] = None if any(value is None for value in values) else np.concatenate(values)
    return replace(signals[0], **joined)
