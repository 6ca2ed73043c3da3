"""Growing of line segments along the points of a scan, compiled.

A line n.p = d is seen along the direction phi at the range 1 / (a cos phi + b sin phi) with (a, b) = n / d. The fit is
to the ranges, since only they are noisy; a fit to the points would tilt towards the scanner.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.compiled import compiled

_Float = NDArray[np.float64]
_Int = NDArray[np.int64]
_Fit = tuple[float, float, float, float, float, float, float]

# The study tests/studies/constants_slam.py varies these numbers by 0.5 and 2. In three rooms SLAM's median error,
# 1.07 mm as they are, is 0.98 to 1.25 mm and the median NEES, 2.5, is 2.4 to 3.3 (3 for an honest covariance).
# Worse are a seed of 16 points (1.5 mm), outliers beyond 2 deviations (1.8 mm) and fits of no fewer than 12 points (no
# lines).
_SEED = 8  # points that a segment begins with
_MOST = 256  # points of a segment
_LONGEST = 5.0  # m, length of a segment
_GAP = 6  # rays without a point that a segment may have
_STEPS = 2  # Gauss-Newton steps
_ON = 3.0  # standard deviations within which a point is on the line
_OFF = 2  # successive points off the line that end it
_FAR = 4.0  # standard deviations beyond which a point does not count in the fit
_FEWEST = 6  # points that a fit needs
_MISFIT = 3.0  # standard deviations, sqrt(2 f), by which the misfit may exceed its mean f (chi-square)
_TRIMMED = 2  # points dropped before such an end, since they may belong to the next segment


@compiled
def grow_lines(ranges: _Float, cosines: _Float, sines: _Float, deviations: _Float, rays: _Int, part_of: _Int) -> _Float:
    """Lines through neighbouring points (m, 7): a, b, covariances aa, ab, bb, index of the first and last point.

    ranges, cosines, sines, deviations (n,): the points' values, in the order of their rays (n,). part_of (n,): output,
    the number of the line that a point is part of, or -1.
    """
    count = len(ranges)
    grown = np.empty((count // _SEED + 1, 7))
    lines, first = 0, 0
    part_of[:] = -1
    while first + _SEED <= count:
        last = first + _SEED
        fit = _fit(ranges, cosines, sines, deviations, first, last)
        if rays[last - 1] - rays[first] >= _SEED + _GAP or not _straight(fit):
            first += 1
            continue
        ended = False
        while not ended:
            reach, ended = _reach(ranges, cosines, sines, deviations, rays, first, last, fit)
            if reach <= last:
                break
            longer = _fit(ranges, cosines, sines, deviations, first, reach)
            if not _straight(longer):
                break
            last, fit = reach, longer
        for column in range(5):
            grown[lines, column] = fit[column]
        grown[lines, 5], grown[lines, 6] = first, last - 1
        for point in range(first, last):
            if abs(ranges[point] - _seen(fit, cosines[point], sines[point])) < _ON * deviations[point]:
                part_of[point] = lines
        lines += 1
        first = last
    return grown[:lines]


@compiled
def _reach(
    ranges: _Float,
    cosines: _Float,
    sines: _Float,
    deviations: _Float,
    rays: _Int,
    first: int,
    last: int,
    fit: _Fit,
) -> tuple[int, bool]:
    """Index up to which the following points lie on a line, at most twice its length on; and whether the line ends."""
    most = min(len(ranges), first + _MOST, 2 * last - first)
    off = 0
    point = last
    while point < most:
        seen = _seen(fit, cosines[point], sines[point])
        slope_a, slope_b = seen * seen * cosines[point], seen * seen * sines[point]
        variance = deviations[point] ** 2
        variance += slope_a * slope_a * fit[2] + 2 * slope_a * slope_b * fit[3] + slope_b * slope_b * fit[4]
        across = seen * cosines[point] - ranges[first] * cosines[first]
        along = seen * sines[point] - ranges[first] * sines[first]
        on = seen > 0 and (ranges[point] - seen) ** 2 < _ON * _ON * variance and math.hypot(across, along) < _LONGEST
        off = 0 if on else off + 1
        if off == _OFF or rays[point] - rays[point - 1] > _GAP:
            return point + 1 - off - _TRIMMED, True
        point += 1
    return most, most == len(ranges) or most == first + _MOST


@compiled
def _fit(ranges: _Float, cosines: _Float, sines: _Float, deviations: _Float, first: int, last: int) -> _Fit:
    """Fit a line: a, b, covariances aa, ab, bb, misfit (sum of squares), number of points without outliers."""
    a = b = 0.0
    aa = ab = bb = misfit = 0.0
    points = 0
    for step in range(_STEPS + 2):  # the first finds the line by its inverse range, the last only judges it
        aa = ab = bb = right_a = right_b = misfit = 0.0
        points = 0
        for point in range(first, last):
            cosine, sine, deviation = cosines[point], sines[point], deviations[point]
            if step == 0:
                seen, error = ranges[point], -ranges[point]
            else:
                inverse = a * cosine + b * sine
                seen = 1.0 / inverse if inverse > 1e-9 else 1e9
                error = ranges[point] - seen
                if step > 1 and abs(error) > _FAR * deviation:
                    continue
            slope_a, slope_b = -seen * seen * cosine / deviation, -seen * seen * sine / deviation
            error /= deviation
            aa += slope_a * slope_a
            ab += slope_a * slope_b
            bb += slope_b * slope_b
            right_a += slope_a * error
            right_b += slope_b * error
            misfit += error * error
            points += 1
        determinant = aa * bb - ab * ab
        if points < 3 or determinant <= 0.0:
            return a, b, 0.0, 0.0, 0.0, math.inf, float(points)
        if step <= _STEPS:
            a += (bb * right_a - ab * right_b) / determinant
            b += (aa * right_b - ab * right_a) / determinant
    return a, b, bb / determinant, -ab / determinant, aa / determinant, misfit, float(points)


@compiled
def _straight(fit: _Fit) -> bool:
    freedom = fit[6] - 2
    return freedom >= _FEWEST - 2 and fit[5] < freedom + _MISFIT * math.sqrt(2.0 * freedom)


@compiled
def _seen(fit: _Fit, cosine: float, sine: float) -> float:
    inverse = fit[0] * cosine + fit[1] * sine
    return 1.0 / inverse if inverse > 1e-9 else -1.0


# Load the compiled code, or compile it, on import: processes that are forked from this one then have it.
grow_lines(*np.empty((4, 0)), *np.empty((2, 0), dtype=np.int64))
