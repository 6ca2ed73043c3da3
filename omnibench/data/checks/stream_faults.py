"""Faults of the streams of runs: missing samples and poses, a standing reference, dead wheels, restarted counters."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from omnibench.data.checks.finding import Finding, Kind, Severity
from omnibench.data.checks.misreading import wheels_in_words
from omnibench.data.checks.reference_jumps import reference_jumps
from omnibench.data.checks.steering_readings import frozen_steering
from omnibench.data.dataset import Trajectory
from omnibench.data.stored.periods import median_period
from omnibench.robot.kinematics import Array, Robot, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.words import plural, some

# Gaps that are told, s, and as a multiple of the usual period (chosen: a Robotino's log has gaps of 0.24 s at 31 ms).
_LEAST_GAP, _PERIODS = 0.4, 6.0
_DRIVEN = 0.05  # m that the wheels drive in a gap or while the reference stands, less than which does no harm; chosen
_STANDING, _STILL = 0.8, 0.03  # s that a reference stands, and share of the wheels' way that it may move then; chosen
_MOSTLY = 0.25  # share of a run for which a reference stands, from which on it counts as frozen; chosen
_FASTEST = 8.0  # m/s of a rim: no robot of this kind is faster; chosen
_RARE = 0.02  # share of the samples: more that are too fast are another unit
# Share of the angle of the wheel that turns most, up to which one is dead; angle, rad, and share of the largest, that
# the reference must ask of it (chosen).
_DEAD, _EXPECTED, _ASKED = 0.002, 3.0, 0.25
# s of a run's begin, and share of its usual speed above which wheels and reference do not begin at rest (chosen: real
# robots that start from rest reach up to 0.32).
_BEGIN, _MOVING = 0.12, 0.35
# A robot that goes on slowly does not begin at rest, either: share of its usual speed, and of that over the next second
# (chosen: a Robotino from rest has up to 0.34 of the latter, and no run of five robots is told that was not before).
_SLOWLY, _AT_ONCE, _NEXT = 0.2, 0.5, 1.0
# Steps, of so many times the robot's size, that are needed, and spread of the turns over them, rad, that one angle
# cannot give: that of circles seven times as wide as the robot is long and of straight lines; chosen.
_FEWEST, _STEP, _BENDS = 10, 3.0, 0.3
_SAME = 1e-4  # m and rad: a pose that is repeated, below the noise of any reference; chosen


def stream_faults(robot: Robot, runs: Sequence[Trajectory]) -> Iterator[Finding]:
    """Faults of runs, of which those without poses have only their wheels looked at.

    Jumps of the reference are told by wheels that are read rightly.
    """
    posed = [run for run in runs if run.has_poses]
    yield from _restarts(robot, runs)
    usual = median_period(runs)
    yield from _gaps_of(robot, runs, "wheel_dropout", usual, lambda run: np.append(0.0, run.times), "wheel samples")
    if not posed:
        return
    usual = float(np.median(np.concatenate([np.diff(run.pose_times) for run in posed])))
    yield from _gaps_of(robot, posed, "reference_dropout", usual, lambda run: run.pose_times, "reference poses")
    frozen = _standing(robot, posed)
    yield from _frozen(posed, frozen)
    yield from dead_wheels(robot, posed)
    yield from _frozen_steering(robot, posed)
    yield from _jumps(robot, [run for run in posed if run.id not in frozen])
    yield from _moving_starts(robot, posed)


def runs_in_words(runs: Sequence[str], every: int) -> str:
    """``run x``, ``runs x, y``, or ``all runs``."""
    if len(runs) == every and every > 1:
        return "all runs"
    return f"run{'' if len(runs) == 1 else 's'} {some(list(runs), 5)}"


def _restarts(robot: Robot, runs: Sequence[Trajectory]) -> Iterator[Finding]:
    found = []
    for run in runs:
        fast = np.abs(run.rates) * robot.radii > _FASTEST
        count = int(fast.any(axis=1).sum())
        if 0 < count <= max(1.0, _RARE * len(fast)):
            found.append(run.id)
    if found:
        yield Finding(
            kind="counter_restart",
            what=f"single wheel rates of {plural(len(found), 'run')} are faster than any wheel turns, as where a "
            "counter begins again",
            where=runs_in_words(found, len(runs)),
            severity="error",
            fix="import the positions of the encoders, which are then counted on; or leave these runs out",
            changes={"leave_out": found},
        )


def _gaps_of(
    robot: Robot,
    runs: Sequence[Trajectory],
    kind: Kind,
    usual: float,
    times_of: Callable[[Trajectory], Array],
    what: str,
) -> Iterator[Finding]:
    """Samples or poses, ``what``, that are missing for long while the robot drives. usual: their period, s."""
    found, lengths = [], []
    least = max(_LEAST_GAP, _PERIODS * usual)
    for run in runs:
        times = times_of(run)
        gaps = np.flatnonzero(np.diff(times) > least)
        gaps = (
            gaps[[_moved_about(robot, run, times[gap], times[gap + 1]) > _DRIVEN for gap in gaps]]
            if len(gaps)
            else gaps
        )
        if len(gaps):
            found.append(run.id)
            lengths += np.diff(times)[gaps].tolist()
    if found:
        longest = float(f"{max(2 * usual, 0.5 * min(lengths)):.2g}")
        yield Finding(
            kind=kind,
            what=f"{what} are missing {plural(len(lengths), 'time')} while the robot drives, for up to "
            f"{max(lengths):.1f} s; what it did then is not known",
            where=runs_in_words(found, len(runs)),
            severity="error",
            changes={"longest_gap": longest},
        )


def _ways(robot: Robot, run: Trajectory) -> Array:
    """Ways (F + 1,) that the wheels' design drives up to each sample's end, m; turning counts at the robot's size."""
    twists = run.signals @ robot.inverse_kinematic_matrix.T
    speeds = np.hypot(twists[:, 0], twists[:, 1]) + robot.reach * np.abs(twists[:, 2])
    return np.append(0.0, np.cumsum(speeds * np.diff(run.times, prepend=0.0)))


