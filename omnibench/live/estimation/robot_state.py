"""State of one robot: its estimators, what came last, and what was refused.

Published stamps: none is published twice, since listeners such as tf2 take a repeated stamp for repeated data.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from itertools import count

from omnibench.live.estimation.counts import Counts
from omnibench.live.estimation.extrapolation_monitor import ExtrapolationMonitor
from omnibench.live.estimation.health import SwapRecord
from omnibench.live.estimation.live_odometry import LiveOdometry
from omnibench.live.fusion.pose_fusion import Fusion, FusionSettings
from omnibench.live.fusion.timeline import ReferenceCorrection, Timeline
from omnibench.live.wheels.wheel_input import SteeringInput, WheelInput, WheelSettings, joints_of
from omnibench.robot.calibration import Calibration
from omnibench.robot.joint_choice import JointChoice
from omnibench.robot.kinematics import CarDrive


class PublishedStamps:
    """Stamps (ns) that were published, to be told apart from those that come when the robot's clock jumps back.

    remembered: how many of the latest stamps are kept (some 80 bytes each). A stamp older than these can be published
    twice by chance, after a clock that jumped back so far.
    """

    def __init__(self, remembered: int = 120_000) -> None:
        self._remembered = remembered
        self._order: deque[int] = deque()
        self._known: set[int] = set()  # the stamps of _order, for looking up
        self._shift = 1  # ns by which the last repeated stamp was moved; a recording in a loop moves all alike

    def __len__(self) -> int:
        return len(self._order)

    def unique(self, stamp: int) -> int:
        """``stamp``, or the next free one (ns) if it was published already; the result counts as published."""
        if stamp in self._known:
            if stamp + self._shift in self._known:
                longer = count(self._shift + 1)
                self._shift = next(shift for shift in longer if stamp + shift not in self._known)
            stamp += self._shift
        if len(self._order) == self._remembered:
            self._known.remove(self._order.popleft())
        self._order.append(stamp)
        self._known.add(stamp)
        return stamp


_HISTORY = 5.0  # s of odometry that are remembered without fusion; chosen, as FusionSettings.history
# Largest steering angles, rad, of a car, which drives by their tangents, and of others, 1600 turns one way; chosen.
_FARTHEST_OF_CAR, _FARTHEST = math.radians(85.0), 1e4


@dataclass(slots=True, eq=False)
class RobotState:
    """Everything that samples, poses and orders change.

    fusion: None for odometry alone. guessed_angles: names of the calibration's effects that need wheel angles, while
    nobody has been warned that there are none. arrival: of the last wheel sample, s, monotonic. behind: longest time
    for which a sample had waited when it was taken, s, since the health was last measured. refusals: number of messages
    that were refused for a reason; last_refusal: that of the last. flows: flow of an acknowledged replay -> number of
    the next message that is not in the odometry. last_swap: None before the first calibration is sent.
    """

    name: str
    calibration: Calibration
    counts: Counts
    wheel_input: WheelInput
    odometry: LiveOdometry
    timeline: Timeline
    fusion: Fusion | None
    reference: ReferenceCorrection
    monitor: ExtrapolationMonitor
    guessed_angles: str
    stamps: PublishedStamps = field(default_factory=PublishedStamps)
    arrival: float | None = None
    behind: float = 0.0
    flows: dict[int, int] = field(default_factory=dict)
    refusals: int = 0
    last_refusal: str = ""
    last_swap: SwapRecord | None = None

    def refused(self, reason: str) -> None:
        """Remember why a message was refused."""
        self.refusals += 1
        self.last_refusal = reason


def new_state(name: str, calibration: Calibration, wheels: WheelSettings, fusion: FusionSettings | None) -> RobotState:
    """The state before the first message: odometry at the origin, nobody knows where in the map.

    ConfigError: the joints that ``wheels`` names are not one for each wheel.
    """
    counts, drive = Counts(), calibration.robot.drive
    joints = joints_of(calibration.robot, wheels, f"robot {name!r}: wheels")
    limit = _FARTHEST_OF_CAR if isinstance(drive, CarDrive) else _FARTHEST
    choice = JointChoice(drive.steered, wheels.steering_joints or (), steering=True)
    steering = SteeringInput(joints.steering, choice, limit, counts) if drive.steered else None
    timeline = Timeline(fusion.history if fusion else _HISTORY)
    taken = wheels.for_wheels(calibration.robot.radii)
    return RobotState(
        name=name,
        calibration=calibration,
        counts=counts,
        wheel_input=WheelInput(calibration.robot.wheel_names, taken, calibration.sample_period, counts, steering),
        odometry=LiveOdometry(calibration, (fusion or FusionSettings()).standstill),
        timeline=timeline,
        fusion=Fusion(fusion, timeline, counts) if fusion else None,
        reference=ReferenceCorrection(calibration.model),
        monitor=ExtrapolationMonitor(name, calibration),
        guessed_angles=wheel_angle_effects(calibration),
    )


def wheel_angle_effects(calibration: Calibration) -> str:
    """Names of the calibration's effects that depend on the absolute angles of the wheels."""
    terms = calibration.model.motion_terms
    return ", ".join(term.name for term in terms if "wheel_angles" in term.effect.needs)
