"""Choice of the joints in messages that are the robot's wheels, or the axles that steer them: of bags and live."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from omnibench.errors import ConfigError, nearest

# Words in the names of joints besides the wheel's own name: front_left_wheel_joint, drive/wheel_a.
_USUAL = {"wheel", "wheels", "joint", "motor", "drive", "traction", "link", "axle", "hub"}
# One of these, too, is in the name of a joint that steers: fl_steering_joint.
_STEERING = {"steer", "steering", "steered", "azimuth", "swivel", "pivot", "rotation", "turn"}


@dataclass(frozen=True)
class JointChoice:
    """The joints that are wanted of messages.

    wheels: that they turn or steer. asked: names of the joints, in the same order; or numbers of elements, from 0, of
    messages that are plain numbers. steering: the joints steer. only: the topic holds nothing else of the robot.
    """

    wheels: tuple[str, ...]
    asked: tuple[str, ...]
    steering: bool = False
    only: bool = False

    def places(self, found: Sequence[str]) -> tuple[int, ...] | None:
        """Indices of the joints among the names ``found``; None when not all of them are there.

        Where they are not asked for, joints are chosen by the wheels' names: equal ones, else those that are equal but
        for words such as ``wheel`` and ``joint``, case, and text before a slash; of plain numbers all are taken.
        """
        alone = self.only and len(self.wheels) == 1
        if not self.asked and (numbered(found) or alone) and len(found) == len(self.wheels):
            return tuple(range(len(found)))
        names = self.asked or self.wheels
        if (self.asked or not self.steering) and all(found.count(name) == 1 for name in names):
            return tuple(found.index(name) for name in names)
        if self.asked:
            return None
        matches = [self.matching(wheel, found) for wheel in self.wheels]
        places = tuple(indices[0] for indices in matches if len(indices) == 1)
        return places if len(set(places)) == len(matches) else None

    def matching(self, wheel: str, found: Sequence[str]) -> list[int]:
        """Indices of the joints that are called like a wheel, but for words such as ``wheel``, ``joint`` and case."""
        cores = [_core(name, self.steering) for name in found]
        places = [place for place, core in enumerate(cores) if core == _core(wheel)]
        if self.steering and len(self.wheels) == 1 and not places:
            places = [place for place, core in enumerate(cores) if core is not None]  # steering_joint
        return places

    def not_found(self, place: str, found: Sequence[str]) -> ConfigError:
        """The error of a topic whose messages never hold all that is wanted; it lists the joints found."""
        key, topic, role = "joints", "wheel_topic", "are the wheels"
        if self.steering:
            key, topic, role = "steering_joints", "steering_topic", "steer the wheels"
        shown = ", ".join(found) or "none (the messages name no joints)"
        missing = next((name for name in self.asked if name not in found), None)
        if missing is not None:
            return ConfigError(f"{place}: {key}: no joint {missing!r}; {nearest(missing, found)}found: {shown}")
        if self.asked:
            return ConfigError(f"{place}: no message holds all of {', '.join(self.asked)} once; joints found: {shown}")
        way = " (numbers of elements)" if numbered(found) else f", or {topic}"
        return ConfigError(
            f"{place}: cannot tell which joints {role} {', '.join(self.wheels)}; --set {key}=[...]{way}, in that "
            f"order; joints found: {shown}"
        )


def numbered(found: Sequence[str]) -> bool:
    """True for the names of plain numbers."""
    return tuple(found) == tuple(map(str, range(len(found))))


def _core(name: str, steering: bool = False) -> str | None:
    """A joint's or a wheel's name without usual words; None for a joint that does not steer if it should."""
    words = re.findall(r"[a-z]+|[0-9]+", name.lower().rpartition("/")[2])
    if steering and _STEERING.isdisjoint(words):
        return None
    left_out = _USUAL | _STEERING if steering else _USUAL
    return " ".join(word for word in words if word not in left_out) or " ".join(words)
