"""Listening to robots: the status of each, its newest odometry, rate, age, presence and health, from its messages."""

from __future__ import annotations

import json
import math
import time
from collections import deque
from dataclasses import dataclass
from functools import partial
from threading import Event, Lock
from typing import Any, Final, Literal

import zenoh
from pydantic_core import to_jsonable_python

from omnibench.errors import DataError
from omnibench.live.control import source_of
from omnibench.live.health import anomalies_among
from omnibench.live.presence import Presence, checked_robot, nothing_received
from omnibench.live.stopping import Closing, direct, wait_until
from omnibench.live.topics import KeySpace
from omnibench.live.wire import DIAGNOSTICS, ODOMETRY, MessageError, MissedMessages, Odometry


@dataclass(frozen=True)
class OdometryStatus:
    """The newest message of one odometry topic.

    rate: Hz over the last 2 s. age: s since the message arrived. stamp_age: s since its stamp, None where the sender's
    clock differs from ours. undecodable: number of messages so far that were not odometry. missed: number of messages
    since the first that were published and did not come.
    """

    message: Odometry
    rate: float | None
    age: float
    stamp_age: float | None
    undecodable: int
    missed: int = 0


@dataclass(frozen=True)
class HealthSummary:
    """A robot's health as its node reports it: a word, the reason, and the counters of anomalies that are not 0."""

    status: str
    message: str
    counts: dict[str, int]


@dataclass(frozen=True)
class RobotStatus:
    """The state of one robot. presence: of its liveliness token; ``no token`` if no omnibench node runs the robot."""

    robot: str
    presence: Literal["alive", "left", "no token"]
    odom: OdometryStatus | None
    filtered: OdometryStatus | None
    health: HealthSummary | None


def json_document(status: RobotStatus) -> Any:
    """A robot's state as a JSON document: SI units, infinity and NaN as null."""
    content = {
        "robot": status.robot,
        "presence": status.presence,
        "odom": _odometry_record(status.odom),
        "filtered": _odometry_record(status.filtered),
        "health": status.health,
    }
    return to_jsonable_python(content, inf_nan_mode="null")


def _odometry_record(status: OdometryStatus | None) -> dict[str, Any] | None:
    if status is None:
        return None
    message = status.message
    return {
        "stamp": message.seconds,
        "frame": message.frame,
        "pose": message.pose.tolist(),
        "pose_covariance": message.pose_covariance.tolist(),
        "position_sigma_m": message.position_sigma,
        "heading_sigma_rad": message.heading_sigma,
        "twist": message.twist.tolist(),
        "rate_hz": status.rate,
        "age_s": status.age,
        "stamp_age_s": status.stamp_age,
        "undecodable": status.undecodable,
        "missed": status.missed,
    }


_FUSED: Final = "odometry/filtered"
_RATE_WINDOW: Final = 2.0  # s of messages that the rate is the mean of; chosen
_QUERY_PERIOD: Final = 1.0  # s between queries for the health; chosen
_HEALTH_LIFETIME: Final = 3.5  # s after which an answer no longer counts: three queries without a reply
_LARGEST_LAG: Final = 10.0  # s from stamp to arrival; beyond it, or below 0, the two clocks differ
_LEVELS: Final = ("ok", "warning", "error", "stale")  # names of DiagnosticStatus's levels 0 to 3


