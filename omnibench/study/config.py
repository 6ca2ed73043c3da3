"""The config of a study: robots, how their runs are divided, methods and regimes, as its YAML file says them."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, field_validator, model_validator

from omnibench.compare.config import LEAST_MEMORY, CalibratorEntry, NamedConfig, known_backend, with_names
from omnibench.config import Model, NonNegative, Positive, RelativePath, printable
from omnibench.data.splits import Names
from omnibench.fit.loss import LossName
from omnibench.fit.parameterisation import Box
from omnibench.fit.prior import MountChoice, default_cost
from omnibench.fit.settings import Budget, CompleteSettings, CostChoice, FitSettings
from omnibench.fit.span import Unidentified
from omnibench.jobs.job import TlsFiles
from omnibench.robot.kinematics import Robot
from omnibench.robot.odometry import Integration
from omnibench.simulate.source import DatasetSource

Label = Annotated[str, Field(min_length=1, max_length=60), AfterValidator(printable)]
TrainingRule = Literal["split", "kind", "session"]
LeftOut = Literal["session", "command", "kind"]
_RULES = ("split", "kind", "session")
RECORDED = "as recorded"  # the regime without any change


class RecordingSource(Model):
    """Recordings of one robot: a data set (or a glob, or several), or a folder that an importer reads.

    Paths are relative to the study's ``data``. A data set there that has the robot's name, as ``omnibench fetch`` makes
    it, is taken where the folder to import is not.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, validate_by_name=True, validate_by_alias=True)

    path: Names = Field((), description="data set folders, or globs")
    format: str | None = Field(None, description="an importer, see omnibench list; then path is its source")
    options: dict[str, Any] = Field({}, description="the importer's")

    def source(self, base: Path, name: str) -> DatasetSource:
        """The source of the robot called ``name``, with its paths below a folder."""
        places = [base / place for place in self.path]
        if self.format is None:
            return DatasetSource(path=tuple(places))
        for place in (places[0], base / name):
            if (place / "dataset.yaml").is_file():
                return DatasetSource(path=place)
            if place.exists():
                break
        return DatasetSource.model_validate(
            {"import": {"format": self.format, "source": places[0], "options": self.options}}
        )

    @model_validator(mode="after")
    def _place_is_given(self) -> RecordingSource:
        if not self.path:
            raise ValueError("path is missing: the folder of the data set or of the recordings, below the study's data")
        if self.format is not None and len(self.path) > 1:
            raise ValueError("an importer reads one folder; give one path")
        return self


class TrainingChoice(Model):
    """Which runs train, and so which judge: all that are not among them.

    by: ``split``, the data set's own; ``kind``, all runs of one kind, and other kinds judge; ``session``, one session
    of one kind after another, and all other sessions and kinds judge. leave_out: in the place of ``by``, every session
    (command) of a kind judges what the kind's other ones trained, or each kind what all the others did.
    """

    by: TrainingRule | None = None
    leave_out: LeftOut | None = None
    kinds: Names = Field((), description="kinds that train; default: each")
    runs_per_command: tuple[Annotated[int, Field(gt=0)], ...] = Field(
        (), description="a learning curve: at most so many runs of each command train, for by: kind"
    )

    @model_validator(mode="after")
    def _one_rule(self) -> TrainingChoice:
        if (self.by is None) == (self.leave_out is None):
            raise ValueError("give one of by (split, kind, session) and leave_out (session, command, kind)")
        if self.runs_per_command and self.by != "kind":
            raise ValueError("runs_per_command is for by: kind")
        if self.kinds and (self.by == "split" or self.leave_out == "kind"):
            raise ValueError("kinds are for by: kind, by: session, leave_out: session and leave_out: command")
        return self


Rules = Annotated[
    tuple[TrainingChoice, ...],
    BeforeValidator(partial(with_names, key="by"), json_schema_input_type=tuple[str | TrainingChoice, ...]),
]


class RobotChoice(RecordingSource):
    """A robot: its recordings, the kinds of path in them, and how these are divided.

    kinds: patterns of run ids by the name of the kind; runs of none are left out. Default: all runs are of one kind.
    """

    kinds: dict[Label, Names] = {}
    trainings: Rules = Field((), description="default: the study's")


