"""The result of a discovery: where odometry and reference disagree, what is missing, how sure, how much better.

It serialises itself as ``discovery.json``, which ``omnibench discover`` writes and, with --json, prints. SI units.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, FieldSerializationInfo, field_serializer
from pydantic.dataclasses import dataclass
from pydantic_core import to_jsonable_python

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.fit.noise import NoiseEstimate
from omnibench.fit.sessions import SessionComparison
from omnibench.robot.calibration import Calibration
from omnibench.robot.effects.effect import Stage
from omnibench.robot.kinematics import Array
from omnibench.views import Shown
from omnibench.words import plural

Verdict = Literal["none", "named", "class", "incomplete", "unknown"]
CALIBRATION_FILES = {"extended": "model.yaml", "plain": "plain.yaml"}
SURE = 0.95  # weight of a name from which on it counts as sure, as the verdict "named" is defined
# Probability that an effect is named where none is missing: in one robot of 500. With half or twice of it no verdict
# changes (tests/studies/constants.py).
CHANCE = 0.002
_NORMAL_CHANCE = 2.88  # standard deviations that a normal number exceeds with that probability
_FEW_RUNS = 10  # with fewer, the signs of runs flip in less than 2^9 ways, and no chance falls below CHANCE, 0.002
_FEW_COMMANDS = 4  # up to three motions are what some matrix makes of any wheel rates: nothing contradicts it
_NOT_WRITTEN = Field(exclude=True)
_ChiSquare = Annotated[float, Field(serialization_alias="gain")]


@dataclass(frozen=True)
class EstimatedParameter:
    """A value with its 95 % interval. shape: True if it was chosen among a few values; then it has no interval."""

    name: Annotated[str, _NOT_WRITTEN]
    value: float
    unit: str
    low: float
    high: float
    shape: bool = False

    @field_serializer("low", "high")
    def _bound_or_none(self, bound: float) -> float | None:
        return None if self.shape else bound


@dataclass(frozen=True)
class NamedEffect:
    """An effect that was found.

    weight: probability that this name is right. confusable_with: names that these data cannot tell from it.
    class_weight: probability that this or one of these is right. chi_square: whitened chi-square difference, of
    degrees_of_freedom parameters. in_doubt: why the name is not sure, or nothing. form: how its size varies with a
    covariate, in words, or that it is the textbook's.
    """

    name: str
    stage: Stage
    weight: float
    parameters: tuple[EstimatedParameter, ...]
    confusable_with: tuple[str, ...]
    physics: str
    source: str
    chi_square: _ChiSquare
    degrees_of_freedom: int
    in_doubt: str
    class_weight: Annotated[float, _NOT_WRITTEN]
    form: str = ""

    @field_serializer("parameters")
    def _by_name(self, parameters: tuple[EstimatedParameter, ...]) -> dict[str, EstimatedParameter]:
        return {parameter.name: parameter for parameter in parameters}


@dataclass(frozen=True)
class Candidate:
    """An effect that was tried at one step. chi_square: whitened difference. weight: probability of its name."""

    name: str
    chi_square: _ChiSquare
    degrees_of_freedom: int
    weight: float


@dataclass(frozen=True)
class CovariateDependence:
    """A covariate that the residuals depend on, before any effect is added or after all are.

    covariate: command, elapsed time, heading, place, order of runs, wheel rate, wheel angle, acceleration or stamps.
    p_value: corrected for all covariates that were tried. excess: whitened chi-square beyond chance. description: in
    words. within_ticks: True if rounding to encoder ticks can make as much. weight: probability that what is missing
    depends on this covariate rather than on another that was tried.
    """

    covariate: str
    stage: Stage
    p_value: float
    excess: float
    degrees_of_freedom: int
    description: str
    within_ticks: bool = False
    weight: float = 1.0

    @property
    def counts(self) -> bool:
        """True for a dependence that is neither chance nor possibly encoder quantisation."""
        return self.p_value < CHANCE and not self.within_ticks


@dataclass(frozen=True)
class Absorbed:
    """An effect that the matrix reproduces in these recordings, and the measurement that would tell it."""

    name: str
    stage: Stage
    measurement: str


@dataclass(frozen=True)
class NotLookedFor:
    """An effect that these recordings cannot show, and why."""

    name: str
    reason: str


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

    metric: "eq6" (m and rad, final poses) or "chi2" (whitened, all poses, per number). floor: None where no command is
    repeated, or where a model errs less than repetitions scatter. closed: the share of before - floor that is gone, at
    most all; None where before - floor is not larger than two standard errors, or no command is repeated.
    standard_error: standard error of before - floor; None of a single run.
    """

    metric: Literal["eq6", "chi2"]
    before: float
    after: float
    floor: float | None
    closed: float | None
    standard_error: float | None

    @property
    def beyond_chance(self) -> bool:
        """True if the plain matrix errs more than repetitions allow, by more than chance makes at CHANCE."""
        return self.floor is not None and self.before - self.floor > _NORMAL_CHANCE * (self.standard_error or math.inf)


