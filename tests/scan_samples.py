"""What a laser scanner sees from the simulated drive of ``bag_samples``: a room with things in it, as ROS messages."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from bag_samples import DRIVE, EPOCH, ROBOT, SLAM, TRUTH, Drive, Sent, header, part

from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

SCAN, SCANS = "/robot/scan", "sensor_msgs/msg/LaserScan"
RAYS, ANGLE_MIN, INCREMENT = 361, -0.75 * math.pi, 1.5 * math.pi / 360
RANGE_MIN, RANGE_MAX = 0.1, 30.0
MOUNT = (0.12, -0.03, 0.2)  # m, m, rad
SCAN_PERIOD = 200_000_000  # ns
SECONDS = 12.4  # two runs
FIRST = 60_000_000  # ns, until the first scan


def _box(left: float, right: float, low: float, high: float) -> list[tuple[float, float, float, float]]:
    """Four walls, each from (x, y) to (x, y)."""
    corners = [(left, low), (right, low), (right, high), (left, high)]
    return [(*a, *b) for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)]


# The drive stays in x -0.1 .. 2.1 m, y -3.1 .. -0.9 m.
WALLS = np.array(
    [
        *_box(-3.0, 5.0, -6.0, 2.0),
        *_box(3.6, 4.4, -1.2, 0.1),
        *_box(-2.6, -1.9, -3.9, -2.5),
        *_box(0.2, 1.6, 1.0, 1.5),
        (-3.0, 0.4, -2.0, 2.0),
        (2.5, -6.0, 5.0, -4.2),
    ]
)


def seen(place: Sequence[float] | Array, rays: int = RAYS) -> Array:
    """Ranges (rays,) in m from a pose of the robot, without noise; the scan is taken at one instant."""
    x, y, heading = place
    mount = np.array([MOUNT[0] + 1j * MOUNT[1]]) * np.exp(1j * heading) + x + 1j * y
    origin = np.array([mount[0].real, mount[0].imag])
    angles = heading + MOUNT[2] + ANGLE_MIN + INCREMENT * np.arange(rays)
    rays_x, rays_y = np.cos(angles)[:, None], np.sin(angles)[:, None]
    from_x, from_y = WALLS[:, 0] - origin[0], WALLS[:, 1] - origin[1]
    along_x, along_y = WALLS[:, 2] - WALLS[:, 0], WALLS[:, 3] - WALLS[:, 1]
    cross = rays_x * along_y - rays_y * along_x
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (from_x * along_y - from_y * along_x) / cross
        share = (from_x * rays_y - from_y * rays_x) / cross
    hit = (reach > 0) & (share >= 0) & (share <= 1)
    return np.where(hit, reach, np.inf).min(axis=1)


def laser_scan(stamp: int, ranges: Iterable[float], **others: Any) -> Sent:
    """A message of the scanner; ``others``: other content."""
    content = {
        "header": header(stamp, "laser"),
        "angle_min": ANGLE_MIN,
        "angle_max": ANGLE_MIN + INCREMENT * (RAYS - 1),
        "angle_increment": INCREMENT,
        "time_increment": 0.0,
        "scan_time": 0.0,
        "range_min": RANGE_MIN,
        "range_max": RANGE_MAX,
        "ranges": list(ranges),
        "intensities": [],
    }
    return Sent(SCAN, SCANS, content | others, int(stamp) + 30_000_000)


def true_places(driven: Drive, stamps: Sequence[int] | Array) -> Array:
    """Where the robot of the drive truly was (K, 3)."""
    times = (driven.stamps[1:] - EPOCH) / 1e9
    log = WheelLog(times, driven.rates, np.array([1.0, -2.0, 3.0]), (np.asarray(stamps) - EPOCH) / 1e9)
    return OdometryModel(ROBOT, TRUTH, "arc").poses([log])[0]


def scans(seconds: float, noise: float = 0.01, driven: Drive = DRIVE) -> list[Sent]:
    """The scans of the first so many seconds of the drive."""
    rng = np.random.default_rng(5)
    stamps = np.arange(EPOCH + FIRST, min(EPOCH + int(seconds * 1e9), driven.stamps[-1]), SCAN_PERIOD)
    return [
        laser_scan(int(stamp), seen(place) + noise * rng.standard_normal(RAYS))
        for stamp, place in zip(stamps, true_places(driven, stamps), strict=True)
    ]


def transform(parent: str, child: str, x: float, y: float, yaw: float, *, roll: float = 0.0) -> dict[str, Any]:
    """A fixed transform: a roll of the child, then a yaw."""
    turn = {
        "x": math.cos(yaw / 2) * math.sin(roll / 2),
        "y": math.sin(yaw / 2) * math.sin(roll / 2),
        "z": math.sin(yaw / 2) * math.cos(roll / 2),
        "w": math.cos(yaw / 2) * math.cos(roll / 2),
    }
    return {
        "header": header(EPOCH, parent),
        "child_frame_id": child,
        "transform": {"translation": {"x": x, "y": y, "z": 0.3}, "rotation": turn},
    }


def tf_static(*transforms: dict[str, Any]) -> Sent:
    return Sent("/tf_static", "tf2_msgs/msg/TFMessage", {"transforms": list(transforms)}, EPOCH - 1_000_000)


MOUNTED = tf_static(transform("base_link", "laser", *MOUNT))


def without_poses(extra: Sequence[Sent] = (MOUNTED,), seconds: float = SECONDS) -> list[Sent]:
    """The first seconds of the drive with scans, and without reference poses."""
    return [each for each in [*part(seconds), *scans(seconds), *extra] if each.topic != SLAM]
