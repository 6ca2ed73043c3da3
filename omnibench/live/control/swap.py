"""Sending another calibration to a running node."""

from __future__ import annotations

from pathlib import Path

import zenoh
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from omnibench.errors import DataError
from omnibench.files import read_bytes
from omnibench.live.control.request_queue import LONGEST, read_sent_calibration, source_of
from omnibench.live.network.presence import alive_robots, checked_robot, nothing_received

_LONGEST_TEXT = 2000  # characters; names have some 400, reasons are one line


class SwapReply(BaseModel):
    """A node's answer. kept: whether the calibration is kept for the node's next start; reason: why not."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    accepted: bool
    calibration: str = Field(max_length=_LONGEST_TEXT)
    kept: bool = True
    reason: str = Field("", max_length=_LONGEST_TEXT)


class _Refusal(BaseModel):
    """A node's answer that refuses a calibration."""

    error: str


def swap_calibration(session: zenoh.Session, robot: str, file: Path, timeout: float = 10.0) -> SwapReply:
    """Send a calibration file to the node that runs ``robot``, and return its answer.

    DataError: the file is no calibration, no node answers (the message names the robots alive), or the node refuses.
    """
    payload, key = read_bytes(file, LONGEST), f"omnibench/{checked_robot(robot)}/swap"
    read_sent_calibration(payload, str(file))
    for reply in session.get(key, payload=payload, timeout=timeout, source_info=source_of(session)):
        try:
            if reply.ok is not None:
                return SwapReply.model_validate_json(reply.ok.payload.to_bytes())
            if reply.err is not None and (refusal := reply.err.payload.to_bytes()) != b"Timeout":
                raise DataError(f"robot {robot!r} refuses {file}: {_Refusal.model_validate_json(refusal).error}")
        except ValidationError:
            raise DataError(f"robot {robot!r}: cannot read its node's answer; is it an omnibench node?") from None
    alive = alive_robots(session)
    if robot in alive:
        raise DataError(
            f"robot {robot!r} is alive, but its node did not answer in {timeout:.0f} s; the `access` of its router may "
            "not let us swap, which only operators may, or the node is too busy"
        )
    raise DataError(nothing_received(robot, timeout, alive))
