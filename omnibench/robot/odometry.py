"""Odometry from drive signals: many trajectories and candidates at once, or one sample at a time.

With a(k) the signals of sample k times its duration (rad: wheel angles, for most robots), C(k) their sum up to sample k
and m3 row 3 of the matrix, the heading is theta(k) = theta(0) + m3.C(k), and sample k moves the robot by

    dx + i dy = (m1 + i m2).a(k) * s * exp(i psi),

Euler step, Eq. (1) and (2) of Palacin et al. 2023: psi = theta(k-1) and s = 1. Arc, the exact path at constant twist:
psi = theta(k-1) + h and s = sin(h)/h with h = m3.a(k)/2. For a given row 3 positions are linear in rows 1 and 2.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, wraps
from itertools import accumulate, pairwise
from typing import Any, Final, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array, Drive, in_the_middle

Integration = Literal["euler", "arc"]
Complex = NDArray[np.complex128]
Numbers = TypeVar("Numbers", Array, Complex, NDArray[np.intp])

T = TypeVar("T")

DIGITS = 8  # of the digest of samples: a run is taken for one of 1000 others in 1 of 4 million cases
_UNCHANGED: Final = object()  # stands for an array that ``replace`` leaves alone
_LAST = 5  # samples whose mean rate continues a log after its last sample; chosen
_BLOCK = 120_000  # samples at a time (candidates x samples), so that temporaries stay in the processor's cache


class Samples:
    """Wheel samples of one run, a handle that its Trajectory and its WheelLogs share.

    arrays: by their names in Trajectory, each an array, None or a function that reads it when it is asked for. A class
    that holds the handle has the arrays as attributes and takes them in its constructor; ``dataclasses.replace`` passes
    the handle on, so that replacing anything else reads no samples.
    size: number and end (s) of the samples, where they are known without reading.
    """

    def __init__(self, arrays: Mapping[str, Any], size: tuple[int, float] | None = None) -> None:
        self._arrays, self._size = dict(arrays), size
        self._signals: tuple[Drive, Array] | None = None

    def array(self, name: str) -> Any:
        """The array called ``name``: times (F,), rates (F, N), steering, angles, targets or odometry; or None."""
        value = self._arrays.get(name)
        return value() if callable(value) else value

    def has(self, name: str) -> bool:
        """True if there is an array called ``name``."""
        return self._arrays.get(name) is not None

    def contents(self) -> dict[str, Any]:
        """All arrays by their names, which are read where they stand in a file."""
        return {name: self.array(name) for name in sorted(self._arrays)}

    @property
    def held(self) -> bool:
        """True if all arrays are in memory."""
        return not any(map(callable, self._arrays.values()))

    @property
    def count(self) -> int:
        """Number of samples, F."""
        return self._size[0] if self._size else len(self.array("times"))

    @property
    def end(self) -> float:
        """End of the last sample, s."""
        return self._size[1] if self._size else float(self.array("times")[-1])

    @cached_property
    def period(self) -> float:
        """The median time between samples, the run's start being the first, s."""
        return float(np.median(np.diff(self.array("times"), prepend=0.0)))

    @cached_property
    def digest(self) -> str:
        """The first 8 hex digits of the SHA-256 of times, rates and steering angles."""
        arrays = [self.array(name) for name in ("times", "rates", "steering")]
        return digest_of(*(array for array in arrays if array is not None))[:DIGITS]

    def summarise(self) -> None:
        """Compute period and digest now, of samples that would have to be read again for it."""
        _ = self.held or (self.period, self.digest)

    def signals(self, drive: Drive | None) -> Array:
        """Drive signals (F, M), rad/s: the rates, or what ``drive`` makes of them and the steering angles."""
        rates: Array = self.array("rates")
        if drive is None or drive.direct:
            return rates
        if self._signals is None or self._signals[0] is not drive:
            signals = drive.signals(rates, in_the_middle(self.array("steering")))
            if not self.held:
                return signals
            self._signals = drive, signals
        return self._signals[1]

    def changed(self, arrays: Mapping[str, Any]) -> Samples:
        """These samples with other arrays in the place of some, by name."""
        return Samples(self._arrays | dict(arrays), None if "times" in arrays else self._size) if arrays else self

    def followed(self, row: Mapping[str, Any]) -> Samples:
        """These samples and one more, for which ``row`` has the values of some of the arrays."""
        arrays = {name: partial(_followed, self, name, value) for name, value in row.items()}
        longer = Samples(arrays, (self.count + 1, float(row["times"])))
        return longer.loaded() if self.held else longer

    def loaded(self) -> Samples:
        """These samples in memory."""
        return self if self.held else Samples({name: self.array(name) for name in self._arrays})