def _moved_about(robot: Robot, run: Trajectory, begin: float, end: float) -> float:
    """Way of the robot, m, between two times by the larger of wheels and reference."""
    wheels = np.interp([begin, end], np.append(0.0, run.times), _ways(robot, run))
    at = np.searchsorted(run.pose_times, [begin - 1e-9, end + 1e-9])
    first, last = max(int(at[0]) - 1, 0), min(int(at[1]), len(run.poses) - 1)
    moved = run.poses[last] - run.poses[first]
    seen = float(np.hypot(moved[0], moved[1]) + robot.reach * abs(moved[2]))
    return max(float(wheels[1] - wheels[0]), seen)


def _standing(robot: Robot, runs: Sequence[Trajectory]) -> dict[str, float]:
    """Seconds in which the reference of a run stands, without even scattering, while its wheels drive, by run."""
    found = {}
    for run in runs:
        changes = np.abs(np.diff(run.poses, axis=0)).max(axis=1) > _SAME
        edges = np.flatnonzero(np.concatenate([[True], changes, [True]]))  # bounds of stretches of equal poses
        first, last = edges[:-1], edges[1:] - 1
        seconds = run.pose_times[last] - run.pose_times[first]
        moved = run.poses[last] - run.poses[first]
        seen = np.hypot(moved[:, 0], moved[:, 1]) + robot.reach * np.abs(moved[:, 2])
        driven = np.interp(run.pose_times, np.append(0.0, run.times), _ways(robot, run))
        wheels = driven[last] - driven[first]
        long = seconds >= max(_STANDING, 3 * float(np.median(np.diff(run.pose_times))))
        still = long & (wheels > _DRIVEN) & (seen < _STILL * wheels)
        if still.any():
            found[run.id] = float(seconds[still].sum())
    return found


