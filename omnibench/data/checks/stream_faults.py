"""Faults of the streams of runs: missing samples and poses, a standing reference, dead wheels, restarts, clocks.

A reference jumps where steps from pose to pose are explained neither by the wheels nor by its usual scatter. A SLAM
that closes a loop moves its poses at once, and motion capture that takes one marker for another turns or shifts them.
The odometry of the design model is wrong by a share of each step, in every step alike; a jump stands out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.data.checks.finding import Finding, Kind, Severity
from omnibench.data.checks.misreading import frozen_steering, wheels_in_words
from omnibench.data.clock_matching import ROUNDS, SEARCH, ClockMatch, Streams, Windows, fitted_together, match_clocks
from omnibench.data.dataset import Trajectory
from omnibench.data.stored_rows import MOST_DRAWN, drawn_runs, median_period
from omnibench.jobs.job import gathered
from omnibench.progress import Reporter
from omnibench.robot.kinematics import Array, Robot, relative, wheel_equations, wrapped
from omnibench.robot.model import OdometryModel
from omnibench.robot.stored_odometry import together, workers
from omnibench.words import plural, some

# A step is a jump if it differs from the odometry's by more than this, m and rad, and by more than the share of the
# way; chosen: above the scatter of motion capture and of matched scans, and the errors of a design.
_LEAST, _SHARE = (0.05, 0.1), 0.5
# It differs by so many times more than nearly all steps do (chosen); of fewer steps it cannot be said what is usual.
_TIMES, _NEARLY_ALL, _FEWEST_POSES = 4.0, 0.95, 20


def reference_jumps(robot: Robot, odometry: Array, poses: Array) -> NDArray[np.intp]:
    """Indices of the poses (K, 3) after which the reference jumps to the next one. odometry (K, 3): of the design."""
    if len(poses) <= _FEWEST_POSES:
        return np.empty(0, dtype=np.intp)
    driven, seen = relative(odometry[:-1], odometry[1:]), relative(poses[:-1], poses[1:])
    way = np.hypot(driven[:, 0], driven[:, 1]) + robot.reach * np.abs(driven[:, 2])
    position = np.hypot(*(seen - driven)[:, :2].T)
    heading = np.abs(wrapped((seen - driven)[:, 2]))
    jumps = np.zeros(len(position), dtype=bool)
    for steps, least, size in ((position, _LEAST[0], way), (heading, _LEAST[1], np.abs(driven[:, 2]))):
        usual = float(np.quantile(steps, _NEARLY_ALL))
        jumps |= steps > np.maximum(least + _SHARE * size, _TIMES * usual)
    return np.flatnonzero(jumps)


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


@dataclass(frozen=True, eq=False)
class Look:
    """Faults and motions that one run shows; those of its reference are None or 0 where it has no poses.

    fast: number of samples that are faster than any wheel turns. wheel_gaps, reference_gaps: lengths of what is missing
    while the robot drives, s. standing: s in which the reference stands while the wheels drive. counted, expected (N,):
    angles that the wheels count, and that the reference asks of them, rad. steering (2, S): least and largest angles,
    rad. bends: see ``_bends``. moves_at_once: wheels and reference move from the first sample on.
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


def stream_faults(robot: Robot, runs: Sequence[Trajectory]) -> Iterator[Finding]:
    """Faults of runs, of which those without poses have only their wheels looked at.

    Jumps of the reference are told by wheels that are read rightly.
    """
    posed = [run for run in runs if run.has_poses]
    of_wheels = median_period(runs)
    of_reference = float(np.median(np.concatenate([np.diff(run.pose_times) for run in posed]))) if posed else np.inf
    tasks = [(robot, part, of_wheels, of_reference) for part in together(runs)]
    looks = [look for part in gathered(workers(), looks_at, tasks) for look in part]
    yield from _restarts(looks)
    yield from _missing("wheel_dropout", of_wheels, {look.run: look.wheel_gaps for look in looks}, "wheel samples")
    looks = [look for run, look in zip(runs, looks, strict=True) if run.has_poses]
    if not looks:
        return
    gaps = {look.run: look.reference_gaps for look in looks}
    yield from _missing("reference_dropout", of_reference, gaps, "reference poses")
    frozen = {look.run: look.standing for look in looks if look.standing}
    yield from _frozen(posed, frozen)
    yield from _dead_wheels(robot, looks)
    yield from _frozen_steering(robot, looks)
    yield from _jumps(robot, [run for run in posed if run.id not in frozen])
    yield from _moving_starts(looks)


