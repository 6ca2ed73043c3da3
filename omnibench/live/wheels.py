"""From wheel messages to wheel steps: decode reads a message, admit puts it in order, unwrap counts the wheels' turns.

What comes late, twice, from a clock that jumped or from a counter that restarted is repaired or refused, and counted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np
from pydantic import Field

from omnibench.config import Model, Positive
from omnibench.errors import ConfigError
from omnibench.live.health import Counts
from omnibench.live.wire import JointState, arrival_stamp
from omnibench.robot.joint_choice import JointChoice
from omnibench.robot.kinematics import FASTEST, FASTEST_RIM, Array, CarDrive, Robot, fastest_rates

_SECOND: Final = 1e9  # ns
_TURN: Final = 2 * math.pi
_WITHIN_A_TURN: Final = _TURN + 1e-6  # rad, a turn and rounding
_LARGEST_ANGLE: Final = 1e12  # rad; no counter goes beyond, nor does a saved state; chosen
# Largest steering angles, rad, of a car, which drives by their tangents, and of others, 1600 turns one way; chosen.
_FARTHEST_OF_CAR, _FARTHEST = math.radians(85.0), 1e4
_MOST_SENDERS: Final = (
    16  # lists of names that are remembered, so that a sender of ever new ones cannot fill the memory
)
REORDERED: Final = 0.2  # s; a message that is late by less is out of order, or the clock was set back a little; chosen


class WheelSettings(Model):
    """Settings for reading wheel messages."""

    joints: tuple[str, ...] | None = Field(None, description="names in the messages, in the robot's order of wheels")
    steering_joints: tuple[str, ...] | None = Field(
        None,
        description="names in the messages, in the order of steered wheels; default: <wheel>_steering",
    )
    use: Literal["auto", "positions", "velocities"] = Field("auto", description="auto: positions where there are any")
    wrap: Positive | None = Field(
        None, description="angle after which angles start again, rad; default: one turn where they seem to"
    )
    max_rate: Positive | None = Field(
        None, description=f"no wheel turns faster, rad/s; default: {FASTEST:g}, or {FASTEST_RIM:g} m/s at its rim"
    )
    stamps: Literal["header", "arrival"] = Field(
        "header", description="arrival: where headers' stamps are 0 or by another clock, the times of arrival count"
    )
    max_gap: Positive = Field(1.0, description="a longer silence makes the path unknown, s")
    max_steering_age: Positive = Field(0.2, description="older steering angles make the path unknown, s")


class WheelStep(NamedTuple):
    """Motion of the wheels from one sample to the next.

    stamp: ns, at its end. duration: s. angles (N,): rad. rates (N,): at its end, rad/s. blind: s of the duration for
    which only ``angles`` are known and not the path. counted: angles are differences of counters, which hold the whole
    motion of blind times too. restarted: the clock jumped, and stamps before have no meaning. positions (N,): readings
    of the counters at its end, rad; None where there are none. steering (S,): angles of the steered wheels at its end,
    rad; None of a robot that does not steer. held: these are old ones.
    """

    stamp: int
    duration: float
    angles: Array
    rates: Array
    blind: float = 0.0
    counted: bool = True
    restarted: bool = False
    positions: Array | None = None
    steering: Array | None = None
    held: bool = False


class Reading(NamedTuple):
    """A checked message, its joints in the order of the wheels. stamp: ns. arrival: s, monotonic.

    positions: rad, N of them, velocities: rad/s; at least one of them is there. skipped: messages before it that never
    came, by the sender's numbers; 0 also of a sender without numbers. steering: rad, S of them. steering_age: of the
    oldest of these angles, s.
    """

    stamp: int
    arrival: float
    positions: list[float] | None
    velocities: list[float] | None
    skipped: int = 0
    steering: list[float] | None = None
    steering_age: float = 0.0


class _Places(NamedTuple):
    """Places of joints in a message: of the wheels, and pairs of a steered wheel and its place.

    wheels: None if the message holds steering joints alone, or if wheels are missing: then ``refusal`` says which.
    """

    wheels: Sequence[int] | None
    steering: Sequence[tuple[int, int]]
    refusal: str = ""


class WheelState:
    """All that is known of one robot's wheel messages.

    settings: its ``max_rate`` is set by the robot's wheels, unless it is given. period: mean time from sample to
    sample, s, at first the calibration's. ConfigError that begins with ``where``: the joints in the settings are not
    one for each wheel.

    refusal: why the latest message was refused, or some of its angles, in words. last: the last reading taken. known:
    readings of the wheels' counters at it, rad; None where there are none. steering: angles of the steered wheels, rad;
    NaN until they are told. repeats: samples in a row with the last stamp; repeated_at: arrival of the last of them, s.
    """

    def __init__(
        self, robot: Robot, settings: WheelSettings, period: float, counts: Counts, where: str = "wheels"
    ) -> None:
        self.settings, self.counts, self.period = settings, counts, period
        self.joints = joints_of(robot, settings, where)
        self.wheel_choice = JointChoice(robot.wheel_names, settings.joints or ())
        self.steering_choice = JointChoice(robot.drive.steered, settings.steering_joints or (), steering=True)
        self.max_rate = settings.max_rate or float(fastest_rates(robot.radii).max())  # a motor may have a small radius
        self.places: dict[tuple[str, ...], _Places] = {}  # by the names of a message's joints
        self.farthest_steering = _FARTHEST_OF_CAR if isinstance(robot.drive, CarDrive) else _FARTHEST
        self.steering = [math.nan] * len(self.joints.steering)
        self.steered_at = [0] * len(self.joints.steering)  # ns, stamp of each angle
        self.refusal = ""
        self.last: Reading | None = None
        self.rates = [0.0] * len(self.joints.wheels)
        self.counting = False  # True: angles come from counters, False: from rates
        self.known: list[float] | None = None
        self.wraps = settings.wrap is not None
        self.beyond_a_turn = [False] * len(self.joints.wheels)  # counters that have been there do not wrap at a turn
        self.fastest = 0.0  # rad/s, of any wheel so far
        self.unconfirmed: list[Reading] = []  # readings at a new time of the clock, until enough of them came
        self.late_in_a_row = 0
        self.repeats, self.repeated_at = 0, 0.0
        self.learnt: list[float] = []  # periods
        self.after_missing = 0  # samples in a row, each after a missing one
        self.stamped, self.waited = 1.0, 1.0  # s by stamps and by this machine's clock, recent ones weighing most
        self.pace = 1.0  # of the stamps, by this machine's clock: 1 of a robot, and more of a fast replay
        self.on_time = 0.0  # s, when the last sample would have come without the delays that others did not have

    @property
    def old_steering(self) -> float:
        """Age of the last sample's steering angles, s, where that is more than it may be; else 0."""
        age = 0.0 if self.last is None else self.last.steering_age
        return age if age > self.settings.max_steering_age else 0.0

    def refuse(self, counter: str, reason: str) -> None:
        """Count a message, or an angle of it, that is refused for a reason."""
        setattr(self.counts, counter, getattr(self.counts, counter) + 1)
        self.refusal = reason

    def count_from(self, positions: list[float] | None) -> None:
        """Count from these angles, rad, N of them; None: from the next reading."""
        self.known = positions
        if positions is not None:
            for wheel, angle in enumerate(positions):
                if abs(angle) > _WITHIN_A_TURN:
                    self.beyond_a_turn[wheel] = True

    def resume(
        self, stamp: int, positions: list[float] | None, arrival: float, steering: list[float] | None = None
    ) -> None:
        """Continue after a sample that another process took; arrival: s, by this process's clock."""
        if self.steering and steering is not None:
            self.steering, self.steered_at = list(steering), [stamp] * len(steering)
        self.last = Reading(stamp, arrival, positions, None, steering=steering)
        self.on_time = arrival
        self.counting = positions is not None and self.settings.use != "velocities"
        self.count_from(positions if self.counting else None)


