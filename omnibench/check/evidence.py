"""The evidence of a recording: its clocks, a look at each run, free fits and mistakes, which detectors share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from omnibench.check.misreadings import Explained, search
from omnibench.check.motion_fit import FreeFit, Windows, continuous
from omnibench.check.source import RecordingSource, recorded
from omnibench.data.clock_matching import ROUNDS, SEARCH, ClockMatch, Streams, fitted_together, match_clocks
from omnibench.data.clock_matching import Windows as ClockWindows
from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.stored import MOST_DRAWN, drawn_runs, median_period, median_step
from omnibench.jobs.job import gathered
from omnibench.progress import Reporter
from omnibench.robot.kinematics import Array, Robot, rotated, wheel_equations
from omnibench.robot.stored_odometry import together, workers

_TOGETHER = 600_000  # wheel samples of the runs by which coefficients of very many are found: 100 of a minute (chosen)
# Of a wheel's steps of half a second, those above so many times this quantile are jumps of the reference; chosen: a
# wheel that turns for less than a fifth of a run is not told to be dead.
_STEADY, _MOSTLY = 2.0, 0.8
# The shortest gap, s, and in usual periods (chosen: a sound Robotino's log has gaps of 0.24 s at 31 ms).
_LEAST_GAP, _PERIODS = 0.4, 6.0
_DRIVEN = 0.05  # m that the wheels drive in a gap or while the reference stands, less than which does no harm; chosen
_STANDING, _STILL = 0.8, 0.03  # s that a reference stands, and share of the wheels' way that it may move then; chosen
_FASTEST = 8.0  # m/s of a rim: no robot of this kind is faster; chosen
# s of a run's begin, and share of its usual speed above which wheels and reference do not begin at rest (chosen: real
# robots that start from rest reach up to 0.32).
_BEGIN, _MOVING = 0.12, 0.35
# A robot that goes on slowly does not begin at rest, either: share of its usual speed, and of that over the next second
# (chosen: a Robotino that starts from rest has up to 0.34 of the latter).
_SLOWLY, _AT_ONCE, _NEXT = 0.2, 0.5, 1.0
_STEP = 3.0  # times the robot's size: steps over which the turns of a robot that steers are compared; chosen
SAME = 1e-4  # m and rad: a pose that is repeated, below the noise of any reference; chosen


@dataclass(frozen=True, eq=False)
class Look:
    """Faults and motions that one run shows; those of its reference are None or 0 where it has no poses.

    fast: number of samples that are faster than any wheel turns. wheel_gaps, reference_gaps: lengths of what is missing
    while the robot drives, s. standing: s in which the reference stands, without even scattering, while the wheels
    drive. counted, expected (N,): angles that the wheels count, and that the reference asks of them, rad. steering
    (2, S): least and largest angles, rad. bends: turns of the reference over steps of _STEP times the robot's size,
    rad, signed as the wheels roll. moves_at_once: wheels and reference move from the first sample on nearly as fast as
    they ever do, or as they go on.
    """

    run: str
    samples: int
    fast: int
    wheel_gaps: tuple[float, ...]
    reference_gaps: tuple[float, ...] = ()
    standing: float = 0.0
    counted: Array | None = None
    expected: Array | None = None
    steering: Array | None = None
    bends: Array | None = None
    moves_at_once: bool = False


@dataclass(frozen=True, eq=False)
class Evidence:
    """A recording, and what detectors need to know of it, computed when the first of them does."""

    read: RecordingSource

    @property
    def dataset(self) -> Dataset:
        """The data set of the recording."""
        return self.read.dataset

    @cached_property
    def runs(self) -> Sequence[Trajectory]:
        """The runs that have poses."""
        return [run for run in self.dataset.trajectories if run.has_poses]

    @cached_property
    def clocks(self) -> Sequence[ClockMatch | None]:
        """The clocks of their references; None where one does not show.

        Of very many runs those that chance has drawn tell what all have in common; then each is matched by itself.
        """
        robot = self.dataset.robot
        smooth = [replace(run, poses=continuous(run.pose_times, run.poses)) for run in self.runs]
        if sum(len(run.times) for run in smooth) <= MOST_DRAWN:
            return match_clocks(robot, [Streams.of_run(run) for run in smooth])
        drawn = (ClockWindows.of(robot, Streams.of_run(run)) for run in drawn_runs(smooth, _TOGETHER))
        usable = [windows for windows in drawn if windows is not None]
        if not usable:
            return [None] * len(smooth)
        fitted, _ = fitted_together(usable, SEARCH)
        tasks = [(robot, part, fitted) for part in together(smooth)]
        return [clock for part in gathered(workers(), clocks_of_part, tasks) for clock in part]

    @cached_property
    def aligned(self) -> Sequence[Trajectory]:
        """The runs that have poses, with these by the wheels' clock where the reference's clock shows."""
        aligned = []
        for run, clock in zip(self.runs, self.clocks, strict=True):
            times = run.pose_times if clock is None else clock.corrected(run.pose_times)
            first, last = int(np.searchsorted(times, 0.0)), int(np.searchsorted(times, run.times[-1], side="right"))
            if clock is not None and last - first >= max(3, len(times) // 2):
                poses = run.poses[first:last]
                run = replace(run, pose_times=times[first:last], poses=poses, pose_covariances=None)
            aligned.append(run)
        return aligned

    @cached_property
    def explained(self) -> Explained:
        """The mistakes that explain how runs with poses move, by the wheels' clock; or else those with positions."""
        seen = recorded(replace(self.dataset, trajectories=tuple(self.aligned)) if self.aligned else self.dataset)
        return search(replace(seen, counted=bool(self.read.options.get("ticks_per_turn"))))

    @cached_property
    def looks(self) -> list[Look]:
        """A look at each of the runs that have poses."""
        return looks_of(self.dataset.robot, self.aligned) if self.aligned else []

    @cached_property
    def windows(self) -> Windows | None:
        """Windows of a second of the runs that have poses, of many some; None where poses are sparse."""
        poses = [continuous(run.pose_times, run.poses) for run in self.aligned]
        return Windows.of([run.log(run.pose_times) for run in self.aligned], poses)

    @cached_property
    def fit(self) -> FreeFit | None:
        """The matrix that fits these windows best."""
        return None if self.windows is None else self.windows.fit(self.dataset.robot.reach)


