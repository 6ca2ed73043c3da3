"""Straight pieces of a scan: where walls are, how sure that is, and nothing across corners."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omnibench.data.true_poses import TruePath
from omnibench.robot.kinematics import Array
from omnibench.simulate.floor_plan import RoomPlan, make_plan
from omnibench.simulate.lidar import Lidar, measure_scans
from omnibench.slam.map import Lines, fit_lines

INCREMENT = np.radians(0.25)


def wall(distance: float, direction: float, rays: int, first: float) -> tuple[Array, Array]:
    """True ranges and angles of neighbouring rays to a wall whose nearest point lies along a direction."""
    angles = first + INCREMENT * np.arange(rays)
    return distance / np.cos(angles - direction), angles


def lines_of(ranges: Array, angles: Array, deviation: float = 0.01) -> Lines:
    points = ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    rays = np.arange(len(ranges))
    return fit_lines(points, np.full(len(ranges), deviation), 1e-5 * rays, rays)[0]


@given(
    distance=st.floats(0.5, 20), direction=st.floats(-np.pi, np.pi), rays=st.integers(40, 200), aside=st.floats(-0.7, 0)
)
def test_a_wall_without_noise_is_found_where_it_is(distance: float, direction: float, rays: int, aside: float) -> None:
    ranges, angles = wall(distance, direction, rays, direction + aside)
    found = lines_of(ranges, angles, deviation=0.001)
    normal = -np.array([np.cos(direction), np.sin(direction)])  # towards the scanner
    assert len(found.rays)
    np.testing.assert_allclose(found.normals, np.broadcast_to(normal, found.normals.shape), atol=1e-6)
    np.testing.assert_allclose(found.centres @ normal, -distance, rtol=1e-6)


@pytest.mark.parametrize("aside", [-1.0, -0.2, 0.6])
def test_stated_tilts_and_places_are_those_of_noisy_walls(aside: float) -> None:
    rng = np.random.default_rng(1)
    tilts, places = [], []
    for _ in range(400):
        ranges, angles = wall(2.0, 0.3, 64, 0.3 + aside)
        found = lines_of(ranges + 0.01 * rng.standard_normal(64), angles)
        if len(found.rays) != 1:
            continue
        (normal,) = found.normals
        tilt = np.arctan2(normal[1], normal[0]) - (0.3 - np.pi)
        tilts.append((tilt + np.pi) % (2 * np.pi) - np.pi)
        places.append(found.centres[0] @ [-np.cos(0.3), -np.sin(0.3)] + 2.0)
    assert len(tilts) > 350
    stated = np.sqrt(found.tilt_variances[0])
    assert abs(np.mean(tilts)) < 4 * stated / np.sqrt(len(tilts))  # not towards the scanner
    assert 0.85 < np.std(tilts) / stated < 1.15
    across = 0.01 * abs(np.cos(aside + 32 * INCREMENT)) / np.sqrt(64)
    assert abs(np.mean(places)) < 4 * across / np.sqrt(len(places))  # neither before nor behind the wall


@pytest.mark.parametrize("seed", range(5))
def test_no_line_bridges_a_corner(seed: int) -> None:
    plan = make_plan(RoomPlan(boundary=((-3, -2), (3, -2), (3, 2), (-3, 2)), start=(0, 0, 0)), "room")
    lidar = Lidar()
    track = TruePath(np.zeros(1), np.array([[1.0, 0.5, 0.2 + seed]]))
    (ranges,) = measure_scans(plan, lidar, track, np.zeros(1), np.random.default_rng(seed)).ranges
    seen = np.flatnonzero(np.isfinite(ranges))
    angles = lidar.scanner.angles[seen]
    found = lines_of(ranges[seen].astype(float), angles)
    heading = 0.2 + seed
    turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    normals = found.normals @ turn
    tilts = np.min(np.abs(np.angle(np.exp(4j * np.arctan2(normals[:, 1], normals[:, 0]))))[:, None] / 4, axis=1)
    assert (tilts < 5 * np.sqrt(found.tilt_variances)).all()
    assert found.rays.sum() > 0.9 * len(seen)


def test_a_scanner_that_turns_clockwise_finds_the_same_lines() -> None:
    ranges, angles = wall(2.0, 0.3, 60, 0.0)
    there, back = lines_of(ranges, angles), lines_of(ranges[::-1], angles[::-1])
    np.testing.assert_allclose(there.normals[0], back.normals[0], atol=1e-9)
    np.testing.assert_allclose(there.centres[0], back.centres[0], atol=1e-9)


def test_what_is_too_short_to_have_a_direction_is_no_line() -> None:
    ranges, angles = wall(2.0, 0.0, 8, 0.0)  # 7 cm at 1 cm of noise
    assert len(lines_of(ranges, angles).rays) == 0
    assert len(lines_of(ranges, angles, deviation=0.001).rays) == 1


def test_a_single_outlier_does_not_end_a_line() -> None:
    ranges, angles = wall(2.0, 0.0, 100, -0.2)
    ranges[40] = 1.0
    assert lines_of(ranges, angles).rays.max() > 90


def test_too_few_points_are_no_line_and_no_error() -> None:
    for rays in (0, 1, 7):
        assert len(lines_of(*wall(2.0, 0.0, rays, 0.0)).rays) == 0