def _followed(samples: Samples, name: str, value: Any) -> Array:
    return np.concatenate([samples.array(name), np.array(value)[None]])


def digest_of(*contents: Any) -> str:
    """SHA-256, in hex digits, of arrays of numbers, or bytes, one after another."""
    digest = hashlib.sha256()
    for content in contents:
        digest.update(content if isinstance(content, bytes) else np.ascontiguousarray(content, dtype=float).tobytes())
    return digest.hexdigest()


def with_samples(*names: str, **renamed: str) -> Callable[[type[T]], type[T]]:
    """Class decorator: a dataclass takes some fields as arrays and holds them by a handle in its field ``samples``.

    names: the fields, which are called in the handle as they are here. renamed: fields, with their names in the handle.
    ``dataclasses.fields`` lists ``samples`` in their place.
    """
    in_handle = {name: name for name in names} | renamed

    def decorate(cls: type[T]) -> type[T]:
        make: Callable[..., None] = cls.__init__
        for attribute, name in in_handle.items():
            setattr(cls, attribute, _array_of_samples(name))
            cls.__dataclass_fields__.pop(attribute)  # type: ignore[attr-defined]

        @wraps(make)
        def construct(self: Any, *arguments: Any, samples: Samples | None = None, **given: Any) -> None:
            unchanged = {} if samples is None else dict.fromkeys(in_handle, _UNCHANGED)
            make(self, *arguments, **(unchanged | given))
            arrays = vars(self).pop("_given", {})
            vars(self)["samples"] = Samples(arrays) if samples is None else samples.changed(arrays)

        cls.__init__ = construct  # type: ignore[method-assign]
        return cls

    return decorate


def _array_of_samples(name: str) -> property:
    """Attribute whose value is an array of the instance's samples."""

    def read(instance: Any) -> Any:
        return instance.samples.array(name)

    def write(instance: Any, value: Any) -> None:  # by the constructor alone: the classes are frozen
        if value is not _UNCHANGED:
            vars(instance).setdefault("_given", {})[name] = value

    return property(read, write)


@with_samples("times", "rates", "steering", wheel_angles="angles")
@dataclass(frozen=True, eq=False)
class WheelLog:
    """Input of odometry for one trajectory.

    times (F,): end of each sample, s, increasing, > 0. rates (F, N): mean wheel rates over each sample, rad/s.
    start (3,): pose at t = 0 (m, m, rad). stamps (S,): when poses are wanted, s, increasing, >= 0.
    Needed by some effects only, None if unknown: wheel_angles (F, N): absolute, at the end of each sample, rad.
    started_at: s since the session's start. session: its name.
    Of robots with W wheels whose steering angles are measured: steering (F, W): at the end of each sample, rad.
    drive: makes drive signals of rates and steering angles; None where the rates are the signals.
    """

    times: Array
    rates: Array
    start: Array
    stamps: Array
    wheel_angles: Array | None = None
    started_at: float | None = None
    session: str | None = None
    steering: Array | None = None
    drive: Drive | None = None
    samples: Samples = field(default=Samples({}), kw_only=True, repr=False)

    @property
    def middle_steering(self) -> Array | None:
        """Steering angles (F, W) in the middle of each sample, rad; None where none are measured."""
        return None if self.steering is None else in_the_middle(self.steering)

    @property
    def signals(self) -> Array:
        """Drive signals (F, M): the rates, or what they and the steering angles make."""
        return self.samples.signals(self.drive)

    def continued(self, until: float) -> WheelLog:
        """The log with one more sample of the last mean rate up to ``until`` (s), where its samples end before.

        The robot drives on after the last sample: a path that stopped there would have a kink.
        """
        if until <= self.samples.end:
            return self
        rate = self.rates[-_LAST:].mean(axis=0)
        row: dict[str, Any] = {"times": until, "rates": rate}
        if self.wheel_angles is not None:
            row["angles"] = self.wheel_angles[-1] + rate * (until - self.samples.end)
        if self.steering is not None:
            row["steering"] = self.steering[-1]
        return replace(self, samples=self.samples.followed(row))