def looks_at(task: tuple[Robot, Sequence[Trajectory], float, float], _: Reporter) -> list[Look]:
    """The looks at some runs. The task: robot, runs, usual periods of wheel samples and of reference poses, s."""
    robot, runs, *periods = task
    matrix = robot.inverse_kinematic_matrix
    return [_look(robot, run, _ways(matrix, robot.reach, run), *periods) for run in runs]


def _look(robot: Robot, run: Trajectory, ways: Array, of_wheels: float, of_reference: float) -> Look:
    """The look at a run. ways (F + 1,): see ``_ways``. of_wheels, of_reference: usual periods, s."""
    fast = int((np.abs(run.rates) * robot.radii > _FASTEST).any(axis=1).sum())
    wheel_gaps = _gaps(robot, run, ways, np.append(0.0, run.times), of_wheels)
    if not run.has_poses:
        return Look(run.id, len(run.times), fast, wheel_gaps)
    return Look(
        run.id,
        len(run.times),
        fast,
        wheel_gaps,
        _gaps(robot, run, ways, run.pose_times, of_reference),
        _standing(robot, run, ways),
        np.abs(run.rates).T @ np.diff(run.times, prepend=0.0),
        _expected_angles(robot, run),
        None if run.steering is None else np.array([run.steering.min(axis=0), run.steering.max(axis=0)]),
        None if run.steering is None else _bends(robot, run),
        _moves_at_once(robot, run, ways),
    )


def runs_in_words(runs: Sequence[str], every: int) -> str:
    """``run x``, ``runs x, y``, or ``all runs``."""
    if len(runs) == every and every > 1:
        return "all runs"
    return f"run{'' if len(runs) == 1 else 's'} {some(list(runs), 5)}"


def _restarts(looks: Sequence[Look]) -> Iterator[Finding]:
    found = [look.run for look in looks if 0 < look.fast <= max(1.0, _RARE * look.samples)]
    if found:
        yield Finding(
            kind="counter_restart",
            what=f"single wheel rates of {plural(len(found), 'run')} are faster than any wheel turns, as where a "
            "counter begins again",
            where=runs_in_words(found, len(looks)),
            severity="error",
            fix="import the positions of the encoders, which are then counted on; or leave these runs out",
            changes={"leave_out": found},
        )


def _gaps(robot: Robot, run: Trajectory, ways: Array, times: Array, usual: float) -> tuple[float, ...]:
    """Lengths, s, of the gaps between times of samples or poses in which the robot drives. usual: their period, s."""
    spacings = np.diff(times)
    gaps = np.flatnonzero(spacings > max(_LEAST_GAP, _PERIODS * usual))
    driven = [gap for gap in gaps if _moved_about(robot, run, ways, times[gap], times[gap + 1]) > _DRIVEN]
    return tuple(spacings[driven].tolist())


def _missing(kind: Kind, usual: float, gaps: Mapping[str, Sequence[float]], what: str) -> Iterator[Finding]:
    """Samples or poses, ``what``, that are missing for long. gaps: their lengths, s, by run. usual: their period, s."""
    found = [run for run, of_run in gaps.items() if of_run]
    if found:
        lengths = [length for of_run in gaps.values() for length in of_run]
        longest = float(f"{max(2 * usual, 0.5 * min(lengths)):.2g}")
        yield Finding(
            kind=kind,
            what=f"{what} are missing {plural(len(lengths), 'time')} while the robot drives, for up to "
            f"{max(lengths):.1f} s; what it did then is not known",
            where=runs_in_words(found, len(gaps)),
            severity="error",
            changes={"longest_gap": longest},
        )


def _ways(matrix: Array, reach: float, run: Trajectory) -> Array:
    """Ways (F + 1,) that the wheels' design (3, M) drives up to each sample's end, m; turning counts at ``reach``."""
    twists = run.signals @ matrix.T
    speeds = np.hypot(twists[:, 0], twists[:, 1]) + reach * np.abs(twists[:, 2])
    return np.append(0.0, np.cumsum(speeds * np.diff(run.times, prepend=0.0)))


