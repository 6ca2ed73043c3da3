"""Optimal experiment design: which commands to drive so that a calibration becomes most precise.

Candidate runs are judged by their Fisher information: the precision and the effort of a design made of them.

The result of a design: the document of ``omnibench design --json``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import get_args

import numpy as np
from pydantic import Field

from omnibench.config import Model
from omnibench.data.dataset import Dataset
from omnibench.design import d_optimality
from omnibench.design.candidates import CandidatePool, CandidateRun, Per, Use, read_candidates
from omnibench.design.exchange import Counts
from omnibench.errors import ConfigError, require_choice, require_range
from omnibench.fit.geometry import WheelGeometry
from omnibench.fit.span import direction_in_words, driven_span
from omnibench.fit.trajectory_fit import Stamps, information_of_runs
from omnibench.report.numbers import motion_in_words
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array, Robot, class_of, relative
from omnibench.robot.odometry import Integration
from omnibench.words import plural


class Candidate(Model):
    """A command that a design may choose. speed m/s, direction rad, turn_rate rad/s: None where it is not known."""

    name: str
    speed: float | None
    direction: float | None
    turn_rate: float | None
    duration_s: float
    distance_m: float = Field(description="way of the robot's centre")
    rolled_m: float = Field(description="way that the wheels roll, mean of the wheels")
    words: str = Field(exclude=True, repr=False, description="as a person drives it")
    path: tuple[tuple[float, float, float], ...] = Field(
        exclude=True, repr=False, description="poses along a run from (0, 0, 0), for drawing: m, m, rad"
    )

    @property
    def motion(self) -> str:
        """The command as ``0.2 m/s at 30°, −0.35 rad/s``."""
        return motion_in_words(self.name, self.speed, self.direction, self.turn_rate)

    @property
    def turned(self) -> float:
        """The angle that a run turns by, rad; positive to the left."""
        return self.path[-1][2] - self.path[0][2]


class Effort(Model):
    """Number, time and distance of some runs."""

    runs: int
    seconds: float
    metres: float = Field(description="way of the robot's centre")
    wheel_metres: float = Field(description="way that the wheels roll, mean of the wheels")


class PhysicalSpread(Model):
    """Largest standard deviation of each kind of physical parameter."""

    radius_percent: float
    distance_percent: float
    angle_deg: float


class MotionPrecision(Model):
    """Standard deviations of a calibrated robot's odometry after 1 m or a full turn, from the matrix alone."""

    motion: str
    position_mm: float
    heading_deg: float


class Precision(Model):
    """Precision of the matrix that some runs give.

    relative: the geometric mean of the standard deviations as a multiple of the baseline's. row_percent: the largest
    standard deviation of an element of each row, % of the row's largest element. motions: of odometry. physical: for
    three omni wheels.
    """

    effort: Effort
    relative: float
    row_percent: tuple[float, float, float]
    motions: tuple[MotionPrecision, ...]
    physical: PhysicalSpread | None


class Step(Precision):
    """A design of some runs. efficiency: its det(M)^(1/p) per run (or s, m) as a share of the bound on all designs."""

    efficiency: float


class Chosen(Model):
    """A command and how often it is driven."""

    command: str
    runs: int


class Equivalent(Model):
    """The smallest design found that gives as much information as the baseline.

    effort: None when there is none within the repetitions allowed. least: lower bound on the cost of any such design,
    in runs, s or m; None where this use leaves part of the matrix undetermined.
    """

    use: Use
    effort: Effort | None
    least: float | None
    chosen: tuple[Chosen, ...]


class Optimum(Model):
    """The continuous optimum. shares: of the cost, by command. gap: how far it can be below the bound, relative."""

    shares: dict[str, float]
    gap: float
    iterations: int


class SetDesign(Model):
    """The design from one set of candidates. reached: the chosen runs are within 1 % of the D-optimum."""

    name: str
    commands: tuple[str, ...]
    optimum: Optimum
    chosen: tuple[Chosen, ...]
    step: Step
    reached: bool
    baseline_efficiency: float
    steps: tuple[Step, ...] = Field(description="the best runs found, more and more of them")
    equivalents: tuple[Equivalent, ...]


class Baseline(Model):
    """The experiment that designs are compared with."""

    name: str
    precision: Precision


