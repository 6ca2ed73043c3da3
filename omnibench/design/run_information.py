"""Fisher information of candidate runs, and the precision and effort of a design made of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import get_args

import numpy as np

from omnibench.design.candidates import CandidatePool, CandidateRun
from omnibench.design.config import Per, Use
from omnibench.design.d_optimality import Candidates, Counts, scale_of
from omnibench.design.result import Candidate, Chosen, Effort, MotionPrecision, PhysicalSpread, Precision, Step
from omnibench.errors import ConfigError
from omnibench.fit.geometry import WheelGeometry
from omnibench.fit.span import direction_in_words, driven_span
from omnibench.fit.uncertainty.information import information_of_runs
from omnibench.fit.uncertainty.physical import is_invertible
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.planar import relative

USES: tuple[Use, ...] = get_args(Use)
_PATH_POINTS = 160  # points that a path is drawn with, one for each few pixels of a figure


class DesignProblem:
    """The candidates with their information for each use; effort and precision of designs, given as counts (C,).

    basis (3N, p): elements of the matrix = basis @ parameters. Directions of wheel rates that no candidate drives are
    not among the parameters: the matrix keeps its start values there.
    """

    def __init__(self, pool: CandidatePool, use: Use, per: Per, repetitions: int | None) -> None:
        self.pool, self.use, self.per, self.repetitions = pool, use, per, repetitions
        self.described = tuple(_described(candidate, pool.robot) for candidate in pool.candidates)
        self.costs = np.array([_cost(candidate, per) for candidate in self.described])
        directions = driven_span([run for candidate in pool.candidates for run in candidate.runs]).strong
        self.basis: Array = np.kron(np.eye(3), directions.T)
        self.information = {name: self._information(name) for name in USES}
        self._everything: dict[Use, Candidates] = {}
        self._physical = _element_slopes(pool.robot) if len(directions) == 3 and is_invertible(pool.robot) else None

    def _information(self, use: Use) -> Array:
        """Mean information (C, p, p) of a run of each candidate."""
        noise = self.pool.noise if use == "trajectory" else evenly(self.pool.noise)
        matrix = self.pool.robot.inverse_kinematic_matrix
        means = [
            information_of_runs(
                candidate.runs, matrix, self.pool.integration, noise, stamps="final" if use == "final" else "reference"
            ).mean(axis=0)
            for candidate in self.pool.candidates
        ]
        return self.basis.T @ np.array(means) @ self.basis

    def everything(self, use: Use) -> Candidates:
        """All candidates, as a common measure for designs from different sets."""
        if use not in self._everything:
            self._everything[use] = self.candidates(use)
        return self._everything[use]

    def candidates(self, use: Use, name: str | None = None) -> Candidates:
        """The candidates of a set, or all. ConfigError when they leave part of the matrix undetermined."""
        chosen = list(range(len(self.described)) if name is None else self.pool.sets[name])
        information = self.information[use][chosen]
        try:
            return Candidates(information, self.costs[chosen], self.repetitions)
        except ValueError:
            raise ConfigError(self._open(information, use, name)) from None

    def _open(self, information: Array, use: Use, name: str | None) -> str:
        mean = information.mean(axis=0)
        scale = scale_of(mean)
        weakest = np.linalg.eigh(mean * scale * scale[:, None])[1][:, 0] * scale
        elements = (self.basis @ weakest).reshape(3, -1)
        direction = np.linalg.svd(elements)[2][0]
        row = int(np.argmax(np.linalg.norm(elements, axis=1))) + 1
        poses = "the final poses" if use == "final" else "the poses"
        return (
            f"{self.pool.source}: {poses} of {name or 'all commands'} leave row {row} of the matrix undetermined along "
            f"{direction_in_words(direction, self.pool.robot.drive.names)}; add commands that determine it"
        )

    def of_all(self, name: str, counts: Counts) -> Counts:
        """Counts of a set's candidates as counts (C,) of all."""
        every: Counts = np.zeros(len(self.described), dtype=np.intp)
        every[list(self.pool.sets[name])] = counts
        return every

    def effort(self, counts: Counts) -> Effort:
        """Time and distance of driving ``counts`` runs (C,) of the candidates."""
        sums = np.array([[run.duration_s, run.distance_m, run.rolled_m] for run in self.described]).T @ counts
        return Effort(runs=int(counts.sum()), seconds=sums[0], metres=sums[1], wheel_metres=sums[2])

    def precision(self, counts: Counts) -> Precision:
        """Standard deviations that ``counts`` runs (C,) of the candidates give."""
        everything = self.everything(self.use)
        covariance = self.basis @ everything.covariance(counts) @ self.basis.T
        deviations = np.sqrt(np.maximum(np.diagonal(covariance), 0.0)).reshape(3, -1)
        largest = self.pool.robot.row_scales
        first, second, third = (100 * deviations.max(axis=1) / largest).tolist()
        relative = math.sqrt(everything.root(self.pool.baseline) / everything.root(counts))
        physical = None if self._physical is None else _physical_spread(self._physical, covariance, self.pool.robot)
        return Precision(
            effort=self.effort(counts),
            relative=relative,
            row_percent=(first, second, third),
            motions=tuple(_motion_precision(name, signals, covariance) for name, signals in _motions(self.pool.robot)),
            physical=physical,
        )

    def step(self, counts: Counts, bound: float) -> Step:
        """The precision of ``counts`` (C,), with its efficiency as a share of ``bound``."""
        efficiency = self.everything(self.use).criterion(counts) / bound
        return Step(**dict(self.precision(counts)), efficiency=efficiency)

    def chosen(self, counts: Counts) -> tuple[Chosen, ...]:
        """The commands that are driven at least once."""
        return tuple(
            Chosen(command=candidate.name, runs=int(count))
            for candidate, count in zip(self.described, counts, strict=True)
            if count
        )