def clocks_of_part(task: tuple[Robot, Sequence[Trajectory], Sequence[Array]], _: Reporter) -> list[ClockMatch | None]:
    """The clocks by which some runs fit given coefficients best. The task: robot, runs and coefficients."""
    robot, runs, fitted = task
    clocks = list[ClockMatch | None]()
    for run in runs:
        if (windows := ClockWindows.of(robot, Streams.of_run(run))) is None:
            clocks.append(None)
        else:
            clock = windows.improved(fitted, windows.scanned(SEARCH, fitted), ROUNDS)
            clocks.append(windows.match(fitted, clock, SEARCH))
    return clocks


def looks_of(robot: Robot, runs: Sequence[Trajectory]) -> list[Look]:
    """The looks at runs, of which those without poses have only their wheels looked at."""
    posed = [run for run in runs if run.has_poses]
    tasks = [(robot, part, median_period(runs), pose_period(posed)) for part in together(runs)]
    return [look for part in gathered(workers(), looks_at, tasks) for look in part]


def pose_period(runs: Sequence[Trajectory]) -> float:
    """The usual time between the poses of runs, s; infinite if there are no runs."""
    return median_step(run.pose_times for run in runs) if runs else np.inf


def looks_at(task: tuple[Robot, Sequence[Trajectory], float, float], _: Reporter) -> list[Look]:
    """The looks at some runs. The task: robot, runs, usual periods of wheel samples and of reference poses, s."""
    robot, runs, *periods = task
    return [_look(robot, run, *periods) for run in runs]


