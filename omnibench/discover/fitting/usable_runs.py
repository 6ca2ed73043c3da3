"""The runs that are looked at, made ready: few enough stamps, without poses that jump, with their nuisances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError
from omnibench.fit.least_squares.noise import Whitener
from omnibench.fit.least_squares.repetitions import differences_between_repetitions
from omnibench.fit.least_squares.start_noise import by_stamps
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import WheelLog

_MOST_STAMPS = 80  # of a run; neighbours in denser references share their errors
_JUMP = 4.5  # standard deviations from what a pose's neighbours say
_MOST_JUMPS = 0.1  # of a run's poses
_RARE = 0.08  # of all poses: more of them are no jumps
_MANY, _MANY_BY_CHANCE = 0.95, 2.39  # a share of all poses, and how many standard deviations these stay below by chance
_LAST = 5  # samples whose mean rate tells how the robot goes on after the last
_STANDING = 1e-3  # rad/s
_LONGEST = 0.5  # s for which it does
_GAIN = 6.6  # twice the gain in log-likelihood that a variance of zero exceeds by chance once in 200 times

NUISANCES = ("start heading", "clock offset", "clock slope")
_LARGEST = np.array([0.3, 0.5, 0.02])  # rad, s, s/s


def usable_runs(trajectories: Sequence[Trajectory]) -> tuple[Trajectory, ...]:
    """Runs with a reference pose after their start, by session and time, at most 80 stamps each. DataError: none."""
    runs = [run for run in trajectories if _driven_poses(run) > 1]
    if not runs:
        raise DataError(
            "no trajectory of the split train has a reference pose between its start and its last wheel sample; "
            "nothing can be found"
        )
    if max(float(np.abs(run.rates).max()) for run in runs) < _STANDING:
        raise DataError("the wheels stand in all training runs; drive some, or check the columns omega_*")
    runs.sort(key=lambda run: (str(run.session), run.started_at or 0.0))
    return tuple(_thinned(run) for run in runs)


def _driven_poses(run: Trajectory) -> int:
    """How many poses there are, the start among them, up to the end of the wheel samples and a little on."""
    return int((run.pose_times <= run.times[-1] + _LONGEST).sum())


def _thinned(run: Trajectory) -> Trajectory:
    last = _driven_poses(run) - 1
    if last == len(run.pose_times) - 1 <= _MOST_STAMPS:
        return run
    return _with_poses(run, np.unique(np.round(np.linspace(last, 0, min(last, _MOST_STAMPS) + 1)).astype(int)))


def _with_poses(run: Trajectory, chosen: Array) -> Trajectory:
    covariances = None if run.pose_covariances is None else run.pose_covariances[chosen]
    return replace(run, pose_times=run.pose_times[chosen], poses=run.poses[chosen], pose_covariances=covariances)


def without_jumps(
    runs: Sequence[Trajectory], residuals: Sequence[Array], noise: Noise
) -> tuple[tuple[Trajectory, ...], int]:
    """Runs less the poses that contradict their neighbours, and how many these are.

    A pose jumps when its residual lies 4.5 standard deviations from what the run's other residuals make of it. What a
    model gets wrong seldom varies as fast as that; where it does, in many poses, jumps must stand out of that, too.
    """
    kept, count = _without_surprises(runs, residuals, noise, _JUMP)
    poses = sum(len(own) for own in residuals)
    if count <= _RARE * poses:
        return kept, count
    surprises = [
        _surprises(own, *_precisions(noise, run.pose_times[1:])) for run, own in zip(runs, residuals, strict=True)
    ]
    usual = float(np.quantile(np.concatenate(surprises), _MANY)) / _MANY_BY_CHANCE
    return _without_surprises(runs, residuals, noise, _JUMP * max(1.0, usual))


def _without_surprises(
    runs: Sequence[Trajectory], residuals: Sequence[Array], noise: Noise, limit: float
) -> tuple[tuple[Trajectory, ...], int]:
    precisions: dict[bytes, tuple[Array, Array]] = {}
    kept, count = [], 0
    for run, own in zip(runs, residuals, strict=True):
        stamps = run.pose_times[1:]
        keep = np.ones(len(stamps), dtype=bool)
        for _ in range(int(np.ceil(_MOST_JUMPS * len(stamps)))):
            key = stamps[keep].tobytes()
            if key not in precisions:
                precisions[key] = _precisions(noise, stamps[keep])
            score = _surprises(own[keep], *precisions[key])
            if keep.sum() < 3 or score.max() < limit:
                break
            keep[np.flatnonzero(keep)[score.argmax()]] = False
        count += int((~keep).sum())
        whole = bool(keep.all())
        kept.append(run if whole else _with_poses(run, np.concatenate([[True], keep])))
    return tuple(kept), count


def _precisions(noise: Noise, stamps: Array) -> tuple[Array, Array]:
    """Inverse covariances (K, K) of the positions and of the headings."""
    identity = np.repeat(np.eye(len(stamps))[:, None, :], 3, axis=1)
    white = Whitener(noise, stamps)(identity)
    return white[:, 0].T @ white[:, 0], white[:, 2].T @ white[:, 2]


def _surprises(residuals: Array, position: Array, heading: Array) -> Array:
    """How many standard deviations (K,) each pose lies from what the others say, the worst of x, y and heading."""
    of_position = (position @ residuals[:, :2]) / np.sqrt(np.diag(position))[:, None]
    of_heading = (heading @ residuals[:, 2:]) / np.sqrt(np.diag(heading))[:, None]
    scores: Array = np.abs(np.concatenate([of_position, of_heading], axis=1)).max(axis=1)
    return scores


def log_of(run: Trajectory, nuisances: Array) -> WheelLog:
    """A run's log at the times when its poses were taken, its start turned: nuisances (3,) rad, s, s per s.

    After the last sample the robot goes on as in the last ones, so that the path has no kink there.
    """
    turn, offset, slope = nuisances
    log = run.log(run.pose_times[1:] * (1 - slope) - offset)
    start = log.start + np.array([0.0, 0.0, turn])
    if log.stamps[-1] <= log.times[-1]:
        return replace(log, start=start)
    rate = log.rates[-_LAST:].mean(axis=0)
    end = log.stamps[-1]
    angles = log.wheel_angles
    if angles is not None:
        angles = np.vstack([angles, angles[-1] + rate * (end - log.times[-1])])
    return replace(
        log, start=start, times=np.append(log.times, end), rates=np.vstack([log.rates, rate]), wheel_angles=angles
    )


def in_start_frames(runs: Sequence[Trajectory], values: Sequence[Array]) -> list[Array]:
    """Residuals (K, 3), or derivatives of poses (K, 3, m), as seen from the heading in which each run starts.

    Only so are they the same for repetitions of a command that start in different headings.
    """
    turned = []
    for run, own in zip(runs, values, strict=True):
        cosine, sine = np.cos(run.start[2]), np.sin(run.start[2])
        turn = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        turned.append(np.einsum("ij,kj...->ki...", turn, own))
    return turned


@dataclass(frozen=True, eq=False)
class Nuisances:
    """What is each run's own: values (Z, 3), rad, s, s per s, and the sizes (3,) that are expected, 0 for none."""

    values: Array
    deviations: Array


