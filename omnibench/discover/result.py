"""The result of a discovery: where odometry and reference disagree, what is missing, how sure, how much better."""

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
    """A value with its 95 % interval. shape: True if it was chosen among a few values; then it has no interval."""

    name: str
    value: float
    unit: str
    low: float
    high: float
    shape: bool = False


@dataclass(frozen=True)
class NamedEffect:
    """An effect that was found.

    weight: probability that this name is right. confusable_with: names that these data cannot tell from it.
    class_weight: probability that this or one of these is right. chi_square: whitened chi-square difference, of
    degrees_of_freedom parameters. in_doubt: why the name is not sure, or nothing.
    """

    name: str
    stage: Stage
    weight: float
    parameters: tuple[EstimatedParameter, ...]
    confusable_with: tuple[str, ...]
    physics: str
    source: str
    chi_square: float
    degrees_of_freedom: int
    in_doubt: str
    class_weight: float


@dataclass(frozen=True)
class Candidate:
    """An effect that was tried at one step. chi_square: whitened difference. weight: probability of its name."""

    name: str
    chi_square: float
    degrees_of_freedom: int
    weight: float


@dataclass(frozen=True)
class CovariateDependence:
    """A covariate that the residuals depend on, before any effect is added or after all are.

    covariate: command, elapsed time, heading, place, order of runs, wheel rate, wheel angle, acceleration or stamps.
    p_value: corrected for all covariates that were tried. excess: whitened chi-square beyond chance. description: in
    words. within_ticks: True if rounding to encoder ticks can make as much.
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
    """An effect that the matrix reproduces in these recordings, and the measurement that would tell it."""

    name: str
    stage: Stage
    measurement: str


@dataclass(frozen=True)
class Hidden:
    """Sizes of an effect that was not found: how large it could still be, and from where on it is found.

    limit: its parameter lies within +-limit with 95 %. detectable: size from which on it is found nearly always.
    plausible: the largest size that its catalogue entry expects.
    """

    name: str
    parameter: str
    unit: str
    limit: float
    detectable: float
    plausible: float


@dataclass(frozen=True)
class Gap:
    """Errors of the plain matrix (before) and of the extended model (after), and what repetitions allow (floor).

    metric: "eq6" (m and rad, final poses) or "chi2" (whitened, all poses, per number). closed: the share of before -
    floor that is gone; None where that is not larger than two standard errors, or no command is repeated.
    standard_error: standard error of before - floor.
    """

    metric: Literal["eq6", "chi2"]
    before: float
    after: float
    floor: float
    closed: float | None
    standard_error: float


@dataclass(frozen=True)
class HeldOut:
    """Errors of both models on runs that no fit has seen.

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
    """A step of the waterfall: the model after one more effect. name: "plain matrix" for the first.

    train, held_out: whitened chi-square per number. eq6_train, eq6_held_out: Eq. (6), m and rad.
    """

    name: str
    train: float
    held_out: float | None
    eq6_train: float
    eq6_held_out: float | None


@dataclass(frozen=True)
class Extrapolation:
    """A command of the held-out runs that leaves the training domain.

    before_m, after_m: 95 % bound on the final position's error, by the plain matrix and by the extended model.
    """

    command: str
    description: str
    before_m: float
    after_m: float


@dataclass(frozen=True)
class Experiment:
    """An experiment that tells the members of a class apart. config: for ``omnibench simulate``, in YAML."""

    separates: tuple[str, ...]
    description: str
    config: str


@dataclass(frozen=True, eq=False)
class Discovery:
    """The result of a discovery.

    plain, extended: calibrations without and with the effects that were found. where, left: what the residuals depend
    on before and after these. dataset: the data set without outliers; dataset_hash: that of the whole data set.
    outliers: number of reference poses that were left out of the fits. before, after: residuals (K, 3) of each training
    run, reference minus odometry in m, m, rad, at pose_times[1:]. whitened_before, whitened_after: these, independent
    and of unit variance under the noise.
    """

    dataset: Dataset
    dataset_hash: str
    verdict: Verdict
    headline: str
    effects: tuple[NamedEffect, ...]
    candidates: tuple[tuple[Candidate, ...], ...]
    where: tuple[CovariateDependence, ...]
    left: tuple[CovariateDependence, ...]
    absorbed: tuple[Absorbed, ...]
    not_looked_for: tuple[tuple[str, str], ...]  # name and why
    classes: tuple[tuple[str, ...], ...]
    hidden: tuple[Hidden, ...]
    gap: Gap
    held_out: tuple[HeldOut, ...]
    steps: tuple[Step, ...]
    extrapolations: tuple[Extrapolation, ...]
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
