"""Floor plans: what is drawn in a config, what is ready-made, and paths that do not fit."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from omnibench.config import parse_yaml, validate
from omnibench.errors import ConfigError, UnknownNameError
from omnibench.simulate import floor_plan
from omnibench.simulate.floor_plan import PLANS, FloorPlan, RoomPlan, make_plan

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


def test_the_yaml_in_the_documentation_is_a_room() -> None:
    assert floor_plan.__doc__ is not None
    one, drawn = parse_yaml(floor_plan.__doc__.split("\n\n", 2)[2].replace("    room:", "- room:"), "documentation")
    assert make_plan(validate(RoomPlan, one["room"], "room"), "room").name == "furnished_room"
    assert len(make_plan(validate(RoomPlan, drawn["room"], "room"), "room").obstacles) == 2


def test_corners_that_are_repeated_make_no_walls() -> None:
    plan = make_plan(room(boundary=[[0, 0], [5, 0], [5, 0], [5, 4], [0, 4], [0, 0]]), "room")
    assert len(plan.segments) == 4


def test_obstacles_may_touch_the_walls_and_each_other() -> None:
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


def test_no_ready_made_obstacle_lies_in_another() -> None:
    for name in PLANS:
        plan = make_plan(RoomPlan(plan=name), "room")
        areas = sum(obstacle.area for obstacle in plan.obstacles)
        assert plan.free.area == pytest.approx(plan.boundary.area - areas)


def test_a_ready_made_plan_takes_another_start() -> None:
    assert make_plan(RoomPlan(plan="hall", start=(5, 8, 180)), "room").start == pytest.approx([5, 8, math.pi])


def test_an_unknown_plan_is_told_with_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'furnished_room'"):
        make_plan(RoomPlan(plan="furnished_rom"), "room")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({}, "neither is given"),
        ({"plan": "hall", "boundary": WALLS}, "both are given"),
        ({"plan": "hall", "obstacles": [CUPBOARD]}, "obstacles: a ready-made plan has its own"),
        ({"boundary": WALLS}, "start: say where"),
        ({"boundary": [[0, 0], [5, float("inf")], [5, 4]], "start": [1, 1, 0]}, "boundary.1.1: .* finite"),
        ({"boundry": WALLS}, "did you mean 'boundary'"),
    ],
)
def test_a_room_is_a_ready_made_plan_or_a_drawing(given: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        validate(RoomPlan, given, "room")


@pytest.mark.parametrize(
    ("corners", "told"),
    [
        ([[1, 1], [2, 2]], "2 of the 3 different corners"),
        ([[1, 1], [1, 1], [1, 1], [1, 1]], "1 of the 3 different corners"),
        ([[1, 1], [2, 2], [3, 3]], "has no area, its corners lie on one line from (1.00, 1.00) m"),
        ([[1, 1], [3, 2], [3, 1], [1, 2]], "crosses or touches itself at (2.00, 1.50) m"),
        ([[6, 6], [7, 6], [7, 7]], "lies outside the boundary"),
        ([[4.5, 1], [6, 1], [6, 2]], "reaches outside the boundary, at ("),
        (WALLS, "covers the whole room"),
        ([[-1, -1], [6, -1], [6, 6], [-1, 6]], "covers the whole room"),
        ([[1000, 1000], [3000, 1000], [3000, 3000]], "is 2000 m wide"),
    ],
)
def test_a_degenerate_obstacle_is_named(corners: list[list[float]], told: str) -> None:
    message = refused(obstacles=[CUPBOARD, corners])
    assert message.startswith("flower: room.obstacles[1]: ")
    assert told in message


@pytest.mark.parametrize(
    ("corners", "told"),
    [
        ([[0, 0], [5, 0]], "2 of the 3 different corners"),
        ([[0, 0], [5, 4], [5, 0], [0, 4]], "crosses or touches itself at (2.50, 2.00) m"),
        ([[0, 0], [5000, 0], [5000, 4000], [0, 4000]], "are these in mm?"),
    ],
)
def test_a_degenerate_boundary_is_named(corners: list[list[float]], told: str) -> None:
    message = refused(boundary=corners)
    assert message.startswith("flower: room.boundary: ")
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


def test_a_robot_that_only_touches_a_wall_for_a_moment_is_seen() -> None:
    with pytest.raises(ConfigError, match="hits the boundary"):
        drive(make_plan(room(), "room"), (2, 2), (4.761, 2), (2, 2), steps=14000)


def test_a_wall_between_two_places_is_seen() -> None:
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


def test_the_free_area_is_the_boundary_without_the_obstacles() -> None:
    plan = make_plan(RoomPlan(plan="furnished_room"), "room")
    places = np.random.default_rng(0).uniform(-1, 9, size=(2000, 2))
    inside = shapely.contains_xy(plan.boundary, places)
    for obstacle in plan.obstacles:
        inside &= ~shapely.intersects_xy(obstacle, places)
    assert (shapely.contains_xy(plan.free, places) == inside).all()
    assert [plan.place_of(place) is None for place in places[:200]] == inside[:200].tolist()
