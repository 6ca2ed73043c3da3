"""The robotino importer: a plug-in in one file, on the recordings where they are at hand."""

from itertools import permutations, product
from pathlib import Path

import numpy as np
import pytest

from omnibench.data.dataset import Dataset
from omnibench.errors import ConfigError, DataError
from omnibench.registry import importers, load_plugin_file
from omnibench.robot.kinematics import wheel_equations
from omnibench.robot.odometry import OdometryBatch
from omnibench.slam.import_dataset import import_dataset

ROOT = Path(__file__).resolve().parents[2]
PLUGIN = ROOT / "plugins" / "robotino.py"

COLUMNS = "t;xsetspeed;ysetspeed;setvel;m1setvel;m2setvel;m3setvel;m1pos;m2pos;m3pos;xpos;ypos;ang"


@pytest.fixture(scope="module", autouse=True)
def _loaded() -> None:
    assert load_plugin_file(PLUGIN) is None


def test_the_registry_knows_the_plugin_and_its_file() -> None:
    entry = importers.entry("robotino")
    assert entry.origin == str(PLUGIN)
    assert entry.summary.startswith("Festo Robotino v2")


def test_all_72_directions_are_read_and_every_second_validates(robotino: Dataset) -> None:
    assert (len(robotino.split("train")), len(robotino.split("validation"))) == (36, 36)
    directions = np.degrees([run.alpha or 0.0 for run in robotino.trajectories])
    np.testing.assert_allclose(directions, 5 * np.arange(72), atol=1e-3)
    assert [run.split for run in robotino.trajectories[:4]] == ["train", "validation"] * 2
    assert robotino.warnings == ()


def test_set_speeds_obey_the_wheel_equation_of_the_design(robotino: Dataset) -> None:
    for run in robotino.trajectories:
        twist = run.v * np.cos(run.alpha), run.v * np.sin(run.alpha), 0.0
        expected = wheel_equations(robotino.robot.wheels) @ twist
        np.testing.assert_allclose(np.median(run.targets, axis=0), expected, atol=1e-4)


def test_no_other_order_or_signs_of_the_wheels_fit_the_camera(robotino: Dataset) -> None:
    batch = OdometryBatch([run.final_log for run in robotino.trajectories], "arc")
    finals = np.array([run.final_pose for run in robotino.trajectories])
    design = robotino.robot.inverse_kinematic_matrix
    arrangements = list(product(permutations(range(3)), product((1, -1), repeat=3)))
    matrices = np.array([design[:, order] * signs for order, signs in arrangements])
    errors = np.linalg.norm((batch.poses(matrices) - finals)[..., :2], axis=-1).mean(axis=1)
    best, second = np.argsort(errors)[:2]
    assert arrangements[best] == ((0, 1, 2), (1, 1, 1))
    assert errors[best] < 0.17
    assert errors[second] > 1.0


def test_the_design_model_predicts_the_camera_s_headings(robotino: Dataset) -> None:
    batch = OdometryBatch([run.final_log for run in robotino.trajectories], "arc")
    headings = batch.poses(robotino.robot.inverse_kinematic_matrix[None])[0, :, 2]
    errors = headings - [run.final_pose[2] for run in robotino.trajectories]
    turned = [run.final_pose[2] - run.start[2] for run in robotino.trajectories]
    assert np.degrees(np.abs(errors).mean()) < 2
    assert np.degrees(np.abs(turned).mean()) > 10


def write_run(folder: Path, name: str = "exp00", vx: float = 0.1) -> Path:
    """One second along +x at the wheel rates of the design, the camera agreeing."""
    folder.mkdir(parents=True, exist_ok=True)
    ticks = 34.641 * np.sign(vx) / (2 * np.pi) * 2000  # a second
    rows = []
    for k in range(6):
        seconds = 0.2 * k
        pixels = 900 - vx * seconds / 1.83716e-3
        set_speeds = f"{-34.641 * np.sign(vx):.3f};0;{34.641 * np.sign(vx):.3f}"
        counts = f"{-ticks * seconds:.0f};0;{ticks * seconds:.0f}"
        rows.append(f"{200 * k + 0.02};{vx};0;0;{set_speeds};{counts};880;{pixels:.4f};0;")
    file = folder / f"{name}.csv"
    header = [f"{line};" for line in ("Time" + 12 * ";x", "ms" + 12 * ";x", COLUMNS)]
    file.write_text("\n".join([*header, *rows]) + "\n")
    return file


def test_pixels_and_ticks_become_si(tmp_path: Path) -> None:
    write_run(tmp_path / "oak")
    (run,) = import_dataset("robotino", tmp_path).trajectories
    assert run.id == "oak/exp00"
    assert (run.pose_times[0], run.pose_times[-1]) == (0.0, pytest.approx(1.0))
    np.testing.assert_allclose(run.poses[-1] - run.poses[0], [0.1, 0, 0], atol=1e-5)
    np.testing.assert_allclose(run.rates[0], [-34.641 / 16, 0, 34.641 / 16], rtol=1e-3)


def test_patterns_split_runs(tmp_path: Path) -> None:
    write_run(tmp_path / "oak", "exp00")
    write_run(tmp_path / "oak", "exp01", -0.1)
    data = import_dataset("robotino", tmp_path, {"train": "oak/exp01"})
    assert {run.id: run.split for run in data.trajectories} == {"oak/exp00": "validation", "oak/exp01": "train"}
    with pytest.raises(ConfigError, match="no run matches 'oak/exp9'"):
        import_dataset("robotino", tmp_path, {"train": "oak/exp9"})


def test_a_malformed_row_and_a_folder_without_runs_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"exp\*\.csv"):
        import_dataset("robotino", tmp_path)
    file = write_run(tmp_path / "oak")
    file.write_text(file.read_text().replace("400.02;0.1", "400.02;full"))
    with pytest.raises(DataError, match=r"exp00\.csv, row 3 \(line 6\): xsetspeed is 'full'"):
        import_dataset("robotino", tmp_path)


# Options of ``import dataset`` hold for an importer that knows none of them.


def test_signs_order_and_cuts_are_applied_to_what_it_reads(tmp_path: Path) -> None:
    write_run(tmp_path)
    (plain,) = import_dataset("robotino", tmp_path).trajectories
    data = import_dataset("robotino", tmp_path, {"wheel_signs": [-1, 1, 1], "wheel_columns": ["2", "1", "3"]})
    (run,) = data.trajectories
    np.testing.assert_allclose(run.rates, plain.rates[:, [1, 0, 2]] * [-1, 1, 1])
    assert (run.id, run.split, run.command, run.session) == (plain.id, plain.split, plain.command, plain.session)
    assert data.imported.options == {"wheel_signs": [-1, 1, 1], "wheel_columns": ["2", "1", "3"]}
    cut = import_dataset("robotino", tmp_path, {"window": 0.5, "name": "halves"})
    assert (cut.name, len(cut.trajectories)) == ("halves", 2)
