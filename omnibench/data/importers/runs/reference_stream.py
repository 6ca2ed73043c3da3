"""Reference poses of a recording, and what the options make of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

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


@dataclass(frozen=True, eq=False)
class ReferenceStream:
    """Reference poses (K, 3), m, m, rad, at times (K,), s, of any epoch; covariances (K, 3, 3) where there are any.

    measured: distances, turns, positions and the like, by the same clock, which may be there in the place of poses.
    """

    times: Array
    poses: Array
    covariances: Array | None = None
    measured: References | None = None

    @classmethod
    def without_poses(cls, measured: References | None = None) -> ReferenceStream:
        """A stream of references of other kinds alone."""
        return cls(np.empty(0), np.empty((0, 3)), measured=measured)

    def read_as(
        self, options: ReferenceOptions, radian: float = 1.0, measured_radian: float | None = None
    ) -> ReferenceStream:
        """The stream in SI units and in the robot's senses, by its clock.

        radian: unit of the headings as recorded. measured_radian: of measured turns and headings, if it is another.
        """
        factors = np.array(units_of(options, radian))
        times, poses, covariances = self.times, self.poses, self.covariances
        if (factors != 1.0).any():
            poses = poses * factors
            covariances = None if covariances is None else covariances * np.outer(factors, factors)
        if options.heading_offset_deg:
            poses = poses + np.array([0.0, 0.0, np.radians(options.heading_offset_deg)])
        measured = None if self.measured is None else measured_as(self.measured, options, measured_radian or radian)
        stream = ReferenceStream(times, poses, covariances, measured)
        return stream.by_clock(options.pose_time_offset, options.pose_time_drift)

    def by_clock(self, offset: float, drift: float) -> ReferenceStream:
        """The stream with times that are later by offset (s) and by drift (s per s since its begin)."""
        if not offset and not drift:
            return self
        first = self.begin
        measured = None if self.measured is None else measured_later(self.measured, offset, drift, first)
        return replace(self, times=self.times + (offset + drift * (self.times - first)), measured=measured)

    @property
    def begin(self) -> float:
        """Time of the first pose, without poses of the first reference that has a time, s; 0 if none has."""
        if len(self.times):
            return float(self.times[0])
        known = np.empty(0) if self.measured is None else np.concatenate([self.measured.t0, self.measured.t1])
        return float(known[np.isfinite(known)].min(initial=np.inf)) if np.isfinite(known).any() else 0.0