def decode(
    message: JointState, arrival: float, state: WheelState, skipped: int = 0, *, replayed: bool = False
) -> Reading | None:
    """Check a message and take its values; None if it is refused, or holds steering joints alone.

    arrival: s, monotonic. skipped: messages before it that never came, by the sender's numbers. replayed: its stamp
    counts in any case.
    """
    state.refusal, settings, names = "", state.settings, message.names
    stamp = arrival_stamp(arrival) if settings.stamps == "arrival" and not replayed else message.stamp
    places = state.places.get(names) or _find(names, state)
    angles = None if message.positions is None else message.positions.tolist()
    rates = None if message.velocities is None else message.velocities.tolist()
    # Steering angles, but for those that are older than the known ones, or NaN, as ros2_control fills in.
    for joint, place in places.steering:
        angle, known = math.nan if angles is None else angles[place], state.steering[joint]
        if not math.isfinite(angle):
            continue
        if abs(angle) > state.farthest_steering:
            state.refuse("bad_steering", _too_far(state.joints.steering[joint], angle))
        elif math.isnan(known) or not -REORDERED * _SECOND <= stamp - state.steered_at[joint] < 0:
            # a joint may wrap at a turn: the angle between two readings lies on the shorter way
            state.steering[joint] = angle if math.isnan(known) else angle + _TURN * round((known - angle) / _TURN)
            state.steered_at[joint] = stamp
    if places.refusal:
        state.refuse("wrong_joints", places.refusal)
        return None
    if places.wheels is None:
        return None
    positions = None if angles is None or settings.use == "velocities" else [angles[place] for place in places.wheels]
    velocities = None if rates is None or settings.use == "positions" else [rates[place] for place in places.wheels]
    if positions is not None and velocities is not None:  # ros2_control fills in NaN for what its joints do not tell
        if all(map(math.isnan, positions)) and not any(map(math.isnan, velocities)):
            positions = None
        elif all(map(math.isnan, velocities)) and not any(map(math.isnan, positions)):
            velocities = None
    if positions is None and velocities is None:
        use = "positions and no velocities" if settings.use == "auto" else settings.use
        state.refuse("wrong_joints", f"it has no {use}")
        return None
    if positions is not None and not all(abs(angle) <= _LARGEST_ANGLE for angle in positions):  # or NaN
        state.refuse("not_finite", f"wheels say {positions}")
        return None
    if velocities is not None and not all(abs(rate) <= state.max_rate for rate in velocities):
        if not all(map(math.isfinite, velocities)):
            state.refuse("not_finite", f"wheels say {velocities}")
            return None
        if positions is None:
            state.refuse("too_fast", f"wheel rates {velocities} rad/s exceed max_rate {state.max_rate:g}")
            return None
        velocities = None
    if not state.steering:
        return Reading(stamp, arrival, positions, velocities, skipped)
    for joint, name in enumerate(state.joints.steering):
        if math.isnan(state.steering[joint]):
            told = {steered: math.nan if angles is None else angles[place] for steered, place in places.steering}
            if joint not in told:
                why = f"no joint {name!r} among {', '.join(names[:12])}; set wheels.steering_joints"
            elif math.isnan(told[joint]):
                why = f"joint {name!r} tells no position"
            else:
                why = _too_far(name, told[joint])
            state.refuse("no_steering", f"no steering angle yet: {why}")
            return None
    age = max(abs(stamp - each) for each in state.steered_at) / _SECOND
    return Reading(stamp, arrival, positions, velocities, skipped, list(state.steering), age)


