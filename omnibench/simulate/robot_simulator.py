"""The robot simulator: from motion commands over motors, encoders, true motion and LIDAR scans to poses by SLAM."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omnibench.data.dataset import Split, Trajectory, make_dataset
from omnibench.data.scans import ScansInMemory, TrajectoryScans
from omnibench.data.true_poses import TruePath
from omnibench.errors import DataError
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.robot.kinematics import Array, Mount, compose, placed, seen_from
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import DrivenPath, WheelLog
from omnibench.simulate.commands import Command, wheels_of
from omnibench.simulate.config import RobotSession
from omnibench.simulate.floor_plan import FloorPlan, make_plan
from omnibench.simulate.flower import PAUSE, runs_of
from omnibench.simulate.lidar import measure_scans, scan_stamps
from omnibench.simulate.motion_commands import CommandedMotion, command_motion, target_rates
from omnibench.simulate.motors import TRUE_STEP, DrivenRun, check_reach, drive_session
from omnibench.simulate.robot_config import RobotConfig
from omnibench.simulate.truth import Simulation, TrueRobot, true_record
from omnibench.slam.slam_dataset import slam_dataset

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
            path = DrivenPath(times[-1:], plan.start, times[-1] * twist[None], "arc")
            plan.check_path(_places(path.poses(times), mount), times, config.radius, f"command {command.name}")
    truth = true_record(config.truth, config.robot, config.sample_period, tuple(sessions), name)
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
                id=f"{split}-{number:03d}",
                split=split,
                command=command.name,
                repetition=repetition,
                session=split,
                started_at=started_at,
                v=command.speed,
                alpha=command.direction,
                omega=command.turn_rate,
                duration=float(motion.times[-1]),
                distance=session.distance if command.speed else 0.0,
                times=motion.times,
                rates=wheels.rates,
                pose_times=np.zeros(1),
                poses=np.zeros((1, 3)),
                angles=wheels.angles,
                targets=target,
                steering=None if direct else config.steering.measured(steering[self._steps :: self._steps], rng),
                drive=None if direct else config.robot.drive,
            )
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
