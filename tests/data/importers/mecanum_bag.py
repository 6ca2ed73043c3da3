"""A ROS 1 bag of a simulated mecanum base as other people's drivers record it; it shares nothing with omnibench.

The encoders sit at the motors and count into 16 bits; the motors on the right are mounted the other way round.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from bag_samples import EPOCH, Sent, header, joint_state, pose, write_rosbag1

GEAR, TICKS = 30, 2048
WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
ALONG, ACROSS = np.array([0.2, 0.2, -0.2, -0.2]), np.array([0.15, -0.15, 0.15, -0.15])  # m, of the design
DESIGN: dict[str, Any] = {
    "name": "base",
    "wheels": [
        {"name": name, "type": "mecanum", "radius": 0.05, "x": x, "y": y, "roller_angle_deg": math.copysign(45, x * y)}
        for name, x, y in zip(WHEELS, ALONG.tolist(), ACROSS.tolist(), strict=True)
    ],
}
RADII = 0.05 * np.array([1.01, 0.985, 1.02, 0.995])  # m, the true ones
HALF_SUM = 0.357  # m, the true one; 0.35 by the design
PERIOD, RUN, REST = 0.02, 2.0, 0.8  # s


def write_mecanum_bag(path: Path) -> Path:
    """Twenty drives, each direction twice with either turn; wheels at 50 Hz, poses of a tracker at 25 Hz."""
    rng = np.random.default_rng(1)
    still = np.zeros((round(REST / PERIOD), 3))
    parts = [still]
    for turn in (-0.6, 0.6, 0.6, -0.6):
        for direction in 0.4 + 2 * math.pi / 5 * np.arange(5):
            twist = [0.25 * math.cos(direction), 0.25 * math.sin(direction), turn]
            parts += [np.tile(twist, (round(RUN / PERIOD), 1)), still]
    vx, vy, w = np.concatenate(parts).T
    rates = (vx[:, None] - np.sign(ALONG * ACROSS) * vy[:, None] - np.sign(ACROSS) * HALF_SUM * w[:, None]) / RADII
    rates *= 1 + 0.01 * rng.normal(size=rates.shape)  # slip
    turned = np.vstack([np.zeros(4), np.cumsum(rates * PERIOD, axis=0)]) * np.sign(ACROSS)
    counters = (np.floor(turned * GEAR * TICKS / (2 * math.pi)) + 32000) % 2**16 - 2**15
    heading = np.append(0.3, 0.3 + np.cumsum(w * PERIOD))
    steps = (vx + 1j * vy) * PERIOD * np.exp(1j * (heading[:-1] + w * PERIOD / 2))
    place = np.append(0, np.cumsum(steps))
    poses = np.column_stack([place.real, place.imag, heading]) + rng.normal(size=(len(place), 3)) * (3e-4, 3e-4, 1e-3)
    stamps = EPOCH + np.round(np.arange(len(turned)) * PERIOD * 1e9).astype(np.int64)
    names = [f"{wheel}_motor" for wheel in WHEELS]
    sent = [joint_state(stamp, row, names=names) for stamp, row in zip(stamps, counters, strict=True)]
    for stamp, row in zip(stamps[::2], poses[::2], strict=True):
        content = {"header": header(stamp), "pose": pose(row)}
        sent.append(Sent("/mocap_node/base/pose", "geometry_msgs/msg/PoseStamped", content, int(stamp) + 8_000_000))
    return write_rosbag1(path, sent)