@dataclass(frozen=True)
class HeldOut:
    """Errors of both models on runs that no fit has seen.

    data: "repetitions" (of the training runs, each fold predicted from the others) or "session" (the validation split,
    which is another session only where sessions were recorded).
    position_m, heading_rad: mean final error before and after.
    """

    data: Annotated[Literal["repetitions", "session"], _NOT_WRITTEN]
    runs: int
    eq6: Gap
    chi2: Gap
    position_m: tuple[float, float]
    heading_rad: tuple[float, float]

    @field_serializer("position_m", "heading_rad")
    def _before_and_after(self, errors: tuple[float, float]) -> dict[str, float]:
        return {"before": errors[0], "after": errors[1]}


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
class ExperimentCommand:
    """A command of an experiment, in words. runs: how often it is driven. seconds: of one run."""

    motion: str
    runs: int
    seconds: float


@dataclass(frozen=True)
class Experiment:
    """The cheapest runs that tell the members of a class apart, beside those that were recorded.

    config: for ``omnibench simulate``, in YAML; empty where no runs tell any members apart. minutes: of the runs, with
    placing the robot. chance: that the right name then has a weight of 0.95, for the member that is hardest to tell.
    chance_recorded: the same after as many minutes of the commands that were recorded. inseparable: pairs of members
    that stay alike whatever is driven.
    """

    separates: tuple[str, ...]
    description: str
    config: str
    commands: tuple[ExperimentCommand, ...] = ()
    runs: int = 0
    minutes: float = 0.0
    chance: float = 0.0
    chance_recorded: float = 0.0
    inseparable: tuple[tuple[str, str], ...] = ()


def verdict_of(
    effects: Sequence[NamedEffect], where: Sequence[CovariateDependence], left: Sequence[CovariateDependence]
) -> Verdict:
    """The verdict. where, left: what the residuals depend on before and after the effects.

    Motors are a stage of their own: naming what they do explains nothing that the odometry gets wrong. What a
    controller does without a name is reported in words, and is nothing that the odometry lacks.
    """
    of_odometry = _of_stage(effects, where, left, motors=False)
    if of_odometry != "none":
        return of_odometry
    of_motors = _of_stage(effects, where, left, motors=True)
    whole: dict[Verdict, Verdict] = {"unknown": "none", "incomplete": "named"}
    return whole.get(of_motors, of_motors)


def lacks_a_name(verdict: Verdict) -> bool:
    """True if something is missing that no effect explains."""
    return verdict in ("unknown", "incomplete")


def _of_stage(
    effects: Sequence[NamedEffect],
    where: Sequence[CovariateDependence],
    left: Sequence[CovariateDependence],
    *,
    motors: bool,
) -> Verdict:
    """The verdict on the motors alone, or on the odometry alone."""
    of_stage = [effect for effect in effects if (effect.stage == "actuator") == motors]
    before, after = (
        any(dependence.counts and (dependence.stage == "actuator") == motors for dependence in dependences)
        for dependences in (where, left)
    )
    if not of_stage:
        return "unknown" if before else "none"
    if all(effect.weight >= SURE for effect in of_stage):
        return "incomplete" if after else "named"
    if all(effect.class_weight >= SURE for effect in of_stage):
        return "class"
    return "incomplete" if any(effect.weight >= SURE for effect in of_stage) else "unknown"


def is_other_session(training: Sequence[Trajectory], held_out: Sequence[Trajectory]) -> bool:
    """True if held-out runs are known to be of sessions that no training run is of."""
    known = {run.session for run in training}
    others = {run.session for run in held_out}
    return bool(others) and None not in known | others and not known & others


def few_in_words(runs: Sequence[Trajectory]) -> str:
    """Runs and commands in words if they are so few that they show hardly anything, else empty."""
    commands = len({run.command for run in runs if run.command is not None})
    if len(runs) >= _FEW_RUNS and (not commands or commands >= _FEW_COMMANDS):
        return ""
    return plural(len(runs), "run") + (f" of {plural(commands, 'command')}" if commands else "")


def experiment_file(number: int) -> str:
    """The name of the file of the experiment of that number, the first being 1."""
    return f"experiment-{number}.yaml"


