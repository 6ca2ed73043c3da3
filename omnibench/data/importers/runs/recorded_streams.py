"""Wheels and reference of one recording, before it is cut into runs, and the matching of their clocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from omnibench.data.clock_matching import Streams, match_clocks
from omnibench.data.importers.recording_options import ReferenceOptions, units_of
from omnibench.data.importers.wheel_samples import WheelSamples
from omnibench.data.references import KINDS, UNITS, References
from omnibench.robot.kinematics import Array, Robot, in_the_middle
from omnibench.words import some


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


_UNKNOWN = 5.0  # s, by which an offset is looked for where wheels and poses are of different epochs; chosen


@dataclass(frozen=True, eq=False)
class RecordedStreams:
    """A recording: its wheel samples and its reference. name: of the recording. place: its file, for messages."""

    name: str
    place: str
    samples: WheelSamples
    reference: ReferenceStream


def by_one_clock(
    recordings: Sequence[RecordedStreams], options: ReferenceOptions, notes: list[str]
) -> list[RecordedStreams]:
    """The recordings with poses by the wheels' clock, which is matched if the options say so, and said then."""
    if options.clocks == "same":
        return list(recordings)
    posed = [recording for recording in recordings if len(recording.reference.times) > 1]
    begun = [_begun_together(recording) for recording in posed]
    search = {} if begun == posed else {"search": _UNKNOWN}
    matches = match_clocks(options.robot, [_streams(options.robot, each) for each in begun], **search)
    matched, said, unknown = [], [], []
    for given, recording, match in zip(posed, begun, matches, strict=True):
        if match is None:
            matched.append(given)
            unknown.append(given.name)
            continue
        moved = replace(recording, reference=recording.reference.by_clock(match.offset, match.drift))
        matched.append(moved)
        offset = moved.reference.times[0] - given.reference.times[0]
        drift = f" and {60e3 * match.drift:+.1f} ms a minute" if match.drift else ""
        said.append(f"{given.name} {offset:+.3f} s{drift}")
    if said:
        notes.append(f"clocks matched, added to the times of the poses: {some(said)}")
    if unknown:
        notes.append(
            f"clocks not matched, as the motion is too short or too even: {some(unknown)}; give "
            "--set pose_time_offset=SECONDS, or drive with more turns"
        )
    by_name = {recording.name: recording for recording in matched}
    return [by_name.get(recording.name, recording) for recording in recordings]


def _begun_together(recording: RecordedStreams) -> RecordedStreams:
    """The recording; where wheels and poses share no time, with poses that begin with the wheels."""
    samples, reference = recording.samples, recording.reference
    if reference.times[0] < samples.ends[-1] and reference.times[-1] > samples.begins[0]:
        return recording
    return replace(recording, reference=reference.by_clock(float(samples.begins[0] - reference.times[0]), 0.0))


def _streams(robot: Robot, recording: RecordedStreams) -> Streams:
    """The streams from the begin of the wheels on; samples that are missing count as standing."""
    samples, zero = recording.samples, float(recording.samples.begins[0])
    steering = None if samples.steering is None else in_the_middle(samples.steering)
    driven = robot.drive.signals(samples.rates, steering) * (samples.ends - samples.begins)[:, None]
    counted = np.vstack([np.zeros(driven.shape[1]), np.cumsum(driven, axis=0)])
    edges = np.append(samples.begins[0], samples.ends) - zero
    poses = recording.reference.poses.copy()
    poses[:, 2] = np.unwrap(poses[:, 2])
    return Streams(edges, counted, recording.reference.times - zero, poses)