class RobotMonitor(Closing):
    """Listens to one robot, or to all if ``robot`` is None; a context manager.

    ConfigError: no robot can have this name.
    """

    def __init__(self, session: zenoh.Session, keys: KeySpace, robot: str | None) -> None:
        self._session = session
        self._robot = None if robot is None else checked_robot(robot)
        self._name_part = 0 if keys.profile == "plain" else 1  # index of the robot's name in the parts of a key
        self._streams: dict[tuple[str, str], _Stream] = {}
        self._answers: dict[str, tuple[float, HealthSummary]] = {}
        self._lock = Lock()
        self._queried_at = -math.inf
        self._presence = Presence(session)
        names = robot or "*"
        self._subscribers: list[zenoh.Subscriber[None]] = []
        for topic in ("odom", _FUSED):
            take = direct(partial(self._take_odometry, topic))
            self._subscribers.append(session.declare_subscriber(keys.expression(names, topic), take))
        expression = keys.expression(names, "diagnostics")
        self._subscribers.append(session.declare_subscriber(expression, direct(self._take_diagnostics)))

    @property
    def alive(self) -> tuple[str, ...]:
        """The names of all robots whose liveliness token is declared."""
        return self._presence.alive

    def statuses(self) -> list[RobotStatus]:
        """The present state of each robot, sorted by name."""
        now = time.monotonic()
        if now - self._queried_at >= _QUERY_PERIOD:
            self._queried_at = now
            key = f"omnibench/{self._robot or '*'}/health"
            take, everyone = direct(self._take_answer), zenoh.QueryTarget.ALL
            self._session.get(key, take, target=everyone, timeout=_QUERY_PERIOD, source_info=source_of(self._session))
        alive, left = self._presence.alive, self._presence.left
        with self._lock:
            streams, answers = dict(self._streams), dict(self._answers)
        names = {name for name, _ in streams}
        names.update(name for name in (*alive, *left) if self._robot in (None, name))
        return [
            RobotStatus(
                name,
                "alive" if name in alive else "left" if name in left else "no token",
                odom=streams[name, "odom"].status(now) if (name, "odom") in streams else None,
                filtered=streams[name, _FUSED].status(now) if (name, _FUSED) in streams else None,
                health=answers[name][1] if name in answers and now - answers[name][0] < _HEALTH_LIFETIME else None,
            )
            for name in sorted(names)
        ]

    def wait_until_present(self, stop: Event, patience: float) -> None:
        """Wait until the robot is alive or sends odometry, or ``stop`` is set; DataError after ``patience`` s."""

        def present() -> bool:
            return any(status.presence == "alive" or status.odom or status.filtered for status in self.statuses())

        if not wait_until(present, patience, stop, 0.02) and not stop.is_set():
            raise DataError(nothing_received(self._robot or "*", patience, self.alive))

    def close(self) -> None:
        """Stop listening."""
        self._presence.close()
        for subscriber in self._subscribers:
            subscriber.undeclare()

    def _take_odometry(self, topic: str, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            key = self._name(sample), topic
            with self._lock:
                stream = self._streams.setdefault(key, _Stream())
            stream.take(sample)

    def _take_answer(self, reply: zenoh.Reply) -> None:
        if reply.ok is None:
            return
        try:
            answer = json.loads(reply.ok.payload.to_string())
            health = HealthSummary(str(answer["status"]), str(answer["message"]), anomalies_among(answer["counts"]))
        except (ValueError, TypeError, KeyError, AttributeError):
            return  # the answer of another program or another version
        with self._lock:
            self._answers[str(reply.ok.key_expr).split("/")[1]] = time.monotonic(), health

    def _take_diagnostics(self, sample: zenoh.Sample) -> None:
        name = self._name(sample)
        with self._lock:
            answer = self._answers.get(name)
        try:
            statuses = DIAGNOSTICS.decode(sample.payload.to_bytes()).statuses
        except MessageError:
            return
        if not statuses or (answer is not None and time.monotonic() - answer[0] < _QUERY_PERIOD * 1.5):
            return  # the robot answers queries, which hold more than diagnostics
        worst = max(statuses, key=lambda status: status.level)
        level = _LEVELS[worst.level] if worst.level < len(_LEVELS) else str(worst.level)
        health = HealthSummary(level, worst.message, anomalies_among(dict(worst.values)))
        with self._lock:
            self._answers[name] = time.monotonic(), health

    def _name(self, sample: zenoh.Sample) -> str:
        return str(sample.key_expr).split("/")[self._name_part]


class _Stream:
    """The odometry messages of one robot's topic. ``take`` runs in Zenoh's thread, ``status`` in the reader's."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._numbers = MissedMessages()
        self._count = 0
        self._undecodable = 0
        self._arrived_at, self._arrived_at_by_clock = 0.0, 0.0
        self._payload = b""
        self._message: Odometry | None = None
        self._history: deque[tuple[float, int]] = deque()  # (time of arrival, messages until then) at each reading

    def take(self, sample: zenoh.Sample) -> None:
        payload = sample.payload.to_bytes()
        with self._lock:
            if self._numbers.take(sample.attachment) is None:
                return
            self._count += 1
            self._arrived_at, self._arrived_at_by_clock = time.monotonic(), time.time()
            self._payload = payload

    def status(self, now: float) -> OdometryStatus | None:
        with self._lock:
            count, payload = self._count, self._payload
            arrived_at, arrived_at_by_clock = self._arrived_at, self._arrived_at_by_clock
        if not self._history or self._history[-1][1] != count:
            self._history.append((arrived_at, count))
            try:
                self._message = ODOMETRY.decode(payload)
            except MessageError:
                self._undecodable += 1
        while len(self._history) > 1 and now - self._history[1][0] > _RATE_WINDOW:
            self._history.popleft()
        if self._message is None:
            return None
        lag = arrived_at_by_clock - self._message.seconds
        age = max(now - arrived_at, 0.0)
        stamp_age = age + lag if 0 <= lag <= _LARGEST_LAG else None
        (first, count_before), (last, after) = self._history[0], self._history[-1]
        return OdometryStatus(
            self._message,
            (after - count_before) / (last - first) if last > first else None,
            age,
            stamp_age,
            self._undecodable,
            self._numbers.count,
        )
