"""Poses, and wheel rates and steering angles of joints, from messages of a ROS recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from omnibench.data.importers.rosbag.bag import Bag, JointTopics, Record, RosbagOptions, Topic, Use
from omnibench.data.importers.wheel_samples import Quantity, WheelReadings
from omnibench.errors import DataError
from omnibench.robot.joint_choice import JointChoice
from omnibench.robot.kinematics import Array, interpolated, pose_covariance, usable_covariances
from omnibench.words import plural

_LARGEST_TILT = np.radians(20)  # rad; a larger tilt is that of another frame than the robot's body (chosen)
_LENGTH_TOLERANCE = 0.01  # largest deviation of a quaternion's length from 1 (chosen)


@dataclass(frozen=True, eq=False)
class PlanarHeadings:
    """Yaw of K orientations, and whether they are those of a robot on the floor.

    headings (K,): rad, within a turn. lengths (K,): the quaternions' lengths, 1 for a rotation. tilts (K,): rad,
    between the z axes of body and world. flawed (K,): the length is not 1 (to 1 %), or the tilt above 20 degrees: then
    it is another frame than the robot's body (z up), for example a camera's.
    """

    headings: Array
    lengths: Array
    tilts: Array
    flawed: NDArray[np.bool_]

    def flaw(self, index: int) -> str:
        """The flaw of an orientation in words."""
        if not abs(self.lengths[index] - 1) <= _LENGTH_TOLERANCE:
            return f"quaternion has length {self.lengths[index]:.3g}, expected 1"
        return f"pose is tilted by {np.degrees(self.tilts[index]):.0f} degrees; give poses of the robot's body (z up)"


def planar_headings(quaternions: Array) -> PlanarHeadings:
    """The yaw of quaternions (K, 4) in the order x, y, z, w; roll and pitch are left out."""
    with np.errstate(over="ignore", invalid="ignore"):  # recorded rubbish
        lengths = np.linalg.norm(quaternions, axis=1)
    rotation = np.abs(lengths - 1) <= _LENGTH_TOLERANCE  # False for NaN, too
    x, y, z, w = np.where(rotation, quaternions.T, [[0.0], [0.0], [0.0], [1.0]]) / np.where(rotation, lengths, 1.0)
    headings = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    tilts = np.arccos(np.clip(1 - 2 * (x**2 + y**2), -1, 1))
    return PlanarHeadings(headings, lengths, tilts, ~(rotation & (tilts <= _LARGEST_TILT)))


T = TypeVar("T")
Stamps = NDArray[np.int64]

_SECOND = 1_000_000_000  # ns
_NO_STAMP = "without a header stamp (it is 0)"
_MOST_SET_BACK = 20  # messages that may come over a second late; more mean a clock that was set back (chosen)
_LARGEST = 1e9  # m, rad or rad/s; a larger value is garbage
_UNKNOWN = np.zeros((3, 3))  # covariance of a pose that comes without one
_PLANAR = np.ix_((0, 1, 5), (0, 1, 5))  # x, y and yaw of a covariance of x, y, z, roll, pitch, yaw


@dataclass(frozen=True, eq=False)
class PoseStream:
    """Pose messages. stamps (K,): ns, increasing. poses (K, 3): m, m, rad. covariances (K, 3, 3), if all have one."""

    stamps: Stamps
    poses: Array
    covariances: Array | None


def read_poses(
    bag: Bag,
    topic: Topic,
    warnings: list[str],
    part: Callable[[Any], Any] = lambda message: message,
    sigma: tuple[float, float] | None = None,
) -> PoseStream:
    """Planar poses of messages, or of the ``part`` of each that has one; what is left out is added to ``warnings``.

    sigma: standard deviations (m, deg) of poses whose covariance is unknown. DataError.
    """
    messages = MessageFilter(bag, topic, part)
    rows, number, stamps = messages.collected(_pose)
    table = np.array([pose for pose, _ in rows], dtype=float).reshape(-1, 6)
    covariances = [covariance for _, covariance in rows]
    good = messages.keep(possible(table[:, :2]), number, "without a finite position")
    headings = planar_headings(table[:, 2:])
    flawed = good[headings.flawed[good]]
    if len(flawed):
        detail = headings.flaw(int(flawed[0]))
        good = good[messages.keep(~headings.flawed[good], number[good], f"with a wrong orientation, as {detail}")]
    order = good[messages.in_order(stamps[good], number[good])]
    messages.require(len(order))
    warnings.extend(messages.warnings())
    poses = np.column_stack([table[:, :2], headings.headings])[order]
    table = np.array([_UNKNOWN if covariances[index] is None else covariances[index] for index in order])
    usable = usable_covariances(table)
    unknown = (
        f"{bag.path}: topic {topic.name}: {np.sum(~usable)} of {plural(len(order), 'pose')} have no usable covariance"
    )
    if sigma is not None:
        table[~usable] = pose_covariance(*sigma)
        if not usable.all():
            warnings.append(f"{unknown}: {sigma[0]:g} m and {sigma[1]:g} deg count for them (pose_sigma)")
        return PoseStream(stamps[order], poses, table)
    if usable.any() and not usable.all():
        warnings.append(f"{unknown}, so that those of the others are left out; set pose_sigma=[m,deg] to use them")
    return PoseStream(stamps[order], poses, table if usable.all() else None)


def header_stamp(message: Any) -> int:
    """The stamp of a message's header, ns; 0 when it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else int(stamp.sec) * _SECOND + int(stamp.nanosec)


