"""Errors that a calibration will have on a path: their expected size, and the region that holds 95 % of them.

The end of a path errs by what is not known of the calibration and by the slip of the run. With the derivatives J (3, n)
of the end by the n fitted numbers, and their covariance C, the former has the covariance

    S = J C J'.                                                                                          (1)

Slip is a random walk over the metres m that the wheels roll: the way, and the turn times the wheels' mean distance from
the robot's centre. A part of it turns the robot on its way, and a turn at pose k of the path moves the end (x, y) by
v_k = (y_k - y, x - x_k, 1). With the standard deviations per root metre h of the heading, a <= h of the part that
turns the way, and p of the place beside that, it has the covariance

    W = p^2 m diag(1, 1, 0)  +  a^2 sum_k m_k v_k v_k'  +  (h^2 - a^2) m diag(0, 0, 1).                    (2)

The training runs tell how large it is. Beside slip, their errors e after the fit hold what a run's start and its
reference's poses err by, R; so that, in sums over the runs,

    h^2 = sum (e_h^2 - R_hh) / sum m,                                                                      (3)
    a^2 = min(h^2, P/2 / sum_runs tr V),  p^2 = (P - a^2 sum_runs tr V) / (2 sum m),                       (4)

where P are the squares of the places as in (3), and V the sum of (2) for the places: slip of the heading explains at
most half of what the places show, as robots that turn on the spot show something, too. After n runs all scatters as
Student's t with n - 1 degrees of freedom.

No factor stands on these regions: of held-out runs of six real robots, on paths of the same and of other kinds, 90 to
100 % lie in them by place and 92 to 100 % by heading, in the mean of the robots 95.6 and 96.8 %, and those of five robots
would set the factor on the sixth's places to 0.91 to 1.01 (tests/studies/region_coverage.py).

The design errs by the same, and by the bias of its end against the calibration's.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit

from omnibench.config import Model
from omnibench.data.dataset import Trajectory
from omnibench.errors import ConfigError, nearest
from omnibench.fit.evaluate import looked_at
from omnibench.robot.calibration import Calibration, Slip
from omnibench.robot.corrections import corrected, needs_of
from omnibench.robot.effects.effect import Term
from omnibench.robot.kinematics import STEERING_LIMITS, Array, Robot, class_of
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import OdometryBatch, RunSamples, WheelLog
from omnibench.robot.signals import signals_of, signals_of_runs

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

# What a run's start and its reference err by, m and rad: as the calibrator map takes them.
_START_PLACE, _START_HEADING = 0.003, 0.005
_LEAST_SLIP = 0.05  # share of the squares of errors that is slip, where the reference alone would explain all; chosen
_MOST_STEPS = 400_000  # wheel samples of the runs that slip is told from; chosen: a tenth of a second
_FEWEST = 4  # runs that it is told from, however long they are
_STEP = 1e-3  # of an effect's parameter in its standard deviations, for derivatives
_NEWTON, _NUDGE = 4, 1e-4  # steps, and rad/s or rad, of the search for what the wheels measure on a path
_GRID = 200  # points a side of the grid of equal probabilities on which regions are computed: to 0.3 %
_REGION = 0.95  # probability of the regions, by convention
_QUANTILE = (1 + _REGION) / 2


class PathError(Model):
    """Predicted error at the end of a path: its expected size, and the radius that holds 95 % of the errors, m, rad."""

    path: str
    model: Literal["calibration", "design"]
    position_m: float
    position_95_m: float
    heading_rad: float
    heading_95_rad: float


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


@dataclass(frozen=True, eq=False)
class EndErrors:
    """Ends of Z runs by a calibration, and what their errors are made of.

    ends (Z, 3): m, m, rad. calibrated (Z, 3, 3): S of Eq. (1). rolled (Z,): m of Eq. (2), m. levers (Z, 3, 3): the sum
    of Eq. (2) over the path. ways (Z, 2): of the ends from the starts, m.
    """

    ends: Array
    calibrated: Array
    rolled: Array
    levers: Array
    ways: Array

    @classmethod
    def of(cls, calibration: Calibration, logs: Sequence[WheelLog]) -> EndErrors:
        """Of logs that have one stamp each, their end. DataError: a log lacks data that an effect needs."""
        model, reach = calibration.model, calibration.robot.reach
        stamps = [np.append(log.times[log.times < log.stamps[-1]], log.stamps[-1]) for log in logs]
        paths = model.poses([replace(log, stamps=when) for log, when in zip(logs, stamps, strict=True)])
        rolled, levers = np.zeros(len(logs)), np.zeros((len(logs), 3, 3))
        for number, (log, path) in enumerate(zip(logs, paths, strict=True)):
            steps = np.diff(path, axis=0, prepend=log.start[None])
            metres = np.hypot(steps[:, 0], steps[:, 1]) + reach * np.abs(steps[:, 2])
            turned = np.column_stack([path[:, 1] - path[-1, 1], path[-1, 0] - path[:, 0], np.ones(len(path))])
            rolled[number], levers[number] = metres.sum(), (turned * metres[:, None]).T @ turned
        ends = np.array([path[-1] for path in paths])
        calibrated = np.zeros((len(logs), 3, 3))
        if calibration.covariance is not None:
            slopes = _slopes(model, logs, np.array(calibration.covariance))
            calibrated = slopes @ np.array(calibration.covariance) @ np.swapaxes(slopes, 1, 2)
        return cls(ends, calibrated, rolled, levers, ends[:, :2] - np.array([log.start[:2] for log in logs]))

    @property
    def of_reference(self) -> Array:
        """Covariances (Z, 3, 3) of what a run's start and its reference's poses err by: R of Eq. (3)."""
        turned = np.column_stack([-self.ways[:, 1], self.ways[:, 0], np.ones(len(self.ways))])
        place = _START_PLACE**2 * np.diag([1.0, 1.0, 0.0])
        return place + _START_HEADING**2 * turned[:, :, None] * turned[:, None, :]

    def of_slip(self, slip: Slip | None) -> Array:
        """Covariances (Z, 3, 3) of slip, Eq. (2); 0 where it is not known."""
        if slip is None:
            return np.zeros_like(self.levers)
        beside = np.diag(np.square([slip.position, slip.position, slip.heading])) - np.diag([0.0, 0.0, slip.way**2])
        return self.rolled[:, None, None] * beside + slip.way**2 * self.levers


def _slopes(model: OdometryModel, logs: Sequence[WheelLog], covariance: Array) -> Array:
    """J (Z, 3, n) of Eq. (1): derivatives of the logs' ends by the matrix elements and the effects' parameters."""
    robot, terms = model.robot, model.motion_terms
    true = list(logs)
    if terms:
        assert model.sample_period is not None  # there are terms
        needs, true = needs_of(terms), []
        for log in logs:
            of_log = corrected(terms, signals_of(log, robot, model.matrix, model.sample_period, needs))
            driven = robot.drive.signals(of_log.rates, of_log.steering)
            true.append(WheelLog(log.times, driven, log.start, log.stamps))
    columns = [OdometryBatch(true, model.integration).jacobian(model.matrix).reshape(len(logs), 3, -1)]
    plain = replace(model, fade=None)
    deviations = np.sqrt(np.maximum(np.diag(covariance)[model.matrix.size :], 0.0)).tolist()
    before = np.array([path[-1] for path in plain.poses(logs)]) if deviations else np.empty(0)
    for number, term in enumerate(model.terms):
        for name in term.values:
            step, moved = _STEP * deviations.pop(0), list(model.terms)
            moved[number] = Term(term.effect, dict(term.values) | {name: term.values[name] + step})
            after = np.array([path[-1] for path in replace(plain, terms=tuple(moved)).poses(logs)]) if step else before
            columns.append(((after - before) / step if step else np.zeros_like(before))[..., None])
    return np.concatenate(columns, axis=2)


def slip_of(calibration: Calibration, runs: Sequence[Trajectory]) -> Slip | None:
    """The slip by which training runs scatter about a calibration, Eq. (3) and (4); None: no run has poses."""
    posed, count = list[Trajectory](), 0
    for run in looked_at([run for run in runs if run.has_poses]):
        count += len(run.times)
        if len(posed) < _FEWEST or count <= _MOST_STEPS:
            posed.append(run)
    if not posed:
        return None
    of_runs = EndErrors.of(calibration, [run.final_log for run in posed])
    errors = of_runs.ends - np.array([run.final_pose for run in posed])
    squares = np.square(errors).sum(axis=0)
    explained = np.diagonal(of_runs.of_reference, axis1=1, axis2=2).sum(axis=0)
    metres = max(float(of_runs.rolled.sum()), 1e-9)
    heading = max(squares[2] - explained[2], _LEAST_SLIP * squares[2]) / metres  # Eq. (3)
    places = max(squares[:2].sum() - explained[:2].sum(), _LEAST_SLIP * squares[:2].sum())
    levers = max(float(np.trace(of_runs.levers[:, :2, :2].sum(axis=0))), 1e-12)
    way = min(heading, places / levers / 2)  # Eq. (4)
    position = max(places - way * levers, 0.0) / (2 * metres)
    return Slip(heading=math.sqrt(heading), way=math.sqrt(way), position=math.sqrt(position), runs=len(posed))


def error_region(covariance: Array, bias: Array, runs: int | None) -> tuple[float, float, float, float]:
    """Expected size and 95 % radius of place errors, m, and of heading errors, rad.

    covariance (3, 3), bias (3,): of the errors. runs: that slip is told from, one more than the degrees of freedom of
    Student's t; None: it is not known, and the distribution is normal.
    """
    sides = ndtri((np.arange(_GRID) + 0.5) / _GRID)
    grid = np.stack(np.meshgrid(sides, sides), axis=-1).reshape(-1, 2)
    wider = 1.0 if runs is None else float(stdtrit(max(runs - 1, 1), _QUANTILE) / ndtri(_QUANTILE))
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    places = grid @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    turns = sides * math.sqrt(max(covariance[2, 2], 0.0))
    expected = np.linalg.norm(bias[:2] + places, axis=1).mean(), np.abs(bias[2] + turns).mean()
    position = np.quantile(np.linalg.norm(bias[:2] + wider * places, axis=1), _REGION)
    heading = np.quantile(np.abs(bias[2] + wider * turns), _REGION)
    return float(expected[0]), float(position), float(expected[1]), float(heading)


def predicted_errors(calibration: Calibration, paths: Sequence[str] = ()) -> tuple[PathError, ...]:
    """Errors of a calibration and of the robot's design on paths, by default the usual; () if the file tells of none.

    ConfigError: a path is none, or the robot cannot drive it.

    >>> [error.path for error in predicted_errors(calibration, ["straight 2"])]
    ['straight 2', 'straight 2']
    """
    chosen = tuple(" ".join(path.split()) for path in paths) or usual_paths(calibration.robot)
    logs = [wheel_log(calibration, legs_of(path, calibration.robot)) for path in chosen]
    if calibration.covariance is None and calibration.slip is None:
        return ()
    ends = EndErrors.of(calibration, logs)
    design = OdometryModel.of_design(calibration.robot, calibration.integration)
    biases = np.array([path[-1] for path in design.poses(logs)]) - ends.ends
    runs = None if calibration.slip is None else calibration.slip.runs
    errors = []
    for path, covariance, bias in zip(chosen, ends.calibrated + ends.of_slip(calibration.slip), biases, strict=True):
        models: tuple[tuple[Literal["calibration", "design"], Array], ...] = (
            ("calibration", np.zeros(3)),
            ("design", bias),
        )
        for model, off in models:
            place, place_95, turn, turn_95 = error_region(covariance, off, runs)
            errors.append(
                PathError(
                    path=path,
                    model=model,
                    position_m=place,
                    position_95_m=place_95,
                    heading_rad=turn,
                    heading_95_rad=turn_95,
                )
            )
    return tuple(errors)


def regions_lack(calibration: Calibration) -> str:
    """What the error regions of a calibration leave out, in a sentence; empty if nothing."""
    again = "calibrate once more to have it in the file"
    if calibration.covariance is None and calibration.slip is None:
        return f"errors on paths are not known: the calibration has neither covariance nor slip; {again}"
    if calibration.slip is None:
        return f"error regions hold the calibration's uncertainty alone: the slip of runs is not in its file; {again}"
    if calibration.covariance is None:
        return "error regions hold the slip of runs alone: the calibration has no covariance"
    return ""