def deviations_of(
    runs: Sequence[Trajectory], residuals: Sequence[Array], slopes: Sequence[Array], noise: Noise
) -> Array:
    """Standard deviations (3,) of the nuisances between repetitions of a command; 0 for what does not show.

    slopes (K, 3, 3): derivatives of each run's poses by its nuisances. One kind looks much like another: the likeliest
    comes in first, and a further one only for what those that are in leave.
    """
    surprise = _Surprise(runs, residuals, slopes, noise)
    found: Array = np.zeros(3)
    chosen: list[int] = []
    while len(chosen) < len(NUISANCES):
        now = surprise(found)
        trials = {kind: surprise.along(found, kind) for kind in range(3) if kind not in chosen}
        best = min(trials, key=lambda kind: trials[kind][1])
        if now - trials[best][1] < _GAIN:
            return found
        chosen.append(best)
        found[best] = trials[best][0]
        for kind in (*chosen, *chosen):  # what came in before may have stood for what came now
            found[kind] = surprise.along(found, kind)[0]
    return found


class _Surprise:
    """Minus twice the log-likelihood of differences between repetitions, by the deviations of the nuisances."""

    def __init__(
        self, runs: Sequence[Trajectory], residuals: Sequence[Array], slopes: Sequence[Array], noise: Noise
    ) -> None:
        kinds = [
            by_stamps(differences_between_repetitions(runs, residuals, [each[..., kind] for each in slopes]).each)
            for kind in range(3)
        ]
        self._products, self._scores = [], []
        for stamps, *everything in zip([stamps for stamps, _ in kinds[0]], *kinds, strict=True):
            count = everything[0][1].shape[2] // 2
            whiten = Whitener(noise, stamps)
            values = whiten(everything[0][1][..., :count]).reshape(-1, count)
            columns = np.stack([whiten(own[..., count:]).reshape(-1, count) for _, own in everything], axis=-1)
            self._products.append(np.einsum("rnk,rnl->nkl", columns, columns))
            self._scores.append(np.einsum("rnk,rn->nk", columns, values))

    def __call__(self, deviations: Array) -> float:
        total = 0.0
        for products, scores in zip(self._products, self._scores, strict=True):
            inner = np.eye(3) + products * np.outer(deviations, deviations)
            scaled = scores * deviations
            total += float(np.linalg.slogdet(inner)[1].sum())
            total -= float(np.einsum("nk,nk->", scaled, np.linalg.solve(inner, scaled[..., None])[..., 0]))
        return total

    def along(self, deviations: Array, kind: int) -> tuple[float, float]:
        """The best deviation of one kind, the others held, and what it reaches."""

        def with_it(value: float) -> float:
            return self(np.where(np.arange(3) == kind, value, deviations))

        answer = minimize_scalar(
            with_it, bounds=(0.0, float(_LARGEST[kind])), method="bounded", options={"xatol": 1e-5 * _LARGEST[kind]}
        )
        return float(answer.x), float(answer.fun)
