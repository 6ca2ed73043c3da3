"""Answering queries about a node's robots, and orders to them: ``omnibench/<robot>/<service>``, in JSON.

Requests to a node and their fair queue, in which every client has a lane; the request of a client to swap.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import zenoh
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat
from pydantic_core import from_json

from omnibench.config import Model, parse_yaml, to_json, validate
from omnibench.errors import ConfigError, DataError, OmnibenchError, one_line
from omnibench.files import read_bytes
from omnibench.live.presence import alive_robots, checked_robot, nothing_received
from omnibench.live.state import RobotMemory
from omnibench.live.stopping import RateLimiter, direct
from omnibench.live.tracker import RobotTracker
from omnibench.robot.calibration import Calibration, parse_calibration
from omnibench.robot.kinematics import Array

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
    """A pose from a payload in JSON or YAML or, without one, from the parameters. ConfigError or DataError."""
    where = "set_pose"
    # JSON is a part of YAML
    content = parse_yaml(_text(payload, where), where, _MAX_POSE_VALUES) if payload else parameters
    return validate(PoseOrder, content, where)


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
    return parse_calibration(_text(payload, where), where, _MAX_CALIBRATION_VALUES)


def _text(payload: bytes, where: str) -> str:
    try:
        return payload.decode()
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: not text in UTF-8: {error}") from None


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
    answer: Callable[[], object]
    refuse: Callable[[str], None]


class RequestQueue:
    """At most ``MOST_WAITING`` requests. When it is full the client with the most of them loses its last one.

    Safe to call from any thread.
    """

    def __init__(self) -> None:
        self._lanes: dict[str, list[Request]] = {}  # of each client, none empty
        self._closed = False
        self._changed = threading.Condition()

    def put(self, request: Request) -> Request | None:
        """Queue a request; the one that has to be refused for it, which may be itself, or None."""
        with self._changed:
            if self._closed:
                return request
            own = self._lanes.setdefault(request.client, [])
            own.append(request)
            self._changed.notify()
            if sum(map(len, self._lanes.values())) <= MOST_WAITING:
                return None
            client, longest = max(self._lanes.items(), key=lambda lane: (len(lane[1]), lane[1] is own))
            if len(longest) == 1:
                del self._lanes[client]
            return longest.pop()

    def take(self) -> list[Request]:
        """All requests that wait, each client's first before anybody's second; empty when the queue is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._lanes or self._closed)
            lanes, self._lanes = self._lanes.values(), {}
        return [request for turn in zip_longest(*lanes) for request in turn if request is not None]

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
                raise DataError(f"robot {robot!r} refuses {file}: {from_json(refusal)['error']}")
        except (ValueError, KeyError, TypeError):
            raise DataError(f"robot {robot!r}: cannot read its node's answer; is it an omnibench node?") from None
    alive = alive_robots(session)
    if robot in alive:
        raise DataError(
            f"robot {robot!r} is alive, but its node did not answer in {timeout:.0f} s; the `access` of its router may "
            "not let us swap, which only operators may, or the node is too busy"
        )
    raise DataError(nothing_received(robot, timeout, alive))


LOG = logging.getLogger("omnibench.live")
_READING: Final = ("info", "calibration", "health", "pose")
_ORDERS: Final = ("set_pose", "reset", "swap")
# The reason why the node's next start does not use a calibration that was swapped in.
_NO_STATE: Final = "the node has no `state`, so that its next start is with the config's calibration"
_CLOSE_TIMEOUT: Final = 6.0  # s to wait for a request under way: longer than Zenoh waits for a client, 5 s


