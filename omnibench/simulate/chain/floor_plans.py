"""Ready-made floor plans, in metres: a furnished room, a corridor without end, a hall of pillars."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

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