def _find(names: tuple[str, ...], state: WheelState) -> _Places:
    """Places of the joints among a message's names."""
    steering, joints = [], state.joints
    for index, (joint, wheel) in enumerate(zip(joints.steering, state.steering_choice.wheels, strict=True)):
        alike = [] if state.steering_choice.asked else state.steering_choice.matching(wheel, names)
        if joint in names or len(alike) == 1:
            steering.append((index, names.index(joint) if joint in names else alike[0]))
    choice, refusal = state.wheel_choice, ""
    wheels = choice.places(names)
    if wheels is None:
        missing = [joint for joint in joints.wheels if joint not in names]
        if not choice.asked:
            missing = [joint for joint in missing if not choice.matching(joint, names)]
        if not (steering and len(missing) == len(joints.wheels)):
            refusal = f"no joint {missing[0]!r}" if missing else "more than one joint a wheel"
            refusal += f" among {', '.join(names[:12]) or 'no names'}; set wheels.joints"
    if len(state.places) >= _MOST_SENDERS:
        state.places.clear()
    places = state.places[names] = _Places(wheels, steering, refusal)
    return places


def _too_far(joint: str, angle: float) -> str:
    return f"joint {joint!r} says {angle:g} rad, so far such a wheel does not steer; is it in degrees?"


