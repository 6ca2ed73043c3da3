"""The table1 importer: Table 1 of Palacin et al. 2023 as files, in the units that it lists."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sample_robots

from omnibench.data.dataset import Trajectory
from omnibench.data.importers.table1 import APR_02, UTM_30LX
from omnibench.data.scans import Mount
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.robot.kinematics import wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.simulate.lidar import Lidar, LidarMount
from omnibench.slam.import_dataset import import_dataset

RPM = 2 * math.pi / 60
PERIOD, SAMPLES = 0.01, 100


def twist(v: float, alpha_deg: float, omega: float) -> np.ndarray:
    alpha = math.radians(alpha_deg)
    return np.array([v * math.cos(alpha), v * math.sin(alpha), omega])


def write_trajectory(
    folder: Path,
    command: tuple[float, float, float] = (0.2, 30.0, 0.35),
    metre: float = 1.0,
    targets: bool = True,
    first_scan: float = 0.0,
) -> Path:
    """A trajectory that the design drives without error, at constant twist on an exact arc."""
    folder.mkdir(parents=True)
    v, alpha, omega = command
    rpm = wheel_equations(APR_02.wheels) @ twist(*command) / RPM
    head = ",omega_Ma,omega_Mb,omega_Mc" if targets else ""
    told = "," + ",".join(f"{value:.12f}" for value in rpm) if targets else ""
    (folder / "command.csv").write_text(f"v,alpha,omega,d{head}\n{v},{alpha},{omega},0.2{told}\n")
    rows = [f"{PERIOD * k:.2f}," + ",".join(f"{value:.12f}" for value in rpm) for k in range(1, SAMPLES + 1)]
    (folder / "wheels.csv").write_text("t,omega_a,omega_b,omega_c\n" + "\n".join(rows) + "\n")
    (folder / "slam.csv").write_text("t,x,y,theta\n")
    with (folder / "slam.csv").open("a") as file:
        for t in np.arange(first_scan, PERIOD * SAMPLES + 1e-9, 0.25):
            half = omega * t / 2
            path = v * t * np.sinc(half / np.pi) * np.exp(1j * (math.radians(alpha) + half))
            theta = (math.degrees(omega * t) + 180) % 360 - 180
            file.write(f"{t:.2f},{path.real * metre:.12f},{path.imag * metre:.12f},{theta:.12f}\n")
    return folder


def only(root: Path, options: dict[str, object] | None = None) -> Trajectory:
    (trajectory,) = import_dataset("table1", root, options).trajectories
    return trajectory


def test_rpm_and_degrees_become_si_so_that_the_design_drives_the_reference(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "t01")
    data = import_dataset("table1", tmp_path)
    run = data.trajectories[0]
    (odometry,) = OdometryModel.of_design(data.robot, "arc").poses([run.reference_log])
    np.testing.assert_allclose(odometry, run.poses[1:], atol=1e-10)
    assert data.warnings == ()
    assert data.sample_period == PERIOD


def write_recorded(folder: Path, times: list[float]) -> None:
    """What the robot computed, at these times, and two commands that were sent to it."""
    rows = [f"{t:.2f},{0.2 * t:.6f},0,{90 * t:.6f}" for t in times]
    (folder / "odometry.csv").write_text("t,x,y,theta\n" + "\n".join(rows) + "\n")
    (folder / "commands.csv").write_text("t,v,alpha,omega,t_r\n0,0.2,30,0.35,0.5\n0.3,0.2,30,0.35,0.2\n")


def test_the_robots_odometry_and_the_commands_sent_to_it_are_kept_in_si_units(tmp_path: Path) -> None:
    write_recorded(write_trajectory(tmp_path / "t01"), [PERIOD * k for k in range(1, SAMPLES + 1)])
    save_dataset(import_dataset("table1", tmp_path), tmp_path / "saved")
    (run,) = load_dataset(tmp_path / "saved").trajectories
    expected = np.outer(run.times, [0.2, 0, math.pi / 2])
    np.testing.assert_allclose(run.odometry, expected, atol=1e-6)
    alpha = math.radians(30)
    np.testing.assert_allclose(run.sent, [[0, 0.2, alpha, 0.35, 0.5], [0.3, 0.2, alpha, 0.35, 0.2]], atol=1e-12)


def test_odometry_and_commands_are_cut_with_the_run(tmp_path: Path) -> None:
    folder = write_trajectory(tmp_path / "t01", first_scan=0.25)
    write_recorded(folder, [PERIOD * k for k in range(1, SAMPLES + 1)])
    run = only(tmp_path)
    assert len(run.odometry) == len(run.times) == SAMPLES - 25
    np.testing.assert_allclose(run.odometry[:, 0], 0.2 * (run.times + 0.25), atol=1e-6)
    np.testing.assert_allclose(run.sent[:, 0], [-0.25, 0.05])


def test_millimetres_are_an_option(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "mm", metre=1000)
    write_trajectory(tmp_path / "m")
    in_mm = only(tmp_path / "mm", {"position_unit": "mm"})
    in_m = only(tmp_path / "m")
    np.testing.assert_allclose(in_mm.poses, in_m.poses, atol=1e-12)
    assert (in_m.odometry, in_m.sent) == (None, None)


def test_the_command_is_read_in_the_units_of_table_1(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "t01", (0.2, 30.0, -0.35))
    run = only(tmp_path)
    assert (run.v, run.omega, run.distance, run.duration) == (0.2, -0.35, 0.2, 1.0)
    assert run.alpha == pytest.approx(math.pi / 6)
    assert run.command == "v0.2_a30_w-0.35_d0.2"
    np.testing.assert_allclose(run.targets, run.rates)


def test_the_robot_is_the_apr_02_unless_another_is_given(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "t01")
    assert import_dataset("table1", tmp_path).robot == APR_02
    wheels = [
        {"name": name, "radius": 0.15, "distance": 0.2, "angle_deg": angle}
        for name, angle in (("a", 60), ("b", 180), ("c", 300))
    ]
    other = import_dataset("table1", tmp_path, {"robot": {"name": "other", "wheels": wheels}}).robot
    assert (other.name, other.wheels[2].radius) == ("other", 0.15)


def test_the_default_robot_is_that_of_the_articles() -> None:
    np.testing.assert_allclose(
        APR_02.inverse_kinematic_matrix, sample_robots.APR_02.inverse_kinematic_matrix, atol=1e-15
    )


def test_a_later_first_scan_becomes_time_zero(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "t01", first_scan=0.13)
    run = only(tmp_path)
    assert run.pose_times[0] == 0
    assert run.times[0] == pytest.approx(0.01)
    (odometry,) = OdometryModel.of_design(APR_02, "arc").poses([run.reference_log])
    np.testing.assert_allclose(odometry, run.poses[1:], atol=1e-10)


def test_folders_called_train_and_validation_or_patterns_split(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "train" / "t01")
    write_trajectory(tmp_path / "validation" / "t01")
    data = import_dataset("table1", tmp_path)
    assert [(run.id, run.split, run.session, run.repetition) for run in data.trajectories] == [
        ("train/t01", "train", "train", 1),
        ("validation/t01", "validation", "validation", 1),
    ]
    data = import_dataset("table1", tmp_path, {"validation": "train/*"})
    assert [run.split for run in data.trajectories] == ["validation", "train"]
    write_trajectory(tmp_path / "t02")
    with pytest.raises(DataError, match="'t02' is in no folder train or validation"):
        import_dataset("table1", tmp_path)


def test_without_such_folders_every_second_repetition_validates(tmp_path: Path) -> None:
    for number in range(3):
        write_trajectory(tmp_path / f"t{number}")
    write_trajectory(tmp_path / "t9", (0.2, 0.0, 0.0))
    data = import_dataset("table1", tmp_path)
    assert [run.split for run in data.trajectories] == ["train", "validation", "train", "train"]


def test_targets_are_left_out_unless_all_trajectories_have_them(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "t1")
    write_trajectory(tmp_path / "t2", targets=False)
    data = import_dataset("table1", tmp_path)
    save_dataset(data, tmp_path / "out")
    assert load_dataset(tmp_path / "out").hash == data.hash


def write_scans(folder: Path, stamps: list[float], rays: int = 1080, metre: float = 1000.0) -> np.ndarray:
    """A lidar.csv of walls between 1 and 4 m, with one ray that saw nothing; its ranges in m."""
    ranges = np.round(np.random.default_rng(0).uniform(1.0, 4.0, (len(stamps), rays)), 3)
    ranges[:, 7] = 0.0
    rows = [f"{t:g}," + ",".join(f"{metre * each:.0f}" for each in row) for t, row in zip(stamps, ranges, strict=True)]
    head = "t," + ",".join(f"d{ray}" for ray in range(1, rays + 1))
    (folder / "lidar.csv").write_text("\n".join([head, *rows]) + "\n")
    return np.where(ranges > 0, ranges, np.inf)


def test_scans_of_lidar_csv_become_scans_of_the_data_set_on_disk(tmp_path: Path) -> None:
    folder = write_trajectory(tmp_path / "in" / "t01", first_scan=0.25)
    write_trajectory(tmp_path / "in" / "t02")
    ranges = write_scans(folder, [0.0, 0.25, 0.5, 0.75, 1.25])
    save_dataset(import_dataset("table1", tmp_path / "in"), tmp_path / "out")
    assert (tmp_path / "out" / "scans.parquet").is_file()
    scans = load_dataset(tmp_path / "out").scans
    assert scans.trajectories == ("t01",)
    assert scans.times("t01").tolist() == [0.0, 0.25, 0.5]  # from the first pose to the last wheel sample
    np.testing.assert_allclose(scans.of("t01").ranges, ranges[1:4], atol=1e-6)
    assert scans.scanner == Lidar(mount=LidarMount(x=0)).scanner  # the data sheet's, as the simulated robot has it


def test_it_is_said_that_the_mount_of_the_scanner_is_not_known(tmp_path: Path) -> None:
    write_scans(write_trajectory(tmp_path / "t01"), [0.0, 0.25])
    (warning,) = import_dataset("table1", tmp_path).warnings
    assert "does not say where the LIDAR is mounted" in warning
    mounted = UTM_30LX.model_copy(update={"mount": Mount(x=0.1)}).model_dump()
    data = import_dataset("table1", tmp_path, {"scanner": mounted})
    assert data.warnings == ()
    assert data.scans.scanner.mount.x == 0.1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rays": 1081}, r"lidar\.csv: it has more than the 1080 ranges of the scanner"),
        ({"rays": 1000}, r"lidar\.csv: column 'd1001' is missing"),
        ({"metre": 1.0}, r"lidar\.csv, row 1 \(line 2\): no range is from 100 to 30000 mm"),
        ({"stamps": [2.0, 3.0]}, r"lidar\.csv: no scan while poses and wheels were recorded"),
        ({"stamps": [0.5, 0.25]}, r"lidar\.csv, row 2 \(line 3\): t goes backwards"),
    ],
)
def test_a_malformed_scan_file_is_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    write_scans(write_trajectory(tmp_path / "t01"), **{"stamps": [0.0, 0.25], **changes})
    with pytest.raises(DataError, match=message):
        import_dataset("table1", tmp_path)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("wheels.csv", "0.05,", "0.03,", r"wheels\.csv, row 5 \(line 6\): t goes backwards: 0\.03 after 0\.04"),
        ("wheels.csv", "omega_b", "omegab", r"wheels\.csv: column 'omega_b' is missing; did you mean 'omegab'\?"),
        ("slam.csv", "0.50,", "0.50;", r"slam\.csv, row 3 \(line 4\): t is '0\.50;\S+', expected a number"),
        ("slam.csv", "0.00,", "-0.10,", r"slam\.csv, row 1 \(line 2\): t is -0\.1"),
        ("slam.csv", None, "t,x,y,theta\n2,0,0,0\n3,0,0,0\n", r"slam\.csv: no two poses while the wheels"),
        ("command.csv", "0.2,30", "fast,30", r"command\.csv, row 1 \(line 2\): v is 'fast'"),
        ("command.csv", "omega,", "omega,omega,", r"command\.csv: column 'omega' is there 2 times"),
        ("command.csv", None, "v,alpha,omega,d\n0.2,30,0,1\n0.2,0,0,1\n", r"command\.csv: it has 2 rows, expected one"),
        ("odometry.csv", None, "t,x,y,theta\n0.1,0,0,0\n", r"odometry\.csv: its times t are not those of wheels\.csv"),
    ],
)
def test_a_broken_file_is_named_with_a_row(tmp_path: Path, file: str, old: str | None, new: str, message: str) -> None:
    path = write_trajectory(tmp_path / "t01") / file
    path.write_text(new if old is None else path.read_text().replace(old, new, 1))
    with pytest.raises(DataError, match=message):
        import_dataset("table1", tmp_path)


def test_a_missing_file_no_trajectory_and_an_unknown_unit_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no command\.csv below it"):
        import_dataset("table1", tmp_path)
    with pytest.raises(ConfigError, match="importer 'table1': position_unit"):
        import_dataset("table1", tmp_path, {"position_unit": "mile"})
    (write_trajectory(tmp_path / "t01") / "slam.csv").unlink()
    with pytest.raises(DataError, match=r"t01.slam\.csv: no such file"):
        import_dataset("table1", tmp_path)
