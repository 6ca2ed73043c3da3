"""Requests to a node and their fair queue, in which every client has a lane; the request of a client to swap."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import chain, zip_longest
from pathlib import Path
from typing import Final

import zenoh
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from omnibench.config import Model, parse_yaml, validate
from omnibench.errors import ConfigError, DataError
from omnibench.files import read_bytes
from omnibench.live.network.presence import alive_robots, checked_robot, nothing_received
from omnibench.robot.calibration import Calibration, parse_calibration

LONGEST: Final = 1 << 17  # bytes of a request: 48 KiB of weights, in base64, and 60 KB of driven motions beside them
_NANOSECONDS: Final = 10**14  # values of ``at`` from this on are ns: as s they would be 3 million years from now
_LAST: Final = 2**63 - 1  # ns, the last time in 64 bits
_LONGEST_NUMBER: Final = 40  # characters of a time; chosen
_MAX_CALIBRATION_VALUES: Final = 5_000  # enough for 20 wheels; parsing more would delay samples (chosen)
_MAX_POSE_VALUES: Final = 20  # a mapping with all five keys and their values counts as eleven


class PoseOrder(Model):
    """The content of a ``set_pose`` request: m and rad in the map."""

    x: FiniteFloat = Field(ge=-1e7, le=1e7)
    y: FiniteFloat = Field(ge=-1e7, le=1e7)
    theta: FiniteFloat = Field(ge=-100.0, le=100.0)
    position_sigma: FiniteFloat = Field(0.05, ge=1e-6, le=1e4, description="standard deviation, m")
    heading_sigma: FiniteFloat = Field(0.05, ge=1e-6, le=10.0, description="standard deviation, rad")


def read_pose(payload: bytes, parameters: dict[str, str]) -> PoseOrder:
    """A pose from a payload in JSON or YAML or, without one, from the parameters. ConfigError in one line."""
    where = "set_pose"
    if not payload:
        return validate(PoseOrder, parameters, where)
    try:
        text = payload.decode()
    except UnicodeDecodeError:
        raise ConfigError(f"{where}: the payload is not text; send x, y (m) and theta (rad) in JSON") from None
    return validate(PoseOrder, parse_yaml(text, where, _MAX_POSE_VALUES), where)  # JSON is a part of YAML


def read_time(text: str) -> int:
    """A time in s, or in ns if it is 10^14 or more, as ns. ConfigError in one line.

    It is read as a decimal number, because a float of today's time in s is only exact to 0.2 us.
    """
    try:
        number = Decimal(text if len(text) <= _LONGEST_NUMBER else "too long")
        if number.is_finite() and number.adjusted() < 20:  # digits before the point; more would be costly to multiply
            nanoseconds = int(number) if abs(number) >= _NANOSECONDS else int((number * 10**9).to_integral_value())
            if abs(nanoseconds) <= _LAST:
                return nanoseconds
    except InvalidOperation:
        pass
    shown = text if len(text) <= _LONGEST_NUMBER else f"{text[:_LONGEST_NUMBER]}..."
    raise ConfigError(f"at: {shown!r} is not a time; give s since 1970, as 1800000000.25")


def read_sent_calibration(payload: bytes, where: str) -> Calibration:
    """Parse a calibration that came over the network. DataError begins with ``where`` and says what is wrong."""
    try:
        text = payload.decode()
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: not a text in UTF-8: {error}") from None
    return parse_calibration(text, where, _MAX_CALIBRATION_VALUES)


MOST_WAITING: Final = 64  # requests that wait; chosen


def source_of(session: zenoh.Session) -> zenoh.SourceInfo:
    """What a request carries so that the node knows its client; Zenoh itself does not say who asks."""
    return zenoh.SourceInfo(session.id, 0)


def client_of(message: zenoh.Query | zenoh.Sample, unnamed: str) -> str:
    """The client that a request names (``source_info``), or else ``unnamed``."""
    return unnamed if message.source_info is None else str(message.source_info.source_id.zid)


@dataclass(frozen=True)
class Request:
    """A request that waits. client: its lane; answer: serve it; refuse: answer with a reason instead."""

    client: str
    answer: Callable[[], None]
    refuse: Callable[[str], None]


class RequestQueue:
    """At most ``MOST_WAITING`` requests. When it is full the client with the most of them loses its last one.

    Safe to call from any thread.
    """

    def __init__(self) -> None:
        self._lanes: dict[str, deque[Request]] = {}
        self._count = 0
        self._closed = False
        self._changed = threading.Condition()

    def put(self, request: Request) -> Request | None:
        """Queue a request; the one that has to be refused for it, which may be itself, or None."""
        with self._changed:
            if self._closed:
                return request
            excess = None
            if self._count >= MOST_WAITING:
                longest = max(self._lanes, key=lambda client: len(self._lanes[client]))
                if len(self._lanes[longest]) - len(self._lanes.get(request.client, ())) <= 1:
                    return request
                excess = self._lanes[longest].pop()
                self._count -= 1
            self._lanes.setdefault(request.client, deque()).append(request)
            self._count += 1
            self._changed.notify()
            return excess

    def take(self) -> list[Request]:
        """All requests that wait, each client's first before anybody's second; empty when the queue is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._count or self._closed)
            lanes, self._lanes, self._count = list(self._lanes.values()), {}, 0
        return [request for request in chain.from_iterable(zip_longest(*lanes)) if request is not None]

    def close(self) -> None:
        """Take no more requests; those that wait are still given out."""
        with self._changed:
            self._closed = True
            self._changed.notify()


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
