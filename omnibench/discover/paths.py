"""The paths of many runs by one matrix, and the slopes of their poses by small changes of the motion.

With z = x + iy and theta along a path, a change (dv, dw) of the twist, dv = dvx + i dvy in the robot's frame, moves the
pose at time t, to first order, by

    d theta(t) = int dw dt',    d z(t) = int (exp(i theta) dv - i z dw) dt' + i z(t) d theta(t),                    (1)

integrals from 0 to t: a turn by dw at t' swings the rest of the path, z(t) - z(t'), about where the robot is then. One
sum over the samples is enough for each change. ``slopes_by``: those by the parameters of an effect.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from omnibench.errors import PluginError
from omnibench.registry import effects
from omnibench.robot.corrections import corrected, corrected_twists, needs_of
from omnibench.robot.effects.effect import MotionEffect, ReferenceEffect, Term, correction_of
from omnibench.robot.effects.smooth import MODES, BentMap, SmoothEffect, direction
from omnibench.robot.effects.textbook import ReferenceTimeOffset
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import PathBatch, RunSamples, WheelLog
from omnibench.robot.signals import Signals, signals_of_runs

# tests/studies/constants.py varies it by 0.5 and 2: on a small set with heading drift no verdict and no name
# changes.
_LAST = 5  # samples at the end of a run whose mean velocity leads on to stamps after it, as WheelLog.continued does
# Samples in a part, a stamp counting as 8: a part's numbers stay in the processor's cache, and its columns are few
# enough to be held as 64 bits, 50 MB of a thousand (chosen).
_BLOCK, _STAMPS = 30_000, 8


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
    driven: Array  # (F, M): drive signals, rad/s
    _turns: Array  # (F, 4): cosine, sine, x and y from the run's start, each times the sample's duration
    lever: Array  # (S, 2): of the stamps, from the run's start

    def in_parts(self) -> Iterator[Paths]:
        """The paths of some runs at a time, few enough that a thousand columns fit into memory."""
        edges = np.searchsorted(self.owner, np.arange(len(self.logs) + 1))
        for first, last in blocks_of([_STAMPS * len(log.stamps) + len(log.times) for log in self.logs], _BLOCK):
            samples = slice(int(edges[first]), int(edges[last]))
            stamps = slice(self.parts[first].start, self.parts[last - 1].stop)
            # The samples of each session that are in the part, counted from its first
            start, stop = samples.start, samples.stop
            within = [
                (name, slice(max(session.start, start) - start, max(min(session.stop, stop), start) - start))
                for name, session in self.sessions
            ]
            yield replace(
                self,
                logs=self.logs[first:last],
                signals=part_of(self.signals, samples, self.signals.session),
                sessions=tuple((name, part) for name, part in within if part.start < part.stop),
                owner=self.owner[samples] - first,
                middle=self.middle[samples],
                poses=self.poses[stamps],
                run=self.run[stamps] - first,
                parts=tuple(slice(run.start - stamps.start, run.stop - stamps.start) for run in self.parts[first:last]),
                ends=self.ends[first:last],
                first=self.first + first,
                driven=self.driven[samples],
                _turns=self._turns[samples],
                lever=self.lever[stamps],
            )

    @property
    def stamps(self) -> Array:
        """Times (S,) of the stamps, s."""
        return np.concatenate([log.stamps for log in self.logs])

    def of_twist(self, direction: Array, shares: Array) -> Array:
        """Slopes (S, 3, J) by changes direction (F, 3) times shares (F, J) of the tracked point's twist."""
        return self.respond(self.changes(direction), shares)

    def tracked(self, twists: Array) -> Array:
        """Twists (F, 3) of the tracked point from those of the robot's centre."""
        mount = self.robot.mount
        return twists if mount is None else twists @ mount.twist.T

    def of_wheel(self, wheel: int, changes: Array) -> Array:
        """Slopes (S, 3, J) of the poses by changes (F, J) of one wheel's rate, rad/s."""
        direct = self.robot.drive.direct
        return self.respond(self.changes(self.matrix[:, wheel] if direct else self._slopes[0][..., wheel]), changes)

    def by_rates(self, changes: Array) -> Array:
        """Changes (F, 3) of the tracked point's twist by changes (F, N) of the wheel rates, rad/s."""
        direct = self.robot.drive.direct
        return changes @ self.matrix.T if direct else np.einsum("fin,fn->fi", self._slopes[0], changes)

    def by_angles(self, changes: Array) -> Array:
        """Changes (F, 3) of the tracked point's twist by changes (F, S) of the steering angles, rad."""
        return np.einsum("fin,fn->fi", self._slopes[1], changes)

    @cached_property
    def _slopes(self) -> tuple[Array, Array]:
        """Derivatives (F, 3, N) and (F, 3, S) of the twists by the wheel rates and by the steering angles."""
        by_rate, by_angle = self.robot.drive.slopes(self.signals.rates, self.signals.steering)
        return self.matrix @ by_rate, self.matrix @ by_angle

    def in_world(self, change: Array) -> Array:
        """Displacements (F, 3) in each sample by a change (F, 2) of the velocity in the reference's frame, m/s."""
        column = np.zeros((len(change), 3))
        column[:, :2] = change * self.signals.durations[:, None]
        return column

    def respond(self, column: Array, shares: Array) -> Array:
        """Slopes (S, 3, J) by column (F, 3), changes of (z, theta) in each sample, times shares (F, J)."""
        steps, sums = np.zeros((len(self.poses), 3, shares.shape[1])), self._sums.copy()
        for axis in range(3):
            if column[:, axis].any():
                sums.data = self._sums.data * column[sums.indices, axis]
                steps[:, axis] = sums @ shares
        return self._from_steps(steps)

    def changes(self, twist: Array) -> Array:
        """Integrals (F, 3) of exp(i theta) dv - i z dw and of dw over each sample. twist: changes (3,) or (F, 3)."""
        cosine, sine, east, north = self._turns.T
        forward, left, turn = twist.T
        changes = np.empty((len(cosine), 3))
        changes[:, 0] = cosine * forward - sine * left + north * turn
        changes[:, 1] = sine * forward + cosine * left - east * turn
        changes[:, 2] = self.signals.durations * turn
        return changes

    def once(self, columns: Callable[[Paths], Array]) -> Array:
        """Columns along these paths, of which several bases have a part; they are computed once."""
        if columns not in self._made:
            self._made[columns] = columns(self)
        return self._made[columns]

    @cached_property
    def _made(self) -> dict[Callable[[Paths], Array], Array]:
        return {}

    @cached_property
    def by_modes(self) -> dict[str, Array]:
        """Changes (F, 3) of (z, theta) in each sample by each of the modes in which a smooth effect acts."""
        return {mode: self.changes(self.tracked(direction(mode, self.signals))) for mode in MODES}

    @cached_property
    def _sums(self) -> csr_array:
        """The matrix (S, F) that adds up what samples do between one stamp and the next."""
        rows, columns, weights = [], [], []
        stamp, first = 0, 0
        for log in self.logs:
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

    def summed(self, changes: Array) -> Array:
        """Slopes (S, 3, J) by changes (F, 3, J) of (z, theta) in each sample."""
        steps = np.asarray(self._sums @ changes.reshape(len(changes), -1))
        return self._from_steps(steps.reshape(-1, *changes.shape[1:]))

    def _from_steps(self, steps: Array) -> Array:
        """Slopes (S, 3, J) by the changes (S, 3, J) of (z, theta) since the stamp before, which are overwritten."""
        np.cumsum(steps, axis=0, out=steps)
        firsts = [part.start for part in self.parts[1:]]
        before = np.concatenate([np.zeros((1, *steps.shape[1:])), steps[[first - 1 for first in firsts]]])
        steps -= before[self.run]
        turned = steps[:, 2]
        steps[:, 0] -= self.lever[:, 1, None] * turned
        steps[:, 1] += self.lever[:, 0, None] * turned
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


