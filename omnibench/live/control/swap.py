"""Sending another calibration to a running node."""

from __future__ import annotations

from pathlib import Path

import zenoh
from pydantic import BaseModel, ConfigDict, ValidationError

from omnibench.errors import DataError
from omnibench.live.network.presence import alive_robots, checked_robot, nothing_received
from omnibench.robot.calibration import read_calibration


class SwapReply(BaseModel):
    """A node's answer. kept: whether the calibration is kept for the node's next start; reason: why not."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    accepted: bool
    calibration: str
    kept: bool = True
    reason: str = ""


class _Refusal(BaseModel):
    """A node's answer that refuses a calibration."""

    error: str


def swap_calibration(session: zenoh.Session, robot: str, file: Path, timeout: float = 10.0) -> SwapReply:
    """Send a calibration file to the node that runs ``robot``, and return its answer.

    DataError: the file is no calibration, no node answers (the message names the robots alive), or the node refuses.
    """
    read_calibration(file)
    payload = file.read_bytes()
    for reply in session.get(f"omnibench/{checked_robot(robot)}/swap", payload=payload, timeout=timeout):
        try:
            if reply.ok is not None:
                return SwapReply.model_validate_json(reply.ok.payload.to_bytes())
            if reply.err is not None and (refusal := reply.err.payload.to_bytes()) != b"Timeout":
                raise DataError(f"robot {robot!r} refuses {file}: {_Refusal.model_validate_json(refusal).error}")
        except ValidationError:
            raise DataError(f"robot {robot!r}: cannot read its node's answer; is it an omnibench node?") from None
    raise DataError(nothing_received(robot, timeout, alive_robots(session)))
