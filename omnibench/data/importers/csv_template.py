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
    model, steered = OdometryModel.of_design(robot, "arc"), robot.drive.steered
    names = [*(f"omega_{wheel}" for wheel in robot.wheel_names), *(f"steer_{wheel}" for wheel in steered)]
    commands = _COMMANDS
    if references:  # which are told best along straights and on the spot
        sideways = not steered and np.linalg.matrix_rank(robot.inverse_kinematic_matrix) == len(_NOISE)
        commands = {"straight": _COMMANDS["straight"], **_BACK, **(_SIDEWAYS if sideways else {})}
        commands |= {command: _COMMANDS[command] if steered else spin for command, spin in _SPINS.items()}
    for command, twist in commands.items():
        for repetition in (1, 2):
            run = f"{command}_{repetition}"
            runs.append(f"{run},{command},{repetition}")
            log = _log(robot, np.array(twist))
            columns = log.rates if log.steering is None else np.hstack([log.rates, log.steering])
            files[folder / f"{run}_wheels.csv"] = _csv(["t", *names], log.times, columns)
            (poses,) = model.poses([log])
            if not references:
                shown = poses + rng.normal(0.0, _NOISE, poses.shape)
                files[folder / f"{run}_poses.csv"] = _csv(["t", "x", "y", "theta"], log.stamps, shown)
            elif command in _SPINS:
                measured.append(f"{run},turn,{poses[-1, 2] + rng.normal(0.0, _BY_MARK):.4f},,,{_BY_MARK}")
            elif command in _SIDEWAYS:
                x, y = poses[-1, :2] + rng.normal(0.0, _BY_TAPE, 2)
                measured.append(f"{run},displacement,,{x:.4f},{y:.4f},{_BY_TAPE}")
            else:
                distance = np.hypot(*poses[-1, :2]) + rng.normal(0.0, _BY_TAPE)
                measured.append(f"{run},distance,{distance:.4f},,,{_BY_TAPE}")
    if references:
        files[folder / "references.csv"] = "\n".join(measured) + "\n"
    files[folder / "runs.csv"] = "\n".join(runs) + "\n"
    for file, content in files.items():
        write_text(file, content)
    return list(files)


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
