"""The calibration file, format ``omnibench-calibration/1``: written by calibrators, read by all other commands.

``odometry`` and ``Calibration.predict`` are for whoever has wheel rates and no data set.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from operator import not_
from pathlib import Path
from typing import Annotated, Any, Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    FiniteFloat,
    PlainSerializer,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from omnibench import config
from omnibench.errors import ConfigError, DataError, require_choice, require_type, shown
from omnibench.files import write_text
from omnibench.robot.corrections import Fade
from omnibench.robot.effects.effect import Term, make_term
from omnibench.robot.kinematics import Array, Mount, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration
from omnibench.robot.physical import PhysicalParameter, read_matrix
from omnibench.robot.wheel_logs import log_of_arrays, logs_of
from omnibench.views import Shown, as_pandas
from omnibench.words import plural

FORMAT: Final = "omnibench-calibration/1"
SAMPLE_PERIODS: Final = (1e-6, 3600.0)  # s: no robot samples its wheels faster or more rarely
_LARGEST_ELEMENT = 1e3  # m or rad per rad of wheel: no wheel is so large
Row = tuple[FiniteFloat, ...]
Fingerprint = Annotated[str, Field(pattern="^[0-9a-f]{16}$")]
Deviation = Annotated[config.NonNegative, Field(le=1e3)]


def _with_names(content: Any) -> Any:
    """Parameters with the names under which they stand."""
    if not isinstance(content, dict):
        return content
    return {name: {"name": name} | each if isinstance(each, dict) else each for name, each in content.items()}


# Physical parameters by their names, as a file holds them: design, value, unit, low, high.
_Parameters = Annotated[
    dict[config.Name, PhysicalParameter],
    BeforeValidator(_with_names),
    PlainSerializer(lambda named: {name: each.model_dump(exclude={"name"}) for name, each in named.items()}),
]


class Slip(config.Model):
    """Scatter of the ends of training runs about the calibrated odometry, which no calibration takes away.

    Standard deviations per root metre that the wheels roll: the way, and the turn times their mean distance from the
    robot's centre.
    """

    heading: Deviation = Field(description="of the heading, rad")
    way: Deviation = Field(description="of the part of that which turns the robot on its way, rad")
    position: Deviation = Field(description="of the place, beside what that turns, m")
    runs: int = Field(ge=1, description="number of training runs that tell it")


class EffectTerm(config.Model):
    """An effect by its name, with the values of its parameters."""

    name: config.Name
    parameters: dict[str, FiniteFloat] = {}
    weights: str | None = Field(
        None, description="of a learned effect: base64 of float32, at most 48 KiB", exclude_if=not_
    )

    @classmethod
    def of(cls, term: Term) -> EffectTerm:
        """A term of a model, as a file holds it."""
        return cls(name=term.name, parameters=dict(term.values), weights=term.weights)

    def term(self, robot: Robot, where: str = "") -> Term:
        """The term of a robot's model. OmnibenchError as ``make_term``; messages begin with ``where``."""
        return make_term(self.name, self.parameters, robot, where, weights=self.weights)


class Noise(config.Model):
    """Standard deviations of the reference's noise: white noise, random walk over time, bias of a run."""

    pose_position: Deviation = Field(0.0, description="white noise of each pose, m")
    pose_heading: Deviation = Field(0.0, description="white noise of each pose, rad")
    walk_position: Deviation = Field(0.0, description="random walk, m per sqrt s")
    walk_heading: Deviation = Field(0.0, description="random walk, rad per sqrt s")
    bias_position: Deviation = Field(0.0, description="constant over a run, m")
    bias_heading: Deviation = Field(0.0, description="constant over a run, rad")


class HeldOutVerdict(config.Model):
    """Verdict on a calibration by held-out runs, beside the design values.

    basis: the runs that were held out from this fit, or, where these are few, quick fits to four fifths of the commands
    by turns, judged on the last fifth.
    verdict: of the errors of the final pose, Eq. (6) of Palacin et al. 2023. Better or worse: the 95 % interval of the
    improvement leaves out 0; undecided: it does not, or the units are too few for one; unknown: nothing was held out.
    Positions (m) and headings (rad) are means over the runs. improvement: share of the design values' Eq. (6) that is
    gone. unit, units, method: what the interval rests on. sentence and detail: all of this in words.
    """

    basis: Literal["held_out", "cross_validation"] = Field("held_out", exclude_if=lambda basis: basis == "held_out")
    verdict: Literal["better", "worse", "undecided", "unknown"]
    runs: tuple[str, ...] = ()
    design_position_m: float | None = None
    position_m: float | None = None
    design_heading_rad: float | None = None
    heading_rad: float | None = None
    improvement: float | None = None
    low: float | None = None
    high: float | None = None
    unit: Literal["command", "run"] | None = None
    units: int = 0
    method: Literal["bootstrap", "Student's t", "none"] = "none"
    sentence: str
    detail: str