@dataclass(frozen=True, eq=False)
class RunSamples:
    """The wheel samples of Z runs one after another, F in all.

    times (F,): end of each sample, s from the start of its run. edges (Z + 1,): the first sample of each run, and F.
    """

    times: Array
    edges: NDArray[np.intp]

    @classmethod
    def of(cls, times: Sequence[Array]) -> RunSamples:
        """The samples of runs from the times (F,) at which the samples of each run end, s from its start."""
        return cls(np.concatenate(times), np.cumsum([0, *map(len, times)]))

    @cached_property
    def run_of_sample(self) -> NDArray[np.intp]:
        """Index (F,) of the run of each sample."""
        return np.repeat(np.arange(len(self.edges) - 1), np.diff(self.edges))

    @cached_property
    def begins(self) -> Array:
        """Begin (F,) of each sample, s from the start of its run."""
        return self.before(self.times)

    @cached_property
    def durations(self) -> Array:
        """Durations (F,) of the samples, s."""
        return self.times - self.begins

    def before(self, values: Numbers) -> Numbers:
        """Values (F, ...) of the sample before each sample; 0 of the first ones of the runs."""
        before = np.empty_like(values)
        before[1:] = values[:-1]
        before[self.edges[:-1]] = 0.0
        return before

    def sums(self, values: Numbers) -> Numbers:
        """Sums (F, ...) of values (F, ...) up to the end of each sample, from the start of its run."""
        sums = np.empty_like(values)
        for low, high in pairwise(self.edges.tolist()):
            np.cumsum(values[low:high], axis=0, out=sums[low:high])
        return sums

    def locate(self, stamps: Sequence[Array]) -> tuple[NDArray[np.intp], Array]:
        """The sample that contains each stamp of each run, and the share of it before then: both (S,), of all runs.

        Stamps before the start are at it, those after the last sample at its end.
        """
        runs = zip(pairwise(self.edges.tolist()), stamps, strict=True)
        sample = np.concatenate([low + self.times[low : high - 1].searchsorted(of_run) for (low, high), of_run in runs])
        begins = self.begins[sample]
        share = np.clip((np.concatenate(stamps) - begins) / (self.times[sample] - begins), 0.0, 1.0)
        return sample, share


def split_by(values: Numbers, parts: Sequence[Array]) -> list[Numbers]:
    """Values (S, ...) of all runs, cut into those of each run, of which one of the parts (K, ...) is as long."""
    return [values[low:high] for low, high in pairwise(accumulate(map(len, parts), initial=0))]


