"""What a node remembers of a robot beyond its own death: pose, wheel angles, and a calibration that was swapped in.

The pose goes into one of two slots of one file in turn, so that a node killed in mid-write leaves the other.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from contextlib import suppress
from pathlib import Path

from pydantic import ValidationError

from omnibench.config import Model, read_model, to_yaml
from omnibench.errors import ConfigError, DataError
from omnibench.files import remove, write_text
from omnibench.robot.calibration import Calibration, read_calibration
from omnibench.robot.kinematics import Array

_SLOT = 4096  # bytes


class SavedState(Model):
    """Where a robot was. stamp: ns, of the wheel sample; wall: unix time of its arrival, s; positions: wheel angles."""

    sequence: int
    stamp: int
    wall: float
    positions: tuple[float, ...] | None
    pose: tuple[float, float, float]
    covariance: tuple[float, ...]
    map_pose: tuple[float, float, float] | None = None
    map_covariance: tuple[float, ...] | None = None


class SwappedCalibration(Model):
    """A calibration that took the place of the file that the config names, whose SHA-256 is ``instead_of``."""

    instead_of: str
    calibration: Calibration


class RobotMemory:
    """The memory of one robot in a folder. ConfigError when another node uses it, or it cannot be written."""

    def __init__(self, folder: Path, robot: str) -> None:
        self._path = folder / f"{robot}.state.json"
        self._swapped = folder / f"{robot}.calibration.yaml"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise ConfigError(f"{self._path}: cannot be written: {error.strerror}; choose another `state`") from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._file)
            raise ConfigError(f"{self._path}: another node is using it for robot {robot!r}; stop one of them") from None
        self._sequence = 0

    def load(self) -> SavedState | None:
        """The newest state that was written whole."""
        found: list[SavedState] = []
        for slot in range(2):
            with suppress(ValueError, ValidationError):  # torn, or never written
                found.append(SavedState.model_validate(json.loads(os.pread(self._file, _SLOT, slot * _SLOT))))
        newest = max(found, key=lambda state: state.sequence, default=None)
        self._sequence = 0 if newest is None else newest.sequence
        return newest

    def save(
        self,
        stamp: int,
        wall: float,
        positions: Array | None,
        odometry: tuple[Array, Array],
        fused: tuple[Array, Array] | None,
    ) -> None:
        """Write where the robot is; pairs are pose (3,) and covariance (3, 3)."""
        self._sequence += 1
        state = {
            "sequence": self._sequence,
            "stamp": stamp,
            "wall": wall,
            "positions": None if positions is None else positions.tolist(),
            "pose": odometry[0].tolist(),
            "covariance": odometry[1].ravel().tolist(),
            "map_pose": None if fused is None else fused[0].tolist(),
            "map_covariance": None if fused is None else fused[1].ravel().tolist(),
        }
        text = json.dumps(state).encode().ljust(_SLOT - 1) + b"\n"
        os.pwrite(self._file, text, (self._sequence % 2) * _SLOT)

    def keep_calibration(self, calibration: Calibration, configured: Path) -> None:
        """Go on with this calibration after a restart, as long as the config's own file stays as it is."""
        write_text(self._swapped, to_yaml(SwappedCalibration(instead_of=_digest(configured), calibration=calibration)))

    def calibration(self, configured: Path) -> Calibration:
        """The calibration to start with: the last one swapped in, unless the config's file has changed since."""
        if self._swapped.exists():
            try:
                kept = read_model(SwappedCalibration, self._swapped)
            except ConfigError as error:
                raise DataError(f"{error}; remove {self._swapped} to start with {configured}") from None
            if kept.instead_of == _digest(configured):
                return kept.calibration
            remove(self._swapped)
        return read_calibration(configured)

    def close(self) -> None:
        """Let another node use it."""
        os.close(self._file)


def _digest(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
