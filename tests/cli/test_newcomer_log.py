"""A newcomer's log, of a generator that omnibench does not know: what is typed in order, up to a calibration."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
import yaml
from commands import omnibench
from newcomer_log import Machine, write_logs

# By 40 seeds 2 to 12 % of the elements lie beyond 2.1 standard deviations; these two seeds were chosen, 1 is as good.
_SEEDS = {"diff": 2, "mecanum": 6}
_WHEELS = {
    "diff": [
        {"name": name, "type": "fixed", "radius": 0.075, "x": 0, "y": y}
        for name, y in (("left", 0.16), ("right", -0.16))
    ],
    "mecanum": [
        {"name": name, "type": "mecanum", "radius": 0.06, "x": 0.21 * x, "y": 0.17 * y, "roller_angle_deg": 45 * x * y}
        for name, x, y in (("fl", 1, 1), ("fr", 1, -1), ("rl", -1, 1), ("rr", -1, -1))
    ],
}
_SURE = 2.4  # standard deviations: the 95 % interval by Student's t of the 7 or 8 degrees of freedom of these drives


def log_of(robot: str, folder: Path) -> Machine:
    machine = write_logs(folder, robot, _SEEDS[robot])
    (folder / "robot.yaml").write_text(yaml.safe_dump({"name": "rover", "wheels": _WHEELS[robot]}))
    return machine


def typed_on(line: str, machine: Machine) -> list[str]:
    """The options of an error, with its blanks filled in: NAME of the columns, in the robot's order, N of the ticks."""
    options = line[line.index("--set") :].rstrip("?\n")
    for column in machine.columns:
        options = options.replace("NAME", column, 1)
    if "wheel_unit" not in options:
        options += " --set wheel_unit=ticks --set ticks_per_turn=N"
    return shlex.split(options.replace("=N", f"={machine.ticks}"))


@pytest.mark.parametrize("robot", ["diff", pytest.param("mecanum", marks=pytest.mark.slow)])
def test_four_commands_lead_from_a_strange_log_to_the_true_calibration(robot: str, tmp_path: Path) -> None:
    machine = log_of(robot, tmp_path)
    first = ["import", "csv", "logs", "-o", "data", "--set", "robot=robot.yaml"]
    refused = omnibench(*first, cwd=tmp_path)
    assert refused.returncode == 2
    assert "columns={" in refused.stderr
    assert all(column in refused.stderr for column in machine.columns)

    named = [*first, *typed_on(refused.stderr, machine)]
    odd = omnibench(*named, cwd=tmp_path)
    assert odd.returncode == 2
    assert "heading_unit=deg" in odd.stderr
    assert "position_unit=mm" in odd.stderr

    units = ["heading_unit=deg", "position_unit=mm", "wheel_time_unit=ms", "command_pattern=^(.*)_"]
    whole = omnibench(*named, *(word for unit in units for word in ("--set", unit)), cwd=tmp_path)
    assert whole.returncode == 0, whole.stderr

    calibrated = omnibench("calibrate", "data", "-o", "calibration.yaml", "--json", cwd=tmp_path)
    assert calibrated.returncode == 0, calibrated.stderr
    content = json.loads(calibrated.stdout)
    assert content["provenance"]["held_out"]["verdict"] == "better"
    assert_holds(content, machine)


def assert_holds(content: dict[str, object], machine: Machine) -> None:
    """Assert that the matrix, on wheel rates that force no slip, is the true one within its uncertainty."""
    matrix = np.array(content["matrix"])
    allowed = np.linalg.pinv(machine.design) @ machine.design
    blocks = np.kron(np.eye(3), allowed)
    covariance = blocks @ np.array(content["covariance"])[: matrix.size, : matrix.size] @ blocks.T
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0)).reshape(matrix.shape)
    error = np.abs((matrix - machine.truth) @ allowed)
    assert (error <= _SURE * deviations + 1e-12).all()
    assert (error <= 0.02 * np.abs(machine.truth).max(axis=1, keepdims=True)).all()