def stamp_of(topic: Topic, record: Record, part: Any) -> int:
    """The stamp, ns, of (a part of) a message: that of its header, or the time of recording where this counts."""
    return record.logged if topic.recorded or not hasattr(part, "header") else header_stamp(part)


class MessageFilter:
    """Filter of a topic's messages: drops the useless ones, and counts them by reason.

    part: gives the wanted part of a message; None where that is not in it. Messages of a type without header, and of
    topics for which it is asked, have the time of recording as their stamp.
    """

    def __init__(self, bag: Bag, topic: Topic, part: Callable[[Any], Any] = lambda message: message) -> None:
        self._bag = bag
        self._topic = topic
        self._part = part
        self._headless = False
        self._place = f"{bag.path}: topic {topic.name}"
        self._reasons: dict[str, tuple[int, int]] = {}  # how many, and the first one's number
        self._sorted = 0

    def decoded(self, unpack: Callable[[Any], T]) -> Iterator[tuple[Record, int, T]]:
        """The messages that can be decoded and have a stamp (ns), each with the result of ``unpack``."""
        for record in self._bag.records(self._topic):
            try:
                message = self._part(record.message)
                if message is None and record.message is not None:
                    continue
                stamp, content = stamp_of(self._topic, record, message), unpack(message)
            except (AttributeError, TypeError, ValueError):  # garbage, or a type that the bag defines otherwise
                self._drop("that cannot be decoded", record.number)
                continue
            self._headless |= not hasattr(message, "header")
            if stamp <= 0:
                self._drop(_NO_STAMP, record.number)
            else:
                yield record, stamp, content

    def collected(self, unpack: Callable[[Any], T]) -> tuple[list[T], Stamps, Stamps]:
        """The results of ``unpack`` of all these messages, their numbers (K,) and their stamps (K,), ns."""
        rows = [(content, record.number, stamp) for record, stamp, content in self.decoded(unpack)]
        numbers, stamps = (np.array([row[column] for row in rows], dtype=np.int64) for column in (1, 2))
        return [content for content, _, _ in rows], numbers, stamps

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

    def require(self, kept: int, way_out: str = "") -> None:
        """DataError when more messages were dropped than kept, or fewer than two kept.

        way_out: what to do where these have stamps.
        """
        if kept < max(2, sum(count for count, _ in self._reasons.values())):
            problem = self._dropped_in_words() or f"it has {plural(self._topic.messages, 'message')}, too few"
            if _NO_STAMP in self._reasons:
                topics = [topic.name for topic in self._bag.topics if topic.recorded or topic == self._topic]
                way_out = (
                    f"set recorded_stamps=[{','.join(topics)}] to take the times of recording, or record it anew: the "
                    "publisher must fill header.stamp"
                )
            raise DataError(f"{self._place}: {problem}{'; ' if way_out else ''}{way_out}")

    def warnings(self) -> list[str]:
        """Warnings of messages that were dropped or put in order."""
        warnings = [f"{self._place}: {self._dropped_in_words()}"] if self._reasons else []
        if self._headless:
            warnings.append(f"{self._place}: its messages have no stamps; they have the times of recording")
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


def possible(values: Array, largest: float = _LARGEST) -> NDArray[np.bool_]:
    """True for rows of values (F, n) that are finite, and smaller than anything real."""
    small: NDArray[np.bool_] = np.abs(values) < largest
    return np.asarray(small.all(axis=1))


