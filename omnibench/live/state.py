"""State of one robot: its estimators, what came last, and what was refused.

Published stamps: none is published twice, since listeners such as tf2 take a repeated stamp for repeated data.
Extrapolation monitor: how long a robot has driven outside the training domain of its calibration's effects.

Saved state, which outlives the node: pose, wheel angles, and a calibration that was swapped in. The pose goes to the
two slots of one file in turn, so that a node that is killed while it writes leaves the other slot. A state is one line
of JSON after its CRC-32, by which a slot that was written in part is known. The line is padded to whole blocks of the
disk: one block for most robots, several for a robot with many wheels.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import logging
import math
import os
import time
import zlib
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, FiniteFloat, ValidationError, model_validator

from omnibench.config import Model, read_model, to_yaml
from omnibench.errors import ConfigError, DataError
from omnibench.files import check_file, read_bytes, remove, write_text
from omnibench.live.fusion import Fusion, FusionSettings, ReferenceCorrection, Timeline
from omnibench.live.health import Counts, SwapRecord
from omnibench.live.odometry import LiveOdometry, Motion
from omnibench.live.wheels import SteeringInput, WheelInput, WheelSettings, WheelStep, joints_of
from omnibench.robot.calibration import Calibration, read_calibration
from omnibench.robot.corrections import TrainingDomain, extrapolation_consequence
from omnibench.robot.joint_choice import JointChoice
from omnibench.robot.kinematics import Array, CarDrive
from omnibench.words import plural

LOG = logging.getLogger("omnibench.live")
_WINDOW = 0.5  # s, over which a twist is averaged before it is judged; chosen
_TRANSITION = 1.0  # s; a motion that lasts no longer is a transition and does not count; chosen


class ExtrapolationMonitor:
    """Counts the time that a robot drives outside its calibration's training domain; warns in the log the first time.

    seconds: the time so far; None where the calibration has no effects, or does not say what it was fitted to.
    """

    def __init__(self, robot: str, calibration: Calibration) -> None:
        self._robot, self._calibration = robot, calibration
        self._domain: TrainingDomain | None = None
        self.seconds: float | None = None
        if calibration.effects and calibration.driven:
            self._domain, self.seconds = TrainingDomain(calibration.robot, calibration.driven), 0.0
        self._matrix = calibration.matrix_array
        self._lasted = 0.0  # s that the robot has now been outside the domain without a break
        self._driven: Array = np.zeros(self._matrix.shape[1])  # rad, integrals of the signals in the present window
        self._elapsed = 0.0  # s since the present window began

    def take(self, step: WheelStep, driven: Array) -> None:
        """Take a wheel step with the integrals (M,) of its drive signals, rad."""
        if self._domain is None:
            return
        if step.blind:  # its motion is not known
            self._begin()
            return
        self._driven = self._driven + driven
        self._elapsed += step.duration
        if self._elapsed >= _WINDOW:
            self._judge(self._domain, self._matrix @ self._driven / self._elapsed)
            self._begin()

    def _begin(self) -> None:
        self._driven = np.zeros(self._matrix.shape[1])
        self._elapsed = 0.0

    def _judge(self, domain: TrainingDomain, motion: Array) -> None:
        if not domain.is_outside(motion):
            self._lasted = 0.0
            return
        before, self._lasted = self._lasted, self._lasted + self._elapsed
        if self._lasted <= _TRANSITION:
            return
        assert self.seconds is not None
        if not self.seconds:
            LOG.warning(
                "%s: drives motions that %r was not fitted to, such as %s: %s; told once, then counted in health",
                *(self._robot, self._calibration.name, domain.in_words(motion[None])),
                extrapolation_consequence(
                    [term.name for term in self._calibration.effects], fading=self._calibration.plain is not None
                ),
            )
        self.seconds += self._lasted if before <= _TRANSITION else self._elapsed


class PublishedStamps:
    """Stamps (ns) that were published, to be told apart from those that come when the robot's clock jumps back.

    remembered: how many of the latest stamps are kept (some 80 bytes each). A stamp older than these can be published
    twice by chance, after a clock that jumped back so far.
    """

    def __init__(self, remembered: int = 120_000) -> None:
        self._remembered = remembered
        self._order: deque[int] = deque()
        self._known: set[int] = set()  # the stamps of _order, for looking up
        self._shift = 1  # ns by which the last repeated stamp was moved; a recording in a loop moves all alike

    def __len__(self) -> int:
        return len(self._order)

    def unique(self, stamp: int) -> int:
        """``stamp``, or the next free one (ns) if it was published already; the result counts as published."""
        if stamp in self._known:
            if stamp + self._shift in self._known:
                longer = count(self._shift + 1)
                self._shift = next(shift for shift in longer if stamp + shift not in self._known)
            stamp += self._shift
        if len(self._order) == self._remembered:
            self._known.remove(self._order.popleft())
        self._order.append(stamp)
        self._known.add(stamp)
        return stamp


_HISTORY = 5.0  # s of odometry that are remembered without fusion; chosen, as FusionSettings.history
# Largest steering angles, rad, of a car, which drives by their tangents, and of others, 1600 turns one way; chosen.
_FARTHEST_OF_CAR, _FARTHEST = math.radians(85.0), 1e4


@dataclass(slots=True, eq=False)
class RobotState:
    """Everything that samples, poses and orders change.

    fusion: None for odometry alone. guessed_angles: names of the calibration's effects that need wheel angles, while
    nobody has been warned that there are none. arrival: of the last wheel sample, s, monotonic. behind: longest time
    for which a sample had waited when it was taken, s, since the health was last measured. refusals: number of messages
    that were refused for a reason; last_refusal: that of the last. flows: flow of an acknowledged replay -> number of
    the next message that is not in the odometry. last_swap: None before the first calibration is sent.
    """

    name: str
    calibration: Calibration
    counts: Counts
    wheel_input: WheelInput
    odometry: LiveOdometry
    timeline: Timeline
    fusion: Fusion | None
    reference: ReferenceCorrection
    monitor: ExtrapolationMonitor
    guessed_angles: str
    stamps: PublishedStamps = field(default_factory=PublishedStamps)
    arrival: float | None = None
    behind: float = 0.0
    flows: dict[int, int] = field(default_factory=dict)
    refusals: int = 0
    last_refusal: str = ""
    last_swap: SwapRecord | None = None

    def refused(self, reason: str) -> None:
        """Remember why a message was refused."""
        self.refusals += 1
        self.last_refusal = reason


def new_state(name: str, calibration: Calibration, wheels: WheelSettings, fusion: FusionSettings | None) -> RobotState:
    """The state before the first message: odometry at the origin, nobody knows where in the map.

    ConfigError: the joints that ``wheels`` names are not one for each wheel.
    """
    counts, drive = Counts(), calibration.robot.drive
    joints = joints_of(calibration.robot, wheels, f"robot {name!r}: wheels")
    limit = _FARTHEST_OF_CAR if isinstance(drive, CarDrive) else _FARTHEST
    choice = JointChoice(drive.steered, wheels.steering_joints or (), steering=True)
    steering = SteeringInput(joints.steering, choice, limit, counts) if drive.steered else None
    timeline = Timeline(fusion.history if fusion else _HISTORY)
    taken = wheels.for_wheels(calibration.robot.radii)
    return RobotState(
        name=name,
        calibration=calibration,
        counts=counts,
        wheel_input=WheelInput(calibration.robot.wheel_names, taken, calibration.sample_period, counts, steering),
        odometry=LiveOdometry(calibration, (fusion or FusionSettings()).standstill),
        timeline=timeline,
        fusion=Fusion(fusion, timeline, counts) if fusion else None,
        reference=ReferenceCorrection(calibration.model),
        monitor=ExtrapolationMonitor(name, calibration),
        guessed_angles=wheel_angle_effects(calibration),
    )


def wheel_angle_effects(calibration: Calibration) -> str:
    """Names of the calibration's effects that depend on the absolute angles of the wheels."""
    terms = calibration.model.motion_terms
    return ", ".join(term.name for term in terms if "wheel_angles" in term.effect.needs)