def make_paths(
    robot: Robot,
    matrix: Array,
    logs: Sequence[WheelLog],
    sample_period: float,
    needs: Collection[str] | None = None,
    first: int = 0,
    terms: Sequence[Term] = (),
) -> Paths:
    """The paths of runs by a matrix and effects of motion, with exact arcs.

    needs: signals to compute that only some effects need, by default those that any effect needs which applies to the
    robot. first: number of the first run. terms: effects; the signals are those without them.
    """
    order = sorted(range(len(logs)), key=lambda index: str(logs[index].session))
    assert order == list(range(len(logs))), "runs come by session"
    samples = RunSamples.of([log.times for log in logs])
    sessions, starts = _sessions(logs, samples.edges), np.array([log.start for log in logs])
    if needs is None:
        known_effects = [effects.create(entry.name) for entry in effects.entries()]
        needs = frozenset().union(*(effect.needs for effect in known_effects if effect.applies(robot)))
    needs = (frozenset(needs) | needs_of(terms)) - ({"poses"} - needs_of(terms))  # else poses are computed in any case
    of_sessions = [
        signals_of_runs(
            logs[low:high], RunSamples.of([log.times for log in logs[low:high]]), robot, matrix, sample_period, needs
        )
        for _, (low, high), _ in sessions
    ]
    # The signals of all runs one after another; a signal that one run lacks is left out for all
    joined: dict[str, Any] = {}
    for item in fields(Signals):
        values = [getattr(each, item.name) for each in of_sessions]
        if isinstance(values[0], np.ndarray) or item.name in ("wheel_angles", "session_time"):
            joined[item.name] = None if any(value is None for value in values) else np.concatenate(values)
    signals = replace(of_sessions[0], **joined)
    driven = robot.drive.signals(signals.rates, signals.steering)
    twists, world = driven @ matrix.T, None
    if terms:
        corrections = [corrected(terms, each) for each in of_sessions]
        driven = np.concatenate([robot.drive.signals(each.rates, each.steering) for each in corrections])
        of_terms = [corrected_twists(terms, each, matrix) for each in of_sessions]
        twists = np.concatenate([of_session for of_session, _ in of_terms])
        if of_terms[0][1] is not None:
            drift = np.concatenate([of_session for _, of_session in of_terms if of_session is not None])
            world = drift * signals.durations[:, None]
    path = PathBatch(samples, starts, twists * signals.durations[:, None], "arc", world)
    edges = np.cumsum([0, *(len(log.stamps) for log in logs)])
    parts = tuple(slice(int(low), int(high)) for low, high in pairwise(edges))
    middle, ends = path.middles, path.ends
    poses = along_ends(samples, np.concatenate(ends), [log.stamps for log in logs])
    run = np.repeat(np.arange(len(logs)), np.diff(edges))
    from_start = middle[:, :2] - starts[samples.run_of_sample, :2]
    turns = np.column_stack([np.cos(middle[:, 2]), np.sin(middle[:, 2]), from_start]) * signals.durations[:, None]
    return Paths(
        robot=robot,
        matrix=matrix,
        logs=tuple(logs),
        signals=replace(signals, poses=middle),
        sessions=tuple((name, part) for name, _, part in sessions),
        owner=samples.run_of_sample,
        middle=middle,
        poses=poses,
        run=run,
        parts=parts,
        ends=tuple(ends),
        first=first,
        driven=driven,
        _turns=turns,
        lever=poses[:, :2] - starts[run, :2],
    )