class Design(Model):
    """The commands that are worth driving, and the precision that they give."""

    source: str
    name: str
    description: str
    robot: str
    simulated: bool = Field(description="nothing of it was measured on a robot")
    recorded: bool = Field(description="the candidates' wheel logs are recordings")
    integration: Integration
    use: Use
    per: Per
    runs_asked: int | None
    most_repetitions: int | None
    parameters: int = Field(description="elements of the matrix that the commands determine")
    noise: Noise
    noise_source: str
    candidates: tuple[Candidate, ...]
    baseline: Baseline
    sets: tuple[SetDesign, ...]
    notes: tuple[str, ...]

    def candidate(self, name: str) -> Candidate:
        """The candidate called ``name``."""
        return next(candidate for candidate in self.candidates if candidate.name == name)


USES: tuple[Use, ...] = get_args(Use)
_PATH_POINTS = 160  # points that a path is drawn with, one for each few pixels of a figure
# Half of each of these numbers (or of the distance from 1) and twice choose the same runs of twelve commands
# (tests/studies/constants_fit.py).
# Share of the bound: the recommended design is the smallest that reaches it. The rest is worth 0.5 % of a deviation.
GOOD_EFFICIENCY = 0.99
_MOST_STEPS = 400  # runs: designs are listed up to the baseline's number, but no further than this
_MOST_RUNS = 2000  # runs or repetitions that may be asked for: more are a slip of the pen
_LEAST_SHARE = 1e-4  # a command with less of the continuous optimum is not listed: less than a run in 10,000


class DesignProblem:
    """The candidates with their information for each use; effort and precision of designs, given as counts (C,).

    basis (3N, p): elements of the matrix = basis @ parameters. Directions of wheel rates that no candidate drives are
    not among the parameters: the matrix keeps its start values there.
    """

    def __init__(self, pool: CandidatePool, use: Use, per: Per, repetitions: int | None) -> None:
        self.pool, self.use, self.repetitions = pool, use, repetitions
        self.described = tuple(_described(candidate, pool.robot) for candidate in pool.candidates)
        efforts = [{"run": 1.0, "second": run.duration_s, "metre": run.rolled_m} for run in self.described]
        self.costs = np.array([effort[per] for effort in efforts])
        directions = driven_span([run for candidate in pool.candidates for run in candidate.runs]).strong
        self.basis: Array = np.kron(np.eye(3), directions.T)
        # Mean information (C, p, p) of a run of each candidate, for each use
        self.information: dict[Use, Array] = {}
        for each in USES:
            noise = evenly(pool.noise) if each == "final" else pool.noise
            stamps: Stamps = "final" if each == "final" else "reference"
            model = (pool.robot.inverse_kinematic_matrix, pool.integration, noise)
            of_runs = [information_of_runs(run.runs, *model, stamps=stamps).mean(axis=0) for run in pool.candidates]
            self.information[each] = self.basis.T @ np.array(of_runs) @ self.basis
        # Of three omni wheels the derivatives (9, 9) of the physical parameters by the matrix elements.
        self.physical: Array | None = None
        geometry = WheelGeometry(pool.robot)
        if len(directions) == 3 and class_of(pool.robot) == "omni" and len(geometry.names) == self.basis.shape[1]:
            self.physical = np.linalg.inv(geometry.slopes(geometry.start))

    @cached_property
    def everything(self) -> d_optimality.Candidates:
        """All candidates for the use that is designed for."""
        return self.candidates(self.use)

    def candidates(self, use: Use, name: str | None = None) -> d_optimality.Candidates:
        """The candidates of a set, or all, which are a common measure for designs from different sets.

        ConfigError when they leave part of the matrix undetermined.
        """
        pool = self.pool
        chosen = list(range(len(self.described)) if name is None else pool.sets[name])
        try:
            return d_optimality.Candidates(self.information[use][chosen], self.costs[chosen], self.repetitions)
        except d_optimality.UndeterminedError as error:
            elements = (self.basis @ error.direction).reshape(3, -1)
            direction = direction_in_words(np.linalg.svd(elements)[2][0], pool.robot.drive.names)
            row = int(np.argmax(np.linalg.norm(elements, axis=1))) + 1
            raise ConfigError(
                f"{pool.source}: {'the final poses' if use == 'final' else 'the poses'} of {name or 'all commands'} "
                f"leave row {row} of the matrix undetermined along {direction}; add commands that determine it"
            ) from None

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
        robot, everything = self.pool.robot, self.everything
        covariance = self.basis @ everything.covariance(counts) @ self.basis.T
        deviations = np.sqrt(np.maximum(np.diagonal(covariance), 0.0)).reshape(3, -1)
        first, second, third = (100 * deviations.max(axis=1) / robot.row_scales).tolist()
        return Precision(
            effort=self.effort(counts),
            relative=math.sqrt(everything.root(self.pool.baseline) / everything.root(counts)),
            row_percent=(first, second, third),
            motions=tuple(_motion_precisions(robot, covariance)),
            physical=None if self.physical is None else _physical_spread(self.physical, covariance, robot),
        )

    def step(self, counts: Counts, bound: float) -> Step:
        """The precision of ``counts`` (C,), with its efficiency as a share of ``bound``."""
        return Step(**dict(self.precision(counts)), efficiency=self.everything.criterion(counts) / bound)

    def chosen(self, counts: Counts) -> tuple[Chosen, ...]:
        """The commands that are driven at least once."""
        driven = np.flatnonzero(counts)
        return tuple(Chosen(command=self.described[index].name, runs=int(counts[index])) for index in driven)

    def equivalent(
        self, name: str, use: Use, optimum: d_optimality.ContinuousDesign | None = None, designs: Sequence[Counts] = ()
    ) -> Equivalent:
        """The smallest design for a use that tells as much about the matrix as the baseline.

        optimum, designs: made already for this use, designs from the smallest on; if none tells as much, one is made. A
        use for which none are made may leave part of the matrix undetermined.
        """
        try:
            own, everything = self.candidates(use, name), self.candidates(use)
        except ConfigError:
            return Equivalent(use=use, effort=None, least=None, chosen=())
        optimum = optimum or d_optimality.continuous_optimum(own)
        target = everything.root(self.pool.baseline)
        counts = next((design for design in designs if everything.root(design) >= target), None)
        if counts is None and (in_set := d_optimality.equal_design(own, optimum, target)) is not None:
            counts = self.of_all(name, in_set)
        effort, chosen = (None, ()) if counts is None else (self.effort(counts), self.chosen(counts))
        return Equivalent(use=use, effort=effort, least=target / optimum.bound, chosen=chosen)


