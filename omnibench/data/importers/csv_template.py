"""Tables and a robot.yaml to fill in, which import as they are written."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from omnibench.config import parse_yaml, read_yaml, validate
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
_TEXTS = Path(__file__).with_suffix(".yaml")


def write_template(folder: Path, robot_type: str, *, references: bool = False) -> list[Path]:
    """Write robot.yaml, runs.csv and tables of a few runs of a robot of this type; the files.

    references: distances and turned angles in the place of poses.
    """
    texts = read_yaml(_TEXTS)
    tables = f"Every run has {'a table' if references else 'two tables'} beside this file:"
    reference = texts["references" if references else "poses"].rstrip()
    text = texts["head"] + texts["robots"][robot_type] + texts["tail"].format(tables=tables, reference=reference)
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
                (poses,) = OdometryModel.of_design(robot, "arc").poses([log])
                shown = poses + rng.normal(0.0, _NOISE, poses.shape)
                files[folder / f"{run}_poses.csv"] = _csv(["t", "x", "y", "theta"], log.stamps, shown)
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
    stamps, rates = _POSE_PERIOD * np.arange(round(_LENGTH / _POSE_PERIOD) + 1), robot.signal_equations @ twist
    if robot.drive.direct:
        return WheelLog(times, share[:, None] * rates, np.zeros(3), stamps)
    (rates,), (angles,) = robot.drive.commands(rates[None])
    steering = np.tile(angles, (len(times), 1)) if len(angles) else None
    return WheelLog(times, share[:, None] * rates, np.zeros(3), stamps, steering=steering, drive=robot.drive)


def _csv(names: list[str], times: Array, columns: Array) -> str:
    rows = [",".join(f"{value:.4f}" for value in row) for row in np.column_stack([times, columns])]
    return "\n".join([",".join(names), *rows]) + "\n"
