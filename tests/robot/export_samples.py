"""Robots of every kind for tests of exports, their calibrations, and what an export's node says."""

import math
import re
from typing import Any

import numpy as np
import yaml

from omnibench.robot.calibration import Calibration, Noise, matrix_rows
from omnibench.robot.export.formats import Export
from omnibench.robot.kinematics import Array, Mount, Robot, Wheel

MOUNT = Mount(x=0.12, y=-0.03, yaw=0.2)
ORIGIN: dict[str, Any] = {  # of a provenance
    "dataset": "flower",
    "dataset_hash": "0",
    "calibrator": "genetic",
    "seed": 1,
    "cost": "final_pose",
    "box": "row",
    "outcome": "converged",
}
NOISE = Noise(pose_position=0.004, walk_position=0.006, walk_heading=0.01, bias_heading=0.02)


def fixed(name: str, x: float, y: float, **more: Any) -> Wheel:
    return Wheel(**({"name": name, "type": "fixed", "radius": 0.08, "x": x, "y": y} | more))


def steered(name: str, x: float, y: float, **more: Any) -> Wheel:
    return Wheel(name=name, type="steered", radius=0.1, x=x, y=y, **more)


def mecanum(name: str, x: float, y: float) -> Wheel:
    return Wheel(name=name, type="mecanum", radius=0.05, x=x, y=y, roller_angle=math.copysign(math.pi / 4, x * y))


DIFF = Robot(name="diff", wheels=(fixed("right", 0, -0.2), fixed("left", 0, 0.2)))
# The right wheel is counted backwards, and the centre is ahead of the axle.
ODD_DIFF = Robot(name="odd", wheels=(fixed("l", -0.1, 0.25), fixed("r", -0.1, -0.15, angle=math.pi)))
SKID = Robot(
    name="skid",
    skid=True,
    wheels=(fixed("fl", 0.2, 0.25), fixed("fr", 0.2, -0.25), fixed("rl", -0.2, 0.25), fixed("rr", -0.2, -0.25)),
)
MECANUM = Robot(
    name="mecanum",
    wheels=(mecanum("fr", 0.2, -0.15), mecanum("fl", 0.2, 0.15), mecanum("rr", -0.2, -0.15), mecanum("rl", -0.2, 0.15)),
)
REAR = (fixed("left", 0, 0.2, measured=False), fixed("right", 0, -0.2, measured=False))
TRICYCLE = Robot(name="tricycle", wheels=(steered("front", 0.8, 0), *REAR))
FORKLIFT = Robot(name="forklift", wheels=(steered("back", -0.9, 0), *REAR))
CAR = Robot(
    name="car",
    wheels=(
        fixed("rl", -0.15, 0.12),
        fixed("rr", -0.15, -0.12),
        steered("sl", 0.2, 0.11, driven=False),
        steered("sr", 0.2, -0.11, driven=False),
    ),
)
TRIKE = Robot(name="trike", wheels=(*CAR.wheels[:2], steered("fork", -0.6, 0, driven=False)))
BICYCLE = Robot(name="bicycle", wheels=(fixed("rear", 0, 0), steered("fork", 1.0, 0, driven=False)))
SWERVE = Robot(
    name="swerve", wheels=tuple(steered(f"m{i}", *xy) for i, xy in enumerate([(0.3, 0.2), (-0.3, 0.2), (0, -0.3)]))
)


def mounted(robot: Robot) -> Robot:
    """The robot with a tracked point off its centre."""
    return robot.model_copy(update={"mount": MOUNT})


def disturbed(robot: Robot, share: float = 0.03) -> Array:
    """A matrix (3, M) of the tracked point that differs from the design in every element that moves the robot."""
    rng = np.random.default_rng(5)
    centre = robot.model_copy(update={"mount": None}).inverse_kinematic_matrix
    scales = np.abs(centre).max(axis=1, keepdims=True)
    scales[1] = max(scales[1], 0.1 * scales[0])
    other = centre + share * scales * rng.normal(size=centre.shape)
    return other if robot.mount is None else robot.mount.twist @ other


def calibration(robot: Robot, matrix: Array | None = None, **fields: Any) -> Calibration:
    chosen = robot.inverse_kinematic_matrix if matrix is None else matrix
    defaults: dict[str, Any] = {"name": robot.name, "sample_period": 0.02, "integration": "arc", "noise": NOISE}
    return Calibration(robot=robot, matrix=matrix_rows(chosen), **(defaults | fields))


def parameters(export: Export, node: str) -> dict[str, Any]:
    """The parameters of a node, nested ones by their dots."""
    content = yaml.safe_load(export.text)[node]["ros__parameters"]
    found: dict[str, Any] = {}

    def flatten(values: dict[str, Any], before: str) -> None:
        for key, value in values.items():
            if isinstance(value, dict):
                flatten(value, f"{before}{key}.")
            else:
                found[before + key] = value

    flatten(content, "")
    return found


def in_brief(export: Export) -> str:
    """Name, warnings and text of an export without its date; numbers have the four digits of any machine."""

    def rounded(found: re.Match[str]) -> str:
        value = float(found[0])
        return f"{value:.4g}" if abs(value) > 1e-9 else "0"

    text = "\n".join([export.file_name, *export.warnings, export.text])
    return re.sub(r"\d{4}-\d\d-\d\d(T[\d:]+)?", "DATE", re.sub(r"-?\d+\.\d+(e[-+]?\d+)?", rounded, text))
