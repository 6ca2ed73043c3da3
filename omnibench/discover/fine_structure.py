"""Fine structure: how the motion between poses depends on heading, place, time, wheels' angles and joints of the floor.

It is finer than whole columns show, and found by scores: how much better the residuals would be explained by changes of
the motion in single samples. An error of the motion in one sample, a displacement d and a turn e (paths.py, Eq. (1),
from the run's start), moves the pose at every later stamp j by d + i z_j e and by e. Let h_j be the inverse covariance
of the residuals times these, by which half the chi-square falls as the pose at stamp j moves. The motion in a sample
before stamp k then lowers it by

    g_d = sum over j >= k of h_j,    g_e = sum over j >= k of h_j(heading) + Re(conj(i z_j) h_j),                  (1)

and the score of a function f of a covariate in a mode m of motion (along the way, across it, turning per way or by the
rate of turn) is the sum of f m g over a run's samples: one product of matrices for all functions, however many.

With s_z the scores of run z for the d columns of a basis, s their sum over Z runs and S = sum of s_z s_z',

    Q = q / (1 - q / Z),    q = s' S^-1 s                                                                          (2)

is the statistic of Hotelling ("The generalization of Student's ratio", Annals of Mathematical Statistics 2, 1931), of d
degrees of freedom where nothing is missing, whatever the noise is taken for. S stays the same where signs are flipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from omnibench.discover.covariates import Basis, area_of, patches_on_grid
from omnibench.discover.fit import Fit, paths_of
from omnibench.discover.paths import Paths
from omnibench.discover.significance import Group, Significance, significance_of_scores, together
from omnibench.robot.effects.effect import Values
from omnibench.robot.effects.smooth import MODES, beyond, bump
from omnibench.robot.kinematics import Array

_COARSE = 0.1  # s: wheel samples are merged up to this duration
_FINE = 0.03  # s: shorter wheel samples are merged where joints of the floor and waves of wheels are looked for
_HARMONICS = 12  # of the heading
_SWINGS, _OF_SESSION = 48, 12  # half periods in the longest run and session (chosen; in 10 s, up to 2.4 Hz)
_WAVES = 400  # plane waves over the floor, at most; the shortest are left out
_DIRECTIONS, _LINES = 12, 9  # directions of lines across the floor, and lines for each
_EDGE = 0.05  # m, over which the floor changes at a line
_CELLS = 9  # patches along each side of the floor
_RUNS = 15  # at least: the scatter of eight scores is hardly known from fewer; chosen
_NUMBERS = 1_000_000  # values of functions that are computed at once (chosen)


@dataclass(frozen=True, eq=False)
class _Kind:
    """Functions of one kind: B shapes and their values (F, B, J). term: the smooth effect that adds them to a model."""

    covariate: str
    term: str
    detail: str
    shapes: Sequence[Mapping[str, float]]
    values: Callable[[slice], Array]


def fine_structure(fit: Fit, rng: np.random.Generator) -> Significance | None:
    """Significance of fine structure in the residuals of a fitted model; None where nothing could show."""
    if len(fit.runs) < _RUNS:
        return None
    found: Significance | None = None
    for members, studentised in _families(fit):
        if members:
            groups, scores = zip(*members, strict=True)
            of_family = significance_of_scores(groups, scores, scores, rng, studentised=studentised)
            found = together(of_family, found)
    return found


def _families(fit: Fit) -> Iterator[tuple[list[tuple[Group, Array]], bool]]:
    """Groups of each kind with their scores (Z, d), and whether these are to be studentised, Eq. (2).

    The paths of one are given up before those of the next are made.
    """
    yield from ((members, True) for members in _of_kinds(paths_of(fit, _COARSE), fit))
    finer = paths_of(fit, _FINE)
    yield list(waves_of_wheels(fit, finer)), True
    yield list(floor_joints(finer, pull_in_modes(fit, finer))), False


def _of_kinds(paths: Paths, fit: Fit) -> Iterator[list[tuple[Group, Array]]]:
    pull = pull_in_modes(fit, paths)
    for kind in _kinds(paths):
        yield list(_of_kind(paths, pull, kind))


def _of_kind(paths: Paths, pull: Array, kind: _Kind) -> Iterator[tuple[Group, Array]]:
    """Groups of one kind and their scores (Z, d)."""
    edges = np.searchsorted(paths.owner, np.arange(len(paths.logs) + 1)).tolist()
    at_once = max(1, _NUMBERS // len(paths.owner))
    for low in range(0, len(kind.shapes), at_once):
        part = slice(low, low + at_once)
        independent = independent_scores(_scores(edges, pull, kind.values(part)))
        for shape, of_runs in zip(kind.shapes[part], independent, strict=True):
            if of_runs.shape[1]:
                detail, tries = kind.detail.format(**shape), len(kind.shapes)
                basis = Basis(kind.covariate, "body", detail, None, tries, kind.term, shape)
                yield Group("covariate", kind.covariate, (), tries=tries, basis=basis), of_runs


def _scores(edges: Sequence[int], pull: Array, values: Array) -> Array:
    """Scores (Z, B, m J) of functions (F, B, J) in m modes: of all of a run's samples, which begin at the edges.

    The functions count from their means, as the matrix holds what is the same everywhere.
    """
    flat = values.reshape(len(values), -1)
    mean = flat.mean(axis=0)
    of_runs = [pull[low:high].T @ flat[low:high] - pull[low:high].sum(axis=0)[:, None] * mean
               for low, high in pairwise(edges)]  # fmt: skip
    scores = np.array(of_runs).reshape(-1, pull.shape[1], *values.shape[1:])
    return scores.transpose(0, 2, 1, 3).reshape(len(scores), values.shape[1], -1)


def _kinds(paths: Paths) -> Iterator[_Kind]:
    """Functions of heading, time and place, as fine as the paths allow."""
    heading, places = paths.middle[:, 2], paths.middle[:, :2]
    harmonics = np.arange(1.0, _HARMONICS + 1)
    yield _Kind(
        "heading",
        "smooth_heading_wave",
        "the robot's heading, {harmonic:g} times a turn",
        [{"harmonic": float(number)} for number in harmonics],
        lambda part: _parts(np.exp(1j * heading[:, None] * harmonics[part])),
    )
    yield from _waves_of_time(paths)
    low = places.min(axis=0)
    extent = places.max(axis=0) - low
    if extent.max() <= _EDGE:
        return
    waves, lines, patches, area = (
        _wave_numbers(),
        _lines(places),
        list(patches_on_grid(places, _CELLS)),
        area_of(places),
    )
    step = np.pi / np.maximum(extent, _EDGE)
    east, north = ((places - low) * step).T
    most = max(max(abs(number) for number in pair) for pair in waves)
    along_x = np.exp(1j * east[:, None] * np.arange(most + 1))
    along_y = np.exp(1j * north[:, None] * np.arange(-most, most + 1))
    columns = np.array(waves) + np.array([0, most])
    yield _Kind(
        "place",
        "smooth_place_wave",
        "a wave over the floor, such as tiles make",
        [{"along_x": float(step[0] * east), "along_y": float(step[1] * north)} | area for east, north in waves],
        lambda part: _parts(along_x.take(columns[part, 0], axis=1) * along_y.take(columns[part, 1], axis=1)),
    )
    for term, detail, shapes, function in (
        ("smooth_edge", "a line across the floor", lines, beyond),
        ("smooth_patch", "a patch of the floor", patches, bump),
    ):
        yield _Kind("place", term, detail, shapes, partial(_over_places, function, places, shapes))


def _waves_of_time(paths: Paths) -> Iterator[_Kind]:
    """Waves of the time since the start of a run, and of a session, from half a period in the longest one on."""
    of_session = paths.signals.session_time
    kinds = [("elapsed time", "smooth_time_wave", "the time since the start, {frequency:.2g} times a second",
              paths.signals.elapsed, _SWINGS)]  # fmt: skip
    if of_session is not None:
        words = "the time since the session's start, {frequency:.2g} times a second"
        kinds.append(("order of runs", "smooth_session_wave", words, of_session, _OF_SESSION))
    for covariate, term, detail, time, most in kinds:
        if time.max() <= 0:
            continue
        frequencies = np.arange(1, most + 1) / (2 * float(time.max()))
        shapes = [{"frequency": frequency, "duration": float(time.max())} for frequency in frequencies.tolist()]
        yield _Kind(covariate, term, detail, shapes, partial(_over_time, time, frequencies))


def _over_time(time: Array, frequencies: Array, part: slice) -> Array:
    """Values (F, B, 2) of waves of times (F,)."""
    return _parts(np.exp(2j * np.pi * time[:, None] * frequencies[part]))


def _over_places(
    function: Callable[[Array, Values], Array], places: Array, shapes: Sequence[Values], part: slice
) -> Array:
    """Values (F, B, 1) of a function of places (F, 2) in several shapes."""
    return np.stack([function(places, shape) for shape in shapes[part]], axis=1)


def _parts(waves: Array) -> Array:
    """Cosines and sines (F, B, 2) of complex waves (F, B)."""
    return waves.view(float).reshape(*waves.shape, 2)


def _wave_numbers() -> list[tuple[int, int]]:
    """Half periods (east, north) across the floor of plane waves, the longest waves first, each in one direction."""
    most = int(np.sqrt(_WAVES))
    pairs = [pair for pair in product(range(most), range(-most, most + 1)) if pair > (0, 0)]
    return sorted(pairs, key=lambda pair: math.hypot(*pair))[:_WAVES]


def _lines(places: Array) -> list[dict[str, float]]:
    """Lines across the floor, in each direction where equal shares of the samples lie between them."""
    shares, lines = np.arange(1, _LINES + 1) / (_LINES + 1), []
    for normal in (np.pi / _DIRECTIONS * np.arange(_DIRECTIONS)).tolist():
        distances = np.quantile(places @ [np.cos(normal), np.sin(normal)], shares)
        lines += [{"normal": normal, "distance": distance, "width": _EDGE} for distance in distances.tolist()]
    return lines


_LOW, _HIGH = 0.1, 6.0  # waves a turn; slower ones look like radii, for faster ones there are whole columns (chosen)
_MAX_WAVES = 1500  # wave numbers that are tried; if the angles resolve more, the highest are left out (chosen)
_WIDTH = 0.1  # w, rad: the fastest wave moves on by 0.6 rad, by which it shows at 98 % (chosen)
_TOGETHER = 300_000  # scores of runs and numbers of waves that are computed at once (chosen)
_TURNS = 10  # over all runs, from which on waves a turn can be told from a radius (chosen)


def waves_of_wheels(fit: Fit, paths: Paths) -> Iterator[tuple[Group, Array]]:
    """Groups of waves of all wheels, each so many times a turn, and their scores (Z, d).

    Gears and belts turn otherwise than the wheels that they drive: any number of times a turn counts. With phi the
    angle of a wheel and g_z the pull of a change of its rate in proportion to the rate, the scores of run z for n
    waves a turn are

        s_z(n) = sum over samples of g_z exp(i n phi) = exp(i n phi_0) sum over bins b of G_zb exp(i n b w),        (3)

    with phi_0 the angle at the start of the run and G_zb the sum of g_z where phi - phi_0 is in bin b of width w. Waves
    with different n are told apart if they fall out of step over all angles that the wheel had.
    """
    angles = paths.signals.wheel_angles
    if angles is None:
        return
    span = float(np.ptp(angles, axis=0).max())
    if span < 2 * np.pi * _TURNS:
        return
    numbers = np.arange(_LOW, _HIGH, np.pi / span)[:_MAX_WAVES]
    rates = paths.signals.rates
    changes = [paths.changes(paths.by_rates(rates * unit)) for unit in np.eye(rates.shape[1])]
    pull, at_once = pull_by(fit, paths, changes), max(1, _TOGETHER // len(paths.logs))
    for first in range(0, len(numbers), at_once):
        some = numbers[first : first + at_once]
        waves = [_scores_of_waves(paths, angles[:, wheel], pull[:, wheel], some) for wheel in range(rates.shape[1])]
        parts = [part[..., None] for scores in waves for part in (scores.real, scores.imag)]
        independent = independent_scores(np.concatenate(parts, axis=2))
        for number, of_runs in zip(some.tolist(), independent, strict=True):
            if of_runs.shape[1]:
                detail, tries = f"the angle of the wheels, {number:.3g} times a turn", len(numbers)
                basis = Basis("wheel angle", "wheel", detail, None, tries, "smooth_wheel_angle", {"harmonic": number})
                yield Group("covariate", "wheel angle", (), tries=tries, basis=basis), of_runs.astype(np.float32)


def _scores_of_waves(paths: Paths, angles: Array, pull: Array, numbers: Array) -> Array:
    """Scores (Z, B) of waves of one wheel, B numbers of times a turn, Eq. (3)."""
    firsts = np.searchsorted(paths.owner, np.arange(len(paths.logs)))
    start = angles[firsts]
    bins = np.round((angles - start[paths.owner]) / _WIDTH).astype(np.intp)
    low = bins.min()
    count = int(bins.max() - low) + 1
    cells = np.bincount(paths.owner * count + bins - low, pull, len(firsts) * count).reshape(-1, count)
    waves = np.exp(1j * _WIDTH * (low + np.arange(count))[:, None] * numbers)
    scores: Array = np.exp(1j * start[:, None] * numbers) * (cells @ waves)
    return scores


_NORMALS = 45  # normals within a right angle: at 1 m from the middle the nearest is half a bin off at most
_JOINT_WIDTH = 0.03  # m, of a bin: wheels meet a joint within a part of their own size; chosen
_MOST_BINS = 300  # each way: on larger floors bins are wider (chosen)
_CROSSED = 5  # runs that must cross a bin: the scatter of fewer says nothing (chosen)
_OUTLYING = 0.005  # share of the samples beyond the bins on either side
_MOST_LINES = 40  # candidates in each direction and across it: so many tiles of 0.3 m lie over 6 m both ways (chosen)
_SURE = 2.0  # standard deviations by which a line must show to be a candidate of a model: by chance one in 22 does
# Modes, by their numbers in MODES, that joints change together: the wheels are held up, or the robot is knocked round.
_CHANGES = {"slow the robot": (0, 3), "turn the robot": (2,)}


def floor_joints(paths: Paths, pull: Array) -> Iterator[tuple[Group, Array]]:
    """Groups of lines in one direction and across it, and their scores (Z, d). pull (F, 4): of each sample and mode.

    At joints, as between tiles, something happens to the motion within centimetres of parallel lines. Across lines
    with the normal n a place p has the coordinate u = n . p. Let s_zb be the score of run z for a change of the motion
    in bin b of u alone, beyond a change of the same size everywhere. With the bins of n and of the direction across it
    together, since tiles have joints both ways,

        Q = sum over b of (sum over z of s_zb)^2 / (sum over z of s_zb^2)                                           (4)

    has the expectation of the number of bins where nothing is missing. Scores of neighbouring bins go along with each
    other, as a pose shows all that happened before: how far Q exceeds its expectation by chance is found by changing
    the signs of whole runs (significance.py, Eq. (2)).
    """
    if float(np.ptp(paths.middle[:, :2], axis=0).max()) < 2 * _JOINT_WIDTH:
        return
    for normal in (np.pi / 2 / _NORMALS * np.arange(_NORMALS)).tolist():
        bins = [_Bins.of(paths, angle) for angle in (normal, normal + np.pi / 2)]
        for words, modes in _CHANGES.items():
            of_samples = pull[:, list(modes)].sum(axis=1)
            scores = [of_axis.scores(paths.owner, of_samples) for of_axis in bins]
            both_ways = np.concatenate(scores, axis=1)
            if both_ways.shape[1]:
                lines = [line for both in zip(bins, scores, strict=True) for line in _lines_of_joints(*both)]
                parts = tuple(shapes for _, shapes in sorted(lines, key=lambda line: -line[0])[:_MOST_LINES])
                detail, tries = f"joints of the floor that {words}, such as tiles have", _NORMALS * len(_CHANGES)
                basis = Basis("place", "body", detail, None, tries, "smooth_joint", {"normal": normal}, parts)
                yield Group("covariate", "place", (), tries=tries, basis=basis), both_ways


def _lines_of_joints(bins: _Bins, scores: Array) -> Iterator[tuple[float, dict[str, float]]]:
    """The lines in whose bins most happens, by how many standard deviations."""
    for distance, score in zip(bins.middles[bins.crossed].tolist(), np.abs(scores.sum(axis=0)).tolist(), strict=True):
        if score > _SURE:
            yield score, {"normal": bins.normal, "distance": distance, "width": bins.width}


@dataclass(frozen=True, eq=False)
class _Bins:
    """Bins across lines: their middles (B,) and width, m; the bin (F,) of each sample, B for none; and those to use.

    share (B + 1,): of the samples in each.
    """

    normal: float
    middles: Array
    width: float
    number: NDArray[np.intp]
    crossed: NDArray[np.intp]
    share: Array

    @staticmethod
    def of(paths: Paths, normal: float) -> _Bins:
        """The bins over the places of some paths, but for the outermost ones."""
        across = paths.middle[:, :2] @ [np.cos(normal), np.sin(normal)]
        low, high = np.quantile(across, [_OUTLYING, 1 - _OUTLYING])
        width = max(_JOINT_WIDTH, float(high - low) / _MOST_BINS)
        count = max(int(np.ceil((high - low) / width)), 1)
        place = np.floor((across - low) / width).astype(np.intp)
        number = np.where((place >= 0) & (place < count), place, count)
        runs = len(paths.logs)
        crossings = np.bincount(np.unique(number * runs + paths.owner) // runs, minlength=count + 1)
        crossed = np.flatnonzero(crossings[:count] >= _CROSSED)
        share = np.bincount(number, minlength=count + 1) / len(number)
        return _Bins(normal, low + (np.arange(count) + 0.5) * width, width, number, crossed, share)

    def scores(self, owner: NDArray[np.intp], pull: Array) -> Array:
        """Scores (Z, d) of the bins to use, of unit variance in sum, Eq. (4). owner (F,): the run of each sample."""
        count, runs = len(self.share), int(owner[-1]) + 1
        scores = np.bincount(owner * count + self.number, pull, runs * count).reshape(runs, count)
        scores -= scores.sum(axis=1, keepdims=True) * self.share  # the matrix holds what is the same everywhere
        of_bins = scores[:, self.crossed]
        normed: Array = of_bins / np.sqrt(np.maximum(np.square(of_bins).sum(axis=0), 1e-300))
        return normed.astype(np.float32)  # there are many, and no more digits are needed


_ROUNDING = 1e-16  # share of the largest column's square below which a column is what rounding leaves
_RANK = 1e-6  # share of a column's square that must be left beyond the others of its basis


def pull_in_modes(fit: Fit, paths: Paths) -> Array:
    """The pull (F, 4) of changes of each sample's motion in the modes in which smooth effects act."""
    return pull_by(fit, paths, [paths.by_modes[mode] for mode in MODES])


