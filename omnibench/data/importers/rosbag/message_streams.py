"""Wheels and poses of a bag as arrays, by the stamps of their headers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from omnibench.data.importers.orientation import planar_headings
from omnibench.data.importers.rosbag.bag import Bag, Record, Topic
from omnibench.data.importers.rosbag.topic_choice import no_joints, wheel_joints
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array, Robot
from omnibench.words import plural

T = TypeVar("T")
Use = Literal["auto", "positions", "velocities"]
Stamps = NDArray[np.int64]

_SECOND = 1_000_000_000  # ns
_NO_STAMP = "without a header stamp (it is 0)"
_MOST_SET_BACK = 20  # messages that may come over a second late; more mean a clock that was set back (chosen)
_LARGEST = 1e9  # rad, rad/s or m; a larger value is garbage
_PLANAR = np.ix_((0, 1, 5), (0, 1, 5))  # x, y and yaw of a covariance of x, y, z, roll, pitch, yaw


@dataclass(frozen=True, eq=False)
class WheelStream:
    """Wheel messages. stamps (F,): ns, increasing. logged (F,): times of recording, ns.

    values (F, N): positions (rad) if ``absolute``, else velocities (rad/s).
    """

    stamps: Stamps
    logged: Stamps
    values: Array
    absolute: bool


@dataclass(frozen=True, eq=False)
class PoseStream:
    """Pose messages. stamps (K,): ns, increasing. poses (K, 3): m, m, rad. covariances (K, 3, 3), if all have one."""

    stamps: Stamps
    poses: Array
    covariances: Array | None


def read_wheels(
    bag: Bag, topic: Topic, robot: Robot, joints: Sequence[str], use: Use, warnings: list[str]
) -> WheelStream:
    """The wheels in the robot's order; what is left out is added to ``warnings``. DataError, ConfigError."""
    messages = MessageFilter(bag, topic)
    places: dict[tuple[str, ...], tuple[int, ...] | None] = {}
    rows: list[tuple[Any, ...]] = []
    for record, stamp, (names, position, velocity) in messages.decoded(_joint_state):
        if names not in places:
            places[names] = wheel_joints(robot, joints, names)
        chosen = places[names]
        if chosen is not None:  # other joints may come by the same topic
            picked = (_picked(values, chosen, len(names)) for values in (position, velocity))
            rows.append((record.number, stamp, record.logged, *picked))
    if not rows:
        if not places:
            messages.require(0)
        raise no_joints(bag, topic, robot, joints, list(dict.fromkeys(name for names in places for name in names)))
    numbers, stamps, logged = (np.array([row[column] for row in rows], dtype=np.int64) for column in range(3))
    positions, velocities = (np.array([row[column] for row in rows]) for column in (3, 4))
    absolute = _uses_positions(positions, velocities, use)
    values = positions if absolute else velocities
    kind = "position" if absolute else "velocity"
    good = messages.keep(_possible(values), numbers, f"without a finite {kind} of every wheel")
    order = good[messages.in_order(stamps[good], numbers[good])]
    messages.require(len(order))
    warnings.extend(messages.warnings())
    return WheelStream(stamps[order], logged[order], values[order], absolute)


def read_poses(bag: Bag, topic: Topic, warnings: list[str]) -> PoseStream:
    """Planar reference poses; what is left out is added to ``warnings``. DataError."""
    messages = MessageFilter(bag, topic)
    rows, covariances, numbers, stamps = [], [], [], []
    for record, stamp, (pose, covariance) in messages.decoded(_pose):
        rows.append(pose)
        covariances.append(covariance)
        numbers.append(record.number)
        stamps.append(stamp)
    table = np.array(rows, dtype=float).reshape(-1, 6)
    number, stamp_array = np.array(numbers, dtype=np.int64), np.array(stamps, dtype=np.int64)
    good = messages.keep(_possible(table[:, :2]), number, "without a finite position")
    headings = planar_headings(table[:, 2:])
    flawed = good[headings.flawed[good]]
    if len(flawed):
        detail = headings.flaw(int(flawed[0]))
        good = good[messages.keep(~headings.flawed[good], number[good], f"with a wrong orientation, as {detail}")]
    order = good[messages.in_order(stamp_array[good], number[good])]
    messages.require(len(order))
    warnings.extend(messages.warnings())
    poses = np.column_stack([table[:, :2], headings.headings])[order]
    return PoseStream(stamp_array[order], poses, _known([covariances[index] for index in order]))