class OdometryBatch:
    """Poses of several trajectories at their stamps, for any number of candidate matrices.

    A stamp within a sample is reached by constant twist from the sample's start; one after the last sample has the
    pose at the end of the last sample.

    trajectory (S,): index of the log of each stamp. driven (S, M): integrals of the signals up to each stamp, rad.
    """

    def __init__(self, logs: Sequence[WheelLog], integration: Integration) -> None:
        self.integration: Integration = integration
        self.trajectory = np.repeat(np.arange(len(logs)), [len(log.stamps) for log in logs])
        samples = RunSamples.of([log.times for log in logs])
        located, share = samples.locate([log.stamps for log in logs])
        self._sample = located - samples.edges[self.trajectory]
        counts = [int(of_run[-1]) + 1 for of_run in split_by(self._sample, [log.stamps for log in logs])]
        shape = (len(logs), max(counts), logs[0].signals.shape[1])
        self._angles = np.zeros(shape)  # a(k); zeros after a trajectory's last sample move nothing
        for row, (log, count) in enumerate(zip(logs, counts, strict=True)):
            durations = samples.durations[samples.edges[row] :][:count]
            self._angles[row, :count] = log.signals[:count] * durations[:, None]
        self._before = np.zeros(shape)  # C(k-1)
        np.cumsum(self._angles[:, :-1], axis=1, out=self._before[:, 1:])
        # The part of a sample that lies before its stamp.
        self._piece = share[:, None] * self._angles[self.trajectory, self._sample]
        self._piece_before = self._before[self.trajectory, self._sample]
        self.driven = self._piece_before + self._piece
        self._start = np.array([log.start for log in logs])[self.trajectory]
        self._turn = np.exp(1j * self._start[:, 2])
        self._one_stamp_each = all(len(log.stamps) == 1 for log in logs)
        if self._one_stamp_each:  # then the last sample can be cut to its stamp, and all is one sum
            self._angles[self.trajectory, self._sample] = self._piece
        self._angles_by_wheel = np.ascontiguousarray(np.swapaxes(self._angles, 1, 2))
        self._phase = self._phase_basis(self._angles, self._before)

    def poses(self, matrices: Array) -> Array:
        """Poses (P, S, 3) in m, m, rad of candidate matrices (P, 3, M). Headings are not wrapped."""
        result = np.empty((len(matrices), len(self.trajectory), 3))
        result[..., 2] = self._start[:, 2] + matrices[:, 2] @ self.driven.T
        block = max(1, _BLOCK // (self._angles.shape[0] * self._angles.shape[1]))
        displacement = self._final_displacement if self._one_stamp_each else self._displacement
        for first in range(0, len(matrices), block):
            part = slice(first, first + block)
            path = displacement(matrices[part]) * self._turn
            result[part, :, 0] = self._start[:, 0] + path.real
            result[part, :, 1] = self._start[:, 1] + path.imag
        return result

    def jacobian(self, matrix: Array) -> Array:
        """Derivatives (S, 3, 3, M) of the poses (x, y, theta) with respect to the elements of one matrix (3, M)."""
        row_12, row_3 = self._at_stamps(
            self._slopes(self._angles, self._before, matrix), self._slopes(self._piece, self._piece_before, matrix)
        )
        return self._as_jacobian(row_12, row_3, self.driven)

    def _as_jacobian(self, row_12: Complex, row_3: Complex, driven: Array) -> Array:
        """Derivatives (S, 3, 3, M) from those of x + iy (S, M) by m1 + i m2 and by m3 in the frames of the starts."""
        row_12, row_3 = row_12 * self._turn[:, None], row_3 * self._turn[:, None]
        jacobian = np.zeros((len(driven), 3, 3, driven.shape[1]))
        jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 0, 2] = row_12.real, -row_12.imag, row_3.real
        jacobian[:, 1, 0], jacobian[:, 1, 1], jacobian[:, 1, 2] = row_12.imag, row_12.real, row_3.imag
        jacobian[:, 2, 2] = driven
        return jacobian

    def position_design(self, headings: Iterable[Array]) -> Complex:
        """Regressors (S, M) of (x - x0) + i(y - y0) on m1 + i m2 for given headings.

        headings: for each log (F,), the absolute heading at the start of each sample, rad.
        """
        turn: Complex = np.ones(self._angles.shape[:2], dtype=complex)
        for row, values in enumerate(headings):
            count = min(len(values), turn.shape[1])
            turn[row, :count] = np.exp(1j * values[:count])
        piece_turn: Complex = turn[self.trajectory, self._sample]
        (design,) = self._at_stamps([self._angles * turn[..., None]], [self._piece * piece_turn[:, None]])
        return design

    def _phase_basis(self, angles: Array, before: Array) -> Array:
        """Integrals of signals (..., M) whose product with m3 is psi, relative to the start heading."""
        return before + angles / 2 if self.integration == "arc" else before

    def _final_displacement(self, matrices: Array) -> Complex:
        """x + iy (P, S) relative to the start, each trajectory having one stamp, at the end of its samples."""
        psi = np.tensordot(self._phase, matrices[:, 2], (2, 1))  # (T, F, P)
        cosine, sine = np.cos(psi), np.sin(psi)
        if self.integration == "arc":
            stretch = chord_shares(np.tensordot(self._angles, matrices[:, 2] / 2, (2, 1)))
            cosine *= stretch
            sine *= stretch
        moved = self._angles_by_wheel @ cosine + 1j * (self._angles_by_wheel @ sine)  # (T, N, P)
        return np.einsum("tnp,pn->pt", moved, matrices[:, 0] + 1j * matrices[:, 1])

    def _displacement(self, matrices: Array) -> Complex:
        """x + iy (P, S) relative to the start, at any stamps."""
        paths = []
        for matrix in matrices:
            whole = self._steps(self._angles, self._before, matrix)[..., None]
            piece = self._steps(self._piece, self._piece_before, matrix)[..., None]
            paths.append(self._at_stamps([whole], [piece])[0][:, 0])
        return np.array(paths)

    def _at_stamps(self, whole: Sequence[Complex], pieces: Sequence[Complex]) -> tuple[Complex, ...]:
        """Sums (S, n) of the whole samples (T, F, n) before each stamp and the piece (S, n) of the stamp's sample."""
        sums = []
        for samples, piece in zip(whole, pieces, strict=True):
            total = np.cumsum(samples, axis=1)
            before = np.where((self._sample > 0)[:, None], total[self.trajectory, np.maximum(self._sample - 1, 0)], 0.0)
            sums.append(before + piece)
        return tuple(sums)

    def _steps(self, angles: Array, before: Array, matrix: Array) -> Complex:
        """dx + i dy of every sample, relative to the start heading."""
        rotation, stretch, _ = self._rotation(angles, before, matrix)
        return (angles @ (matrix[0] + 1j * matrix[1])) * stretch * rotation

    def _slopes(self, angles: Array, before: Array, matrix: Array) -> tuple[Complex, Complex]:
        """Derivatives of the steps with respect to m1 + i m2 and to m3, each (..., M)."""
        rotation, stretch, bend = self._rotation(angles, before, matrix)
        row_12 = angles * (stretch * rotation)[..., None]
        velocity = (angles @ (matrix[0] + 1j * matrix[1])) * rotation
        phase = self._phase_basis(angles, before)
        row_3 = velocity[..., None] * (1j * stretch[..., None] * phase + bend[..., None] * angles / 2)
        return row_12, row_3

    def _rotation(self, angles: Array, before: Array, matrix: Array) -> tuple[Complex, Array, Array]:
        """exp(i psi), s and ds/dh of every sample, relative to the start heading."""
        rotation = np.exp(1j * (self._phase_basis(angles, before) @ matrix[2]))
        if self.integration == "euler":
            return rotation, np.ones(rotation.shape), np.zeros(rotation.shape)
        half_turn = angles @ matrix[2] / 2
        return rotation, chord_shares(half_turn), _sinc_slope(half_turn)


