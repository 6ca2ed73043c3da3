"""The optiodom importer: on the recordings of four robots, and on small files of the same layout."""

import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from real_recordings import OMNI3, mean_errors

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.errors import ConfigError, DataError
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch
from omnibench.slam.import_dataset import import_dataset

needs_recordings = pytest.mark.skipif(not OMNI3.is_dir(), reason=f"the OptiOdom recordings are not at {OMNI3}")
TICK = 2 * math.pi / (12 * 1024)


@needs_recordings
class TestRecordings:
    def test_all_runs_are_read_and_circular_trains_and_square_validates_by_default(self, omni3: Dataset) -> None:
        train, validation = omni3.split("train"), omni3.split("validation")
        assert (len(train), len({run.session for run in train})) == (44, 7)
        assert (len(validation), len({run.session for run in validation})) == (23, 2)
        groups = {(run.split, run.id.split("_")[0]) for run in omni3.trajectories}
        assert groups == {("train", "circular"), ("validation", "square")}

    def test_the_design_matrix_leaves_the_worst_heading_error_that_the_authors_published(self, omni3: Dataset) -> None:
        batch = OdometryBatch([run.final_log for run in omni3.trajectories], "arc")
        finals = batch.poses(omni3.robot.inverse_kinematic_matrix[None])[0]
        errors = finals - np.array([run.final_pose for run in omni3.trajectories])
        assert np.degrees(np.abs(errors[:, 2]).max()) == pytest.approx(37.69, abs=0.01)
        assert np.hypot(errors[:, 0], errors[:, 1]).max() == pytest.approx(0.371, abs=0.005)

    def test_commands_group_repetitions_that_end_alike(self, omni3: Dataset) -> None:
        counts = Counter(run.command for run in omni3.trajectories)
        assert sorted(counts.values()) == [1] * 16 + [2, 3, 6, 6, 6, 7, 7, 7, 7]
        for command, count in counts.items():
            finals = np.array([run.final_pose for run in omni3.trajectories if run.command == command])
            if count > 1:
                assert np.ptp(finals[:, :2], axis=0).max() < 0.15
                assert np.degrees(np.ptp(finals[:, 2])) < 10

    def test_commands_are_those_of_the_sessions_log(self, omni3: Dataset) -> None:
        first = omni3.trajectories[0]
        assert first.command == "circular_a0_turn-720_v0.2_r0.85x0.9"
        assert (first.v, first.alpha, first.omega) == pytest.approx((0.162, 0.0, -0.2353))
        assert first.distance == pytest.approx(9.0, abs=0.05)
        assert omni3.trajectories[1].started_at == pytest.approx(453.52 - 370.24)

    def test_absolute_angles_move_as_the_rates_say_and_go_on_from_run_to_run(self, omni3: Dataset) -> None:
        ends = []
        for run in omni3.trajectories[:3]:
            ends.append((run.angles[0], run.angles[-1]))
            np.testing.assert_allclose(
                np.diff(run.angles, axis=0), run.rates[1:] * np.diff(run.times)[:, None], atol=1e-9
            )
        assert np.abs(ends[1][0] - ends[0][1]).max() > 1.0  # it was driven back in between

    def test_one_group_or_one_session_can_be_the_source(self) -> None:
        circular = import_dataset("optiodom", OMNI3 / "circular")
        assert (len(circular.split("train")), len(circular.split("validation"))) == (32, 12)
        session = import_dataset("optiodom", OMNI3 / "square" / "221220201953")
        assert (len(session.split("train")), len(session.split("validation"))) == (8, 4)

    @pytest.mark.slow
    def test_groups_can_be_chosen(self) -> None:
        swapped = import_dataset("optiodom", OMNI3, {"train": "square", "log": False})
        assert len(swapped.split("train")) == 23
        assert {run.command for run in swapped.trajectories} == {None}
        with pytest.raises(ConfigError, match=r"'circlar'; did you mean 'circular'\?"):
            import_dataset("optiodom", OMNI3, {"train": "circlar"})


