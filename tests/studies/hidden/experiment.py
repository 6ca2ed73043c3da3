"""Plan of a blind experiment: commands, order, sessions and start poses of the runs, without the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from omnibench.data.dataset import Split
from omnibench.robot.kinematics import Array, Robot, Wheel, inverse_kinematic_matrix

SAMPLE = 0.01  # s, of the wheels
POSE = 0.25  # s, between reference poses
RAMP = 0.3  # s, to the commanded speed and from it
LENGTH = 1.116  # m, of every run that is not a turn on the spot
TURN = 6.0  # s, of a turn on the spot
REPETITIONS = 5

ROBOT = Robot(
    name="APR-02",
    wheels=tuple(
        Wheel(name=name, radius=0.148, distance=0.195, angle=math.radians(angle))
        for name, angle in (("a", 60), ("b", 180), ("c", 300))
    ),
)


@dataclass(frozen=True)
class Command:
    """Speed (m/s), direction in the robot's frame (rad), rate of turn (rad/s). seconds: of a run, if not by LENGTH."""

    speed: float
    direction: float
    turn: float
    seconds: float | None = None

    @property
    def name(self) -> str:
        name = f"v{self.speed:g}_a{math.degrees(self.direction):.0f}_w{self.turn:g}"
        return name if self.seconds is None else f"{name}_t{self.seconds:g}"

    @property
    def twist(self) -> Array:
        """(vx, vy, w)."""
        return np.array([self.speed * math.cos(self.direction), self.speed * math.sin(self.direction), self.turn])

    @property
    def samples(self) -> int:
        """Wheel samples of a run: the ramps do not shorten the way."""
        if self.seconds is not None:
            return round(self.seconds / SAMPLE)
        return round((LENGTH / self.speed + RAMP if self.speed else TURN) / SAMPLE)


@dataclass(frozen=True, eq=False)
class Run:
    """One run to be driven. start (3,): m, m, rad; angles (N,): of the wheels at its start, rad."""

    split: Split
    session: str
    session_number: int
    started_at: float
    command: Command
    command_number: int
    repetition: int
    start: Array
    angles: Array

    @property
    def stamps(self) -> Array:
        """Stamps of the reference poses, the first at 0, the last at the end; s."""
        end = self.command.samples * SAMPLE
        between = POSE * np.arange(math.ceil(round(end / POSE, 9)))
        return np.append(between, end)


@dataclass(frozen=True)
class Design:
    """A plan of runs. sessions: into how many the training is divided; scattered: start poses differ between runs.

    noise: factor on the noise of the reference.
    """

    commands: tuple[Command, ...]
    sessions: int = 1
    scattered: bool = False
    noise: float = 1.0


def _flower() -> tuple[Command, ...]:
    directions = [math.radians(30 * step) for step in range(12)]
    return tuple(Command(0.2, direction, turn) for turn in (-0.35, 0.0, 0.35) for direction in directions)


def _rich() -> tuple[Command, ...]:
    """Two speeds, each with its own five directions, and turns on the spot."""
    driven = [
        Command(speed, math.radians(72 * step + first), turn)
        for speed, first in ((0.1, 0.0), (0.3, 36.0))
        for turn in (-0.35, 0.0, 0.35)
        for step in range(5)
    ]
    return (*driven, *(Command(0.0, 0.0, turn) for turn in (-0.9, -0.5, -0.25, 0.25, 0.5, 0.9)))


def _small() -> tuple[Command, ...]:
    """A third of the runs, for what repeats a discovery many times."""
    return tuple(
        Command(speed, angle, turn)
        for speed, first in ((0.1, 0.0), (0.3, 1.0))
        for turn in (-0.35, 0.35)
        for angle in (first, first + 2.1, first + 4.2)
    )


_ON_THE_SPOT = (Command(0.0, 0.0, -0.9), Command(0.0, 0.0, 0.5))
DESIGNS = {
    "flower": Design(_flower()),
    "rich": Design(_rich(), scattered=True),
    "small": Design(_small(), scattered=True),
    "small_sessions": Design((*_small(), *_ON_THE_SPOT), sessions=3, scattered=True),
    "sessions": Design(_rich(), sessions=3, scattered=True),
    "precise": Design(_rich(), scattered=True, noise=0.3),  # cameras instead of SLAM
}


def plan(design: Design, rng: np.random.Generator) -> tuple[Run, ...]:
    """The runs of the training, then those of the validation, each in the order in which they are driven."""
    training = _split(design, "train", design.sessions, 1, rng)
    return (*training, *_split(design, "validation", 1, design.sessions + 1, rng))


def _split(design: Design, split: Split, sessions: int, first: int, rng: np.random.Generator) -> list[Run]:
    wanted = [(number, repetition) for number in range(len(design.commands)) for repetition in range(REPETITIONS)]
    runs: list[Run] = []
    for session, part in enumerate(np.array_split(rng.permutation(len(wanted)), sessions), first):
        started_at, angles = 0.0, rng.uniform(-math.pi, math.pi, len(ROBOT.wheels))
        for index in part:
            number, repetition = wanted[index]
            command = design.commands[number]
            start = rng.uniform([-0.3, -0.3, -math.pi], [0.3, 0.3, math.pi]) if design.scattered else np.zeros(3)
            runs.append(
                Run(split, f"s{session}", session, started_at, command, number, repetition + 1, start, angles.copy())
            )
            started_at += command.samples * SAMPLE + rng.uniform(8, 15)
            angles += rng.uniform(-40, 40, len(angles))  # rad, on the way back to the start
    return runs


def true_matrix(rng: np.random.Generator) -> Array:
    """The matrix (3, N) of wheels that differ from their design by 1 to 3 % and a degree."""
    radius, distance = rng.uniform(0.01, 0.03, 2)
    wheels = tuple(
        wheel.model_copy(
            update={
                "radius": wheel.radius * (1 + radius * rng.standard_normal()),
                "distance": wheel.distance * (1 + distance * rng.standard_normal()),
                "angle": wheel.angle + math.radians(rng.standard_normal()),
            }
        )
        for wheel in ROBOT.wheels
    )
    return inverse_kinematic_matrix(wheels)