def _moved_about(robot: Robot, run: Trajectory, ways: Array, begin: float, end: float) -> float:
    """Way of the robot, m, between two times by the larger of wheels and reference."""
    wheels = np.interp([begin, end], np.append(0.0, run.times), ways)
    at = np.searchsorted(run.pose_times, [begin - 1e-9, end + 1e-9])
    first, last = max(int(at[0]) - 1, 0), min(int(at[1]), len(run.poses) - 1)
    moved = run.poses[last] - run.poses[first]
    seen = float(np.hypot(moved[0], moved[1]) + robot.reach * abs(moved[2]))
    return max(float(wheels[1] - wheels[0]), seen)


def _standing(robot: Robot, run: Trajectory, ways: Array) -> float:
    """Seconds in which the reference of a run stands, without even scattering, while its wheels drive."""
    changes = np.abs(np.diff(run.poses, axis=0)).max(axis=1) > _SAME
    edges = np.flatnonzero(np.concatenate([[True], changes, [True]]))  # bounds of stretches of equal poses
    first, last = edges[:-1], edges[1:] - 1
    seconds = run.pose_times[last] - run.pose_times[first]
    moved = run.poses[last] - run.poses[first]
    seen = np.hypot(moved[:, 0], moved[:, 1]) + robot.reach * np.abs(moved[:, 2])
    driven = np.interp(run.pose_times, np.append(0.0, run.times), ways)
    wheels = driven[last] - driven[first]
    long = seconds >= max(_STANDING, 3 * float(np.median(np.diff(run.pose_times))))
    still = long & (wheels > _DRIVEN) & (seen < _STILL * wheels)
    return float(seconds[still].sum())


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


def _dead_wheels(robot: Robot, looks: Sequence[Look]) -> Iterator[Finding]:
    """Wheels that count nothing though the reference shows that they turn."""
    dead: dict[str, list[str]] = {}
    counts = np.zeros(len(robot.wheel_names), dtype=bool)
    for look in looks:
        assert look.expected is not None  # it has poses
        assert look.counted is not None
        # Shares of the wheel that moves most, so that units which are misread do not matter.
        still = look.counted <= _DEAD * look.counted.max()
        counts |= ~still
        still &= look.expected > max(_EXPECTED, _ASKED * look.expected.max())
        if still.all() and len(still) > 1:
            continue  # a reference that moves by itself is told otherwise
        for name, is_dead in zip(robot.wheel_names, still.tolist(), strict=True):
            if is_dead:
                dead.setdefault(name, []).append(look.run)
    for name, names in dead.items():
        every = len(names) > 0.8 * len(looks) or not counts[robot.wheel_names.index(name)]
        where = wheels_in_words([name])
        at = "" if every else f" in {runs_in_words(names, len(looks))}"
        yield Finding(
            kind="wheel_dead",
            what=f"{where} never turns{at}, though the reference shows that it must: its encoder or column is dead",
            where=where if every else f"{where} in {runs_in_words(names, len(looks))}",
            severity="error",
            fix="check its cable and the column that is read, and record again" if every else "",
            changes={} if every else {"leave_out": names},
        )


def _frozen_steering(robot: Robot, looks: Sequence[Look]) -> Iterator[Finding]:
    """Steering angles that never change though the robot's turns do."""
    ends = [look.steering for look in looks if look.steering is not None]
    if not ends:
        return
    spans = np.max([most for _, most in ends], axis=0) - np.min([least for least, _ in ends], axis=0)
    bends = np.concatenate([look.bends for look in looks if look.bends is not None])
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


def _expected_angles(robot: Robot, run: Trajectory) -> Array:
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


def _moving_starts(looks: Sequence[Look]) -> Iterator[Finding]:
    found = [look.run for look in looks if look.moves_at_once]
    if found:
        severity: Severity = "warning" if len(found) > len(looks) / 2 else "note"
        yield Finding(
            kind="not_at_rest",
            what=f"{plural(len(found), 'run')} {'begins' if len(found) == 1 else 'begin'} while the robot drives: the "
            "start pose is uncertain then, and what was driven before the first sample is lost",
            where=runs_in_words(found, len(looks)),
            severity=severity,
            fix="let the robot stand for a second at the begin of every run, with recording on",
        )


def _moves_at_once(robot: Robot, run: Trajectory, ways: Array) -> bool:
    """True if wheels and reference move from the first sample on nearly as fast as they ever do, or as they go on."""
    edges = np.append(0.0, run.times)
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


