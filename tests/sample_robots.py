"""The robot of most tests."""

import math

from omnibench.robot.kinematics import Robot, Wheel

# Three omni wheels, as in the articles on the APR-02 (m, rad).
APR_02 = Robot(
    name="APR-02",
    wheels=tuple(
        Wheel(name=name, radius=0.148, distance=0.195, angle=math.radians(degrees))
        for name, degrees in zip("abc", (60, 180, 300), strict=True)
    ),
)

APR02 = APR_02.model_dump(mode="json")  # as a config has it
# A mecanum base whose wheels are given by their lever arms, as a config has it.
LEVER_MECANUM = {
    "name": "mecanum",
    "wheels": [
        {"name": name, "radius": 0.05, "distance": 0.35, "angle": math.radians(90 * side), "roller_angle": roller}
        for name, side, roller in (("fl", 1, 0.785), ("fr", -1, -0.785), ("rl", 1, -0.785), ("rr", -1, 0.785))
    ],
}


def make_robot(name: str, *wheels: dict[str, object], **more: object) -> Robot:
    """A robot of wheels that the functions below describe."""
    return Robot.model_validate({"name": name, "wheels": wheels, **more})


def fixed(name: str, x: float, y: float, **more: object) -> dict[str, object]:
    return {"name": name, "type": "fixed", "radius": 0.05, "x": x, "y": y, **more}


def steered(name: str, x: float, y: float, **more: object) -> dict[str, object]:
    return {"name": name, "type": "steered", "radius": 0.05, "x": x, "y": y, **more}


def mecanum(name: str, x: float, y: float, rollers: float) -> dict[str, object]:
    return {"name": name, "type": "mecanum", "radius": 0.05, "x": x, "y": y, "roller_angle_deg": rollers}


_REAR = (fixed("rear_left", 0.0, 0.2, measured=False), fixed("rear_right", 0.0, -0.2, measured=False))
_CORNERS = {
    "front_left": (0.2, 0.15),
    "front_right": (0.2, -0.15),
    "rear_left": (-0.2, 0.15),
    "rear_right": (-0.2, -0.15),
}

# One robot of every other class (m).
DIFFERENTIAL = make_robot("diff", fixed("left", 0.0, 0.15), fixed("right", 0.0, -0.15))
SKID = make_robot("skid", *(fixed(name, *place) for name, place in _CORNERS.items()), skid=True)
MECANUM = make_robot(
    "mecanum",
    *(mecanum(name, *place, 45 * (-1) ** (number in (1, 2))) for number, (name, place) in enumerate(_CORNERS.items())),
)
TRICYCLE = make_robot("tricycle", steered("front", 0.5, 0.0), *_REAR)
CAR = make_robot(
    "car",
    fixed("left", 0.0, 0.2),
    fixed("right", 0.0, -0.2),
    steered("front_left", 0.5, 0.2, driven=False),
    steered("front_right", 0.5, -0.2, driven=False),
)
SWERVE = make_robot("swerve", *(steered(name, *place) for name, place in _CORNERS.items()))
WHEELED = (DIFFERENTIAL, SKID, MECANUM, TRICYCLE, CAR, SWERVE)
