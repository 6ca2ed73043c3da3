"""Faults of a recording's streams: missing samples and poses, dead wheels, restarts, jumps, clocks, copies.

Each detector takes the evidence of a recording and gives findings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import polars as pl
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from omnibench.check.evidence import SAME, Evidence, looks_of, pose_period
from omnibench.check.hypotheses import POSITION_UNITS, another_zero, wheels_in_words
from omnibench.data.dataset import Trajectory
from omnibench.data.finding import CounterRestart, Finding, Kind, Severity, error
from omnibench.data.references import KINDS, UNITS, ReferenceKind
from omnibench.data.spoiled_references import follows_the_wheels, reference_jumps
from omnibench.data.stored import count_drawn, drawn_runs, median_period
from omnibench.robot.kinematics import CarDrive
from omnibench.robot.model import OdometryModel
from omnibench.words import plural, some

_MOST_NOTES = 3  # notes on restarts of counters that are shown one by one; chosen
_MOSTLY = 0.25  # share of a run for which a reference stands, from which on it counts as frozen; chosen
_RARE = 0.02  # share of the samples: more that are too fast are another unit
# Share of the angle of the wheel that turns most, up to which one is dead; angle, rad, and share of the largest, that
# the reference must ask of it (chosen).
_DEAD, _EXPECTED, _ASKED = 0.002, 3.0, 0.25
# Share of a run's motion that the matrix of other runs leaves where an encoder is dead, and times what it usually
# leaves; chosen: one of four dead wheels leaves 0.23 of a real run, of which 0.03 is usual.
_UNEXPLAINED, _UNUSUAL = 0.15, 4.0
# Counts that never fall: share of the windows in which they may, and in which the reference must ask for either sense;
# correlation of their sizes; chosen.
_HARDLY, _BOTH, _ALIKE = 0.005, 0.08, 0.9
# A steering angle that never changes is frozen if the reference's turns spread by more than this, rad, over steps of
# three times the robot's size, of which there must be some (chosen: straight lines and a circle seven times as wide as
# the robot is long spread by as much).
_BENDS, _FEWEST = 0.3, 5
# Zeros of a car's steering that are reported, rad and standard errors (chosen: simulated cars without one are below);
# beyond the most the angle is no small one, and another mistake.
_LEAST_ZERO, _ZERO_ERRORS, _MOST_ZERO = math.radians(1.0), 5.0, math.radians(15.0)
# A clock is reported that is off by at least so many s and by more than chance: Student's t as rare as so many standard
# errors of a normal distribution (chosen: simulated runs, whose clocks are right, are below). From _SPOILS, s, on it
# spoils a fit.
_LEAST_OFF, _ERRORS, _SPOILS = 0.05, 4.0, 0.15
# Runs up to which so many errors hold; ten times as many runs need as many errors again, as one of them is farther off
# by chance (chosen: the farthest of 333, 1,665 and 6,660 simulated runs, whose clocks are right, are 4.2, 6.0 and 7.4
# errors off: about 2.5 errors more for ten times as many runs).
_USUAL = 500
# Poses in a row that two runs must share, changes among them, and share of the later run's rows (chosen: a reference
# scatters, so that no two drives share any; wheel rates as commanded are alike in all repetitions).
_ROWS, _CHANGES, _SHARED = 12, 8, 0.3
_MOST_KEYS = 500_000  # stretches of poses that are kept, some 50 MB; of more every second, or third... (chosen)
_DIGIT = 1e-7  # m, to which positions are compared; below the noise of any reference
_REACHED = 0.05  # share of a run's time after which its last pose comes at least; chosen
# Share of the squares of the whole runs' turns that the best matrix does not explain: at most 0.005 on OptiOdom's
# recordings, and 0.68 to 1.45 where the poses of each run were given to one of another command.
_FOREIGN = 0.25
_TURNED = 0.5  # rad, root mean square of the runs' turns: less of it tells nothing; chosen
_FEWEST_RUNS = 3  # runs whose turns a matrix of a few numbers cannot all follow; chosen
# How many times too large references in another unit are, and that unit; and the option that says so.
_FACTORS = {"m": POSITION_UNITS, "rad": ((float(np.degrees(1)), "deg"),)}
_OPTIONS: dict[str, Kind] = {"m": "position_unit", "rad": "heading_unit"}
_NEAR = 1.5  # a ratio to the odometry within this factor of a unit's is that unit; chosen: designs are off by less
_LEAST = {"m": 0.02, "rad": 0.05}  # m, rad: motions that are smaller tell nothing of a unit; chosen


def runs_in_words(runs: Sequence[str], every: int) -> str:
    """``run x``, ``runs x, y``, or ``all runs``."""
    if len(runs) == every and every > 1:
        return "all runs"
    return f"run{'' if len(runs) == 1 else 's'} {some(list(runs), 5)}"


def notes(evidence: Evidence) -> Iterator[Finding]:
    """Restarts of counters that the importer has mended, and a note where not all runs are looked at together."""
    restarts = [warning for warning in evidence.dataset.warnings if isinstance(warning, CounterRestart)]
    if restarts:
        what = "; ".join(restarts[:_MOST_NOTES])
        what += f"; and {len(restarts) - _MOST_NOTES} more such notes" if len(restarts) > _MOST_NOTES else ""
        fix = "nothing: the import has mended it"
        yield Finding(kind="counter_restart", what=what, where="all wheels", severity="note", fix=fix)
    runs = evidence.dataset.trajectories
    if (count := count_drawn(runs)) < len(runs):
        what = f"what concerns the recording as a whole is judged by {count:,} of {len(runs):,} runs, which chance "
        what += "has drawn, some of every session and command first; every run by itself is looked at"
        fix = "nothing: so many tell as much as all"
        yield Finding(kind="runs_drawn", what=what, where="the recording", severity="note", fix=fix)


def own_odometry(evidence: Evidence) -> Iterator[Finding]:
    """A reference that is the robot's own odometry."""
    if evidence.dataset.simulated or (residual := follows_the_wheels(drawn_runs(evidence.runs))) is None:
        return
    what = "the reference is the robot's own odometry, or simulated without noise: some matrix makes its headings of "
    what += f"the wheels to {residual:.1g} rad a second, and nothing can be learnt from it"
    fix = "record an independent reference, such as motion capture, SLAM, or a tape measure (omnibench guide data)"
    yield error("reference_is_odometry", what, "the reference", fix=fix)