class QueryServer:
    """Answers queries and accepts calibrations, one request after another, in a thread of its own.

    Requests that are too long or too many are refused on arrival, so that they do not delay the wheel samples. Clients
    are served in turn. Zenoh tells who asks only if the client says so (``source_info``, as omnibench's own commands
    do); requests without it share a turn for each robot and service. What waits for the same answer gets one that is
    made once. Zenoh gives a reply its query's congestion control: for a client that queried with BLOCK and does not
    read, Zenoh waits up to 5 s and then disconnects it. Until then this thread waits; wheel samples are not delayed.

    info: makes the answer to ``info`` for a robot. memories: robot -> its saved state, for nodes that keep one.
    """

    def __init__(
        self,
        session: zenoh.Session,
        trackers: Mapping[str, RobotTracker],
        info: Callable[[RobotTracker], Mapping[str, Any]],
        memories: Mapping[str, RobotMemory],
    ) -> None:
        self._trackers = trackers
        self._info = info
        self._memories = memories
        self._rate_limiter = RateLimiter()
        self._refused = 0
        self._requests = RequestQueue()
        self._answers: dict[str, bytes] = {}  # key -> answer, for the requests taken together, until an order
        self._thread = threading.Thread(target=self._run, name="query server", daemon=True)
        self._declarations: list[Any] = []
        for name in trackers:
            # declared one by one, so that access control can tell them apart
            for service in _READING + _ORDERS:
                handler = direct(partial(self._take_query, name, service))
                self._declarations.append(session.declare_queryable(f"omnibench/{name}/{service}", handler))
            put = direct(partial(self._take_sample, name))
            self._declarations.append(session.declare_subscriber(f"omnibench/{name}/calibration", put))
        self._thread.start()

    def close(self) -> None:
        """Answer the requests that wait, and accept no more."""
        for declaration in self._declarations:
            declaration.undeclare()
        self._requests.close()
        self._thread.join(_CLOSE_TIMEOUT)

    def _take_query(self, name: str, service: str, query: zenoh.Query) -> None:
        if service in _ORDERS and str(query.key_expr) != f"omnibench/{name}/{service}":
            return  # an order must name its robot: wildcards are ignored
        request = Request(
            client_of(query, f"{name}/{service}"),
            lambda: self._answer(name, service, query),
            lambda reason: _refuse(query, name, f"omnibench/{name}/{service}: {reason}"),
        )
        self._queue(request, query, len(str(query.parameters)))

    def _take_sample(self, name: str, sample: zenoh.Sample) -> None:
        """Take a calibration that was put: it has no reply, unlike ``swap``, so health and log report a refusal."""
        if sample.kind != zenoh.SampleKind.PUT:
            return
        request = Request(
            client_of(sample, f"{name}/put"),
            lambda: self._swap(name, sample.payload.to_bytes()),
            lambda reason: self._trackers[name].refuse_swap(f"omnibench/{name}/calibration: {reason}"),
        )
        self._queue(request, sample)

    def _queue(self, request: Request, message: zenoh.Query | zenoh.Sample, size: int = 0) -> None:
        """Queue a request, or refuse it or the one that gives way to it. size: of its parameters, bytes."""
        size += sum(len(part) for part in (message.payload, message.attachment) if part is not None)
        refused: Request | None = request
        if size > LONGEST:
            reason = f"{size} bytes are more than a request may have, {LONGEST}"
        else:
            refused, reason = self._requests.put(request), f"{MOST_WAITING} requests are waiting; ask again later"
        if refused is None:
            return
        self._refused += 1
        if self._rate_limiter.allows("refused"):
            LOG.warning("requests refused so far: %d; the last: %s", self._refused, reason)
        refused.refuse(reason)

    def _run(self) -> None:
        while batch := deque(self._requests.take()):
            self._answers.clear()
            while batch:
                try:
                    batch.popleft().answer()  # a query ends when the last reference to it is gone
                except OmnibenchError:
                    pass  # a calibration that was put and refused, which is logged
                except Exception as error:  # whatever it was, the next request is answered
                    if self._rate_limiter.allows(type(error).__name__):
                        LOG.error("a request failed: %s: %s", type(error).__name__, one_line(str(error)))

    def _answer(self, name: str, service: str, query: zenoh.Query) -> None:
        """Answer a query; an answer that needs no parameters is made once for all that wait for it."""
        key = f"omnibench/{name}/{service}"
        with query:
            plain = service in _READING and not str(query.parameters) and query.payload is None
            answer = self._answers.get(key) if plain else None
            try:
                if answer is None:
                    answer = to_json(self._serve(name, service, query)).encode()
            except OmnibenchError as error:
                _refuse(query, name, str(error))
                return
            except Exception as error:
                _refuse(query, name, f"{key}: {type(error).__name__}: {error}")
                raise
            if plain:
                self._answers[key] = answer
            query.reply(key, answer, encoding=zenoh.Encoding.APPLICATION_JSON)

    def _serve(self, name: str, service: str, query: zenoh.Query) -> Mapping[str, Any] | Model:
        tracker = self._trackers[name]
        payload = b"" if query.payload is None else query.payload.to_bytes()
        parameters = dict(cast(Iterable[tuple[str, str]], query.parameters))
        if service in _ORDERS:
            self._answers.clear()
        if service == "info":
            return self._info(tracker)
        if service == "health":
            return tracker.health(time.monotonic())
        if service == "pose":
            estimate = tracker.pose_at(read_time(parameters["at"]) if "at" in parameters else None)
            in_map: dict[str, Any] | None = None
            if estimate.in_map is not None:
                pose, covariance = estimate.in_map
                in_map = {**_planar(pose), "covariance": covariance.tolist()}
            times = {"at": estimate.stamp / 1e9, "at_ns": estimate.stamp}
            return {"robot": name, **times, "odom": _planar(estimate.odometry), "map": in_map}
        if service == "calibration":
            if payload:  # the right to query this key must not be a right to swap the calibration
                raise ConfigError(f"omnibench/{name}/calibration: put it there, or ask omnibench/{name}/swap with it")
            return tracker.calibration
        if service == "swap":
            return self._swap(name, payload)
        if service == "set_pose":
            order = read_pose(payload, parameters)
            deviations = np.array([order.position_sigma, order.position_sigma, order.heading_sigma])
            tracker.set_pose(np.array([order.x, order.y, order.theta]), np.diag(deviations**2))
            LOG.info("%s: pose set to %.3f m, %.3f m, %.1f deg", name, order.x, order.y, math.degrees(order.theta))
            return {"robot": name, "done": "set_pose"}
        tracker.reset()
        LOG.info("%s: filter reset", name)
        return {"robot": name, "done": "reset"}

    def _swap(self, name: str, payload: bytes) -> Mapping[str, Any]:
        self._answers.clear()
        tracker = self._trackers[name]
        try:
            try:
                calibration = read_sent_calibration(payload, f"omnibench/{name}/calibration")
            except DataError as error:
                tracker.refuse_swap(str(error))
                raise
            tracker.swap(calibration)
        except DataError as error:
            if self._rate_limiter.allows(f"calibration of {name}"):
                LOG.warning("%s: calibration refused, %s runs on: %s", name, tracker.calibration.name, error)
            raise
        LOG.info("%s: calibration %r runs", name, calibration.name)
        answer = {"robot": name, "accepted": True, "calibration": calibration.name}
        if name not in self._memories:
            return answer | {"kept": False, "reason": _NO_STATE}
        try:
            self._memories[name].keep_calibration(calibration)
        except OmnibenchError as error:
            LOG.warning("%s: calibration %r runs, but not after a restart: %s", name, calibration.name, error)
            return answer | {"kept": False, "reason": str(error)}
        return answer | {"kept": True}


def _refuse(query: zenoh.Query, name: str, reason: str) -> None:
    answer = to_json({"robot": name, "error": one_line(reason)})
    query.reply_err(answer, encoding=zenoh.Encoding.APPLICATION_JSON)


def _planar(pose: Array) -> dict[str, float]:
    x, y, theta = pose.tolist()
    return {"x": x, "y": y, "theta": theta}
