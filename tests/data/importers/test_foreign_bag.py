"""A newcomer's way: another laboratory's ROS 1 bag becomes a calibration by options that the error lines name."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from commands import Command, assert_refused
from mecanum_bag import DESIGN, GEAR, TICKS, write_mecanum_bag


@pytest.fixture(scope="module")
def foreign_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mecanum_bag(tmp_path_factory.mktemp("foreign") / "drive")


@pytest.mark.slow
def test_every_error_line_names_the_option_that_leads_on(command: Command, tmp_path: Path, foreign_bag: Path) -> None:
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(DESIGN))
    said: list[str] = []

    def attempt(*new: str) -> list[str]:
        said.extend(each for option in new for each in ("--set", option))
        return ["import", "rosbag", str(foreign_bag), "-o", "data", *said]

    assert_refused(command(*attempt()), "key 'robot' is missing (name and wheels: --set robot=FILE.yaml")
    assert_refused(command(*attempt("robot=robot.yaml")), "whole numbers: --set wheel_unit=ticks --set ticks_per_turn")
    assert_refused(
        command(*attempt("wheel_unit=ticks")), "needs ticks_per_turn (of the wheel, gear included; of the motor"
    )
    assert_refused(
        command(*attempt(f"ticks_per_turn={TICKS}")), "set ticks_per_turn=N, gear_ratio=N (turns of the motor for"
    )
    turned = command(*attempt(f"gear_ratio={GEAR}"))
    assert turned.returncode == 0
    assert "begin again after 65536 ticks and were counted on (wraps_at=65536 says so)" in turned.stderr
    assert "--set 'wheel_signs=[1,-1,1,-1]'" in turned.stderr
    right = command(*attempt("joint_signs=[1,-1,1,-1]", "wraps_at=2^16"), "--force")
    assert (right.returncode, "warning" in right.stderr) == (0, False)
    assert right.stdout == "20 trajectories: data\n"

    inspected = command("inspect", "data")
    assert (inspected.returncode, "warning" in inspected.stderr) == (0, False)
    assert command("calibrate", "data", "-o", "calibration.yaml").returncode == 0
    judged = command("evaluate", "calibration.yaml", "data")
    assert "better than the design" in judged.stdout