def wheel_faults(evidence: Evidence) -> Iterator[Finding]:
    """Samples of wheels that are missing, or faster than any wheel turns; also of runs without poses."""
    sparse = [run for run in evidence.dataset.trajectories if not run.has_poses]
    looks = evidence.looks + (looks_of(evidence.dataset.robot, sparse) if sparse else [])
    if fast := [look.run for look in looks if 0 < look.fast <= max(1.0, _RARE * look.samples)]:
        what = f"single wheel rates of {plural(len(fast), 'run')} are faster than any wheel turns, as where a "
        what += "counter begins again"
        fix = "import the positions of the encoders, which are then counted on; or leave these runs out"
        yield error("counter_restart", what, runs_in_words(fast, len(looks)), {"leave_out": fast}, fix=fix)
    period = median_period([*evidence.aligned, *sparse])
    yield from _missing("wheel_dropout", period, {look.run: look.wheel_gaps for look in looks}, "wheel samples")


def reference_faults(evidence: Evidence) -> Iterator[Finding]:
    """Poses that are missing, or stand, of runs that have some; and runs that begin in motion."""
    runs, looks, count = evidence.aligned, evidence.looks, len(evidence.aligned)
    if not runs:
        return
    gaps = {look.run: look.reference_gaps for look in looks}
    yield from _missing("reference_dropout", pose_period(runs), gaps, "reference poses")
    frozen = {look.run: look.standing for look in looks if look.standing}
    long = [run.id for run in runs if frozen.get(run.id, 0.0) > _MOSTLY * float(run.pose_times[-1])]
    short = [run for run in frozen if run not in long]
    if long:
        what = f"the reference stands still for up to {max(frozen[run] for run in long):.1f} s while wheels drive"
        if len(long) == count:
            fix = "in every run: check its tracking, and record again"
            yield error("reference_frozen", what, "the reference", fix=fix)
        else:
            yield error("reference_frozen", what, runs_in_words(long, count), {"leave_out": long})
    if short:
        what = f"the reference repeats a pose for up to {max(frozen[run] for run in short):.1f} s while the wheels "
        what += "drive, as where its tracking was lost"
        yield error("reference_dropout", what, runs_in_words(short, count), {"leave_out": short})
    if moving := [look.run for look in looks if look.moves_at_once]:
        what = f"{plural(len(moving), 'run')} {'begins' if len(moving) == 1 else 'begin'} while the robot drives: the "
        what += "start pose is uncertain then, and what was driven before the first sample is lost"
        severity: Severity = "warning" if len(moving) > count / 2 else "note"
        where = runs_in_words(moving, count)
        fix = "let the robot stand for a second at the beginning of every run, with recording on"
        yield Finding(kind="not_at_rest", what=what, where=where, severity=severity, fix=fix)