def write_session(root: Path, group: str = "circular", name: str = "s1", runs: int = 2, log: bool = True) -> Path:
    """A session of straight runs along x: wheels 0 and 1 drive, 100 ticks a cycle."""
    folder = root / group / name
    folder.mkdir(parents=True)
    metadata = "type,omni3\nngear,12\nencRes,1024\nLi,0.195\nDi,0.102,0.102,0.102\n"
    (folder / f"{name}_metadata.csv").write_text(metadata)
    step = 100 * TICK * 2 * 0.051 / math.sqrt(3)
    lines = ["Method:,x", "N:,1,R(m):,0.85,Rrate(%):,90,#180curves:,4", "time(s):,odo0"]
    for number in range(1, runs + 1):
        rows = [f"{0.04 * k:.2f},{step * k:.9f},0,0,{-100 * (k > 0)},{100 * (k > 0)},0" for k in range(6)]
        (folder / f"{name}_run-{number:02d}.csv").write_text("\n".join(rows) + "\n")
        lines.append(f"Run:,{number}")
        lines += [f"{10 * number + 0.04 * k:.2f},{100 * (k > 0)},{-100 * (k > 0)},0,0,0,0,0.2,0,0,0" for k in range(6)]
        lines.append("RUNFINISHED")
    if log:
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    return folder


def test_ticks_are_negated_and_the_row_at_zero_gives_the_start_only(tmp_path: Path) -> None:
    write_session(tmp_path)
    run = import_dataset("optiodom", tmp_path).trajectories[0]
    assert run.times.tolist() == pytest.approx([0.04, 0.08, 0.12, 0.16, 0.2])
    assert run.pose_times.tolist() == pytest.approx([0, 0.04, 0.08, 0.12, 0.16, 0.2])
    np.testing.assert_allclose(run.rates, np.tile([100 * TICK / 0.04, -100 * TICK / 0.04, 0], (5, 1)))


def test_the_design_drives_the_recorded_path(tmp_path: Path) -> None:
    write_session(tmp_path)
    data = import_dataset("optiodom", tmp_path)
    assert mean_errors(data.robot.inverse_kinematic_matrix, data.trajectories) == pytest.approx((0, 0), abs=1e-7)


def test_every_second_run_of_a_command_validates_when_there_is_one_group(tmp_path: Path) -> None:
    write_session(tmp_path, runs=3)
    data = import_dataset("optiodom", tmp_path)
    assert [(run.split, run.repetition) for run in data.trajectories] == [("train", 1), ("validation", 2), ("train", 3)]


def test_groups_that_neither_side_names_are_left_out_and_one_on_both_is_refused(tmp_path: Path) -> None:
    for group in ("a", "b", "c"):
        write_session(tmp_path, group)
    data = import_dataset("optiodom", tmp_path, {"train": ["a"], "validation": ["c"]})
    assert {run.id[0] for run in data.trajectories} == {"a", "c"}
    with pytest.raises(ConfigError, match="group 'a' is in both train and validation"):
        import_dataset("optiodom", tmp_path, {"train": "a", "validation": "[ab]"})


def test_without_a_log_angles_are_left_out_and_a_command_is_named_after_the_motion(tmp_path: Path) -> None:
    write_session(tmp_path, name="s1")
    write_session(tmp_path, name="s2", log=False)
    data = import_dataset("optiodom", tmp_path)
    assert {run.angles is None for run in data.trajectories} == {True}
    assert "1 of 2 sessions have no log (s2)" in data.warnings[0]
    commands = {run.session: run.command for run in data.trajectories}
    assert commands == {"s1": "circular_a0_turn+0_v0.2_r0.85x0.9", "s2": "circular_a0_turn+0_0.0m"}


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("_run-01", "0.08,", "0.02,", r"row 3: t goes backwards: 0\.02 after 0\.04"),
        ("_run-01", "-100,100,0\n0.12", "-100,oops,0\n0.12", r"row 3: ticks_1 is 'oops'"),
        ("_run-01", "-100,100,0\n0.12", "-100,nan,0\n0.12", r"row 3: ticks_1 is nan"),
        ("_run-01", "-100,100,0\n0.12", "-100,100\n0.12", r"row 3: ticks_2 is missing"),
        ("_metadata", "type,omni3", "type,omni2", r"type is 'omni2'; did you mean 'omni4'\?"),
        ("_metadata", "Di,0.102,0.102,0.102", "Di,0.102,0.102", "Di is 0.102, 0.102, expected 3 numbers above 0"),
        ("_metadata", "Li,0.195", "Lo,0.195", r"key 'Li' is missing; did you mean 'Lo'\?"),
        ("_metadata", "ngear,12", "ngear,0", r"ngear is 0"),
        ("_metadata", "encRes,1024", "encRes,many", "encRes is many, expected 1 numbers"),
        ("", "10.08,100,", "10.08,x,", "line 7: expected 10 finite numbers"),
        ("", "10.08,100,", "10.08,nan,", "line 7: expected 10 finite numbers"),
        ("", "Run:,2", "Run:,two", "line 12: expected the number of a run after 'Run:'"),
        ("", "Run:", "Walk:", "it holds no run"),
        ("", "10.08,100,", "10.08,99,", r"does not hold the ticks of s1_run-01\.csv; .* log: false"),
    ],
)
def test_what_is_wrong_is_named_with_file_and_row(tmp_path: Path, file: str, old: str, new: str, message: str) -> None:
    path = write_session(tmp_path) / f"s1{file}.csv"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(DataError, match=rf"s1{file}\.csv[:,] {message}"):
        import_dataset("optiodom", tmp_path)


