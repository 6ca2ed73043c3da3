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
    content: dict[str, Any] = {"robot": status.robot, "presence": status.presence}
    for name, stream in (("odom", status.odom), ("filtered", status.filtered)):
        content[name] = stream and {
            "stamp": stream.message.seconds,
            "frame": stream.message.frame,
            "pose": stream.message.pose.tolist(),
            "pose_covariance": stream.message.pose_covariance.tolist(),
            "position_sigma_m": stream.message.position_sigma,
            "heading_sigma_rad": stream.message.heading_sigma,
            "twist": stream.message.twist.tolist(),
            "rate_hz": stream.rate,
            "age_s": stream.age,
            "stamp_age_s": stream.stamp_age,
            "undecodable": stream.undecodable,
            "missed": stream.missed,
        }
    return to_jsonable_python(content | {"health": status.health}, inf_nan_mode="null")


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
        self._lock = Lock()  # held while these change
        self._queried_at = -math.inf
        self._presence = Presence(session)
        self._subscribers: list[zenoh.Subscriber[None]] = []
        for topic in ("odom", _FUSED, "diagnostics"):
            take = direct(self._take_diagnostics if topic == "diagnostics" else partial(self._take_odometry, topic))
            self._subscribers.append(session.declare_subscriber(keys.expression(robot or "*", topic), take))

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
            seen = {key: stream.status(now) for key, stream in self._streams.items()}
            healths = {name: health for name, (at, health) in self._answers.items() if now - at < _HEALTH_LIFETIME}
        names = {name for name, _ in seen} | {name for name in (*alive, *left) if self._robot in (None, name)}
        return [
            RobotStatus(
                name,
                "alive" if name in alive else "left" if name in left else "no token",
                odom=seen.get((name, "odom")),
                filtered=seen.get((name, _FUSED)),
                health=healths.get(name),
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
            with self._lock:
                self._streams.setdefault((self._name(sample), topic), _Stream()).take(sample)

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
        """Take them for the health of a robot that answers no queries, whose answers hold more."""
        try:
            statuses = DIAGNOSTICS.decode(sample.payload.to_bytes()).statuses
        except MessageError:
            return
        name, now = self._name(sample), time.monotonic()
        with self._lock:
            at, _ = self._answers.get(name, (-math.inf, None))
            if statuses and now - at >= _QUERY_PERIOD * 1.5:
                worst = max(statuses, key=lambda status: status.level)
                level = _LEVELS[worst.level] if worst.level < len(_LEVELS) else str(worst.level)
                self._answers[name] = now, HealthSummary(level, worst.message, anomalies_among(dict(worst.values)))

    def _name(self, sample: zenoh.Sample) -> str:
        return str(sample.key_expr).split("/")[self._name_part]


class _Stream:
    """The odometry messages of one robot's topic, of which those that are read are decoded."""

    def __init__(self) -> None:
        self._numbers = MissedMessages()
        self._undecodable = 0
        self._arrivals: deque[float] = deque()  # within _RATE_WINDOW, and one before
        self._arrived_by_clock = 0.0
        self._payload: bytes | None = None  # of a message that is not decoded yet
        self._message: Odometry | None = None

    def take(self, sample: zenoh.Sample) -> None:
        if self._numbers.take(sample.attachment) is not None:
            self._arrivals.append(time.monotonic())
            self._forget(self._arrivals[-1])
            self._arrived_by_clock, self._payload = time.time(), sample.payload.to_bytes()

    def status(self, now: float) -> OdometryStatus | None:
        if self._payload is not None:
            try:
                self._message = ODOMETRY.decode(self._payload)
            except MessageError:
                self._undecodable += 1
            self._payload = None
        if self._message is None:
            return None
        self._forget(now)
        first, last = self._arrivals[0], self._arrivals[-1]
        lag, age = self._arrived_by_clock - self._message.seconds, max(now - last, 0.0)
        return OdometryStatus(
            self._message,
            rate=(len(self._arrivals) - 1) / (last - first) if last > first else None,
            age=age,
            stamp_age=age + lag if 0 <= lag <= _LARGEST_LAG else None,
            undecodable=self._undecodable,
            missed=self._numbers.count,
        )

    def _forget(self, now: float) -> None:
        while len(self._arrivals) > 1 and now - self._arrivals[1] > _RATE_WINDOW:
            self._arrivals.popleft()
