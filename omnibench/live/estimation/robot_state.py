"""State of one robot: its estimators, what came last, and what was refused.

Published stamps: none is published twice, since listeners such as tf2 take a repeated stamp for repeated data.
Extrapolation monitor: how long a robot has driven outside the training domain of its calibration's effects.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from dataclasses import dataclass, field
from itertools import count

import numpy as np

from omnibench.live.estimation.health import Counts, SwapRecord
from omnibench.live.estimation.live_odometry import LiveOdometry
from omnibench.live.fusion.pose_fusion import Fusion, FusionSettings, ReferenceCorrection, Timeline
from omnibench.live.wheels.wheel_input import SteeringInput, WheelInput, WheelSettings, WheelStep, joints_of
from omnibench.robot.calibration import Calibration
from omnibench.robot.corrections import TrainingDomain, extrapolation_consequence
from omnibench.robot.joint_choice import JointChoice
from omnibench.robot.kinematics import Array, CarDrive

LOG = logging.getLogger("omnibench.live")
_WINDOW = 0.5  # s, over which a twist is averaged before it is judged; chosen
_TRANSITION = 1.0  # s; a motion that lasts no longer is a transition and does not count; chosen


class ExtrapolationMonitor:
    """Counts the time that a robot drives outside its calibration's training domain; warns in the log the first time.

    seconds: the time so far; None where the calibration has no effects, or does not say what it was fitted to.
    """

    def __init__(self, robot: str, calibration: Calibration) -> None:
        self._robot, self._calibration = robot, calibration
        self._domain: TrainingDomain | None = None
        self.seconds: float | None = None
        if calibration.effects and calibration.driven:
            self._domain, self.seconds = TrainingDomain(calibration.robot, calibration.driven), 0.0
        self._matrix = calibration.matrix_array
        self._lasted = 0.0  # s that the robot has now been outside the domain without a break
        self._driven: Array = np.zeros(self._matrix.shape[1])  # rad, integrals of the signals in the present window
        self._elapsed = 0.0  # s since the present window began

    def take(self, step: WheelStep, driven: Array) -> None:
        """Take a wheel step with the integrals (M,) of its drive signals, rad."""
        if self._domain is None:
            return
        if step.blind:  # its motion is not known
            self._begin()
            return
        self._driven = self._driven + driven
        self._elapsed += step.duration
        if self._elapsed >= _WINDOW:
            self._judge(self._domain, self._matrix @ self._driven / self._elapsed)
            self._begin()

    def _begin(self) -> None:
        self._driven = np.zeros(self._matrix.shape[1])
        self._elapsed = 0.0

    def _judge(self, domain: TrainingDomain, motion: Array) -> None:
        if not domain.is_outside(motion):
            self._lasted = 0.0
            return
        before, self._lasted = self._lasted, self._lasted + self._elapsed
        if self._lasted <= _TRANSITION:
            return
        assert self.seconds is not None
        if not self.seconds:
            LOG.warning(
                "%s: drives motions that %r was not fitted to, such as %s: %s; told once, then counted in health",
                *(self._robot, self._calibration.name, domain.in_words(motion[None])),
                extrapolation_consequence(
                    [term.name for term in self._calibration.effects], fading=self._calibration.plain is not None
                ),
            )
        self.seconds += self._lasted if before <= _TRANSITION else self._elapsed


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
