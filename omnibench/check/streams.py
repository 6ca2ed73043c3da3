"""Faults of the streams of runs: missing samples and poses, a standing reference, dead wheels, restarts, jumps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from xxhash import xxh3_64_intdigest

from omnibench.check.hypotheses import mistake, wheels_in_words
from omnibench.check.motion_fit import FreeFit, Windows
from omnibench.data.dataset import Trajectory
from omnibench.data.finding import Finding, Kind, Severity
from omnibench.data.jumps import reference_jumps
from omnibench.data.stored import median_period
from omnibench.jobs.job import gathered
from omnibench.progress import Reporter
from omnibench.robot.kinematics import Array, Robot, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.stored_odometry import together, workers
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
_UNEXPLAINED = 0.3  # share of a run's motion that the matrix of all runs leaves where an encoder is dead; chosen
# Counts that never fall: share of the windows in which they may, and in which the reference must ask for either sense;
# correlation of their sizes; chosen.
_HARDLY, _BOTH, _ALIKE = 0.005, 0.08, 0.9
# s of a run's begin, and share of its usual speed above which wheels and reference do not begin at rest (chosen: real
# robots that start from rest reach up to 0.32).
_BEGIN, _MOVING = 0.12, 0.35
# A robot that goes on slowly does not begin at rest, either: share of its usual speed, and of that over the next second
# (chosen: a Robotino from rest has up to 0.34 of the latter, and no run of five robots is told that was not before).
_SLOWLY, _AT_ONCE, _NEXT = 0.2, 0.5, 1.0
# Steps, of so many times the robot's size, that are needed, and spread of the turns over them, rad, that one angle
# cannot give: that of circles seven times as wide as the robot is long and of straight lines; chosen.
_FEWEST, _STEP, _BENDS = 5, 3.0, 0.3
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


def looks_of(robot: Robot, runs: Sequence[Trajectory]) -> list[Look]:
    """The looks at runs, of which those without poses have only their wheels looked at."""
    posed = [run for run in runs if run.has_poses]
    of_wheels = median_period(runs)
    of_reference = float(np.median(np.concatenate([np.diff(run.pose_times) for run in posed]))) if posed else np.inf
    tasks = [(robot, part, of_wheels, of_reference) for part in together(runs)]
    return [look for part in gathered(workers(), looks_at, tasks) for look in part]


def wheel_faults(runs: Sequence[Trajectory], looks: Sequence[Look]) -> Iterator[Finding]:
    """Samples of wheels that are missing, or faster than any wheel turns."""
    yield from _restarts(looks)
    gaps = {look.run: look.wheel_gaps for look in looks}
    yield from _missing("wheel_dropout", median_period(runs), gaps, "wheel samples")


def reference_faults(runs: Sequence[Trajectory], looks: Sequence[Look]) -> Iterator[Finding]:
    """Poses that are missing, or stand, of runs that have some; and runs that begin in motion."""
    if not runs:
        return
    period = float(np.median(np.concatenate([np.diff(run.pose_times) for run in runs])))
    yield from _missing(
        "reference_dropout", period, {look.run: look.reference_gaps for look in looks}, "reference poses"
    )
    yield from _frozen(runs, {look.run: look.standing for look in looks if look.standing})
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


def dead_wheels(robot: Robot, looks: Sequence[Look], windows: Windows | None, fit: FreeFit | None) -> Iterator[Finding]:
    """Wheels that count nothing though the reference shows that they turn: in the whole recording, or in some runs.

    A run in which a wheel counts nothing has a dead encoder if the matrix of all runs does not explain its motion.
    """
    counted = np.array([look.counted for look in looks])  # (R, N), rad
    expected = np.array([look.expected for look in looks])
    # Shares of the wheel that moves most, so that units which are misread do not matter.
    still = counted <= _DEAD * counted.max(axis=1, keepdims=True)
    asked = expected > np.maximum(_EXPECTED, _ASKED * expected.max(axis=1, keepdims=True))
    lost = np.zeros(len(looks))
    if windows is not None and fit is not None:
        off = np.abs(windows.moved - windows.bent @ (fit.matrix[0] + 1j * fit.matrix[1]))
        off = off + robot.reach * np.abs(windows.turned - windows.driven @ fit.matrix[2])
        whole = np.abs(windows.moved) + robot.reach * np.abs(windows.turned)
        sums = [np.bincount(windows.run, each, len(looks)) for each in (off, whole)]
        lost = sums[0] / np.maximum(sums[1], 1e-9)
    for index, name in enumerate(robot.wheel_names):
        where, dead = wheels_in_words([name]), still[:, index] & asked[:, index] & ~still.all(axis=1)
        if still[~still.all(axis=1), index].all() and dead.mean() > 0.5:
            what = f"{where} never turns, though the reference shows that it must: its encoder or column is dead"
            fix = "check its cable and the column that is read, and record again"
            yield Finding(kind="wheel_dead", what=what, where=where, severity="error", fix=fix)
        elif (dead := dead & (lost > _UNEXPLAINED) & (lost > 2 * np.median(lost))).any():
            runs = [look.run for look, is_dead in zip(looks, dead.tolist(), strict=True) if is_dead]
            at = runs_in_words(runs, len(looks))
            what = (
                f"{where} never turns in {at}, though the reference shows that it must: its encoder or column is dead"
            )
            yield mistake("wheel_dead", what, f"{where} in {at}", {"leave_out": runs})


def unsigned_counts(robot: Robot, windows: Windows | None, runs: Sequence[Trajectory]) -> Iterator[Finding]:
    """Counts that never fall though the reference shows that wheels turn back, as of encoders with one channel."""
    if windows is None or not robot.drive.direct:
        return
    moved = windows.moved * np.exp(-0.5j * windows.turned)
    expected = np.column_stack([moved.real, moved.imag, windows.turned]) @ robot.signal_equations.T
    usual = 0.1 * np.abs(expected).max(axis=0)
    back = (expected < -usual) & (np.abs(windows.driven) > 0)
    single = []
    for index, name in enumerate(robot.wheel_names):
        counts = windows.driven[:, index]
        falls = min((counts < 0).mean(), (counts > 0).mean())
        both = min(back[:, index].mean(), (expected[:, index] > usual[index]).mean())
        if falls < _HARDLY and both > _BOTH and np.corrcoef(np.abs(expected[:, index]), np.abs(counts))[0, 1] > _ALIKE:
            single.append(name)
    if single:
        reversing = np.bincount(
            windows.run, back[:, [robot.wheel_names.index(name) for name in single]].any(axis=1), len(runs)
        )
        names = [run.id for run, count in zip(runs, reversing.tolist(), strict=True) if count > 1]
        where = wheels_in_words(single)
        what = f"the counts of {where} never fall, though the reference shows that the robot reverses: do its encoders "
        what += "have one channel, which counts up whichever way a wheel turns?"
        yield Finding(
            kind="wheel_unsigned",
            what=what,
            where=where,
            severity="error",
            fix="read both channels of the encoders, or leave out the runs in which wheels turn back",
            changes={"leave_out": names} if len(names) < len(runs) else {},
        )


def frozen_steering(robot: Robot, looks: Sequence[Look]) -> Iterator[Finding]:
    """Steering angles that never change though the robot's turns do."""
    ends = [look.steering for look in looks if look.steering is not None]
    if not ends:
        return
    spans = np.max([most for _, most in ends], axis=0) - np.min([least for least, _ in ends], axis=0)
    bends = np.concatenate([look.bends for look in looks if look.bends is not None])
    if len(bends) < _FEWEST or np.subtract(*np.quantile(bends, [0.9, 0.1])) < _BENDS:
        return
    for name in [name for name, span in zip(robot.drive.steered, spans.tolist(), strict=True) if span < _SAME]:
        where = f"steering of wheel {name}"
        yield Finding(
            kind="steering_frozen",
            what=f"the steering angle of wheel {name} never changes, though the reference shows that it must",
            where=where,
            severity="error",
            fix=f"read the column or topic that holds the angle of wheel {name} (steering_columns; of bags "
            "steering_joints or steering_topic), or record it, and import again",
        )


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


