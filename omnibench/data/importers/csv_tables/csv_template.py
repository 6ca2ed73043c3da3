"""Tables and a robot.yaml to fill in, which import as they are written."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from omnibench.config import parse_yaml, validate
from omnibench.files import write_text
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

_PERIOD, _POSE_PERIOD = 0.05, 0.1  # s
_LENGTH, _REST = 6.0, 0.5  # s of a run, and of the rests before and after it
_NOISE = (0.002, 0.002, 0.004)  # m, m, rad, as of motion capture: exact poses would be taken for odometry
# Commands of the example runs, each driven twice: twists, m/s, m/s, rad/s.
_COMMANDS = {"straight": (0.3, 0.0, 0.0), "left": (0.25, 0.0, 0.5), "right": (0.25, 0.0, -0.5)}
_BACK, _SIDEWAYS = {"back": (-0.3, 0.0, 0.0)}, {"sideways": (0.0, 0.3, 0.0)}
_SPINS = {"left": (0.0, 0.0, 0.8), "right": (0.0, 0.0, -0.8)}
# m, rad: standard deviations of a length by tape and of an angle by marks on the floor
_BY_TAPE, _BY_MARK = 0.003, 0.01

_HEAD = """\
# The robot, by its design values: m, and degrees under keys that end in _deg.
# x is forward and y left of the robot's centre; angles and turns are
# counter-clockwise.
{sign}
name: my_robot
wheels:
"""
_FORWARD = "# Each wheel counts up when it drives the robot forward."
_STEERED = """\
# Each wheel counts up when it drives the robot forward. Steering angles
# (columns steer_<wheel>, rad; --set steering_unit=deg for degrees) are 0
# straight ahead and grow to the left."""
_OMNI = """\
# Each wheel counts up when it turns the robot counter-clockwise. distance: from
# the centre to the wheel; angle_deg: from x to the wheel's axle."""
_FIXED = "  - {{name: {0}, type: fixed, radius: 0.05, x: {1}, y: {2}}}\n"
_ROBOTS = {
    "diff": (_FORWARD, _FIXED.format("left", 0, 0.15) + _FIXED.format("right", 0, -0.15)),
    "skid": (
        _FORWARD,
        "".join(
            _FIXED.format(f"{end}_{side}", x, y)
            for end, x in (("front", 0.15), ("rear", -0.15))
            for side, y in (("left", 0.2), ("right", -0.2))
        )
        + "skid: true # fixed wheels slide when the robot turns\n",
    ),
    "omni3": (
        _OMNI,
        "".join(
            f"  - {{name: {name}, type: omni, radius: 0.05, distance: 0.2, angle_deg: {angle}}}\n"
            for name, angle in (("a", 60), ("b", 180), ("c", 300))
        ),
    ),
    "mecanum": (
        _FORWARD,
        "".join(
            f"  - {{name: {end}_{side}, type: mecanum, radius: 0.05, x: {x}, y: {y},\n"
            f"     roller_angle_deg: {roller}}}\n"
            for end, side, x, y, roller in (
                ("front", "left", 0.2, 0.15, 45),
                ("front", "right", 0.2, -0.15, -45),
                ("rear", "left", -0.2, 0.15, -45),
                ("rear", "right", -0.2, -0.15, 45),
            )
        ),
    ),
    "tricycle": (
        _STEERED,
        "  - {name: front, type: steered, radius: 0.05, x: 0.5, y: 0} # driven\n"
        "  # without encoders: they only guide\n"
        "  - {name: left, type: fixed, radius: 0.05, x: 0, y: 0.2, measured: false}\n"
        "  - {name: right, type: fixed, radius: 0.05, x: 0, y: -0.2, measured: false}\n",
    ),
    "car": (
        _STEERED,
        _FIXED.format("rear_left", 0, 0.2)
        + _FIXED.format("rear_right", 0, -0.2)
        + "  # of the front axle only the angle is measured\n"
        "  - {name: front, type: steered, driven: false, radius: 0.05, x: 0.5, y: 0}\n",
    ),
    "swerve": (
        _STEERED,
        "".join(
            f"  - {{name: {end}_{side}, type: steered, radius: 0.05, x: {x}, y: {y}}}\n"
            for end, x in (("front", 0.2), ("rear", -0.2))
            for side, y in (("left", 0.2), ("right", -0.2))
        ),
    ),
}
_TAIL = """\
# Where the reference tracks another point than the robot's centre:
# mount: {{x: 0.1, y: 0, yaw_deg: 0}}
#
# {tables}
#   <run>_wheels.csv  t (s), then for each wheel its mean rate since the row
#                     before (rad/s). Ticks are taken as well: columns
#                     ticks_<wheel>, and on import --set wheel_unit=ticks
#                     --set ticks_per_turn=4096 (with gear_ratio of a motor)
{reference}
# Replace the rows by yours, and begin each run at rest. runs.csv names the
# command of each run, which repetitions share.
# Other columns, units and layouts: omnibench import csv --help
"""
_POSES = """\
#   <run>_poses.csv   t (s) by the same clock, x, y (m) and theta (rad) of
#                     motion capture, a camera or SLAM"""
_REFERENCES = """\
#   references.csv    a row for each measurement: run, kind, value and sigma, its
#                     standard deviation. distance: m driven (tape); turn: rad,
#                     counter-clockwise (marks on the floor); displacement:
#                     value_x, value_y, m, in the robot's frame at the start.
#                     More kinds: omnibench guide references"""


