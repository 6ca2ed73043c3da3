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
_Fit = tuple[float, float, float, float, float, bool]

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
def grow_lines(points: _Float, rays: _Int, part_of: _Int) -> _Float:
    """Lines through neighbouring points (m, 7): a, b, covariances aa, ab, bb, index of the first and last point.

    points (n, 4): their ranges, cosines and sines of their directions, and deviations of the ranges, in the order of
    their rays (n,). part_of (n,): output, the number of the line that a point is part of, or -1.
    """
    count = len(points)
    grown = np.empty((count // _SEED + 1, 7))
    lines, first = 0, 0
    part_of[:] = -1
    while first + _SEED <= count:
        last = first + _SEED
        fit = _fit(points, first, last)
        if rays[last - 1] - rays[first] >= _SEED + _GAP or not fit[5]:
            first += 1
            continue
        ended = False
        while not ended:
            reach, ended = _reach(points, rays, first, last, fit)
            if reach <= last:
                break
            longer = _fit(points, first, reach)
            if not longer[5]:
                break
            last, fit = reach, longer
        grown[lines, 0], grown[lines, 1], grown[lines, 2], grown[lines, 3], grown[lines, 4] = fit[:5]
        grown[lines, 5], grown[lines, 6] = first, last - 1
        for point in range(first, last):
            distance, cosine, sine, deviation = points[point, 0], points[point, 1], points[point, 2], points[point, 3]
            if abs(distance - _seen(fit, cosine, sine)) < _ON * deviation:
                part_of[point] = lines
        lines += 1
        first = last
    return grown[:lines]


@compiled
def _reach(points: _Float, rays: _Int, first: int, last: int, fit: _Fit) -> tuple[int, bool]:
    """Index up to which the following points lie on a line, at most twice its length on; and whether the line ends."""
    most = min(len(points), first + _MOST, 2 * last - first)
    off = 0
    point = last
    while point < most:
        distance, cosine, sine, deviation = points[point, 0], points[point, 1], points[point, 2], points[point, 3]
        seen = _seen(fit, cosine, sine)
        slope_a, slope_b = seen * seen * cosine, seen * seen * sine
        variance = deviation**2
        variance += slope_a * slope_a * fit[2] + 2 * slope_a * slope_b * fit[3] + slope_b * slope_b * fit[4]
        across = seen * cosine - points[first, 0] * points[first, 1]
        along = seen * sine - points[first, 0] * points[first, 2]
        on = seen > 0 and (distance - seen) ** 2 < _ON * _ON * variance and math.hypot(across, along) < _LONGEST
        off = 0 if on else off + 1
        if off == _OFF or rays[point] - rays[point - 1] > _GAP:
            return point + 1 - off - _TRIMMED, True
        point += 1
    return most, most == len(points) or most == first + _MOST


@compiled
def _fit(points: _Float, first: int, last: int) -> _Fit:
    """Fit a line: a, b, covariances aa, ab, bb; and whether the points, without outliers, are enough and on it."""
    a = b = aa = ab = bb = misfit = 0.0
    count = 0
    for step in range(_STEPS + 2):  # the first finds the line by its inverse range, the last only judges it
        aa = ab = bb = right_a = right_b = misfit = 0.0
        count = 0
        for point in range(first, last):
            distance, cosine, sine, deviation = points[point, 0], points[point, 1], points[point, 2], points[point, 3]
            seen, error = distance, -distance
            if step > 0:
                inverse = a * cosine + b * sine
                seen = 1.0 / inverse if inverse > 1e-9 else 1e9
                error = distance - seen
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
            count += 1
        determinant = aa * bb - ab * ab
        if count < 3 or determinant <= 0.0:
            return a, b, 0.0, 0.0, 0.0, False
        if step <= _STEPS:
            a += (bb * right_a - ab * right_b) / determinant
            b += (aa * right_b - ab * right_a) / determinant
    freedom = float(count) - 2
    straight = freedom >= _FEWEST - 2 and misfit < freedom + _MISFIT * math.sqrt(2.0 * freedom)
    return a, b, bb / determinant, -ab / determinant, aa / determinant, straight


@compiled
def _seen(fit: _Fit, cosine: float, sine: float) -> float:
    inverse = fit[0] * cosine + fit[1] * sine
    return 1.0 / inverse if inverse > 1e-9 else -1.0


# Load the compiled code, or compile it, on import: processes that are forked from this one then have it.
grow_lines(np.empty((0, 4)), *np.empty((2, 0), dtype=np.int64))
