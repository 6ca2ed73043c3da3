"""Motion commands as the APR-02 gets them: refreshed over a link with a watchdog, slewed, turned into target rates.

Palacin et al. 2023, section 2.1: the planner sends (v, alpha, omega, t_r) every 300 ms, and no command is valid for
longer than 500 ms, so that the robot stops when its computer does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import count
from typing import Literal

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from omnibench.config import Model, NonNegative, Positive
from omnibench.robot.kinematics import Array, Robot
from omnibench.simulate.commands import Command, wheels_of


@dataclass(frozen=True)
class SlewLimits:
    """The steepest slope of the scale, 1/s, and the greatest change of the slope, 1/s2 (inf: the slope may step)."""

    slope: float
    jerk: float = math.inf


@dataclass(frozen=True)
class Phase:
    """A phase of constant jerk from ``start``, s, on. way: integral of the scale until then, s at full speed."""

    start: float
    way: float
    scale: float
    slope: float = 0.0
    jerk: float = 0.0

    def at(self, time: float) -> Phase:
        """The rest of the phase, from ``time``, s, on."""
        s = time - self.start
        way = self.way + s * (self.scale + s * (self.slope / 2 + s * self.jerk / 6))
        scale = self.scale + s * (self.slope + s * self.jerk / 2)
        return Phase(time, way, scale, self.slope + s * self.jerk, self.jerk)


@dataclass(frozen=True)
class SetPoint:
    """A course of the set point's scale, from 0 (rest) to 1 (full speed), with limited slope and jerk.

    Its phases of constant jerk are in closed form; nothing is sampled. The last goes on for ever.
    """

    limits: SlewLimits
    phases: tuple[Phase, ...] = (Phase(0.0, 0.0, 0.0),)

    def towards(self, target: float, time: float) -> SetPoint:
        """The course that leaves this one at ``time`` (s, from 0 on) for ``target``, as fast as the limits allow.

        A scale between 0 and 1 that is sent to 0 or to 1 stays between them.
        """
        if target == self.phases[-1].scale:
            return self
        now = next(phase for phase in reversed(self.phases) if phase.start <= time).at(time)
        driven = (phase for phase in self.phases if phase.start < time)
        return SetPoint(self.limits, (*driven, *_course(now, target, self.limits)))

    def ways(self, times: Array) -> Array:
        """Integrals (F,) of the scale until ``times`` (F,), s at full speed."""
        columns = np.array([[phase.start, phase.way, phase.scale, phase.slope, phase.jerk] for phase in self.phases]).T
        chosen = np.searchsorted(columns[0], times, side="right") - 1
        start, way, scale, slope, jerk = columns[:, chosen]
        s = times - start
        covered: Array = way + s * (scale + s * (slope / 2 + s * jerk / 6))
        return covered


def _course(now: Phase, target: float, limits: SlewLimits) -> tuple[Phase, ...]:
    """The fastest course to the target: the slope goes to its peak, stays there, goes to 0."""
    if math.isinf(limits.jerk):
        sign = math.copysign(1.0, target - now.scale)
        parts = [(abs(target - now.scale) / limits.slope, sign * limits.slope, 0.0)]
    else:
        parts = _s_curve(now, target, limits)
    phases, start, way, scale = [], now.start, now.way, now.scale
    for duration, slope, jerk in parts:
        if duration > 0:
            phases.append(Phase(start, way, scale, slope, jerk))
            reached = phases[-1].at(start + duration)
            start, way, scale = reached.start, reached.way, reached.scale
    return (*phases, Phase(start, way, target))


def _s_curve(now: Phase, target: float, limits: SlewLimits) -> list[tuple[float, float, float]]:
    """Duration, slope at the begin and jerk of the three phases, from any slope to slope 0."""
    # The scale that is reached if the slope goes to 0 at once.
    coasting = now.scale + now.slope * abs(now.slope) / (2 * limits.jerk)
    sign = math.copysign(1.0, target - coasting)
    slope, missing, jerk = sign * now.slope, sign * (target - now.scale), limits.jerk
    peak = max(min(limits.slope, math.sqrt(max(jerk * missing + slope**2 / 2, 0.0))), slope, 0.0)
    held = (missing - (2 * peak**2 - slope**2) / (2 * jerk)) / peak if peak > 0 else 0.0
    return [
        ((peak - slope) / jerk, now.slope, sign * jerk),
        (max(held, 0.0), sign * peak, 0.0),
        (peak / jerk, sign * peak, -sign * jerk),
    ]


_NOTHING = 1e-9  # s; a command of a shorter validity is not sent


class MotionProfile(Model):
    """Limits on the change of the set point. All parts of the twist change in step: direction and curvature stay.

    Accelerations are of the set point in the robot's frame, without the centripetal acceleration of a curve.
    """

    shape: Literal["trapezoid", "jerk_limited"] = Field("trapezoid", description="jerk_limited: S-curves")
    acceleration: Positive = Field(0.5, description="m/s2")
    turn_acceleration: Positive = Field(1.0, description="rad/s2")
    jerk: Positive = Field(2.5, description="m/s3; for shape jerk_limited")
    turn_jerk: Positive = Field(5.0, description="rad/s3; for shape jerk_limited")

    def limits(self, command: Command) -> SlewLimits:
        """Limits on the share of the command's full twist."""
        slope = _slower(command, self.acceleration, self.turn_acceleration)
        return SlewLimits(slope, math.inf if self.shape == "trapezoid" else _slower(command, self.jerk, self.turn_jerk))


