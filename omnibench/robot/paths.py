"""Paths that robots are asked to drive, and what their wheels measure on them.

A path is said in words: ``straight 1.0`` (m), ``turn 360`` (deg), ``circle 1.0 left`` (its radius) or ``square 1.0
right`` (its side).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from omnibench.errors import ConfigError, nearest
from omnibench.robot.calibration import Calibration
from omnibench.robot.corrections import corrected, needs_of
from omnibench.robot.kinematics import STEERING_LIMITS, Array, Robot, class_of
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import RunSamples, WheelLog
from omnibench.robot.signals import signals_of_runs

_FORMS = {
    "straight": "straight 1.0",
    "turn": "turn 360",
    "circle": "circle 1.0 left",
    "square": "square 1.0 left",
}
_KNOWN = "straight 1.0 (m), turn 360 (deg), circle 1.0 left or right (its radius, m), square 1.0 left or right (m)"
_LONGEST, _MOST_TURNS = 1000.0, 100.0  # m and turns of a path; chosen
_SPEED, _TURNING = 0.2, 0.5  # m/s and rad/s of the tracked paths, usual ones of small robots; chosen
_TURNS_FIRST = 1e3  # m/rad: times its rate of turn counts a twist that wheels cannot meet in all
_MOST_SAMPLES = 2_000  # of a leg of a path: the regions do not depend on the samples; chosen
_ROUNDING_UP = 10.0  # per m: radii of the tightest arcs are shown in full decimetres

_NEWTON, _NUDGE = 4, 1e-4  # steps, and rad/s or rad, of the search for what the wheels measure on a path


class Leg(NamedTuple):
    """A part of a path: twist of the robot's centre, m/s, m/s, rad/s, and its duration, s."""

    twist: Array
    seconds: float


def legs_of(path: str, robot: Robot) -> tuple[Leg, ...]:
    """The legs of a path like ``circle 1.0 left``. ConfigError: it is none, or this robot cannot drive it."""
    words = path.split()
    given = re.fullmatch(r"(straight|turn|circle|square) ([-+]?(?:\d+\.?\d*|\.\d+))(?: (left|right))?", " ".join(words))
    kind, size, side = given.groups() if given else ("", "", "")
    if not given or (side and kind in ("straight", "turn")):
        hint = nearest(words[0] if words else "", _FORMS)
        example = next((form for name, form in _FORMS.items() if repr(name) in hint), "")
        hint = f"did you mean {example!r}? " if example and not given else ""
        raise ConfigError(f"--path {path!r} is no path; {hint}known: {_KNOWN}")
    length, most = float(size), 360 * _MOST_TURNS if kind == "turn" else _LONGEST
    if not 0 < abs(length) <= most or (length < 0 and kind != "turn"):
        raise ConfigError(f"--path {path!r}: {size} is out of range; give at most {most:g}, and more than 0")
    # Straight on, and the motion nearest to a turn on the spot, at unit speed
    ahead, turning = (robot.motions[0], robot.motions[-1])
    ahead, turning = ahead / math.hypot(ahead[0], ahead[1]), turning / turning[2]
    tightest, sign = tightest_arc(robot), -1.0 if side == "right" else 1.0

    def arc(radius: float, angle: float) -> Leg:
        speed = min(_SPEED, _TURNING * radius)
        return Leg(speed * ahead + sign * speed / radius * turning, abs(angle) * radius / speed)

    if kind == "straight":
        return (Leg(_SPEED * ahead, length / _SPEED),)
    if kind == "turn":
        if tightest:
            raise ConfigError(
                f"--path {path!r}: robot {robot.name} cannot turn on the spot; its tightest is circle {tightest:g} left"
            )
        return (Leg(math.copysign(_TURNING, length) * turning, math.radians(abs(length)) / _TURNING),)
    if kind == "circle":
        if length < tightest:
            raise ConfigError(f"--path {path!r}: robot {robot.name} turns on radii of {tightest:g} m and more")
        return (arc(length, 2 * math.pi),)
    if length < 2 * tightest:
        raise ConfigError(f"--path {path!r}: robot {robot.name} needs sides of {2 * tightest:g} m for its corners")
    corner = arc(tightest, math.pi / 2) if tightest else Leg(sign * _TURNING * turning, math.pi / 2 / _TURNING)
    return (Leg(_SPEED * ahead, (length - 2 * tightest) / _SPEED), corner) * 4


