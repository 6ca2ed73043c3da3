"""Speed of scanning a room, as a ratio against plain NumPy in the same run.

    pytest --dist no tests/studies/bench_lidar.py

"Plain NumPy" is every ray of a scan against every wall at once, written out below, independent of omnibench's code.
"""

from __future__ import annotations

import time

import numpy as np
import pytest

from omnibench.data.true_poses import TruePath
from omnibench.robot.kinematics import Array
from omnibench.simulate.floor_plan import PLANS, FloorPlan, RoomPlan, make_plan
from omnibench.simulate.lidar import Lidar, cast_rays, measure_scans, scan_stamps

RUN = 6.5  # s
RUNS = 190  # of 25 scans: about a session of 180 flower runs


def driven(plan: FloorPlan) -> TruePath:
    times = np.arange(0, RUN, 0.001)
    return TruePath(times, plan.start + np.outer(times, [0.1, 0.05, 0.35]))


def plain_numpy(plan: FloorPlan, lidar: Lidar, track: TruePath, stamps: Array) -> Array:
    """Distances (S, R) to the nearest walls, scan by scan."""
    starts, edges = plan.segments[:, :2], plan.segments[:, 2:] - plan.segments[:, :2]
    found = np.empty((len(stamps), lidar.rays))
    for scan, stamp in enumerate(stamps):
        poses = track.at(stamp + lidar.scanner.delays)
        heading = poses[:, 2]
        origin = poses[:, :2] + lidar.mount.x * np.column_stack([np.cos(heading), np.sin(heading)])
        direction = heading + lidar.scanner.angles
        x, y = np.cos(direction)[:, None], np.sin(direction)[:, None]
        to_x, to_y = np.moveaxis(starts[None] - origin[:, None], -1, 0)
        across = x * edges[:, 1] - y * edges[:, 0]
        distance = (to_x * edges[:, 1] - to_y * edges[:, 0]) / across
        share = (to_x * y - to_y * x) / across
        hit = (distance >= 0) & (share >= -1e-12) & (share <= 1 + 1e-12)
        found[scan] = np.where(hit, distance, np.inf).min(axis=1)
    return found


@pytest.mark.parametrize("name", PLANS)
def test_a_session_of_scans(benchmark, name: str) -> None:
    plan, lidar = make_plan(RoomPlan(plan=name), "room"), Lidar()
    track, rng = driven(plan), np.random.default_rng(0)
    stamps = scan_stamps(lidar, RUN, rng)

    def session() -> None:
        for _ in range(RUNS):
            measure_scans(plan, lidar, track, stamps, rng)

    benchmark.pedantic(session, rounds=3, warmup_rounds=1)
    each = benchmark.stats.stats.median / (RUNS * len(stamps))
    began = time.perf_counter()
    plain = plain_numpy(plan, lidar, track, stamps)
    plain_each = (time.perf_counter() - began) / len(stamps)
    cast = cast_rays(plan.segments, lidar.scanner, track.times, track.poses, stamps)
    benchmark.extra_info |= {
        "scans a second, noise and all": 1 / each,
        "times faster than plain NumPy without noise": plain_each / each,
        "walls": len(plan.segments),
        "largest difference": float(np.abs(cast - plain).max()),
    }
    assert np.abs(cast - plain).max() < 1e-9
    assert plain_each / each > 3
    assert benchmark.stats.stats.median < 3