class RegimeChoice(Model):
    """A way in which the training runs are made worse; the runs that judge stay as they were recorded.

    runs_per_command: most that train of each command. noise_position (m), noise_heading_deg: standard deviations of
    white noise that is added to every pose. outlier_share: of the poses, which are moved by outlier_size (m) in a
    direction of chance. clock_offset (s): standard deviation over runs of the time by which a reference's stamps are
    late; clock_drift: of what is added to that per second.
    """

    runs_per_command: int | None = Field(None, gt=0)
    noise_position: NonNegative = 0.0
    noise_heading_deg: NonNegative = 0.0
    outlier_share: float = Field(0.0, ge=0, lt=1)
    outlier_size: Positive = 1.0
    clock_offset: NonNegative = 0.0
    clock_drift: NonNegative = 0.0
    trainings: Names = Field(("*",), description="patterns of the trainings' names that it is applied to")

    @property
    def of_poses(self) -> bool:
        """True if reference poses are all that it changes."""
        return self.runs_per_command is None and self != RegimeChoice(trainings=self.trainings)


class MethodChoice(CalibratorEntry):
    """A method: a calibrator with its options and settings.

    family: what it is counted under in the answer. cost, unidentified: default, those that ``calibrate`` takes for the
    robot. trainings, regimes: patterns of those that it is run on, beside the runs as recorded.
    """

    family: Literal["ours", "published", "baseline", "other"] = "other"
    cost: CostChoice | None = None
    loss: LossName = "squares"
    unidentified: Unidentified | None = None
    mount: MountChoice | None = None
    tolerance: Positive | None = None
    trainings: Names = ("*",)
    regimes: Names = ("*",)

    @property
    def shown(self) -> str:
        """Its name in tables."""
        return self.label or self.name

    @field_validator("cost", mode="before", json_schema_input_type=str | CostChoice | None)
    @classmethod
    def _name_stands_for_cost(cls, cost: Any) -> Any:
        return {"name": cost} if isinstance(cost, str) else cost


class StudyConfig(NamedConfig):
    """A study: robots x trainings x regimes x methods x seeds, every method fitted to the same runs."""

    data: RelativePath = Field(Path(), description="folder of the recordings; relative to the config file")
    robots: dict[Label, RobotChoice] = Field(min_length=1)
    trainings: Rules = Field((TrainingChoice(by="kind"),), min_length=1)
    regimes: dict[Label, RegimeChoice] = {}
    methods: tuple[MethodChoice, ...] = Field(min_length=1)
    reference: Label | None = Field(None, description="the method that is compared with the best published one")
    integration: Integration = "arc"
    box: Box = "row"
    budget: Budget = Budget(evaluations=20_000, seconds=60.0)
    seeds: tuple[Annotated[int, Field(ge=0)], ...] = Field(
        (1,), min_length=1, description="one run of every stochastic method for each"
    )
    plugins: tuple[RelativePath, ...] = Field((), description="folders of plug-ins; relative to the config file")
    workers: int | None = Field(None, gt=0, strict=True, description="processes; default: the processors")
    backend: Annotated[str, AfterValidator(known_backend)] = Field("processes", description="as for a comparison")
    tls: TlsFiles | None = None
    timing: bool = Field(True, description="no: the runs' seconds are not compared")
    memory_mb: Annotated[float, Field(ge=LEAST_MEMORY)] | None = Field(None, description="as for a comparison")

    def settings_of(self, method: MethodChoice, robot: Robot, runs: int, seed: int) -> CompleteSettings:
        """The settings of a method's fit to so many runs of a robot; what it leaves open is as usual for these."""
        common = FitSettings(
            cost=method.cost or CostChoice(name=default_cost(robot, runs)),
            loss=method.loss,
            box=self.box,
            integration=self.integration,
            seed=seed,
            budget=self.budget,
            unidentified=method.unidentified or "keep",
            tolerance=method.tolerance,
            mount=method.mount,
        )
        return method.settings(common)

    @field_validator("methods", mode="before", json_schema_input_type=tuple[str | MethodChoice, ...])
    @classmethod
    def _names_stand_for_methods(cls, methods: Any) -> Any:
        return with_names(methods, "name")

    @model_validator(mode="after")
    def _labels_differ(self) -> StudyConfig:
        shown = [method.shown for method in self.methods]
        twice = next((name for name in shown if shown.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"two methods are called {twice!r}; give one a label of its own")
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds: one is there twice: {', '.join(map(str, self.seeds))}")
        if RECORDED in self.regimes:
            raise ValueError(f"regimes: {RECORDED!r} is the name of the runs without any change; choose another")
        if self.reference is not None and self.reference not in shown:
            raise ValueError(f"reference: no method is called {self.reference!r}; known: {', '.join(shown)}")
        return self
