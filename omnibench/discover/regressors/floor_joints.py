"""Joints of the floor, as between tiles: what happens to the motion within centimetres of parallel lines.

Across lines with the normal n a place p has the coordinate u = n . p. Let s_zb be the score of run z for a change of
the motion in bin b of u alone (local_scores.py, Eq. (1)), beyond a change of the same size everywhere. With the bins
of n and of the direction across it together, since tiles have joints both ways,

    Q = sum over b of (sum over z of s_zb)^2 / (sum over z of s_zb^2)                                               (1)

has the expectation of the number of bins where nothing is missing. Scores of neighbouring bins go along with each
other, as a pose shows all that happened before: how far Q exceeds its expectation by chance is found by changing the
signs of whole runs (significance.py, Eq. (2)).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.discover.regressors.column_group import Group
from omnibench.discover.regressors.covariate_bases import Basis
from omnibench.discover.regressors.paths import Paths
from omnibench.robot.kinematics import Array

_DIRECTIONS = 45  # normals within a right angle: at 1 m from the middle the nearest is half a bin off at most
_WIDTH = 0.03  # m, of a bin: wheels meet a joint within a part of their own size; chosen
_MOST_BINS = 300  # each way: on larger floors bins are wider (chosen)
_CROSSED = 5  # runs that must cross a bin: the scatter of fewer says nothing (chosen)
_OUTLYING = 0.005  # share of the samples beyond the bins on either side
_MOST_LINES = 40  # candidates in each direction and across it: so many tiles of 0.3 m lie over 6 m both ways (chosen)
_SURE = 2.0  # standard deviations by which a line must show to be a candidate of a model: by chance one in 22 does
# Modes, by their numbers in MODES, that joints change together: the wheels are held up, or the robot is knocked round.
_CHANGES = {"slow the robot": (0, 3), "turn the robot": (2,)}


def floor_joints(paths: Paths, pull: Array) -> Iterator[tuple[Group, Array]]:
    """Groups of lines in one direction and across it, and their scores (Z, d). pull (F, 4): of each sample and mode."""
    if float(np.ptp(paths.middle[:, :2], axis=0).max()) < 2 * _WIDTH:
        return
    for normal in (np.pi / 2 / _DIRECTIONS * np.arange(_DIRECTIONS)).tolist():
        bins = [_Bins.of(paths, angle) for angle in (normal, normal + np.pi / 2)]
        for words, modes in _CHANGES.items():
            of_samples = pull[:, list(modes)].sum(axis=1)
            scores = [of_axis.scores(paths.owner, of_samples) for of_axis in bins]
            together = np.concatenate(scores, axis=1)
            if together.shape[1]:
                lines = [line for both in zip(bins, scores, strict=True) for line in _lines(*both)]
                parts = tuple(shapes for _, shapes in sorted(lines, key=lambda line: -line[0])[:_MOST_LINES])
                detail, tries = f"joints of the floor that {words}, such as tiles have", _DIRECTIONS * len(_CHANGES)
                basis = Basis("place", "body", detail, None, tries, "smooth_joint", {"normal": normal}, parts)
                yield Group("covariate", "place", (), tries=tries, basis=basis), together


def _lines(bins: _Bins, scores: Array) -> Iterator[tuple[float, dict[str, float]]]:
    """The lines in whose bins most happens, by how many standard deviations."""
    for distance, score in zip(bins.middles[bins.kept].tolist(), np.abs(scores.sum(axis=0)).tolist(), strict=True):
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
    kept: NDArray[np.intp]
    share: Array

    @staticmethod
    def of(paths: Paths, normal: float) -> _Bins:
        """The bins over the places of some paths, but for the outermost ones."""
        across = paths.middle[:, :2] @ [np.cos(normal), np.sin(normal)]
        low, high = np.quantile(across, [_OUTLYING, 1 - _OUTLYING])
        width = max(_WIDTH, float(high - low) / _MOST_BINS)
        count = max(int(np.ceil((high - low) / width)), 1)
        place = np.floor((across - low) / width).astype(np.intp)
        number = np.where((place >= 0) & (place < count), place, count)
        runs = len(paths.logs)
        crossed = np.bincount(np.unique(number * runs + paths.owner) // runs, minlength=count + 1)
        kept = np.flatnonzero(crossed[:count] >= _CROSSED)
        share = np.bincount(number, minlength=count + 1) / len(number)
        return _Bins(normal, low + (np.arange(count) + 0.5) * width, width, number, kept, share)

    def scores(self, owner: NDArray[np.intp], pull: Array) -> Array:
        """Scores (Z, d) of the bins to use, of unit variance in sum, Eq. (1). owner (F,): the run of each sample."""
        count, runs = len(self.share), int(owner[-1]) + 1
        scores = np.bincount(owner * count + self.number, pull, runs * count).reshape(runs, count)
        scores -= scores.sum(axis=1, keepdims=True) * self.share  # the matrix holds what is the same everywhere
        of_bins = scores[:, self.kept]
        normed: Array = of_bins / np.sqrt(np.maximum(np.square(of_bins).sum(axis=0), 1e-300))
        return normed.astype(np.float32)  # there are many, and no more digits are needed