def header_stamp(message: Any) -> int:
    """The stamp of a message's header, ns; 0 when it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else int(stamp.sec) * _SECOND + int(stamp.nanosec)


class MessageFilter:
    """Filter of a topic's messages: drops the useless ones, and counts them by reason."""

    def __init__(self, bag: Bag, topic: Topic) -> None:
        self._bag = bag
        self._topic = topic
        self._place = f"{bag.path}: topic {topic.name}"
        self._reasons: dict[str, tuple[int, int]] = {}  # how many, and the first one's number
        self._sorted = 0

    def decoded(self, unpack: Callable[[Any], T]) -> Iterator[tuple[Record, int, T]]:
        """The messages that can be decoded and have a stamp (ns), each with the result of ``unpack``."""
        for record in self._bag.records(self._topic):
            try:
                stamp, content = header_stamp(record.message), unpack(record.message)
            except (AttributeError, TypeError, ValueError):  # garbage, or a type that the bag defines otherwise
                self._drop("that cannot be decoded", record.number)
                continue
            if stamp <= 0:
                self._drop(_NO_STAMP, record.number)
            else:
                yield record, stamp, content

    def keep(self, good: NDArray[np.bool_], numbers: Stamps, reason: str) -> NDArray[np.intp]:
        """Indices of the good messages; the others are dropped for ``reason``."""
        for number in numbers[~good]:
            self._drop(reason, int(number))
        return np.flatnonzero(good)

    def in_order(self, stamps: Stamps, numbers: Stamps) -> NDArray[np.intp]:
        """Indices that sort by stamp, without repeated stamps. DataError when the clock was set back."""
        newest = np.maximum.accumulate(stamps) if len(stamps) else stamps
        behind = newest - stamps
        late = np.flatnonzero(behind > _SECOND)
        if len(late) > _MOST_SET_BACK:
            first = late[0]
            raise DataError(
                f"{self._place}, message {numbers[first]}: the stamps go back by {behind[first] / _SECOND:.3g} s and "
                "stay behind: the clock was set back, or two recordings share the bag; split it there"
            )
        self._sorted = int(np.count_nonzero(behind))
        order = np.argsort(stamps, kind="stable")
        fresh: NDArray[np.bool_] = np.diff(stamps[order], prepend=-1) > 0
        self.keep(fresh, numbers[order], "with a repeated stamp")
        return order[fresh]

    def require(self, kept: int) -> None:
        """DataError when more messages were dropped than kept, or fewer than two kept."""
        if kept < max(2, sum(count for count, _ in self._reasons.values())):
            problem = self._dropped_in_words() or f"it has {plural(self._topic.messages, 'message')}, too few"
            way_out = "; the publisher must fill header.stamp" if _NO_STAMP in self._reasons else ""
            raise DataError(f"{self._place}: {problem}{way_out}")

    def warnings(self) -> list[str]:
        """Warnings of messages that were dropped or put in order."""
        warnings = [f"{self._place}: {self._dropped_in_words()}"] if self._reasons else []
        if self._sorted:
            late = "message was recorded late and sorted by its stamp"
            if self._sorted > 1:
                late = "messages were recorded late and sorted by their stamps"
            warnings.append(f"{self._place}: {self._sorted} {late}")
        return warnings

    def _drop(self, reason: str, number: int) -> None:
        count, first = self._reasons.get(reason, (0, number))
        self._reasons[reason] = (count + 1, first)

    def _dropped_in_words(self) -> str:
        if not self._reasons:
            return ""
        lost = sum(count for count, _ in self._reasons.values())
        parts = (f"{count} {reason} (first: message {first})" for reason, (count, first) in self._reasons.items())
        return f"{lost} of {plural(self._topic.messages, 'message')} left out: {', '.join(parts)}"


def _picked(values: Array, places: Sequence[int], names: int) -> Array:
    return values[list(places)] if len(values) == names else np.full(len(places), np.nan)


def _uses_positions(positions: Array, velocities: Array, use: Use) -> bool:
    if use != "auto":
        return use == "positions"
    counted, measured = _possible(positions), _possible(velocities)
    if measured.sum() > 2 * counted.sum():
        return False
    # Some drivers fill in zeros for positions that they do not know.
    stands = bool((positions[counted] == positions[counted][:1]).all())
    return not (stands and measured.any() and bool(velocities[measured].any()))


def _possible(values: Array) -> NDArray[np.bool_]:
    """True for rows whose values are finite, and smaller than any robot reaches."""
    small: NDArray[np.bool_] = np.abs(values) < _LARGEST
    return np.asarray(small.all(axis=1))


def _joint_state(message: Any) -> tuple[tuple[str, ...], Array, Array]:
    return tuple(message.name), np.asarray(message.position, dtype=float), np.asarray(message.velocity, dtype=float)


def _pose(message: Any) -> tuple[tuple[float, ...], Array | None]:
    """x, y and the quaternion of a message of any of the known types, and its covariance (3, 3)."""
    pose, covariance = message.pose, None
    if hasattr(pose, "covariance"):
        pose, covariance = pose.pose, np.reshape(pose.covariance, (6, 6))[_PLANAR]
    place, turn = pose.position, pose.orientation
    return (place.x, place.y, turn.x, turn.y, turn.z, turn.w), covariance


def _known(covariances: Sequence[Array | None]) -> Array | None:
    """Covariances (K, 3, 3), or None unless every pose has one; in ROS zeros and -1 mean that it is not known."""
    known = [each for each in covariances if each is not None]
    if len(known) < len(covariances):
        return None
    table = np.array(known, dtype=float)
    usable = np.isfinite(table).all() and (np.diagonal(table, axis1=1, axis2=2) > 0).all()
    return table if usable else None
