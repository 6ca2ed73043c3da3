"""Steering angles of one robot from its wheel messages: continued over turns, and held where a message tells none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from omnibench.live.estimation.counts import Counts
from omnibench.live.wire.messages import JointState, MessageError
from omnibench.robot.joint_choice import JointChoice
from omnibench.robot.kinematics import Array

REORDERED: Final = 0.2  # s; a message that is late by less is out of order, or the clock was set back a little; chosen
_SECOND = 1e9  # ns
_TURN = 2 * math.pi
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