@dataclass(frozen=True, eq=False, repr=False, config=ConfigDict(arbitrary_types_allowed=True))
class Discovery(Shown):
    """The result of a discovery.

    where, left: what the residuals depend on before and after the effects that were found. absorbed: names of effects
    that the matrix reproduces; measurements: what would identify them. extended, plain: calibrations with and without
    the effects; their files are written in their place, None for the extended one where nothing was added. held_out:
    empty, written as None, where no run could be held out. gap: on the training runs then. dataset: the data set
    without outliers; dataset_hash: that of the whole data set. outliers: number of reference poses that were left out
    of the fits. sessions: comparison of the sessions by the extended model; eq6_of_sessions: Eq. (6) on the validation
    split, m and rad, once the matrices of those that differ are changed. trajectories: names of the training runs.
    before, after: residuals (K, 3) of each of these, reference minus odometry in m, m, rad, at pose_times[1:].
    whitened_before, whitened_after: these, independent and of unit variance under the noise.
    """

    verdict: Verdict
    effects: tuple[NamedEffect, ...]
    where: tuple[CovariateDependence, ...]
    absorbed: tuple[str, ...]
    gap: Gap
    held_out: tuple[HeldOut, ...]
    extended: Annotated[Calibration, Field(serialization_alias="model")]
    plain: Annotated[Calibration, Field(serialization_alias="plain_model")]
    headline: str
    dataset: Dataset
    dataset_hash: str
    simulated: bool
    left: tuple[CovariateDependence, ...]
    candidates: tuple[tuple[Candidate, ...], ...]
    classes: tuple[tuple[str, ...], ...]
    experiments: tuple[Experiment, ...]  # their configs are files beside discovery.json, too
    measurements: tuple[Absorbed, ...]
    not_looked_for: tuple[NotLookedFor, ...]
    hidden: tuple[Hidden, ...]
    steps: tuple[Step, ...]
    extrapolations: Annotated[tuple[Extrapolation, ...], Field(serialization_alias="novelties")]
    notes: tuple[str, ...]
    noise: NoiseEstimate
    sessions: SessionComparison
    eq6_of_sessions: float | None
    trajectories: Annotated[tuple[str, ...], Field(serialization_alias="runs")]
    poses: int
    outliers: int
    seconds: float
    before: Annotated[tuple[Array, ...], _NOT_WRITTEN]
    after: Annotated[tuple[Array, ...], _NOT_WRITTEN]
    whitened_before: Annotated[tuple[Array, ...], _NOT_WRITTEN]
    whitened_after: Annotated[tuple[Array, ...], _NOT_WRITTEN]

    @property
    def extends(self) -> bool:
        """True if the extended model holds more than the plain matrix."""
        return bool(self.extended.effects)

    @property
    def has_unnamed_term(self) -> bool:
        """True if the extended model holds functions without a name."""
        return any(step.name.startswith("+ unnamed") for step in self.steps)

    @property
    def has_other_session(self) -> bool:
        """True if the validation split is known to be of another session."""
        names = set(self.trajectories)
        split: tuple[list[Trajectory], list[Trajectory]] = ([], [])
        for run in self.dataset.trajectories:
            split[run.id not in names].append(run)
        return is_other_session(*split)

    @property
    def few(self) -> str:
        """The training runs in words if they are so few that they show hardly anything, else empty."""
        names = set(self.trajectories)
        return few_in_words([run for run in self.dataset.trajectories if run.id in names])

    @field_serializer("held_out")
    def _by_data(self, held_out: tuple[HeldOut, ...]) -> dict[str, HeldOut] | None:
        return {held.data: held for held in held_out} or None

    @field_serializer("extended", "plain")
    def _file(self, _: Calibration, info: FieldSerializationInfo) -> str | None:
        if info.field_name == "extended" and not self.extends:
            return None
        return str(Path(info.context or "", CALIBRATION_FILES[info.field_name]).resolve())

    @field_serializer("dataset")
    def _name(self, dataset: Dataset) -> str:
        return dataset.name

    @field_serializer("trajectories")
    def _count(self, trajectories: tuple[str, ...]) -> int:
        return len(trajectories)

    @field_serializer("noise")
    def _components(self, estimate: NoiseEstimate) -> dict[str, object]:
        values = vars(estimate).copy()
        return {"components": values.pop("noise"), **values}


def discovery_document(discovery: Discovery, folder: Path) -> dict[str, Any]:
    """The content of discovery.json. folder: where the calibrations are, or will be."""
    document: dict[str, Any] = to_jsonable_python(discovery, context=folder)
    return document
