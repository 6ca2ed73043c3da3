"""The result of a design: the document of ``omnibench design --json``."""

from __future__ import annotations

from pydantic import Field

from omnibench.config import Model
from omnibench.design.config import Per, Use
from omnibench.robot.calibration import Noise
from omnibench.robot.odometry import Integration


class Candidate(Model):
    """A command that a design may choose. speed m/s, direction rad, turn_rate rad/s: None where it is not known."""

    name: str
    speed: float | None
    direction: float | None
    turn_rate: float | None
    duration_s: float
    distance_m: float = Field(description="way of the robot's centre")
    rolled_m: float = Field(description="way that the wheels roll, mean of the wheels")
    path: tuple[tuple[float, float, float], ...] = Field(
        exclude=True, repr=False, description="poses along a run from (0, 0, 0), for drawing: m, m, rad"
    )


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
