"""The config of a comparison, as its YAML file says it, and as it is once every default is written out.

It names ``datasets``, each of which is judged by its own split, or ``robots``, whose runs are divided into training and
judged runs by kind of path or session.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, field_validator, model_validator

from omnibench.config import Model, NonNegative, Positive, RelativePath, printable, read_model, validate
from omnibench.data.dataset import Dataset, Split
from omnibench.data.splits import Names, training_split
from omnibench.data.storage import dataset_folders, in_few_words, load_dataset
from omnibench.errors import ConfigError, OmnibenchError, PluginError, UnknownNameError
from omnibench.fit.calibrator import as_answered, unloadable
from omnibench.fit.geometry import GeometryLimits
from omnibench.fit.intervals import Bootstrap
from omnibench.fit.loss import LossName
from omnibench.fit.parameterisation import Box, ParameterisationName
from omnibench.fit.prior import MountChoice, default_cost
from omnibench.fit.problem import make_parameterisation
from omnibench.fit.settings import Budget, CompleteSettings, CostChoice, objective_in_words
from omnibench.fit.span import Unidentified
from omnibench.jobs.backend_choice import name_flaw
from omnibench.jobs.job import TlsFiles
from omnibench.registry import PluginFailure, calibrators, costs, load_plugins, plugin_text
from omnibench.robot.kinematics import Robot
from omnibench.robot.odometry import Integration
from omnibench.simulate.source import DatasetSource

LEAST_MEMORY = 256.0  # 10^6 bytes; a worker process has 200 MB before its run begins (measured, RLIMIT_DATA)
THEORETICAL_NAME = "theoretical"  # the calibrator that leaves the design values
AS_RECORDED = "as recorded"  # the regime without any change

Label = Annotated[str, Field(min_length=1, max_length=60), AfterValidator(printable)]


def named(key: str) -> Callable[[Any], Any]:
    """A validator that takes a name alone as a mapping from ``key``."""
    return lambda given: {key: given} if isinstance(given, str) else given


def _known_backend(backend: str) -> str:
    """The name of a backend. ValueError: it is none's."""
    if flaw := name_flaw(backend):
        raise ValueError(flaw)
    return backend


NamedCost = Annotated[CostChoice, BeforeValidator(named("name"), json_schema_input_type=str | CostChoice)]


class TrainingChoice(Model):
    """Which runs train, and so which judge: all that are not among them.

    by: ``split``, the data set's own; ``kind``, all runs of one kind, and other kinds judge; ``session``, one session
    of one kind after another, and all other sessions and kinds judge. leave_out: in the place of ``by``, every session
    (command) of a kind judges what the kind's other ones trained, or each kind what all the others did.
    """

    by: Literal["split", "kind", "session"] | None = None
    leave_out: Literal["session", "command", "kind"] | None = None
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


Rules = tuple[Annotated[TrainingChoice, BeforeValidator(named("by"), json_schema_input_type=str | TrainingChoice)], ...]


class RobotChoice(Model):
    """A robot: its recordings, the kinds of path in them, and how these are divided.

    The recordings are a data set (or a glob, or several), or a folder that an importer reads. Paths are relative to the
    study's ``data``. A data set there that has the robot's name, as ``omnibench fetch`` makes it, is taken where the
    folder to import is not. kinds: patterns of run ids by the name of the kind; runs of none are left out. Default: all
    runs are of one kind.
    """

    path: Names = Field((), description="data set folders, or globs")
    format: str | None = Field(None, description="an importer, see omnibench list; then path is its source")
    options: dict[str, Any] = Field({}, description="the importer's")

    kinds: dict[Label, Names] = {}
    trainings: Rules = Field((), description="default: the study's")

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
    def _place_is_given(self) -> RobotChoice:
        if not self.path:
            raise ValueError("path is missing: the folder of the data set or of the recordings, below the study's data")
        if self.format is not None and len(self.path) > 1:
            raise ValueError("an importer reads one folder; give one path")
        return self


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