_CONFIRMATION = 3  # stamps in a row that confirm a new time of the sender's clock (chosen, as all here)
_SET_BACK = 3  # late samples in a row; so many are of a clock that was set back, and not out of order
_SLACK = 0.1  # s, by which arrivals may scatter
_LEARNING = 10  # samples, whose lower quartile gives the first period, so that lost ones do not lengthen it
_SLOWER = 50  # samples in a row each after a missing one, as of a robot that sends more rarely than before
_SMOOTHING = 0.02  # share of a new period in the mean
_IRREGULAR = 0.25  # share of the mean period by which a regular one may be off
_MEMORY = 0.995  # share of the past in the pace of the stamps
_FOLLOWING = 1e-3  # share of a sample's delay that counts as the drift of the two clocks


def admit(reading: Reading, state: WheelState) -> list[WheelStep]:
    """The steps that a reading makes, by its stamp: mostly one; none while it is refused or has to be confirmed."""
    counts, last, max_gap = state.counts, state.last, state.settings.max_gap
    if last is None:
        return [_step(reading, 0.0, state)]
    elapsed = (reading.stamp - last.stamp) / _SECOND
    if elapsed == 0 or (state.unconfirmed and reading.stamp == state.unconfirmed[-1].stamp):
        counts.duplicates += 1
        state.repeats, state.repeated_at = state.repeats + 1, reading.arrival
        return []
    if 0 < elapsed <= max_gap:
        if state.unconfirmed:
            _drop_unconfirmed(state)
        return [_step(reading, elapsed, state)]
    if -REORDERED <= elapsed < 0:
        counts.late += 1
        state.late_in_a_row += 1
        return []
    if elapsed > 0 and abs(elapsed - _waited_for(reading, state)) <= 0.5 + 0.1 * elapsed:
        return [_step(reading, elapsed, state, silence=True)]
    # The stamp is at a new time of the clock, which counts once enough readings follow each other there.
    if state.unconfirmed and not 0 < (reading.stamp - state.unconfirmed[-1].stamp) / _SECOND <= max_gap:
        _drop_unconfirmed(state)
    state.unconfirmed.append(reading)
    if len(state.unconfirmed) < _CONFIRMATION:
        state.refusal = f"its stamp is {elapsed:+.3f} s from the last one"
        return []
    (first, *others), state.unconfirmed = state.unconfirmed, []
    counts.clock_jumps += 1
    elapsed = (first.stamp - last.stamp) / _SECOND
    waited = max(_waited_for(first, state), state.period)
    if elapsed > 0:
        waited = min(waited, elapsed)
    steps = [_step(first, waited, state, silence=waited > max_gap, restarted=True)]
    for other in others:
        steps.append(_step(other, (other.stamp - steps[-1].stamp) / _SECOND, state))
    return steps


def _drop_unconfirmed(state: WheelState) -> None:
    assert state.last is not None
    for reading in state.unconfirmed:
        if reading.stamp < state.last.stamp:
            state.counts.late += 1
        else:
            state.counts.bad_stamps += 1
    state.unconfirmed.clear()


def _waited_for(reading: Reading, state: WheelState) -> float:
    """Time since the last sample should have come, by this machine's clock at the pace of the stamps, s."""
    assert state.last is not None
    if 0.5 < state.pace < 2:  # a robot; a replay may come as it likes
        return reading.arrival - state.on_time
    return (reading.arrival - state.last.arrival) * state.pace


