"""Simulated recordings of a robot of known truth: the flower, with noise of encoders and reference, and the robot link
by link, from motion commands over motors, encoders, true motion and LIDAR scans to poses by SLAM.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np

from omnibench.data.dataset import Split, Trajectory, make_dataset
from omnibench.data.scans import ScansInMemory, TrajectoryScans
from omnibench.data.true_poses import TruePath
from omnibench.errors import DataError
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.robot.kinematics import Array, Mount, Robot, compose, placed, seen_from
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import PathBatch, RunSamples, WheelLog
from omnibench.simulate.commands import STEADY, Command, TimedCommand, Variation, straight_and_pivot, wheels_of
from omnibench.simulate.config import FlowerConfig, RobotConfig, RobotSession, Session
from omnibench.simulate.floor_plan import FloorPlan, make_plan
from omnibench.simulate.lidar import measure_scans, scan_stamps
from omnibench.simulate.motion_commands import CommandedMotion, command_motion, target_rates
from omnibench.simulate.motors import TRUE_STEP, DrivenRun, check_reach, drive_session
from omnibench.simulate.truth import Simulation, TrueRobot, reference_noise, true_record
from omnibench.slam.slam_dataset import slam_dataset
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
    truth = true_record(config, name)
    robot = truth.true_robot()
    trajectories: list[Trajectory] = []
    for split, session in config.sessions.items():
        for run in flower_session(config, robot, split, session):
            trajectories.append(run)
            watch(Progress(f"simulating {name}", len(trajectories), config.runs, "run"))
    watch(Progress(f"simulating {name}", len(trajectories), result=""))
    if len(trajectories) > _MANY:
        watch(Progress(f"checking and writing {plural(len(trajectories), 'run')}"))
    source = "simulated by omnibench"
    dataset = make_dataset(
        name, config.robot, config.sample_period, trajectories, description=description, source=source, simulated=True
    )
    return Simulation(replace(dataset, warnings=(*dataset.warnings, *config.left_out)), truth)


def runs_of(
    commands: Sequence[tuple[C, int]], order: Literal["shuffled", "sorted"], rng: np.random.Generator
) -> list[tuple[C, int]]:
    """Every command, given with its repetitions, with the number of each, in the order in which they are driven."""
    runs = [(command, repetition) for command, count in commands for repetition in range(1, count + 1)]
    return [runs[index] for index in rng.permutation(len(runs))] if order == "shuffled" else runs


def commanded_rates(robot: Robot, command: Command, times: Array, ramp: float, variation: Variation = STEADY) -> Array:
    """Mean wheel rates (F, N) by the design values, rad/s, in samples that end at times (F,), s.

    ramp: time in which the rates rise and fall linearly, s.
    """
    rates, _ = variation.wheels(robot, command, times, ends=False)
    if not ramp:
        return rates
    # Mean speed (F,) in each sample as a share of the full speed, from rest to rest.
    ends = np.append(0.0, times)
    ramp = min(ramp, times[-1] / 2)
    rising, falling = np.minimum(ends, ramp), np.maximum(ends - (times[-1] - ramp), 0.0)
    driven = rising**2 / (2 * ramp) + (ends - rising) - falling**2 / (2 * ramp)  # s at full speed
    return rates * (np.diff(driven) / np.diff(ends))[:, None]


def commanded_steering(robot: Robot, command: Command, times: Array, variation: Variation = STEADY) -> Array | None:
    """Steering angles (F, S) by the design values at times (F,), rad, s; None for robots without any."""
    return None if robot.drive.direct else variation.wheels(robot, command, times, ends=True)[1]


def true_steering(robot: Robot, run: Trajectory, variation: Variation = STEADY) -> Array | None:
    """Steering angles (F, S), rad, that exact encoders measure in a simulated run; None for robots without any."""
    _, pivot = straight_and_pivot(robot)
    command = Command(run.v or 0.0, run.alpha or 0.0, run.omega or 0.0, pivot)
    return commanded_steering(robot, command, run.times, variation)


def flower_session(config: FlowerConfig, robot: TrueRobot, split: Split, session: Session) -> Iterator[Trajectory]:
    """The runs: targets and steering by the design values, wheel rates by the motors, motion by the true robot.

    Encoders are exact between runs, so that recorded and true wheel angles do not drift apart: the angles (N,) at a
    run's end are those at which the next one begins.
    """
    rng = np.random.default_rng(session.seed)
    runs = runs_of([(planned, planned.repetitions) for planned in config.planned(session)], config.order, rng)
    half, started_at = config.start_area / 2, 0.0
    before: Array = np.zeros(len(config.robot.wheel_names))
    for number, (planned, repetition) in enumerate(runs, 1):
        timed = planned.timed
        times, pose_times = stamps_of_run(timed.duration, config.sample_period, config.pose_period)
        targets = commanded_rates(config.robot, timed.command, times, timed.ramp, timed.variation)
        steering = commanded_steering(config.robot, timed.command, times, timed.variation)
        start = np.zeros(3) if config.start == "fixed" else rng.uniform((-half, -half, -math.pi), (half, half, math.pi))
        start = start if planned.heading is None else np.append(start[:2], planned.heading)
        driven = robot.driven(times, targets)
        log = robot.log(times, driven, start, pose_times, before, started_at, split, steering)
        rates = log.rates + config.noise.encoder * rng.standard_normal(targets.shape)
        if steering is not None:
            steering = steering + config.noise.steering * rng.standard_normal(steering.shape)
        noise = session.noise_scale * reference_noise(config.noise, pose_times, rng)
        angles = before + np.cumsum(rates * config.sample_period, axis=0)
        run = Trajectory(
            f"{split}-{number:03d}",
            split,
            times,
            rates,
            pose_times,
            robot.reported(log) + noise,
            repetition=repetition,
            session=split,
            started_at=started_at,
            angles=angles,
            targets=targets,
            steering=steering,
        )
        yield _commanded(run, timed.command, _way(timed, times), planned.name)
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
    rates = commanded_rates(robot, command, times, timed.ramp, timed.variation)
    steering = commanded_steering(robot, command, times, timed.variation)
    drive = None if robot.drive.direct else robot.drive
    (poses,) = model.poses([WheelLog(times, rates, np.zeros(3), pose_times, steering=steering, drive=drive)])
    run = Trajectory(name, "train", times, rates, pose_times, poses, steering=steering, drive=drive)
    return _commanded(run, command, _way(timed, times), name)


def _way(timed: TimedCommand, times: Array) -> float:
    """Length of a run, m: ramps take their own length at half the speed."""
    return timed.command.speed * (float(times[-1]) - timed.ramp)


def _commanded(run: Trajectory, command: Command, distance: float, name: str) -> Trajectory:
    """The run with what was commanded: the command and its name, its length in m, and its duration."""
    speed, direction, turn_rate = command.speed, command.direction, command.turn_rate
    duration = float(run.times[-1])
    return replace(run, command=name, v=speed, alpha=direction, omega=turn_rate, duration=duration, distance=distance)


_FOLLOWED = 0.1  # relative difference of wheel angle from target above which a warning is given (chosen)
_STEP = 0.05  # m between the points of a path that are checked before the simulation
_DENSE = 0.01  # s, at most, between true poses that are kept


def simulate_robot(
    config: RobotConfig, name: str = "robot", description: str = "", watch: Reporter = no_progress
) -> Simulation:
    """Simulate the training session and, if there is one, the validation session.

    ConfigError or DataError in one line: an effect of the truth is unknown or lacks a parameter, a polygon of the room
    is invalid, a command is faster than the motors, or leads out of the room.
    """
    plan = make_plan(config.room, f"data set {name}: room")
    commands, sessions, mount = config.driven, config.sessions, config.robot.mount
    check_reach(config.robot, commands, config.motor)
    # Commands that lead the robot, as designed, out of the room.
    for command in commands:
        twist = command.twist if mount is None else mount.twist @ command.twist
        for session in sessions.values() if command.speed else ():
            times = np.linspace(0.0, session.distance / command.speed, max(2, math.ceil(session.distance / _STEP)))
            path = PathBatch(RunSamples.of([times[-1:]]), plan.start[None], times[-1] * twist[None], "arc")
            plan.check_path(_places(path.poses([times])[0], mount), times, config.radius, f"command {command.name}")
    truth = true_record(config, name)
    robot = truth.true_robot(TRUE_STEP)
    runs: list[_Recorded] = []
    total = len(sessions) * len(commands) * config.repetitions
    watch(Progress("driving and scanning", 0, total, "run"))
    for split, session in sessions.items():
        for run in _robot_session(config, robot, plan, split, session):
            runs.append(run)
            watch(Progress("driving and scanning", len(runs), total, "run"))
    recorded = make_dataset(
        name,
        config.robot,
        config.sample_period,
        [run.trajectory for run in runs],
        description=description,
        source="simulated by omnibench from command to SLAM",
        simulated=True,
        scans=ScansInMemory(config.lidar.scanner, {run.trajectory.id: run.scans for run in runs}),
    )
    dataset = slam_dataset(recorded, config.slam, watch=watch)
    dataset = replace(dataset, warnings=(*dataset.warnings, *config.left_out, *_warnings(runs)))
    paths = {run.trajectory.id: run.path for run in runs}
    return Simulation(dataset, truth, paths, plan, {run.trajectory.id: run.start for run in runs})


def _places(poses: Array, mount: Mount | None) -> Array:
    """Places (K, 2) of the robot's centre, m, from poses (K, 3) of its tracked point."""
    if mount is None:
        return poses[:, :2]
    return placed(poses, seen_from(np.array([mount.x, mount.y, mount.yaw]), np.zeros(2)))


