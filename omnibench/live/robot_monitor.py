"""What is heard of robots: the newest odometry, how often it comes, how old it is, and how the robot says it is."""

from __future__ import annotations

import json
import math
import time
from collections import deque
from dataclasses import dataclass, fields
from threading import Lock
from types import TracebackType
from typing import Any, Final, Literal

import zenoh
from zenoh.handlers import Callback

from omnibench.live.estimation.counts import Counts
from omnibench.live.network.presence import Presence
from omnibench.live.wire.messages import DIAGNOSTICS, ODOMETRY, MessageError, Odometry
from omnibench.live.wire.topics import KeySpace

_FUSED: Final = "odometry/filtered"
_RATE_WINDOW: Final = 2.0  # s
_ASK_PERIOD: Final = 1.0  # s, between questions for the health
_HEALTH_LASTS: Final = 3.5  # s
_LARGEST_LAG: Final = 10.0  # s; beyond it, or before the stamp, sender and receiver have different clocks
_LEVELS: Final = ("ok", "warning", "error", "stale")  # of ROS 2's diagnostics
_COUNTERS: Final = frozenset(item.name for item in fields(Counts))


@dataclass(frozen=True)
class OdometryStatus:
    """The newest message of one topic. rate: Hz over the last 2 s. age: s since it came; stamp_age: s since its stamp,
    None where the sender's clock is another. undecodable: messages so far that were not odometry."""

    message: Odometry
    rate: float | None
    age: float
    stamp_age: float | None
    undecodable: int

    @property
    def position_sigma(self) -> float:
        """Standard deviation of the position along an axis, m: the root of the mean of x's and y's variances."""
        covariance = self.message.pose_covariance
        return math.sqrt(max(float(covariance[0, 0] + covariance[1, 1]) / 2, 0.0))

    @property
    def heading_sigma(self) -> float:
        """Standard deviation of the heading, rad."""
        return math.sqrt(max(float(self.message.pose_covariance[2, 2]), 0.0))


@dataclass(frozen=True)
class HealthSummary:
    """How a robot says it is: a word, the reason, and the counters of what is not as it should be."""

    status: str
    message: str
    counts: dict[str, int]


@dataclass(frozen=True)
class RobotStatus:
    """What is heard of one robot. presence: its liveliness token; ``no token`` where no node of omnibench has it."""

    robot: str
    presence: Literal["alive", "left", "no token"]
    odom: OdometryStatus | None
    filtered: OdometryStatus | None
    health: HealthSummary | None


class RobotMonitor:
    """Listens for one robot, or for all when ``robot`` is None; ask for its ``news``. A context manager."""

    def __init__(self, session: zenoh.Session, keys: KeySpace, robot: str | None) -> None:
        self._session = session
        self._robot = robot
        self._place = 0 if keys.profile == "plain" else 1  # of the robot's name in a key
        self._streams: dict[tuple[str, str], _Stream] = {}
        self._answers: dict[str, tuple[float, HealthSummary]] = {}
        self._lock = Lock()
        self._asked = -math.inf
        self._presence = Presence(session)
        who = robot or "*"
        self._subscribers = [self._subscribe(keys.expression(who, topic), topic) for topic in ("odom", _FUSED)]
        heard: Any = Callback(self._diagnosed, indirect=False)
        self._subscribers.append(session.declare_subscriber(keys.expression(who, "diagnostics"), heard))

    @property
    def alive(self) -> tuple[str, ...]:
        """All robots whose tokens are there."""
        return self._presence.alive

    def status(self) -> list[RobotStatus]:
        """What is heard of each robot, by name."""
        now = time.monotonic()
        if now - self._asked >= _ASK_PERIOD:
            self._asked = now
            self._ask()
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
                health=answers[name][1] if name in answers and now - answers[name][0] < _HEALTH_LASTS else None,
            )
            for name in sorted(names)
        ]

    def close(self) -> None:
        """Stop listening."""
        self._presence.close()
        for subscriber in self._subscribers:
            subscriber.undeclare()

    def __enter__(self) -> RobotMonitor:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _subscribe(self, expression: str, topic: str) -> zenoh.Subscriber[None]:
        def arrived(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                key = self._name(sample), topic
                with self._lock:
                    stream = self._streams.setdefault(key, _Stream())
                stream.arrived(sample.payload.to_bytes())

        direct: Any = Callback(arrived, indirect=False)
        return self._session.declare_subscriber(expression, direct)

    def _ask(self) -> None:
        replied: Any = Callback(self._answered, indirect=False)
        self._session.get(
            f"omnibench/{self._robot or '*'}/health", replied, target=zenoh.QueryTarget.ALL, timeout=_ASK_PERIOD
        )

    def _answered(self, reply: zenoh.Reply) -> None:
        if reply.ok is None:
            return
        try:
            answer = json.loads(reply.ok.payload.to_string())
            health = HealthSummary(str(answer["status"]), str(answer["message"]), _anomalies(answer["counts"]))
        except (ValueError, TypeError, KeyError, AttributeError):
            return  # of another program, or of another version
        with self._lock:
            self._answers[str(reply.ok.key_expr).split("/")[1]] = time.monotonic(), health

    def _diagnosed(self, sample: zenoh.Sample) -> None:
        name = self._name(sample)
        with self._lock:
            answer = self._answers.get(name)
        try:
            statuses = DIAGNOSTICS.decode(sample.payload.to_bytes()).statuses
        except MessageError:
            return
        if not statuses or (answer is not None and time.monotonic() - answer[0] < _ASK_PERIOD * 1.5):
            return  # the robot answers questions, which says more
        worst = max(statuses, key=lambda status: status.level)
        level = _LEVELS[worst.level] if worst.level < len(_LEVELS) else str(worst.level)
        health = HealthSummary(level, worst.message, _anomalies(dict(worst.values)))
        with self._lock:
            self._answers[name] = time.monotonic(), health

    def _name(self, sample: zenoh.Sample) -> str:
        return str(sample.key_expr).split("/")[self._place]


class _Stream:
    """The odometry of one robot's topic."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._count = 0
        self._undecodable = 0
        self._came, self._came_by_clock = 0.0, 0.0
        self._payload = b""
        self._message: Odometry | None = None
        self._history: deque[tuple[float, int]] = deque()  # when the last message of so many came

    def arrived(self, payload: bytes) -> None:
        with self._lock:
            self._count += 1
            self._came, self._came_by_clock = time.monotonic(), time.time()
            self._payload = payload

    def status(self, now: float) -> OdometryStatus | None:
        with self._lock:
            count, came, came_by_clock, payload = self._count, self._came, self._came_by_clock, self._payload
        if not self._history or self._history[-1][1] != count:
            self._history.append((came, count))
            try:
                self._message = ODOMETRY.decode(payload)
            except MessageError:
                self._undecodable += 1
        while len(self._history) > 1 and now - self._history[1][0] > _RATE_WINDOW:
            self._history.popleft()
        if self._message is None:
            return None
        lag = came_by_clock - self._message.seconds
        age = max(now - came, 0.0)
        return OdometryStatus(
            self._message, self._rate(), age, age + lag if 0 <= lag <= _LARGEST_LAG else None, self._undecodable
        )

    def _rate(self) -> float | None:
        (first, before), (last, count) = self._history[0], self._history[-1]
        return (count - before) / (last - first) if last > first else None


def _anomalies(counts: dict[str, Any]) -> dict[str, int]:
    """Those of a node's counters that tell of something that is not as it should be."""
    return Counts(**{name: int(value) for name, value in counts.items() if name in _COUNTERS}).anomalies()