class CalibratorEntry(Model):
    """One entry of the comparison: a calibrator with its options.

    What it leaves open is as the config says. family: what it is counted under in the answer on several robots.
    trainings, regimes: patterns of those of the robots that it is run on, beside the runs as recorded.
    """

    name: str = Field(description="a calibrator, see omnibench list")
    label: Label | None = Field(None, description="what tables call it; default: the name and, if it differs, the box")
    options: dict[str, Any] = {}
    parameterisation: ParameterisationName | None = Field(None, description="default: the calibrator's own")
    box: Box | None = Field(None, description="default: the config's box")
    limits: GeometryLimits | None = Field(None, description="limits of the geometry parameterisation; default: its own")
    cost: NamedCost | None = None
    loss: LossName | None = None
    unidentified: Unidentified | None = None
    mount: MountChoice | None = None
    tolerance: Positive | None = None
    family: Literal["ours", "published", "baseline", "other"] = "other"
    trainings: Names = ("*",)
    regimes: Names = ("*",)

    @property
    def shown(self) -> str:
        """Its name in tables, where its box and parameterisation are the usual ones."""
        return self.label or self.name


Entries = tuple[
    Annotated[CalibratorEntry, BeforeValidator(named("name"), json_schema_input_type=str | CalibratorEntry)], ...
]


class CertificateChoice(Model):
    """Precision to which the lowest possible cost in each box is to be proven."""

    gap: float = Field(1e-3, gt=0, lt=1, description="share of the lowest cost that may stay unproven")
    seconds: float = Field(10.0, gt=0, description="time for each box; what is proven by then is reported")
    parts: int | None = Field(None, gt=0, description="most parts of each box, the same on every machine")


class PublishedResult(Model):
    """A result from the literature, on other data, that tables show beside ours."""

    label: str
    source: str
    theoretical_train_cost: Positive
    train_cost: Positive
    train_improvement: float | None = Field(None, lt=1, description="as printed, 0.826 for 82.6 %; default: by costs")
    theoretical_validation_cost: Positive | None = None
    validation_cost: Positive | None = None
    validation_improvement: float | None = Field(None, lt=1, description="as printed; default: by costs")
    seconds: Positive | None = Field(None, description="time of the published calibration, s")
    entry: str | None = Field(None, description="label of the entry that is the same method")
    remarks: tuple[str, ...] = Field((), description="what a reader of these figures must know")

    def costs(self, split: Split) -> tuple[float, float] | None:
        """Costs of the design values and of the calibration on a split; None where one of them was not published."""
        if split == "train":
            return self.theoretical_train_cost, self.train_cost
        if self.theoretical_validation_cost is None or self.validation_cost is None:
            return None
        return self.theoretical_validation_cost, self.validation_cost

    def improvement(self, split: Split) -> float | None:
        """Share of the cost of the design values that was saved: as printed, or else from the costs as printed."""
        printed = self.train_improvement if split == "train" else self.validation_improvement
        costs = self.costs(split)
        return printed if printed is not None or costs is None else 1 - costs[1] / costs[0]


