"""The LIDAR and its rooms: exact geometry, motion within a scan, noise, plans, and what does not fit."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from shapely.geometry import LineString, Point

from omnibench.config import validate
from omnibench.data.scans import Mount, TrajectoryScans
from omnibench.data.true_poses import TruePath
from omnibench.errors import ConfigError, DataError, UnknownNameError
from omnibench.robot.kinematics import Array
from omnibench.simulate.floor_plan import PLANS, FloorPlan, RoomPlan, make_plan
from omnibench.simulate.lidar import Lidar, LidarMount, cast_rays, measure_scans, scan_stamps

EXACT = Lidar(rays=360, noise=0.0, far_noise=0.0, dropouts=0.0, resolution=1e-6)
FLOAT32 = 2e-6  # m: steps of float32 below 16 m, and of the resolution
seeds = st.integers(0, 2**32 - 1)


def square(half: float, obstacles: tuple[Any, ...] = ()) -> FloorPlan:
    boundary = ((-half, -half), (half, -half), (half, half), (-half, half))
    return make_plan(RoomPlan(boundary=boundary, obstacles=obstacles, start=(0, 0, 0)), "room")


def standing(x: float, y: float, heading: float) -> TruePath:
    return TruePath(np.array([0.0, 1.0]), np.array([[x, y, heading]] * 2))


def look(plan: FloorPlan, lidar: Lidar, track: TruePath, stamps: Array | None = None, seed: int = 0) -> TrajectoryScans:
    return measure_scans(plan, lidar, track, np.zeros(1) if stamps is None else stamps, np.random.default_rng(seed))


def to_the_walls(half: float, x: Array, y: Array, direction: Array) -> Array:
    """From inside of a square to its walls, along directions."""
    with np.errstate(divide="ignore", over="ignore"):
        along_x = (half - np.sign(np.cos(direction)) * x) / np.abs(np.cos(direction))
        along_y = (half - np.sign(np.sin(direction)) * y) / np.abs(np.sin(direction))
    return np.minimum(along_x, along_y)


@given(
    x=st.floats(-3, 3), y=st.floats(-3, 3), heading=st.floats(-10, 10),
    forward=st.floats(-0.5, 0.5), left=st.floats(-0.5, 0.5), yaw=st.floats(-180, 180),
)  # fmt: skip
def test_ranges_in_a_square_room_are_exact(
    x: float, y: float, heading: float, forward: float, left: float, yaw: float
) -> None:
    lidar = EXACT.model_copy(update={"mount": LidarMount(x=forward, y=left, yaw_deg=yaw)})
    found = look(square(4), lidar, standing(x, y, heading)).ranges[0]
    scanner_x = x + forward * math.cos(heading) - left * math.sin(heading)
    scanner_y = y + forward * math.sin(heading) + left * math.cos(heading)
    directions = heading + math.radians(yaw) + lidar.scanner.angles
    expected = to_the_walls(4, np.array(scanner_x), np.array(scanner_y), directions)
    seen = expected > lidar.range_min + FLOAT32
    assert np.abs(found - expected)[seen].max() < FLOAT32


@given(seed=seeds)
def test_ranges_agree_with_shapely_among_random_polygons(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plan = make_plan(
        RoomPlan(
            boundary=_star(rng, 0, 0, 7, 10),
            obstacles=tuple(_star(rng, 3 * math.cos(turn), 3 * math.sin(turn), 0.2, 1.0) for turn in (0, 2, 4)),
            start=(0, 0, 0),
        ),
        "room",
    )
    x, y, heading = *rng.uniform(-0.5, 0.5, 2), rng.uniform(-math.pi, math.pi)
    scanner = EXACT.model_copy(update={"rays": 30, "mount": LidarMount(x=0)}).scanner
    found = cast_rays(plan.segments, scanner, np.zeros(1), np.array([[x, y, heading]]), np.zeros(1))[0]
    walls = [plan.boundary.exterior, *(obstacle.exterior for obstacle in plan.obstacles)]
    for direction, distance in zip(heading + scanner.angles, found, strict=True):
        ray = LineString([(x, y), (x + 30 * math.cos(direction), y + 30 * math.sin(direction))])
        nearest = min(
            Point(x, y).distance(hit) for wall in walls for hit in [wall.intersection(ray)] if not hit.is_empty
        )
        assert distance == pytest.approx(nearest, abs=1e-9)


def _star(rng: np.random.Generator, x: float, y: float, low: float, high: float) -> tuple[tuple[float, float], ...]:
    """A polygon that is seen whole from (x, y)."""
    corners = int(rng.integers(6, 13))
    turns = (np.arange(corners) + rng.uniform(0.3, 0.7, corners)) * 2 * np.pi / corners
    reach = rng.uniform(low, high, corners)
    return tuple((x + r * math.cos(turn), y + r * math.sin(turn)) for r, turn in zip(reach, turns, strict=True))


@given(seed=seeds)
def test_no_ray_slips_through_a_corner(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = np.array(_star(rng, 0, 0, 1, 5))
    walls = np.hstack([corners, np.roll(corners, -1, axis=0)])
    for corner in corners:
        aimed = EXACT.model_copy(update={"rays": 1, "field_of_view_deg": 1e-9, "mount": LidarMount(x=0)}).scanner
        heading = math.atan2(corner[1], corner[0])
        found = cast_rays(walls, aimed, np.zeros(1), np.array([[0, 0, heading]]), np.zeros(1))
        assert found[0, 0] == pytest.approx(np.hypot(*corner), rel=1e-6)


def circling(vx: float, vy: float, turn_rate: float, times: Array) -> Array:
    """Exact poses under a constant twist from the origin."""
    turned = turn_rate * times
    along = np.sin(turned) / turn_rate
    across = (1 - np.cos(turned)) / turn_rate
    return np.column_stack([vx * along - vy * across, vx * across + vy * along, turned])


@given(
    vx=st.floats(-1, 1),
    vy=st.floats(-1, 1),
    turn_rate=st.floats(0.1, 3) | st.floats(-3, -0.1),
    latency=st.floats(0, 0.2),
)
def test_each_ray_starts_where_the_robot_then_is(vx: float, vy: float, turn_rate: float, latency: float) -> None:
    lidar = EXACT.model_copy(update={"latency": latency})
    times = np.arange(-300, 1200) * 0.001
    stamps = np.array([0.0, 0.213, 0.5])
    found = look(square(4), lidar, TruePath(times, circling(vx, vy, turn_rate, times)), stamps).ranges
    measured = stamps[:, None] - latency + 0.025 * 270 / 360 * np.arange(360) / 360
    x, y, heading = circling(vx, vy, turn_rate, measured.ravel()).T
    x, y = x + 0.1 * np.cos(heading), y + 0.1 * np.sin(heading)
    directions = heading + np.tile(lidar.scanner.angles, 3)
    assert np.abs(found.ravel() - to_the_walls(4, x, y, directions)).max() < 5e-6


def tilted(pitch_deg: float, height: float = 0.5, yaw_deg: float = 0.0) -> Lidar:
    mount = LidarMount(x=0.0, pitch_deg=pitch_deg, height=height, yaw_deg=yaw_deg)
    return EXACT.model_copy(update={"mount": mount})


@given(
    pitch=st.floats(-60, 60), height=st.floats(0.1, 2), yaw=st.floats(-180, 180), x=st.floats(-3, 3), y=st.floats(-3, 3)
)  # fmt: skip
def test_a_tilted_scanner_meets_walls_and_floor(pitch: float, height: float, yaw: float, x: float, y: float) -> None:
    lidar = tilted(pitch, height, yaw)
    found = look(square(4), lidar, standing(x, y, 0.3)).ranges[0].astype(float)
    flat = np.column_stack([np.cos(lidar.scanner.angles), np.sin(lidar.scanner.angles), np.zeros(lidar.rays)])
    rays = Rotation.from_euler("ZY", [0.3 + math.radians(yaw), math.radians(pitch)]).apply(flat)
    with np.errstate(divide="ignore"):
        to_planes = [(4 - x) / rays[:, 0], (-4 - x) / rays[:, 0], (4 - y) / rays[:, 1], (-4 - y) / rays[:, 1]]
        to_planes.append(-height / rays[:, 2])
    expected = np.min([np.where(each > 0, each, np.inf) for each in to_planes], axis=0)
    seen = (expected > lidar.range_min + FLOAT32) & (expected < lidar.range_max - FLOAT32)
    np.testing.assert_allclose(found[seen], expected[seen], rtol=1e-6, atol=FLOAT32)


def test_without_distortion_all_rays_start_where_the_robot_is_at_the_stamp() -> None:
    times = np.arange(0, 1000) * 0.001
    track = TruePath(times, circling(0.5, 0.2, 2.0, times))
    lidar = EXACT.model_copy(update={"distortion": False})
    assert lidar.scanner.time_increment == 0
    at_rest = TruePath(np.zeros(1), track.at(np.array([0.3])))
    found = look(square(4), lidar, track, np.array([0.3])).ranges
    assert (found == look(square(4), lidar, at_rest).ranges).all()
    assert (found != look(square(4), EXACT, track, np.array([0.3])).ranges).any()


def test_a_robot_is_at_rest_before_and_after_its_track() -> None:
    track = TruePath(np.array([0.0, 1.0]), np.array([[0.0, 0, 0], [1, 2, 3]]))
    assert track.at(np.array([-1.0, 0.5, 7.0])).tolist() == [[0, 0, 0], [0.5, 1, 1.5], [1, 2, 3]]


def test_the_defaults_are_the_data_sheet_s() -> None:
    scanner = Lidar().scanner
    assert scanner.rays == 1080
    assert math.degrees(scanner.angle_min) == pytest.approx(-135)
    assert math.degrees(scanner.angle_increment) == pytest.approx(0.25)
    assert scanner.time_increment == pytest.approx(0.025 / 1440)
    assert (scanner.range_min, scanner.range_max, scanner.noise, scanner.far_noise) == (0.1, 30.0, 0.01, 0.03)


@pytest.mark.parametrize(("half", "sigma"), [(3.0, 0.01), (11.0, 0.03)])
def test_noise_is_as_large_as_the_data_sheet_says(half: float, sigma: float) -> None:
    lidar = Lidar(mount=LidarMount(x=0), dropouts=0)
    ranges = look(square(half), lidar, standing(0, 0, 0), np.arange(300) * 0.25).ranges.astype(float)
    errors = ranges - to_the_walls(half, np.array(0.0), np.array(0.0), lidar.scanner.angles)
    several = 5 / math.sqrt(errors.size)  # standard errors
    assert abs(errors.mean()) < several * sigma
    assert errors.std() == pytest.approx(math.hypot(sigma, 0.001 / math.sqrt(12)), rel=several)


def test_ranges_are_whole_millimetres() -> None:
    ranges = look(make_plan(RoomPlan(plan="hall"), "room"), Lidar(dropouts=0), standing(12, 8, 0)).ranges
    steps = ranges.astype(float) * 1000
    assert np.abs(steps - np.round(steps)).max() < 2e-3  # of float32
    assert len(np.unique(np.round(steps) % 10)) == 10


def test_what_is_too_near_or_too_far_is_not_seen() -> None:
    lidar = EXACT.model_copy(update={"range_min": 2.0, "range_max": 4.5})
    ranges = look(square(4), lidar, standing(2.5, 0, 0.1)).ranges[0]
    expected = look(square(4), EXACT, standing(2.5, 0, 0.1)).ranges[0]
    seen = (expected >= 2.0) & (expected <= 4.5)
    assert 0 < seen.sum() < len(seen)
    assert (ranges[seen] == expected[seen]).all()
    assert np.isposinf(ranges[~seen]).all()
    assert (lidar.scanner.valid(ranges) == seen).all()


def test_rays_are_lost_by_chance_and_the_same_seed_gives_the_same_scans() -> None:
    plan, stamps = square(3), np.arange(200) * 0.25
    one, again, other = (look(plan, Lidar(dropouts=0.02), standing(0, 0, 0), stamps, seed).ranges for seed in (1, 1, 2))
    assert np.isposinf(one).mean() == pytest.approx(0.02, abs=5 * math.sqrt(0.02 / one.size))
    assert (one == again).all()
    assert (one != other).mean() > 0.5


@given(low=st.floats(0.02, 1), longer=st.floats(0, 1), end=st.floats(0.02, 30), latency=st.floats(0, 0.1), seed=seeds)
def test_scans_follow_within_their_period(low: float, longer: float, end: float, latency: float, seed: int) -> None:
    lidar = Lidar(period=(low, low + longer), latency=latency)
    stamps = scan_stamps(lidar, end, np.random.default_rng(seed))
    assert stamps[0] == 0
    assert np.diff(stamps).min(initial=low) >= low - 1e-12
    assert np.diff(stamps).max(initial=low) <= low + longer + 1e-12
    assert stamps[-1] <= end
    assert stamps[-1] - latency + lidar.sweep <= end
    assert stamps[-1] + low + longer > end - lidar.sweep - 1e-9


def test_a_run_too_short_for_a_scan_and_a_scan_that_sees_nothing_are_refused() -> None:
    with pytest.raises(DataError, match="first scan"):
        scan_stamps(Lidar(), 0.01, np.random.default_rng(0))
    track = TruePath(np.array([0.0, 1.0]), np.array([[8.9, 0, 0], [0.0, 0, 0]]))
    with pytest.raises(DataError, match=r"0\.75 s, the robot at \(2\.2., 0\.00\) m"):
        look(square(10), Lidar(range_max=5), track, np.array([0.0, 0.25, 0.75]))


@pytest.mark.parametrize(("x", "told"), [(2.95, "outside the boundary"), (0.95, r"in obstacles\[0\]")])
def test_a_scanner_in_a_wall_is_refused(x: float, told: str) -> None:
    plan = square(3, (((1, -1), (2, -1), (2, 1), (1, 1)),))
    with pytest.raises(DataError, match=rf"the LIDAR at \(.*, 0\.00\) m is {told} .* at 0 s; check lidar.mount"):
        look(plan, Lidar(), standing(x, 0, 0))


@pytest.mark.parametrize(
    ("part", "given", "told"),
    [
        (Lidar, {"period": [0.3, 0.2]}, "period"),
        (Lidar, {"period": [0.2, float("inf")]}, "period"),
        (Lidar, {"period": [1e-9, 0.2], "turn_time": 0}, "0.001 s"),
        (Lidar, {"period": [0.01, 0.2]}, "0.01875 s"),
        (Lidar, {"range_min": 40}, "range_min 40 m"),
        (Lidar, {"rays": 0}, "rays"),
        (Lidar, {"noise": -1}, "noise"),
        (Lidar, {"mount": {"yaw": 3}}, "'yaw_deg'"),
        (Lidar, {"mount": {"pitch_deg": 80}}, "mount.pitch_deg"),
        (Lidar, {"latency": float("nan")}, "latency"),
        (Mount, {"pitch": 0.1}, "height"),
    ],
)
def test_a_lidar_that_cannot_be_is_refused_in_one_line(part: Any, given: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError, match=told) as error:
        validate(part, given, "lidar")
    assert "\n" not in str(error.value)


WALLS = [[0, 0], [5, 0], [5, 4], [0, 4]]
CUPBOARD = [[4, 3], [5, 3], [5, 4], [4, 4]]


def room(**drawn: Any) -> RoomPlan:
    return validate(RoomPlan, {"boundary": WALLS, "start": [2, 2, 90], **drawn}, "room")


def refused(**drawn: Any) -> str:
    with pytest.raises(ConfigError) as error:
        make_plan(room(**drawn), "flower: room")
    assert "\n" not in str(error.value)
    return str(error.value)


def drive(plan: FloorPlan, *places: tuple[float, float], radius: float = 0.25, steps: int = 2000) -> None:
    """Along straight lines from place to place, a second each."""
    times = np.linspace(0, len(places) - 1, steps)
    corners = np.array(places, dtype=float)
    positions = np.column_stack([np.interp(times, np.arange(len(places)), column) for column in corners.T])
    plan.check_path(positions, times, radius, "run train-001")


def test_a_drawn_room_has_its_walls_and_start() -> None:
    plan = make_plan(room(obstacles=[CUPBOARD]), "room")
    assert plan.start == pytest.approx([2, 2, math.pi / 2])
    assert plan.free.area == pytest.approx(19)
    assert plan.segments.shape == (8, 4)
    assert plan.owners.tolist() == [-1, -1, -1, -1, 0, 0, 0, 0]
    assert np.hypot(*(plan.segments[:, 2:] - plan.segments[:, :2]).T).sum() == pytest.approx(18 + 4)


def test_corners_that_are_repeated_make_no_walls_and_obstacles_may_touch_each_other() -> None:
    plan = make_plan(room(boundary=[[0, 0], [5, 0], [5, 0], [5, 4], [0, 4], [0, 0]]), "room")
    assert len(plan.segments) == 4
    plan = make_plan(room(obstacles=[CUPBOARD, [[3, 3], [4, 3], [4, 4], [3, 4]]]), "room")
    assert plan.free.area == pytest.approx(18)


@pytest.mark.parametrize("name", PLANS)
def test_a_ready_made_plan_leaves_the_robot_room(name: str) -> None:
    plan = make_plan(RoomPlan(plan=name), "room")
    free = 0.9 if name == "corridor" else 1.9
    turns = np.linspace(0, 2 * np.pi, 400)
    circle = plan.start[:2] + (free - 0.25) * np.column_stack([np.cos(turns), np.sin(turns)])
    plan.check_path(circle, turns, 0.25, "circle")


def test_the_corridor_has_no_end_within_the_range_of_a_30_m_scanner() -> None:
    plan = make_plan(RoomPlan(plan="corridor"), "room")
    left, _, right, _ = plan.boundary.bounds
    assert min(plan.start[0] - left, right - plan.start[0]) > 30 + 5


def test_ready_made_plans_have_obstacles_apart_and_take_another_start() -> None:
    for name in PLANS:
        plan = make_plan(RoomPlan(plan=name), "room")
        areas = sum(obstacle.area for obstacle in plan.obstacles)
        assert plan.free.area == pytest.approx(plan.boundary.area - areas)
    assert make_plan(RoomPlan(plan="hall", start=(5, 8, 180)), "room").start == pytest.approx([5, 8, math.pi])
    with pytest.raises(UnknownNameError, match="'furnished_room'"):
        make_plan(RoomPlan(plan="furnished_rom"), "room")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({}, "neither"),
        ({"plan": "hall", "boundary": WALLS}, "both"),
        ({"plan": "hall", "obstacles": [CUPBOARD]}, "obstacles"),
        ({"boundary": WALLS}, "start"),
        ({"boundary": [[0, 0], [5, float("inf")], [5, 4]], "start": [1, 1, 0]}, "boundary.1.1"),
        ({"boundry": WALLS}, "'boundary'"),
    ],
)
def test_a_room_is_a_ready_made_plan_or_a_drawing(given: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        validate(RoomPlan, given, "room")


@pytest.mark.parametrize(
    ("part", "corners", "told"),
    [
        ("obstacles[1]", [[1, 1], [2, 2]], "2 of the 3"),
        ("obstacles[1]", [[1, 1], [1, 1], [1, 1], [1, 1]], "1 of the 3"),
        ("obstacles[1]", [[1, 1], [2, 2], [3, 3]], "no area"),
        ("obstacles[1]", [[1, 1], [3, 2], [3, 1], [1, 2]], "(2.00, 1.50) m"),
        ("obstacles[1]", [[4.5, 1], [6, 1], [6, 2]], "outside"),
        ("obstacles[1]", WALLS, "whole room"),
        ("obstacles[1]", [[-1, -1], [6, -1], [6, 6], [-1, 6]], "whole room"),
        ("obstacles[1]", [[1000, 1000], [3000, 1000], [3000, 3000]], "2000 m"),
        ("boundary", [[0, 0], [5, 4], [5, 0], [0, 4]], "(2.50, 2.00) m"),
        ("boundary", [[0, 0], [5000, 0], [5000, 4000], [0, 4000]], "mm"),
    ],
)
def test_a_degenerate_obstacle_or_boundary_is_named(part: str, corners: list[list[float]], told: str) -> None:
    message = refused(boundary=corners) if part == "boundary" else refused(obstacles=[CUPBOARD, corners])
    assert message.startswith(f"flower: room.{part}: ")
    assert told in message


def test_obstacles_that_fill_the_room_together_are_refused() -> None:
    left, right = [[0, 0], [2.5, 0], [2.5, 4], [0, 4]], [[2.5, 0], [5, 0], [5, 4], [2.5, 4]]
    assert "obstacles: they cover the whole room" in refused(obstacles=[left, right])


@pytest.mark.parametrize(
    ("start", "told"), [([4.5, 3.5, 0], "in obstacles[0]"), ([5, 7, 0], "outside the boundary"), ([0, 0, 0], "outside")]
)
def test_a_start_that_is_not_free_is_refused(start: list[float], told: str) -> None:
    message = refused(obstacles=[CUPBOARD], start=start)
    assert message.startswith("flower: room.start: (")
    assert told in message


@given(reach=st.floats(0.3, 1.9), radius=st.floats(0.05, 0.5), turn=st.floats(0, 2 * math.pi))
def test_a_circle_fits_when_the_robot_keeps_off_the_walls(reach: float, radius: float, turn: float) -> None:
    turns = turn + np.linspace(0, 2 * np.pi, 1500)
    plan = make_plan(room(boundary=[[-2, -2], [2, -2], [2, 2], [-2, 2]], start=[0, 0, 0]), "room")
    circle = reach * np.column_stack([np.cos(turns), np.sin(turns)])
    if reach + radius <= 2:
        plan.check_path(circle, turns, radius, "circle")
    elif reach + radius > 2.01:
        with pytest.raises(ConfigError, match=r"circle: at .* hits the boundary"):
            plan.check_path(circle, turns, radius, "circle")


def test_a_robot_that_hits_a_wall_is_told_with_run_time_and_place() -> None:
    with pytest.raises(ConfigError) as error:
        drive(make_plan(room(), "room"), (2, 2), (4.9, 2))
    message = str(error.value)
    assert message.startswith("run train-001: at 0.95 s the robot at (4.7")
    assert "hits the boundary" in message
    assert "larger room" in message


def test_a_robot_that_hits_an_obstacle_is_told_which() -> None:
    with pytest.raises(ConfigError, match=r"hits obstacles\[0\]"):
        drive(make_plan(room(obstacles=[CUPBOARD]), "room"), (2, 2), (4.2, 2.8))
    with pytest.raises(ConfigError, match=r"hits sofa of the room furnished_room"):
        drive(make_plan(RoomPlan(plan="furnished_room"), "room"), (3.2, 3), (3.2, 5))


def test_a_wall_that_is_touched_for_a_moment_or_lies_between_two_places_is_seen() -> None:
    with pytest.raises(ConfigError, match="hits the boundary"):
        drive(make_plan(room(), "room"), (2, 2), (4.761, 2), (2, 2), steps=14000)
    post = [[2.4, 1.9], [2.5, 1.9], [2.5, 2.1], [2.4, 2.1]]
    plan = make_plan(room(obstacles=[post], start=[1, 1, 0]), "room")
    with pytest.raises(ConfigError, match=r"hits obstacles\[0\]"):
        plan.check_path(np.array([[1.5, 2.0], [3.5, 2.0]]), np.array([0.0, 1.0]), 0.25, "run")


@pytest.mark.parametrize(
    ("place", "told"), [((9, 9), "is outside the boundary"), ((4.5, 3.5), r"is in obstacles\[0\]")]
)
def test_a_robot_that_is_far_from_the_free_area_is_told_where(place: tuple[float, float], told: str) -> None:
    plan = make_plan(room(obstacles=[CUPBOARD]), "room")
    with pytest.raises(ConfigError, match=told):
        plan.check_path(np.array([place]), np.zeros(1), 0.1, "run")