def evenly(noise: Noise) -> Noise:
    """A noise model with equal figures (m, rad) for x, y and heading, as Eq. (6) weighs them: the RMS of the three."""
    sizes = {}
    for kind in ("pose", "walk", "bias"):
        position, heading = getattr(noise, f"{kind}_position"), getattr(noise, f"{kind}_heading")
        sizes[f"{kind}_position"] = sizes[f"{kind}_heading"] = math.sqrt((2 * position**2 + heading**2) / 3)
    return Noise(**sizes)


def _described(candidate: CandidateRun, robot: Robot) -> Candidate:
    first = candidate.runs[0]
    picks = np.unique(np.linspace(0, len(first.poses) - 1, _PATH_POINTS).round().astype(int))
    path = np.round(relative(first.start, first.poses[picks]), 5)
    angles = [(np.abs(run.rates) * np.diff(run.times, prepend=0.0)[:, None]).sum(axis=0) for run in candidate.runs]
    return Candidate(
        name=candidate.name,
        speed=first.v,
        direction=first.alpha,
        turn_rate=first.omega,
        duration_s=candidate.duration,
        distance_m=candidate.distance,
        rolled_m=float(np.mean(angles * robot.radii)),
        words=candidate.in_words,
        path=tuple((px, py, ph) for px, py, ph in path.tolist()),
    )


def _motion_precisions(robot: Robot, covariance: Array) -> Iterator[MotionPrecision]:
    """Standard deviations of 1 m of each motion of a robot and of a full turn; covariance (3M, 3M): of the matrix."""
    names = ("1 m ahead", "1 m aside", "a full turn") if robot.slides and not robot.skid else ("1 m", "a full turn")
    for name, motion in zip(names, robot.motions, strict=True):
        length = math.tau / motion[2] if name == "a full turn" else 1 / math.hypot(motion[0], motion[1])
        along = np.kron(np.eye(3), length * robot.signal_equations @ motion)
        x, y, heading = np.sqrt(np.maximum(np.diagonal(along @ covariance @ along.T), 0.0)).tolist()
        yield MotionPrecision(motion=name, position_mm=1000 * math.hypot(x, y), heading_deg=math.degrees(heading))


def _physical_spread(slopes: Array, covariance: Array, robot: Robot) -> PhysicalSpread:
    deviations = np.sqrt(np.diagonal(slopes @ covariance @ slopes.T)).reshape(3, -1)
    design = WheelGeometry(robot).start.reshape(3, -1)
    radius, distance = (100 * deviations[:2] / design[:2]).max(axis=1).tolist()
    return PhysicalSpread(radius_percent=radius, distance_percent=distance, angle_deg=math.degrees(deviations[2].max()))


