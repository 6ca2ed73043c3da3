"""Mounting of a scanner on its robot by the fixed transforms of a bag (``/tf_static``)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from omnibench.data.importers.rosbag.bag import Bag
from omnibench.data.scans import Mount
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array

_BASES = ("base_link", "base_footprint", "base")  # REP-105; with or without the robot's namespace
_LARGEST_TILT = math.radians(20)  # rad; a scanner with a larger tilt does not scan parallel to the floor (chosen)


@dataclass(frozen=True)
class ScannerMounting:
    """A scanner's mount. upside_down: its counter-clockwise rays run clockwise in the robot's frame."""

    mount: Mount
    upside_down: bool = False


def scanner_mounting(bag: Bag, frame: str) -> ScannerMounting | None:
    """Mounting of the scanner with a frame; None if the bag has no transform to it. DataError: it is tilted."""
    parents = fixed_transforms(bag)
    child, whole = frame.strip("/"), np.eye(4)
    for _ in range(len(parents) + 1):
        if child.rpartition("/")[2] in _BASES:
            return _planar(whole, bag, frame)
        if child not in parents:
            return None
        child, step = parents[child]
        whole = step @ whole
    return None  # a ring of frames


def fixed_transforms(bag: Bag) -> dict[str, tuple[str, Array]]:
    """Parent of every frame, and the transform (4, 4) from the frame to its parent."""
    from scipy.spatial.transform import Rotation  # slow to import, and needed by bags with transforms alone

    parents: dict[str, tuple[str, Array]] = {}
    for topic in bag.topics:
        if topic.type != "tf2_msgs/msg/TFMessage" or not topic.name.endswith("tf_static"):
            continue
        for record in bag.records(topic):
            for stamped in getattr(record.message, "transforms", ()):
                turn, place = stamped.transform.rotation, stamped.transform.translation
                matrix = np.eye(4)
                try:
                    matrix[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
                except ValueError:  # all zeros: no rotation, and so no transform
                    continue
                matrix[:3, 3] = place.x, place.y, place.z
                if np.isfinite(matrix).all():
                    parents[stamped.child_frame_id.strip("/")] = stamped.header.frame_id.strip("/"), matrix
    return parents


def _planar(transform: Array, bag: Bag, frame: str) -> ScannerMounting:
    tilt = math.acos(np.clip(transform[2, 2], -1.0, 1.0))
    upside_down = tilt > math.pi / 2
    if min(tilt, math.pi - tilt) > _LARGEST_TILT:
        raise DataError(
            f"{bag.path}: the scanner's frame {frame} is tilted by {math.degrees(tilt):.0f} degrees, so that it does "
            "not scan the plane of the floor; if it does, set scanner_mount; scans=false leaves the scans out"
        )
    yaw = math.atan2(transform[1, 0], transform[0, 0])
    return ScannerMounting(Mount(x=float(transform[0, 3]), y=float(transform[1, 3]), yaw=yaw), upside_down)