def _missing(kind: Kind, usual: float, gaps: Mapping[str, Sequence[float]], what: str) -> Iterator[Finding]:
    """Samples or poses, ``what``, that are missing for long. gaps: their lengths, s, by run. usual: their period, s."""
    if lengths := [length for of_run in gaps.values() for length in of_run]:
        where = runs_in_words([run for run, of_run in gaps.items() if of_run], len(gaps))
        longest = float(f"{max(2 * usual, 0.5 * min(lengths)):.2g}")
        what += f" are missing {plural(len(lengths), 'time')} while the robot drives, for up to {max(lengths):.1f} s"
        yield error(kind, f"{what}; what it did then is not known", where, {"longest_gap": longest})


def dead_sensors(evidence: Evidence) -> Iterator[Finding]:
    """Wheels and steering angles that do not follow the motion that the reference shows, whatever the units."""
    if evidence.looks:
        yield from _dead_wheels(evidence)
        yield from _frozen_steering(evidence)
        yield from _unsigned_counts(evidence)


def _dead_wheels(evidence: Evidence) -> Iterator[Finding]:
    """Wheels that count nothing though the reference shows that they turn: in the whole recording, or in some runs.

    A run in which a wheel counts nothing has a dead encoder if the matrix of the others does not explain its motion.
    """
    robot, looks, windows = evidence.dataset.robot, evidence.looks, evidence.windows
    counted = np.array([look.counted for look in looks])  # (R, N), rad
    expected = np.array([look.expected for look in looks])
    # Shares of the wheel that moves most, so that units which are misread do not matter.
    still = counted <= _DEAD * counted.max(axis=1, keepdims=True)
    asked = expected > np.maximum(_EXPECTED, _ASKED * expected.max(axis=1, keepdims=True))
    # Runs in which none of several wheels turns, beside others.
    idle = still.all(axis=1) & ~still.all() & (len(robot.wheel_names) > 1)
    why = "though the reference shows that it must: its encoder or column is dead"
    for index, name in enumerate(robot.wheel_names):
        where, dead = wheels_in_words([name]), still[:, index] & asked[:, index] & ~idle
        if still[~idle, index].all() and dead.mean() > 0.5:
            fix = "check its cable and the column that is read, and record again"
            yield error("wheel_dead", f"{where} never turns, {why}", where, fix=fix)
        elif dead.any() and windows is not None:
            lost = windows.unexplained(windows.only(~dead[windows.run]).fit(robot.reach), robot.reach, len(looks))
            if (dead := dead & (lost > np.maximum(_UNEXPLAINED, _UNUSUAL * np.median(lost)))).any():
                runs = [looks[number].run for number in np.flatnonzero(dead).tolist()]
                at = runs_in_words(runs, len(looks))
                what = f"{where} never turns in {at}, {why}"
                yield error("wheel_dead", what, f"{where} in {at}", {"leave_out": runs})