@dataclass(frozen=True, eq=False)
class _Recorded:
    """A run before SLAM: its poses are the design model's odometry.

    path: the true one, from (0, 0, 0) on. start (3,): its true start in the room, m, m, rad. stops: from and until when
    the watchdog stopped the robot, s.
    """

    trajectory: Trajectory
    scans: TrajectoryScans
    path: TruePath
    start: Array
    stops: tuple[tuple[float, float], ...]


def _robot_session(
    config: RobotConfig, robot: TrueRobot, plan: FloorPlan, split: Split, session: RobotSession
) -> Iterator[_Recorded]:
    """The runs of a session one after the other in a room; wheel angles go on from run to run."""
    rng = np.random.default_rng(session.seed)
    design, direct, period = config.robot, config.robot.drive.direct, config.sample_period
    steps = round(period / TRUE_STEP)
    runs = runs_of([(command, config.repetitions) for command in config.driven], config.order, rng)
    # The motion of each run once it has steered, and its true steering angles (K + 1, S), rad, every millisecond.
    motions: list[CommandedMotion] = []
    steered: list[Array] = []
    before = np.zeros(len(design.drive.steered))
    for command, _ in runs:
        way, turning = session.distance if command.speed else None, config.commands.turn_duration
        motion = command_motion(command, way, turning, config.profile, config.link, period, config.settle, rng)
        _, angles = wheels_of(design, command.twist)
        motions.append(motion.after(config.steering.rest(design, before, angles, period)))
        steered.append(config.steering.angles(before, angles, len(motions[-1].times) * steps))
        before = steered[-1][-1]
    targets = [target_rates(design, motion) for motion in motions]
    rates = [robot.driven(motion.times, target) for motion, target in zip(motions, targets, strict=True)]
    if robot.has_differential:
        rates = [rate.mean(axis=1, keepdims=True) for rate in rates]
    resting = np.zeros(rates[0].shape[1])
    driven = drive_session(config.motor, config.controller, config.encoder, rates, period, resting)
    started_at, angles = 0.0, np.zeros(len(design.wheel_names))
    recordings = zip(runs, motions, targets, steered, driven, strict=True)
    for number, ((command, repetition), motion, target, steering, wheels) in enumerate(recordings, 1):
        if robot.has_differential:
            wheels = _behind_differential(config, robot, wheels, steering, angles)
            angles = wheels.wheel_angles[-1]
        run = Trajectory(
            f"{split}-{number:03d}",
            split,
            motion.times,
            wheels.rates,
            np.zeros(1),
            np.zeros((1, 3)),
            repetition=repetition,
            session=split,
            started_at=started_at,
            angles=wheels.angles,
            targets=target,
            steering=None if direct else config.steering.measured(steering[steps::steps], rng),
            drive=None if direct else design.drive,
        )
        run = _commanded(run, command, session.distance if command.speed else 0.0, command.name)
        yield _scanned(config, robot, plan, run, wheels, steering, motion, rng)
        started_at += float(motion.times[-1]) + PAUSE