class CompareConfig(Model):
    """A comparison: data sets, or robots with their trainings and regimes, x calibrators x seeds."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=60)
    description: str = ""
    notes: tuple[str, ...] = Field((), description="what a reader of the report must know")
    datasets: dict[Annotated[str, Field(min_length=1, max_length=60)], DatasetSource] = Field(
        {}, description="each judged by its own split"
    )
    data: RelativePath = Field(Path(), description="folder of the robots' recordings; relative to the config file")
    robots: dict[Label, RobotChoice] = Field({}, description="in the place of datasets: judged by kinds of path, too")
    trainings: Rules = Field((TrainingChoice(by="kind"),), min_length=1, description="of the robots' runs")
    regimes: dict[Label, RegimeChoice] = Field({}, description="ways in which the robots' training runs are made worse")
    cost: NamedCost | None = Field(None, description="default: final_pose; of robots, the cost that calibrate takes")
    loss: LossName = Field(
        "squares",
        description="of the cost's pose errors when they are fitted: as each calibrator takes them (squares), or one "
        "that bounds the influence of poses that are far off, its scale estimated",
        exclude_if=lambda loss: loss == "squares",
    )
    integration: Integration = "arc"
    box: Box = "row"
    unidentified: Unidentified = Field(
        "keep",
        description="what the data hardly tell: keep the design values of motions that they hardly drive, or fit these "
        "to slip and noise; map weighs all against the design",
    )
    mount: MountChoice | None = Field(
        None, description="tracked point of a robot that cannot slide: known, or fitted; default: by the robot's class"
    )
    tolerance: Positive | None = Field(
        None, description="of the design, share of each row's largest element, for map; default: the robot class's"
    )
    budget: Budget = Budget()
    seeds: tuple[int, ...] = Field((1,), min_length=1, description="one run of every search for each")
    calibrators: Entries = Field((), description="what is compared", exclude_if=lambda entries: not entries)
    methods: Entries = Field((), description="another word for calibrators", exclude_if=lambda entries: not entries)
    reference: Label | None = Field(None, description="the entry that is compared with the best published one")
    plugins: tuple[RelativePath, ...] = Field((), description="folders of plug-ins; relative to the config file")
    workers: int | None = Field(None, gt=0, strict=True, description="processes; default: the processors")
    backend: Annotated[str, AfterValidator(_known_backend)] = Field(
        "processes",
        description="where runs are made: processes, dask, or a scheduler of Dask: tcp://HOST:PORT, tls://...",
    )
    tls: TlsFiles | None = Field(None, description="files for a scheduler at tls://; relative to the config file")
    timing: bool = Field(True, description="no: the runs' seconds are not compared, and may be those of a busy machine")
    memory_mb: float | None = Field(
        None, ge=LEAST_MEMORY, description="memory of each run's process, 10^6 bytes; default: no limit"
    )
    bootstrap: Bootstrap = Bootstrap()
    certificate: CertificateChoice | None = Field(
        CertificateChoice(), description="null: prove nothing; of robots nothing is proven"
    )
    published_results: tuple[PublishedResult, ...] = ()

    @property
    def entries(self) -> tuple[CalibratorEntry, ...]:
        """The entries that are compared, of ``calibrators`` or ``methods``."""
        return (*self.calibrators, *self.methods)

    @property
    def cost_name(self) -> str:
        """The name of the cost that data sets are judged by."""
        return (self.cost or CostChoice()).name

    @property
    def objective(self) -> str:
        """The names of the cost and of its loss, if it has a robust one."""
        return objective_in_words(self.cost or CostChoice(), self.loss)

    def settings(self, entry: CalibratorEntry, robot: Robot, runs: int, seed: int) -> CompleteSettings:
        """The settings of an entry's fit to so many runs of a robot."""
        found = calibrators.entry(entry.name)
        cost = entry.cost or self.cost
        if cost is None:
            cost = CostChoice(name=default_cost(robot, runs)) if self.robots else CostChoice()
        unidentified, mount = as_answered(found.cls, entry.unidentified or self.unidentified, entry.mount or self.mount)
        return CompleteSettings(
            calibrator=found.name,
            options=entry.options,
            cost=cost,
            loss=entry.loss or self.loss,
            parameterisation=entry.parameterisation or found.cls.parameterisation,
            box=entry.box or self.box,
            limits=entry.limits,
            integration=self.integration,
            seed=seed,
            budget=self.budget,
            unidentified=unidentified,
            tolerance=entry.tolerance or self.tolerance,
            mount=mount,
        )

    @model_validator(mode="before")
    @classmethod
    def _usual_for_robots(cls, given: Any) -> Any:
        """Robots have many fits, so that each may take less, and nothing is proven of any."""
        if isinstance(given, Mapping) and given.get("robots"):
            return {"budget": {"evaluations": 20_000, "seconds": 60.0}, "certificate": None, **given}
        return given

    @model_validator(mode="after")
    def _fits_together(self) -> CompareConfig:
        if bool(self.datasets) == bool(self.robots):
            raise ValueError("datasets: give datasets, or robots in their place")
        if not self.entries:
            raise ValueError("calibrators: name at least one")
        if self.calibrators and self.methods:
            raise ValueError("methods: is another word for calibrators; give one of the two")
        shown = [entry.shown for entry in self.entries]
        twice = next((name for name in shown if shown.count(name) > 1), None)
        if self.robots and twice is not None:
            raise ValueError(f"two methods are called {twice!r}; give one a label of its own")
        if AS_RECORDED in self.regimes:
            raise ValueError(f"regimes: {AS_RECORDED!r} is the name of the runs without any change; choose another")
        if self.reference is not None and self.reference not in shown:
            raise ValueError(f"reference: no method is called {self.reference!r}; known: {', '.join(shown)}")
        return self

    @field_validator("seeds")
    @classmethod
    def _seeds_differ(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(seeds)) < len(seeds):
            raise ValueError("a seed is given twice")
        if not all(0 <= seed < 2**63 for seed in seeds):
            raise ValueError("seeds must not be negative, and below 2^63")
        return seeds


