"""Search for the mistakes, in the log or in the robot's file, that bring the motion nearest to the robot's design.

Where reference poses are dense, every hypothesis has the score

    d^2 + costs of its mistakes + n log(residual) + n log(contradiction),                           (1)

d^2 being the distance of the fitted matrix from the design (motion_fit.py); the residual of the fit tells readings by
which the windows contradict each other, and the share of the signals that no motion gives those by which the wheels do.
Where poses are sparse, the design's odometry is compared with them at a few moments of each run.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from omnibench.check import hypotheses as readings
from omnibench.check.hypotheses import Hypothesis, Reading
from omnibench.check.motion_fit import DesignDistance, FreeFit, Windows, continuous, transformed, usual_changes
from omnibench.data.finding import Finding
from omnibench.robot.kinematics import Array, CarDrive, Robot, wrapped
from omnibench.robot.odometry import Complex, OdometryBatch, WheelLog

# d^2 from which on a recording is suspicious, share of it that may remain, and score by which an explanation must be
# better (chosen: untouched recordings have 3.6 at most, a wheel counted 1.5 times too much adds 16 or more).
_SUSPICIOUS, _REMAINS, _BETTER = 7.0, 0.6, 4.0
# Contradiction from which on a recording is suspicious, and what slip and designs make of it: chosen, OptiOdom's
# mecanum base has 0.03.
_CONTRADICTING, _USUAL = 0.1, 0.04
_BADLY = 0.25  # share of the motion that no matrix explains, from which on a recording is suspicious; usual: 0.08
_MOST_WEIGHED, _CORRELATED = 60.0, 4.0  # n of Eq. (1) at most, and windows that tell as much as one; chosen
UNRELATED = 0.5  # share of the way and of the turns that wheels leave which have nothing to do with them; chosen
_SIMPLE = 4.5  # cost of wheels' mistakes that are looked for beside one of the reference
_IN_DEGREES = 8.0  # cost of headings in degrees; less where a run begins beyond a whole turn
_TURN = 2 * math.pi
# Explanations whose scores are nearer than this to the best one's, or without their costs, are named beside it; chosen.
_ALIKE, _SAME = 3.0, 0.5
_MOST_SAMPLES = 60_000  # wheel samples of the runs that hypotheses are fitted to: half a second of work; chosen
# Sparse poses: misfits of the odometry from which on a recording, or its steering, is suspicious; share of it that an
# explanation may leave, and misfits that are as good as the best (chosen: errors of calibration, slip and noise are
# below).
_MISFIT, _LEAST_MISFIT, _EXPLAINED, _AS_GOOD = 0.15, 0.05, 0.35, 1.1
_SCALES = ("wheel_scale", "design_radius")
_LEAST_FACTOR = 1.8  # factor of rates, below which sparse poses do not tell it from another design; chosen
# Score by which positions without headings must fit better with a tracked point off the centre than with none, or
# another: what it costs and is to be better by beside poses. And their least deviation, as a share of the robot's size;
# chosen.
_FITTED_POINT, _EXACT = 10.0, 0.01
_APART = 0.15  # share of the robot's size, within which two tracked points that fit are one; chosen
# Runs that are compared at most, and poses of each: with headings, and without; chosen.
_MOST_RUNS, _MOST_STAMPS, _MOST_POSITIONS = 24, 300, 30


@dataclass(frozen=True, eq=False)
class Recorded:
    """Runs of a robot: logs, and reference poses (K, 3) at their stamps.

    as_read: these poses before their headings were made continuous. without_headings: True if they are positions, in a
    frame that each run may have turned. counted: True if the rates were made of ticks.
    """

    robot: Robot
    logs: Sequence[WheelLog]
    poses: Sequence[Array]
    as_read: Sequence[Array] = ()
    without_headings: bool = False
    counted: bool = False

    def some(self) -> Recorded:
        """Runs from first to last that are looked at, all if they are few or short; with continuous headings."""
        samples = sum(len(log.times) for log in self.logs)
        every = max(1, math.ceil(samples / _MOST_SAMPLES)) if len(self.logs) > 3 else 1
        logs, as_read = self.logs[::every], self.poses[::every]
        poses = [continuous(log.stamps, of_run) for log, of_run in zip(logs, as_read, strict=True)]
        return replace(self, logs=logs, poses=poses, as_read=as_read)

    def fit(self) -> FreeFit | None:
        """The matrix that fits freely; None where poses are too sparse."""
        windows = Windows.of(self.logs, self.poses)
        if windows is not None and isinstance(self.robot.drive, CarDrive):
            windows = windows.only(windows.gentle())  # its matrix holds no slip of the tyres
        return None if windows is None else windows.fit(self.robot.reach)

    def meant(self, hypothesis: Hypothesis) -> Recorded:
        """With the logs that were meant, by a reading of steering angles and rates."""
        reading = hypothesis.reading or Reading()
        return replace(self, logs=[reading.of(log) for log in self.logs])

    def with_headings(self, factor: float) -> Recorded:
        """With headings times a factor."""
        return replace(self, poses=[poses * (1.0, 1.0, factor) for poses in self.poses])

    def in_degrees(self) -> Recorded:
        """With headings that were recorded in degrees."""
        as_read = self.as_read or self.poses
        pairs = [(poses[:, :2], np.radians(np.unwrap(poses[:, 2], period=360.0))) for poses in as_read]
        return replace(self, poses=[np.column_stack(pair) for pair in pairs])


@dataclass(frozen=True, eq=False)
class Explained:
    """The best explanation of a recording: its mistakes, and those of explanations that fit about as well.

    unexplained: share of the way or of the turns, whichever is less, that no matrix explains if it is read so. far: the
    recording is far from the design, and no hypothesis explains it. fit: of the recording as it was read.
    """

    mistakes: tuple[Finding, ...] = ()
    alike: tuple[tuple[Finding, ...], ...] = ()
    unexplained: float = 0.0
    far: bool = False
    fit: FreeFit | None = field(default=None, repr=False)


@dataclass(frozen=True, eq=False)
class _Scored:
    """Mistakes by Eq. (1). remaining: share of the way or of the turns that no matrix explains."""

    score: float
    cost: float
    distance: float
    contradiction: float
    remaining: float
    mistakes: tuple[Finding, ...]

    def leaves(self, distance: float, contradiction: float) -> bool:
        """True if it leaves no larger distance and contradiction, and the wheels explain the motion."""
        return self.remaining < UNRELATED and self.distance <= distance and self.contradiction <= contradiction


def search(recording: Recorded) -> Explained:
    """The mistakes that explain a recording best; none if its matrix is near enough to the design."""
    some = recording.some()
    fit = None if recording.without_headings else some.fit()
    if fit is None:
        return _search_sparse(recording)
    if not fit.gram.any():  # the wheels stand
        return Explained()
    far = DesignDistance(recording.robot)
    distance = far.of(fit)
    contradiction = float(far.contradictions(fit.gram, np.eye(len(fit.gram))[None])[0])
    if distance < _SUSPICIOUS and contradiction < _CONTRADICTING and fit.share < _BADLY:
        return Explained(_contradicting(some), fit=fit)
    suspicious = distance >= _SUSPICIOUS or contradiction >= _CONTRADICTING
    scored = sorted(_scores(some, fit), key=lambda each: each.score)
    present = next(each for each in scored if not each.mistakes)
    usual = _SUSPICIOUS, _CONTRADICTING
    hardly = np.maximum(usual, (_REMAINS * present.distance, _REMAINS * present.contradiction)).tolist()
    best, likelier = None, scored[0].mistakes and scored[0].score <= present.score - _BETTER
    if likelier and scored[0].leaves(*hardly):
        best = scored[0]
    elif suspicious:
        # Something is wrong anyway: a single mistake that leaves nothing of it need only pay for itself.
        single = [each for each in scored[: scored.index(present)] if len(each.mistakes) == 1]
        best = next((each for each in single if each.leaves(*usual)), None)
    if best is None:
        return Explained(unexplained=present.remaining, far=suspicious, fit=fit)
    near = [
        other.mistakes
        for other in scored
        if other is not best and other.mistakes
        if other.score < best.score + _ALIKE or other.score - other.cost < best.score - best.cost + _SAME
    ]
    return Explained(best.mistakes, _other_kinds(best.mistakes, near), unexplained=best.remaining, fit=fit)


def _other_kinds(best: Sequence[Finding], others: Sequence[tuple[Finding, ...]]) -> tuple[tuple[Finding, ...], ...]:
    """The first explanation of every other class, by kinds of mistakes, that is as simple as the best one."""
    classes: dict[frozenset[str], tuple[Finding, ...]] = {}
    for mistakes in others:
        kinds = frozenset(mistake.kind for mistake in mistakes)
        if kinds != {mistake.kind for mistake in best} and len(mistakes) <= max(len(best), 2):
            classes.setdefault(kinds, mistakes)
    return tuple(classes.values())


def _scores(recording: Recorded, fit: FreeFit) -> Iterator[_Scored]:
    """The scores of all hypotheses, without those of fits whose residual alone is beyond any explanation."""
    weight, best = min(fit.windows / _CORRELATED, _MOST_WEIGHED), math.inf
    every = list(readings.wheel_hypotheses(recording.robot, counted=recording.counted))
    transforming = [hypothesis for hypothesis in every if hypothesis.reading is None]
    fitted = [hypothesis for hypothesis in every if hypothesis.reading is not None]
    for free, base, flipped in _bases(recording, fit, fitted):
        residual, remaining = weight * math.log(max(free.share, 1e-9)), float(free.unexplained.min())
        if residual + weight * math.log(_USUAL) > best + _ALIKE:
            continue
        for robot, hypotheses in _combined(recording.robot, free, base, transforming, flipped=flipped):
            far = DesignDistance(robot)
            rows, columns = (np.array([getattr(each, name) for each in hypotheses]) for name in ("rows", "columns"))
            squared = far.squared(*transformed(free, rows, columns))
            against = far.contradictions(free.gram, columns)
            scores = base.cost + residual + squared + weight * np.log(np.hypot(against, _USUAL))
            numbers = zip(hypotheses, scores.tolist(), squared.tolist(), against.tolist(), strict=True)
            for hypothesis, score, distance, share in numbers:
                mistakes, cost = (*base.mistakes, *hypothesis.mistakes), base.cost + hypothesis.cost
                best = min(best, score + hypothesis.cost)
                yield _Scored(score + hypothesis.cost, cost, distance, share, remaining, mistakes)


def _combined(
    robot: Robot, fit: FreeFit, base: Hypothesis, wheels: Sequence[Hypothesis], *, flipped: bool
) -> Iterator[tuple[Robot, Sequence[Hypothesis]]]:
    """Mistakes of the wheels, and of the reference or the robot's file with those, by the design that is meant.

    base: under which the fit was made; beside a reading of the wheels nothing else is tried. Never more than three
    mistakes are made at once.
    """
    simple = [wheel for wheel in wheels if wheel.cost <= _SIMPLE]
    if not flipped:
        yield robot, wheels
        if base.reading is not None:
            return
        for unit in readings.position_units():
            yield robot, [wheel.with_reference(unit) for wheel in simple]
        turned = [
            wheel.with_reference(reference)
            for wheel in simple
            if not wheel.mistakes or wheel.mistakes[0].kind != "wheels_swapped"
            if (reference := readings.turned_reference(robot, fit, wheel.columns)) is not None
        ]
        if turned:
            yield robot, turned
        for hypothesis in () if base.mistakes else readings.design_hypotheses(robot, fit):
            yield hypothesis.robot or robot, [hypothesis]
    for mirrored in readings.reference_hypotheses(flipped):
        yield robot, [wheel.with_reference(mirrored) for wheel in simple]


_Base = tuple[FreeFit, Hypothesis, bool]
"""A fit, the hypothesis under which it was made, and True if its headings had the other sign."""


def _bases(recording: Recorded, fit: FreeFit, wheels: Sequence[Hypothesis]) -> Iterator[_Base]:
    """The fits that hypotheses transform: as recorded, by other headings, and by readings of wheels and steering."""
    plain = readings.plain_hypothesis(recording.robot)
    yield fit, plain, False
    if (mirrored := recording.with_headings(-1.0).fit()) is not None:
        yield mirrored, plain, True
    # Headings in rad hardly begin beyond a whole turn.
    beyond = any(abs(float(poses[0, 2])) > 1.01 * _TURN for poses in recording.poses)
    in_degrees = replace(plain, mistakes=(readings.IN_DEGREES,), cost=0.0 if beyond else _IN_DEGREES)
    degrees, read_as = recording.in_degrees(), [(recording, plain)]
    for factor in (1.0, -1.0):
        if (other := degrees.with_headings(factor).fit()) is not None:
            yield other, in_degrees, factor < 0
            if factor > 0 and (beyond or other.unexplained[1] < fit.unexplained[1] / 2):
                read_as.append((degrees, in_degrees))
    for read, base in read_as:
        for hypothesis in (*wheels, *readings.steering_readings(read.robot, read.logs, read.poses)):
            if (other := read.meant(hypothesis).fit()) is not None:
                mistakes, cost = (*base.mistakes, *hypothesis.mistakes), base.cost + hypothesis.cost
                yield other, replace(hypothesis, mistakes=mistakes, cost=cost), False


def _search_sparse(recording: Recorded) -> Explained:
    """The mistakes that explain sparse poses best, by the misfit of the design's odometry to them."""
    if not any(log.rates.any() for log in recording.logs):
        return Explained()
    positions, robot, moments = recording.without_headings, recording.robot, _Moments.of(recording)
    plain = readings.plain_hypothesis(robot)
    present = float(moments.misfits([plain])[0])
    if not present > _LEAST_MISFIT:  # nan: it hardly moved
        contradicting = _contradicting(recording)
        return moments.off_centre() if positions and not contradicting else Explained(contradicting)
    # Mistakes of the wheels, one of them or none, each with every unit of the positions. Small factors of rates and
    # radii are left to the calibration: sparse poses do not tell them from another design.
    wheels = []
    for wheel in readings.wheel_hypotheses(robot, counted=recording.counted):
        scaled, factors = any(mistake.kind in _SCALES for mistake in wheel.mistakes), np.diag(wheel.columns)
        small = scaled and bool((factors > 1 / _LEAST_FACTOR).all() and (factors < _LEAST_FACTOR).all())
        if wheel.reading is None and not small:
            wheels.append(wheel)
    simple = [wheel for wheel in wheels if not wheel.mistakes or wheel.mistakes[0].kind == "wheel_unit"]
    hypotheses = [*wheels, *(wheel.with_reference(unit) for unit in readings.position_units() for wheel in simple)]
    if positions:
        hypotheses.append(plain.with_reference(readings.mirrored_positions()))
    scored = []
    for radian, headings in ((1.0, ()), (math.pi / 180, (readings.IN_DEGREES,)))[: 1 if positions else 2]:
        for hypothesis, misfit in zip(hypotheses, moments.misfits(hypotheses, radian).tolist(), strict=True):
            scored.append((misfit, hypothesis.cost, (*headings, *hypothesis.mistakes)))
    for hypothesis in readings.steering_scales(robot):
        misfits = _Moments.of(recording.meant(hypothesis)).misfits([plain])
        scored.append((float(misfits[0]), hypothesis.cost, hypothesis.mistakes))
    if present <= _MISFIT and not positions:  # another design misses by as much: only steering is judged
        scored = [each for each in scored if all(mistake.kind.startswith("steering") for mistake in each[2])]
    # The simplest of those that fit about as well as the best one.
    least = np.nanmin([misfit for misfit, _, _ in scored])
    near = [each for each in scored if each[0] <= _AS_GOOD * least + (present / 10 if positions else _MISFIT / 4)]
    misfit, _, mistakes = min(near, key=lambda each: (len(each[2]), each[1], each[0]))
    if not mistakes or misfit >= _EXPLAINED * present or (positions and len(mistakes) > 1):
        return moments.off_centre() if positions else Explained(far=present > _MISFIT)
    alike = [each[2] for each in near if len(each[2]) == len(mistakes)] if positions else []
    return Explained(mistakes, _other_kinds(mistakes, alike))