def jump_findings(robot: Robot, runs: Sequence[Trajectory]) -> Iterator[Finding]:
    """Poses that jump off the motion that wheels tell and return, and shifts of the reference that last."""
    lone, shifts, counts = list[str](), list[str](), [0, 0]
    odometry = OdometryModel.of_design(robot, "arc").poses([run.log(run.pose_times) for run in runs])
    for run, driven in zip(runs, odometry, strict=True):
        jumps = reference_jumps(robot, driven, run.poses)
        lone += [run.id] if len(jumps.lone) else []
        shifts += [run.id] if len(jumps.shifts) else []
        counts = [counts[0] + len(jumps.lone), counts[1] + len(jumps.shifts)]
    if shifts:
        beside = f", and {plural(counts[0], 'lone pose')} jump and return" if lone else ""
        what = f"the reference jumps {plural(counts[1], 'time')} for good, farther than the wheels drive{beside}"
        where = f"poses of {runs_in_words(list(dict.fromkeys([*shifts, *lone])), len(runs))}"
        yield mistake("reference_jump", what, where, {"jumps": "cut"})
    elif lone:
        share = counts[0] / sum(len(run.poses) for run in runs)
        what = (
            f"{plural(counts[0], 'pose')} of the reference, {share:.1%}, jump and return, farther than the wheels drive"
        )
        what += "; jumps=drop leaves them out (or keep them: calibrate --loss huber)"
        yield mistake("reference_jump", what, f"poses of {runs_in_words(lone, len(runs))}", {"jumps": "drop"})


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