def _frozen_steering(evidence: Evidence) -> Iterator[Finding]:
    """Steering angles that never change though the robot's turns do."""
    ends = [look.steering for look in evidence.looks if look.steering is not None]
    if not ends:
        return
    spans = np.max([most for _, most in ends], axis=0) - np.min([least for least, _ in ends], axis=0)
    bends = np.concatenate([look.bends for look in evidence.looks if look.bends is not None])
    if len(bends) < _FEWEST or np.subtract(*np.quantile(bends, [0.9, 0.1])) < _BENDS:
        return
    for name, span in zip(evidence.dataset.robot.drive.steered, spans.tolist(), strict=True):
        if span < SAME:
            what = f"the steering angle of wheel {name} never changes, though the reference shows that it must"
            fix = f"read the column or topic that holds the angle of wheel {name} (steering_columns; of bags "
            fix += "steering_joints or steering_topic), or record it, and import again"
            yield error("steering_frozen", what, f"steering of wheel {name}", fix=fix)


def steering_zero(evidence: Evidence) -> Iterator[Finding]:
    """A car's steering that is not straight ahead at 0, which no inverse kinematic matrix can hold."""
    robot, windows = evidence.dataset.robot, evidence.windows
    if not isinstance(robot.drive, CarDrive) or windows is None or not windows.driven[:, 1].any():
        return
    zero, deviation = windows.steering_zero()
    if abs(zero) > max(_LEAST_ZERO, _ZERO_ERRORS * deviation) and abs(zero) < _MOST_ZERO:
        finding = another_zero(robot, np.ones(len(robot.drive.steered)), round(math.degrees(zero), 1))
        what = f"{finding.what} (or leave the recording as it is, and fit the zero: calibrate --steering fit)"
        yield finding.model_copy(update={"what": what, "severity": "warning"})


def _unsigned_counts(evidence: Evidence) -> Iterator[Finding]:
    """Counts that never fall though the reference shows that wheels turn back, as of encoders with one channel."""
    robot, windows, runs = evidence.dataset.robot, evidence.windows, evidence.aligned
    if windows is None or not robot.drive.direct:
        return
    moved = windows.moved * np.exp(-0.5j * windows.turned)
    expected = np.column_stack([moved.real, moved.imag, windows.turned]) @ robot.signal_equations.T
    usual = 0.1 * np.abs(expected).max(axis=0)
    back = (expected < -usual) & (windows.driven != 0)
    turned = np.abs(windows.driven)
    falls = np.minimum((windows.driven < 0).mean(axis=0), (windows.driven > 0).mean(axis=0))
    both = np.minimum(back.mean(axis=0), (expected > usual).mean(axis=0))
    single = [
        index
        for index in np.flatnonzero((falls < _HARDLY) & (both > _BOTH)).tolist()
        if np.corrcoef(np.abs(expected[:, index]), turned[:, index])[0, 1] > _ALIKE
    ]
    if single:
        reversing = np.bincount(windows.run, back[:, single].any(axis=1), len(runs))
        names = [runs[number].id for number in np.flatnonzero(reversing > 1).tolist()]
        where = wheels_in_words([robot.wheel_names[index] for index in single])
        what = f"the counts of {where} never fall, though the reference shows that the robot reverses: do its encoders "
        what += "have one channel, which counts up whichever way a wheel turns?"
        fix = "read both channels of the encoders, or leave out the runs in which wheels turn back"
        yield error("wheel_unsigned", what, where, {"leave_out": names} if len(names) < len(runs) else {}, fix=fix)


def jumps(evidence: Evidence) -> Iterator[Finding]:
    """Poses that jump off the motion that wheels tell and return, and shifts of the reference that last."""
    robot, standing = evidence.dataset.robot, {look.run for look in evidence.looks if look.standing}
    runs = [run for run in evidence.aligned if run.id not in standing]
    found = {run.id: reference_jumps(robot, run.log(run.pose_times), run.poses) for run in runs}
    lone, shifts = ([run for run, each in found.items() if len(each[kind])] for kind in (0, 1))
    poses = sum(len(of_run) for of_run, _ in found.values())
    if shifts:
        beside = f", and {plural(poses, 'lone pose')} jump and return" if lone else ""
        count = plural(sum(len(of_run) for _, of_run in found.values()), "time")
        what = f"the reference jumps {count} for good, farther than the wheels drive{beside}"
        where = f"poses of {runs_in_words(list(dict.fromkeys([*shifts, *lone])), len(runs))}"
        yield error("reference_jump", what, where, {"jumps": "cut"})
    elif lone:
        share = poses / sum(len(run.poses) for run in runs)
        what = f"{plural(poses, 'pose')} of the reference, {share:.1%}, jump and return, farther than the wheels drive"
        what += "; jumps=drop leaves them out (or keep them: calibrate --loss huber)"
        yield error("reference_jump", what, f"poses of {runs_in_words(lone, len(runs))}", {"jumps": "drop"})