class OdometryStream:
    """Odometry one sample at a time: ``drive`` advances ``pose`` (3,) in m, m, rad.

    moved (3,): the last sample's motion in the robot's frame, m, m, rad. doubts (3, r): its standard deviations, in r
    independent directions, by what effects extrapolate; None where nothing is extrapolated. driven (M,): integrals of
    its signals, rad, without effects. frame_heading: the heading of the stream's frame in the reference's, rad; effects
    of the world act along the axes of the reference.
    """

    def __init__(
        self, matrix: Array, integration: Integration, start: Array | None = None, signals: Drive | None = None
    ) -> None:
        self.matrix = matrix
        self.integration: Integration = integration
        self._steered_drive = None if signals is None or signals.direct else signals
        self._steering: Array | None = None
        self.pose = np.zeros(3) if start is None else np.array(start, dtype=float)
        self.moved = np.zeros(3)
        self.driven: Array = np.zeros(matrix.shape[1])
        self.doubts: Array | None = None
        self.frame_heading = 0.0

    def drive(
        self,
        angles: Array,
        duration: float | None = None,  # noqa: ARG002
        wheel_angles: Array | None = None,  # noqa: ARG002
        steering: Array | None = None,
    ) -> Array:
        """Advance by one sample in which the wheels turned by ``angles`` (N,), rad, and return the new pose (3,).

        steering (W,): angles of the steered wheels at the sample's end, rad. Models with effects use the others, too:
        duration, s, of the sample; wheel_angles (N,): absolute, at the sample's end, rad, default: counted from 0.
        ValueError: a model with effects is given no duration, or a robot that steers no steering angles.
        """
        self.driven = self.driven_signals(angles, self.steer(steering))
        self.moved = self.matrix @ self.driven
        self.pose = advance(self.pose, self.moved, self.integration)
        return self.pose

    def steer(self, steering: Array | None) -> Array | None:
        """Steering angles (W,) in the middle of the next sample, which ends at the angles ``steering`` (W,), rad.

        The first sample holds its own. None for a robot that does not steer. ValueError: it steers, and they are None.
        """
        if self._steered_drive is None:
            return None
        if steering is None:
            raise ValueError("the robot steers, and its steering angles are missing")
        steering = np.array(steering, dtype=float)
        before, self._steering = self._steering, steering
        return steering if before is None else (before + steering) / 2

    def driven_signals(self, angles: Array, steering: Array | None) -> Array:
        """Integrals (M,) of the signals of a sample in which the wheels turn by ``angles`` (N,) rad."""
        if self._steered_drive is None:
            return angles
        assert steering is not None  # the robot steers
        return self._steered_drive.signals(np.asarray(angles)[None], steering[None])[0]


def advance(pose: Array, moved: Array, integration: Integration) -> Array:
    """The pose (3,) after a motion (3,) in the robot's frame, m, m, rad, by an Euler step or an arc."""
    x, y, heading = pose.tolist()
    moved_x, moved_y, turned = moved.tolist()
    direction = heading
    if integration == "arc":
        half_turn = turned / 2
        direction += half_turn
        stretch = math.sin(half_turn) / half_turn if half_turn else 1.0
        moved_x, moved_y = moved_x * stretch, moved_y * stretch
    cosine, sine = math.cos(direction), math.sin(direction)
    return np.array([x + moved_x * cosine - moved_y * sine, y + moved_x * sine + moved_y * cosine, heading + turned])


