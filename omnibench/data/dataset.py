"""Trajectory and Dataset: a robot's recordings in memory, SI units throughout; and the header of their folder."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from pydantic import Field, model_validator
from pydantic_core import to_jsonable_python

from omnibench.config import Model, Name, Positive, read_yaml, to_yaml, validate
from omnibench.data.checks.finding import findings_of
from omnibench.data.checks.implausible import implausible
from omnibench.data.references import References, odd_references, reference_flaw, with_whole_turns
from omnibench.data.run_checks import check_sample_period, pose_times_flaw, reach_flaw, values_flaw, wheel_times_flaw
from omnibench.data.scans import Scanner, Scans
from omnibench.data.stored_rows import in_file, median_period, noted, period_of
from omnibench.errors import ConfigError, DataError, nearest, require_type, shown
from omnibench.robot.kinematics import Array, Drive, Robot, in_the_middle, interpolated
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog, kept_with_samples
from omnibench.views import Shown
from omnibench.words import plural

TURN = 2 * np.pi  # rad


def unwrap(robot: Robot, logs: Sequence[WheelLog], headings: Sequence[Array]) -> tuple[list[Array], list[int]]:
    """Continuous headings (rad) and the indices of trajectories in which they are ambiguous.

    Every increment gets the whole turns that bring it closest to the design model's odometry. Where the reference is
    dense this is the nearest turn; where it is sparse, the odometry tells how often the robot turned in between. A
    trajectory is ambiguous if the two still differ by more than a quarter turn between two reference poses.
    """
    model = OdometryModel.of_design(robot, "arc")
    unwrapped: list[Array] = []
    ambiguous: list[int] = []
    for index, (odometry, heading) in enumerate(zip(model.poses(logs), headings, strict=True)):
        steps, expected = np.diff(heading), np.diff(odometry[:, 2])
        turns = np.round((expected - steps) / TURN)
        # Added to the headings as recorded, so that continuous ones stay as they are to the bit.
        unwrapped.append(heading + TURN * np.concatenate([[0.0], np.cumsum(turns)]))
        if len(steps) and np.abs(steps + TURN * turns - expected).max() > TURN / 4:
            ambiguous.append(index)
    return unwrapped, ambiguous


FORMAT: Final = "omnibench-dataset/1"


class Imported(Model):
    """The importer, the source and the options as they were given: what was typed."""

    importer: str = Field(description="name of the importer")
    source: str = Field(description="file or folder, as it was given")
    options: dict[str, Any] = Field({}, description="options as they were given")

    @classmethod
    def of(cls, importer: str, source: Path, options: Mapping[str, Any]) -> Imported:
        """The import of a source; options are kept as JSON can hold them."""
        return cls(importer=importer, source=str(source), options=to_jsonable_python(dict(options), fallback=str))


class Header(Model):
    """The content of dataset.yaml."""

    format: Literal["omnibench-dataset/1"] = FORMAT
    name: Name = Field(min_length=1)
    description: str = ""
    source: str = ""
    licence: str = ""
    simulated: bool = Field(False, description="true for simulated data")
    robot: Robot
    sample_period: Positive = Field(description="s")
    wheels: tuple[str, ...] = Field(description="the wheels with a measured rate; column names: omega_<wheel>")
    scanner: Scanner | None = Field(None, description="the scanner, if there are scans")
    imported: Imported | None = Field(None, description="how it was imported; no part of the hash")

    @model_validator(mode="after")
    def _wheels_are_the_robots(self) -> Header:
        if self.wheels != self.robot.wheel_names:
            raise ValueError(
                f"wheels are {', '.join(self.wheels)}, but the robot's wheels with a measured rate are "
                f"{', '.join(self.robot.wheel_names)}; name the same wheels in the same order"
            )
        return self

    @property
    def text(self) -> str:
        """The header as it is written: how it was imported only where that is known."""
        return to_yaml(self.model_dump(mode="json", by_alias=True, exclude=None if self.imported else {"imported"}))


def read_header(folder: Path) -> Header:
    """The dataset.yaml of a data set's folder. DataError: it is none, or it is wrong."""
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "no such folder"
        raise DataError(f"{folder}: {what}; a data set is a folder with dataset.yaml in it")
    file = folder / "dataset.yaml"
    if not file.exists():
        several = any(folder.glob("*/dataset.yaml"))
        way = f"its folders are some: give '{folder}/*'" if several else "`omnibench import` makes one of a log"
        raise DataError(f"{file}: no such file, and so {folder} is no data set; {way}")
    try:
        content = read_yaml(file)
        given = content.get("format") if isinstance(content, dict) else None
        if given != FORMAT:
            raise DataError(f"{file}: format is {shown(given)}, expected {FORMAT!r}")
        return validate(Header, content, str(file))
    except ConfigError as error:
        raise DataError(str(error)) from None


