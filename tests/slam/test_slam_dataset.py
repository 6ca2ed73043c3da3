"""SLAM of whole data sets: what becomes of them, on import too, and what is said of bad ones."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from bag_samples import DRIVE, EPOCH, Sent, header, odometry_error, pose, read, text, write_mcap, write_rosbag1
from hypothesis import given
from hypothesis import strategies as st
from scan_samples import MOUNTED, SECONDS, without_poses
from slam_study import ROBOT, drive, flower_command

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.scans import ScansInMemory, TrajectoryScans
from omnibench.data.true_poses import TruePath
from omnibench.errors import ConfigError, DataError
from omnibench.progress import Progress
from omnibench.robot.kinematics import published_matrix
from omnibench.robot.model import OdometryModel
from omnibench.simulate.floor_plan import RoomPlan, make_plan
from omnibench.simulate.lidar import Lidar
from omnibench.slam.import_dataset import import_dataset
from omnibench.slam.pose_errors import FLOOR
from omnibench.slam.slam_dataset import slam_dataset
from omnibench.slam.slam_options import SlamOptions
from omnibench.slam.slam_request import distances, run_errors, slam_accuracy
from omnibench.testing.synthetic import synthetic_dataset

LIDAR = Lidar()
START = np.array([1.0, 2.0, 0.5])


@cache
def recorded(room: str = "furnished_room", runs: int = 3) -> tuple[Dataset, dict[str, TruePath]]:
    """Short runs whose poses are not known but for the start, and where the robot truly was, from there on."""
    plan = make_plan(RoomPlan(plan=room), room)
    trajectories, scans, truth = [], {}, {}
    for number in range(runs):
        run = drive(plan, LIDAR, flower_command(number), np.random.default_rng([3, number]), distance=0.4)
        name = f"run-{number}"
        scans[name] = run.scans
        poses = np.array([START, START])
        last = float(run.log.times[-1])
        trajectories.append(
            Trajectory(name, "train", run.log.times, run.log.rates, np.array([0.0, last]), poses, command=f"{number}")
        )
        way = (run.true[:, 0] + 1j * run.true[:, 1]) * np.exp(1j * START[2])
        true = np.column_stack([START[0] + way.real, START[1] + way.imag, START[2] + run.true[:, 2]])
        truth[name] = TruePath(run.scans.times, true)
    held = ScansInMemory(LIDAR.scanner, scans)
    return make_dataset("rooms", ROBOT, 0.01, trajectories, simulated=True, scans=held), truth


@cache
def found_alone() -> Dataset:
    """What SLAM in this process makes of them."""
    return slam_dataset(recorded()[0], SlamOptions(), workers=1)


def with_scans(dataset: Dataset, **changed: TrajectoryScans | None) -> Dataset:
    """The data set with other scans for some runs; None: with none."""
    scans = dict(dataset.scans) | {name.replace("_", "-"): found for name, found in changed.items()}
    kept = {name: found for name, found in scans.items() if found is not None}
    return replace(dataset, scans=ScansInMemory(LIDAR.scanner, kept))


class TestPoses:
    def test_are_found_from_the_start_pose_on_at_the_stamps_of_the_scans_and_all_else_stays(self) -> None:
        dataset, truth = recorded()
        found = found_alone()
        for run in found.trajectories:
            np.testing.assert_array_equal(run.pose_times, truth[run.id].times)
            np.testing.assert_array_equal(run.poses[0], START)
            assert np.abs(run.poses - truth[run.id].poses).max() < 0.004
            assert (np.linalg.eigvalsh(run.pose_covariances) > 0).all()
        assert (found.name, found.robot, found.simulated, found.scans) == ("rooms", ROBOT, True, dataset.scans)
        for before, after in zip(dataset.trajectories, found.trajectories, strict=True):
            assert after.command == before.command
            np.testing.assert_array_equal(after.rates, before.rates)
        assert found.warnings == ()

    def test_do_not_depend_on_the_number_of_processes_and_progress_is_told_run_by_run(self) -> None:
        told: list[Progress] = []
        found = slam_dataset(recorded()[0], SlamOptions(), workers=2, watch=told.append)
        assert found.hash == found_alone().hash
        assert told == [Progress("SLAM", done, 3, "run") for done in range(4)]

    def test_do_not_depend_on_the_odometry_that_the_search_starts_from(self) -> None:
        dataset, _ = recorded()
        better = OdometryModel(ROBOT, published_matrix("palacin2023_eq9"), "arc")
        other = slam_dataset(dataset, SlamOptions(), model=better, workers=1)
        for one, two in zip(found_alone().trajectories, other.trajectories, strict=True):
            assert 0 < np.abs(one.poses - two.poses).max() < 0.0002

    def test_begin_at_t_0_when_the_first_scan_comes_later(self) -> None:
        dataset, truth = recorded()
        scans = dataset.scans.of("run-1")
        late = with_scans(dataset, run_1=TrajectoryScans(scans.times[1:], scans.ranges[1:]))
        run = slam_dataset(late, SlamOptions(), workers=1).trajectories[1]
        np.testing.assert_array_equal(run.pose_times, [0.0, *scans.times[1:]])
        np.testing.assert_array_equal(run.poses[0], START)
        assert len(run.pose_covariances) == len(run.poses)
        assert np.abs(run.poses - truth["run-1"].poses).max() < 0.01  # as the odometry missed until then
        np.testing.assert_array_equal(run.pose_covariances[0], FLOOR)

    def test_are_as_uncertain_as_the_odometry_until_a_first_scan_that_comes_later(self) -> None:
        dataset, truth = recorded()
        late = {name: TrajectoryScans(scans.times[8:], scans.ranges[8:]) for name, scans in dataset.scans}
        found = slam_dataset(replace(dataset, scans=ScansInMemory(LIDAR.scanner, late)), SlamOptions(), workers=1)
        for run in found.trajectories:
            way = np.hypot(*(run.poses[1] - START)[:2])
            assert way > 0.2
            stated = np.sqrt(np.linalg.eigvalsh(run.pose_covariances[:, :2, :2])[:, -1])
            assert stated[0] == pytest.approx(1e-4)
            assert (stated[1:] > 0.09 * way).all()
        every = slam_accuracy(found, truth).every
        assert every.nees_mean < 5
        (warning,) = found.warnings
        assert warning.startswith("SLAM: the robot moves before the first scan, whose pose is therefore as uncertain")
        assert "3 of 3 runs" in warning

    def test_leave_scans_before_t_0_out(self) -> None:
        dataset, _ = recorded()
        scans = dataset.scans.of("run-1")
        early = TrajectoryScans(np.concatenate([[-0.2], scans.times]), np.vstack([scans.ranges[:1], scans.ranges]))
        run = slam_dataset(with_scans(dataset, run_1=early), SlamOptions(), workers=1).trajectories[1]
        np.testing.assert_array_equal(run.pose_times, scans.times)


class TestWhatIsSaid:
    def test_a_corridor_is_named_with_its_direction_and_runs(self) -> None:
        dataset, _ = recorded("corridor", 2)
        (warning,) = slam_dataset(dataset, SlamOptions(), workers=1).warnings
        # The robot stands along the corridor, within some degrees; its start pose is turned by 0.5 rad, or 29 deg.
        said = (
            r"SLAM: scans tell too little along (2[4-9]|3[0-4]) deg of the run's frame: 2 of 2 runs, e.g. run-0, run-1"
        )
        assert re.fullmatch(said, warning)

    @pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
    def test_missing_and_empty_scans_name_the_run_whoever_found_it(self, workers: int) -> None:
        dataset, _ = recorded()
        scans = dataset.scans.of("run-1")
        ranges = scans.ranges.copy()
        ranges[2] = np.inf
        for changed, named in (
            (replace(dataset, scans=None), r"scans\.parquet"),
            (with_scans(dataset, run_2=None), "run-2 has no scans"),
            (with_scans(dataset, run_1=TrajectoryScans(scans.times, ranges)), "run-1: SLAM: the scan at .* is empty"),
        ):
            with pytest.raises(DataError, match=f"data set rooms: .*{named}"):
                slam_dataset(changed, SlamOptions(), workers=workers)


class TestAccuracy:
    def test_is_that_of_the_poses(self) -> None:
        _, truth = recorded()
        found = slam_accuracy(found_alone(), truth)
        assert found.runs == 3
        assert found.distance_m == pytest.approx(3 * 0.4, rel=0.1)
        assert found.final.poses == 3
        assert found.every.poses == sum(len(path.times) - 1 for path in truth.values())
        assert 0 < found.final.position_mean_m <= found.final.position_p95_m <= found.final.position_max_m < 0.004
        assert 0 < found.every.heading_mean_rad < found.every.heading_max_rad < 0.002
        assert 1 < found.every.nees_mean < 6

    def test_growing_errors_are_drift_and_bias_in_the_robots_frame(self) -> None:
        dataset, truth = recorded()
        runs = []
        for run in dataset.trajectories:
            path = truth[run.id]
            way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path.poses[:, :2], axis=0).T))])
            left = path.poses[:, 2] + np.pi / 2
            poses = path.poses + 0.02 * way[:, None] * np.column_stack([np.cos(left), np.sin(left), 0.5 + 0 * left])
            runs.append(replace(run, pose_times=path.times, poses=poses))
        found = slam_accuracy(make_dataset("drifting", ROBOT, 0.01, runs), truth)
        assert found.drift_position == pytest.approx(0.02, rel=1e-6)
        assert found.drift_heading == pytest.approx(0.01, rel=1e-6)
        assert found.final.bias_left_m == pytest.approx(found.final.position_mean_m, rel=1e-6)
        assert found.final.bias_forward_m == pytest.approx(0, abs=1e-9)
        assert found.final.position_mean_m == pytest.approx(0.02 * found.distance_m / 3, rel=1e-6)
        assert found.every.nees_mean is None  # covariances are not known

    def test_singular_covariances_of_a_foreign_data_set_are_left_out_of_the_nees(self) -> None:
        dataset, truth = recorded(runs=1)
        (run,) = dataset.trajectories
        path = truth[run.id]
        poses = path.poses + np.array([0.0, 0.002, 0.0])
        poses[0] = START
        flat = np.tile(np.diag([0.001, 0.001, 0.001]) ** 2, (len(poses), 1, 1))
        none = replace(run, pose_times=path.times, poses=poses, pose_covariances=0 * flat)
        assert slam_accuracy(replace(dataset, trajectories=(none,)), truth).every.nees_mean is None
        flat[4, 2, 2] = 0.0
        some = replace(none, pose_covariances=flat)
        found = slam_accuracy(replace(dataset, trajectories=(some,)), truth)
        assert found.every.nees_mean == pytest.approx(4.0)
        assert np.isnan(run_errors(some, path).nees).sum() == 1

    def test_another_truth_is_one_line(self) -> None:
        dataset, truth = recorded()
        others = {name: path for name, path in truth.items() if name != "run-1"}
        with pytest.raises(DataError, match="trajectory run-1 is not in the truth"):
            slam_accuracy(dataset, others)


@pytest.fixture(scope="module")
def blind(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of scans and wheels, without poses."""
    return write_mcap(tmp_path_factory.mktemp("blind") / "drive", without_poses())