def _pose(message: Any) -> tuple[tuple[float, ...], Array | None]:
    """x, y and the quaternion of a message of any of the known types, and its covariance (3, 3)."""
    if hasattr(message, "transform"):
        place, turn, covariance = message.transform.translation, message.transform.rotation, None
    else:
        pose, covariance = message.pose, None
        if hasattr(pose, "covariance"):
            pose, covariance = pose.pose, np.reshape(pose.covariance, (6, 6))[_PLANAR]
        place, turn = pose.position, pose.orientation
    return (place.x, place.y, turn.x, turn.y, turn.z, turn.w), covariance


# A longer gap while the robot drives ends a stretch, since a constant twist does not describe it (chosen):
_LONGEST_GAP = 0.5  # s, and
_LONGEST_GAP_PERIODS = 10  # sample periods
_LARGEST_COUNT = 2.0**64  # ticks
_USE: dict[Quantity, Use] = {"positions": "positions", "increments": "positions", "rates": "velocities"}


@dataclass(frozen=True, eq=False)
class WheelStream:
    """Readings of all wheels and steering angles. stamps (F,): ns, increasing. logged (F,): times of recording, ns.

    readings: their times are s since the first stamp.
    """

    stamps: Stamps
    logged: Stamps
    readings: WheelReadings

    @property
    def longest_gap(self) -> float:
        """The longest time, s, between readings of a robot that drives."""
        return _longest_gap(self.stamps)


@dataclass(frozen=True, eq=False)
class _JointStream:
    """Messages of some joints. values (F, n): angles that count on, rad, if ``counted``; else rates, rad/s."""

    stamps: Stamps
    logged: Stamps
    values: Array
    counted: bool


def read_wheels(bag: Bag, topics: JointTopics, options: RosbagOptions, warnings: list[str]) -> WheelStream:
    """The wheels and steering angles in the robot's order; what is left out is added to ``warnings``.

    Where they come by several topics, those of the others are interpolated at the stamps of the first, and its readings
    in their gaps left out. DataError, ConfigError.
    """
    wheels = _joints(bag, topics.wheels, topics, options, warnings)
    steering = _joints(bag, topics.steering, topics, options, warnings, steering=True) if topics.steering else []
    first, *others = wheels + steering
    if len({each.counted for each in wheels}) > 1:
        raise DataError(f"{bag.path}: some wheel topics hold positions and some velocities; --set use=velocities")
    kept = np.flatnonzero(np.logical_and.reduce([_covers(each.stamps, first.stamps) for each in (first, *others)]))
    if len(kept) < 2:
        names = ", ".join(topic.name for topic in dict.fromkeys((*topics.wheels, *topics.steering)))
        raise DataError(
            f"{bag.path}: topics {names} hold no messages of one time; all must be stamped by one clock, or be named "
            "in recorded_stamps"
        )
    stamps, logged, origin = first.stamps[kept], first.logged[kept], first.stamps[kept[0]]
    times = (stamps - origin) / 1e9
    values = [first.values[kept], *(interpolated(times, (each.stamps - origin) / 1e9, each.values) for each in others)]
    angles = np.hstack(values[len(wheels) :]) if steering else None
    absolute = first.counted and options.quantity == "positions"
    return WheelStream(
        stamps, logged, WheelReadings(times, np.hstack(values[: len(wheels)]), first.counted, absolute, angles)
    )


def _joints(
    bag: Bag,
    named: Sequence[Topic],
    topics: JointTopics,
    options: RosbagOptions,
    warnings: list[str],
    steering: bool = False,
) -> list[_JointStream]:
    """The joints of all wheels (or steered ones) by one topic, or those of each by its own."""
    wheels = options.robot.drive.steered if steering else options.robot.wheel_names
    asked = options.steering_joints if steering else options.joints
    only = set(topics.wheels).isdisjoint(topics.steering)
    if len(named) == 1:
        return [_read(bag, named[0], JointChoice(wheels, asked, steering, only), slice(None), options, warnings)]
    choices = [JointChoice((wheel,), asked[each : each + 1], steering, True) for each, wheel in enumerate(wheels)]
    return [
        _read(bag, topic, choice, slice(each, each + 1), options, warnings)
        for each, (topic, choice) in enumerate(zip(named, choices, strict=True))
    ]