def load_calibrators(plugins: Iterable[Path], names: Iterable[str]) -> list[PluginFailure]:
    """Load a config's plug-ins. The runs of one that cannot be imported fail with its error, the others run.

    names: the calibrators that the config names.
    """
    failures = load_plugins(plugins)
    missing = set(names) - {entry.name for entry in calibrators.entries()}
    for failure in failures:
        # A plug-in registers its file's name, or names in its text
        file = Path(failure.origin)
        registered = re.findall(r"""calibrators\s*\.\s*register\(\s*["']([^"']+)["']""", plugin_text(file))
        for name in missing & {file.stem, *registered}:
            calibrators.register(name)(unloadable(failure))
            missing.remove(name)
    return failures


def effective_config(config: CompareConfig) -> CompareConfig:
    """The config with every default of every option written out. Refuses unknown names and options."""
    place = f"config {config.name}"
    changes: dict[str, Any] = {}
    if config.cost is not None or config.datasets:
        changes["cost"] = _effective_cost(config.cost or CostChoice(), place)
    for key in ("calibrators", "methods"):
        changes[key] = tuple(
            _effective_entry(entry, f"{place}: {key}.{index}") for index, entry in enumerate(getattr(config, key))
        )
    return config.model_copy(update=changes)


def _effective_cost(choice: CostChoice, place: str) -> CostChoice:
    """A cost with every default of its options. Errors begin with ``place``: an unknown name or option."""
    options = costs.create(choice.name, choice.options, place).options
    return choice.model_copy(update={"options": options.model_dump(mode="json")})


def _effective_entry(entry: CalibratorEntry, place: str) -> CalibratorEntry:
    """An entry with every default of its options. ConfigError begins with ``place``: an unknown name or option."""
    calibrator = calibrators.entry(entry.name, place)
    options = validate(calibrator.options, entry.options, f"{place}: calibrator {entry.name!r}")
    try:
        calibrators.create(entry.name, entry.options)  # a constructor may check its options further
    except PluginError:
        pass  # reported as the outcome of its run
    except OmnibenchError as error:
        raise ConfigError(f"{place}: {error}") from None
    cost = entry.cost and _effective_cost(entry.cost, place)
    return entry.model_copy(update={"options": options.model_dump(mode="json"), "cost": cost})


