"""Configuration of the robot simulator: every link of the chain from motion command to SLAM."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, FiniteFloat, field_validator, model_validator

from omnibench.config import Model, Positive
from omnibench.simulate.chain.floor_plan import RoomPlan
from omnibench.simulate.chain.lidar import Lidar
from omnibench.simulate.chain.motion_commands import CommandLink, MotionProfile
from omnibench.simulate.chain.motors import TRUE_STEP, Controller, Encoder, Motor
from omnibench.simulate.chain.steering import Steering
from omnibench.simulate.config import Experiment, RobotSession
from omnibench.slam.slam_options import SlamOptions

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
        chosen, profile = self.commands, self.profile
        sessions = self.sessions.values()
        seconds = 0.0
        for speed in chosen.speeds:
            directions = len(chosen.directions(self.robot)) if speed else 1
            for turn_rate in chosen.turn_rates:
                ramps = 2 * max(speed / profile.acceleration, abs(turn_rate) / profile.turn_acceleration)
                if profile.shape == "jerk_limited":
                    ramps += 4 * max(math.sqrt(speed / profile.jerk), math.sqrt(abs(turn_rate) / profile.turn_jerk))
                driven = sum(session.distance / speed if speed else chosen.turn_duration for session in sessions)
                seconds += directions * (driven + len(sessions) * (ramps + self.settle))
        if not self.robot.drive.direct:  # half a turn of the steering, at most, before each run
            seconds += len(self.driven) * len(sessions) * 180 / self.steering.rate_deg
        return seconds * self.repetitions * len(self.robot.wheels) / TRUE_STEP
