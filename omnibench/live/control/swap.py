"""Giving a running node another calibration, from outside."""

from __future__ import annotations

from pathlib import Path

import zenoh
from pydantic import BaseModel, ConfigDict, ValidationError

from omnibench.errors import DataError
from omnibench.live.network.presence import alive_robots, checked_robot, nothing_received
from omnibench.robot.calibration import read_calibration


class Swapped(BaseModel):
    """A node's answer. kept: whether the calibration outlives the node; reason: why not."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    accepted: bool
    calibration: str
    kept: bool = True
    reason: str = ""


class _Refused(BaseModel):
    """A node's answer that says no."""

    error: str


def swap_calibration(session: zenoh.Session, robot: str, file: Path, timeout: float = 10.0) -> Swapped:
    """Send a calibration file to the node that runs ``robot``, and its answer.

    DataError: the file is none, nobody answers (with those that are alive), or the node refuses, with its reason.
    """
    read_calibration(file)
    payload = file.read_bytes()
    for reply in session.get(f"omnibench/{checked_robot(robot)}/swap", payload=payload, timeout=timeout):
        try:
            if reply.ok is not None:
                return Swapped.model_validate_json(reply.ok.payload.to_bytes())
            if reply.err is not None and (said := reply.err.payload.to_bytes()) != b"Timeout":
                raise DataError(f"robot {robot!r} refuses {file}: {_Refused.model_validate_json(said).error}")
        except ValidationError:
            raise DataError(f"robot {robot!r}: its node gives an answer that is none; is it omnibench's?") from None
    raise DataError(nothing_received(robot, timeout, alive_robots(session)))