def test_of_different_dimensions_the_commonest_are_the_robots_and_it_is_said(tmp_path: Path) -> None:
    for name in ("s1", "s2", "s3"):
        metadata = write_session(tmp_path, name=name) / f"{name}_metadata.csv"
        if name != "s1":
            metadata.write_text(metadata.read_text().replace("Li,0.195", "Li,0.2,,"))
        if name == "s2":  # equally common: those of the first session
            assert import_dataset("optiodom", tmp_path).robot.wheels[0].distance == 0.195
    data = import_dataset("optiodom", tmp_path)
    assert [wheel.distance for wheel in data.robot.wheels] == [0.2] * 3
    for part in ("2 of 3", "L 0.2 m, D 0.102 m", "L 0.195 m, D 0.102 m in 1"):
        assert part in data.warnings[0]
        assert part in data.description


def test_a_source_of_several_robots_is_refused_with_the_way_out(tmp_path: Path) -> None:
    write_session(tmp_path, name="s1")
    other = write_session(tmp_path, name="s2") / "s2_metadata.csv"
    other.write_text("type,diff,,\nngear,43.7\nencRes,64\nLi,0.2\nDi,0.084,0.084,\n")
    with pytest.raises(DataError, match=r"it holds recordings of 2 robots, diff, omni3; .* or --set robot=diff"):
        import_dataset("optiodom", tmp_path)
    assert len(import_dataset("optiodom", tmp_path, {"robot": "omni3"}).trajectories) == 2
    with pytest.raises(DataError, match="tricyc; found: diff, omni3"):
        import_dataset("optiodom", tmp_path, {"robot": "tricyc"})
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"no \*_metadata\.csv below it"):
        import_dataset("optiodom", tmp_path / "empty")


def test_options_of_import_dataset_hold_too(tmp_path: Path) -> None:
    write_session(tmp_path, name="s1")
    write_session(tmp_path, name="s2", log=False)
    plain = import_dataset("optiodom", tmp_path)
    turned = import_dataset("optiodom", tmp_path, {"wheel_signs": [-1, -1, 1]})
    for run, other in zip(plain.trajectories, turned.trajectories, strict=True):
        np.testing.assert_array_equal(other.rates, run.rates * [-1, -1, 1])
        assert (other.split, other.command, other.session) == (run.split, run.command, run.session)
    assert turned.warnings[0] == plain.warnings[0]  # that sessions have no log
    assert turned.sample_period == plain.sample_period
    left = import_dataset("optiodom", tmp_path, {"leave_out": "*s2*", "position_unit": "cm"})
    assert [run.session for run in left.trajectories] == ["s1", "s1"]
    np.testing.assert_allclose(left.trajectories[0].poses[:, 0], plain.trajectories[0].poses[:, 0] / 100)


@pytest.fixture
def dataset(request: pytest.FixtureRequest) -> Dataset:
    found: Dataset = request.getfixturevalue(request.param)
    return found


def group(dataset: Dataset, name: str) -> list[Trajectory]:
    return [run for run in dataset.trajectories if run.id.startswith(f"{name}_")]