_BLOCK = 4096  # bytes, a block of most disks; a state takes some 1000, and 20 more for each wheel
_LONG = 16 * _BLOCK  # bytes; room for some 3000 wheels

# Bounds that no robot reaches; chosen.
Coordinate = Annotated[FiniteFloat, Field(ge=-1e9, le=1e9)]  # m, rad: 25 times round the Earth
SavedPose = tuple[Coordinate, Coordinate, Coordinate]
Moment = Annotated[FiniteFloat, Field(ge=-1e18, le=1e18)]  # m2, m rad, rad2
SavedCovariance = Annotated[tuple[Moment, ...], Field(min_length=9, max_length=9)]
Angle = Annotated[FiniteFloat, Field(ge=-1e12, le=1e12)]  # rad
Time = Annotated[FiniteFloat, Field(ge=0, le=1e11)]  # s, 3000 years
Count = Annotated[int, Field(ge=0, lt=2**64)]


class SavedState(Model):
    """A robot's state after a wheel sample; poses in m, m, rad, covariances (3, 3) row by row.

    sequence: number of the state. stamp: of the sample, ns. wall: unix time of its arrival, s. positions: wheel angles,
    rad. steering: of steered wheels, rad. map_pose: fused pose, once SLAM has located the robot. session_time: s since
    the session began. flows: as RobotState's.
    """

    sequence: Count = 0
    stamp: int = Field(ge=-(2**63), lt=2**63)
    wall: Time
    positions: tuple[Angle, ...] | None
    steering: tuple[Angle, ...] | None = None
    pose: SavedPose
    covariance: SavedCovariance
    map_pose: SavedPose | None = None
    map_covariance: SavedCovariance | None = None
    session_time: Time = 0.0
    flows: dict[Count, Count] = {}

    @model_validator(mode="after")
    def _variances_are_not_negative(self) -> SavedState:
        for covariance in (self.covariance, self.map_covariance or ()):
            if min(covariance[::4], default=0.0) < 0:
                raise ValueError("a variance is negative")
        return self