def _contradicting(recording: Recorded) -> tuple[Finding, ...]:
    """The mistake of one steered wheel without which the wheels agree about the motion; empty if there is none."""
    if max(recording.robot.drive.pairs, default=-1) < 1:
        return ()
    signals = np.concatenate([log.signals for log in recording.logs])
    lengths = np.concatenate([np.diff(log.times, prepend=0.0) for log in recording.logs])
    gram, far = (signals.T * lengths) @ signals, DesignDistance(recording.robot)
    present = far.contradictions(gram, np.eye(len(gram))[None])[0]
    if present <= _CONTRADICTING / 3:
        return ()
    steering = []
    for hypothesis in readings.wheel_hypotheses(recording.robot):
        options = [option for mistake in hypothesis.mistakes for option in mistake.changes]
        if hypothesis.reading is None and any(option.startswith("steering") for option in options):
            steering.append(hypothesis)
    shares = far.contradictions(gram, np.array([hypothesis.columns for hypothesis in steering]))
    best = int(shares.argmin())
    return steering[best].mistakes if shares[best] < _EXPLAINED * present else ()


@dataclass(frozen=True, eq=False)
class _Moments:
    """Runs at S moments, between which the robot turns by a radian.

    odometry: of the logs, at these moments. poses (S, 3): of the reference, at these moments. starts (S, 3): pose of
    the reference at the begin of each moment's run.
    """

    recording: Recorded
    odometry: OdometryBatch
    poses: Array
    starts: Array

    @classmethod
    def of(cls, recording: Recorded) -> _Moments:
        """The moments of some runs from first to last."""
        few = np.linspace(0, len(recording.logs) - 1, min(len(recording.logs), _MOST_RUNS))
        logs, poses = [], []
        row_3 = recording.robot.inverse_kinematic_matrix[2]
        for index in np.unique(few.round().astype(int)).tolist():
            log, of_run = recording.logs[index], recording.poses[index]
            turned = np.cumsum((log.signals @ row_3) * np.diff(log.times, prepend=0.0))
            headings = np.interp(log.stamps, np.append(0.0, log.times), np.append(0.0, turned))
            numbers = np.floor(np.abs(headings - headings[0])).astype(int)
            seen = np.unique([*np.flatnonzero(np.diff(numbers, prepend=0))[:_MOST_STAMPS], len(headings) - 1])
            if recording.without_headings:
                seen = np.unique(np.linspace(0, len(headings) - 1, _MOST_POSITIONS).round().astype(int))
            logs.append(replace(log, start=np.zeros(3), stamps=log.stamps[seen]))
            poses.append(np.vstack([of_run[:1], of_run[seen]]))
        odometry = OdometryBatch(logs, "arc")
        starts = np.array([of_run[0] for of_run in poses])[odometry.trajectory]
        return cls(recording, odometry, np.concatenate([of_run[1:] for of_run in poses]), starts)

    @property
    def first(self) -> NDArray[np.bool_]:
        """True (S,) for the first moment of a run."""
        return np.diff(self.odometry.trajectory, prepend=-1) > 0

    def misfits(self, hypotheses: Sequence[Hypothesis], radian: float = 1.0) -> Array:
        """Misfits (P,) of the design to the poses under hypotheses, from 0 (exact) to 1 (unrelated).

        radian: unit of the recorded headings. NaN where the robot hardly moved: at rest it fits any matrix.
        """
        robot, columns = self.recording.robot, np.array([each.columns for each in hypotheses])
        odometry = self.odometry.poses(robot.inverse_kinematic_matrix @ np.linalg.inv(columns))
        metres = np.array([each.rows[0, 0] for each in hypotheses])[:, None]
        moved = self.poses - self.starts
        path = metres * (moved[:, 0] + 1j * moved[:, 1]) * np.exp(-1j * radian * self.starts[:, 2])
        driven = odometry[..., 0] + 1j * odometry[..., 1]
        firsts, run = np.flatnonzero(self.first), self.odometry.trajectory
        if self.recording.without_headings:
            # From the first position of each run, which is turned to fit; and seen in a mirror.
            path = np.where([[np.linalg.det(each.rows[:2, :2]) < 0] for each in hypotheses], path.conj(), path)
            driven = driven - driven[:, firsts][:, run]
            path = path * np.exp(1j * np.angle(np.add.reduceat(driven * path.conj(), firsts, axis=1)))[:, run]
        turned = self._turns(odometry[..., 2])
        # Whole turns between two moments do not show in the headings, and are no reason for a larger error.
        missed = wrapped(turned - self._turns(radian * moved[:, 2]))
        lengths = (np.abs(driven) + np.abs(path)).sum(axis=1)
        by_wheels = np.minimum(np.abs(turned), _TURN)
        angles = (by_wheels + np.minimum(np.abs(turned - missed), _TURN)).sum(axis=1)
        # Noise and slip may amount to a radian and the robot's size at every moment, and to more while it turns.
        count, rims, size = len(moved), by_wheels.sum(axis=1), robot.reach
        position = np.abs(driven - path).sum(axis=1) / (lengths + size * (rims + count))
        heading = np.abs(missed).sum(axis=1) / (angles + count)
        at_rest = lengths < len(firsts) * size
        if self.recording.without_headings:
            return np.where(at_rest, np.nan, position)
        return np.where(at_rest & (angles < len(firsts)), np.nan, np.maximum(position, heading))

    def off_centre(self) -> Explained:
        """The mistake of a tracked point off the centre, by positions in frames that each run may have turned.

        Runs of one motion tell how far the point is ahead, or behind, but not which: such points are named alike. None
        is where the point is near or not known, or where the design fits about as well without it.
        """
        robot = self.recording.robot
        reach, count = robot.reach, len(usual_changes(robot))
        exact, nothing = _EXACT * reach, np.zeros(count + 2)
        starts = [np.append(nothing[:count], np.multiply(signs, reach / 2)) for signs in product((1, -1), repeat=2)]
        deviation = max(self._missed(nothing), exact)
        at_first = [self._fitted(start, deviation, count + 2)[0] for start in starts]
        deviation = max(min(map(self._missed, at_first)), exact)
        points = [self._fitted(start, deviation, count + 2) for start in at_first]
        least = min(cost for _, cost, _ in points)
        likely = [point for point in points if point[1] < least + _FITTED_POINT]
        values, cost, error = max(likely, key=lambda point: float(point[0][count]))  # trackers mostly stand ahead
        without, dearer, _ = self._fitted(nothing, deviation, count)
        close = max(self._missed(values), exact) < _REMAINS * self._missed(without)
        mistake = readings.another_mount(robot, values[count:])
        if mistake is None or not close or dearer - cost < _FITTED_POINT or error > np.hypot(*values[count:]) / 2:
            return Explained()
        distinct, alike = [values[count:]], list[tuple[Finding, ...]]()
        for point in (other[count:] for other, _, _ in likely):
            if min(np.hypot(*(point - other)) for other in distinct) > _APART * reach:
                distinct.append(point)
                if (other := readings.another_mount(robot, point)) is not None:
                    words = f"{other.what}, which runs that drive ahead and then turn on the spot would tell"
                    alike.append((other.model_copy(update={"what": words}),))
        return Explained((mistake,), tuple(alike))

    def _fitted(self, start: Array, deviation: float, free: int) -> tuple[Array, float, float]:
        """Values as in _misses by maximum a posteriori, -2 log(density), and the standard error of the tracked point.

        free: number of the first values that are fitted, the others stay 0. deviation: of the positions, m.
        """
        from scipy.optimize import least_squares  # slow to import

        count, as_one = len(start) - 2, max(_CORRELATED, len(self.poses) / _MOST_WEIGHED)
        steps = 1e-4 * np.append(np.ones(count), [self.recording.robot.reach] * 2)[:free]

        def residuals(values: Array) -> Array:
            """Residuals (P, 2 S + J) of values (P, free), in standard deviations."""
            whole = np.pad(values, ((0, 0), (0, len(start) - free)))
            off = self._misses(whole) / (deviation * math.sqrt(as_one))
            return np.hstack([off.real, off.imag, whole[:, :count]])

        def slopes(values: Array) -> Array:
            moved = residuals(np.vstack([values, values + np.diag(steps)]))
            return ((moved[1:] - moved[0]) / steps[:, None]).T

        solution = least_squares(
            lambda values: residuals(values[None])[0], start[:free], slopes,
            loss="soft_l1", x_scale=100 * steps, max_nfev=15,
        )  # fmt: skip
        covariance = np.linalg.pinv(solution.jac.T @ solution.jac + 1e-9 * np.eye(free))[count:, count:]
        error = math.sqrt(float(np.linalg.eigvalsh(covariance)[-1])) if free > count else 0.0
        return np.pad(solution.x, (0, len(start) - free)), 2 * float(solution.cost), error

    def _missed(self, values: Array) -> float:
        """The median distance of the positions from the odometry of values (J + 2,), m."""
        return float(np.median(np.abs(self._misses(values[None]))))

    def _misses(self, values: Array) -> Complex:
        """Differences (P, S) of the positions from the odometry, m, with each run moved and turned to fit.

        values (P, J + 2): changes of the design in standard deviations, and x and y of the tracked point, m.
        """
        robot, run = self.recording.robot, self.odometry.trajectory
        changes = np.tensordot(values[:, :-2], usual_changes(robot), 1)
        poses = self.odometry.poses(robot.inverse_kinematic_matrix + changes)
        point = (values[:, -2] + 1j * values[:, -1])[:, None]
        firsts, counts = np.flatnonzero(self.first), np.bincount(run)
        places = [poses[..., 0] + 1j * poses[..., 1] + point * np.exp(1j * poses[..., 2])]
        places.append((self.poses[:, 0] + 1j * self.poses[:, 1])[None])
        driven, seen = (place - (np.add.reduceat(place, firsts, axis=1) / counts)[:, run] for place in places)
        angles = np.angle(np.add.reduceat(driven * seen.conj(), firsts, axis=1))
        return driven - seen * np.exp(1j * angles)[:, run]

    def _turns(self, headings: Array) -> Array:
        """Turns (..., S) since the moment before from headings since the start."""
        return headings - np.where(self.first, 0.0, np.roll(headings, 1, axis=-1))
