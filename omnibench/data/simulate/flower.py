"""The flower benchmark: a robot of known truth drives every command, wheels and reference are recorded with noise."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from omnibench.config import Model
from omnibench.data.dataset import Dataset, Split, Trajectory, make_dataset
from omnibench.data.simulate.config import Commands, EncoderNoise, FlowerConfig, Session, Truth
from omnibench.robot.calibration import Row, matrix_rows
from omnibench.robot.kinematics import Array, Robot, inverse_kinematic_matrices, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, WheelLog
from omnibench.robot.published import published_matrix

_PAUSE = 10.0  # s between runs


class TruthRecord(Model):
    """What was hidden: goes to its own folder, which fitting and comparing never read."""

    dataset: str
    robot: Robot
    matrix: tuple[Row, Row, Row]
    integration: Integration
    noise: EncoderNoise


@dataclass(frozen=True)
class Simulation:
    """A simulated data set and, apart from it, the truth behind it."""

    dataset: Dataset
    truth: TruthRecord


@dataclass(frozen=True)
class Command:
    """A motion command: speed (m/s), direction (rad, robot's frame), rate of turn (rad/s)."""

    speed: float
    direction: float
    turn_rate: float

    @property
    def name(self) -> str:
        return f"v{self.speed:g}_a{math.degrees(self.direction):g}_w{self.turn_rate:g}"

    @property
    def twist(self) -> Array:
        """(vx, vy, w)."""
        x, y = self.speed * math.cos(self.direction), self.speed * math.sin(self.direction)
        return np.array([x, y, self.turn_rate])


def simulate_dataset(config: FlowerConfig, name: str = "flower", description: str = "") -> Simulation:
    """Simulate the training session and, if there is one, the validation session."""
    matrix = true_matrix(config.truth, config.robot)
    trajectories = list(_session(config, matrix, "train", config.train))
    if config.validation is not None:
        trajectories += _session(config, matrix, "validation", config.validation)
    dataset = make_dataset(
        name,
        config.robot,
        config.sample_period,
        trajectories,
        description=description,
        source="simulated by omnibench",
        simulated=True,
    )
    record = TruthRecord(
        dataset=name,
        robot=config.robot,
        matrix=matrix_rows(matrix),
        integration=config.integration,
        noise=config.noise,
    )
    return Simulation(dataset, record)


def true_matrix(truth: Truth, robot: Robot) -> Array:
    """The hidden inverse kinematic matrix (3, N)."""
    if truth.published is not None:
        return published_matrix(truth.published)
    if truth.matrix is not None:
        return np.array(truth.matrix)
    assert truth.tolerances is not None  # one of the three is given
    rng = np.random.default_rng(truth.tolerances.seed)
    draws = rng.standard_normal((3, len(robot.wheels)))
    wheels = robot.wheels
    radius = np.array([wheel.radius for wheel in wheels]) * (1 + truth.tolerances.radius * draws[0])
    distance = np.array([wheel.distance for wheel in wheels]) * (1 + truth.tolerances.distance * draws[1])
    angle = np.array([wheel.angle for wheel in wheels]) + math.radians(truth.tolerances.angle_deg) * draws[2]
    rollers = np.array([wheel.roller_angle for wheel in wheels])
    return inverse_kinematic_matrices(radius[None], distance[None], angle[None], rollers)[0]


def commands_of(config: FlowerConfig) -> list[Command]:
    """The commands of a config, in its order."""
    return grid_of(config.commands)


def grid_of(chosen: Commands) -> list[Command]:
    """Every direction with every rate of turn, at each speed; the direction of a turn on the spot is 0."""
    return [
        Command(speed, math.radians(direction), turn_rate)
        for speed, turn_rate in product(chosen.speeds, chosen.turn_rates)
        for direction in (chosen.directions_deg if speed > 0 else (0.0,))
        if speed or turn_rate
    ]


def _session(config: FlowerConfig, matrix: Array, split: Split, session: Session) -> Iterator[Trajectory]:
    rng = np.random.default_rng(session.seed)
    runs = [(command, repetition) for command in commands_of(config) for repetition in range(1, config.repetitions + 1)]
    if config.order == "shuffled":
        runs = [runs[index] for index in rng.permutation(len(runs))]
    model = OdometryModel(config.robot, matrix, config.integration)
    started_at, angles = 0.0, np.zeros(len(config.robot.wheels))
    for number, (command, repetition) in enumerate(runs, 1):
        run = _drive(config, model, command, session, rng, angles)
        yield Trajectory(
            id=f"{split}-{number:03d}",
            split=split,
            command=command.name,
            repetition=repetition,
            session=split,
            started_at=started_at,
            v=command.speed,
            alpha=command.direction,
            omega=command.turn_rate,
            duration=float(run.times[-1]),
            distance=command.speed * float(run.times[-1]),
            times=run.times,
            rates=run.rates,
            pose_times=run.pose_times,
            poses=run.poses,
            angles=run.angles,
            targets=run.targets,
        )
        started_at += float(run.times[-1]) + _PAUSE
        angles = run.angles[-1]


@dataclass(frozen=True)
class _Run:
    times: Array
    rates: Array
    angles: Array
    targets: Array
    pose_times: Array
    poses: Array


def _drive(
    config: FlowerConfig,
    model: OdometryModel,
    command: Command,
    session: Session,
    rng: np.random.Generator,
    angles: Array,
) -> _Run:
    """One run: the robot's own matrix turns the command into wheel rates, its true one into motion."""
    duration = session.distance / command.speed if command.speed else config.commands.turn_duration
    times, pose_times = stamps_of_run(duration, config.sample_period, config.pose_period)
    targets = np.tile(wheel_equations(config.robot.wheels) @ command.twist, (len(times), 1))
    rates = targets + config.noise.encoder * rng.standard_normal(targets.shape)
    (poses,) = model.poses([WheelLog(times, targets, np.zeros(3), pose_times)])
    return _Run(
        times=times,
        rates=rates,
        angles=angles + np.cumsum(rates * config.sample_period, axis=0),
        targets=targets,
        pose_times=pose_times,
        poses=poses + session.noise_scale * _reference_noise(config.noise, pose_times, rng),
    )


def stamps_of_run(duration: float, sample_period: float, pose_period: float) -> tuple[Array, Array]:
    """Ends of the wheel samples (F,) and stamps of the reference poses (K,), the first at 0, the last at the end; s."""
    samples = max(1, round(duration / sample_period))
    times: Array = sample_period * np.arange(1, samples + 1)
    between = pose_period * np.arange(1, math.ceil(times[-1] / pose_period))
    return times, np.concatenate([[0.0], between[between < times[-1] - 1e-9], times[-1:]])


def _reference_noise(noise: EncoderNoise, times: Array, rng: np.random.Generator) -> Array:
    """Noise (K, 3) of the reference poses in m, m, rad; none at t = 0, where the start pose is exact."""
    white = np.array([noise.pose_position, noise.pose_position, noise.pose_heading])
    walk = np.array([noise.walk_position, noise.walk_position, noise.walk_heading])
    bias = np.array([noise.bias_position, noise.bias_position, noise.bias_heading])
    steps = np.sqrt(np.diff(times))[:, None] * rng.standard_normal((len(times) - 1, 3))
    after_start = (
        bias * rng.standard_normal(3)
        + walk * np.cumsum(steps, axis=0)
        + white * rng.standard_normal((len(times) - 1, 3))
    )
    return np.vstack([np.zeros(3), after_start])