Split = Literal["train", "validation"]
SPLITS: tuple[Split, ...] = ("train", "validation")
# Digits of a fingerprint that tell the wheel samples: a run is taken for one of 1000 others in 1 of 4 million cases.
WHEEL_DIGITS = 8
# A reference that moves by more, m and rad, is no noise of one that stands; a robot whose wheels drive less than the
# share of that has a dead encoder. Chosen: motion capture scatters by mm, and no wheel slips a hundredfold.
_MOVED, _TURNED, _HARDLY = 0.05, 0.1, 0.01
_EVERY = 1.0  # s between the moments at which wheel angles are compared where there are no poses; chosen
_UNUSED = ("odometry", "sent")  # recorded, but no fit depends on them
_ARRAYS = ("times", "rates", "pose_times", "poses", "angles", "targets", "pose_covariances", "steering", *_UNUSED)


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

    def with_arrays(self) -> Trajectory:
        """The run with its numbers as arrays, whatever sequences they were given as. DataError: they are no numbers."""
        if self.references is not None:
            require_type(self.references, References, "References.of([...], end=...)")
        arrays: dict[str, Any] = {}
        for name in _ARRAYS:
            if (value := getattr(self, name)) is not None and not in_file(value):
                try:
                    arrays[name] = np.asarray(value, dtype=float)
                except (TypeError, ValueError):
                    raise DataError(f"trajectory {self.id}: {name}: expected numbers, in rows of one length") from None
        return replace(self, **arrays)

    @kept_with_samples
    def signals(self) -> Array:
        """Drive signals (F, M) of the wheel samples, rad/s: the rates, where the robot does not steer."""
        if self.drive is None:
            return self.rates
        assert self.steering is not None  # the drive steers
        return self.drive.signals(self.rates, in_the_middle(self.steering))

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
        return float(self.pose_times[-1] if self.has_poses else self.times[-1])

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
        reference = _digest(self.pose_times, self.poses)
        if self.references is not None:
            reference.update(repr(self.references.content).encode())
        return self.wheel_digits + reference.hexdigest()[:8]

    @property
    def wheel_digits(self) -> str:
        """The first half of the fingerprint."""
        sampled = (self.times, self.rates) if self.steering is None else (self.times, self.rates, self.steering)
        return noted(self.times, "wheel_digits", lambda: _digest(*sampled).hexdigest()[:WHEEL_DIGITS])

    def log(self, stamps: Sequence[float] | Array) -> WheelLog:
        """The wheel rates from the start pose, with poses wanted at ``stamps`` (s)."""
        wanted = np.asarray(stamps, dtype=float)
        return WheelLog(
            self.times,
            self.rates,
            self.start,
            wanted,
            self.angles,
            self.started_at,
            self.session,
            self.steering,
            self.drive,
        )

    @property
    def final_log(self) -> WheelLog:
        """The log up to the last reference pose."""
        return self.log(self.pose_times[-1:])

    @property
    def reference_log(self) -> WheelLog:
        """The log with a stamp at every reference pose after the start."""
        return self.log(self.pose_times[1:])


