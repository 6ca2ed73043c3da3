"""Candidate runs from a robot alone: lines, arcs and turns on the spot that it can drive in an area."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field, model_validator

from omnibench.config import Model, Positive, validate
from omnibench.data.importers.recording_options import RobotOption
from omnibench.design.candidates import CandidatePool, checked_pool, driven_as_designed, refuse_choice
from omnibench.errors import ConfigError
from omnibench.robot.calibration import Noise
from omnibench.robot.odometry import Integration
from omnibench.simulate.commands import Command, default_directions, steering_limit, wheels_of
from omnibench.simulate.drivable_commands import LONGEST, SHORTEST, DrivableCommands, Shapes
from omnibench.words import plural

# What follows offers shapes of runs; more of them change a design little, because it is a choice of few (chosen).
_SHAPES = Shapes(lines=(0.5, 1.0), radii=(0.1, 0.2, 0.4, 0.8), turns=(45.0, 90.0, 180.0, 360.0), spins=(360.0, 1080.0))
_MOST = {
    "steering_limit": 180.0,
    "position_noise": 10.0,
    "heading_noise": 90.0,
}  # deg, m, deg: more is a slip of the pen
_SET = "robot"  # name of the candidates' set
_SAMPLE_PERIOD, _POSE_PERIOD = 0.05, 0.25  # s; commands are constant, so that longer samples tell the same
# White noise of a motion capture or of scan matching, and per sqrt(s) what a floor and slip add: the order of magnitude
# of the recordings that omnibench was tried on, 3 to 9 mm.
ASSUMED_NOISE = Noise(pose_position=0.005, pose_heading=0.005, walk_position=0.003, walk_heading=0.003)


def parse_area(text: str) -> tuple[float, float]:
    """The sides, m, of an area like ``3x2.5``. ConfigError: it is none."""
    match = re.fullmatch(r"\s*([0-9.]+)\s*[xX×]\s*([0-9.]+)\s*m?\s*", text)
    try:
        sides = (float(match[1]), float(match[2])) if match else (0.0, 0.0)
    except ValueError:
        sides = (0.0, 0.0)
    if min(sides) <= 0 or not math.isfinite(max(sides)):
        raise ConfigError(f"--area {text}: give two sides in m, like --area 3x2.5")
    return sides


@dataclass(frozen=True)
class RobotOptions:
    """Options of ``omnibench design --robot``, named as on the command line; None: not given."""

    max_speed: float | None = None
    max_turn_rate: float | None = None
    max_wheel_rate: float | None = None
    steering_limit: float | None = None
    area: str | None = None
    position_noise: float | None = None
    heading_noise: float | None = None


def design_source(
    source: Path | None,
    robot: Path | None,
    options: RobotOptions,
    *,
    dataset: str | None = None,
    integration: Integration | None = None,
) -> Path | CandidatePool:
    """What to design from: a data set or config, or the candidates of a robot's file.

    dataset, integration: see ``read_candidates``. ConfigError in one line: both or neither are given, options that go
    with the other, or a value that cannot be.
    """
    given = {name: value for name, value in vars(options).items() if value is not None}
    if robot is None:
        for name in given:
            raise ConfigError(f"--{name.replace('_', '-')}: is for --robot FILE, a design without a recording")
        if source is None:
            raise ConfigError("name a DATASET or a CONFIG, or a robot's file with --robot FILE")
        return source
    if source is not None:
        raise ConfigError(f"--robot {robot}: designs without {source}; give one of them")
    refuse_choice(dataset, robot)
    for name, value in given.items():
        if name != "area" and not 0 < value < _MOST.get(name, math.inf):
            below = f" and below {_MOST[name]:g}" if name in _MOST else ""
            raise ConfigError(f"--{name.replace('_', '-')} {value:g}: must be above 0{below}")
    noise = ASSUMED_NOISE.model_dump()
    noise["pose_position"] = given.pop("position_noise", noise["pose_position"])
    noise["pose_heading"] = math.radians(given.pop("heading_noise", math.degrees(noise["pose_heading"])))
    if "area" in given:
        given["area"] = parse_area(given["area"])
    if "steering_limit" in given:
        given["steering_limit_deg"] = given.pop("steering_limit")
    content = {"robot": str(robot), "noise": noise, **given}
    return validate(RobotCommands, content, f"design --robot {robot}").pool(str(robot), integration or "arc")


class RobotCommands(Model):
    """A robot without recordings, and what it may drive.

    Without ``max_wheel_rate`` no wheel turns faster than it does straight on at ``max_speed``.
    """

    robot: RobotOption
    max_speed: Positive = Field(0.5, description="m/s")
    max_turn_rate: Positive = Field(1.0, description="rad/s")
    max_wheel_rate: Positive | None = Field(None, description="rad/s")
    area: tuple[Positive, Positive] = Field((3.0, 3.0), description="free floor, m")
    steering_limit_deg: float | None = Field(None, gt=0, le=180, description="degrees; default: by the type of robot")
    noise: Noise = ASSUMED_NOISE

    @model_validator(mode="after")
    def _can_be_driven(self) -> RobotCommands:
        if self.steering_limit_deg is not None and self.robot.drive.direct:
            raise ValueError("--steering-limit: no wheel of this robot steers; leave it out")
        fastest = self.max_speed * self._wheel_rate / min(self._straight_rates)
        if fastest < (1 - 1e-9) * self.max_speed:
            raise ValueError(
                f"--max-speed {self.max_speed:g}: at --max-wheel-rate {self._wheel_rate:g} rad/s the wheels drive at "
                f"most {math.floor(1000 * fastest) / 1000:g} m/s; give no more, or raise the wheels' rate"
            )
        if min(self._free) < 2 * SHORTEST:
            need = 2 * (self._half_width + SHORTEST)
            raise ValueError(
                f"--area {self.area[0]:g}x{self.area[1]:g}: the robot alone takes {2 * self._half_width:.2g} m; give "
                f"both sides at least {math.ceil(10 * need) / 10:g} m"
            )
        return self

    def pool(self, source: str, integration: Integration = "arc") -> CandidatePool:
        """The candidates of a design, each of which the baseline drives once.

        source: for messages. ConfigError: the commands leave part of the matrix undetermined.
        """
        commands, robot = tuple(dict.fromkeys(self.commands())), self.robot
        if not any(timed.command.turn_rate for timed in commands):
            raise ConfigError(
                f"{source}: no curve that it can drive within {LONGEST:g} s fits an area of {self.area[0]:g} x "
                f"{self.area[1]:g} m; give a larger --area, or a greater --steering-limit or --max-speed"
            )
        _, candidates = driven_as_designed(robot, integration, (_SAMPLE_PERIOD, _POSE_PERIOD), {_SET: commands})
        noise = self.noise
        return checked_pool(
            CandidatePool(
                source=source,
                name=robot.name or "robot",
                description="What to drive before anything was recorded.",
                robot=robot,
                integration=integration,
                candidates=candidates,
                sets={_SET: tuple(range(len(candidates)))},
                baseline=np.ones(len(candidates), dtype=np.intp),
                baseline_name=f"all {plural(len(candidates), 'command')} once",
                noise=noise,
                noise_source=(
                    f"assumed: {1000 * noise.pose_position:.3g} mm and {math.degrees(noise.pose_heading):.2g} deg of "
                    f"each reference pose, {1000 * noise.walk_position:.3g} mm and "
                    f"{math.degrees(noise.walk_heading):.2g} deg per √s of floor and slip"
                ),
                simulated=True,
                recorded=False,
                notes=(
                    self._limits,
                    "Left is counter-clockwise as seen from above, backward too. Begin where a run stays on the floor.",
                ),
            )
        )

    def commands(self) -> DrivableCommands:
        """Lines, arcs to both sides and turns on the spot, each as fast as the limits allow."""
        return DrivableCommands(
            self.robot,
            self.max_speed,
            self.max_turn_rate,
            self._wheel_rate,
            self._steering_limit,
            self._free,
            _SHAPES,
        )

    @property
    def _straight_rates(self) -> list[float]:
        """Largest wheel rates, rad/s, straight on at the greatest speed, in each direction that the robot drives."""
        twists = [Command(self.max_speed, math.radians(each), 0.0).twist for each in default_directions(self.robot)]
        return [float(np.abs(wheels_of(self.robot, twist)[0]).max()) for twist in twists]

    @property
    def _wheel_rate(self) -> float:
        return self.max_wheel_rate or max(self._straight_rates)

    @property
    def _steering_limit(self) -> float:
        return steering_limit(self.robot, self.steering_limit_deg)

    @property
    def _half_width(self) -> float:
        """The farthest that a wheel reaches from the centre, m."""
        return max(math.hypot(*wheel.position) + wheel.radius for wheel in self.robot.wheels)

    @property
    def _free(self) -> tuple[float, float]:
        """Sides, m, of the area that the robot's centre may be in."""
        wide, deep = (side - 2 * self._half_width for side in self.area)
        return wide, deep

    @property
    def _limits(self) -> str:
        """The limits in words."""
        words = [f"{self.max_speed:g} m/s", f"{self.max_turn_rate:g} rad/s", f"wheels {self._wheel_rate:.3g} rad/s"]
        if not self.robot.drive.direct:
            words.append(f"steering angles {math.degrees(self._steering_limit):g} deg")
        return (
            f"Commands were made for at most {', '.join(words)}, and a free floor of {self.area[0]:g} x "
            f"{self.area[1]:g} m, of which the robot's wheels need {self._half_width:.2g} m about its centre."
        )