class Provenance(config.Model):
    """Origin of a calibration: data set, calibrator with options, versions, costs, outcome, what held-out runs say.

    fitted: None in files of versions that did not write it. on_bounds: no interval is stated of what depends on these.
    """

    dataset: config.Name
    dataset_hash: str
    fitted: tuple[Fingerprint, ...] | None = Field(None, description="fingerprints of the runs that it was fitted to")
    simulated: bool = False
    calibrator: config.Name
    options: dict[str, Any] = {}
    seed: int
    cost: str
    loss: Literal["huber", "student_t"] | None = Field(
        None, description="of the cost's norms; None: as the calibrator takes them", exclude_if=not_
    )
    box: str
    unidentified: Literal["keep", "fit", "shrink", "weigh"] = Field("keep", description="what the data hardly tell")
    tolerance: float | None = Field(None, description="of the design, for map; None: that of the robot's class")
    mount: Literal["known", "fit"] | None = Field(None, description="tracked point of a robot that cannot slide")
    unshrunk_cost: float | None = Field(None, description="training cost before it was shrunk to the design")
    on_bounds: tuple[str, ...] = Field((), description="fitted numbers on a bound of the box")
    versions: dict[str, str] = {}
    training_cost: float | None = None
    validation_cost: float | None = None
    outcome: str
    reason: str = ""
    held_out: HeldOutVerdict | None = None


class ModelExtension(config.Model):
    """Effects beside a matrix (3, M), and how they fade outside the motions that they were fitted to.

    driven, plain, covariance: as in ``Calibration``; without them the effects do not fade.
    """

    effects: tuple[EffectTerm, ...]
    driven: tuple[tuple[FiniteFloat, FiniteFloat, FiniteFloat], ...] | None = None
    plain: tuple[Row, Row, Row] | None = None
    covariance: tuple[Row, ...] | None = None


def extended_model(
    robot: Robot,
    matrix: Array,
    integration: Integration,
    sample_period: float,
    extension: ModelExtension | None,
    where: str = "",
) -> OdometryModel:
    """The odometry model of a matrix (3, M) with effects. OmnibenchError: an effect or a parameter is unknown.

    sample_period: nominal, s. where: what messages begin with.
    """
    if extension is None:
        return OdometryModel(robot, matrix, integration, (), sample_period)
    terms = tuple(term.term(robot, where) for term in extension.effects)
    model = OdometryModel(robot, matrix, integration, terms, sample_period)
    if extension.plain is None or extension.driven is None or extension.covariance is None or not terms:
        return model
    change, driven = matrix - np.array(extension.plain), np.array(extension.driven)
    return replace(model, fade=Fade(robot, change, driven, terms, np.array(extension.covariance)))


def _signal_names(content: dict[str, Any]) -> tuple[str, ...] | None:
    """Names of the drive signals of a calibration's robot; None where they are its wheels."""
    robot: Robot | None = content.get("robot")  # missing if it is wrong
    return None if robot is None or robot.drive.direct else robot.drive.names


