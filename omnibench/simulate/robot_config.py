"""Configuration of the robot simulator: every link of the chain from motion command to SLAM.

Steering of wheels: motors that turn them to their angles at a limited rate, and encoders that measure these.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from pydantic import Field, FiniteFloat, field_validator, model_validator

from omnibench.config import Model, Positive
from omnibench.robot.kinematics import Array, Robot, class_of
from omnibench.simulate.config import Experiment, RobotSession
from omnibench.simulate.floor_plan import RoomPlan
from omnibench.simulate.lidar import Lidar
from omnibench.simulate.motion_commands import CommandLink, MotionProfile
from omnibench.simulate.motors import TRUE_STEP, Controller, Encoder, Motor
from omnibench.slam.slam_options import SlamOptions


class Steering(Model):
    """The drives of steering angles. Each turns its wheel to the commanded angle at a constant rate, and holds it."""

    rate_deg: Positive = Field(180.0, description="of a steering motor, degrees/s")
    ticks: int = Field(8192, gt=0, le=10**9, description="of the absolute encoder, per turn of the steering angle")
    noise_deg: float = Field(0.05, ge=0, le=45, description="white noise of the measured angle, degrees")
    waits: bool | None = Field(
        None,
        description="the wheels drive once they are steered; default: true for several driven steered wheels, which "
        "would push against each other, else false",
    )

    def rest(self, robot: Robot, before: Array, targets: Array, sample_period: float) -> int:
        """Samples for which a robot stands until its steering has gone from angles to targets (S,), rad."""
        waits = class_of(robot) == "swerve" if self.waits is None else self.waits
        if not waits:
            return 0
        seconds = np.abs(targets - before).max(initial=0.0) / math.radians(self.rate_deg)
        return math.ceil(seconds / sample_period - 1e-9)

    def angles(self, before: Array, targets: Array, steps: int) -> Array:
        """True angles (steps + 1, S), rad, every millisecond, from those before a run to its targets (S,)."""
        reach = math.radians(self.rate_deg) * TRUE_STEP * np.arange(steps + 1)[:, None]
        turned: Array = before + np.clip(targets - before, -reach, reach)
        return turned

    def measured(self, angles: Array, rng: np.random.Generator) -> Array:
        """Measured angles (F, S) of true ones (F, S), rad: with noise, and in whole ticks."""
        tick = 2 * math.pi / self.ticks
        noisy = angles + math.radians(self.noise_deg) * rng.standard_normal(angles.shape)
        return tick * np.round(noisy / tick)


_MOST_ANGLES = 1e8  # true wheel angles of all runs; more do not fit into memory


class Placement(Model):
    """Standard deviations with which the robot is put back on its mark before each run."""

    position: float = Field(0.02, ge=0, le=1, description="m, in x and y")
    heading_deg: float = Field(2.0, ge=0, le=180, description="degrees")


class RobotConfig(Experiment[RobotSession]):
    """A simulated robot: commands, motors under PID, encoders, true motion, LIDAR in a room, SLAM."""

    generator: Literal["robot"]
    sample_period: Positive = Field(0.01, description="of PID controllers and encoders, s")
    profile: MotionProfile = MotionProfile()
    link: CommandLink = CommandLink()
    settle: float = Field(0.6, ge=0, le=60, description="rest that is recorded after the motion, s")
    motor: Motor = Motor()
    controller: Controller = Controller()
    encoder: Encoder = Encoder()
    steering: Steering = Field(Steering(), description="of robots that steer")
    room: RoomPlan
    radius: Positive = Field(0.25, description="of the robot, to check for collisions, m")
    placement: Placement = Placement()
    lidar: Lidar = Lidar()
    slam: SlamOptions = SlamOptions()

    @field_validator("sample_period")
    @classmethod
    def _whole_milliseconds(cls, period: FiniteFloat) -> FiniteFloat:
        steps = period / TRUE_STEP
        if abs(steps - round(steps)) > 1e-6 or not 1 <= round(steps) <= 100:
            raise ValueError("must be a whole number of milliseconds, 0.001 to 0.1 s")
        return period

    @model_validator(mode="after")
    def _can_be_driven(self) -> RobotConfig:
        coarse, fastest = self.encoder.tick / self.sample_period, self.motor.fastest_rate
        if coarse > fastest / 2:
            raise ValueError(
                f"encoder.ticks: one tick a sample is {coarse:.3g} rad/s, and the motor's fastest rate {fastest:.3g} "
                "rad/s, so that it cannot be controlled; give it more ticks a turn"
            )
        if self._angles() > _MOST_ANGLES:
            raise ValueError(
                f"this is {self._angles():.1g} milliseconds of wheels, more than {_MOST_ANGLES:.0e}; check the "
                "distances (m), speeds (m/s), accelerations, settle and repetitions"
            )
        return self

    def _angles(self) -> float:
        """Approximate number of true wheel angles that are simulated."""
        sessions, seconds = self.sessions.values(), 0.0
        for command in self.driven:
            limits = self.profile.limits(command)
            rest = 2 / limits.slope + 4 / math.sqrt(limits.jerk) + self.settle
            if not self.robot.drive.direct:  # half a turn of the steering, at most, before each run
                rest += 180 / self.steering.rate_deg
            for session in sessions:
                seconds += rest + (session.distance / command.speed if command.speed else self.commands.turn_duration)
        return seconds * self.repetitions * len(self.robot.wheels) / TRUE_STEP