@pytest.fixture(scope="module")
def found(blind: Path) -> Dataset:
    return read(blind)


def test_without_poses_they_are_made_from_the_scans(found: Dataset) -> None:
    data = found
    assert "made from the scans by SLAM" in data.warnings[0]
    assert len(data.trajectories) == 2
    for run in data.trajectories:
        np.testing.assert_array_equal(run.poses[0], 0.0)
        assert run.pose_covariances is not None
    assert odometry_error(data) < 0.005  # m and rad; the true odometry agrees with SLAM


@pytest.mark.slow
def test_the_poses_are_the_same_whatever_the_format_of_the_recording(found: Dataset, tmp_path: Path) -> None:
    for own, other in zip(
        found.trajectories, read(write_rosbag1(tmp_path / "drive", without_poses())).trajectories, strict=True
    ):
        np.testing.assert_allclose(other.poses, own.poses, atol=1e-6)


def test_odometry_is_no_reference_where_scans_can_make_one(tmp_path: Path) -> None:
    odometry = [
        Sent(
            "/robot/odom",
            "nav_msgs/msg/Odometry",
            {"header": header(int(stamp)), "pose": {"pose": pose(place)}},
            int(stamp),
        )
        for stamp, place in zip(DRIVE.pose_stamps, DRIVE.poses * 1.1, strict=True)
        if stamp < EPOCH + SECONDS * 1e9
    ]
    data = read(write_mcap(tmp_path / "drive", without_poses([MOUNTED, *odometry])))
    assert "made from the scans by SLAM" in data.warnings[0]
    assert odometry_error(data) < 0.005