def pull_by(fit: Fit, paths: Paths, changes: Sequence[Array]) -> Array:
    """The pull (F, m): by how much half the chi-square falls with m changes (F, 3) of (z, theta) in each sample."""
    pull = np.zeros((len(paths.owner), len(changes)))
    first = 0
    for log, part, gradient in zip(paths.logs, paths.parts, fit.weighted_residuals, strict=True):
        rows = slice(first, first + len(log.times))
        first = rows.stop
        lever = paths.lever[part]
        swing = lever[:, 0] * gradient[:, 1] - lever[:, 1] * gradient[:, 0] + gradient[:, 2]
        later = np.column_stack([gradient[:, :2], swing])[::-1].cumsum(axis=0)[::-1]
        stamp = np.searchsorted(log.stamps, log.times - paths.signals.durations[rows] / 2)
        moved = np.vstack([later, np.zeros(3)])[stamp]
        for mode, change in enumerate(changes):
            pull[rows, mode] = (change[rows] * moved).sum(axis=1)  # Eq. (1)
    return pull


def independent_scores(scores: Array) -> list[Array]:
    """Scores (Z, B, d) of B bases as independent ones (Z, d) whose sums have unit variance, Eq. (2)."""
    of_bases = np.ascontiguousarray(scores.transpose(1, 0, 2))
    square = of_bases.transpose(0, 2, 1) @ of_bases
    sizes_of = np.diagonal(square, axis1=1, axis2=2)
    there = sizes_of > _ROUNDING * sizes_of.max(initial=0.0)  # a function that is the same everywhere leaves no more
    scale = np.where(there, 1 / np.sqrt(np.maximum(sizes_of, 1e-300)), 0.0)
    sizes, vectors = np.linalg.eigh(square * scale[:, :, None] * scale[:, None, :])
    known = sizes > _RANK
    independent = of_bases @ (scale[:, :, None] * vectors / np.sqrt(np.where(known, sizes, 1.0))[:, None, :])
    return [of_runs[:, rows] for of_runs, rows in zip(independent, known, strict=True)]