def design_experiment(
    source: Path | str | Dataset | CandidatePool,
    *,
    use: Use = "trajectory",
    per: Per = "run",
    runs: int | None = None,
    repetitions: int | None = None,
    dataset: str | None = None,
    integration: Integration | None = None,
) -> Design:
    """Choose the runs that shrink the covariance of the matrix elements most, from each set of candidates.

    source: a data set or its folder, a comparison config or a design config. use: the reference poses that a
    calibration uses. per: the cost that is saved: runs, s of driving, or m that the wheels roll. runs: how many to
    choose; default: the fewest within 1 % of the D-optimum. repetitions: how often a command may be chosen at most.
    dataset, integration: see ``read_candidates``. The Fisher information is taken at the design values, with wheel
    rates as exact, so that designs are optimal for matrices near them.

    OmnibenchError in one line: bad source or arguments, candidates that do not determine the whole matrix.
    """
    require_choice("use", use, get_args(Use))
    require_choice("per", per, get_args(Per))
    for name, number in (("runs", runs), ("repetitions", repetitions)):
        if number is not None:
            require_range(name, number, 1, _MOST_RUNS, whole=True)
    pool = source
    if not isinstance(pool, CandidatePool):
        pool = read_candidates(pool, dataset=dataset, integration=integration)
    problem = DesignProblem(pool, use, per, repetitions)
    sets = tuple(_design_of_set(problem, name, runs) for name in pool.sets)
    return Design(
        **{field: getattr(pool, field) for field in _OF_POOL},
        robot=pool.robot.name,
        use=use,
        per=per,
        runs_asked=runs,
        most_repetitions=repetitions,
        parameters=problem.basis.shape[1],
        candidates=problem.described,
        baseline=Baseline(name=pool.baseline_name, precision=problem.precision(pool.baseline)),
        sets=sets,
        notes=(*pool.notes, *_remarks(pool, use, per)),
    )


_OF_POOL = ("source", "name", "description", "simulated", "recorded", "integration", "noise", "noise_source")


def _design_of_set(problem: DesignProblem, name: str, runs: int | None) -> SetDesign:
    """The design from a set: that of ``runs`` runs, else the smallest that is good enough, else the best."""
    candidates, pool = problem.candidates(problem.use, name), problem.pool
    optimum = d_optimality.continuous_optimum(candidates)
    most = max(min(max(int(pool.baseline.sum()), 4 * candidates.parameters), _MOST_STEPS), runs or 0)
    exact = d_optimality.exact_designs(candidates, optimum, range(1, most + 1))
    designs = [problem.of_all(name, counts) for counts in exact if candidates.identifies(counts)]
    steps = [problem.step(counts, optimum.bound) for counts in designs]
    numbers = [step.effort.runs for step in steps]
    if not steps or (runs is not None and runs not in numbers):
        wanted = "no number of runs can" if runs is None else f"{plural(runs, 'run')} cannot"
        span = f"from {numbers[0]} to {numbers[-1]} can" if numbers else "allow more runs or repetitions"
        raise ConfigError(f"{pool.source}: {name}: {wanted} be chosen so that they identify the matrix; {span}")
    best = max(steps, key=lambda step: min(step.efficiency, GOOD_EFFICIENCY))  # the first of those that are good
    chosen = steps.index(best) if runs is None else numbers.index(runs)
    commands = [problem.described[index].name for index in pool.sets[name]]
    shares = {
        command: float(share) for command, share in zip(commands, optimum.shares, strict=True) if share > _LEAST_SHARE
    }
    made = {problem.use: (optimum, designs)}
    return SetDesign(
        name=name,
        commands=tuple(commands),
        optimum=Optimum(shares=shares, gap=optimum.gap, iterations=optimum.iterations),
        chosen=problem.chosen(designs[chosen]),
        step=steps[chosen],
        reached=steps[chosen].efficiency >= GOOD_EFFICIENCY,
        baseline_efficiency=problem.everything.criterion(pool.baseline) / optimum.bound,
        steps=tuple(steps),
        equivalents=tuple(problem.equivalent(name, use, *made.get(use, ())) for use in USES),
    )


def _remarks(pool: CandidatePool, use: Use, per: Per) -> Iterator[str]:
    """Assumptions behind the numbers."""
    logs = "as recorded" if pool.recorded else "as the design values command them"
    yield (
        f"Information is that of the matrix elements at the robot's design values, with wheel rates {logs} and taken "
        "as exact. It assumes that one matrix is the whole truth: to find what a matrix cannot express (slip, speed or "
        "direction dependence), drive other commands too."
    )
    yield "Exact designs are found by exchange, and are local optima; the bound says how far from the best they can be."
    if per == "run":
        yield "A run counts as a run however long it is; --per second or --per metre makes long ones dear."
    if use == "final":
        yield "Only the final pose of a run is used, with the same noise in m and rad, as Eq. (6) weighs it."
