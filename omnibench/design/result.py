"""What a design says: the document of ``omnibench design --json``."""

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
    """What driving some runs takes."""

    runs: int
    seconds: float
    metres: float = Field(description="way of the robot's centre")
    wheel_metres: float = Field(description="way that the wheels roll, mean of the wheels")


class PhysicalSpread(Model):
    """Standard deviation of the physical parameters, of each kind the largest."""

    radius_percent: float
    distance_percent: float
    angle_deg: float


class Precision(Model):
    """How well some runs tell the matrix.

    relative: the geometric mean of the standard deviations as a multiple of the baseline's. row_percent: the largest
    standard deviation of an element of each row, % of the row's largest element. physical: for three wheels.
    """

    effort: Effort
    relative: float
    row_percent: tuple[float, float, float]
    physical: PhysicalSpread | None


class Step(Precision):
    """A design of some runs. efficiency: its det(M)^(1/p) per run (or s, m) as a share of what none can exceed."""

    efficiency: float


class Chosen(Model):
    """A command and how often it is driven."""

    command: str
    runs: int


class Equivalent(Model):
    """The smallest design found that tells as much as the baseline; effort None when there is none within the limits.

    least: no design whatever does it with less, in runs, s or m, by the bound; None where such a calibration leaves
    part of the matrix open.
    """

    use: Use
    effort: Effort | None
    least: float | None
    chosen: tuple[Chosen, ...]


class Optimum(Model):
    """The continuous optimum: shares of the cost, and by how much it can fall short of the bound at most."""

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
    """The experiment that designs are measured by."""

    name: str
    precision: Precision


class Design(Model):
    """Which commands are worth driving."""

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
        """The candidate of a name."""
        return next(each for each in self.candidates if each.name == name)
