"""From wheel messages to wheel steps: what a real sender gets wrong is put right or refused, and counted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from omnibench.config import Model
from omnibench.live.counts import Counts
from omnibench.live.messages import JointState, MessageError
from omnibench.robot.kinematics import Array

_SECOND = 1e9  # ns
_TURN = 2 * math.pi
_CONFIRMATION = 3  # stamps in a row that make a new time of a stamp that cannot be
_REORDERED = 0.2  # s; what is late by less is out of order, never a clock that jumped back
_IRREGULAR = 0.25  # of the mean period
_SMOOTHING = 0.02  # share of a new period in the mean


class WheelSettings(Model):
    """How wheel messages are read."""

    joints: tuple[str, ...] | None = Field(None, description="names in the messages, in the robot's order of wheels")
    use: Literal["auto", "positions", "velocities"] = Field("auto", description="auto: positions where there are any")
    wrap: float | None = Field(
        None, gt=0, allow_inf_nan=False, description="angles start again after so much, rad; a full turn is found"
    )
    max_rate: float = Field(100.0, gt=0, allow_inf_nan=False, description="no wheel turns faster, rad/s")
    max_gap: float = Field(1.0, gt=0, allow_inf_nan=False, description="a longer silence is not bridged, s")


@dataclass(frozen=True, slots=True, eq=False)
class WheelStep:
    """What the wheels did from one sample to the next.

    angles (N,): rad. blind: s of the duration of whose motion nothing is known beyond ``angles``. counted: angles are
    differences of counters, so that they hold the whole motion of blind times too. restarted: the clock jumped, and
    stamps before have no meaning any more.
    """

    stamp: int
    duration: float
    angles: Array
    blind: float = 0.0
    counted: bool = True
    restarted: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    stamp: int
    arrival: float
    positions: Array | None
    velocities: Array | None


class WheelInput:
    """Takes the wheel messages of one robot in the order of their arrival.

    last_refusal: why the latest refused message was refused, in words. period: s from sample to sample, on average.
    """

    def __init__(self, wheels: Sequence[str], settings: WheelSettings, period: float, counts: Counts) -> None:
        self._joints = settings.joints or tuple(wheels)
        self._settings = settings
        self._counts = counts
        self._places: dict[tuple[str, ...], NDArray[np.intp]] = {}
        self._last: _Sample | None = None
        self._rates: Array = np.zeros(len(self._joints))
        self._suspects: list[_Sample] = []
        self.period = period
        self.last_refusal = ""

    @property
    def last_sample(self) -> tuple[int, Array | None] | None:
        """Stamp and wheel angles of the last sample taken, for a node that starts again."""
        return None if self._last is None else (self._last.stamp, self._last.positions)

    def resume(self, stamp: int, positions: Array | None, arrival: float) -> None:
        """Go on after a sample that another process took."""
        self._last = _Sample(stamp, arrival, positions, None)

    def take(self, message: JointState, arrival: float) -> list[WheelStep]:
        """The steps that a message makes: mostly one; none when it is refused or has to be confirmed first.

        arrival: s, by a clock of this machine that never jumps.
        """
        try:
            sample = self._read(message, arrival)
        except MessageError as error:
            self.last_refusal = str(error)
            return []
        if self._last is None:
            self._counts.samples += 1
            self._last = sample
            return [WheelStep(sample.stamp, 0.0, np.zeros(len(self._joints)))]
        elapsed = (sample.stamp - self._last.stamp) / _SECOND
        if elapsed == 0 or (self._suspects and sample.stamp == self._suspects[-1].stamp):
            self._counts.duplicates += 1
            return []
        if 0 < elapsed <= self._settings.max_gap:
            if self._suspects:
                self._drop_suspects()
            return [self._step(sample, elapsed)]
        if -_REORDERED <= elapsed < 0:
            self._counts.late += 1
            return []
        return self._suspect(sample)

    def _read(self, message: JointState, arrival: float) -> _Sample:
        places = self._places.get(message.names)
        if places is None:
            places = self._find(message.names)
        positions = None if message.positions is None else message.positions.take(places)
        velocities = None if message.velocities is None else message.velocities.take(places)
        if self._settings.use == "velocities" or (self._settings.use == "auto" and self._rates_only()):
            positions = None
        if positions is None and (velocities is None or self._settings.use == "positions"):
            self._counts.wrong_joints += 1
            raise MessageError(f"it has no {'positions' if self._settings.use != 'velocities' else 'velocities'}")
        used = velocities if positions is None else positions
        assert used is not None
        if not all(map(math.isfinite, used.tolist())):
            self._counts.not_finite += 1
            raise MessageError(f"wheels say {used.tolist()}")
        if velocities is not None and not all(abs(rate) <= self._settings.max_rate for rate in velocities.tolist()):
            if positions is None:
                self._counts.too_fast += 1
                raise MessageError(
                    f"wheel rates {velocities.tolist()} rad/s exceed max_rate {self._settings.max_rate:g}"
                )
            velocities = None
        return _Sample(message.stamp, arrival, positions, velocities)

    def _rates_only(self) -> bool:
        """Whether the sender began without positions: then it stays so, lest motion be counted twice."""
        return self._last is not None and self._last.positions is None

    def _find(self, names: tuple[str, ...]) -> NDArray[np.intp]:
        missing = [joint for joint in self._joints if joint not in names]
        if missing:
            self._counts.wrong_joints += 1
            raise MessageError(
                f"no joint {missing[0]!r} among {', '.join(names[:12]) or 'no names'}; set wheels.joints"
            )
        if len(self._places) > 16:  # a sender that makes up names forever shall not fill the memory
            self._places.clear()
        places = self._places[names] = np.array([names.index(joint) for joint in self._joints])
        return places

    def _step(self, sample: _Sample, elapsed: float, *, restarted: bool = False) -> WheelStep:
        """The step to a sample ``elapsed`` s after the last one."""
        assert self._last is not None
        gap = elapsed > self._settings.max_gap
        if not gap and not restarted:
            periods = elapsed / self.period
            self._counts.missing += max(round(periods) - 1, 0)
            self._counts.irregular += abs(periods - max(round(periods), 1)) > _IRREGULAR
            self.period += _SMOOTHING * (min(elapsed, 3 * self.period) - self.period)
        blind = elapsed if gap or restarted else 0.0
        if sample.positions is None:
            assert sample.velocities is not None
            seen = min(elapsed, self.period) if blind else elapsed  # a rate says nothing of a long silence before it
            angles, counted = sample.velocities * seen, False
        else:
            angles, counted = self._counted(sample, elapsed)
            blind = blind if counted else elapsed
        self._counts.samples += 1
        self._last = sample
        self._rates = angles / elapsed
        return WheelStep(sample.stamp, elapsed, angles, blind, counted, restarted)

    def _counted(self, sample: _Sample, elapsed: float) -> tuple[Array, bool]:
        """Differences of wheel angles, and whether they can be trusted: not where a counter began again."""
        assert self._last is not None
        before = self._last.positions
        assert before is not None
        assert sample.positions is not None
        angles: Array = sample.positions - before
        largest = self._settings.max_rate * (elapsed + self.period)
        if self._settings.wrap is not None:
            wrapped = angles - self._settings.wrap * np.round(angles / self._settings.wrap)
            self._counts.wraps += int((wrapped != angles).any())
            angles = wrapped
        elif max(map(abs, angles.tolist())) > min(largest, math.pi):
            angles = self._unwrapped(angles, before, sample.positions)
        if max(map(abs, angles.tolist())) <= largest:
            return angles, True
        strange = np.abs(angles) > largest
        self._counts.counter_restarts += 1
        rates = self._rates if sample.velocities is None else sample.velocities
        return np.where(strange, rates * min(elapsed, self._settings.max_gap), angles), False

    def _unwrapped(self, angles: Array, before: Array, after: Array) -> Array:
        """The shorter way round, for wheels whose angles lie within one turn as those of ROS 2's continuous joints."""
        within = (np.abs(before) <= _TURN + 1e-6) & (np.abs(after) <= _TURN + 1e-6) & (np.abs(angles) > math.pi)
        if within.any():
            self._counts.wraps += 1
        return np.where(within, angles - _TURN * np.round(angles / _TURN), angles)

    def _suspect(self, sample: _Sample) -> list[WheelStep]:
        """A stamp too far off: taken for the new time once others follow it, else dropped."""
        assert self._last is not None
        if self._suspects and not 0 < (sample.stamp - self._suspects[-1].stamp) / _SECOND <= self._settings.max_gap:
            self._drop_suspects()
        self._suspects.append(sample)
        if len(self._suspects) < _CONFIRMATION:
            self.last_refusal = f"its stamp is {(sample.stamp - self._last.stamp) / _SECOND:+.3f} s from the last one"
            return []
        first, *others = self._suspects
        self._suspects = []
        elapsed, waited = (first.stamp - self._last.stamp) / _SECOND, first.arrival - self._last.arrival
        silence = elapsed > 0 and abs(elapsed - waited) <= 0.5 + 0.1 * elapsed
        if silence:
            self._counts.gaps += 1
            steps = [self._step(first, elapsed)]
        else:
            self._counts.clock_jumps += 1
            steps = [self._step(first, max(waited, self.period), restarted=True)]
        for each in others:
            steps.append(self._step(each, (each.stamp - self._last.stamp) / _SECOND))
        return steps

    def _drop_suspects(self) -> None:
        assert self._last is not None
        late = sum(each.stamp < self._last.stamp for each in self._suspects)
        self._counts.late += late
        self._counts.bad_stamps += len(self._suspects) - late
        self._suspects = []