# Poses in a row that two runs must share, changes among them, and share of the later run's rows (chosen: a reference
# scatters, so that no two drives share any; wheel rates as commanded are alike in all repetitions).
_ROWS, _CHANGES, _SHARED = 12, 8, 0.3
_MOST_KEYS = 2_000_000  # stretches of poses that are kept, some 0.2 GB; of more every second, or third... (chosen)
_DIGIT = 1e-7  # m, to which positions are compared; below the noise of any reference


def copied_runs(runs: Sequence[Trajectory]) -> Iterator[Finding]:
    """Runs that repeat an earlier one."""
    every = -(-sum(len(run.pose_times) for run in runs) // _MOST_KEYS)
    seen: dict[int, str] = {}
    copies: dict[str, str] = {}
    for run in runs:
        keys = {key for key in _keys(run) if key % every == 0}
        shared = [seen[key] for key in keys if key in seen]
        if keys and len(shared) > _SHARED * len(keys):
            copies[run.id] = max(set(shared), key=shared.count)
        else:
            seen.update(dict.fromkeys(keys, run.id))
    if copies:
        first = next(iter(copies.items()))
        yield Finding(
            kind="copies",
            what=f"{plural(len(copies), 'run')} {'repeats' if len(copies) == 1 else 'repeat'} the poses of "
            f"others, as {first[0]} those of {first[1]}: what validates then was trained on",
            where=runs_in_words(list(copies), len(runs)),
            severity="error",
            changes={"leave_out": list(copies)},
        )


def _keys(run: Trajectory) -> Iterator[int]:
    """Digests of every stretch of reference positions that change often enough."""
    rounded = np.round(run.poses[:, :2] / _DIGIT).astype(np.int64)
    changes = np.append(0, np.cumsum(np.any(np.diff(rounded, axis=0) != 0, axis=1)))
    for row in range(len(rounded) - _ROWS + 1):
        if changes[row + _ROWS - 1] - changes[row] >= _CHANGES:
            yield xxh3_64_intdigest(rounded[row : row + _ROWS].tobytes())
