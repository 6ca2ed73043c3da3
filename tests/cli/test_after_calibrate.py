"""Every command that takes a calibration takes that of ``calibrate`` as it comes."""

from pathlib import Path

import pytest
import yaml
from commands import Command, Prepared, prepare, run_here, shared_folder, succeeded
from lanes import slow_cases
from nodes import asked, running
from recording_samples import sample
from sessions import free_port
from shared_results import made_once

from omnibench.data.storage import load_dataset, save_dataset
from omnibench.live.config import read_live_config
from omnibench.robot.calibration import Calibration, matrix_rows, read_calibration, write_calibration


@made_once
def calibrated_by_default() -> Path:
    """The calibration that ``omnibench calibrate`` writes where nothing is chosen."""
    folder = shared_folder() / "by_default"
    folder.mkdir()
    succeeded(run_here("calibrate", prepare().data, "-o", folder / "calibration.yaml", cwd=folder))
    return folder / "calibration.yaml"


@pytest.fixture
def calibration() -> Path:
    return calibrated_by_default()


@pytest.mark.parametrize(
    ("typed", "says"),
    [
        ("evaluate CALIBRATION DATA", "better than the design"),
        ("certify CALIBRATION DATA --seconds 2", "optimum of the matrix alone"),
        ("export CALIBRATION --to ros2_controllers", "wheel"),
        ("export CALIBRATION --to robot_localization", "covariance"),
        ("export CALIBRATION --to c_header", "turning"),
        ("design DATA", "runs"),
        ("simulate --like DATA --model CALIBRATION -o again", "simulated"),
        *slow_cases(
            ("discover DATA --model CALIBRATION -o found", "held out"),
            ("live NODE DATA --replay --speed max", "position"),
        ),
    ],
)
def test_a_command_takes_the_default_calibration(
    typed: str, says: str, command: Command, prepared: Prepared, calibration: Path
) -> None:
    node = {"zenoh": {"listen": "tcp/127.0.0.1:17461"}, "robots": [{"name": "own", "calibration": str(calibration)}]}
    Path("node.yaml").write_text(yaml.safe_dump(node))
    places = {"CALIBRATION": str(calibration), "DATA": str(prepared.data), "NODE": "node.yaml"}
    printed = succeeded(command(*(places.get(word, word) for word in typed.split())))
    assert says in printed.stdout + printed.stderr
    assert "Warning:" not in printed.stderr


def test_a_running_node_takes_the_default_calibration(command: Command, calibration: Path) -> None:
    config = {"zenoh": {"listen": f"tcp/127.0.0.1:{free_port()}"}, "robots": [{"name": "own", "calibration": "c.yaml"}]}
    found = read_calibration(calibration)
    design = matrix_rows(found.robot.inverse_kinematic_matrix)
    of_design = {"robot": found.robot, "sample_period": found.sample_period, "integration": found.integration}
    write_calibration(Calibration(name="design", matrix=design, **of_design), Path("c.yaml"))
    Path("node.yaml").write_text(yaml.safe_dump(config))
    with running(read_live_config(Path("node.yaml"))) as (_, session):
        succeeded(command("swap", "own", calibration, "--config", "node.yaml"))
        assert asked(session, "omnibench/own/info")["calibration"] == found.name


@pytest.mark.slow
def test_scans_are_matched_with_the_odometry_of_the_default_calibration(command: Command) -> None:
    save_dataset(sample(repetitions=1, rays=360).dataset, Path("scans"))
    succeeded(command("calibrate", "scans", "-o", "c.yaml"))
    printed = succeeded(command("slam", "scans", "-o", "data", "--model", "c.yaml"))
    assert "Warning:" not in printed.stderr
    assert load_dataset(Path("data")).trajectories


def test_a_former_name_of_a_calibrator_is_one_line_of_warning(command: Command, prepared: Prepared) -> None:
    printed = succeeded(command("calibrate", prepared.data, "--calibrator", "posterior", "-o", "c.yaml"))
    lines = [line for line in printed.stderr.splitlines() if "now called" in line]
    assert lines == ["warning: calibrator posterior is now called map"]
    assert "FutureWarning" not in printed.stderr
    assert read_calibration(Path("c.yaml")).provenance.calibrator == "map"


def test_a_former_name_in_a_comparison_is_one_line_of_warning(command: Command, prepared: Prepared) -> None:
    config = yaml.safe_load(prepared.config.read_text()) | {"calibrators": ["theoretical", "posterior"]}
    Path("config.yaml").write_text(yaml.safe_dump(config))
    printed = succeeded(command("compare", "config.yaml", "-o", "out"))
    lines = [line for line in printed.stderr.splitlines() if "now called" in line]
    assert lines == ["warning: calibrator posterior is now called map"]