def chord_shares(half_turns: Array) -> Array:
    """sin(h)/h: the chord of an arc as a share of its length, for halves h of the angles that it turns by, rad."""
    shares: Array = np.ones(np.shape(half_turns))
    return np.divide(np.sin(half_turns), half_turns, out=shares, where=half_turns != 0)


def _sinc_slope(angle: Array) -> Array:
    """d/dh of sin(h)/h; by its series near 0, where the quotient loses digits."""
    small = np.abs(angle) < 1e-2
    safe = np.where(small, 1.0, angle)
    exact = (safe * np.cos(safe) - np.sin(safe)) / safe**2
    return np.where(small, angle * (-1 / 3 + angle**2 * (1 / 30 - angle**2 / 840)), exact)


class PathBatch:
    """The paths of Z runs, F samples in all, one run after another.

    starts (Z, 3): poses at t = 0. moved (F, 3): motion in the robot's frame, m, m, rad. drift (F, 2): further
    displacement in the reference's frame, m; None for none.
    """

    def __init__(
        self, samples: RunSamples, starts: Array, moved: Array, integration: Integration, drift: Array | None = None
    ) -> None:
        self._samples, self._arc, self._moved = samples, integration == "arc", moved
        self._drift: Complex | None = None if drift is None else drift[:, 0] + 1j * drift[:, 1]
        run_of_sample = samples.run_of_sample
        self._headings = starts[run_of_sample, 2] + samples.before(samples.sums(moved[:, 2]))
        steps = self._steps(moved, self._headings)
        if self._drift is not None:
            steps += self._drift
        sums, places = samples.sums(steps), (starts[:, 0] + 1j * starts[:, 1])[run_of_sample]
        self._positions: Complex = places + samples.before(sums)
        self._after: Complex = places + sums

    @cached_property
    def middles(self) -> Array:
        """Means (F, 3) of the poses before and after each sample."""
        places = (self._positions + self._after) / 2
        return np.column_stack([places.real, places.imag, self._headings + self._moved[:, 2] / 2])

    @property
    def ends(self) -> list[Array]:
        """Poses (F + 1, 3) of each run at its start and at the end of each sample."""
        before = np.column_stack([self._positions.real, self._positions.imag, self._headings])
        after = np.column_stack([self._after.real, self._after.imag, self._headings + self._moved[:, 2]])
        return [np.vstack([before[low : low + 1], after[low:high]]) for low, high in pairwise(self._samples.edges)]

    def poses(self, stamps: Sequence[Array]) -> list[Array]:
        """Poses (S, 3) of each run in m, m, rad at stamps (S,) in s, in any order; headings are not wrapped.

        Before t = 0 it is the start pose, after the last sample the pose at its end.
        """
        sample, share = self._samples.locate(stamps)
        piece = share[:, None] * self._moved[sample]
        heading = self._headings[sample]
        position = self._positions[sample] + self._steps(piece, heading)
        if self._drift is not None:
            position = position + share * self._drift[sample]
        poses = np.column_stack([position.real, position.imag, heading + piece[:, 2]])
        return split_by(poses, stamps)

    def lengths(self, stamps: Sequence[Array]) -> list[Array]:
        """Distances driven along each path, backwards too, up to stamps (S,) in s, in any order, m."""
        samples = self._samples
        sample, share = samples.locate(stamps)
        moved: Complex = self._moved[:, 0] + 1j * self._moved[:, 1]
        if self._drift is not None:
            moved = moved + self._drift * np.exp(-1j * self._headings)
        speeds = np.abs(moved)
        return split_by(samples.before(samples.sums(speeds))[sample] + share * speeds[sample], stamps)

    def _steps(self, moved: Array, headings: Array) -> Complex:
        """x + iy of motions (n, 3) that begin with headings (n,)."""
        turned = headings + moved[:, 2] / 2 if self._arc else headings
        cosine, sine = np.cos(turned), np.sin(turned)
        steps: Complex = np.empty(len(moved), dtype=complex)
        steps.real = moved[:, 0] * cosine - moved[:, 1] * sine
        steps.imag = moved[:, 0] * sine + moved[:, 1] * cosine
        if self._arc:
            steps *= chord_shares(moved[:, 2] / 2)
        return steps