class CommandLink(Model):
    """The link by which commands reach the robot."""

    refresh: FiniteFloat = Field(0.3, ge=0.01, description="time from one command to the next, s")
    watchdog: Positive = Field(0.5, description="longest validity of a command, s")
    lost: float = Field(0.0, ge=0, le=0.9, description="probability that a command is lost")
    stalls_at: NonNegative | None = Field(None, description="time of a run from which on no command is sent, s")

    @model_validator(mode="after")
    def _goes_on(self) -> CommandLink:
        if self.watchdog < self.refresh:
            raise ValueError(f"watchdog {self.watchdog:g} s is shorter than refresh {self.refresh:g} s; give more")
        return self


@dataclass(frozen=True)
class SentCommand:
    """A command: time of sending, s, validity t_r, s, and whether it reached the robot."""

    time: float
    duration: float
    arrived: bool


@dataclass(frozen=True, eq=False)
class CommandedMotion:
    """The set point of one run. times (F,): ends of the samples, s. twists (F, 3): mean of each sample, m/s and rad/s.

    stopped_by_watchdog: begin and end of the times without a valid command, s.
    """

    times: Array
    twists: Array
    commands: tuple[SentCommand, ...]
    stopped_by_watchdog: tuple[tuple[float, float], ...]

    def after(self, samples: int) -> CommandedMotion:
        """The motion after a rest of some samples, in which the robot steers."""
        if not samples:
            return self
        count, period = samples + len(self.times), self.times[0]
        rest = samples * period
        return CommandedMotion(
            period * np.arange(1, count + 1),
            np.vstack([np.zeros((samples, 3)), self.twists]),
            tuple(replace(sent, time=sent.time + rest) for sent in self.commands),
            tuple((since + rest, until + rest) for since, until in self.stopped_by_watchdog),
        )

    @property
    def distance(self) -> float:
        """Length of the set point's path, m."""
        return float(np.hypot(self.twists[:, 0], self.twists[:, 1]) @ np.diff(self.times, prepend=0.0))


def command_motion(
    command: Command,
    way: float | None,
    turn_duration: float,
    profile: MotionProfile,
    link: CommandLink,
    sample_period: float,
    settle: float,
    rng: np.random.Generator,
) -> CommandedMotion:
    """The set point of a run over a distance ``way``, m, or of ``turn_duration``, s, at full speed if way is None.

    The planner knows how far the set point has come. It refreshes the command until the distance is covered, also when
    commands are lost; the validity of the last command makes the robot come to rest there. A link that stalls leaves
    the run incomplete. A rest of ``settle``, s, follows.
    """
    seconds = way / command.speed if way is not None and command.speed else turn_duration
    set_point, sent, stops = _planned(seconds, SetPoint(profile.limits(command)), link, rng)
    samples = max(1, math.ceil((set_point.phases[-1].start + settle) / sample_period - 1e-9))
    times: Array = sample_period * np.arange(1, samples + 1)
    shares = np.diff(set_point.ways(np.append(0.0, times))) / sample_period
    ended = tuple((since, min(until, float(times[-1]))) for since, until in stops)
    return CommandedMotion(times, shares[:, None] * command.twist, sent, ended)


def target_rates(robot: Robot, motion: CommandedMotion) -> Array:
    """Target wheel rates (F, N) by the robot's design values, rad/s; its steering angles hold throughout the run."""
    if robot.drive.direct:
        rates: Array = motion.twists @ robot.signal_equations.T
        return rates
    speeds = np.linalg.norm(motion.twists, axis=1)
    fastest = int(np.argmax(speeds))  # all twists are shares of one
    return np.outer(speeds / max(speeds[fastest], 1e-12), wheels_of(robot, motion.twists[fastest])[0])


def _slower(command: Command, straight: float, turning: float) -> float:
    """The smaller of two limits as shares of the command's speed and rate of turn."""
    return min(
        straight / command.speed if command.speed else math.inf,
        turning / abs(command.turn_rate) if command.turn_rate else math.inf,
    )


def _planned(
    seconds: float, set_point: SetPoint, link: CommandLink, rng: np.random.Generator
) -> tuple[SetPoint, tuple[SentCommand, ...], tuple[tuple[float, float], ...]]:
    """Plan a run: its set point, the commands sent, and the stops by the watchdog as (start, end), s.

    seconds: duration of the run at full speed, s. A stop that lasts to the end of the run ends at infinity.
    """
    sent: list[SentCommand] = []
    stops: list[tuple[float, float]] = []
    expires, reached = 0.0, False
    for number in count():
        now = number * link.refresh
        if link.stalls_at is not None and now >= link.stalls_at:
            break
        if expires <= now:
            set_point = set_point.towards(0.0, expires)
        needed = _needed(set_point, now, seconds, link.refresh)
        if expires <= now and needed is not None and needed < _NOTHING:
            break
        sent.append(SentCommand(now, link.watchdog if needed is None else needed, bool(rng.random() >= link.lost)))
        if sent[-1].arrived:
            if 0.0 < expires < now:
                stops.append((expires, now))
            set_point, expires = set_point.towards(1.0, now), now + sent[-1].duration
            reached = needed is not None
            if reached:
                break
    set_point = set_point.towards(0.0, expires)
    if expires > 0.0 and not reached:
        stops.append((expires, math.inf))
    return set_point, tuple(sent), tuple(stops)


def _needed(set_point: SetPoint, now: float, seconds: float, longest: float) -> float | None:
    """Validity, s, with which a command sent now lets the set point end at its goal; None: longer than ``longest``."""
    driving = set_point.towards(1.0, now)

    def missing(duration: float) -> float:
        return seconds - driving.towards(0.0, now + duration).phases[-1].way

    if missing(0.0) <= 0:
        return 0.0
    if missing(longest + _NOTHING) > 0:
        return None
    from scipy.optimize import brentq  # loads slowly

    return float(brentq(missing, 0.0, longest + _NOTHING, xtol=1e-14))
