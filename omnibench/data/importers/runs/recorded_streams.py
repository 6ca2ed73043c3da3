"""Wheels and reference of one recording, before it is cut into runs, and the matching of their clocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from omnibench.data.clock_matching import Streams, match_clocks
from omnibench.data.importers.runs.reference_options import ReferenceOptions
from omnibench.data.importers.runs.reference_stream import ReferenceStream
from omnibench.data.importers.wheel_samples import WheelSamples
from omnibench.robot.kinematics import Robot, in_the_middle
from omnibench.words import some

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