class Calibration(Shown, config.Model):
    """The content of a calibration file."""

    format: Literal["omnibench-calibration/1"] = FORMAT
    name: Annotated[
        str, Field(max_length=2 * config.LONGEST_NAME + 1), AfterValidator(config.printable)
    ]  # data set and calibrator
    created: datetime = Field(default_factory=lambda: datetime.now(UTC).replace(microsecond=0))
    robot: Robot
    sample_period: float = Field(ge=SAMPLE_PERIODS[0], le=SAMPLE_PERIODS[1], description="s")
    matrix: tuple[Row, Row, Row] = Field(description="3 x M: m (rows 1, 2) and rad (row 3) per rad of wheel")
    signals: tuple[str, ...] | None = Field(
        default_factory=_signal_names, description="names of the M columns, where they are not the N wheels"
    )
    integration: Integration
    effects: tuple[EffectTerm, ...] = ()
    parameters: _Parameters | None = Field(
        None,
        description="radii, track, ... that matrix and effects mean, with 95 % intervals",
        exclude_if=not_,
    )
    noise: Noise | None = None
    covariance: tuple[Row, ...] | None = Field(None, description="of the matrix, row by row, then of the effects")
    slip: Slip | None = Field(None, description="by which runs scatter about the odometry", exclude_if=not_)
    session: config.Name | None = Field(None, description="what drift terms are measured from")
    driven: tuple[tuple[FiniteFloat, FiniteFloat, FiniteFloat], ...] | None = Field(
        None, description="motions that it was fitted to, m/s, m/s, rad/s; its effects are not known to hold beyond"
    )
    plain: tuple[Row, Row, Row] | None = Field(
        None,
        description="matrix without effects; these fade to it beyond driven motions, as far as they are not sure",
        exclude_if=not_,
    )
    provenance: Provenance | None = None

    @model_validator(mode="after")
    def _shapes_agree(self) -> Calibration:
        signals = self.robot.drive.names
        if self.signals not in (_signal_names({"robot": self.robot}), signals):
            raise ValueError(
                f"signals are {', '.join(self.signals or ()) or 'none'}, but the columns of this robot's matrix are "
                f"{', '.join(signals)}; put them in this order"
            )
        for name, matrix in (("matrix", self.matrix), ("plain matrix", self.plain)):
            for index, row in enumerate(matrix or (), 1):
                if len(row) != len(signals):
                    what = "wheel" if self.robot.drive.direct else "drive signal"
                    raise ValueError(
                        f"row {index} of the {name} has {plural(len(row), 'value')}, "
                        f"the robot has {plural(len(signals), what)}"
                    )
            if matrix is not None and (flaw := matrix_flaw(np.array(matrix))):
                raise ValueError(f"{name} holds {flaw}")
        if self.covariance is not None:
            size = 3 * len(signals) + sum(len(term.parameters) for term in self.effects)
            if [len(row) for row in self.covariance] != [size] * size:
                raise ValueError(f"covariance is not {size} x {size}")
            covariance = np.array(self.covariance)
            largest = float(np.abs(covariance).max())
            symmetric = np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-9 * largest)
            if largest > _LARGEST_ELEMENT**2 or not symmetric:
                raise ValueError("covariance is not symmetric, or its values are impossibly large")
            if np.linalg.eigvalsh(covariance)[0] < -1e-6 * largest:
                raise ValueError(
                    "covariance is not positive semi-definite: it has a negative variance in some direction"
                )
        return self

    @model_serializer(mode="wrap")
    def _without_wheels_as_signals(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without signals where they are the wheels, so that these files stay as they were."""
        written: dict[str, Any] = write(self)
        return {key: value for key, value in written.items() if key != "signals" or not self.robot.drive.direct}

    @property
    def model(self) -> OdometryModel:
        """The odometry model of the file. OmnibenchError: an effect or one of its parameters is unknown."""
        extension = ModelExtension(
            effects=self.effects, driven=self.driven, plain=self.plain, covariance=self.covariance
        )
        where = f"calibration {self.name!r}"
        return extended_model(self.robot, self.matrix_array, self.integration, self.sample_period, extension, where)

    @property
    def matrix_array(self) -> Array:
        """The matrix as an array (3, M)."""
        return np.array(self.matrix)

    @property
    def matrix_without_effects(self) -> Array:
        """The matrix (3, M) for whoever holds no effects: the plain one, where the file has it."""
        return self.matrix_array if self.plain is None else np.array(self.plain)

    @property
    def physical_parameters(self) -> Mapping[str, PhysicalParameter]:
        """The physical parameters by their names; without intervals if the file is older than they are.

        DataError: no wheels near the design have the matrix.
        """
        if self.parameters is not None:
            return self.parameters
        fitted_mount = self.provenance is not None and self.provenance.mount == "fit"
        reading = read_matrix(self.robot, self.matrix_array, effects=self.effects, fitted_mount=fitted_mount)
        if not reading.parameters:
            raise DataError(f"calibration {self.name!r}: {reading.doubt}")
        return {each.name: each for each in reading.parameters}

    @property
    def radius(self) -> Mapping[str, float]:
        """Radii of the wheels, m, by their names."""
        return self._of_wheels("radius")

    @property
    def distance(self) -> Mapping[str, float]:
        """Lever arms of wheels on rollers about the robot's centre, m, by the wheels' names."""
        return self._of_wheels("distance")

    @property
    def angle(self) -> Mapping[str, float]:
        """Directions of the axles of wheels on rollers, rad, by the wheels' names."""
        return self._of_wheels("angle")

    @property
    def track(self) -> float:
        """Effective distance between the wheels of both sides, m. DataError: the robot has no track."""
        return self._single("track")

    @property
    def wheelbase(self) -> float:
        """Distance from the rear axle to the steered wheels, m. DataError: the robot has no wheelbase."""
        return self._single("wheelbase")

    @property
    def mount(self) -> Mount:
        """Pose of the tracked point in the robot's frame: fitted, or else as the robot's file says."""
        known = (self.robot.mount or Mount()).model_dump()
        fitted = {name: each.value for name, each in self.physical_parameters.items() if name.startswith("mount_")}
        return Mount(**known | {name.removeprefix("mount_"): value for name, value in fitted.items()})

    def _of_wheels(self, kind: str) -> Mapping[str, float]:
        """The parameters of one kind by the names of the wheels. DataError: the robot has none."""
        named = self.physical_parameters
        of_wheels = {name.partition("_")[2]: named[name].value for name in named if name.startswith(f"{kind}_")}
        if not of_wheels:
            raise DataError(f"robot {self.robot.name} has no {kind}; it has {', '.join(named)}")
        return of_wheels

    def _single(self, name: str) -> float:
        """The value of a parameter. DataError: the robot has none."""
        named = self.physical_parameters
        if name not in named:
            raise DataError(f"robot {self.robot.name} has no {name}; it has {', '.join(named)}")
        return named[name].value

    def predict(self, wheels: Any, *, start: ArrayLike | None = None) -> Any:
        """Poses by the calibration's odometry: a data frame with t (s), x, y (m) and theta (rad, not wrapped).

        wheels: a run of a data set; or a data frame (Polars, pandas) or a dict of columns: t, the ends of the wheel
        samples (s), omega_<wheel> of every measured wheel (rad/s), steer_<wheel> of steered ones (rad), phi_<wheel>
        where an effect needs them. A table with a column ``trajectory`` is of several runs, and so is the answer, which
        has a row at t = 0 and one for each sample, and is a pandas frame for a pandas frame. start: pose at t = 0;
        default: a run's own, else the origin.

        DataError: a column is missing, or a value is wrong.

        >>> wheels = {f"omega_{name}": [1.0, 1.0] for name in calibration.robot.wheel_names}
        >>> calibration.predict({"t": [0.5, 1.0], **wheels}).shape
        (3, 4)
        """
        import polars as pl  # takes longer than all that imports this module

        model, frames = self.model, []
        for name, log in logs_of(self.robot, wheels, start):
            x, y, theta = model.poses([log])[0].T
            poses = pl.DataFrame({"t": log.stamps, "x": x, "y": y, "theta": theta})
            frames.append(poses if name is None else poses.select(pl.lit(name).alias("trajectory"), pl.all()))
        predicted = pl.concat(frames)
        return as_pandas(predicted) if type(wheels).__module__.startswith("pandas") else predicted

    @property
    def effects_in_words(self) -> str:
        """The effects with their parameters, like ``steering_gain (g 0.1)``, and how many weights there are."""
        words = []
        for term in self.effects:
            numbers = [f"{name} {value:.6g}" for name, value in term.parameters.items()]
            numbers += [] if term.weights is None else [f"{len(term.weights) * 3 // 16} weights"]
            words.append(f"{term.name} ({', '.join(numbers)})")
        return ", ".join(words)

    def check_wheels(self, robot: Robot, owner: str, place: str = "") -> None:
        """DataError: the calibration is for other wheels than a robot's, or for wheels that drive it in another way.

        owner: whose wheels these are, for the message. place: what the message begins with, as an option.
        """
        ours, theirs = self.robot.drive, robot.drive
        for what, one, other in (
            ("wheels", ours.wheels, theirs.wheels),
            ("steered wheels", ours.steered, theirs.steered),
            ("drive signals", ours.names, theirs.names),
        ):
            if one != other:
                raise DataError(
                    f"{place}calibration {self.name!r} is for {what} {', '.join(one) or 'none'}, {owner} has "
                    f"{', '.join(other) or 'none'}; take a calibration of the same robot"
                )


def matrix_flaw(matrix: Array) -> str:
    """The flaw of a matrix (3, M) that no robot can have, as what it holds; empty if there is none."""
    if np.abs(matrix).max() > _LARGEST_ELEMENT:
        return f"{np.abs(matrix).max():g}, which no wheel can drive in m or rad per rad"
    return "" if matrix.any() else "zeros only: no wheel would move the robot"


def matrix_rows(matrix: Array) -> tuple[Row, Row, Row]:
    """A matrix (3, M) as rows of a document."""
    first, second, third = covariance_rows(matrix)
    return first, second, third


def covariance_rows(covariance: Array) -> tuple[Row, ...]:
    """A covariance (n, n) as rows of a document."""
    return tuple(map(tuple, np.asarray(covariance, dtype=float).tolist()))


def read_calibration(path: Path | str) -> Calibration:
    """Read and check a calibration file. DataError names the file and what is wrong."""
    return _checked(partial(config.read_yaml, Path(path)), str(path))


def parse_calibration(text: str, where: str, most: int = config.MOST_VALUES) -> Calibration:
    """Parse and check the text of a calibration file. DataError begins with ``where`` and says what is wrong.

    most: values that the text may have.
    """
    return _checked(partial(config.parse_yaml, text, where, most), where)


def _checked(read: Callable[[], Any], where: str) -> Calibration:
    """The calibration of a document. DataError: it cannot be read, or is none."""
    try:
        content = read()
        version = content.get("format") if isinstance(content, dict) else None
        if version != FORMAT:
            raise DataError(f"{where}: format is {shown(version)}, expected {FORMAT!r}; is this a calibration file?")
        calibration = config.validate(Calibration, content, where)
        for term in calibration.effects:
            term.term(calibration.robot, where)
    except ConfigError as error:
        raise DataError(str(error)) from None
    return calibration


def write_calibration(calibration: Calibration, path: Path | str) -> None:
    """Write a calibration file, whole or not at all. DataError when it cannot be written.

    >>> write_calibration(calibration, "calibration.yaml")
    >>> read_calibration("calibration.yaml") == calibration
    True
    """
    require_type(calibration, Calibration, "read_calibration")
    write_text(Path(path), config.to_yaml(calibration))


def odometry(
    robot: Robot | Calibration,
    times: ArrayLike,
    rates: ArrayLike,
    *,
    steering: ArrayLike | None = None,
    start: ArrayLike = (0.0, 0.0, 0.0),
    stamps: ArrayLike | None = None,
    integration: Integration | None = None,
    angles: ArrayLike | None = None,
) -> Array:
    """Poses (K, 3) of a robot's odometry: x, y in m and the heading in rad, not wrapped.

    robot: its design, or a calibration, effects included. times (F,): end of each wheel sample, s, > 0. rates (F, N):
    mean rate of every measured wheel over the sample, rad/s. steering (F, S): of the steered wheels at the samples'
    ends, rad. start (3,): pose at t = 0. stamps (K,): when poses are wanted, s; default: ``times``. integration: path
    within a sample; default: ``arc``, or the calibration's. angles (F, N): of the wheels, rad, for effects that need
    them. Source: Eq. (1) and (2) of Palacin et al. 2023.

    DataError: a shape, a time or a value is wrong, or an effect needs data that are not given. ConfigError: ``robot``
    is neither.

    >>> import numpy as np
    >>> cart = Robot(name="cart", wheels=[
    ...     Wheel(name="left", type="fixed", radius=0.05, x=0, y=0.15),
    ...     Wheel(name="right", type="fixed", radius=0.05, x=0, y=-0.15)])
    >>> times = np.arange(1, 101) * 0.02
    >>> poses = odometry(cart, times, np.full((100, 2), 4.0))  # 2 s at 0.05 m x 4 rad/s
    >>> poses.shape, bool(np.allclose(poses[-1], [0.4, 0, 0]))
    ((100, 3), True)
    """
    if integration is not None:
        require_choice("integration", integration, get_args(Integration))
    if isinstance(robot, Robot):
        model = OdometryModel.of_design(robot, integration or "arc")
    else:
        require_type(robot, Calibration, "read_calibration, or a Robot with omnibench.Robot(name=..., wheels=[...])")
        model = robot.model
        model = replace(model, integration=integration or model.integration)
    log = log_of_arrays(model.robot, times, rates, start=start, stamps=stamps, steering=steering, angles=angles)
    return model.poses([log])[0]