class SwappedCalibration(Model):
    """A calibration that replaces the config's calibration file, whose SHA-256 is ``instead_of``."""

    instead_of: str
    calibration: Calibration


class RobotMemory:
    """Files with one robot's saved state in a folder, locked for one node.

    ConfigError: another node uses them, or they cannot be written.
    """

    def __init__(self, folder: Path, robot: str) -> None:
        self._path = folder / f"{robot}.state.json"
        self._swapped = folder / f"{robot}.calibration.yaml"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if self._path.exists():
                check_file(self._path)
            self._file: int | None = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise ConfigError(f"{self._path}: cannot be written: {error.strerror}; choose another `state`") from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._file)
            raise ConfigError(f"{self._path}: another node is using it for robot {robot!r}; stop one of them") from None
        self._sequence = 0
        self._configured = ""  # SHA-256 of the config's file when the node started

    def load(self) -> SavedState | None:
        """The newest state that was written whole, or None; a damaged file is a warning in the log."""
        if self._file is None:
            return None
        states: list[SavedState] = []
        slots = [os.pread(self._file, _LONG, place).partition(b"\n")[0] for place in (0, _BLOCK, _LONG)]
        for content in slots:
            checksum, _, text = content.rstrip().partition(b" ")
            if checksum == _checksum(text):  # else torn, or never written
                with suppress(ValueError, ValidationError, RecursionError):
                    states.append(SavedState.model_validate(json.loads(text)))
        if not states and any(slots):
            fault = "of an earlier version, without checksums" if slots[0].startswith(b"{") else "damaged"
            LOG.warning("%s: %s; odom starts at its origin", self._path, fault)
        newest = max(states, key=lambda state: state.sequence, default=None)
        self._sequence = 0 if newest is None else newest.sequence
        return newest

    def save(self, state: SavedState) -> None:
        """Write a state under the next number. OSError: the disk refuses, or the state is longer than a slot."""
        if self._file is None:
            return
        self._sequence += 1
        text = state.model_copy(update={"sequence": self._sequence}).model_dump_json().encode()
        text = _checksum(text) + b" " + text
        slot = _BLOCK if len(text) < _BLOCK else _LONG
        if len(text) >= slot:
            raise OSError(errno.EFBIG, f"it takes {len(text)} bytes")
        blocks = len(text) // _BLOCK + 1
        os.pwrite(self._file, text.ljust(blocks * _BLOCK - 1) + b"\n", (self._sequence % 2) * slot)

    def keep_calibration(self, calibration: Calibration) -> None:
        """Use this calibration after a restart too, unless the config's own file has changed by then.

        DataError: the disk refuses.
        """
        write_text(self._swapped, to_yaml(SwappedCalibration(instead_of=self._configured, calibration=calibration)))

    def calibration(self, configured: Path) -> Calibration:
        """The calibration to start with: the last one swapped in, unless the config's file has changed since."""
        self._configured = hashlib.sha256(read_bytes(configured)).hexdigest()
        if self._swapped.exists():
            try:
                kept = read_model(SwappedCalibration, self._swapped)
            except ConfigError as error:
                raise DataError(f"{error}; remove {self._swapped} to start with {configured}") from None
            if kept.instead_of == self._configured:
                return kept.calibration
            remove(self._swapped)
        return read_calibration(configured)

    def close(self) -> None:
        """Let another node use it. May be called twice."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def _checksum(text: bytes) -> bytes:
    return b"%08x" % zlib.crc32(text)


_PERIOD = 0.1  # s between two states; chosen: a node that is killed loses no more
_RETRY = 10.0  # s until a state that could not be written is tried again; chosen


class StateWriter:
    """Writes a robot's state to its memory; does nothing without one."""

    def __init__(self, memory: RobotMemory | None) -> None:
        self._memory = memory
        # arrival (s, monotonic) of the wheel sample after which the state is to be written; never without a memory
        self._due = -math.inf if memory is not None else math.inf

    def save_if_due(self, state: RobotState) -> None:
        """Write the state unless that was done less than 0.1 s ago."""
        if state.arrival is not None and state.arrival >= self._due:
            self.save(state)

    def save(self, state: RobotState) -> None:
        """Write the state after the last wheel sample; a disk that refuses is counted and told in health."""
        last = state.wheel_input.last_sample
        if self._memory is None or last is None or state.arrival is None:
            return
        self._due = state.arrival + _PERIOD
        stamp, positions, steering = last
        fusion = state.fusion
        fused = (fusion.pose, fusion.covariance) if fusion is not None and fusion.located else (None, None)
        saved = SavedState.model_construct(  # not validated: reading refuses numbers that cannot be
            stamp=stamp,
            wall=time.time() - (time.monotonic() - state.arrival),
            positions=_row(positions),
            steering=_row(steering),
            pose=_row(state.odometry.pose),
            covariance=_row(state.odometry.covariance),
            map_pose=_row(fused[0]),
            map_covariance=_row(fused[1]),
            session_time=state.odometry.session_time,
            flows=dict(state.flows),
        )
        try:
            self._memory.save(saved)
        except OSError as error:  # a full disk must not stop the odometry
            state.counts.failures += 1
            state.refused(f"the state could not be written: {error.strerror}")
            self._due += _RETRY

    def close(self, state: RobotState) -> None:
        """Write the last state and let another node use the memory."""
        self.save(state)
        if self._memory is not None:
            self._memory.close()
            self._memory = None


