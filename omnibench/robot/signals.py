"""Signals that a correction may depend on: causal quantities of every wheel sample, equal in batch and in a stream."""

from __future__ import annotations

import cmath
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.kinematics import Array, Robot, compose
from omnibench.robot.odometry import PathBatch, RunSamples, WheelLog, advance

_STANDING = 1e-4  # m/s: a slower caster stands; and a way of its direction, of length 1, that is none; chosen
STILL = 1e-3  # rad/s: a slower wheel counts as standing; chosen
_SMOOTHING = 0.05  # s, time constant of the smoothed twist whose derivative is the acceleration; chosen
# rad, half of the angle that a steering motor turns back before it takes the wheel along: above the noise and the steps
# of usual encoders, and within the play of usual gears; chosen
_TAKE_UP = 0.01
_TRAIL = 0.05  # m, from a caster's pivot back to where its wheel touches the floor; chosen, as of small robots
# Servos that commanded steering angles may have, one a time constant, s, and one a limit of the rate, rad/s: from those
# of model cars (60 deg in 0.1 to 0.2 s at the arm, less at the wheels) to those of trucks; each twice the one before.
SERVO_LAGS = (0.05, 0.1, 0.2, 0.4)
SERVO_RATES = (0.5, 1.0, 2.0, 4.0, 8.0)
_REVERSED = 0.05  # length of a caster's mean direction below which the side that it swings to is chance; chosen


@dataclass(frozen=True, eq=False, slots=True)
class Signals:
    """F wheel samples as recorded; every quantity is computed from the uncorrected rates.

    durations (F,): s. rates (F, N): mean wheel rates, rad/s. steering (F, S): steering angles in the middle of the
    sample, rad; None if the robot does not steer. elapsed (F,): s from the start of the run to the middle of the
    sample. twists (F, 3): of the robot's centre by the model's matrix, m/s, m/s, rad/s. accelerations (F, 3):
    derivatives of the twists, smoothed over 50 ms, from rest before the first sample. travelled (F,): distance since
    the robot last stood still, m. wheel_angles (F, N): absolute, in the middle of the sample, rad; None if they were
    not recorded. session_time (F,): s since the session's start; None if unknown. session: its name. poses (F, 3): in
    the reference's frame, m, m, rad, by the uncorrected twists and exact arcs: mean of the poses before and after the
    sample; None if no effect needs them.

    Of robots that steer: steering_rates (F, S): rates of the steering angles from one sample's end to the next, rad/s.
    steering_side (F, S): the side of its gear's play on which the motor stands, from -1 (it turned to the right last)
    to 1 (to the left), 0 at first; None if no effect needs it. servo_gaps (F, S, 9): by how much servos turn a wheel
    less far than they are told by the steering angle, mean over the sample, rad, of lags SERVO_LAGS and then of limits
    SERVO_RATES; None if no effect needs it. caster_rates (F,): rates at which a caster behind the
    centre swings round, relative to the robot, to follow its motion, rad/s; None if no effect needs them.
    """

    robot: Robot
    durations: Array
    rates: Array
    elapsed: Array
    twists: Array
    accelerations: Array
    travelled: Array
    wheel_angles: Array | None = None
    session_time: Array | None = None
    session: str | None = None
    poses: Array | None = None
    steering: Array | None = None
    steering_rates: Array | None = None
    steering_side: Array | None = None
    servo_gaps: Array | None = None
    caster_rates: Array | None = None

    @property
    def speed(self) -> Array:
        """Speed (F,) of the robot's centre, m/s."""
        return np.hypot(self.twists[:, 0], self.twists[:, 1])


def needed(signal: Array | None) -> Array:
    """A signal that is there: an effect names it among its needs, or applies to robots that steer only."""
    assert signal is not None
    return signal


def signals_of(
    log: WheelLog, robot: Robot, matrix: Array, sample_period: float, needs: Collection[str] = ()
) -> Signals:
    """The signals of one log's F samples, see ``signals_of_runs``."""
    return signals_of_runs([log], RunSamples.of([log.times]), robot, matrix, sample_period, needs)