def clocks(evidence: Evidence) -> Iterator[Finding]:
    """Offsets and drifts of the reference's clocks that stand out of their errors."""
    count = len(evidence.runs)
    errors = _ERRORS * max(1.0, 1.0 + math.log10(max(count, 1) / _USUAL))
    offset, drift = dict[str, float](), dict[str, float]()  # s, of the runs
    for run, clock in zip(evidence.runs, evidence.clocks, strict=True):
        if clock is None:
            continue
        quantile = float(stdtrit(clock.freedom, ndtr(errors)))
        if abs(clock.middle) > max(_LEAST_OFF, quantile * clock.middle_error):
            offset[run.id] = clock.middle
        gone = clock.drift * clock.length
        if abs(gone) > max(_LEAST_OFF, quantile * clock.drift_error * clock.length):
            drift[run.id] = gone
    kinds: tuple[tuple[Kind, dict[str, float]], ...] = (("clock_offset", offset), ("clock_drift", drift))
    for kind, seconds in kinds:
        if not seconds:
            continue
        least, most = min(seconds.values()), max(seconds.values())
        size, every = max(-least, most), len(seconds) == count
        among = "every run" if every else f"{len(seconds)} of {count} runs"
        if kind == "clock_offset":
            ways = [f"{off:.2f} s too {way}" for way, off in (("late", -least), ("early", most)) if off > 0]
            what = f"the stamps of the reference are {' to '.join(ways) if len(ways) > 1 else f'up to {ways[0]}'}"
        else:
            what = f"the reference's clock goes too {'slow' if size == most else 'fast'}, by up to {size:.2f} s a run,"
        what += f" in {among}"
        severity: Severity = "error" if size > _SPOILS else "warning"
        where = "the reference" if every else runs_in_words(list(seconds), count)
        yield Finding(kind=kind, what=what, where=where, severity=severity, changes={"clocks": "match"})