def _row(values: Array | None) -> Any:
    return None if values is None else tuple(values.ravel().tolist())


def resume_state(state: RobotState, saved: SavedState, now: float, wall: float) -> Motion:
    """Bring a new state to where another node stopped; the motion that begins the timeline there.

    now, wall: monotonic and unix time, s. DataError: the saved state is of a robot with other wheels.
    """
    drive = state.calibration.robot.drive
    for angles, wheels, what in (
        (saved.positions, drive.wheels, "wheel"),
        (saved.steering, drive.steered, "steered wheel"),
    ):
        if angles is not None and len(angles) != len(wheels):
            raise DataError(
                f"the state of robot {state.name!r} is of a robot with {plural(len(angles), what)}; remove it"
            )
    positions, steering = (None if row is None else np.array(row) for row in (saved.positions, saved.steering))
    state.wheel_input.resume(saved.stamp, positions, now - (wall - saved.wall), steering)
    state.flows.update(saved.flows)
    state.odometry.resume(np.array(saved.pose), np.reshape(saved.covariance, (3, 3)), saved.session_time, steering)
    if state.fusion is not None and saved.map_pose is not None and saved.map_covariance is not None:
        state.fusion.begin(np.array(saved.map_pose), np.reshape(saved.map_covariance, (3, 3)))
    state.stamps.unique(saved.stamp)
    return Motion(saved.stamp, 0.0, np.zeros(3), state.calibration.integration, 0.0, 0.0)