def tightest_arc(robot: Robot) -> float:
    """Radius, m, of the tightest arc of a robot that cannot turn on the spot, in full decimetres; else 0."""
    limit = STEERING_LIMITS.get(class_of(robot))
    if limit is None:
        return 0.0
    axle = float(np.mean([wheel.position[0] for wheel in robot.wheels if wheel.kind == "fixed"]))
    steered = [wheel.position for wheel in robot.wheels if wheel.has_steering]
    radius = max(abs(x - axle) / math.tan(math.radians(limit)) + abs(y) for x, y in steered)
    return math.ceil(_ROUNDING_UP * radius) / _ROUNDING_UP


def usual_paths(robot: Robot) -> tuple[str, ...]:
    """The paths where none is given: 1 m ahead, a turn on the spot or the tightest arc, a circle and a square."""
    if not (tightest := tightest_arc(robot)):
        return tuple(_FORMS.values())
    circle, square = max(1.0, tightest), max(1, math.ceil(3 * tightest))
    paths = ("straight 1.0", f"circle {tightest:.1f} left", f"circle {circle:.1f} left", f"square {square:.1f} left")
    return tuple(dict.fromkeys(paths))


def wheel_log(calibration: Calibration, legs: Sequence[Leg]) -> WheelLog:
    """What the wheels measure on a path, at which the robot stands before each leg while it steers.

    Signals of the design's wheels that the calibrated matrix turns into the wanted twists; rates and angles that
    effects correct to these.
    """
    model, robot = calibration.model, calibration.robot
    basis = robot.signal_equations @ robot.allowed_basis  # of the signals, (M, D)
    twists = np.array([leg.twist for leg in legs])
    tracked = twists if robot.mount is None else twists @ robot.mount.twist.T
    # A tracked point that was fitted stands elsewhere than in the design, so that not all of a twist can be met
    first = np.array([1.0, 1.0, _TURNS_FIRST])
    signals = (tracked * first) @ np.linalg.pinv(first[:, None] * model.matrix @ basis).T @ basis.T
    rates, steering = robot.drive.commands(signals)
    rates, steering = _measured(model, rates, steering, calibration.session)
    # Samples: one in which the robot stands and steers, then those of the leg.
    durations, of_leg, moving = list[float](), list[int](), list[bool]()
    for number, leg in enumerate(legs):
        count = int(np.clip(math.ceil(leg.seconds / calibration.sample_period), 1, _MOST_SAMPLES))
        durations += [calibration.sample_period, *[leg.seconds / count] * count]
        of_leg += [number] * (count + 1)
        moving += [False, *[True] * count]
    driven = rates[of_leg] * np.array(moving)[:, None]
    return _log(robot, np.cumsum(durations), driven, steering[of_leg], calibration.session)


def _log(robot: Robot, times: Array, rates: Array, steering: Array, session: str | None) -> WheelLog:
    """The log of samples that begins at the origin, with its end as the only stamp."""
    angles = np.cumsum(rates * np.diff(times, prepend=0.0)[:, None], axis=0)
    log = WheelLog(times, rates, np.zeros(3), times[-1:], angles, 0.0, session)
    return log if robot.drive.direct else replace(log, steering=steering, drive=robot.drive)


def _measured(model: OdometryModel, rates: Array, steering: Array, session: str | None) -> tuple[Array, Array]:
    """Wheel rates (L, N) and steering angles (L, S) that effects correct to given ones; by Newton steps for each."""
    terms, robot = [term for term in model.motion_terms if term.effect.stage in ("wheel", "steering")], model.robot
    if not terms:
        return rates, steering
    wheels, wanted = rates.shape[1], np.hstack([rates, steering])
    assert model.sample_period is not None  # there are terms
    period = model.sample_period

    def true(measured: Array) -> Array:
        parts = zip(measured[:, None, :wheels], measured[:, None, wheels:], strict=True)
        logs = [_log(robot, np.array([period]), rate, angle, session) for rate, angle in parts]
        samples = RunSamples.of([log.times for log in logs])
        signals = signals_of_runs(logs, samples, robot, model.matrix, period, needs_of(terms))
        values = corrected(terms, signals)
        return values.rates if values.steering is None else np.hstack([values.rates, values.steering])

    measured = wanted
    for _ in range(_NEWTON):
        value = true(measured)
        slopes = (true(measured + _NUDGE) - value) / _NUDGE
        measured = measured + (wanted - value) / np.where(np.abs(slopes) > _NUDGE, slopes, 1.0)
    return measured[:, :wheels], measured[:, wheels:]
