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
100 % lie in them by place and 92 to 100 % by heading, in the mean of the robots 95.5 and 98.0 %. Five robots would set
the factor on the sixth's places to 0.89 to 1.02 (tests/studies/region_coverage.py).

The design errs by the same, and by the bias of its end against the calibration's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import ndtri, stdtrit

from omnibench.config import Model
from omnibench.data.dataset import Trajectory
from omnibench.fit.estimate import LEAST, USUAL_NUISANCES
from omnibench.fit.evaluate import looked_at
from omnibench.robot.calibration import Calibration, Slip
from omnibench.robot.corrections import driven_signals
from omnibench.robot.effects.effect import Term
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import OdometryBatch, WheelLog
from omnibench.robot.paths import legs_of, usual_paths, wheel_log

_START_PLACE, _START_HEADING = LEAST, USUAL_NUISANCES[0]  # m and rad: by which a run's start and its reference err
_LEAST_SLIP = 0.05  # share of the squares of errors that is slip, where the reference alone would explain all; chosen
_MOST_STEPS = 400_000  # wheel samples of the runs that slip is told from; chosen: a tenth of a second
_FEWEST = 4  # runs that it is told from, however long they are
_STEP = 1e-3  # of an effect's parameter in its standard deviations, for derivatives
_GRID = 200  # points a side of the grid of equal probabilities on which regions are computed: to 0.3 %
_REGION = 0.95  # probability of the regions, by convention
_QUANTILE = (1 + _REGION) / 2
_SIZES = ("position_m", "position_95_m", "heading_rad", "heading_95_rad")


class PathError(Model):
    """Predicted error at the end of a path: its expected size, and the radius that holds 95 % of the errors, m, rad."""

    path: str
    model: Literal["calibration", "design"]
    position_m: float
    position_95_m: float
    heading_rad: float
    heading_95_rad: float


@dataclass(frozen=True, eq=False)
class EndErrors:
    """Ends of Z runs by a calibration, and what slip makes of them.

    ends (Z, 3): m, m, rad. rolled (Z,): m of Eq. (2), m. levers (Z, 3, 3): the sum
    of Eq. (2) over the path. ways (Z, 2): of the ends from the starts, m.
    """

    ends: Array
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
        return cls(ends, rolled, levers, ends[:, :2] - np.array([log.start[:2] for log in logs]))

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


def calibration_covariances(calibration: Calibration, logs: Sequence[WheelLog]) -> Array:
    """Covariances (Z, 3, 3) of the ends of logs by what is not known of a calibration, Eq. (1); 0 if untold."""
    if calibration.covariance is None:
        return np.zeros((len(logs), 3, 3))
    covariance, model, true = np.array(calibration.covariance), calibration.model, list(logs)
    if terms := model.motion_terms:
        signals = driven_signals(terms, logs, model.robot, model.matrix, calibration.sample_period)
        true = [WheelLog(log.times, driven, log.start, log.stamps) for log, driven in zip(logs, signals, strict=True)]
    # J of Eq. (1): derivatives (Z, 3, n) of the ends by the matrix elements and the effects' parameters.
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
    slopes = np.concatenate(columns, axis=2)
    return np.asarray(slopes @ covariance @ np.swapaxes(slopes, 1, 2))


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
    covariances = calibration_covariances(calibration, logs) + ends.of_slip(calibration.slip)
    for path, covariance, bias in zip(chosen, covariances, biases, strict=True):
        for model, off in (("calibration", np.zeros(3)), ("design", bias)):
            sizes = dict(zip(_SIZES, error_region(covariance, off, runs), strict=True))
            errors.append(PathError.model_validate({"path": path, "model": model} | sizes))
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