def signals_of_runs(
    logs: Sequence[WheelLog],
    samples: RunSamples,
    robot: Robot,
    matrix: Array,
    sample_period: float,
    needs: Collection[str] = (),
) -> Signals:
    """The signals of the samples of several runs of one session, one run after another, by a matrix (3, M).

    sample_period: nominal, s. needs: signals to compute that only some effects need, by name. What was not recorded of
    one run is unknown of all.

    With u_k the twist of sample k of a run, d_k its duration and y_k = y_{k-1} + a (u_k - y_{k-1}), y_0 = 0, the twist
    smoothed with a = 1 - exp(-sample_period / 50 ms), its acceleration is (y_k - y_{k-1}) / d_k: causal, and with the
    right integral over time for any durations of samples.
    """
    durations, rates = samples.durations, np.concatenate([log.rates for log in logs])
    ends = _joined([log.steering for log in logs])
    steering, side, gaps, swings = None, None, None, None
    if ends is not None:
        before = samples.before(ends)
        before[samples.edges[:-1]] = ends[samples.edges[:-1]]
        steering = (before + ends) / 2
        if "steering_side" in needs:
            side = np.concatenate([_sides(angles) for angles in np.split(steering, samples.edges[1:-1])])
        if "servo_gaps" in needs:
            parts = zip(*(np.split(values, samples.edges[1:-1]) for values in (ends, durations)), strict=True)
            gaps = np.concatenate([_gaps(*of_run) for of_run in parts])
    tracked = (rates if logs[0].drive is None else logs[0].drive.signals(rates, steering)) @ matrix.T
    twists = of_centre(robot, tracked)
    smoothed = _smoothed(twists, samples, smoothing_share(sample_period))
    if "caster_rates" in needs:
        parts = zip(*(np.split(values, samples.edges[1:-1]) for values in (twists, durations)), strict=True)
        swings = np.concatenate([_swings(robot, *of_run) for of_run in parts])
    angles = _joined([log.wheel_angles for log in logs])
    elapsed = samples.times - durations / 2
    started_at = None if any(log.started_at is None for log in logs) else np.array([log.started_at for log in logs])
    starts = np.array([log.start for log in logs])
    return Signals(
        robot=robot,
        durations=durations,
        rates=rates,
        elapsed=elapsed,
        twists=twists,
        accelerations=(smoothed - samples.before(smoothed)) / durations[:, None],
        travelled=_travelled(rates, np.sqrt(twists[:, 0] ** 2 + twists[:, 1] ** 2) * durations, samples),
        wheel_angles=None if angles is None else angles - rates * (durations / 2)[:, None],
        session_time=None if started_at is None else started_at[samples.run_of_sample] + elapsed,
        session=logs[0].session,
        poses=PathBatch(samples, starts, tracked * durations[:, None], "arc").middles if "poses" in needs else None,
        steering=steering,
        steering_rates=None if ends is None else steering_rates(ends, steering, durations),
        steering_side=side,
        servo_gaps=gaps,
        caster_rates=swings,
    )


def _joined(of_runs: Sequence[Array | None]) -> Array | None:
    """Values (F, n) of all runs one after another; None if those of a run are not known."""
    recorded = [values for values in of_runs if values is not None]
    return np.concatenate(recorded) if len(recorded) == len(of_runs) else None


def _smoothed(twists: Array, samples: RunSamples, share: float) -> Array:
    """Twists (F, 3) smoothed as ``signals_of_runs`` says, each run from rest."""
    from scipy.linalg.lapack import dtbtrs  # slow to import, and not needed by a live node

    bands = np.array([[1.0], [share - 1.0]]).repeat(len(twists), axis=1)
    bands[1, samples.edges[1:] - 1] = 0.0  # from the last sample of a run to the first of the next
    return dtbtrs(bands, share * twists, uplo="L")[0]


def steering_rates(ends: Array, middles: Array | None, durations: Array) -> Array:
    """Rates (F, S) of steering angles from those at the samples' ends and in their middles, rad; durations (F,), s."""
    return 2 * (ends - needed(middles)) / durations[:, None]


class SteeringGears:
    """Steering gears with play, one angle (S,) after another: the play operator.

    The wheel stands where the motor left it until the motor has turned back by the play. Source: M. A. Krasnosel'skii
    and A. V. Pokrovskii, Systems with Hysteresis, 1989.
    """

    def __init__(self) -> None:
        self._wheel: Array | None = None

    def turned(self, angles: Array) -> Array:
        """Place (S,) of the motors' angles (S,), rad, within the play, from -1 to 1."""
        if self._wheel is None:
            self._wheel = angles
        self._wheel = np.maximum(np.minimum(self._wheel, angles + _TAKE_UP), angles - _TAKE_UP)  # clip is slow on few
        return (angles - self._wheel) / _TAKE_UP