def _behind_differential(
    config: RobotConfig, robot: TrueRobot, shaft: DrivenRun, steering: Array, angles: Array
) -> DrivenRun:
    """Motion of a car's wheels (N), which turn as they roll, from angles (N,), rad, on; shaft: their mean."""
    rates = np.repeat(np.diff(shaft.wheel_angles, axis=0) / TRUE_STEP, len(angles), axis=1)
    ends = TRUE_STEP * np.arange(1, len(rates) + 1)
    log = robot.log(ends, rates, np.zeros(3), ends, angles, 0.0, None, steering[1:])
    assert log.wheel_angles is not None  # they were given
    true, tick = np.vstack([angles, log.wheel_angles]), config.encoder.tick
    counts = np.floor(true[:: round(config.sample_period / TRUE_STEP)] / tick)
    measured = np.diff(counts, axis=0) * tick / config.sample_period
    return DrivenRun(true, measured, counts[1:] * tick, shaft.voltages)


def _scanned(
    config: RobotConfig, robot: TrueRobot, plan: FloorPlan, run: Trajectory, wheels: DrivenRun, steering: Array,
    motion: CommandedMotion, rng: np.random.Generator,
) -> _Recorded:  # fmt: skip
    """The run with its scans; its poses are the design model's odometry until SLAM replaces them."""
    # Log of the true wheels at every millisecond.
    ends = TRUE_STEP * np.arange(len(wheels.wheel_angles))
    rates = np.diff(wheels.wheel_angles, axis=0) / TRUE_STEP
    steered = None if run.drive is None else steering[1:]
    angles = wheels.wheel_angles[1:]
    log = WheelLog(ends[1:], rates, np.zeros(3), ends, angles, run.started_at, run.session, steered, run.drive)
    path = robot.poses(log)
    seen = robot.reported(log)  # the LIDAR's poses: with the effects on the reference
    # The robot is put on its mark by hand.
    spread = [config.placement.position, config.placement.position, math.radians(config.placement.heading_deg)]
    start = plan.start + spread * rng.standard_normal(3)
    places = _places(compose(start, path), robot.model.robot.mount)
    plan.check_path(places, log.stamps, config.radius, f"run {run.id}")
    stamps = scan_stamps(config.lidar, float(run.times[-1]), rng)
    try:
        scans = measure_scans(plan, config.lidar, TruePath(log.stamps, compose(start, seen)), stamps, rng)
    except DataError as error:
        raise DataError(f"run {run.id}: {error}") from None
    # Odometry at the scans, and that of the robot at its samples by Eq. (1), both from (0, 0, 0) on.
    arcs, steps = OdometryModel.of_design(config.robot, "arc"), OdometryModel.of_design(config.robot, "euler")
    (odometry,) = arcs.poses([replace(run.log(stamps), start=np.zeros(3))])
    (computed,) = steps.poses([replace(run.log(run.times), start=np.zeros(3))])
    sent = [(command.time, run.v, run.alpha, run.omega, command.duration) for command in motion.commands]
    sent_rows = np.reshape(np.array(sent, dtype=float), (-1, 5))
    run = replace(run, pose_times=stamps, poses=odometry, odometry=computed, sent=sent_rows)
    every = round(min(config.sample_period, _DENSE) / TRUE_STEP)
    return _Recorded(run, scans, TruePath(log.stamps[::every], path[::every]), start, motion.stopped_by_watchdog)


def _warnings(runs: Sequence[_Recorded]) -> Iterator[str]:
    """Warnings of runs that the watchdog stopped, and of those in which wheels did not follow their targets."""
    if stopped := [run for run in runs if run.stops]:
        yield (
            f"no command was valid for a while, and the watchdog stopped the robot, in {len(stopped)} of {len(runs)} "
            f"runs, e.g. {stopped[0].trajectory.id} at {stopped[0].stops[0][0]:.2f} s"
        )
    missed = {}
    for run in (recorded.trajectory for recorded in runs):
        assert run.targets is not None
        turned, commanded = (np.abs(rates.sum(axis=0)).sum() for rates in (run.rates, run.targets))
        if commanded and abs(turned / commanded - 1) > _FOLLOWED:
            missed[run.id] = turned / commanded
    for name, share in [*missed.items()][:1]:
        yield (
            f"in {len(missed)} of {len(runs)} runs the wheels do not follow their targets: in {name} they turn "
            f"{share:.0%} of their target angles; check motor and controller"
        )