# A clock is reported that is off by at least so many s and so many standard errors (chosen: simulated runs, whose
# clocks are right, are below); from _SPOILS, s, on it spoils a fit.
_LEAST_OFF, _ERRORS, _SPOILS = 0.05, 4.0, 0.15
# Runs up to which so many errors hold; ten times as many runs need as many errors again, as one of them is farther off
# by chance (chosen: the farthest of 333, 1,665 and 6,660 simulated runs, whose clocks are right, are 4.2, 6.0 and 7.4
# errors off: about 2.5 errors more for ten times as many runs).
_USUAL = 500

_TOGETHER = 600_000  # wheel samples of the runs by which coefficients of very many are found: 100 of a minute (chosen)


def clocks_of(robot: Robot, runs: Sequence[Trajectory]) -> list[ClockMatch | None]:
    """The clock of every run's reference; None where it does not show.

    Of very many runs those that chance has drawn tell what all have in common, and then each is matched by itself.
    """
    if sum(len(run.times) for run in runs) <= MOST_DRAWN:
        return match_clocks(robot, [Streams.of_run(run) for run in runs])
    drawn = (Windows.of(robot, Streams.of_run(run)) for run in drawn_runs(runs, _TOGETHER))
    usable = [windows for windows in drawn if windows is not None]
    if not usable:
        return [None] * len(runs)
    fitted, _ = fitted_together(usable, SEARCH)
    tasks = [(robot, part, fitted) for part in together(runs)]
    return [clock for part in gathered(workers(), clocks_of_part, tasks) for clock in part]


def clocks_of_part(task: tuple[Robot, Sequence[Trajectory], Sequence[Array]], _: Reporter) -> list[ClockMatch | None]:
    """The clocks of some runs, of which the task names the robot, the runs and the coefficients."""
    robot, runs, fitted = task
    return [_matched(Windows.of(robot, Streams.of_run(run)), fitted) for run in runs]


def _matched(windows: Windows | None, fitted: Sequence[Array]) -> ClockMatch | None:
    """The clock by which a run fits given coefficients best; None where it does not show."""
    if windows is None:
        return None
    return windows.match(fitted, windows.improved(fitted, windows.scanned(SEARCH, fitted), ROUNDS), SEARCH)


def clock_findings(runs: Sequence[Trajectory], clocks: Sequence[ClockMatch | None]) -> Iterator[Finding]:
    """Offsets and drifts that stand out of their errors."""
    offset, drift = [], []
    errors = _ERRORS * max(1.0, 1.0 + math.log10(max(len(runs), 1) / _USUAL))
    for run, clock in zip(runs, clocks, strict=True):
        if clock is None:
            continue
        if abs(clock.middle) > max(_LEAST_OFF, errors * clock.middle_error):
            offset.append((run.id, clock.middle))
        gone = clock.drift * clock.length
        if abs(gone) > max(_LEAST_OFF, errors * clock.drift_error * clock.length):
            drift.append((run.id, gone))
    for kind, found in (("clock_offset", offset), ("clock_drift", drift)):
        if not found:
            continue
        names, values = [name for name, _ in found], np.array([value for _, value in found])
        largest = float(values[np.abs(values).argmax()])
        severity: Severity = "error" if abs(largest) > _SPOILS else "warning"
        if kind == "clock_offset":
            what = f"the stamps of the reference are {_off(values)} in {_count(found, runs)}"
        else:
            slow = "slow" if largest > 0 else "fast"
            what = (
                f"the reference's clock goes too {slow}, by up to {abs(largest):.2f} s a run, in {_count(found, runs)}"
            )
        yield Finding.model_validate(
            {
                "kind": kind,
                "what": what,
                "where": runs_in_words(names, len(runs)) if len(names) < len(runs) else "the reference",
                "severity": severity,
                "changes": {"clocks": "match"},
            }
        )


def _off(values: Array) -> str:
    """Offsets in words: the largest one, or the largest to either side."""
    ways = [f"{size:.2f} s too {way}" for way, size in (("late", -values.min()), ("early", values.max())) if size > 0]
    return " to ".join(ways) if len(ways) > 1 else f"up to {ways[0]}"


def _count(found: Sequence[object], runs: Sequence[Trajectory]) -> str:
    return "every run" if len(found) == len(runs) else f"{len(found)} of {len(runs)} runs"