def _step(
    reading: Reading, elapsed: float, state: WheelState, *, silence: bool = False, restarted: bool = False
) -> WheelStep:
    """The step to a reading that is taken, ``elapsed`` s after the last one. silence: only its two ends are known."""
    counts, positions, velocities, first = state.counts, reading.positions, reading.velocities, state.last is None
    unseen, rated = elapsed, state.period  # s of which the path is not known, and for which rates stand
    if first or silence:
        counts.gaps += silence and not restarted
        state.on_time = reading.arrival
    else:
        elapsed, unseen = _by_clocks(reading, elapsed, state)
        rated = elapsed
    rates = state.rates if velocities is None else velocities
    if state.counting and positions is not None and state.known is not None:
        expected = None if silence else [rate * elapsed for rate in rates]
        angles, counted = unwrap(positions, expected, elapsed, state)
        # two that arrive at once tell no rate, and the ends of a silence only that of a sender without rates
        if (silence and velocities is None) or (not silence and elapsed >= 0.5 * state.period):
            rates = [angle / elapsed for angle in angles]
        unseen = elapsed if silence or not counted else 0.0
    else:  # no angles to compare with: rates, or the last ones; the first step has no duration
        angles, counted = [rate * min(rated, elapsed) for rate in rates], first
        if positions is not None and (first or state.counting or velocities is None):
            state.counting = True
            state.count_from(positions)
        elif state.known is not None:
            state.known = [known + angle for known, angle in zip(state.known, angles, strict=True)]
    state.last, state.rates, state.repeats, state.late_in_a_row = reading, rates, 0, 0
    counts.samples += 1
    held = not first and reading.steering_age > state.settings.max_steering_age
    counts.old_steering += held
    return WheelStep(
        reading.stamp,
        elapsed,
        np.array(angles),
        np.array(rates),
        elapsed if held else unseen,
        counted,
        restarted,
        None if state.known is None else np.array(state.known),
        None if reading.steering is None else np.array(reading.steering),
        held,
    )