@pytest.mark.slow
def test_runs_are_cut_by_a_topic_without_poses_too(tmp_path: Path) -> None:
    words = [text(f"go{number}", EPOCH + int(begin * 1e9)) for number, begin in enumerate(DRIVE.begins[:2])]
    data = read(
        write_mcap(tmp_path / "drive", without_poses([MOUNTED, *words])), cut="topic", cut_topic="/robot/command"
    )
    assert [run.id for run in data.trajectories] == ["001-go0", "002-go1"]
    assert odometry_error(data) < 0.005


@pytest.mark.slow
def test_the_options_under_slam_are_those_of_slam(blind: Path, found: Dataset) -> None:
    other = read(blind, slam={"spacing": 0.3})
    assert not np.array_equal(other.trajectories[0].poses, found.trajectories[0].poses)


def test_wrong_options_of_slam_are_refused_before_the_recording_is_read(tmp_path: Path) -> None:
    (tmp_path / "empty.mcap").touch()
    for slam, named in (({"spacng": 0.3}, "slam: unknown key 'spacng'.*'spacing'"), (3, "slam")):
        with pytest.raises(ConfigError, match=named):
            read(tmp_path / "empty.mcap", slam=slam)
    with pytest.raises(ConfigError, match="'csv': unknown key 'slam'"):
        import_dataset("csv", tmp_path, {"slam": {}})