@dataclass(frozen=True, eq=False, repr=False)
class Dataset(Shown):
    """Recordings of one robot. Make it with :func:`make_dataset`, which unwraps headings and looks for wrong units.

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
        for trajectory in self.trajectories:
            for item in fields(trajectory):
                value = getattr(trajectory, item.name)
                if item.name in ("drive", *_UNUSED) or (item.name in ("steering", "references") and value is None):
                    continue  # the robot has it; runs without steering or references keep the hash of earlier versions
                if item.name in _ARRAYS and value is not None:
                    digest.update(np.ascontiguousarray(value, dtype=float).tobytes())
                elif isinstance(value, References):
                    digest.update(repr(value.content).encode())
                else:  # 6, 6.0 and a NumPy 6.0 are the same number
                    digest.update(repr(float(value) if isinstance(value, (int, float)) else value).encode())
        return digest.hexdigest()


def make_dataset(
    name: str,
    robot: Robot,
    sample_period: float,
    trajectories: Iterable[Trajectory],
    *,
    description: str = "",
    source: str = "",
    licence: str = "",
    simulated: bool = False,
    scans: Scans | None = None,
) -> Dataset:
    """A data set with unwrapped headings and with warnings about values that cannot be right.

    DataError: there is no trajectory, two have the same id, an array has another shape, other times or other values
    than a data set on disk may have, or the sample period is far from that of the stamps.
    """
    raw = tuple(_with_drive(trajectory, robot) for trajectory in trajectories)
    if not raw:
        raise DataError(f"data set {name}: it has no trajectory")
    matrix, standing = robot.inverse_kinematic_matrix, list[str]()
    seen: set[str] = set()
    for trajectory in raw:
        if trajectory.id in seen:
            raise DataError(f"data set {name}: trajectory {trajectory.id} is there twice; give each its own id")
        seen.add(trajectory.id)
        _check_run(f"data set {name}", robot, trajectory)
        if _moves_unseen(matrix, trajectory):
            standing.append(trajectory.id)
        if in_file(trajectory.times):  # its samples are at hand now, and would be read again
            _ = trajectory.wheel_digits, period_of(trajectory)
    median = median_period(raw)
    check_sample_period(f"data set {name}", sample_period, median)
    logs = [trajectory.log(trajectory.pose_times) for trajectory in raw]
    warnings = implausible(robot, logs, [trajectory.poses for trajectory in raw])
    headings, ambiguous = [trajectory.poses[:, 2] for trajectory in raw], list[int]()
    wrong = {finding.kind for finding in findings_of(warnings)}
    if "heading_unit" not in wrong:  # whole turns of 2 pi would spoil them
        headings, ambiguous = unwrap(robot, logs, headings)
    if ambiguous and not warnings:
        shown = ", ".join(raw[index].id for index in ambiguous[:5])
        warnings = [
            f"headings of {plural(len(ambiguous), 'trajectory')} may be unwrapped wrongly (reference too sparse): "
            f"{shown}"
        ]
    # Where all stand, another warning says so; in other units all runs seem to move too far.
    if 0 < len(standing) < len(raw) and not warnings:
        warnings.append(
            f"the reference moves in {plural(len(standing), 'trajectory')} though no wheel turns, which spoils every "
            f"fit; leave {'it' if len(standing) == 1 else 'them'} out: {', '.join(standing[:5])}"
        )
    warnings += _late_references(raw)
    if not 0.5 < median / sample_period < 2:
        warnings.append(
            f"sample_period is {sample_period:g} s, but the wheel samples come every {median:g} s (the median)"
        )
    unwrapped = [
        replace(trajectory, poses=np.column_stack([trajectory.poses[:, :2], heading]))
        for trajectory, heading in zip(raw, headings, strict=True)
    ]
    unwrapped = [
        run
        if run.references is None
        else replace(run, references=with_whole_turns(robot, run.log([0.0]), run.references))
        for run in unwrapped
    ]
    warnings += odd_references(
        robot, [(run.log([0.0]), run.references) for run in unwrapped if run.references is not None]
    )
    dataset = Dataset(name, robot, sample_period, tuple(unwrapped), description, source, licence, simulated, (), scans)
    if copies := dataset.copies:
        are = "is a copy of a training run and is" if len(copies) == 1 else "are copies of training runs and are"
        warnings.append(f"{plural(len(copies), 'trajectory')} {are} left out of validation: {', '.join(copies[:5])}")
    return replace(dataset, warnings=tuple(warnings))


def _with_drive(trajectory: Trajectory, robot: Robot) -> Trajectory:
    """A run with the drive signals of a robot that steers."""
    drive = None if robot.drive.direct else robot.drive
    return trajectory if trajectory.drive == drive else replace(trajectory, drive=drive)


def _check_run(place: str, robot: Robot, trajectory: Trajectory) -> None:
    """DataError in one line that begins with ``place``: a shape, a time, a value or the split of a run is wrong."""
    where = f"{place}: trajectory {trajectory.id}"
    if trajectory.split not in SPLITS:
        hint = nearest(str(trajectory.split), SPLITS)
        raise DataError(f"{where}: split is {trajectory.split!r}; {hint}it must be train or validation")
    samples, poses = trajectory.times.shape, trajectory.pose_times.shape
    expected: dict[str, tuple[int, ...]] = {"rates": (*samples, len(robot.wheel_names)), "poses": (*poses, 3)}
    expected |= {"angles": expected["rates"], "targets": expected["rates"], "pose_covariances": (*poses, 3, 3)}
    expected |= {"steering": (*samples, len(robot.drive.steered)), "odometry": (*samples, 3)}
    expected |= {} if trajectory.sent is None else {"sent": (len(trajectory.sent), 5)}
    if trajectory.steering is None and robot.drive.steered:
        raise DataError(f"{where}: it has no steering angles; wheels {', '.join(robot.drive.steered)} steer")
    for item, shape in expected.items():
        array = getattr(trajectory, item)
        if len(samples) != 1 or len(poses) != 1 or (array is not None and array.shape != shape):
            given = None if array is None else array.shape
            raise DataError(f"{where}: {item} has shape {given}, expected {shape}")
    if not samples[0] or not poses[0]:
        raise DataError(f"{where}: it has no {'reference poses' if samples[0] else 'wheel samples'}")
    arrays = {name: array for name in _ARRAYS if (array := getattr(trajectory, name)) is not None}
    for name, flaw in (
        *((name, values_flaw(array)) for name, array in arrays.items() if not in_file(array)),
        ("times", None if in_file(trajectory.times) else wheel_times_flaw(trajectory.times, trajectory.id)),
        ("pose_times", pose_times_flaw(trajectory.pose_times, trajectory.id)),
    ):
        if flaw is not None:
            raise DataError(f"{where}: {name}, row {flaw[0] + 1}: {flaw[1]}")
    references, times = trajectory.references, trajectory.times
    if references is not None and (flaw := reference_flaw(references, times)) is not None:
        raise DataError(f"{where}: references, row {flaw[0] + 1}: {flaw[1]}")
    if (flaw := reach_flaw(robot, times, trajectory.rates, trajectory.pose_times, trajectory.poses)) is not None:
        raise DataError(f"{where}: {flaw[1]}")


def _moves_unseen(matrix: Array, run: Trajectory) -> bool:
    """True if the reference moves in a run while the wheels, by the design matrix (3, N), travel hardly any of it."""
    moved = np.abs(run.poses - run.poses[0]).max(axis=0)
    far = moved > (_MOVED, _MOVED, _TURNED)
    if not far.any():
        return False
    driven = np.abs(run.signals @ matrix.T) * np.diff(run.times, prepend=0.0)[:, None]
    return bool(driven.sum(axis=0).max() < _HARDLY * moved[far].max())


def _digest(*arrays: Array) -> hashlib._Hash:
    """SHA-256 of arrays one after another."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array, dtype=float).tobytes())
    return digest


def _late_references(trajectories: Sequence[Trajectory]) -> list[str]:
    late = []
    for trajectory in trajectories:
        last = trajectory.times[-1]
        period = last / len(trajectory.times)
        if trajectory.pose_times[-1] > last + 1.5 * period:
            late.append(trajectory.id)
    if not late:
        return []
    shown = ", ".join(late[:5])
    have = "has reference poses after its" if len(late) == 1 else "have reference poses after their"
    return [f"{plural(len(late), 'trajectory')} {have} last wheel sample, e.g. {shown}"]
