"""Options to type on import for the changes that mend a misreading, relative to the present ones."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from omnibench.config import parse_yaml
from omnibench.data.checks.finding import Finding, FindingWarning
from omnibench.data.checks.misreading import FEWEST_TICKS
from omnibench.robot.kinematics import Robot

_TIMES, _PLUS, _COLUMNS = "times the present ones", "added to the present ones", "the columns of these wheels"
# Of changes relative to the present options: the option, how its value is meant, and the option of bags, if another.
_OPTIONS = {
    "wheel_order": ("wheel_columns", _COLUMNS, "joints"),
    "wheel_signs": ("wheel_signs", _TIMES, "joint_signs"),
    "rate_factors": ("gear_ratio", _TIMES, ""),
    "steering_order": ("steering_columns", _COLUMNS, "steering_joints"),
    "steering_signs": ("steering_signs", _TIMES, ""),
    "steering_factors": ("steering_scale", _TIMES, ""),
    "steering_offsets_deg": ("steering_offsets_deg", _PLUS, ""),
}
# Of a factor of all wheels: the options where it is that of ticks, and other ways.
_FACTORS = {
    "rate_factors": (
        "--set wheel_unit=ticks --set ticks_per_turn=N, with /s or /sample behind ticks",
        ", where the encoder is at the motor; or ticks_per_turn, which counts edges (4 a pulse), or correct the radius "
        "of the wheels, in m, in robot.yaml",
    ),
    "steering_factors": (
        "--set steering_unit=ticks --set steering_ticks_per_turn=N",
        "; or steering_unit; or calibrate with --steering fit",
    ),
}


def warning_of(robot: Robot, finding: Finding, *, unit: bool = False) -> FindingWarning:
    """The warning of a finding, with what mends it. unit: a unit cannot be right."""
    way = _mended_by(robot, finding.changes) if finding.changes else finding.fix
    return FindingWarning.of(finding, f"{finding.what} ({way})", unit=unit)


def _mended_by(robot: Robot, changes: Mapping[str, Any]) -> str:
    """The options of an import that make the changes, in words."""
    options = " and ".join(_option(robot, key, value) for key, value in changes.items())
    of_bags = " and ".join(_OPTIONS[key][2] for key in changes if key in _OPTIONS and _OPTIONS[key][2])
    return f"import with {options}{f'; rosbag: {of_bags}' if of_bags else ''}"


def _option(robot: Robot, key: str, value: Any) -> str:
    if key not in _OPTIONS:
        positions = f", or {value[:-2]} of positions" if key == "wheel_unit" and value.endswith("/s") else ""
        return f"--set {key}={as_yaml(value)}{positions}"
    option, meant, _ = _OPTIONS[key]
    if meant == _COLUMNS:
        names = robot.wheel_names if key == "wheel_order" else robot.drive.steered
        return f"--set {option}={as_yaml([names[column] for column in value])}, {meant}"
    rounded = [float(f"{each:.6g}") for each in value]
    if key not in _FACTORS or len(set(value)) > 1:
        return f"--set {option}={as_yaml(rounded)}, {meant}"
    count = 2 * math.pi * (value[0] if key == "rate_factors" else 1 / value[0])
    ticks, otherwise = _FACTORS[key]
    return f"{f'{ticks}; or ' if count > FEWEST_TICKS else ''}--set {option}={as_yaml(rounded[0])}, {meant}{otherwise}"


def as_yaml(value: Any) -> str:
    """A value as ``--set`` takes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        plain = value and all(letter.isalnum() or letter in "._/*-" for letter in value) and value[0] != "*"
        return value if plain and parse_yaml(value, "value") == value else json.dumps(value)
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    if isinstance(value, Mapping):
        return json.dumps(value)
    if isinstance(value, list | tuple):
        return f"[{','.join(as_yaml(item) for item in value)}]"
    return str(value)