def along_ends(samples: RunSamples, ends: Array, times: Sequence[Array]) -> Array:
    """Poses (S, 3) of each run at times (K,), s: at rest before its start, straight on after its last sample.

    ends (F + Z, 3): poses at the start and at the end of each sample of each run, between which they lie on lines.
    """
    sample, share = samples.locate(times)
    wanted, run = np.concatenate(times), samples.run_of_sample[sample]
    before = ends[sample + run]
    poses: Array = before + share[:, None] * (ends[sample + run + 1] - before)
    number = np.arange(len(samples.edges) - 1)
    first, last = samples.edges[:-1] + number, samples.edges[1:] + number  # of the ends of each run
    back = np.maximum(last - _LAST, first)
    end = samples.times[samples.edges[1:] - 1]
    since = np.where(back > first, samples.times[back - number - 1], 0.0)
    mean = (ends[last] - ends[back]) / (end - since)[:, None]
    late = np.flatnonzero(wanted > end[run])
    passed = wanted[late] - end[run[late]]
    poses[late] = ends[last[run[late]]] + mean[run[late]] * passed[:, None]
    return poses


def _sessions(logs: Sequence[WheelLog], edges: NDArray[np.intp]) -> list[tuple[str | None, tuple[int, int], slice]]:
    """The name, the first and last runs and the samples of each session; its runs come one after another."""
    names = [log.session for log in logs]
    firsts = [index for index, name in enumerate(names) if not index or name != names[index - 1]]
    return [
        (names[first], (first, last), slice(int(edges[first]), int(edges[last])))
        for first, last in pairwise([*firsts, len(logs)])
    ]


def part_of(signals: Signals, part: slice, session: str | None) -> Signals:
    """The signals of some samples, which are of one session."""
    values = {item.name: getattr(signals, item.name) for item in fields(signals)}
    chosen: dict[str, Any] = {name: value[part] for name, value in values.items() if isinstance(value, np.ndarray)}
    chosen["session"] = session
    return replace(signals, **chosen)


def slopes_by_matrix(paths: Paths) -> Array:
    """Slopes (S, 3, 3M) by the elements of the matrix, row by row."""
    driven = paths.driven
    return np.concatenate([paths.of_twist(np.tile(row, (len(driven), 1)), driven) for row in np.eye(3)], axis=2)


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
