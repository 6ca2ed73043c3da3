"""The flower experiment: a robot of known truth drives every command; wheels and reference are recorded with noise."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np

from omnibench.data.dataset import Split, Trajectory, make_dataset
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.simulate.commands import STEADY, Command, TimedCommand, Variation, straight_and_pivot, wheels_of
from omnibench.simulate.config import FlowerConfig, Session
from omnibench.simulate.truth import Simulation, TrueRobot, reference_noise, true_record
from omnibench.words import plural

_MANY = 1000  # runs whose checks and tables take more than about a second; chosen
PAUSE = 10.0  # s between runs
C = TypeVar("C")


def simulate_flower(
    config: FlowerConfig, name: str = "flower", description: str = "", watch: Reporter = no_progress
) -> Simulation:
    """Simulate the training session and, if there is one, the validation session. watch: told of every run.

    ConfigError or DataError in one line: an effect of the truth, or a parameter of one, is not known or is missing.
    """
    truth = true_record(
        config.truth,
        config.robot,
        config.sample_period,
        tuple(config.sessions),
        name,
        integration=config.integration,
        noise=config.noise,
        variation=config.commands.variation,
    )
    robot = truth.true_robot()
    trajectories: list[Trajectory] = []
    for split, session in config.sessions.items():
        for run in _session(config, robot, split, session):
            trajectories.append(run)
            watch(Progress(f"simulating {name}", len(trajectories), config.runs, "run"))
    watch(Progress(f"simulating {name}", len(trajectories), result=""))
    if len(trajectories) > _MANY:
        watch(Progress(f"checking and writing {plural(len(trajectories), 'run')}"))
    dataset = make_dataset(
        name,
        config.robot,
        config.sample_period,
        trajectories,
        description=description,
        source="simulated by omnibench",
        simulated=True,
    )
    return Simulation(replace(dataset, warnings=(*dataset.warnings, *config.left_out)), truth)


def runs_of(
    commands: Sequence[tuple[C, int]], order: Literal["shuffled", "sorted"], rng: np.random.Generator
) -> list[tuple[C, int]]:
    """Every command, given with its repetitions, with the number of each, in the order in which they are driven."""
    runs = [(command, repetition) for command, count in commands for repetition in range(1, count + 1)]
    return [runs[index] for index in rng.permutation(len(runs))] if order == "shuffled" else runs


@dataclass(frozen=True)
class PlannedCommand:
    """A command of a session. heading: at the start, rad; None: as for all runs."""

    name: str
    timed: TimedCommand
    repetitions: int
    heading: float | None = None


def planned_commands(config: FlowerConfig, session: Session) -> list[PlannedCommand]:
    """The commands within the steering limit; ramps lengthen the runs of a grid, so that their length in m stays."""
    chosen, driven = config.commands, config.driven
    if not chosen.listed:
        seconds = [session.distance / each.speed if each.speed else chosen.turn_duration for each in driven]
        return [
            PlannedCommand(
                each.name, TimedCommand(each, driving + chosen.ramp, chosen.ramp, chosen.variation), config.repetitions
            )
            for each, driving in zip(driven, seconds, strict=True)
        ]
    planned = []
    lengths: dict[Command, set[float]] = {}
    for listed in chosen.listed:
        lengths.setdefault(listed.command(config.robot), set()).add(listed.duration)
    for listed in chosen.listed:
        command = listed.command(config.robot)
        name = command.name if len(lengths[command]) == 1 else f"{command.name}_t{listed.duration:g}"
        heading = None
        if listed.heading_deg is not None:
            name, heading = f"{name}_h{listed.heading_deg:g}", math.radians(listed.heading_deg)
        if command in driven:
            timed = TimedCommand(command, listed.duration, chosen.ramp, chosen.variation)
            planned.append(PlannedCommand(name, timed, listed.repetitions, heading))
    return planned


def commanded_rates(robot: Robot, command: Command, times: Array, ramp: float, variation: Variation = STEADY) -> Array:
    """Mean wheel rates (F, N) by the design values, rad/s, in samples that end at times (F,), s.

    ramp: time in which the rates rise and fall linearly, s.
    """
    rates: Array
    if variation.is_none:
        rates = np.tile(wheels_of(robot, command.twist)[0], (len(times), 1))
    else:
        rates, _ = variation.wheels(robot, command, times, ends=False)
    return rates if not ramp else rates * _mean_shares(times, ramp)[:, None]


def commanded_steering(robot: Robot, command: Command, times: Array, variation: Variation = STEADY) -> Array | None:
    """Steering angles (F, S) by the design values at times (F,), rad, s; None for robots without any."""
    if robot.drive.direct:
        return None
    if variation.is_none:
        return np.tile(wheels_of(robot, command.twist)[1], (len(times), 1))
    return variation.wheels(robot, command, times, ends=True)[1]


def true_steering(robot: Robot, run: Trajectory, variation: Variation = STEADY) -> Array | None:
    """Steering angles (F, S), rad, that exact encoders measure in a simulated run; None for robots without any."""
    chosen = straight_and_pivot(robot)
    pivot = (0.0, 0.0) if chosen is None else chosen[1]
    command = Command(run.v or 0.0, run.alpha or 0.0, run.omega or 0.0, pivot)
    return commanded_steering(robot, command, run.times, variation)


def _mean_shares(times: Array, ramp: float) -> Array:
    """Mean speed (F,) in each sample as a share of the full speed, from rest to rest."""
    ends = np.append(0.0, times)
    ramp = min(ramp, times[-1] / 2)
    rising, falling = np.minimum(ends, ramp), np.maximum(ends - (times[-1] - ramp), 0.0)
    driven = rising**2 / (2 * ramp) + (ends - rising) - falling**2 / (2 * ramp)  # s at full speed
    return np.diff(driven) / np.diff(ends)


def _session(config: FlowerConfig, robot: TrueRobot, split: Split, session: Session) -> Iterator[Trajectory]:
    """The runs: targets and steering by the design values, wheel rates by the motors, motion by the true robot.

    Encoders are exact between runs, so that recorded and true wheel angles do not drift apart: the angles (N,) at a
    run's end are those at which the next one begins.
    """
    rng = np.random.default_rng(session.seed)
    commands = [(each, each.repetitions) for each in planned_commands(config, session)]
    runs = runs_of(commands, config.order, rng)
    half, started_at = config.start_area / 2, 0.0
    before: Array = np.zeros(len(config.robot.wheel_names))
    for number, (planned, repetition) in enumerate(runs, 1):
        timed = planned.timed
        command, ramp, variation = timed.command, timed.ramp, timed.variation
        times, pose_times = stamps_of_run(timed.duration, config.sample_period, config.pose_period)
        targets = commanded_rates(config.robot, command, times, ramp, variation)
        start = np.zeros(3) if config.start == "fixed" else rng.uniform((-half, -half, -math.pi), (half, half, math.pi))
        start = start if planned.heading is None else np.append(start[:2], planned.heading)
        driven, steering = robot.driven(times, targets), commanded_steering(config.robot, command, times, variation)
        log = robot.log(times, driven, start, pose_times, before, started_at, split, steering)
        rates = log.rates + config.noise.encoder * rng.standard_normal(targets.shape)
        if steering is not None:
            steering = steering + config.noise.steering * rng.standard_normal(steering.shape)
        poses = robot.reported(log)
        angles = before + np.cumsum(rates * config.sample_period, axis=0)
        yield Trajectory(
            id=f"{split}-{number:03d}",
            split=split,
            command=planned.name,
            repetition=repetition,
            session=split,
            started_at=started_at,
            v=command.speed,
            alpha=command.direction,
            omega=command.turn_rate,
            duration=float(times[-1]),
            distance=command.speed * (float(times[-1]) - ramp),
            times=times,
            rates=rates,
            pose_times=pose_times,
            poses=poses + session.noise_scale * reference_noise(config.noise, pose_times, rng),
            angles=angles,
            targets=targets,
            steering=steering,
        )
        started_at, before = started_at + (float(times[-1]) + PAUSE), angles[-1]


def stamps_of_run(duration: float, sample_period: float, pose_period: float) -> tuple[Array, Array]:
    """Ends of the wheel samples (F,) and stamps of the reference poses (K,), the first at 0, the last at the end; s."""
    samples = max(1, round(duration / sample_period))
    times: Array = sample_period * np.arange(1, samples + 1)
    between = pose_period * np.arange(1, math.ceil(times[-1] / pose_period))
    return times, np.concatenate([[0.0], between[between < times[-1] - 1e-9], times[-1:]])


def run_as_designed(model: OdometryModel, timed: TimedCommand, periods: tuple[float, float], name: str) -> Trajectory:
    """The run of a command with wheel rates by the design values, and poses by a model, from the origin on.

    periods: of the wheel samples and of the reference poses, s.
    """
    robot, command = model.robot, timed.command
    times, pose_times = stamps_of_run(timed.duration, *periods)
    still = Trajectory(
        name,
        "train",
        times,
        commanded_rates(robot, command, times, timed.ramp, timed.variation),
        pose_times,
        np.zeros((len(pose_times), 3)),
        steering=commanded_steering(robot, command, times, timed.variation),
        drive=None if robot.drive.direct else robot.drive,
    )
    (poses,) = model.poses([still.log(pose_times)])
    return replace(
        still,
        poses=poses,
        command=name,
        v=command.speed,
        alpha=command.direction,
        omega=command.turn_rate,
        duration=float(times[-1]),
        distance=command.speed * (float(times[-1]) - timed.ramp),
    )