def _frozen(runs: Sequence[Trajectory], frozen: dict[str, float]) -> Iterator[Finding]:
    lengths = {run.id: float(run.pose_times[-1]) for run in runs}
    long = [run for run, seconds in frozen.items() if seconds > _MOSTLY * lengths[run]]
    short = [run for run in frozen if run not in long]
    every = len(long) == len(runs)
    if long:
        words = "in every run: check its tracking, and record again" if every else ""
        yield Finding(
            kind="reference_frozen",
            what=f"the reference stands still for up to {max(frozen[run] for run in long):.1f} s while wheels drive",
            where="the reference" if every else runs_in_words(long, len(runs)),
            severity="error",
            fix=words,
            changes={} if every else {"leave_out": long},
        )
    if short:
        yield Finding(
            kind="reference_dropout",
            what=f"the reference repeats a pose for up to {max(frozen[run] for run in short):.1f} s while the wheels "
            "drive, as where its tracking was lost",
            where=runs_in_words(short, len(runs)),
            severity="error",
            changes={"leave_out": short},
        )


def dead_wheels(robot: Robot, runs: Sequence[Trajectory]) -> Iterator[Finding]:
    """Wheels that count nothing though the reference shows that they turn."""
    dead: dict[str, list[str]] = {}
    counts = np.zeros(len(robot.wheel_names), dtype=bool)
    for run in runs:
        expected = expected_angles(robot, run)
        counted = np.abs(run.rates).T @ np.diff(run.times, prepend=0.0)
        # Shares of the wheel that moves most, so that units which are misread do not matter.
        still = counted <= _DEAD * counted.max()
        counts |= ~still
        still &= expected > max(_EXPECTED, _ASKED * expected.max())
        if still.all() and len(still) > 1:
            continue  # a reference that moves by itself is told otherwise
        for name, is_dead in zip(robot.wheel_names, still.tolist(), strict=True):
            if is_dead:
                dead.setdefault(name, []).append(run.id)
    for name, names in dead.items():
        every = len(names) > 0.8 * len(runs) or not counts[robot.wheel_names.index(name)]
        where = wheels_in_words([name])
        at = "" if every else f" in {runs_in_words(names, len(runs))}"
        yield Finding(
            kind="wheel_dead",
            what=f"{where} never turns{at}, though the reference shows that it must: its encoder or column is dead",
            where=where if every else f"{where} in {runs_in_words(names, len(runs))}",
            severity="error",
            fix="check its cable and the column that is read, and record again" if every else "",
            changes={} if every else {"leave_out": names},
        )


def _frozen_steering(robot: Robot, runs: Sequence[Trajectory]) -> Iterator[Finding]:
    """Steering angles that never change though the robot's turns do."""
    angles = [run.steering for run in runs if run.steering is not None]
    if not angles:
        return
    ends = np.array([(of_run.min(axis=0), of_run.max(axis=0)) for of_run in angles])
    spans = ends[:, 1].max(axis=0) - ends[:, 0].min(axis=0)
    bends = np.concatenate([_bends(robot, run) for run in runs])
    if len(bends) < _FEWEST or np.subtract(*np.quantile(bends, [0.9, 0.1])) < _BENDS:
        return
    for name in [name for name, span in zip(robot.drive.steered, spans.tolist(), strict=True) if span < _SAME]:
        yield frozen_steering([name])


def _bends(robot: Robot, run: Trajectory) -> Array:
    """Turns of the reference over steps of _STEP times the robot's size, rad, signed as the wheels roll."""
    steps = np.diff(run.poses, axis=0)
    whole = np.append(0.0, np.cumsum(np.hypot(steps[:, 0], steps[:, 1]) + robot.reach * np.abs(steps[:, 2])))
    length = _STEP * max(robot.reach, 1e-3)
    if whole[-1] < 3 * length:
        return np.zeros(0)
    rolled = np.append(0.0, np.cumsum(run.rates.mean(axis=1) * np.diff(run.times, prepend=0.0)))
    rolling = np.sign(np.diff(np.interp(run.pose_times, np.append(0.0, run.times), rolled)))
    signed = np.append(0.0, np.cumsum(steps[:, 2] * rolling))
    bends: Array = np.diff(np.interp(np.arange(0.0, whole[-1], length), whole, signed))
    return bends