@needs_recordings
@pytest.mark.parametrize(
    ("dataset", "name", "runs", "metres", "degrees"),
    [
        ("diff", "circular", 54, 0.0657, 9.24),
        ("diff", "square", 44, 0.0385, 3.19),
        ("diff", "ivanjko", 66, 0.0052, 1.19),
        ("tricyc", "circular", 14, 0.6647, 64.86),
        ("tricyc", "square", 14, 0.7707, 39.79),
        ("omni4", "circular", 24, 0.1540, 17.52),
    ],
    indirect=["dataset"],
)
def test_the_design_leaves_known_errors(dataset: Dataset, name: str, runs: int, metres: float, degrees: float) -> None:
    found = group(dataset, name)
    assert len(found) == runs
    errors = mean_errors(dataset.robot.inverse_kinematic_matrix, found)
    assert errors == (pytest.approx(metres, abs=6e-5), pytest.approx(degrees, abs=0.006))


@needs_recordings
@pytest.mark.parametrize(
    ("dataset", "expected"),
    [
        ("omni3", 0.017 * np.array([[3**0.5, -(3**0.5), 0], [1, 1, -2], [1 / 0.195] * 3])),
        ("diff", [[0.021, 0.021], [0, 0], [0.21, -0.21]]),
        ("tricyc", [[0.0325, 0], [0, 0], [0, 0.0325 / 0.15]]),
        ("omni4", 0.03 / 4 * np.array([[1, 1, 1, 1], [-1, 1, 1, -1], np.array([-1, 1, -1, 1]) / 0.2])),
    ],
    indirect=["dataset"],
)
def test_the_design_matrix_is_that_of_the_authors(dataset: Dataset, expected: Array) -> None:
    np.testing.assert_allclose(dataset.robot.inverse_kinematic_matrix, expected, atol=1e-15)
    assert dataset.robot.mount is None


@needs_recordings
@pytest.mark.parametrize(
    ("dataset", "period", "parts"),
    [
        ("diff", 0.05, ("23 of 29", "L 0.2 m, D 0.084 m", "L 0.205 m, D 0.084 m in 3; L 0.205 m, D 0.085 m in 3")),
        ("omni3", 0.04, ()),
        ("tricyc", 0.05, ()),
        ("omni4", 0.01, ("4 of 5 sessions have no log (080920201547, 080920201911, 231220200453, 231220200502)",)),
    ],
    indirect=["dataset"],
)
def test_the_choice_is_said_and_nothing_looks_wrong(dataset: Dataset, period: float, parts: tuple[str, ...]) -> None:
    assert len(dataset.warnings) == bool(parts)
    for part in parts:
        assert part in dataset.warnings[0]
        assert part in dataset.description
    assert dataset.sample_period == period


@needs_recordings
def test_the_tricycle_steers_by_the_angles_of_its_encoder(tricyc: Dataset) -> None:
    assert tricyc.robot.wheel_names == tricyc.robot.drive.steered == ("front",)
    for run in tricyc.trajectories:
        assert run.steering is not None
        turned = np.degrees(run.signals @ tricyc.robot.inverse_kinematic_matrix[2] @ np.diff(run.times, prepend=0.0))
        assert turned == pytest.approx(float(run.command.split("turn")[1].split("_")[0]), abs=5)


@needs_recordings
@pytest.mark.parametrize(
    ("dataset", "counts", "commands"),
    [
        (
            "diff",
            [1] * 10 + [3] * 14 + [7] * 2 + [8] * 10 + [9] * 2,
            ["circular_a0_turn-720_v0.11_r0.85x0.9_b0.2d0.084", "square_a0_turn+360_v0.057_l0.75_b0.205d0.085"],
        ),
        ("tricyc", [7] * 4, ["circular_a0_turn-720_r0.85x0.9", "square_a0_turn+360_l1.5"]),
        ("omni4", [1] * 12 + [3] * 4, ["circular_a90_turn+720_5.8m", "circular_a0_turn-180_v0.075_r0.8x0.9"]),
    ],
    indirect=["dataset"],
)
def test_runs_of_one_path_share_a_command(dataset: Dataset, counts: list[int], commands: list[str]) -> None:
    found = Counter(run.command for run in dataset.trajectories)
    assert sorted(found.values()) == counts
    assert set(commands) <= set(found)


@needs_recordings
def test_the_commands_of_the_differential_drive_are_those_of_its_logs(diff: Dataset) -> None:
    turning = next(run for run in diff.trajectories if run.command == "ivanjko_a0_turn+180_v0_l2_b0.2d0.084")
    assert (turning.v, turning.omega) == (0.0, pytest.approx(1.0))
