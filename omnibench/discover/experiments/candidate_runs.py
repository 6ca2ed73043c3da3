"""Candidate runs: short ones that the recorded robot can drive, within what it was recorded to do."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.discover.fitting.model_fit import Fit
from omnibench.robot.corrections import motions_of
from omnibench.robot.effects.effect import Effect
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.signals import of_centre
from omnibench.simulate.command import is_within
from omnibench.simulate.driving.designed_run import run_as_designed
from omnibench.simulate.driving.drivable_commands import DrivableCommands, Shapes
from omnibench.simulate.driving.timed_command import TimedCommand
from omnibench.simulate.variation import Variation

SESSION = "experiment"  # name of the session in which the new runs are driven
PLACING = 15.0  # s before a run, in which the robot is put into its place: a person walks a few metres (chosen)
RAMP = 0.3  # s at the start and the end of a run in which the speed changes: what small robots take (chosen)
# Shapes: finer steps change the minutes little, because runs of several kinds are combined (chosen).
_SHAPES = Shapes(lines=(1.0,), radii=(0.2, 0.5), turns=(180.0, 360.0), spins=(360.0, 1080.0), paces=(1.0, 0.5, 0.25))
_HEADINGS = (0.0, 90.0, 180.0, 270.0)  # deg, at the start, for effects that depend on the heading
_OFTEN = 0.99  # quantile of the speeds that the robot is taken to be able to drive: spikes lie beyond (chosen)
_LEAST_FLOOR = 1.0  # m, side of the floor that is free in any case: the robot stands somewhere (chosen)
_LEAST_STEERING = math.radians(10.0)  # rad: limit of the steering where a robot only drove straight on (chosen)
_TURNING = 1.0  # rad/s: at most, where the robot never turned as fast (chosen)
_WEAVE, _WEAVE_PERIOD = 0.3, 3.0  # rad/s and s, by which the rate of turn swings: gear play of a degree shows (chosen)
_COARSE = 0.05  # s: shorter samples tell the same of constant commands
_STAMPS = 80  # reference poses of a run that a fit uses, at most: see fit/least_squares/usable_runs.py


@dataclass(frozen=True, eq=False)
class CandidateRun:
    """A run that could be driven. heading: of the robot at its start, deg; None where it does not matter."""

    timed: TimedCommand
    heading: float | None
    run: Trajectory

    @property
    def seconds(self) -> float:
        """Time that the run takes, s, with placing the robot."""
        return self.timed.duration + PLACING


def candidate_runs(fit: Fit, effects: Sequence[Effect]) -> tuple[CandidateRun, ...]:
    """Lines, arcs and turns on the spot at three paces, within the speeds and wheel rates of a fit's runs.

    effects: that are to be told apart; runs begin at several headings where one of these depends on it.
    """
    turned = any(effect.shows_in in ("heading", "place") for effect in effects)
    headings: Sequence[float | None] = _HEADINGS if turned else (None,)
    commands = dict.fromkeys(_drivable(fit, variation_for(effects)))
    return tuple(CandidateRun(timed, heading, _run(fit, timed, heading)) for timed in commands for heading in headings)


def variation_for(effects: Sequence[Effect]) -> Variation:
    """How commands vary within a run: steering that turns shows what it does, and casters that swing round."""
    steering = any(effect.stage == "steering" or "steering_side" in effect.needs for effect in effects)
    casters = any("caster_rates" in effect.needs for effect in effects)
    return Variation(weave=_WEAVE if steering else 0.0, period=_WEAVE_PERIOD, reversals=int(casters))


def placed_seconds(runs: Sequence[Trajectory]) -> float:
    """Mean time that some recorded runs take, s, with placing the robot."""
    return float(np.mean([run.pose_times[-1] for run in runs])) + PLACING


def _drivable(fit: Fit, variation: Variation) -> Iterator[TimedCommand]:
    """Commands within the limits of what was recorded, with their ramps and a variation."""
    robot = fit.model.robot
    motions = np.concatenate([motions_of(fit.model.matrix, run.times, run.signals) for run in fit.runs])
    twists = of_centre(robot, motions)
    speed = _mostly(np.hypot(twists[:, 0], twists[:, 1]))
    turning = _mostly(np.abs(twists[:, 2]))
    speed = max(speed, turning * robot.reach)  # a robot that only turned has wheels that drove that fast
    steering = [np.abs(run.steering).max(axis=1) for run in fit.runs if run.steering is not None and run.steering.size]
    side = max(float(np.ptp(run.poses[:, :2], axis=0).max()) for run in fit.runs)
    limit = max(_mostly(np.concatenate(steering)), _LEAST_STEERING) if steering else math.pi
    commands = DrivableCommands(
        robot,
        max_speed=speed,
        max_turn_rate=max(turning, min(_TURNING, speed / robot.reach)),
        max_wheel_rate=_mostly(np.concatenate([np.abs(run.rates).max(axis=1) for run in fit.runs])),
        steering_limit=limit,
        free=(max(side, _LEAST_FLOOR),) * 2,
        shapes=_SHAPES,
    )
    for timed in commands:
        if all(is_within(robot, extreme, limit) for extreme in variation.extremes(timed.command)):
            yield TimedCommand(timed.command, round(timed.duration + RAMP, 1), RAMP, variation)


def _mostly(values: Array) -> float:
    return float(np.quantile(values, _OFTEN))


def _run(fit: Fit, timed: TimedCommand, heading: float | None) -> Trajectory:
    """The run as the robot's design has it, with what was recorded of the fit's runs."""
    period = fit.model.sample_period
    assert period is not None
    between = float(np.median(np.concatenate([np.diff(run.pose_times) for run in fit.runs])))
    periods = (max(period, _COARSE), max(min(between, timed.duration / 4), timed.duration / _STAMPS))
    run = run_as_designed(OdometryModel.of_design(fit.model.robot, "arc"), timed, periods, timed.command.name)
    first = fit.runs[0]
    poses = run.poses.copy()
    if heading is not None:
        poses[0, 2] = math.radians(heading)
    return replace(
        run,
        poses=poses,
        session=None if first.session is None else SESSION,
        started_at=None if first.started_at is None else 0.0,
        angles=None if first.angles is None else np.cumsum(run.rates * periods[0], axis=0),
    )


def coarse(fit: Fit) -> Fit:
    """The fit with a model at the sample period of the candidate runs."""
    period = fit.model.sample_period
    assert period is not None
    return replace(fit, model=replace(fit.model, sample_period=max(period, _COARSE)))
