"""Twists of wheel samples, corrected by all terms of a model; batch and stream share this code.

Outside the training domain, the motions that a model was fitted to, its corrections may fade to the plain matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from omnibench.errors import DataError, PluginError
from omnibench.robot.effects.effect import MotionEffect, Need, Term, correction_of
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import RunSamples, WheelLog
from omnibench.robot.signals import Signals, needed, signals_of_runs

# Attribute of a log for each need of an effect, and words for it where the log lacks it
_MISSING: dict[Need, tuple[str, str]] = {
    "wheel_angles": ("wheel_angles", "absolute wheel angles (phi_* in wheels), which were not recorded"),
    "session_time": (
        "started_at",
        "the time since the session's start (started_at in trajectories), which is not known",
    ),
    "session": ("session", "the session's name (session in trajectories), which is not known"),
}

# Lengths of motions (m/s, turning as speed at the wheels) are shares of the largest in the domain. All are chosen.
_NEAR = 0.15  # a motion nearer than this to one in the domain is inside
_SPACING = 0.05  # least distance between the representatives that are kept
_SMOOTHING = 0.25  # s, over which the twists of a run are averaged
_STANDING = 0.02  # a smaller motion is standing still, which is inside every domain
_OFTEN = 0.05  # share of a run's time: motions outside that take less are transitions, and do not count

GROWTH = 4.0
_VARIES = 1e-9  # share of the largest variance below which a direction of the parameters has none but by rounding


@dataclass(frozen=True, eq=False)
class Corrected:
    """Wheel samples with the corrections of all terms.

    rates (F, N), rad/s, and steering (F, S), rad: as the wheels truly turn and point. body (F, 3): added to the twist
    of the robot's centre. world (F, 2): added to the velocity in the reference's frame, m/s. None: no term acts there.
    """

    rates: Array
    steering: Array | None
    body: Array | None = None
    world: Array | None = None


def corrected(terms: Sequence[Term], signals: Signals) -> Corrected:
    """The wheel samples with all corrections, each computed from the uncorrected signals, so that their order does not
    matter. PluginError: a correction has a wrong shape.
    """
    sums: dict[str, Array | None] = {"wheel": signals.rates, "steering": signals.steering}
    count, wheels = signals.rates.shape
    widths = {"body": 3, "world": 2, "steering": 0 if signals.steering is None else signals.steering.shape[1]}
    for term in terms:
        effect = term.effect
        assert isinstance(effect, MotionEffect)
        added = correction_of(effect, signals, term.values)
        shape = (count, widths.get(effect.stage, wheels))
        if added.shape != shape:
            raise PluginError(f"effect {term.name!r}: its correction has shape {added.shape}, expected {shape}")
        stage = effect.stage if effect.stage in widths else "wheel"
        before = sums.get(stage)
        sums[stage] = added if before is None else before + added
    return Corrected(needed(sums["wheel"]), sums["steering"], sums.get("body"), sums.get("world"))


def corrected_twists(terms: Sequence[Term], signals: Signals, matrix: Array) -> tuple[Array, Array | None]:
    """Twists (F, 3) of the tracked point with all corrections, and the velocity (F, 2) that world effects add.

    The velocity is None if no term acts in the world. PluginError: a correction has a wrong shape.
    """
    true = corrected(terms, signals)
    mount = signals.robot.mount
    if mount is None and true.rates is signals.rates and true.steering is signals.steering:
        twists = signals.twists
    else:
        twists = signals.robot.drive.signals(true.rates, true.steering) @ matrix.T
    if true.body is None:
        return twists, true.world
    return twists + (true.body if mount is None else true.body @ mount.twist.T), true.world


def driven_signals(
    terms: Sequence[Term], logs: Sequence[WheelLog], robot: Robot, matrix: Array, sample_period: float
) -> list[Array]:
    """The drive signals (F, M) of every log as effects on wheels and steering correct them.

    sample_period: nominal, s. The logs of a session that follow each other are corrected at once.
    """
    needs, driven = needs_of(terms), list[Array]()
    for _, of_session in groupby(logs, key=lambda log: log.session):
        alike = list(of_session)
        samples = RunSamples.of([log.times for log in alike])
        true = corrected(terms, signals_of_runs(alike, samples, robot, matrix, sample_period, needs))
        driven += np.split(robot.drive.signals(true.rates, true.steering), samples.edges[1:-1])
    return driven


def needs_of(terms: Sequence[Term]) -> frozenset[Need]:
    """All that the effects of some terms need."""
    return frozenset().union(*(term.effect.needs for term in terms))


def check_needs(terms: Sequence[Term], log: WheelLog) -> None:
    """Raise DataError, in one line, if a log lacks data that an effect needs."""
    for term in terms:
        for need in sorted(term.effect.needs & _MISSING.keys()):
            attribute, words = _MISSING[need]
            if getattr(log, attribute) is None:
                raise DataError(
                    f"effect {term.name!r} needs {words}; record it, or take the effect out of the calibration"
                )


def _scale(robot: Robot) -> Array:
    """Factors (3,) that make m/s of a twist: turning counts as the speed that it gives the wheels."""
    return np.array([1.0, 1.0, robot.reach])


def _size(at_wheels: Array) -> float:
    """Length of the largest of some motions (k, 3), m/s."""
    return max(float(np.linalg.norm(at_wheels, axis=1).max()), 1e-9)


def motions_of(matrix: Array, times: Array, signals: Array) -> Array:
    """Twists (k, 3) of a run, m/s, m/s, rad/s, smoothed over a quarter of a second; times (F,), signals (F, M)."""
    width = max(1, round(_SMOOTHING * len(times) / float(times[-1])))
    totals = np.cumsum(np.vstack([np.zeros(3), signals @ matrix.T]), axis=0)
    if len(times) <= width:
        return totals[-1:] / len(times)
    return (totals[width:] - totals[:-width])[:: max(1, width // 2)] / width


def representatives(robot: Robot, motions: Array) -> Array:
    """A subset of motions (k, 3) such that every motion is near one of the subset."""
    at_wheels = motions * _scale(robot)
    size = _size(at_wheels)
    _, first = np.unique(np.round(at_wheels / (_SPACING * size)), axis=0, return_index=True)
    chosen: list[int] = []
    for index in first:
        if not chosen or np.linalg.norm(at_wheels[chosen] - at_wheels[index], axis=1).min() > _SPACING * size:
            chosen.append(int(index))
    return motions[chosen]


def kinds_of_motion(robot: Robot, means: Array, spreads: Array) -> NDArray[np.intp]:
    """The number (k,) of the kind of each of several paths: all of a kind are near to its first one.

    means, spreads (k, 3): of their twists, and standard deviations about these.
    """
    paths = np.hstack([means, spreads]) * np.tile(_scale(robot), 2)
    size = _size(paths)
    kinds, firsts = np.zeros(len(paths), dtype=np.intp), list[int]()
    for number, path in enumerate(paths):
        near = np.flatnonzero(np.linalg.norm(paths[firsts] - path, axis=1) < _NEAR * size)
        kinds[number] = near[0] if len(near) else len(firsts)
        if not len(near):
            firsts.append(number)
    return kinds


def extrapolated_share(robot: Robot, fitted: Array, motions: Array) -> tuple[float, str]:
    """The share of motions (k, 3) outside the training domain of ``fitted`` (n, 3), and what they are, in words."""
    domain = TrainingDomain(robot, fitted)
    outside = domain.outside_in_run(motions)
    return (float(outside.mean()), domain.in_words(motions[outside])) if outside.any() else (0.0, "")


class TrainingDomain:
    """The motions (n, 3) that a model was fitted to, m/s, m/s, rad/s; a motion far from all of them is outside."""

    def __init__(self, robot: Robot, motions: Array | Sequence[Sequence[float]]) -> None:
        self._scale = _scale(robot)
        self._fitted = np.asarray(motions, dtype=float) * self._scale
        self._size = _size(self._fitted)

    def excess(self, motions: Array) -> Array:
        """Distances (k,) of motions (k, 3) from the domain, in widths of what counts as near to it; 0 inside."""
        at_wheels = motions * self._scale
        if len(at_wheels) == 1:  # without SciPy, which is slow to import live
            distances = np.sqrt(np.square(self._fitted - at_wheels).sum(axis=1).min(keepdims=True))
        else:
            from scipy.spatial import KDTree

            distances = KDTree(self._fitted).query(at_wheels)[0]
        excess: Array = np.maximum(distances / (_NEAR * self._size) - 1, 0.0)
        return np.where(np.linalg.norm(at_wheels, axis=1) < _STANDING * self._size, 0.0, excess)

    def is_outside(self, motion: Array) -> bool:
        """True if one motion (3,) is outside."""
        return bool(self.outside(motion[None])[0])

    def outside(self, motions: Array) -> NDArray[np.bool_]:
        """True (k,) for each of many motions (k, 3) that is outside."""
        return self.excess(motions) > 0

    def outside_in_run(self, motions: Array) -> NDArray[np.bool_]:
        """True (k,) for the motions (k, 3) of one run that are outside; all False where they are mere transitions."""
        outside = self.outside(motions)
        return outside if outside.mean() >= _OFTEN else np.zeros_like(outside)

    def in_words(self, motions: Array) -> str:
        """The kind of motion that these (k, 3) are, by their medians, in words."""
        speed = float(np.median(np.hypot(motions[:, 0], motions[:, 1])))
        turning = float(np.median(np.abs((motions * self._scale)[:, 2])))
        if speed < 0.3 * turning:
            return "turning on the spot"
        if turning < 0.2 * speed:
            return f"driving straight at {speed:.2f} m/s"
        return f"turning while driving at {speed:.2f} m/s"


def extrapolation_consequence(effects: Sequence[str], *, fading: bool = False) -> str:
    """The consequence of extrapolation for effects of these names, in words. fading: they do so where unsure."""
    names = list(dict.fromkeys(effects))
    one = len(names) == 1
    fades = f"{'fades' if one else 'fade'} to the plain matrix where unsure, " if fading else ""
    return (
        f"{', '.join(names)} {'is' if one else 'are'} not known to hold there, {fades}and errors may be larger than "
        "stated"
    )


class FadedTwists(NamedTuple):
    """Twists (F, 3) of the tracked point, and velocity (F, 2) in the reference's frame, None for none.

    doubts (F, 5, r): standard deviations of twist and velocity in r independent directions by what is extrapolated,
    Eq. (3); None where no sample is outside the training domain.
    """

    twists: Array
    drift: Array | None
    doubts: Array | None


class Fade:
    """Fading: outside the training domain, corrections fade to the plain matrix as far as they are not sure.

    Let u be the drive signals of a sample, K the model's matrix, c(b) the corrections by parameters b, and K0 the plain
    matrix, which was fitted without corrections. The model changes the plain twist by

        m = K u + c(b) - K0 u.                                                                            (1)

    With S the covariance of b and R that of K with b, an error e of b goes along with an error R S^+ e of K, the
    conditional mean of normal errors. So m errs by D e, with the variance s^2,

        D = dc/db + (R S^+) u,    s^2 = tr(D S D'),                                                       (2)

    turning counted as the speed that it gives the wheels. Where motions are near to driven ones, runs that were held
    out confirmed the corrections. Beyond, at x widths of "near" from there, a correction may have another form, and the
    variance of what is extrapolated is taken to grow in proportion to that distance, as that of a random walk does:

        v = GROWTH x s^2.                                                                                 (3)

    Of an estimate m with the variance v, the share

        g = max(1 - v / m^2, 0)                                                                           (4)

    is used (positive part of the estimator of James and Stein, Proc. 4th Berkeley Symposium, 1961; non-negative garrote
    of Breiman, Technometrics 37, 1995): m is kept where the parameters are known well; where they are not, or models
    that the recordings cannot tell apart disagree, the plain matrix is left. Every sample is judged by itself, batch
    and stream alike.

    change (3, M): what the matrix has that the plain one has not. driven (n, 3): motions of the training domain, m/s,
    m/s, rad/s. covariance (3M + p, 3M + p): of the matrix, row by row, then of the values of all terms; 0 for those
    that were not fitted.
    """

    def __init__(self, robot: Robot, change: Array, driven: Array, terms: Sequence[Term], covariance: Array) -> None:
        self._change, self._terms = change, tuple(terms)
        self._domain = TrainingDomain(robot, driven)
        self._weights = np.array([1.0, 1.0, robot.reach, 1.0, 1.0])
        elements, variances = change.size, np.diag(covariance)
        values = [(number, name) for number, term in enumerate(terms) for name in term.values]
        fitted = np.flatnonzero(variances[elements:] > 0)
        sizes = np.sqrt(variances[elements + fitted])
        self._fitted = [(*values[row], float(size)) for row, size in zip(fitted, sizes, strict=True)]
        rest = [dict(term.values) for term in terms]
        for number, name, _ in self._fitted:
            rest[number][name] = 0.0
        self._without_fitted = rest  # the values of each term, the fitted ones 0
        rows = elements + fitted
        strengths, vectors = np.linalg.eigh(covariance[np.ix_(rows, rows)] / np.outer(sizes, sizes))
        varied = strengths > _VARIES * strengths.max(initial=0.0)
        self._roots = vectors[:, varied] * np.sqrt(strengths[varied])  # square root of S, in standard deviations
        inverse = vectors[:, varied] / np.sqrt(strengths[varied])
        along = covariance[:elements, rows] / sizes @ inverse  # R S^+ of the roots
        self._matrices = along.T.reshape(-1, *change.shape)

    def applied(self, terms: Sequence[Term], signals: Signals, matrix: Array) -> FadedTwists:
        """The corrected twists of samples, faded outside the training domain. PluginError as ``corrected_twists``."""
        twists, drift = corrected_twists(terms, signals, matrix)
        drive = signals.robot.drive.signals(signals.rates, signals.steering)
        excess = self._domain.excess(drive @ matrix.T)
        rows = np.flatnonzero(excess)
        if not len(rows):
            return FadedTwists(twists, drift, None)
        arrays = {field.name: getattr(signals, field.name) for field in fields(signals)}
        of_rows: dict[str, Any] = {name: item[rows] for name, item in arrays.items() if isinstance(item, np.ndarray)}
        slopes = self._slopes(replace(signals, **of_rows), drive[rows], matrix)
        doubts = np.sqrt(GROWTH * excess[rows])[:, None, None] * slopes  # Eq. (3)
        plain = drive @ (matrix - self._change).T
        change = np.concatenate([twists - plain, np.zeros((len(twists), 2)) if drift is None else drift], axis=1)
        variance = np.square(doubts * self._weights[:, None]).sum(axis=(1, 2))
        size = np.square(change[rows] * self._weights).sum(axis=1)
        share = np.ones((len(twists), 1))
        share[rows, 0] = np.maximum(1 - variance / np.maximum(size, 1e-300), 0.0)  # Eq. (4)
        outside = np.zeros((len(twists), *doubts.shape[1:]))
        outside[rows] = doubts
        twists = np.where(share < 1, plain + share * change[:, :3], twists)
        return FadedTwists(twists, None if drift is None else share * drift, outside)

    def _slopes(self, signals: Signals, drive: Array, matrix: Array) -> Array:
        """D of Eq. (2) times the roots of S, (F, 5, r)."""
        twists, _ = corrected_twists((), signals, matrix)
        slopes = np.zeros((len(drive), 5, len(self._fitted)))
        for column, (number, name, size) in enumerate(self._fitted):
            effect = self._terms[number].effect
            if isinstance(effect, MotionEffect):
                moved, drift = corrected_twists(
                    [Term(effect, self._without_fitted[number] | {name: size})], signals, matrix
                )
                slopes[:, :3, column] = moved - twists
                if drift is not None:
                    slopes[:, 3:, column] = drift
        slopes = slopes @ self._roots
        slopes[:, :3] += np.einsum("rkm,fm->fkr", self._matrices, drive)
        return slopes


def faded_twists(fade: Fade | None, terms: Sequence[Term], signals: Signals, matrix: Array) -> FadedTwists:
    """The corrected twists of samples, faded if a fade is given. PluginError as ``corrected_twists``."""
    if fade is None:
        return FadedTwists(*corrected_twists(terms, signals, matrix), None)
    return fade.applied(terms, signals, matrix)
