"""Trajectory and Dataset: a robot's recordings, SI units throughout; made from arrays or tables, which are checked."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl
from pydantic import Field
from pydantic_core import to_jsonable_python

from omnibench.config import Model
from omnibench.data import stored
from omnibench.data.references import NUMBERS, TURN, References, reference_flaw, references_of, unwrap, with_whole_turns
from omnibench.data.scans import Scans
from omnibench.data.stored import Flaw, Table
from omnibench.errors import DataError, UnknownNameError, nearest, require_type
from omnibench.robot.calibration import SAMPLE_PERIODS
from omnibench.robot.kinematics import Array, Drive, Robot, interpolated
from omnibench.robot.odometry import Samples, WheelLog, digest_of, with_samples
from omnibench.robot.wheel_logs import frame_of
from omnibench.views import Shown
from omnibench.words import plural, some

Split = Literal["train", "validation"]
SPLITS: tuple[Split, ...] = ("train", "validation")

RUN_NUMBERS = ("started_at", "v", "alpha", "omega", "duration", "distance")
_ARRAYS = (
    *("times", "rates", "pose_times", "poses", "angles", "targets", "pose_covariances", "steering"),
    *("odometry", "sent"),  # recorded, but no fit depends on them
)
_HASHED = (
    *("id", "split", "times", "rates", "pose_times", "poses", "command", "repetition", "session", "started_at"),
    *("v", "alpha", "omega", "duration", "distance", "angles", "targets", "pose_covariances", "steering", "references"),
)

# A reference that moves by more, m and rad, is no noise of one that stands; a robot whose wheels drive less than the
# share of that has a dead encoder. Chosen: motion capture scatters by mm, and no wheel slips a hundredfold.
_MOVED, _TURNED, _HARDLY = 0.05, 0.1, 0.01
_EVERY = 1.0  # s between the moments at which wheel angles are compared where there are no poses; chosen
# The farthest pose from a run's start as a multiple of the wheels' travel and a metre; chosen: poses in mm, which the
# check tells of, are a thousand times too far.
_FARTHEST = 1e4
# A sample period is refused when it is this many times longer or shorter than the median of the stamps; chosen: one in
# ms in the place of s is just within, and warned of.
_MOST_PERIODS = 1001.0
# Share of the runs whose headings are neither wrapped nor those of the wheels, from which on none is unwrapped (chosen:
# in degrees most are such, in radians none); turns within which wrapped headings lie, with what rounding adds.
_CONTRADICTED, _WITHIN = 0.25, 1.001
_SHOWN = 5  # ids in a warning, at most
_ONLY_RUN = "run"  # id of the run of tables without a column "trajectory"
_PERIOD_DECIMALS = 9  # of a sample period in s that is taken from stamps: ns


@with_samples("times", "rates", "angles", "targets", "steering", "odometry")
@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Shown):
    """One recorded run.

    times (F,): end of each wheel sample, s, > 0. rates (F, N): mean wheel rates over each sample, rad/s.
    pose_times (K,): s, the first is 0. poses (K, 3): reference poses x, y (m) and heading (rad). A run without
    motion capture has one, its start: the origin of a frame of its own where it is not known.
    The fields from ``command`` on may be unknown (None).
    """

    id: str
    split: Split
    times: Array
    rates: Array
    pose_times: Array
    poses: Array
    command: str | None = None
    repetition: int | None = None
    session: str | None = None
    started_at: float | None = None  # s since the session's start
    v: float | None = None  # commanded speed, m/s
    alpha: float | None = None  # commanded direction, rad
    omega: float | None = None  # commanded rate of turn, rad/s
    duration: float | None = None  # s
    distance: float | None = None  # commanded length, m
    angles: Array | None = None  # phi, absolute wheel angles at ``times`` (F, N), rad
    targets: Array | None = None  # target rates of the motor controllers (F, N), rad/s
    pose_covariances: Array | None = None  # (K, 3, 3)
    steering: Array | None = None  # steering angles at ``times`` (F, S), rad
    drive: Drive | None = None  # the robot's drive signals where it steers; ``make_dataset`` sets it
    references: References | None = None  # distances, turns and the like that were measured in the place of poses
    odometry: Array | None = None  # x, y (m), heading (rad) at ``times`` (F, 3) that the robot computed; not used
    sent: Array | None = None  # motion commands (C, 5) sent in the run: t (s), v, alpha, omega, validity t_r (s)
    samples: Samples = field(default=Samples({}), kw_only=True)  # the arrays (F, ...) above, which this handle gives

    @property
    def signals(self) -> Array:
        """Drive signals (F, M) of the wheel samples, rad/s: the rates, where the robot does not steer."""
        return self.samples.signals(self.drive)

    @cached_property
    def angles_at_poses(self) -> Array:
        """Integrals (K, M) of the drive signals up to each reference pose, rad; without poses once a second."""
        times = np.append(0.0, self.times)
        driven = np.cumsum(self.signals * np.diff(times)[:, None], axis=0)
        stamps = self.pose_times if self.has_poses else np.arange(0.0, times[-1] + _EVERY, _EVERY)
        return interpolated(stamps, times, np.vstack([np.zeros(driven.shape[1]), driven]))

    @property
    def has_poses(self) -> bool:
        """True if there is a reference pose after the start."""
        return len(self.pose_times) > 1

    @property
    def end(self) -> float:
        """Time of the last reference pose, of a run without any that of its last wheel sample, s."""
        return float(self.pose_times[-1]) if self.has_poses else self.samples.end

    @property
    def start_known(self) -> bool:
        """True if the start pose is one of the reference's frame; False: the origin of a frame of the run's own."""
        return self.references is None or self.has_poses or self.references.start_known

    @property
    def start(self) -> Array:
        """The reference pose at t = 0."""
        return self.poses[0]

    @property
    def final_pose(self) -> Array:
        """The last reference pose."""
        return self.poses[-1]

    @cached_property
    def fingerprint(self) -> str:
        """Sixteen hex digits of the run's content, whatever its name, split and file format.

        The first 8 begin the SHA-256 of the wheel samples, the others that of the reference poses.
        """
        references = [] if self.references is None else [repr(self.references.content).encode()]
        return self.samples.digest + digest_of(self.pose_times, self.poses, *references)[:8]

    def log(self, stamps: Sequence[float] | Array) -> WheelLog:
        """The wheel rates from the start pose, with poses wanted at ``stamps`` (s)."""
        known: dict[str, Any] = {"samples": self.samples, "started_at": self.started_at, "session": self.session}
        return WheelLog(start=self.start, stamps=np.asarray(stamps, dtype=float), drive=self.drive, **known)

    @property
    def final_log(self) -> WheelLog:
        """The log up to the last reference pose."""
        return self.log(self.pose_times[-1:])

    @property
    def reference_log(self) -> WheelLog:
        """The log with a stamp at every reference pose after the start."""
        return self.log(self.pose_times[1:])


class Imported(Model):
    """The importer, the source and the options as they were given: what was typed."""

    importer: str = Field(description="name of the importer")
    source: str = Field(description="file or folder, as it was given")
    options: dict[str, Any] = Field({}, description="options as they were given")

    @classmethod
    def of(cls, importer: str, source: Path, options: Mapping[str, Any]) -> Imported:
        """The import of a source; options are kept as JSON can hold them."""
        return cls(importer=importer, source=str(source), options=to_jsonable_python(dict(options), fallback=str))


@dataclass(frozen=True, eq=False, repr=False)
class Dataset(Shown):
    """Recordings of one robot. Make it with :func:`make_dataset`, which checks them and unwraps headings.

    scans: scans of its laser scanner, if it has one and they were recorded. referenced: the poses are reference poses;
    False: they are placeholders until ``slam_dataset`` makes poses from the scans, and the data set cannot be saved.
    """

    name: str
    robot: Robot
    sample_period: float
    trajectories: tuple[Trajectory, ...]
    description: str = ""
    source: str = ""
    licence: str = ""
    simulated: bool = False
    warnings: tuple[str, ...] = field(default=())
    scans: Scans | None = None
    referenced: bool = True
    imported: Imported | None = None

    def __len__(self) -> int:
        return len(self.trajectories)

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self.trajectories)

    def __contains__(self, name: object) -> bool:
        return any(run.id == name for run in self.trajectories)

    def __getitem__(self, name: str | int) -> Trajectory:
        """A run by its id, or by its number from 0 on. UnknownNameError, IndexError: there is none."""
        if not isinstance(name, str):
            return self.trajectories[name]
        if name not in self:
            raise UnknownNameError("run", name, (run.id for run in self.trajectories), f"data set {self.name}")
        return next(run for run in self.trajectories if run.id == name)

    def split(self, name: Split) -> tuple[Trajectory, ...]:
        """The trajectories of one split; may be empty. Copies of training runs are not for validation."""
        return tuple(run for run in self.trajectories if run.split == name and run.id not in self.copies)

    @cached_property
    def copies(self) -> tuple[str, ...]:
        """Ids of the runs for validation that are copies of training runs."""
        if len({run.split for run in self.trajectories}) < 2:
            return ()
        training = {run.fingerprint for run in self.trajectories if run.split == "train"}
        return tuple(run.id for run in self.trajectories if run.split != "train" and run.fingerprint in training)

    def fingerprints(self, split: Split) -> tuple[str, ...]:
        """The fingerprints of the trajectories of one split."""
        return tuple(trajectory.fingerprint for trajectory in self.split(split))

    @cached_property
    def hash(self) -> str:
        """SHA-256 of everything a fit could depend on; independent of names and file formats."""
        digest = hashlib.sha256(self.robot.model_dump_json().encode())
        digest.update(repr(self.sample_period).encode())
        for run in self.trajectories:
            for name in _HASHED:
                value = getattr(run, name)
                if name in _ARRAYS and value is not None:
                    digest.update(np.ascontiguousarray(value, dtype=float).tobytes())
                elif isinstance(value, References):
                    digest.update(repr(value.content).encode())
                elif value is not None or name not in ("steering", "references"):  # as of earlier versions
                    # 6, 6.0 and a NumPy 6.0 are the same number
                    digest.update(repr(float(value) if isinstance(value, (int, float)) else value).encode())
        return digest.hexdigest()


def make_dataset(
    name: str,
    robot: Robot,
    sample_period: float | None = None,
    trajectories: Iterable[Trajectory] | Any = None,
    *,
    wheels: Any = None,
    poses: Any = None,
    references: Any = None,
    description: str = "",
    source: str = "",
    licence: str = "",
    simulated: bool = False,
    scans: Scans | None = None,
) -> Dataset:
    """A data set from arrays or data frames, checked as files are checked, with unwrapped headings.

    sample_period: s, that of the wheel samples; default: the median of their stamps. Either

    - ``trajectories``: :class:`Trajectory` objects, one a run, with arrays; or
    - tables: Polars or pandas data frames, or dicts of columns, with the columns of a data set's files.
      wheels: trajectory, t (s), omega_<wheel> (rad/s) of every wheel, steer_<wheel> (rad) of steered ones; poses:
      trajectory, t, x, y (m), theta (rad), the first of a run at t = 0; references: in their place or beside them.
      trajectories: trajectory, split (train or validation), command ...; default: every run of ``wheels``. Without
      ``split`` every second run of a command validates. Tables of one run need no column ``trajectory``.

    DataError names the table, its row (1 is the first) and column, and what is wrong: a missing column or value, times
    that do not increase, a run without a pose at t = 0, two runs of the same name, values that no robot reaches. Units
    and signs are judged by :func:`omnibench.check`.

    >>> import numpy as np
    >>> robot = Robot(name="cart", wheels=[
    ...     Wheel(name="left", type="fixed", radius=0.05, x=0, y=0.15),
    ...     Wheel(name="right", type="fixed", radius=0.05, x=0, y=-0.15)])
    >>> t = np.arange(1, 51) * 0.02
    >>> wheels = {"t": t, "omega_left": np.full(50, 4.0), "omega_right": np.full(50, 4.0)}
    >>> poses = {"t": [0.0, 1.0], "x": [0.0, 0.2], "y": [0.0, 0.0], "theta": [0.0, 0.0]}
    >>> make_dataset("day1", robot, wheels=wheels, poses=poses)
    Dataset 'day1': 1 run (1 train, 0 validation) of robot cart (wheels left, right)
      recorded, 50 wheel samples every 20 ms, 2 reference poses
    """
    require_type(robot, Robot, "Robot(name=..., wheels=[...])")
    if wheels is None and (trajectories is None or poses is not None or references is not None):
        raise DataError(f"data set {name}: wheels is missing: a table with the columns t and omega_<wheel>")
    if wheels is not None and poses is None and references is None:
        raise DataError(f"data set {name}: poses is missing: a table with t, x, y and theta; or references (distances)")
    if not isinstance(sample_period, Real | None):
        raise DataError(f"data set {name}: sample_period is {sample_period!r}, expected a number of seconds")
    if wheels is None:
        runs = [_checked(f"data set {name}", robot, run) for run in trajectories]
    else:
        required = stored.REQUIRED | {"wheels": stored.required_columns(robot)}
        given = {"wheels": wheels, "poses": poses, "references": references}
        frames = {key: frame_of(key, content) for key, content in given.items() if content is not None}
        if all("trajectory" not in frame.columns for frame in frames.values()):
            frames = {key: frame.with_columns(pl.lit(_ONLY_RUN).alias("trajectory")) for key, frame in frames.items()}
        tables = {key: Table(Path(key), frame, required[key]) for key, frame in frames.items()}
        named = tables["wheels"].frame["trajectory"].unique(maintain_order=True)
        listed = frame_of("trajectories", {"trajectory": named} if trajectories is None else trajectories)
        if "split" not in listed.columns:
            commands = listed["command"].to_list() if "command" in listed.columns else [None] * len(listed)
            listed = listed.with_columns(pl.Series("split", every_second(commands), dtype=pl.String))
        of_runs = check_runs(Table(Path("trajectories"), listed, required["trajectories"]))
        samples = stored.samples_in_memory(tables["wheels"], of_runs, robot)
        runs = runs_of_tables(of_runs, samples, tables)
    if sample_period is None:  # the median; that there is no run is said next
        sample_period = round(stored.median_period(runs), _PERIOD_DECIMALS) if runs else 1.0
    made = Dataset(name, robot, sample_period, tuple(runs), description, source, licence, simulated, scans=scans)
    return checked(made)


def _checked(place: str, robot: Robot, run: Any) -> Trajectory:
    """A run with its numbers as arrays, whatever sequences they were given as.

    DataError in one line that begins with ``place``: it is no run, or its split, a shape, a time or a value is wrong.
    """
    if not isinstance(run, Trajectory):
        kind = type(run).__name__
        raise DataError(f"{place}: a trajectory is of type {kind}; of tables give wheels= and poses=, too")
    where = f"{place}: trajectory {run.id}"
    if run.split not in SPLITS:
        hint = nearest(str(run.split), SPLITS)
        raise DataError(f"{where}: split is {run.split!r}; {hint}it must be train or validation")
    if run.references is not None:
        require_type(run.references, References, "References.of([...], end=...)")
    arrays, changed = dict[str, Array](), dict[str, Any]()
    for name in _ARRAYS:
        if (value := getattr(run, name)) is not None:
            try:
                arrays[name] = np.asarray(value, dtype=float)
            except (TypeError, ValueError):
                raise DataError(f"{where}: {name}: expected numbers, in rows of one length") from None
            if arrays[name] is not value:
                changed[name] = arrays[name]
    if run.steering is None and robot.drive.steered:
        raise DataError(f"{where}: it has no steering angles; wheels {', '.join(robot.drive.steered)} steer")
    samples, poses, sent = (np.atleast_1d(arrays.get(name, 0.0)).shape[:1] for name in ("times", "pose_times", "sent"))
    shapes = {"times": samples, "pose_times": poses, "poses": (*poses, 3), "pose_covariances": (*poses, 3, 3)}
    shapes |= dict.fromkeys(("rates", "angles", "targets"), (*samples, len(robot.wheel_names)))
    shapes |= {"steering": (*samples, len(robot.drive.steered)), "odometry": (*samples, 3), "sent": (*sent, 5)}
    for name, array in arrays.items():
        if array.shape != shapes[name]:
            raise DataError(f"{where}: {name} has shape {array.shape}, expected {shapes[name]}")
    if not samples[0] or not poses[0]:
        raise DataError(f"{where}: it has no {'reference poses' if samples[0] else 'wheel samples'}")
    flaws = {name: stored.values_flaw(array) for name, array in arrays.items()}
    flaws["times"] = flaws["times"] or stored.wheel_times_flaw(arrays["times"], run.id)
    flaws["pose_times"] = flaws["pose_times"] or stored.pose_times_flaw(arrays["pose_times"], run.id)
    if run.references is not None:
        flaws["references"] = reference_flaw(run.references, float(arrays["times"][-1]))
    for name, flaw in flaws.items():
        if flaw is not None:
            raise DataError(f"{where}: {name}, row {flaw[0] + 1}: {flaw[1]}")
    return replace(run, **changed) if changed else run


def check_runs(runs: Table) -> Table:
    """The table of runs with its numbers as such. DataError names the row and what is wrong."""
    for column in runs.frame.columns:
        if column in (*RUN_NUMBERS, "repetition"):
            values = runs.floats(column)
            runs.refuse(~values.is_finite(), f"{column} is {{}}; leave it empty if it is not known", values)
            if column == "repetition":
                runs.refuse(values % 1 != 0, "repetition is {}, not a whole number", values)
            runs.frame = runs.frame.with_columns(values.alias(column))
    ids, splits = runs.frame["trajectory"], runs.frame["split"]
    runs.refuse(~ids.is_first_distinct(), "trajectory {} is there twice; give each its own id", ids)
    for row, split in enumerate(splits):
        if split not in SPLITS:
            raise runs.fail(row, f"split is {split!r}; {nearest(str(split), SPLITS)}it must be train or validation")
    return runs


def runs_of_tables(runs: Table, samples: Sequence[Samples], tables: Mapping[str, Table]) -> list[Trajectory]:
    """The runs of a data set's tables by name. DataError names the table, the row and what is wrong.

    runs: see ``check_runs``. samples: of each run. poses: none where all runs have references. references: a row for
    each measurement of a run's motion, with columns trajectory, kind, value and sigma of kinds of one number, value_x,
    value_y, sigma_x and sigma_y of those of two (sigma stands for both where these are empty), t0 and t1, which may be
    missing or empty: the run's start and end; sigma_rate (rad/s) of a gyro's offset, which the turns of a session
    share. commands: the motion commands that were sent in runs, if they were recorded.
    """
    poses, references, commands = (tables.get(name) for name in ("poses", "references", "commands"))
    started = set() if poses is None else set(poses.ids)
    measured: dict[str, References] = {}
    if references is not None:
        numbers = {name: np.full(len(references.frame), np.nan) for name in NUMBERS}
        for name in [name for name in NUMBERS if name in references.frame.columns]:
            numbers[name] = references.floats(name).fill_null(np.nan).to_numpy()
            infinite = np.isinf(numbers[name])
            references.refuse(infinite, f"{name} is {{}}; remove or repair the row", numbers[name].tolist())
        kinds = np.array(["" if kind is None else str(kind).strip() for kind in references.frame["kind"]], dtype=str)
        for index, rows in references.rows_by_run(runs.ids, runs.file.name):
            run, end = runs.ids[index], samples[index].end
            of_rows = {name: values[rows] for name, values in numbers.items()}
            of_run = references_of(kinds[rows], of_rows, start_known=run in started).of_run(0.0, end)
            if (wrong := reference_flaw(of_run, end)) is not None:
                raise references.fail(int(rows[wrong[0]]), wrong[1])
            measured[run] = of_run.by_time()

    def flaw(times: Array, run: str) -> Flaw | None:
        return stored.pose_times_flaw(times, run, fewest=1 if run in measured else 2)

    covariances = stored.present_groups(poses.file, stored.COVARIANCES, poses.frame.columns) if poses else {}
    posed = stored.arrays_of_runs(poses, runs, stored.POSES | covariances, flaw, measured)
    sent = stored.arrays_of_runs(commands, runs, stored.SENT, lambda times, _: stored.times_flaw(times), runs.ids)
    trajectories = []
    for index, row in enumerate(runs.frame.iter_rows(named=True)):
        known = {name: row[name] for name in RUN_NUMBERS if row.get(name) is not None}
        known |= {name: str(row[name]) for name in ("command", "session") if row.get(name) is not None}
        if row.get("repetition") is not None:
            known["repetition"] = round(row["repetition"])
        if (upper := posed[index].get("pose_covariances")) is not None:
            known["pose_covariances"] = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        known["pose_times"] = posed[index].get("times", np.zeros(1))
        known["poses"] = posed[index].get("poses", np.zeros((1, 3)))
        known |= {"references": measured.get(row["trajectory"]), "sent": sent[index].get("sent")}
        trajectories.append(Trajectory(row["trajectory"], row["split"], samples=samples[index], **known))
    return trajectories


def checked(dataset: Dataset) -> Dataset:
    """A data set of runs whose arrays are checked, with unwrapped headings, and with warnings about the runs.

    DataError: there is no run, two have the same id, a pose is farther away than wheels roll, or the sample period is
    far from that of the stamps.
    """
    robot, sample_period, place = dataset.robot, dataset.sample_period, f"data set {dataset.name}"
    drive = None if robot.drive.direct else robot.drive
    runs = [run if run.drive == drive else replace(run, drive=drive) for run in dataset.trajectories]
    if not runs:
        raise DataError(f"{place}: it has no trajectory")
    for identity, count in Counter(run.id for run in runs).items():
        if count > 1:
            raise DataError(f"{place}: trajectory {identity} is there twice; give each its own id")
    moving, standing = 0, list[str]()
    for each in runs:
        steps = np.diff(each.times, prepend=0.0)
        travel = float((np.abs(each.rates) * robot.radii).max(axis=1) @ steps)  # m, of the fastest wheel
        distances = np.linalg.norm(each.poses[:, :2] - each.poses[0, :2], axis=1)
        for row in np.flatnonzero(distances > _FARTHEST * (travel + 1.0))[:1]:
            x, y = each.poses[row, :2]
            pose = f"the pose at {each.pose_times[row]:g} s, x {x:g} and y {y:g}, is {distances[row]:.3g} m from"
            what = f"{pose} the run's start, whose wheels rolled {travel:.3g} m; remove or repair it"
            raise DataError(f"{place}: trajectory {each.id}: {what}")
        moved = np.abs(each.poses - each.poses[0]).max(axis=0)
        if (far := moved > (_MOVED, _MOVED, _TURNED)).any():
            # The reference moves: do the wheels, by the design matrix, travel more than hardly any of it?
            driven = np.abs(each.signals @ robot.inverse_kinematic_matrix.T) * steps[:, None]
            moving += 1
            standing += [each.id] if driven.sum(axis=0).max() < _HARDLY * moved[far].max() else []
        each.samples.summarise()  # while they are at hand
    period, (shortest, longest) = stored.median_period(runs), SAMPLE_PERIODS
    odd = f"sample_period is {sample_period:g} s, but the wheel samples come every {period:g} s (the median)"
    if not period / _MOST_PERIODS < sample_period < period * _MOST_PERIODS:
        raise DataError(f"{place}: {odd}; set it to {period:.3g}")
    if not shortest <= sample_period <= longest:
        expected = f"expected {shortest:g} to {longest:g} s; check the units of the times"
        raise DataError(f"{place}: sample_period is {sample_period:g} s, {expected}")
    recorded = [run.poses[:, 2] for run in runs]
    headings, ambiguous = unwrap(robot, [run.log(run.pose_times) for run in runs], recorded)
    # Wrapped headings lie within a turn, and continuous ones need no turns: others are in degrees, say.
    contradicted = [
        run.id
        for run, before, after in zip(runs, recorded, headings, strict=True)
        if np.ptp(before) > _WITHIN * TURN and not np.array_equal(before, after)
    ]
    if len(contradicted) > _CONTRADICTED * sum(run.has_poses for run in runs):
        headings, ambiguous, standing = recorded, [], []  # in other units runs seem to move too far
    else:
        contradicted = []
    standing = standing if len(standing) < moving else []  # in all runs the wheels are another robot's
    late = [run.id for run in runs if run.pose_times[-1] > run.samples.end * (1 + 1.5 / run.samples.count)]
    concerned = {
        "headings of {} turn otherwise than the wheels, so that all stay as they were recorded": contradicted,
        "headings of {} may be unwrapped wrongly (reference too sparse)": [runs[index].id for index in ambiguous],
        "the reference moves in {} though no wheel turns, which spoils every fit; leave them out": standing,
        "{} with reference poses after the last wheel sample": late,
    }
    warnings = [
        f"{what.format(plural(len(ids), 'trajectory'))}: {some(ids, _SHOWN)}" for what, ids in concerned.items() if ids
    ]
    if not 0.5 < period / sample_period < 2:
        warnings.append(odd)
    for index, (run, before, heading) in enumerate(zip(runs, recorded, headings, strict=True)):
        if heading is not before:  # poses that stay need no memory for a copy
            run = replace(run, poses=np.column_stack([run.poses[:, :2], heading]))
        references = None if run.references is None else with_whole_turns(robot, run.log([0.0]), run.references)
        runs[index] = replace(run, references=references)
    return with_warnings(replace(dataset, trajectories=tuple(runs)), warnings)


def with_warnings(dataset: Dataset, warnings: Iterable[str]) -> Dataset:
    """The data set with more warnings, each once, and with one about copies in its validation split."""
    warnings = list(dict.fromkeys([*dataset.warnings, *warnings]))
    if dataset.copies:
        warnings.append(f"left out of validation, as copies of training runs: {some(dataset.copies, _SHOWN)}")
    return replace(dataset, warnings=tuple(warnings))


def every_second(groups: Sequence[Hashable]) -> list[Split]:
    """Splits by turns within each group, in the order given; the first member trains."""
    return ["train" if number % 2 else "validation" for number in repetitions(groups)]


def repetitions(commands: Sequence[Hashable]) -> list[int]:
    """Number of each run among the runs of its command, from 1, in the order given."""
    seen, numbers = Counter[Hashable](), []
    for command in commands:
        seen[command] += 1
        numbers.append(seen[command])
    return numbers