DATA = synthetic_dataset()


def moved(data: Dataset, by: tuple[float, float, float], turns: int = 0) -> Dataset:
    """Every pose but the first of each run moved, and the headings of all by whole turns."""
    whole = [0.0, 0.0, 2 * math.pi * turns]
    runs = [
        replace(run, poses=run.poses + np.where(run.pose_times[:, None] > 0, by, 0.0) + whole)
        for run in data.trajectories
    ]
    return replace(data, trajectories=tuple(runs))


def thinned(data: Dataset, kept: slice) -> Dataset:
    runs = [replace(run, pose_times=run.pose_times[kept], poses=run.poses[kept]) for run in data.trajectories]
    return replace(data, trajectories=tuple(runs))


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-9, 9), st.integers(-2, 2))
def test_a_shift_is_found_whatever_turns_headings_begin_with(x: float, y: float, turn: float, turns: int) -> None:
    found = distances(DATA, moved(DATA, (x, y, turn), turns))
    assert found.poses == sum(len(run.poses) - 1 for run in DATA.trajectories)
    assert found.position_mean_m == pytest.approx(math.hypot(x, y), abs=1e-9)
    assert found.position_p95_m == pytest.approx(math.hypot(x, y), abs=1e-9)
    assert found.heading_mean_rad == pytest.approx(abs(turn), abs=1e-9)
    assert found.heading_p95_rad == pytest.approx(abs(turn), abs=1e-9)


def test_the_sparser_reference_says_where_they_are_compared() -> None:
    sparse = moved(thinned(DATA, slice(None, None, 5)), (0.03, 0.04, 0.0))
    expected = sum(len(run.poses) - 1 for run in sparse.trajectories)
    for one, other in ((DATA, sparse), (sparse, DATA)):
        found = distances(one, other)
        assert found.poses == expected
        assert found.position_mean_m == pytest.approx(0.05)


def test_what_has_no_times_in_common_is_not_compared() -> None:
    assert distances(thinned(DATA, slice(0, 1)), DATA) is None