def read_compare_config(path: Path | str, data: Mapping[str, Path] | None = None) -> CompareConfig:
    """Read a config; paths in it are relative to its folder and come back absolute.

    data: sources of data sets by name, in the place of the config's, the name "" standing for the only one; of robots
    the folder of all under the name "", and that of one under its name. ConfigError in one line.
    """
    path, places = Path(path), dict(data or {})
    config = read_model(CompareConfig, path)
    if config.robots:
        base = places.pop("", config.data).resolve()
        robots = dict(config.robots)
        for name, place in places.items():
            if name not in robots:
                raise UnknownNameError("robot", name, robots, f"--data of {path}")
            robots[name] = robots[name].model_copy(update={"path": (str(place.resolve()),)})
        if not base.is_dir() and not all(
            Path(given).is_absolute() for robot in robots.values() for given in robot.path
        ):
            raise ConfigError(
                f"{path}: the recordings are not at {base}; say where they are with --data DIR (omnibench guide data "
                "says where the public ones come from)"
            )
        return config.model_copy(update={"data": base, "robots": robots})
    sources = dict(config.datasets)
    for name, location in places.items():
        if not name and len(sources) > 1:
            raise ConfigError(f"--data: {path} has several data sets; say which: --data NAME={location}")
        name = name or next(iter(sources))
        if name not in sources:
            raise UnknownNameError("data set", name, sources, str(path))
        sources[name] = sources[name].at(location.resolve())
    return config.model_copy(update={"datasets": sources})


# Evaluations and s of each run: on two cores a first look takes a minute or two (chosen)
_QUICK_EVALUATIONS, _QUICK_SECONDS = 10_000, 30.0
_LONGEST_NAME = 60  # letters, of a config's name


def recording_config(places: Path | Sequence[Path], plugins: Sequence[Path] = ()) -> CompareConfig:
    """A quick comparison on a data set, with cost and treatment of what is hardly driven as ``calibrate`` has.

    places: its folder, or several, named one by one or by a glob. plugins: folders of plug-ins, whose calibrators
    take part. DataError: the data set cannot be read, or has no run to train. PluginError: a folder of plug-ins is not
    there.
    """
    folders = dataset_folders(places)
    dataset = load_dataset(folders)
    load_plugins(plugins)
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", dataset.name).strip("_.-")[:_LONGEST_NAME] or "dataset"
    paths = [str(folder.resolve()) for folder in folders]
    content: dict[str, Any] = {
        "name": name,
        "datasets": {name: {"path": paths if len(paths) > 1 else paths[0]}},
        "cost": default_cost(dataset.robot, len(training_split(dataset))),
        "budget": {"evaluations": _QUICK_EVALUATIONS, "seconds": _QUICK_SECONDS},
        "calibrators": suitable_calibrators(dataset),
        "plugins": [str(path.resolve()) for path in plugins],
    }
    return validate(CompareConfig, content, f"comparison on {in_few_words(folders)}")


def suitable_calibrators(dataset: Dataset) -> list[str]:
    """Names of the registered calibrators that can fit a data set's robot, the design values first.

    A matrix that is not fitted, such as a published one, is another robot's and is left out.
    """
    names = [THEORETICAL_NAME]
    for entry in calibrators.entries():
        if not entry.cls.fitted or not calibrators.create(entry.name).applies(dataset.robot):
            continue
        with suppress(ConfigError):  # this robot has no such parameters
            make_parameterisation(entry.cls.parameterisation, dataset.robot, training_split(dataset))
            names.append(entry.name)
    return names


def config_in_words(config: CompareConfig) -> str:
    """The calibrators, cost and budget of a comparison without a config, in a sentence."""
    names = ", ".join(entry.name for entry in config.entries)
    return (
        f"no config is given: {names}; cost {config.objective}, at most {config.budget.evaluations:,} evaluations and "
        f"{config.budget.seconds:g} s each, one seed (config.yaml beside the results says all of it)"
    )
