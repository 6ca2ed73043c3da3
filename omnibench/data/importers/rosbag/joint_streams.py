"""Wheels and steering angles of a bag as arrays: joints of JointState messages, or plain numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omnibench.data.importers.rosbag.bag import Bag, JointTopics, Topic
from omnibench.data.importers.rosbag.message_streams import MessageFilter, Stamps, possible
from omnibench.data.importers.rosbag.rosbag_options import RosbagOptions, Use
from omnibench.data.importers.wheel_samples import Quantity, WheelReadings
from omnibench.errors import DataError
from omnibench.robot.joint_choice import JointChoice
from omnibench.robot.kinematics import Array, interpolated

# A longer gap while the robot drives ends a stretch, since a constant twist does not describe it (chosen):
_LONGEST_GAP = 0.5  # s, and
_LONGEST_GAP_PERIODS = 10  # sample periods
_LARGEST = 1e9  # rad or rad/s; a larger value is garbage
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