def _read(
    bag: Bag, topic: Topic, choice: JointChoice, wheels: slice, options: RosbagOptions, warnings: list[str]
) -> _JointStream:
    """The joints of some wheels that come by one topic."""
    messages, place = MessageFilter(bag, topic), f"{bag.path}: topic {topic.name}"
    quantity = "positions" if choice.steering else options.quantity
    places: dict[tuple[str, ...], tuple[int, ...] | None] = {}
    rows: list[tuple[Any, ...]] = []
    for record, stamp, (names, position, velocity) in messages.decoded(partial(_joint_values, quantity)):
        if names not in places:
            places[names] = choice.places(names)
        chosen = places[names]
        if chosen is not None:  # other joints may come by the same topic
            picked = (_picked(values, chosen, len(names)) for values in (position, velocity))
            rows.append((record.number, stamp, record.logged, *picked))
    if not rows:
        if not places:
            messages.require(0)
        raise choice.not_found(place, list(dict.fromkeys(chain(*places))))
    numbers, stamps, logged = (np.array([row[column] for row in rows], dtype=np.int64) for column in range(3))
    positions, velocities = (np.array([row[column] for row in rows]) for column in (3, 4))
    unit = options.steering_unit if choice.steering else options.wheel_unit
    largest = _LARGEST_COUNT if unit.startswith("ticks") else _LARGEST
    use = options.use if quantity == "positions" and not choice.steering else _USE[quantity]
    counted = _uses_positions(positions, velocities, use, largest)
    values = positions if counted else velocities
    kind = "position" if counted else "velocity"
    whose, way_out = "every wheel", "set joints or wheel_topic to those that are measured"
    if choice.steering:
        whose, way_out = "every joint that steers", "set steering_joints or steering_topic to those that are measured"
    elif options.use != "auto":
        way_out = f"leave use={options.use} out, or {way_out}"
    good = messages.keep(possible(values, largest), numbers, f"without a finite {kind} of {whose}")
    order = good[messages.in_order(stamps[good], numbers[good])]
    messages.require(len(order), f"{way_out} (joints found: {', '.join(dict.fromkeys(chain(*places)))})")
    warnings.extend(each for each in messages.warnings() if each not in warnings)
    values = values[order]
    if choice.steering:
        values = options.steering_angles(values, place, wheels)
    elif counted:
        values = options.wheel_angles(values, 1e-9 * stamps[order], place, warnings, wheels)
    else:
        values = values * options.wheel_radians[wheels]
    return _JointStream(stamps[order], logged[order], values, counted)


def _joint_values(quantity: Quantity, message: Any) -> tuple[tuple[str, ...], Array, Array]:
    """Names, positions and velocities of the joints of a message; those of plain numbers are 0, 1 ..."""
    if hasattr(message, "position"):
        positions, velocities = (np.asarray(each, dtype=float) for each in (message.position, message.velocity))
        return tuple(message.name), positions, velocities
    numbers, none = np.ravel(np.asarray(message.data, dtype=float)), np.empty(0)
    names = tuple(map(str, range(len(numbers))))
    return (names, none, numbers) if quantity == "rates" else (names, numbers, none)


def _picked(values: Array, places: Sequence[int], names: int) -> Array:
    return values[list(places)] if len(values) == names else np.full(len(places), np.nan)


def _uses_positions(positions: Array, velocities: Array, use: Use, largest: float) -> bool:
    if use != "auto":
        return use == "positions"
    counted, measured = possible(positions, largest), possible(velocities, largest)
    if measured.sum() > 2 * counted.sum():
        return False
    # Some drivers fill in zeros for positions that they do not know.
    stands = bool((positions[counted] == positions[counted][:1]).all())
    return not (stands and measured.any() and bool(velocities[measured].any()))


def _covers(other: Stamps, stamps: Stamps) -> NDArray[np.bool_]:
    """True for stamps (F,) at which another stream has a message, or one before and one after without a gap."""
    after = np.searchsorted(other, stamps)
    inside = np.minimum(after, len(other) - 1)
    equal: NDArray[np.bool_] = other[inside] == stamps
    between = (after > 0) & (after < len(other))
    near = (other[inside] - other[np.maximum(after - 1, 0)]) / 1e9 <= _longest_gap(other)
    return equal | (between & near)


def _longest_gap(stamps: Stamps) -> float:
    return max(_LONGEST_GAP, _LONGEST_GAP_PERIODS * float(np.median(np.diff(stamps))) / 1e9)
