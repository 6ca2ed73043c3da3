"""Fine structure: how the motion between poses depends on heading, place and time, finer than whole columns show.

Scores are those of local_scores.py: one product of matrices for all functions, however many.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product

import numpy as np

from omnibench.discover.fitting.model_fit import Fit, paths_of
from omnibench.discover.regressors.column_group import Group
from omnibench.discover.regressors.covariate_bases import Basis, area_of
from omnibench.discover.regressors.floor_joints import floor_joints
from omnibench.discover.regressors.local_scores import independent_scores, pull_in_modes
from omnibench.discover.regressors.paths import Paths
from omnibench.discover.regressors.significance import Significance, significance_of_scores, together
from omnibench.discover.regressors.wheel_waves import waves_of_wheels
from omnibench.robot.effects.effect import Values
from omnibench.robot.effects.smooth.motion import beyond, bump
from omnibench.robot.kinematics import Array

_COARSE = 0.1  # s: wheel samples are merged up to this duration
_FINE = 0.03  # s: shorter wheel samples are merged where joints of the floor and waves of wheels are looked for
_HARMONICS = 12  # of the heading
_SWINGS, _OF_SESSION = 48, 12  # half periods in the longest run and session (chosen; in 10 s, up to 2.4 Hz)
_WAVES = 400  # plane waves over the floor, at most; the shortest are left out
_DIRECTIONS, _LINES = 12, 9  # directions of lines across the floor, and lines for each
_EDGE = 0.05  # m, over which the floor changes at a line
_CELLS = 9  # patches along each side of the floor
_WIDE = 0.7  # radius of a patch, of the distance between two, as in covariate_bases.py
_RUNS = 15  # at least: the scatter of eight scores is hardly known from fewer; chosen
_SEEN = 0.002  # share of the samples that must lie in a patch, as in covariate_bases.py
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
    """Groups of each kind with their scores (Z, d), and whether these are to be studentised (local_scores.py, Eq. (2)).

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
    waves, lines, patches, area = _wave_numbers(), _lines(places), _patches(places), area_of(places)
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


def _patches(places: Array) -> list[dict[str, float]]:
    """Patches on a grid, where there are samples."""
    low = places.min(axis=0)
    spacing = (places.max(axis=0) - low) / (_CELLS - 1)
    radius, patches = _WIDE * float(spacing.max()), []
    for steps in product(range(_CELLS), repeat=2):
        x, y = (low + spacing * steps).tolist()
        patch = {"centre_x": x, "centre_y": y, "radius": radius}
        if (bump(places, patch) > np.exp(-1)).mean() > _SEEN:
            patches.append(patch)
    return patches
