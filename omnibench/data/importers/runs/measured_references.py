"""Distances, turns, positions and the like of a recording, read as the options say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omnibench.data.importers.runs.reference_options import ReferenceOptions, units_of
from omnibench.data.references.run_references import KINDS, UNITS, References
from omnibench.robot.kinematics import Array


def measured_as(measured: References, options: ReferenceOptions, radian: float) -> References:
    """References in SI units and in the robot's senses. radian: unit of the angles as recorded.

    The signs of the poses hold for x and y of positions and displacements, and for turns and headings; distances have
    none. Headings in a fixed frame are turned by ``heading_offset_deg``.
    """
    x, y, heading = units_of(options, radian)
    angles = np.isin(measured.kinds, [kind for kind in KINDS if UNITS[kind] == "rad"])
    first = np.where(angles, heading, np.where(measured.planar, x, abs(x)))
    factors = np.column_stack([first, np.full(len(first), y)])
    values = measured.values * factors
    fixed = measured.fixed_frame & angles
    values[fixed, 0] += np.radians(options.heading_offset_deg)
    return replace(
        measured,
        values=values,
        sigmas=measured.sigmas * np.abs(factors),
        rate_sigma=measured.rate_sigma * abs(heading),
    )


def measured_later(measured: References, offset: float, drift: float, first: float) -> References:
    """References that are later by offset, s, and by drift, s per s since the time ``first``."""

    def later(times: Array) -> Array:
        known = np.where(np.isfinite(times), times, first)
        return np.where(np.isfinite(times), times + (offset + drift * (known - first)), times)

    return replace(measured, t0=later(measured.t0), t1=later(measured.t1))
