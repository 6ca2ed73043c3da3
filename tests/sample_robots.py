"""The robot of most tests."""

from __future__ import annotations

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
