"""From wheel messages to wheel steps: messages are put in order, repaired or refused, and counted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from omnibench.config import Model, Positive
from omnibench.errors import ConfigError
from omnibench.live.health import Counts
from omnibench.live.wire import JointState, MessageError
from omnibench.robot.joint_choice import JointChoice
from omnibench.robot.kinematics import FASTEST, FASTEST_RIM, Array, Robot, fastest_rates

_TURN = 2 * math.pi
_WITHIN_A_TURN = _TURN + 1e-6  # rad, a turn and rounding
# Share of its last reading below which a counter has restarted; chosen: a robot seldom drives back so near its start.
_RESTARTED = 0.05
_JITTER = 0.01  # s, by which stamps may be too close together; chosen
_FASTER = 1.5  # times the fastest rate so far is the fastest that is believed of a silence; chosen


class WheelAngles:
    """The counters of one robot's wheels.

    wrap: the angle after which counters start again, rad; None: a counter that stays within one turn is taken to wrap
    there. max_rate: of any wheel, rad/s. known (N,): the last reading, rad; None before the first.
    """

    def __init__(self, wheels: int, wrap: float | None, max_rate: float, counts: Counts) -> None:
        self._wrap = wrap
        self._max_rate = max_rate
        self._counts = counts
        self._fastest = 0.0  # rad/s, of any wheel so far
        self._beyond_a_turn = np.zeros(wheels, dtype=bool)  # counters that have been there do not wrap at a turn
        self._wraps = wrap is not None
        self.known: Array | None = None

    def begin(self, positions: Array | None) -> None:
        """Count from these angles (N,) rad; None: from the next reading."""
        self.known = positions
        if positions is not None:
            self._beyond_a_turn |= np.abs(positions) > _WITHIN_A_TURN

    def drive(self, angles: Array) -> None:
        """Add a turn by ``angles`` (N,) rad that comes from rates and not from the counters."""
        if self.known is not None:
            self.known = self.known + angles

    def turned(self, positions: Array, rates: Array, elapsed: float) -> tuple[Array, bool]:
        """Angles (N,) rad since the last reading, and True if they hold the whole motion.

        rates (N,): expected, rad/s; they stand in for a counter that restarted. elapsed: s since the last reading.
        """
        assert self.known is not None
        expected = rates * elapsed
        angles = self._unwrapped(positions, expected)
        self.begin(positions)
        farthest, span = max(map(abs, angles.tolist())), max(elapsed, _JITTER)
        if farthest <= self._max_rate * span:
            self._fastest = max(self._fastest, farthest / span)
            return angles, True
        self._counts.counter_restarts += 1
        return np.where(np.abs(angles) > self._max_rate * span, expected, angles), False

    def turned_unseen(self, positions: Array, elapsed: float) -> tuple[Array, bool]:
        """Angles and flag of ``turned`` after a silence of ``elapsed`` s: turns may be lost, counters restarted."""
        assert self.known is not None
        before = self.known
        # counters that wrap do not tell how far the wheels went: the shortest way is taken
        angles = self._unwrapped(positions, np.zeros(len(positions))) if self._wraps else positions - before
        self.begin(positions)
        fastest = (_FASTER * self._fastest or self._max_rate) * elapsed + math.pi
        far = np.abs(before) > math.pi
        restarted = bool(far.any()) and bool((np.abs(positions) < _RESTARTED * np.abs(before))[far].all())
        if restarted or (np.abs(angles) > fastest).any():
            self._counts.counter_restarts += 1
            return np.zeros(len(angles)), False
        turns_may_be_lost = self._wrap is not None or not self._beyond_a_turn.all()
        length = self._wrap or _TURN
        return angles, not (turns_may_be_lost and fastest > length / 2 + math.pi)

    def _unwrapped(self, positions: Array, expected: Array) -> Array:
        """Differences (N,) rad from the last reading, with the wraps that bring them nearest to those expected."""
        assert self.known is not None
        angles: Array = positions - self.known
        length = self._wrap or _TURN
        if max(map(abs, (angles - expected).tolist())) <= length / 2:
            return angles
        wraps = np.round((angles - expected) / length)
        if self._wrap is None:  # a continuous joint of ROS 2 may wrap at a turn
            wraps[self._beyond_a_turn | (np.abs(positions) > _WITHIN_A_TURN)] = 0.0
        if wraps.any():
            self._counts.wraps += 1
            self._wraps = True
        return angles - length * wraps


REORDERED: Final = 0.2  # s; a message that is late by less is out of order, or the clock was set back a little; chosen
_SECOND = 1e9  # ns
_MOST_SENDERS = 16  # lists of names that are remembered, so that a sender of ever new ones cannot fill the memory


class SteeringInput:
    """Takes the positions of a robot's steering joints, in messages of their own or beside those of the wheels.

    joints (S,): their names. choice: finds them where a message calls them otherwise. limit: beyond it, rad, no angle
    is believed. An angle that a message does not tell, or tells as NaN, as ros2_control does of joints without a
    position, is held.
    """

    def __init__(self, joints: Sequence[str], choice: JointChoice, limit: float, counts: Counts) -> None:
        self._joints = tuple(joints)
        self._choice = choice
        self._limit = limit
        self._counts = counts
        self._angles = [math.nan] * len(self._joints)
        self._stamps = [0] * len(self._joints)  # ns, of each angle
        self._places: dict[tuple[str, ...], list[tuple[int, int]]] = {}  # joints and their places in a message

    def tells(self, names: tuple[str, ...]) -> bool:
        """True if a message with these names has a steering joint."""
        return bool(self._found(names))

    def take(self, message: JointState) -> str:
        """Take the angles that a message tells, but those that are older than the known ones; why one is refused."""
        refusal = ""
        if message.positions is None:
            return refusal
        for joint, place in self._found(message.names):
            angle, known = float(message.positions[place]), self._angles[joint]
            if not math.isfinite(angle):
                continue
            if abs(angle) > self._limit:
                self._counts.bad_steering += 1
                refusal = _too_far(self._joints[joint], angle)
                continue
            if math.isnan(known):
                known = angle
            elif -REORDERED * _SECOND <= message.stamp - self._stamps[joint] < 0:
                continue
            # a joint may wrap at a turn: the angle between two readings lies on the shorter way
            self._angles[joint] = angle + _TURN * round((known - angle) / _TURN)
            self._stamps[joint] = message.stamp
        return refusal

    def known(self, message: JointState) -> Array:
        """The angles (S,) at a message, rad. MessageError: one was never told, nor is it by this message."""
        for joint, angle in zip(self._joints, self._angles, strict=True):
            if math.isnan(angle):
                self._counts.no_steering += 1
                raise MessageError(f"no steering angle yet: {self._why_missing(joint, message)}")
        return np.array(self._angles)

    def age(self, stamp: int) -> float:
        """Time at a stamp (ns) since the oldest angle was told, s."""
        return max(abs(stamp - each) for each in self._stamps) / _SECOND

    def resume(self, stamp: int, angles: Array | None) -> None:
        """Continue from the angles (S,), rad, that another process knew at a stamp, ns."""
        if angles is not None:
            self._angles, self._stamps = angles.tolist(), [stamp] * len(self._joints)

    def _why_missing(self, joint: str, message: JointState) -> str:
        place = dict(self._found(message.names)).get(self._joints.index(joint))
        if place is None:
            return f"no joint {joint!r} among {', '.join(message.names[:12])}; set wheels.steering_joints"
        if message.positions is None or math.isnan(angle := message.positions[place]):
            return f"joint {joint!r} tells no position"
        return _too_far(joint, angle)

    def _found(self, names: tuple[str, ...]) -> list[tuple[int, int]]:
        found = self._places.get(names)
        if found is None:
            if len(self._places) >= _MOST_SENDERS:
                self._places.clear()
            found = []
            for index, (joint, wheel) in enumerate(zip(self._joints, self._choice.wheels, strict=True)):
                matching = [] if self._choice.asked else self._choice.matching(wheel, names)
                if joint in names or len(matching) == 1:
                    found.append((index, names.index(joint) if joint in names else matching[0]))
            self._places[names] = found
        return found


def _too_far(joint: str, angle: float) -> str:
    return f"joint {joint!r} says {angle:g} rad, so far such a wheel does not steer; is it in degrees?"


_CONFIRMATION = 3  # stamps in a row that confirm a new time of the sender's clock (chosen, as all here)
_SET_BACK = 3  # late samples in a row; so many are of a clock that was set back, and not out of order
_SLACK = 0.1  # s, by which arrivals may scatter
_LEARNING = 10  # samples, whose lower quartile gives the first period, so that lost ones do not lengthen it
_SLOWER = 50  # samples in a row each after a missing one, as of a robot that sends more rarely than before
_SMOOTHING = 0.02  # share of a new period in the mean
_IRREGULAR = 0.25  # share of the mean period by which a regular one may be off
_MEMORY = 0.995  # share of the past in the pace of the stamps, which is 1 of a robot and more of a fast replay
_FOLLOWING = 1e-3  # share of a sample's delay that counts as the drift of the two clocks


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

    def for_wheels(self, radii: Array) -> WheelSettings:
        """With the rate that no wheel of radii (N,), m, exceeds; a motor in the place of its wheel has a small one."""
        if self.max_rate is not None:
            return self
        return self.model_copy(update={"max_rate": float(fastest_rates(radii).max())})


@dataclass(frozen=True, slots=True, eq=False)
class WheelStep:
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


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    """A checked message, its joints in the order of the wheels. stamp: ns. arrival: s.

    skipped: messages before it that never came, by the sender's numbers; 0 also of a sender without numbers. steering
    (S,): rad. steering_age: of the oldest of these angles, s.
    """

    stamp: int
    arrival: float
    positions: Array | None
    velocities: Array | None
    skipped: int = 0
    steering: Array | None = None
    steering_age: float = 0.0


class WheelInput:
    """Takes the wheel messages of one robot in the order of their arrival.

    wheels (N): names in the robot's order, and in the messages, unless the settings name joints. steering: of a robot
    that steers. last_refusal: reason of the latest refusal, in words. period: mean time from sample to sample, s, at
    first the calibration's.
    """

    def __init__(
        self,
        wheels: Sequence[str],
        settings: WheelSettings,
        period: float,
        counts: Counts,
        steering: SteeringInput | None = None,
    ) -> None:
        self._joints = settings.joints or tuple(wheels)
        self._choice = JointChoice(tuple(wheels), settings.joints or ())
        self._settings = settings
        self._counts = counts
        self._steering = steering
        self._places: dict[tuple[str, ...], NDArray[np.intp] | None] = {}
        self._fastest = settings.max_rate or FASTEST
        self._angles = WheelAngles(len(self._joints), settings.wrap, self._fastest, counts)
        self._counting = settings.use == "positions"  # True: angles come from counters, False: from rates
        self._last: _Sample | None = None
        self._rates: Array = np.zeros(len(self._joints))
        self._unconfirmed: list[_Sample] = []  # samples of a new time of the clock, until enough of them came
        self._late_in_a_row = 0
        self.repeats, self.repeated_at = 0, 0.0  # samples in a row with the last stamp, and when the last of them came
        self._learnt: list[float] = []
        self._after_missing = 0  # samples in a row, each after a missing one
        self._stamped, self._waited = 1.0, 1.0  # s by stamps and by this machine's clock, recent ones weighing most
        self._on_time = 0.0  # s, when the last sample would have come without the delays that others did not have
        self.period = period
        self.last_refusal = ""

    @property
    def last_sample(self) -> tuple[int, Array | None, Array | None] | None:
        """Stamp (ns), wheel angles (N,) and steering (S,) of the last sample taken, for a node that starts again."""
        return None if self._last is None else (self._last.stamp, self._angles.known, self._last.steering)

    @property
    def old_steering(self) -> float:
        """Age of the last sample's steering angles, s, where that is more than it may be; else 0."""
        age = 0.0 if self._last is None else self._last.steering_age
        return age if age > self._settings.max_steering_age else 0.0

    def resume(self, stamp: int, positions: Array | None, arrival: float, steering: Array | None = None) -> None:
        """Continue after a sample that another process took; arrival: s, by this process's clock."""
        if self._steering is not None:
            self._steering.resume(stamp, steering)
        self._last = _Sample(stamp, arrival, positions, None, steering=steering)
        self._on_time = arrival
        self._counting = positions is not None and self._settings.use != "velocities"
        self._angles.begin(positions if self._counting else None)

    def take(self, message: JointState, arrival: float, skipped: int = 0) -> list[WheelStep]:
        """The steps that a message makes: mostly one; none while it is refused or has to be confirmed.

        arrival: s, by a clock of this machine that never jumps. skipped: messages before it that never came, by the
        sender's numbers.
        """
        try:
            sample = self._read(message, arrival, skipped)
        except MessageError as error:
            self.last_refusal = str(error)
            return []
        if sample is None:
            return []
        if self._last is None:
            return [self._first(sample)]
        elapsed = (sample.stamp - self._last.stamp) / _SECOND
        if elapsed == 0 or (self._unconfirmed and sample.stamp == self._unconfirmed[-1].stamp):
            self._counts.duplicates += 1
            self.repeats, self.repeated_at = self.repeats + 1, arrival
            return []
        if 0 < elapsed <= self._settings.max_gap:
            if self._unconfirmed:
                self._drop_unconfirmed()
            return [self._step(sample, elapsed)]
        if -REORDERED <= elapsed < 0:
            self._counts.late += 1
            self._late_in_a_row += 1
            return []
        if elapsed > 0 and abs(elapsed - self._waited_for(sample)) <= 0.5 + 0.1 * elapsed:
            return [self._after_silence(sample, elapsed)]
        return self._confirmed(sample)

    def _read(self, message: JointState, arrival: float, skipped: int) -> _Sample | None:
        """Check a message and take the wheels' values from it; None if it holds steering joints alone.

        MessageError: why it is refused.
        """
        if self._steering is not None:
            self.last_refusal = self._steering.take(message)
        places = self._places[message.names] if message.names in self._places else self._find(message.names)
        if places is None:
            return None
        use = self._settings.use
        positions = None if message.positions is None or use == "velocities" else message.positions.take(places)
        velocities = None if message.velocities is None or use == "positions" else message.velocities.take(places)
        if positions is not None and velocities is not None:
            # ros2_control fills in NaN for what its joints do not tell
            told = _told(positions, velocities), _told(velocities, positions)
            positions, velocities = told
        if positions is None and velocities is None:
            self._counts.wrong_joints += 1
            raise MessageError(f"it has no {'positions and no velocities' if use == 'auto' else use}")
        for values in (positions, velocities):
            if values is not None and not all(map(math.isfinite, values.tolist())):
                self._counts.not_finite += 1
                raise MessageError(f"wheels say {values.tolist()}")
        if velocities is not None and not all(abs(rate) <= self._fastest for rate in velocities.tolist()):
            if positions is None:
                self._counts.too_fast += 1
                raise MessageError(f"wheel rates {velocities.tolist()} rad/s exceed max_rate {self._fastest:g}")
            velocities = None
        if self._steering is None:
            return _Sample(message.stamp, arrival, positions, velocities, skipped)
        steering, age = self._steering.known(message), self._steering.age(message.stamp)
        return _Sample(message.stamp, arrival, positions, velocities, skipped, steering, age)

    def _find(self, names: tuple[str, ...]) -> NDArray[np.intp] | None:
        """Places (N,) of the wheels among a message's joints; None if it holds steering joints alone.

        MessageError: a wheel is not there.
        """
        chosen = self._choice.places(names)
        missing = [] if chosen else [joint for joint in self._joints if joint not in names]
        if not self._choice.asked:
            missing = [joint for joint in missing if not self._choice.matching(joint, names)]
        alone = len(missing) == len(self._joints) and self._steering is not None and self._steering.tells(names)
        if chosen is None and not alone:
            self._counts.wrong_joints += 1
            where = f"among {', '.join(names[:12]) or 'no names'}; set wheels.joints"
            raise MessageError(
                f"no joint {missing[0]!r} {where}" if missing else f"more than one joint a wheel {where}"
            )
        if len(self._places) > 16:  # so that a sender of ever new names cannot fill the memory
            self._places.clear()
        places = self._places[names] = None if chosen is None else np.array(chosen)
        return places

    def _first(self, sample: _Sample) -> WheelStep:
        """The first step, which has no duration; from here on angles are counted if there are any, else rates."""
        self._counting = sample.positions is not None
        self._angles.begin(sample.positions)
        self._counts.samples += 1
        self._last, self._on_time = sample, sample.arrival
        if sample.velocities is not None:
            self._rates = sample.velocities
        still = np.zeros(len(self._joints))
        return WheelStep(sample.stamp, 0.0, still, self._rates, positions=self._angles.known, steering=sample.steering)

    def _step(self, sample: _Sample, elapsed: float) -> WheelStep:
        """The step to the next sample, ``elapsed`` s after the last one by its stamp."""
        assert self._last is not None
        waited = self._waited_for(sample)
        set_back = self._late_in_a_row >= _SET_BACK and waited > elapsed + 2 * self.period
        set_ahead = elapsed > max(waited + _SLACK, (3 + sample.skipped) * self.period)
        if set_back or set_ahead:  # the clock jumped within the limits of a next sample: this machine's clock counts
            self._counts.clock_jumps += 1
            unseen = max(elapsed, waited)
            elapsed = min(max(waited, self.period), self._settings.max_gap)
            self._on_time = sample.arrival
        else:
            due = self._on_time + elapsed / self._pace
            self._on_time = min(sample.arrival, due + _FOLLOWING * (sample.arrival - due))
            self._learn(elapsed, sample.arrival - self._last.arrival, sample.skipped)
            unseen = elapsed - self.period if elapsed > 1.7 * self.period else 0.0
        self._late_in_a_row = 0
        if self._counting and sample.positions is not None and self._angles.known is not None:
            rates = self._rates if sample.velocities is None else sample.velocities
            angles, counted = self._angles.turned(sample.positions, rates, elapsed)
            if elapsed >= 0.5 * self.period:  # two that arrive at once tell no rate
                rates = angles / elapsed
            return self._taken(sample, elapsed, angles, rates, 0.0 if counted else elapsed, counted)
        return self._by_rates(sample, elapsed, elapsed, blind=unseen)

    def _after_silence(self, sample: _Sample, elapsed: float, *, restarted: bool = False) -> WheelStep:
        """The step over a silence of ``elapsed`` s, of which only the two ends are known."""
        if not restarted:
            self._counts.gaps += 1
        self._late_in_a_row, self._on_time = 0, sample.arrival
        if self._counting and sample.positions is not None and self._angles.known is not None:
            angles, counted = self._angles.turned_unseen(sample.positions, elapsed)
            rates = angles / elapsed if sample.velocities is None else sample.velocities
            return self._taken(sample, elapsed, angles, rates, elapsed, counted, restarted)
        return self._by_rates(sample, elapsed, self.period, blind=elapsed, restarted=restarted)

    def _by_rates(
        self, sample: _Sample, elapsed: float, seen: float, *, blind: float, restarted: bool = False
    ) -> WheelStep:
        """The step of a sample without angles to compare with: its rates, or the last ones, for ``seen`` s."""
        rates = self._rates if sample.velocities is None else sample.velocities
        angles = rates * min(seen, elapsed)
        if sample.positions is not None and (self._counting or sample.velocities is None):
            self._counting = True
            self._angles.begin(sample.positions)
        else:
            self._angles.drive(angles)
        return self._taken(sample, elapsed, angles, rates, blind, False, restarted)

    def _taken(
        self,
        sample: _Sample,
        elapsed: float,
        angles: Array,
        rates: Array,
        blind: float,
        counted: bool,
        restarted: bool = False,
    ) -> WheelStep:
        """The step of a sample that is taken, which becomes the last one."""
        self._counts.samples += 1
        self.repeats = 0
        self._last, self._rates = sample, rates
        known, steering, held = self._angles.known, sample.steering, self.old_steering > 0
        if held:
            self._counts.old_steering += 1
            blind = elapsed
        return WheelStep(sample.stamp, elapsed, angles, rates, blind, counted, restarted, known, steering, held)

    def _learn(self, elapsed: float, waited: float, skipped: int) -> None:
        """Update the mean period and the pace of the stamps, and count missing and irregular samples.

        skipped: samples of the period that never came, by their numbers.
        """
        bunched = self._settings.stamps == "arrival"  # the time between two then tells no period
        self._stamped = _MEMORY * self._stamped + elapsed
        self._waited = _MEMORY * self._waited + waited
        if len(self._learnt) < _LEARNING and not bunched:
            self._counts.missing += skipped
            self._learnt.append(elapsed / (1 + skipped))
            self.period = sorted(self._learnt)[len(self._learnt) // 4]
            return
        periods = elapsed / self.period
        whole = 1 + skipped if bunched else max(math.floor(periods + 0.3), 1)
        self._counts.missing += whole - 1
        self._counts.irregular += abs(periods - whole) > _IRREGULAR
        self.period += _SMOOTHING * (elapsed / whole - self.period)
        self._after_missing = self._after_missing + 1 if whole > 1 + skipped else 0
        if self._after_missing == _SLOWER:
            self._learnt.clear()
            self._after_missing = 0

    @property
    def _pace(self) -> float:
        """Time by the stamps per time by this machine's clock."""
        return self._stamped / self._waited if self._waited > 1e-6 else 1e6

    def _waited_for(self, sample: _Sample) -> float:
        """Time since the last sample should have come, by this machine's clock at the pace of the stamps, s."""
        assert self._last is not None
        if 0.5 < self._pace < 2:  # a robot; a replay may come as it likes
            return sample.arrival - self._on_time
        return (sample.arrival - self._last.arrival) * self._pace

    def _confirmed(self, sample: _Sample) -> list[WheelStep]:
        """The steps of samples at a new time of the clock, once enough follow each other; till then none."""
        assert self._last is not None
        if (
            self._unconfirmed
            and not 0 < (sample.stamp - self._unconfirmed[-1].stamp) / _SECOND <= self._settings.max_gap
        ):
            self._drop_unconfirmed()
        self._unconfirmed.append(sample)
        if len(self._unconfirmed) < _CONFIRMATION:
            self.last_refusal = f"its stamp is {(sample.stamp - self._last.stamp) / _SECOND:+.3f} s from the last one"
            return []
        first, *others = self._unconfirmed
        self._unconfirmed = []
        self._counts.clock_jumps += 1
        elapsed = (first.stamp - self._last.stamp) / _SECOND
        waited = max(self._waited_for(first), self.period)
        if elapsed > 0:
            waited = min(waited, elapsed)
        if waited > self._settings.max_gap:
            steps = [self._after_silence(first, waited, restarted=True)]
        else:
            steps = [replace(self._step(first, waited), restarted=True)]
        for other in others:
            steps.append(self._step(other, (other.stamp - self._last.stamp) / _SECOND))
        return steps

    def _drop_unconfirmed(self) -> None:
        assert self._last is not None
        late = sum(sample.stamp < self._last.stamp for sample in self._unconfirmed)
        self._counts.late += late
        self._counts.bad_stamps += len(self._unconfirmed) - late
        self._unconfirmed = []


def _told(values: Array, others: Array) -> Array | None:
    """Values (N,) of the wheels; None if none is told, and the ``others`` (N,) are."""
    return None if math.isnan(values[0]) and np.isnan(values).all() and not np.isnan(others).any() else values


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