def expected_angles(robot: Robot, run: Trajectory) -> Array:
    """Angles (N,), rad, by which wheels must turn for the reference's motion, at least about."""
    every = max(1, round(0.5 / float(np.median(np.diff(run.pose_times)))))
    poses = run.poses[::every]
    steps = np.diff(poses, axis=0)
    middle = (poses[1:, 2] + poses[:-1, 2]) / 2
    cosine, sine = np.cos(middle), np.sin(middle)
    twists = np.column_stack(
        [cosine * steps[:, 0] + sine * steps[:, 1], -sine * steps[:, 0] + cosine * steps[:, 1], steps[:, 2]]
    )
    if robot.mount is not None:
        twists = twists @ np.linalg.inv(robot.mount.twist).T
    angles = []
    for wheel in robot.measured:
        x, y = wheel.position
        if wheel.has_steering:
            moved = np.hypot(twists[:, 0] - y * twists[:, 2], twists[:, 1] + x * twists[:, 2]) / wheel.radius
        else:
            moved = np.abs(twists @ wheel_equations([wheel])[0])
        moved[moved < 0.1] = 0.0  # rad in a step: noise of the reference
        angles.append(float(moved.sum()))
    return np.array(angles)


def _jumps(robot: Robot, runs: Sequence[Trajectory]) -> Iterator[Finding]:
    found, count = [], 0
    odometry = OdometryModel.of_design(robot, "arc").poses([run.log(run.pose_times) for run in runs])
    for run, driven in zip(runs, odometry, strict=True):
        jumps = reference_jumps(robot, driven, run.poses)
        if len(jumps):
            found.append(run.id)
            count += len(jumps)
    if found:
        yield Finding(
            kind="reference_jump",
            what=f"the reference jumps {plural(count, 'time')}, farther than the wheels drive",
            where=f"poses of {runs_in_words(found, len(runs))}",
            severity="error",
            changes={"jumps": "cut"},
        )


def _moving_starts(robot: Robot, runs: Sequence[Trajectory]) -> Iterator[Finding]:
    found = [run.id for run in runs if _starts_moving(robot, run)]
    if found:
        severity: Severity = "warning" if len(found) > len(runs) / 2 else "note"
        yield Finding(
            kind="not_at_rest",
            what=f"{plural(len(found), 'run')} {'begins' if len(found) == 1 else 'begin'} while the robot drives: the "
            "start pose is uncertain then, and what was driven before the first sample is lost",
            where=runs_in_words(found, len(runs)),
            severity=severity,
            fix="let the robot stand for a second at the begin of every run, with recording on",
        )


def _starts_moving(robot: Robot, run: Trajectory) -> bool:
    """True if wheels and reference move from the first sample on nearly as fast as they ever do, or as they go on."""
    edges, ways = np.append(0.0, run.times), _ways(robot, run)
    seen = np.append(
        0.0, np.cumsum(np.hypot(*np.diff(run.poses[:, :2], axis=0).T) + robot.reach * np.abs(np.diff(run.poses[:, 2])))
    )
    for stamps, way in ((edges, ways), (run.pose_times, seen)):
        moments = np.arange(stamps[0], stamps[-1], _BEGIN)
        speeds = np.diff(np.interp(moments, stamps, way))
        moving = speeds[speeds > 0.1 * speeds.max(initial=0.0)]
        if not len(moving):
            return False
        share = speeds[0] / float(np.median(moving))
        goes_on = speeds[0] >= _AT_ONCE * float(np.mean(speeds[: 1 + round(_NEXT / _BEGIN)]))
        if share < (_SLOWLY if goes_on else _MOVING):
            return False
    return True
