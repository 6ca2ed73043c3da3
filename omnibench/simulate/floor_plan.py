"""Floor plans: the walls that a LIDAR sees and that a robot must not hit.

In a config a room is the name of a ready-made plan or a drawing of one's own, in metres:

    room: {plan: furnished_room}

    room:
      boundary: [[0, 0], [5, 0], [5, 4], [0, 4]]     # the walls, corner by corner, in either direction
      obstacles:
        - [[4, 3], [5, 3], [5, 4], [4, 4]]           # a cupboard in the corner
        - [[1, 1], [1.4, 1], [1.2, 1.4]]
      start: [2.5, 2, 90]                            # x (m), y (m) and heading (degrees) of the robot at rest
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat, model_validator
from shapely.geometry import LineString, MultiLineString, MultiPolygon, Point, Polygon

from omnibench.config import Model
from omnibench.errors import ConfigError, require_choice
from omnibench.robot.kinematics import Array

Corners = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Drawing:
    """A room and its obstacles. start: x (m), y (m), heading (degrees) of the robot at rest."""

    boundary: Corners
    start: tuple[float, float, float]
    obstacles: Mapping[str, Corners] = field(default_factory=dict)


def box(left: float, bottom: float, right: float, top: float) -> Corners:
    """Corners of a rectangle along the axes."""
    return ((left, bottom), (right, bottom), (right, top), (left, top))


def turned_box(x: float, y: float, length: float, width: float, degrees: float) -> Corners:
    """Corners of a rectangle about (x, y), its length along a direction in degrees."""
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    halves = [(along * length / 2, across * width / 2) for along, across in signs]
    return tuple((x + cosine * u - sine * v, y + sine * u + cosine * v) for u, v in halves)


def column(x: float, y: float, radius: float, corners: int = 16) -> Corners:
    """Corners of a polygon for a round column about (x, y)."""
    turns = [math.tau * index / corners for index in range(corners)]
    return tuple((x + radius * math.cos(turn), y + radius * math.sin(turn)) for turn in turns)


def legs(name: str, x: float, y: float, length: float, width: float, degrees: float, side: float) -> dict[str, Corners]:
    """The four square legs of a table or a chair about (x, y)."""
    places = turned_box(x, y, length, width, degrees)
    return {f"{name}, leg {number}": turned_box(*place, side, side, degrees) for number, place in enumerate(places, 1)}


# 7 x 6 m with an alcove in the east, a door's niche in the south, a chimney in the north and a slanted corner. Around
# the start a disc of 1.9 m is free: a flower of 1.3 m with the robot's radius of 0.25 m and an inexact start.
_FURNISHED_ROOM = Drawing(
    boundary=(
        *((0, 0), (3.6, 0), (3.6, -0.25), (4.5, -0.25), (4.5, 0), (7, 0)),
        *((7, 2.3), (7.9, 2.3), (7.9, 4.1), (7, 4.1), (7, 6)),
        *((2.3, 6), (2.3, 5.65), (1.3, 5.65), (1.3, 6), (0.8, 6), (0, 5.3)),
    ),
    start=(3.2, 3.0, 0.0),
    obstacles={
        "cupboard": box(0, 1.2, 0.6, 2.8),
        "sofa": box(2.7, 5.1, 4.7, 6),
        "shelves": box(5.2, 0, 6.9, 0.35),
        "sideboard": box(1.0, 0, 2.4, 0.45),
        "armchair": turned_box(0.85, 4.35, 0.8, 0.75, -25),
        "pillar": column(5.45, 4.65, 0.2),
        "plant": column(6.65, 5.6, 0.17, 12),
        **legs("table", 6.15, 1.75, 0.7, 1.3, 0, 0.06),
        **legs("chair by the table", 5.55, 1.5, 0.38, 0.4, 20, 0.035),
        **legs("chair in the corner", 0.55, 0.65, 0.38, 0.4, 55, 0.035),
    },
)

# Near its middle a LIDAR sees no end within 30 m, and nothing that distinguishes one place from the next.
_CORRIDOR = Drawing(boundary=box(-40, -1.2, 40, 1.2), start=(0.0, 0.0, 0.0))

_HALL = Drawing(
    boundary=(
        *((0, 0), (9, 0), (9, -1.5), (13, -1.5), (13, 0), (24, 0)),
        *((24, 10), (22, 10), (22, 16), (0, 16)),
    ),
    start=(12.0, 8.0, 0.0),
    obstacles={
        f"pillar {number}": column(x, y, 0.35) if number % 2 else box(x - 0.3, y - 0.3, x + 0.3, y + 0.3)
        for number, (x, y) in enumerate([(x, y) for y in (4.5, 11.5) for x in (4.0, 9.0, 14.5, 19.0)], 1)
    }
    | {"counter": box(0.6, 6.2, 1.6, 10.4), "bench": turned_box(17.5, 14.6, 2.4, 0.5, 15)},
)

PLANS: Mapping[str, Drawing] = {"furnished_room": _FURNISHED_ROOM, "corridor": _CORRIDOR, "hall": _HALL}


Corner = tuple[FiniteFloat, FiniteFloat]
Pose = tuple[FiniteFloat, FiniteFloat, FiniteFloat]

_LARGEST = 1000.0  # m; a larger plan is one in mm
_SMALLEST_AREA = 1e-6  # m²
_STEP = 0.01  # m between the points at which a path is checked (chosen)
_OUTSIDE = 0.01  # m that an obstacle may reach outside the boundary (chosen)


class RoomPlan(Model):
    """A room: the name of a ready-made plan, or a boundary with obstacles."""

    plan: str | None = Field(None, description=f"ready-made: one of {', '.join(PLANS)}")
    boundary: tuple[Corner, ...] | None = Field(None, description="corners of the walls [x, y], m")
    obstacles: tuple[tuple[Corner, ...], ...] = Field((), description="corners [x, y] of each, m")
    start: Pose | None = Field(None, description="where the robot starts: x (m), y (m), heading (degrees)")

    @model_validator(mode="after")
    def _one_is_given(self) -> RoomPlan:
        if (self.plan is None) == (self.boundary is None):
            given = "both are" if self.plan is not None else "neither is"
            raise ValueError(f"give plan, a ready-made one ({', '.join(PLANS)}), or boundary ({given} given)")
        if self.plan is not None and self.obstacles:
            raise ValueError("obstacles: a ready-made plan has its own; leave them out, or draw the boundary too")
        if self.boundary is not None and self.start is None:
            raise ValueError("start: say where the robot starts in this room: [x, y, heading in degrees]")
        return self


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """A room as the robot meets it, in metres, in the room's frame.

    obstacle_names: for messages. start (3,): m, m, rad. segments (S, 4): x, y of both ends of each wall of boundary and
    obstacles. owners (S,): index of the obstacle that a wall belongs to, -1 for the boundary. free: area inside the
    boundary without the obstacles.
    """

    name: str
    boundary: Polygon
    obstacles: tuple[Polygon, ...]
    obstacle_names: tuple[str, ...]
    start: Array
    segments: Array
    owners: NDArray[np.intp]
    free: Polygon | MultiPolygon

    @property
    def outlines(self) -> list[Array]:
        """The walls of boundary and obstacles, closed (n, 2) each, m."""
        return [np.array(shape.exterior.coords) for shape in (self.boundary, *self.obstacles)]

    def check_path(self, positions: Array, times: Array, radius: float, what: str) -> None:
        """ConfigError in one line when a robot, a disc of ``radius`` m, leaves the free area.

        positions (K, 2): the robot's centre, m, at times (K,), s. what: name of the path, for the message. The path
        is checked every 1 cm, so that a collision less deep than that may be missed.
        """
        way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(positions, axis=0).T))])
        chosen = np.flatnonzero(np.diff(np.floor(way / _STEP), prepend=-1.0))
        chosen = np.union1d(chosen, [len(positions) - 1])
        places = positions[chosen]
        steps = shapely.linestrings(np.stack([places[np.maximum(np.arange(len(places)) - 1, 0)], places], axis=1))
        distances = shapely.distance(steps, MultiLineString(list(self.segments.reshape(-1, 2, 2))))
        bad = (distances < radius - 1e-9) | ~shapely.contains_xy(self.free, places)
        for step in np.flatnonzero(bad)[:1]:
            raise ConfigError(
                f"{what}: at {times[chosen[step]]:.2f} s the robot at ({_place(places[step])}) m, radius {radius:g} m, "
                f"{self._hit(steps[step], radius)} of the room {self.name}; shorten the way, move the start or choose "
                "a larger room"
            )

    def place_of(self, position: Array) -> str | None:
        """Obstacle in which a position (2,) lies, or that it is outside, in words; None in the free area."""
        if self.free.contains(Point(position)):
            return None
        for name, obstacle in zip(self.obstacle_names, self.obstacles, strict=True):
            if obstacle.intersects(Point(position)):
                return f"in {name}"
        return "outside the boundary"

    def _hit(self, step: LineString, radius: float) -> str:
        """Collision of the robot in words: what it hits, or where it is."""
        distances = shapely.distance(shapely.linestrings(self.segments.reshape(-1, 2, 2)), step)
        nearest = int(np.argmin(distances))
        if distances[nearest] >= radius:
            return f"is {self.place_of(np.array(step.coords[-1]))}"
        owner = self.owners[nearest]
        name = "the boundary" if owner < 0 else self.obstacle_names[owner]
        return f"hits {name}"


def make_plan(room: RoomPlan, where: str) -> FloorPlan:
    """The floor plan of a config's room. where: its place in the config, for messages.

    ConfigError in one line: an unknown plan, a start that is not free, or a polygon with fewer than three corners,
    without area, that crosses itself, lies outside the boundary or covers all of it.
    """
    if room.plan is None:
        drawn = {f"obstacles[{index}]": corners for index, corners in enumerate(room.obstacles)}
        drawing, name = Drawing(room.boundary or (), (0.0, 0.0, 0.0), drawn), "drawn in the config"
    else:
        require_choice("plan", room.plan, PLANS, where)
        drawing, name = PLANS[room.plan], room.plan
    x, y, heading = room.start or drawing.start
    walls = _polygon(drawing.boundary, f"{where}.boundary")
    inner = {each: _polygon(corners, f"{where}.{each}") for each, corners in drawing.obstacles.items()}
    room_and_wall = walls.buffer(_OUTSIDE, join_style="mitre")
    for each, polygon in inner.items():
        outside = polygon.difference(room_and_wall)
        if not polygon.intersects(walls):
            raise ConfigError(f"{where}.{each}: lies outside the boundary; move or remove it")
        if polygon.covers(walls):
            raise ConfigError(f"{where}.{each}: covers the whole room; make it smaller, or the boundary larger")
        if not outside.is_empty:
            place = _place(outside.representative_point().coords[0])
            raise ConfigError(f"{where}.{each}: reaches outside the boundary, at ({place}) m; cut it off at the wall")
    free = walls.difference(shapely.union_all(list(inner.values())))
    if free.area < _SMALLEST_AREA:
        raise ConfigError(f"{where}.obstacles: they cover the whole room together; leave the robot some floor")
    edges = []  # both ends (E, 4) of each edge, without those between repeated corners
    for polygon in (walls, *inner.values()):
        ends = shapely.get_coordinates(polygon.exterior)
        edges.append(np.hstack([ends[:-1], ends[1:]])[(ends[:-1] != ends[1:]).any(axis=1)])
    shapely.prepare(free)
    plan = FloorPlan(
        name,
        walls,
        tuple(inner.values()),
        tuple(inner),
        np.array([x, y, math.radians(heading)]),
        np.concatenate(edges),
        np.repeat(np.arange(len(edges)) - 1, [len(each) for each in edges]),
        free,
    )
    blocked = plan.place_of(plan.start[:2])
    if blocked is not None:
        raise ConfigError(f"{where}.start: ({_place(plan.start)}) m is {blocked}; start where the floor is free")
    return plan


def _polygon(corners: Sequence[Corner], where: str) -> Polygon:
    different = len(set(corners))
    if different < 3:
        raise ConfigError(f"{where}: has {different} of the 3 different corners that a polygon needs at least")
    points = np.array(corners)
    size = float(np.ptp(points, axis=0).max())
    if size > _LARGEST:
        raise ConfigError(f"{where}: is {size:g} m wide, more than {_LARGEST:g} m; corners are in m, are these in mm?")
    polygon = Polygon(points)
    if shapely.MultiPoint(points).convex_hull.area < _SMALLEST_AREA:
        raise ConfigError(f"{where}: has no area, its corners lie on one line from ({_place(points[0])}) m; move one")
    if not polygon.is_valid:
        match = re.fullmatch(r"(.*)\[(\S+) (\S+)\]", shapely.is_valid_reason(polygon))
        place = f" at ({_place((float(match[2]), float(match[3])))}) m" if match else ""
        raise ConfigError(f"{where}: crosses or touches itself{place}; give its corners in their order along the walls")
    return polygon


def _place(position: Sequence[float] | Array) -> str:
    return f"{position[0]:.2f}, {position[1]:.2f}"
