"""Saved state of one robot, which outlives its node: pose, wheel angles, and a calibration that was swapped in.

The pose goes to the two slots of one file in turn, so that a node that is killed while it writes leaves the other slot.
A state is one line of JSON after its CRC-32, by which a slot that was written in part is known. The line is padded to
whole blocks of the disk: one block for most robots, several for a robot with many wheels.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import logging
import os
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from pydantic import Field, FiniteFloat, ValidationError, model_validator

from omnibench.config import Model, read_model, to_yaml
from omnibench.errors import ConfigError, DataError
from omnibench.files import check_file, read_bytes, remove, write_text
from omnibench.robot.calibration import Calibration, read_calibration

LOG = logging.getLogger("omnibench.live")
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
    the session began. flows: flow of an acknowledged replay -> number of the next message that is not in the odometry.
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