def evenly(noise: Noise) -> Noise:
    """A noise model with equal figures (m, rad) for x, y and heading, as Eq. (6) weighs them: the RMS of the three."""
    return Noise(
        **{
            f"{kind}_{coordinate}": math.sqrt(
                (2 * getattr(noise, f"{kind}_position") ** 2 + getattr(noise, f"{kind}_heading") ** 2) / 3
            )
            for kind in ("pose", "walk", "bias")
            for coordinate in ("position", "heading")
        }
    )


def _described(candidate: CandidateRun, robot: Robot) -> Candidate:
    first = candidate.runs[0]
    picks = np.unique(np.linspace(0, len(first.poses) - 1, _PATH_POINTS).round().astype(int))
    path = np.round(relative(first.start, first.poses[picks]), 5)
    known = first.v is not None and first.alpha is not None and first.omega is not None
    radii = robot.radii
    rolled = [
        float((np.abs(run.rates) * np.diff(run.times, prepend=0.0)[:, None] * radii).sum() / len(radii))
        for run in candidate.runs
    ]
    return Candidate(
        name=candidate.name,
        speed=first.v if known else None,
        direction=first.alpha if known else None,
        turn_rate=first.omega if known else None,
        duration_s=candidate.duration,
        distance_m=candidate.distance,
        rolled_m=float(np.mean(rolled)),
        path=tuple((px, py, ph) for px, py, ph in path.tolist()),
    )


def _motions(robot: Robot) -> Iterator[tuple[str, Array]]:
    """Each motion of a robot by its name, with the signals (M,) that drive 1 m of it or a full turn, rad."""
    names = ("1 m ahead", "1 m aside", "a full turn") if robot.slides and not robot.skid else ("1 m", "a full turn")
    for name, motion in zip(names, robot.motions, strict=True):
        length = math.tau / motion[2] if name == "a full turn" else 1 / math.hypot(motion[0], motion[1])
        yield name, length * robot.signal_equations @ motion


def _motion_precision(name: str, signals: Array, covariance: Array) -> MotionPrecision:
    """Standard deviations of a motion with those signals (M,) under a covariance (3M, 3M) of the matrix."""
    along = np.kron(np.eye(3), signals)
    x, y, heading = np.sqrt(np.maximum(np.diagonal(along @ covariance @ along.T), 0.0)).tolist()
    return MotionPrecision(motion=name, position_mm=1000 * math.hypot(x, y), heading_deg=math.degrees(heading))


def _cost(candidate: Candidate, per: Per) -> float:
    return {"run": 1.0, "second": candidate.duration_s, "metre": candidate.rolled_m}[per]


def _element_slopes(robot: Robot) -> Array:
    """Derivatives (9, 9) of the physical parameters of three omni wheels with respect to the matrix elements."""
    geometry = WheelGeometry(robot)
    return np.linalg.inv(geometry.slopes(geometry.start))


def _physical_spread(slopes: Array, covariance: Array, robot: Robot) -> PhysicalSpread:
    deviations = np.sqrt(np.diagonal(slopes @ covariance @ slopes.T)).reshape(3, -1)
    design = WheelGeometry(robot).start.reshape(3, -1)
    return PhysicalSpread(
        radius_percent=float((100 * deviations[0] / design[0]).max()),
        distance_percent=float((100 * deviations[1] / design[1]).max()),
        angle_deg=float(np.degrees(deviations[2]).max()),
    )