def _by_clocks(reading: Reading, elapsed: float, state: WheelState) -> tuple[float, float]:
    """Duration of a step that takes ``elapsed`` by the stamps, and how much of it nobody saw, both in s.

    Mean period and pace of the stamps are learnt, and missing and irregular samples are counted.
    """
    assert state.last is not None
    counts, waited, skipped = state.counts, _waited_for(reading, state), reading.skipped
    set_back = state.late_in_a_row >= _SET_BACK and waited > elapsed + 2 * state.period
    set_ahead = elapsed > max(waited + _SLACK, (3 + skipped) * state.period)
    if set_back or set_ahead:  # the clock jumped within the limits of a next sample: this machine's clock counts
        counts.clock_jumps += 1
        state.on_time = reading.arrival
        return min(max(waited, state.period), state.settings.max_gap), max(elapsed, waited)
    due = state.on_time + elapsed / state.pace
    state.on_time = min(reading.arrival, due + _FOLLOWING * (reading.arrival - due))
    bunched = state.settings.stamps == "arrival"  # the time between two then tells no period
    state.stamped = _MEMORY * state.stamped + elapsed
    state.waited = _MEMORY * state.waited + (reading.arrival - state.last.arrival)
    state.pace = state.stamped / state.waited if state.waited > 1e-6 else 1e6
    if len(state.learnt) < _LEARNING and not bunched:
        counts.missing += skipped
        state.learnt.append(elapsed / (1 + skipped))
        state.period = sorted(state.learnt)[len(state.learnt) // 4]
    else:
        periods = elapsed / state.period
        whole = 1 + skipped if bunched else max(math.floor(periods + 0.3), 1)
        counts.missing += whole - 1
        counts.irregular += abs(periods - whole) > _IRREGULAR
        state.period += _SMOOTHING * (elapsed / whole - state.period)
        state.after_missing = state.after_missing + 1 if whole > 1 + skipped else 0
        if state.after_missing == _SLOWER:
            state.learnt.clear()
            state.after_missing = 0
    return elapsed, elapsed - state.period if elapsed > 1.7 * state.period else 0.0


# Share of its last reading below which a counter has restarted; chosen: a robot seldom drives back so near its start.
_RESTARTED = 0.05
_JITTER = 0.01  # s, by which stamps may be too close together; chosen
_FASTER = 1.5  # times the fastest rate so far is the fastest that is believed of a silence; chosen


def unwrap(
    positions: list[float], expected: list[float] | None, elapsed: float, state: WheelState
) -> tuple[list[float], bool]:
    """Angles since the last reading, rad, and True if they hold the whole motion of ``elapsed`` s.

    expected: angles by the rates; they stand in for a counter that restarted. None after a silence, in which turns may
    be lost and counters restarted.
    """
    before, wrap = state.known, state.settings.wrap
    assert before is not None
    # A counter that wraps is brought nearest to what is expected; after a silence it does not tell how far the wheel
    # went: the shortest way is taken. A continuous joint of ROS 2 may wrap at a turn.
    length, may_wrap, wrapped, angles = wrap or _TURN, expected is not None or state.wraps, False, []
    for wheel, (position, known) in enumerate(zip(positions, before, strict=True)):
        angle = position - known
        turns = round((angle - (expected[wheel] if expected else 0.0)) / length) if may_wrap else 0
        if turns and (wrap is not None or not (state.beyond_a_turn[wheel] or abs(position) > _WITHIN_A_TURN)):
            angle -= length * turns
            state.wraps = wrapped = True
        angles.append(angle)
    state.counts.wraps += wrapped
    state.count_from(positions)
    farthest = max(map(abs, angles))
    if expected is not None:
        span = max(elapsed, _JITTER)
        if farthest <= state.max_rate * span:
            state.fastest = max(state.fastest, farthest / span)
            return angles, True
        state.counts.counter_restarts += 1
        return [
            near if abs(angle) > state.max_rate * span else angle for near, angle in zip(expected, angles, strict=True)
        ], False
    limit = (_FASTER * state.fastest or state.max_rate) * elapsed + math.pi
    far = [(at, known) for at, known in zip(positions, before, strict=True) if abs(known) > math.pi]
    if farthest > limit or (far and all(abs(at) < _RESTARTED * abs(known) for at, known in far)):
        state.counts.counter_restarts += 1
        return [0.0] * len(angles), False
    turns_may_be_lost = wrap is not None or not all(state.beyond_a_turn)
    return angles, not (turns_may_be_lost and limit > length / 2 + math.pi)


@dataclass(frozen=True)
class Joints:
    """Names of the joints of wheels with a measured rate (N) and of those that steer (S)."""

    wheels: tuple[str, ...]
    steering: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """All, wheels first."""
        return self.wheels + self.steering


def joints_of(robot: Robot, settings: WheelSettings | None = None, where: str = "wheels") -> Joints:
    """A robot's joints. ConfigError that begins with ``where``: they are not one, and a different one, for each wheel.

    By default a wheel has its own name, and its steering joint that name with _steering at the end.
    """
    rated, steered, settings = robot.wheel_names, robot.drive.steered, settings or WheelSettings()
    joints = Joints(
        rated if settings.joints is None else settings.joints,
        tuple(f"{name}_steering" for name in steered) if settings.steering_joints is None else settings.steering_joints,
    )
    check_joints(joints.wheels, rated, f"{where}.joints")
    check_joints(joints.steering, steered, f"{where}.steering_joints", "steered wheels")
    if both := set(joints.wheels) & set(joints.steering):
        raise ConfigError(f"{where}.steering_joints: {min(both)} is the joint of a wheel, too; name its steering joint")
    return joints


def check_joints(joints: Sequence[str], wheels: Sequence[str], where: str, what: str = "wheels") -> None:
    """ConfigError that begins with ``where``: the joints are not one, and a different one, for each wheel."""
    if len(joints) != len(wheels) or len(set(joints)) < len(joints):
        reason = f"name one joint, and a different one, for each of the {what} {', '.join(wheels)}"
        raise ConfigError(f"{where}: {', '.join(joints) or 'none'}; {reason if wheels else 'no wheel steers'}")