def _look(robot: Robot, run: Trajectory, of_wheels: float, of_reference: float) -> Look:
    edges = np.append(0.0, run.times)
    speeds = _lengths(robot, run.signals @ robot.inverse_kinematic_matrix.T)
    ways = np.append(0.0, np.cumsum(speeds * np.diff(edges)))  # m that the wheels drive up to each edge

    def gaps(times: Array, usual: float) -> tuple[float, ...]:
        long = np.flatnonzero(np.diff(times) > max(_LEAST_GAP, _PERIODS * usual))
        begins, ends = times[long], times[long + 1]
        wheels = np.interp(ends, edges, ways) - np.interp(begins, edges, ways)
        first = np.maximum(np.searchsorted(run.pose_times, begins - 1e-9) - 1, 0)
        last = np.minimum(np.searchsorted(run.pose_times, ends + 1e-9), len(run.poses) - 1)
        driven = np.maximum(wheels, _lengths(robot, run.poses[last] - run.poses[first]))
        return tuple((ends - begins)[driven > _DRIVEN].tolist())

    fast = int((np.abs(run.rates) * robot.radii > _FASTEST).any(axis=1).sum())
    of_run = run.id, len(run.times), fast, gaps(edges, of_wheels)
    if not run.has_poses:
        return Look(*of_run)
    # Stretches of equal poses, from first to last.
    moves = np.diff(run.poses, axis=0)
    bounds = np.flatnonzero(np.concatenate([[True], np.abs(moves).max(axis=1) > SAME, [True]]))
    first, last = bounds[:-1], bounds[1:] - 1
    seconds = run.pose_times[last] - run.pose_times[first]
    driven = np.interp(run.pose_times, edges, ways)
    wheels = driven[last] - driven[first]
    long = seconds >= max(_STANDING, 3 * float(np.median(np.diff(run.pose_times))))
    seen = _lengths(robot, run.poses[last] - run.poses[first])
    still = long & (wheels > _DRIVEN) & (seen < _STILL * wheels)
    seen_ways = np.append(0.0, np.cumsum(_lengths(robot, moves)))
    counted, expected = np.abs(run.rates).T @ np.diff(run.times, prepend=0.0), _expected_angles(robot, run)
    steering = bends = None
    if run.steering is not None:
        steering = np.array([run.steering.min(axis=0), run.steering.max(axis=0)])
        bends = _bends(robot, run, seen_ways)
    at_once = _at_once(edges, ways) and _at_once(run.pose_times, seen_ways)
    reference_gaps, standing = gaps(run.pose_times, of_reference), float(seconds[still].sum())
    return Look(*of_run, reference_gaps, standing, counted, expected, steering, bends, at_once)


def _lengths(robot: Robot, motions: Array) -> Array:
    """Lengths (...) of motions (..., 3), m; turning counts at the robot's reach."""
    return np.hypot(motions[..., 0], motions[..., 1]) + robot.reach * np.abs(motions[..., 2])


def _bends(robot: Robot, run: Trajectory, ways: Array) -> Array:
    length = _STEP * max(robot.reach, 1e-3)
    if ways[-1] < 3 * length:
        return np.zeros(0)
    rolled = np.append(0.0, np.cumsum(run.rates.mean(axis=1) * np.diff(run.times, prepend=0.0)))
    rolling = np.sign(np.diff(np.interp(run.pose_times, np.append(0.0, run.times), rolled)))
    signed = np.append(0.0, np.cumsum(np.diff(run.poses[:, 2]) * rolling))
    return np.diff(np.interp(np.arange(0.0, ways[-1], length), ways, signed))


def _expected_angles(robot: Robot, run: Trajectory) -> Array:
    """Angles (N,), rad, by which wheels must turn for the reference's motion, at least about."""
    every = max(1, round(0.5 / float(np.median(np.diff(run.pose_times)))))
    poses = run.poses[::every]
    steps = np.diff(poses, axis=0)
    middle = (poses[1:, 2] + poses[:-1, 2]) / 2
    twists = np.column_stack([rotated(steps[:, :2], -middle), steps[:, 2]])
    if robot.mount is not None:
        twists = twists @ np.linalg.inv(robot.mount.twist).T
    angles = []
    for wheel in robot.measured:
        x, y = wheel.position
        if wheel.has_steering:
            moved = np.hypot(twists[:, 0] - y * twists[:, 2], twists[:, 1] + x * twists[:, 2]) / wheel.radius
        else:
            moved = np.abs(twists @ wheel_equations([wheel])[0])
        moved = np.minimum(moved, _STEADY * np.quantile(moved, _MOSTLY)) if len(moved) else moved
        angles.append(float(moved[moved >= 0.1].sum()))  # rad in a step: less is noise of the reference
    return np.array(angles)


def _at_once(stamps: Array, ways: Array) -> bool:
    """True if what has driven these ways, m, up to the stamps, s, moves from the first one on."""
    speeds = np.diff(np.interp(np.arange(stamps[0], stamps[-1], _BEGIN), stamps, ways))
    moving = speeds[speeds > 0.1 * speeds.max(initial=0.0)]
    if not len(moving):
        return False
    goes_on = speeds[0] >= _AT_ONCE * float(np.mean(speeds[: 1 + round(_NEXT / _BEGIN)]))
    return bool(speeds[0] / float(np.median(moving)) >= (_SLOWLY if goes_on else _MOVING))