class SteeringServos:
    """Servos that turn steered wheels to commanded angles u, one sample after another; all stand as told at first.

    With u linear within samples of duration d, and s = (u_k - u_(k-1)) / d, the gap g = y - u of a lag tau is

        g_k = (g_(k-1) + tau s) e - tau s,    e = exp(-d / tau),                                            (3)

    and its mean over the sample -tau s + (g_(k-1) + tau s) (1 - e) tau / d. A servo that turns at the rate R at most
    turns to u_k during the sample, as far as it gets, and its gap is the mean of those at both ends.
    """

    def __init__(self) -> None:
        self._angles: list[float] | None = None
        self._gaps: list[list[float]] = []  # of each wheel, of lags and of limits

    def turned(self, angles: Sequence[float], duration: float) -> list[list[float]]:
        """Mean gaps (S, 9) of a sample that ends at commanded angles (S,), rad, after a duration > 0 s."""
        if self._angles is None:
            self._angles = list(angles)
            self._gaps = [[0.0] * (len(SERVO_LAGS) + len(SERVO_RATES)) for _ in angles]
        means = []
        for before, angle, gaps in zip(self._angles, angles, self._gaps, strict=True):
            turned, of_wheel = angle - before, []
            for number, tau in enumerate(SERVO_LAGS):
                ahead = tau * turned / duration
                from_ramp = gaps[number] + ahead
                lost = -math.expm1(-duration / tau)
                of_wheel.append(from_ramp * lost * tau / duration - ahead)
                gaps[number] = from_ramp * (1 - lost) - ahead  # Eq. (3)
            for number, rate in enumerate(SERVO_RATES, len(SERVO_LAGS)):
                asked = turned - gaps[number]
                gap = max(min(asked, rate * duration), -rate * duration) - asked
                of_wheel.append((gaps[number] + gap) / 2)
                gaps[number] = gap
            means.append(of_wheel)
        self._angles = list(angles)
        return means


class Caster:
    """A caster as far behind a robot's centre as its wheels stand from there, one sample after another.

    With V the velocity of its pivot and c the mean of the directions in which the pivot moved lately, both complex in
    the robot's frame, c turns back with the robot and follows V over the trail L,

        c <- c exp(-i w d),    c <- c + (1 - exp(-abs(V) d / L)) (V / abs(V) - c),                          (1)

    and the caster swings as c does on its straight way to V in Eq. (1): with h the distance of that way from 0, x what
    is behind along it, and g a small number for ways that lead nearly through 0, of which the side is chance, by

    integral of h / (x^2 + h^2 + g^2) dx.                                                               (2)

    At first the caster points where the robot goes.
    """

    def __init__(self, robot: Robot) -> None:
        self._behind = robot.reach
        self._direction: complex | None = None

    def moved(self, twist: Sequence[float], duration: float) -> float:
        """Mean rate of the swing, rad/s, in a sample with the twist (3,) of the robot's centre."""
        vx, vy, turn = twist
        pivot = complex(vx, vy - self._behind * turn)
        speed = abs(pivot)
        if speed < _STANDING:
            return 0.0
        ahead = pivot / speed
        before = ahead if self._direction is None else self._direction * cmath.exp(-1j * turn * duration)
        way = -math.expm1(-speed * duration / _TRAIL) * (ahead - before)
        self._direction = before + way
        length = abs(way)
        if length < _STANDING:
            return (before.conjugate() * way).imag / duration  # c points ahead: abs(c) is 1
        turned = before.conjugate() * way / length  # x and h
        near = math.hypot(turned.imag, _REVERSED)
        swept = math.atan((turned.real + length) / near) - math.atan(turned.real / near)
        return turned.imag / near * swept / duration  # Eq. (2)


def of_centre(robot: Robot, twists: Array) -> Array:
    """Twists (F, 3) of the robot's centre from those of its tracked point."""
    return twists if robot.mount is None else twists @ np.linalg.inv(robot.mount.twist).T


