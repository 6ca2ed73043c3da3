"""Reference poses of a recording, and what the options make of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from omnibench.data.importers.runs.reference_options import ReferenceOptions, units_of
from omnibench.robot.kinematics import Array


@dataclass(frozen=True, eq=False)
class ReferenceStream:
    """Reference poses (K, 3), m, m, rad, at times (K,), s, of any epoch; covariances (K, 3, 3) where there are any."""

    times: Array
    poses: Array
    covariances: Array | None = None

    def read_as(self, options: ReferenceOptions, radian: float = 1.0) -> ReferenceStream:
        """The stream in SI units and in the robot's senses, by its clock. radian: unit of the headings as recorded."""
        factors = np.array(units_of(options, radian))
        times, poses, covariances = self.times, self.poses, self.covariances
        if (factors != 1.0).any():
            poses = poses * factors
            covariances = None if covariances is None else covariances * np.outer(factors, factors)
        if options.heading_offset_deg:
            poses = poses + np.array([0.0, 0.0, np.radians(options.heading_offset_deg)])
        return ReferenceStream(times, poses, covariances).by_clock(options.pose_time_offset, options.pose_time_drift)

    def by_clock(self, offset: float, drift: float) -> ReferenceStream:
        """The stream with times that are later by offset (s) and by drift (s per s since the first pose)."""
        if not offset and not drift:
            return self
        return replace(self, times=self.times + (offset + drift * (self.times - self.times[0])))