def copied_runs(evidence: Evidence) -> Iterator[Finding]:
    """Runs that repeat an earlier one."""
    runs = evidence.runs
    every = -(-sum(len(run.pose_times) for run in runs) // _MOST_KEYS)
    seen: dict[int, str] = {}
    copies: dict[str, str] = {}
    for run in runs:
        digests = _digests(run)
        keys = set(digests[digests % every == 0].tolist())
        shared = [seen[key] for key in keys & seen.keys()]
        if keys and len(shared) > _SHARED * len(keys):
            copies[run.id] = max(set(shared), key=shared.count)
        else:
            seen.update(dict.fromkeys(keys, run.id))
    if copies:
        copy, original = next(iter(copies.items()))
        what = f"{plural(len(copies), 'run')} {'repeats' if len(copies) == 1 else 'repeat'} the poses of others, as "
        what += f"{copy} those of {original}: what validates then was trained on"
        yield error("copies", what, runs_in_words(list(copies), len(runs)), {"leave_out": list(copies)})


def _digests(run: Trajectory) -> NDArray[np.uint64]:
    """Digests (n,) of every stretch of reference positions that change often enough."""
    rounded = np.round(run.poses[:, :2] / _DIGIT).astype(np.int64)
    if len(rounded) < _ROWS:
        return np.empty(0, dtype=np.uint64)
    stretches = sliding_window_view(rounded, _ROWS, axis=0).reshape(-1, 2 * _ROWS)
    changes = np.append(0, np.cumsum(np.any(np.diff(rounded, axis=0) != 0, axis=1)))
    often = changes[_ROWS - 1 :] - changes[: len(stretches)] >= _CHANGES
    return pl.from_numpy(stretches[often]).hash_rows().to_numpy()


def odd_references(evidence: Evidence) -> Iterator[Finding]:
    """Kinds of references whose values are as large as in another unit; beside poses no option mends them alone."""
    ratios: dict[ReferenceKind, list[float]] = {kind: [] for kind in KINDS}
    model = OdometryModel.of_design(evidence.dataset.robot, "arc")
    for run in evidence.dataset.trajectories:
        if (references := run.references) is None or not len(references):
            continue
        # Magnitudes of what was measured and of the same by the design; positions and compass headings since the first.
        stamps, places = np.unique([references.t0, references.t1], return_inverse=True)
        log = run.log(stamps)
        first, last = model.poses([log])[0][places.reshape(2, -1)]  # (R, 3), poses at the begin and at the end of each
        begin, end = model.lengths([log])[0][places.reshape(2, -1)]
        measured = references.values.copy()
        for in_fixed_frame in ("position", "heading"):
            chosen = references.fixed_frame & (references.kinds == in_fixed_frame)
            if chosen.any():
                measured[chosen] -= measured[chosen][0]
                measured[np.flatnonzero(chosen)[0]] = np.nan
                first[chosen] = last[chosen][0]
        sizes = np.where(references.planar, np.hypot(measured[:, 0], measured[:, 1]), np.abs(measured[:, 0]))
        moved, kinds = last - first, [references.kinds == "distance", references.planar]
        driven = np.select(kinds, [end - begin, np.hypot(moved[:, 0], moved[:, 1])], np.abs(moved[:, 2]))
        for kind, size, expected in zip(references.kinds.tolist(), sizes, driven, strict=True):
            if expected > _LEAST[UNITS[kind]] and np.isfinite(size):
                ratios[kind].append(size / expected)
    for kind, values in ratios.items():
        ratio, must = float(np.median(values)) if values else 0.0, UNITS[kind]
        for factor, unit in _FACTORS[must]:
            if factor / _NEAR < ratio < factor * _NEAR:
                what = f"references of kind {kind} are {ratio:.3g} times what the wheels say, as if they were in "
                what += f"{'degrees' if unit == 'deg' else unit}: they must be in {must}"
                where, option = f"references of kind {kind}", _OPTIONS[must]
                fix = "write these references in m and rad, as the poses are, and import again" if evidence.runs else ""
                yield error(option, what, where, {} if evidence.runs else {option: unit}, fix=fix)


def early_references(evidence: Evidence) -> Iterator[Finding]:
    """The finding that the poses of most runs end long before their wheels."""
    runs = evidence.aligned
    early = [run for run in runs if run.references is None and run.pose_times[-1] < _REACHED * run.times[-1]]
    if 2 * len(early) > len(runs):
        what = f"the poses of {plural(len(early), 'run')} end long before the wheels, as after "
        what += f"{early[0].pose_times[-1]:.2g} s of {early[0].times[-1]:.3g} s"
        fix = "say the unit of the poses' times (pose_time_unit), or record poses to the end of each run"
        yield error("reference_foreign", what, "the reference", fix=fix)


def unrelated_references(evidence: Evidence) -> Iterator[Finding]:
    """The finding that no matrix explains how the reference turns, as where poses are of other drives.

    It is judged by the share of the squares of the runs' turns that the best matrix does not explain.
    """
    windows, fit = evidence.windows, evidence.fit
    if windows is None or fit is None or len(evidence.runs) < _FEWEST_RUNS:
        return
    turned = np.bincount(windows.run, windows.turned)
    missed = turned - np.bincount(windows.run, windows.driven @ fit.matrix[2])
    if np.sqrt(np.mean(turned**2)) < _TURNED:
        return
    if (share := float((missed**2).sum() / (turned**2).sum())) > _FOREIGN:
        what = f"the wheels explain {max(0.0, 1 - share):.0%} of how the reference turns"
        fix = "see whether wheels and poses of each run are of the same drive, and name the robot's wheels right"
        yield error("reference_foreign", what, "the reference", fix=fix)
