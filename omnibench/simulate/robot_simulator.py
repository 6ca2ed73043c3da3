"""The robot simulator: from motion commands over motors, encoders, true motion and LIDAR scans to poses by SLAM.

The flower experiment: a robot of known truth drives every command; wheels and reference are recorded with noise.
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
from omnibench.simulate.config import FlowerConfig, RobotSession, Session
from omnibench.simulate.floor_plan import FloorPlan, make_plan
from omnibench.simulate.lidar import measure_scans, scan_stamps
from omnibench.simulate.motion_commands import CommandedMotion, command_motion, target_rates
from omnibench.simulate.motors import TRUE_STEP, DrivenRun, check_reach, drive_session
from omnibench.simulate.robot_config import RobotConfig
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
    commands = [(each, each.repetitions) for each in config.planned(session)]
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
        run = Trajectory(
            f"{split}-{number:03d}",
            split,
            times,
            rates,
            pose_times,
            poses + session.noise_scale * reference_noise(config.noise, pose_times, rng),
            repetition=repetition,
            session=split,
            started_at=started_at,
            angles=angles,
            targets=targets,
            steering=steering,
        )
        yield _commanded(run, command, command.speed * (float(times[-1]) - ramp), planned.name)
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
    return _commanded(replace(still, poses=poses), command, command.speed * (float(times[-1]) - timed.ramp), name)


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
    commands = config.driven
    check_reach(config.robot, commands, config.motor)
    sessions = config.sessions
    # Commands that lead the robot, as designed, out of the room.
    mount = config.robot.mount
    for command in commands:
        twist = command.twist if mount is None else mount.twist @ command.twist
        for session in sessions.values() if command.speed else ():
            times = np.linspace(0.0, session.distance / command.speed, max(2, math.ceil(session.distance / _STEP)))
            path = PathBatch(RunSamples.of([times[-1:]]), plan.start[None], times[-1] * twist[None], "arc")
            plan.check_path(_places(path.poses([times])[0], mount), times, config.radius, f"command {command.name}")
    truth = true_record(config, name)
    simulator = _RobotSimulator(config, truth.true_robot(TRUE_STEP), plan, commands)
    runs: list[_Recorded] = []
    total = len(sessions) * len(commands) * config.repetitions
    watch(Progress("driving and scanning", 0, total, "run"))
    for split, session in sessions.items():
        for run in simulator.session(split, session):
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
    warnings = (*dataset.warnings, *config.left_out, *_stopped(runs), *_missed_targets(runs))
    dataset = replace(dataset, warnings=warnings)
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


@dataclass(frozen=True, eq=False)
class _RobotSimulator:
    """Drives the commands with the true robot in its room, session by session."""

    config: RobotConfig
    robot: TrueRobot
    plan: FloorPlan
    commands: Sequence[Command]

    def session(self, split: Split, session: RobotSession) -> Iterator[_Recorded]:
        """The runs of a session one after the other; wheel angles go on from run to run."""
        config, rng = self.config, np.random.default_rng(session.seed)
        runs = runs_of([(command, config.repetitions) for command in self.commands], config.order, rng)
        motions = [
            command_motion(
                command, session.distance if command.speed else None, config.commands.turn_duration, config.profile,
                config.link, config.sample_period, config.settle, rng,
            )
            for command, _ in runs
        ]  # fmt: skip
        steered, motions = self._steered([command for command, _ in runs], motions)
        targets = [target_rates(config.robot, motion) for motion in motions]
        rates = [self.robot.driven(motion.times, target) for motion, target in zip(motions, targets, strict=True)]
        if self.robot.has_differential:
            rates = [rate.mean(axis=1, keepdims=True) for rate in rates]
        driven = drive_session(
            config.motor, config.controller, config.encoder, rates, config.sample_period, np.zeros(rates[0].shape[1])
        )
        started_at, angles, direct = 0.0, np.zeros(len(config.robot.wheel_names)), config.robot.drive.direct
        for number, ((command, repetition), motion, target, steering, wheels) in enumerate(
            zip(runs, motions, targets, steered, driven, strict=True), 1
        ):
            if self.robot.has_differential:
                wheels = self._behind_differential(wheels, steering, angles)
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
                steering=None if direct else config.steering.measured(steering[self._steps :: self._steps], rng),
                drive=None if direct else config.robot.drive,
            )
            run = _commanded(run, command, session.distance if command.speed else 0.0, command.name)
            yield self._scanned(run, wheels, steering, motion, rng)
            started_at += float(motion.times[-1]) + PAUSE

    def _steered(
        self, commands: Sequence[Command], motions: Sequence[CommandedMotion]
    ) -> tuple[list[Array], list[CommandedMotion]]:
        """True steering angles (K + 1, S), rad, every millisecond of each run, and its motion once it has steered."""
        config, robot = self.config, self.config.robot
        before, angles, rested = np.zeros(len(robot.drive.steered)), [], []
        for command, motion in zip(commands, motions, strict=True):
            _, wanted = wheels_of(robot, command.twist)
            rested.append(motion.after(config.steering.rest(robot, before, wanted, config.sample_period)))
            angles.append(config.steering.angles(before, wanted, len(rested[-1].times) * self._steps))
            before = angles[-1][-1]
        return angles, rested

    @property
    def _steps(self) -> int:
        """Milliseconds of a sample."""
        return round(self.config.sample_period / TRUE_STEP)

    def _behind_differential(self, shaft: DrivenRun, steering: Array, angles: Array) -> DrivenRun:
        """Motion of a car's wheels (N), which turn as they roll, from angles (N,), rad, on; shaft: their mean."""
        rates = np.repeat(np.diff(shaft.wheel_angles, axis=0) / TRUE_STEP, len(angles), axis=1)
        ends = TRUE_STEP * np.arange(1, len(rates) + 1)
        log = self.robot.log(ends, rates, np.zeros(3), ends, angles, 0.0, None, steering[1:])
        assert log.wheel_angles is not None  # they were given
        true, tick = np.vstack([angles, log.wheel_angles]), self.config.encoder.tick
        counts = np.floor(true[:: self._steps] / tick)
        measured = np.diff(counts, axis=0) * tick / self.config.sample_period
        return DrivenRun(true, measured, counts[1:] * tick, shaft.voltages)

    def _scanned(
        self, run: Trajectory, wheels: DrivenRun, steering: Array, motion: CommandedMotion, rng: np.random.Generator
    ) -> _Recorded:
        """The run with its scans; its poses are the design model's odometry until SLAM replaces them."""
        config, plan = self.config, self.plan
        # Log of the true wheels at every millisecond.
        ends = TRUE_STEP * np.arange(len(wheels.wheel_angles))
        rates = np.diff(wheels.wheel_angles, axis=0) / TRUE_STEP
        steered = None if run.drive is None else steering[1:]
        angles = wheels.wheel_angles[1:]
        log = WheelLog(ends[1:], rates, np.zeros(3), ends, angles, run.started_at, run.session, steered, run.drive)
        path = self.robot.poses(log)
        seen = self.robot.reported(log)  # the LIDAR's poses: with the effects on the reference
        # The robot is put on its mark by hand.
        spread = [config.placement.position, config.placement.position, math.radians(config.placement.heading_deg)]
        start = plan.start + spread * rng.standard_normal(3)
        places = _places(compose(start, path), self.robot.model.robot.mount)
        plan.check_path(places, log.stamps, config.radius, f"run {run.id}")
        stamps = scan_stamps(config.lidar, float(run.times[-1]), rng)
        try:
            scans = measure_scans(plan, config.lidar, TruePath(log.stamps, compose(start, seen)), stamps, rng)
        except DataError as error:
            raise DataError(f"run {run.id}: {error}") from None
        every = round(min(config.sample_period, _DENSE) / TRUE_STEP)
        design = OdometryModel.of_design(config.robot, "arc")
        (odometry,) = design.poses([replace(run.log(stamps), start=np.zeros(3))])
        by_robot = OdometryModel.of_design(config.robot, "euler")  # Eq. (1), from (0, 0, 0) on
        (computed,) = by_robot.poses([replace(run.log(run.times), start=np.zeros(3))])
        sent = [(command.time, run.v, run.alpha, run.omega, command.duration) for command in motion.commands]
        run = replace(run, odometry=computed, sent=np.reshape(np.array(sent, dtype=float), (-1, 5)))
        true = TruePath(log.stamps[::every], path[::every])
        return _Recorded(
            replace(run, pose_times=stamps, poses=odometry), scans, true, start, motion.stopped_by_watchdog
        )


def _stopped(runs: Sequence[_Recorded]) -> tuple[str, ...]:
    """Warning of runs in which the watchdog stopped the robot."""
    stopped = [run for run in runs if run.stops]
    if not stopped:
        return ()
    first = stopped[0]
    return (
        f"no command was valid for a while, and the watchdog stopped the robot, in {len(stopped)} of {len(runs)} runs, "
        f"e.g. {first.trajectory.id} at {first.stops[0][0]:.2f} s",
    )


def _missed_targets(runs: Sequence[_Recorded]) -> tuple[str, ...]:
    """Warning of runs in which wheels did not follow their targets."""
    missed = {}
    for run in runs:
        rates, targets = run.trajectory.rates, run.trajectory.targets
        assert targets is not None
        turned, wanted = (np.abs(wheel_rates.sum(axis=0)).sum() for wheel_rates in (rates, targets))
        if wanted and abs(turned / wanted - 1) > _FOLLOWED:
            missed[run.trajectory.id] = turned / wanted
    if not missed:
        return ()
    name, share = next(iter(missed.items()))
    return (
        f"in {len(missed)} of {len(runs)} runs the wheels do not follow their targets: in {name} they turn "
        f"{share:.0%} of their target angles; check motor and controller",
    )
