"""Poses of one frame in another by the transforms of a bag (``/tf`` and ``/tf_static``)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from omnibench.data.importers.rosbag.bag import Bag, Topic
from omnibench.data.importers.rosbag.message_streams import PoseStream, read_poses
from omnibench.data.importers.rosbag.scan_stream import fixed_transforms
from omnibench.errors import ConfigError, nearest
from omnibench.robot.kinematics import Array, compose, interpolated


def read_transforms(bag: Bag, topic: Topic, frames: Sequence[str], warnings: list[str]) -> PoseStream:
    """Poses of the second of two frames in the first, at the stamps of the rarest transform between them.

    Transforms between are composed in the plane. ConfigError: no frames are given, or nothing leads from one to the
    other. DataError as for ``read_poses``.
    """
    moving = _parents(bag, topic)
    fixed = fixed_transforms(bag)
    parents = moving | {child: parent for child, (parent, _) in fixed.items()}
    shown = ", ".join(f"{parent} > {child}" for child, parent in parents.items()) or "none"
    place = f"{bag.path}: topic {topic.name}"
    if not frames:
        raise ConfigError(f"{place}: set pose_frames=[world, robot] to the frames of the reference; found: {shown}")
    world, child = (frame.strip("/") for frame in frames)
    links: list[str] = []
    while child != world:
        if child not in parents or child in links:
            known = {*parents, *parents.values()}
            hint = nearest(child if links else frames[1], known) if child not in known else ""
            raise ConfigError(
                f"{place}: pose_frames: no transforms lead from {world} to {frames[1]}; {hint}found: {shown}"
            )
        links.append(child)
        child = parents[child]
    streams = {link: read_poses(bag, topic, warnings, partial(_transform, link)) for link in links if link in moving}
    if not streams:
        raise ConfigError(f"{place}: pose_frames: {frames[1]} does not move in {world}; found: {shown}")
    stamps = min(streams.values(), key=lambda stream: len(stream.stamps)).stamps
    begin, end = max(each.stamps[0] for each in streams.values()), min(each.stamps[-1] for each in streams.values())
    stamps = stamps[(stamps >= begin) & (stamps <= end)]
    poses: Array = np.zeros((len(stamps), 3))
    for link in reversed(links):
        poses = compose(
            poses,
            _at(streams[link], stamps) if link in streams else np.broadcast_to(_planar(fixed[link][1]), poses.shape),
        )
    return PoseStream(stamps, poses, None)


def _parents(bag: Bag, topic: Topic) -> dict[str, str]:
    """The parent of every frame that moves."""
    return {
        stamped.child_frame_id.strip("/"): stamped.header.frame_id.strip("/")
        for record in bag.records(topic)
        for stamped in getattr(record.message, "transforms", ())
    }


def _transform(child: str, message: Any) -> Any:
    """The transform of a frame in a message of transforms; None if it is not in it."""
    return next((each for each in message.transforms if each.child_frame_id.strip("/") == child), None)


def _at(stream: PoseStream, stamps: Any) -> Array:
    """Poses (K, 3) at stamps (K,), by straight lines between those of a stream."""
    poses = np.column_stack([stream.poses[:, :2], np.unwrap(stream.poses[:, 2])])
    return interpolated((stamps - stream.stamps[0]) / 1e9, (stream.stamps - stream.stamps[0]) / 1e9, poses)


def _planar(transform: Array) -> Array:
    return np.array([*transform[:2, 3], np.arctan2(transform[1, 0], transform[0, 0])])