def write_template(folder: Path, robot_type: str, *, references: bool = False) -> list[Path]:
    """Write robot.yaml, runs.csv and tables of a few runs of a robot of this type; the files.

    references: distances and turned angles in the place of poses.
    """
    sign, wheels = _ROBOTS[robot_type]
    tables = "Every run has a table beside this file:" if references else "Every run has two tables beside this file:"
    tail = _TAIL.format(tables=tables, reference=_REFERENCES if references else _POSES)
    text = _HEAD.format(sign=sign) + wheels + tail
    robot = validate(Robot, parse_yaml(text, "robot.yaml"), "robot.yaml")
    rng = np.random.default_rng(0)
    files = {folder / "robot.yaml": text}
    runs, measured = ["run,command,repetition"], ["run,kind,value,value_x,value_y,sigma"]
    for command, twist in (_measured_commands(robot) if references else _COMMANDS).items():
        for repetition in (1, 2):
            run = f"{command}_{repetition}"
            runs.append(f"{run},{command},{repetition}")
            log = _log(robot, np.array(twist))
            names = [f"omega_{wheel}" for wheel in robot.wheel_names] + [
                f"steer_{wheel}" for wheel in robot.drive.steered
            ]
            columns = log.rates if log.steering is None else np.hstack([log.rates, log.steering])
            files[folder / f"{run}_wheels.csv"] = _csv(["t", *names], log.times, columns)
            if references:
                measured.append(f"{run},{_measured(robot, log, command, rng)}")
            else:
                files[folder / f"{run}_poses.csv"] = _poses_table(robot, log, rng)
    if references:
        files[folder / "references.csv"] = "\n".join(measured) + "\n"
    files[folder / "runs.csv"] = "\n".join(runs) + "\n"
    for file, content in files.items():
        write_text(file, content)
    return list(files)


def _measured_commands(robot: Robot) -> dict[str, tuple[float, float, float]]:
    """Commands whose ends a tape and marks on the floor can tell: turns on the spot, where a robot need not steer."""
    turns = {command: _COMMANDS[command] if robot.drive.steered else spin for command, spin in _SPINS.items()}
    sideways = _SIDEWAYS if np.linalg.matrix_rank(robot.inverse_kinematic_matrix) == len(_NOISE) else {}
    return {"straight": _COMMANDS["straight"], **_BACK, **({} if robot.drive.steered else sideways), **turns}


def _measured(robot: Robot, log: WheelLog, command: str, rng: np.random.Generator) -> str:
    """The row of what is measured of a run, after its name: kind, value, value_x, value_y and sigma."""
    (poses,) = OdometryModel.of_design(robot, "arc").poses([log])
    x, y, turned = poses[-1]
    if command in _SPINS:
        return f"turn,{turned + rng.normal(0.0, _BY_MARK):.4f},,,{_BY_MARK}"
    if command in _SIDEWAYS:
        x, y = poses[-1, :2] + rng.normal(0.0, _BY_TAPE, 2)
        return f"displacement,,{x:.4f},{y:.4f},{_BY_TAPE}"
    return f"distance,{np.hypot(x, y) + rng.normal(0.0, _BY_TAPE):.4f},,,{_BY_TAPE}"


def _log(robot: Robot, twist: Array) -> WheelLog:
    """The wheels of a run at a twist (3,), m/s, m/s, rad/s, from rest to rest."""
    times = _PERIOD * np.arange(1, round(_LENGTH / _PERIOD) + 1)
    share = np.clip(np.minimum(times - _REST, _LENGTH - _REST - times), 0.0, _REST) / _REST
    rates, angles = _driven(robot, twist)
    steering = np.tile(angles, (len(times), 1)) if len(angles) else None
    stamps = _POSE_PERIOD * np.arange(round(_LENGTH / _POSE_PERIOD) + 1)
    drive = None if robot.drive.direct else robot.drive
    return WheelLog(times, share[:, None] * rates, np.zeros(3), stamps, steering=steering, drive=drive)


def _poses_table(robot: Robot, log: WheelLog, rng: np.random.Generator) -> str:
    (poses,) = OdometryModel.of_design(robot, "arc").poses([log])
    return _csv(["t", "x", "y", "theta"], log.stamps, poses + rng.normal(0.0, _NOISE, poses.shape))


def _driven(robot: Robot, twist: Array) -> tuple[Array, Array]:
    """Wheel rates (N,) and steering angles (S,) that drive the robot by a twist (3,)."""
    signals = robot.signal_equations @ twist
    if robot.drive.direct:
        return signals, np.empty(0)
    rates, angles = robot.drive.commands(signals[None])
    return rates[0], angles[0]


def _csv(names: list[str], times: Array, columns: Array) -> str:
    rows = [",".join(f"{value:.4f}" for value in row) for row in np.column_stack([times, columns])]
    return "\n".join([",".join(names), *rows]) + "\n"