class SignalStream:
    """The signals of ``signals_of``, one sample at a time, from rest.

    session_time: at the first sample's start, s. pose (3,): by the uncorrected twists so far, m, m, rad; None if no
    effect needs it. needs: as for ``signals_of``.
    """

    def __init__(
        self,
        robot: Robot,
        matrix: Array,
        sample_period: float,
        session: str | None = None,
        session_time: float = 0.0,
        needs: Collection[str] = (),
    ) -> None:
        self.matrix = matrix
        self.pose: Array | None = None
        self.robot, self._session, self._session_time = robot, session, session_time
        self._share = smoothing_share(sample_period)
        self._elapsed = self._way = 0.0
        self._smoothed = np.zeros(3)
        self._angles = np.zeros(len(robot.wheel_names))
        self._gears = SteeringGears() if "steering_side" in needs else None
        self._servos = SteeringServos() if "servo_gaps" in needs else None
        self._caster = Caster(robot) if "caster_rates" in needs else None

    def turn(self, angles: Array, wheel_angles: Array | None = None) -> None:
        """Turn the wheels by angles (N,) rad, or to the absolute ``wheel_angles`` (N,) if they are known."""
        self._angles = self._angles + angles if wheel_angles is None else np.asarray(wheel_angles, dtype=float)

    def move(self, moved: Array) -> Array | None:
        """Move the robot by (3,) in its own frame, m, m, rad; return the mean of its poses (1, 3) before and after."""
        if self.pose is None:
            return None
        before = self.pose
        self.pose = advance(before, moved, "arc")
        return (before + self.pose)[None] / 2

    def next(
        self,
        rates: Array,
        duration: float,
        wheel_angles: Array | None = None,
        frame_heading: float = 0.0,
        steering: tuple[Array, Array] | None = None,
    ) -> Signals:
        """The signals (F = 1) of one sample: mean rates (N,) rad/s over a duration > 0 s, absolute angles at its end.

        Unknown angles are integrated from the last known ones, or from 0. frame_heading: heading of the stream's frame
        in the reference's, rad; both have the same origin. steering: angles (S,) in the sample's middle and at its end,
        rad.
        """
        turned = rates * duration
        self.turn(turned, wheel_angles)
        steered = None if steering is None else steering[0][None]
        tracked = self.matrix @ self.robot.drive.signals(rates[None], steered)[0]
        twist = of_centre(self.robot, tracked[None])[0]
        gained = self._share * (twist - self._smoothed)
        self._smoothed = self._smoothed + gained
        middle = self._elapsed + duration / 2
        self._elapsed += duration
        if max(map(abs, rates.tolist())) < STILL:
            self._way = step = 0.0
        else:
            vx, vy, _ = twist.tolist()
            step = math.hypot(vx, vy) * duration
            self._way += step
        poses = self.move(tracked * duration)
        if poses is not None and frame_heading:
            poses = compose(np.array([0.0, 0.0, frame_heading]), poses)
        elapsed, session_time, travelled, durations = np.array(
            [[middle], [self._session_time + middle], [self._way - step / 2], [duration]]
        )
        return Signals(
            self.robot,
            durations,
            rates[None],
            elapsed,
            twist[None],
            (gained / duration)[None],
            travelled,
            (self._angles - turned / 2)[None],
            session_time,
            self._session,
            poses,
            steered,
            None if steering is None else steering_rates(steering[1][None], steered, durations),
            None if steering is None or self._gears is None else self._gears.turned(steering[0])[None],
            None
            if steering is None or self._servos is None
            else np.array([self._servos.turned(steering[1].tolist(), duration)]),
            None if self._caster is None else np.array([self._caster.moved(twist.tolist(), duration)]),
        )


def smoothing_share(sample_period: float) -> float:
    """The weight a of a new twist in the smoothed one."""
    return -math.expm1(-sample_period / _SMOOTHING)


def _travelled(rates: Array, steps: Array, samples: RunSamples) -> Array:
    """Distance (F,) to the middle of each sample since all wheels last stood, from each sample's distance (F,), m."""
    still: NDArray[np.bool_] = reduce(np.logical_and, (np.abs(rates) < STILL).T)  # all(axis=1) takes twice as long
    way = np.append(0.0, np.cumsum(steps))
    number = np.arange(len(steps))
    since = np.where(still, number + 1, 0)
    since[samples.edges[:-1]] += np.where(still, 0, number)[samples.edges[:-1]]
    since = np.maximum.accumulate(since)
    return np.where(still, 0.0, way[1:] - steps / 2 - way[since])


def _sides(angles: Array) -> Array:
    """Sides (F, S) of its gears' play on which a run's steering motors stand, at angles (F, S), rad."""
    gears = SteeringGears()
    return np.array([gears.turned(row) for row in angles])


def _gaps(ends: Array, durations: Array) -> Array:
    """Mean gaps (F, S, 9) of servos in a run that were told the angles (F, S), rad, at the samples' ends."""
    servos = SteeringServos()
    return np.array([servos.turned(*sample) for sample in zip(ends.tolist(), durations.tolist(), strict=True)])


def _swings(robot: Robot, twists: Array, durations: Array) -> Array:
    """Rates (F,) at which a caster swings round in a run with twists (F, 3), rad/s."""
    caster = Caster(robot)
    return np.array([caster.moved(*sample) for sample in zip(twists.tolist(), durations.tolist(), strict=True)])
