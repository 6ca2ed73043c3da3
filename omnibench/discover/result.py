"""What a discovery says: where, what, how sure, how much better."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from omnibench.data.dataset import Dataset
from omnibench.fit.least_squares.noise import NoiseEstimate
from omnibench.robot.calibration import Calibration
from omnibench.robot.effects.effect import Stage
from omnibench.robot.kinematics import Array

Verdict = Literal["none", "named", "class", "incomplete", "unknown"]


@dataclass(frozen=True)
class EstimatedParameter:
    """A value with its 95 % interval. shape: it was chosen among a few, and has no interval."""

    name: str
    value: float
    unit: str
    low: float
    high: float
    shape: bool = False


@dataclass(frozen=True)
class NamedEffect:
    """An effect that was found.

    weight: the probability that this name is right. confusable_with: names that these data cannot tell from it.
    gain: by how much it lowers the whitened chi2, of degrees_of_freedom parameters; in doubt: why it is not sure.
    """

    name: str
    stage: Stage
    weight: float
    parameters: tuple[EstimatedParameter, ...]
    confusable_with: tuple[str, ...]
    physics: str
    source: str
    gain: float
    degrees_of_freedom: int
    in_doubt: str = ""


@dataclass(frozen=True)
class Candidate:
    """An effect that was tried at one step. weight: among those tried; gain: in whitened chi2."""

    name: str
    gain: float
    degrees_of_freedom: int
    weight: float


@dataclass(frozen=True)
class Place:
    """Where the residual depends on something, before any effect is added or after all are.

    covariate: command, elapsed time, heading, place, order of runs, wheel rate, wheel angle, acceleration or stamps.
    p_value: with all that was looked at counted. excess: whitened chi2 beyond chance. description: in words.
    within_ticks: rounding to encoder ticks can make as much.
    """

    covariate: str
    stage: Stage
    p_value: float
    excess: float
    degrees_of_freedom: int
    description: str
    within_ticks: bool = False


@dataclass(frozen=True)
class Absorbed:
    """An effect that any matrix reproduces here, and the measurement that would tell it."""

    name: str
    stage: Stage
    measurement: str


@dataclass(frozen=True)
class Hidden:
    """How large an effect could still hide: its parameter lies within +-limit with 95 %. detectable: found nearly
    always from this size on."""

    name: str
    parameter: str
    unit: str
    limit: float
    detectable: float
    plausible: float


@dataclass(frozen=True)
class Gap:
    """The error of the plain matrix (before), of the extended model (after), and what repetitions allow (floor).

    metric: "eq6" (m and rad, final poses) or "chi2" (whitened, all poses, per degree of freedom). closed: the share of
    the gap that is gone; None where the gap is not larger than two standard errors. standard_error: of before - floor.
    """

    metric: Literal["eq6", "chi2"]
    before: float
    after: float
    floor: float
    closed: float | None
    standard_error: float


@dataclass(frozen=True)
class HeldOut:
    """The same on runs that no fit has seen.

    data: "repetitions" (of the training runs, each fold predicted from the others) or "session" (the validation split).
    """

    data: Literal["repetitions", "session"]
    runs: int
    eq6: Gap
    chi2: Gap
    position_m: tuple[float, float]  # mean final error before and after
    heading_rad: tuple[float, float]


@dataclass(frozen=True)
class Step:
    """One step of the waterfall: the model after an effect was added. name: "plain matrix" for the first."""

    name: str
    train: float  # whitened chi2 per degree of freedom
    held_out: float | None
    eq6_train: float
    eq6_held_out: float | None


@dataclass(frozen=True)
class Novelty:
    """A motion of the held-out runs that the training runs never drove, and what it does to the intervals."""

    command: str
    description: str
    before_m: float  # predicted 95 % bound of the final position error, plain matrix
    after_m: float  # and extended model


@dataclass(frozen=True)
class Experiment:
    """What would tell the members of a class apart: a config for ``omnibench simulate``, in YAML, and words."""

    separates: tuple[str, ...]
    description: str
    config: str


@dataclass(frozen=True, eq=False)
class Discovery:
    """All that is said.

    plain, extended: calibrations without and with the effects that were found. dataset: outliers taken out;
    dataset_hash: of all of it.
    outliers: reference poses that were left out of the fits. before, after: residuals of the training runs, each
    (K, 3), reference minus odometry in m, m, rad, at pose_times[1:]; whitened_before, whitened_after: the same,
    independent and of unit variance under the noise.
    """

    dataset: Dataset
    dataset_hash: str
    verdict: Verdict
    headline: str
    effects: tuple[NamedEffect, ...]
    candidates: tuple[tuple[Candidate, ...], ...]
    where: tuple[Place, ...]
    left: tuple[Place, ...]
    absorbed: tuple[Absorbed, ...]
    not_looked_for: tuple[tuple[str, str], ...]  # name and why
    classes: tuple[tuple[str, ...], ...]
    hidden: tuple[Hidden, ...]
    gap: Gap
    held_out: tuple[HeldOut, ...]
    steps: tuple[Step, ...]
    novelties: tuple[Novelty, ...]
    experiments: tuple[Experiment, ...]
    notes: tuple[str, ...]
    noise: NoiseEstimate
    outliers: int
    poses: int
    plain: Calibration
    extended: Calibration
    trajectories: tuple[str, ...]
    before: tuple[Array, ...]
    after: tuple[Array, ...]
    whitened_before: tuple[Array, ...]
    whitened_after: tuple[Array, ...]
    seconds: float
