"""The optiodom importer: on the recordings where they are at hand, and on small files of the same layout."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from real_recordings import OMNI3

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch
from omnibench.slam.import_dataset import import_dataset

needs_recordings = pytest.mark.skipif(not OMNI3.is_dir(), reason=f"the OptiOdom recordings are not at {OMNI3}")
TICK = 2 * math.pi / (12 * 1024)


def final_errors(matrix: Array, runs: tuple[Trajectory, ...]) -> tuple[float, float]:
    """Mean final error of a matrix: m and degrees."""
    batch = OdometryBatch([run.final_log for run in runs], "arc")
    errors = batch.poses(matrix[None])[0] - np.array([run.final_pose for run in runs])
    return float(np.hypot(errors[:, 0], errors[:, 1]).mean()), float(np.degrees(np.abs(errors[:, 2]).mean()))


def fitted_on_windows(runs: tuple[Trajectory, ...], window: int = 25) -> Array:
    """The matrix (3, 3) of least squares on windows of 1 s, the headings being the reference's."""
    turned, angles, moved, driven = [], [], [], []
    for run in runs:
        steps = run.rates * np.diff(run.times, prepend=0.0)[:, None]
        theta = run.poses[:, 2]
        turn = np.exp(1j * (theta[:-1] + theta[1:]) / 2)
        xy = run.poses[:, 0] + 1j * run.poses[:, 1]
        for first in range(0, len(steps) - window + 1, window):
            part = slice(first, first + window)
            angles.append(steps[part].sum(0))
            turned.append(theta[first + window] - theta[first])
            driven.append((steps[part] * turn[part, None]).sum(0))
            moved.append(xy[first + window] - xy[first])
    row_12 = np.linalg.lstsq(np.array(driven), np.array(moved), rcond=None)[0]
    row_3 = np.linalg.lstsq(np.array(angles), np.array(turned), rcond=None)[0]
    return np.array([row_12.real, row_12.imag, row_3])


@needs_recordings
class TestRecordings:
    def test_all_runs_of_all_sessions_are_read(self, omni3: Dataset) -> None:
        train, validation = omni3.split("train"), omni3.split("validation")
        assert (len(train), len({run.session for run in train})) == (44, 7)
        assert (len(validation), len({run.session for run in validation})) == (23, 2)

    def test_circular_trains_and_square_validates_by_default(self, omni3: Dataset) -> None:
        assert {(run.split, run.id.split("_")[0]) for run in omni3.trajectories} == {
            ("train", "circular"),
            ("validation", "square"),
        }

    def test_nothing_about_units_and_wheels_looks_wrong(self, omni3: Dataset) -> None:
        assert omni3.warnings == ()

    def test_geometry_and_period_are_the_robots(self, omni3: Dataset) -> None:
        assert [wheel.radius for wheel in omni3.robot.wheels] == [0.051] * 3
        assert [wheel.distance for wheel in omni3.robot.wheels] == [0.195] * 3
        assert omni3.sample_period == 0.04
        root, third = 0.051 / math.sqrt(3), 0.051 / 3
        expected = [[root, -root, 0], [third, third, -2 * third], [third / 0.195] * 3]
        np.testing.assert_allclose(omni3.robot.inverse_kinematic_matrix, expected, atol=1e-15)

    def test_the_design_matrix_leaves_the_worst_heading_error_that_the_authors_published(self, omni3: Dataset) -> None:
        batch = OdometryBatch([run.final_log for run in omni3.trajectories], "arc")
        finals = batch.poses(omni3.robot.inverse_kinematic_matrix[None])[0]
        errors = finals - np.array([run.final_pose for run in omni3.trajectories])
        assert np.degrees(np.abs(errors[:, 2]).max()) == pytest.approx(37.69, abs=0.01)
        assert np.hypot(errors[:, 0], errors[:, 1]).max() == pytest.approx(0.371, abs=0.005)

    def test_a_free_matrix_fitted_on_circular_reaches_the_figures_of_the_data_readme(self, omni3: Dataset) -> None:
        train, validation = omni3.split("train"), omni3.split("validation")
        matrix = fitted_on_windows(train)
        assert final_errors(matrix, train) == pytest.approx((0.044, 3.67), rel=0.01)
        assert final_errors(matrix, validation) == pytest.approx((0.109, 5.41), rel=0.01)

    def test_the_design_matrix_is_far_worse(self, omni3: Dataset) -> None:
        design = omni3.robot.inverse_kinematic_matrix
        position, heading = final_errors(design, omni3.split("train"))
        assert 0.15 < position < 0.2
        assert 13 < heading < 16

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

    def test_absolute_angles_move_as_the_rates_say(self, omni3: Dataset) -> None:
        for run in omni3.trajectories[:3]:
            assert run.angles is not None
            np.testing.assert_allclose(
                np.diff(run.angles, axis=0), run.rates[1:] * np.diff(run.times)[:, None], atol=1e-9
            )

    def test_absolute_angles_go_on_from_run_to_run(self, omni3: Dataset) -> None:
        first, second = omni3.trajectories[:2]
        assert first.angles is not None
        assert second.angles is not None
        assert np.abs(second.angles[0] - first.angles[-1]).max() > 1.0  # it was driven back in between

    def test_one_group_or_one_session_can_be_the_source(self) -> None:
        circular = import_dataset("optiodom", OMNI3 / "circular")
        assert (len(circular.split("train")), len(circular.split("validation"))) == (32, 12)
        session = import_dataset("optiodom", OMNI3 / "square" / "221220201953")
        assert (len(session.split("train")), len(session.split("validation"))) == (8, 4)

    def test_groups_can_be_chosen(self) -> None:
        swapped = import_dataset("optiodom", OMNI3, {"train": "square", "log": False})
        assert len(swapped.split("train")) == 23
        assert {run.command for run in swapped.trajectories} == {None}

    def test_a_misspelt_group_is_refused_with_the_nearest(self) -> None:
        with pytest.raises(ConfigError, match=r"no group matches 'circlar'; did you mean 'circular'\? found: circular"):
            import_dataset("optiodom", OMNI3, {"train": "circlar"})

    def test_the_data_set_survives_its_way_over_the_disk(self, omni3: Dataset, tmp_path: Path) -> None:
        save_dataset(omni3, tmp_path / "omni3")
        assert load_dataset(tmp_path / "omni3").hash == omni3.hash


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
    assert final_errors(data.robot.inverse_kinematic_matrix, data.trajectories) == pytest.approx((0, 0), abs=1e-7)


def test_every_second_run_of_a_command_validates_when_there_is_one_group(tmp_path: Path) -> None:
    write_session(tmp_path, runs=3)
    data = import_dataset("optiodom", tmp_path)
    assert [(run.split, run.repetition) for run in data.trajectories] == [
        ("train", 1),
        ("validation", 2),
        ("train", 3),
    ]


def test_groups_that_neither_side_names_are_left_out(tmp_path: Path) -> None:
    for group in ("a", "b", "c"):
        write_session(tmp_path, group)
    data = import_dataset("optiodom", tmp_path, {"train": ["a"], "validation": ["c"]})
    assert {run.id[0] for run in data.trajectories} == {"a", "c"}


def test_a_group_on_both_sides_is_refused(tmp_path: Path) -> None:
    write_session(tmp_path)
    with pytest.raises(ConfigError, match="group 'circular' is in both train and validation"):
        import_dataset("optiodom", tmp_path, {"train": "circular", "validation": "circ*"})


def test_angles_are_left_out_when_one_session_has_no_log(tmp_path: Path) -> None:
    write_session(tmp_path, name="s1")
    write_session(tmp_path, name="s2", log=False)
    data = import_dataset("optiodom", tmp_path)
    assert {run.angles is None for run in data.trajectories} == {True}
    assert "1 of 2 sessions have no log (s2)" in data.warnings[0]


def test_without_a_log_a_command_is_named_after_the_motion_by_the_wheels(tmp_path: Path) -> None:
    write_session(tmp_path, name="s1")
    write_session(tmp_path, name="s2", log=False)
    data = import_dataset("optiodom", tmp_path)
    commands = {run.session: run.command for run in data.trajectories}
    assert commands == {"s1": "circular_a0_turn+0_v0.2_r0.85x0.9", "s2": "circular_a0_turn+0_0.0m"}


def test_a_log_with_other_ticks_is_refused_with_a_way_out(tmp_path: Path) -> None:
    folder = write_session(tmp_path)
    log = folder / "s1.csv"
    log.write_text(log.read_text().replace("10.08,100,", "10.08,99,"))
    with pytest.raises(DataError, match=r"s1\.csv: does not hold the ticks of s1_run-01\.csv; .* log: false"):
        import_dataset("optiodom", tmp_path)
    assert len(import_dataset("optiodom", tmp_path, {"log": False}).trajectories) == 2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("0.08,", "0.02,", r"s1_run-01\.csv, row 3: t goes backwards: 0\.02 after 0\.04"),
        ("-100,100,0\n0.12", "-100,oops,0\n0.12", r"s1_run-01\.csv, row 3: ticks_1 is 'oops', expected a number"),
        ("-100,100,0\n0.12", "-100,nan,0\n0.12", r"s1_run-01\.csv, row 3: ticks_1 is nan"),
        ("-100,100,0\n0.12", "-100,100\n0.12", r"s1_run-01\.csv, row 3: it has 6 fields, expected 7"),
    ],
)
def test_a_malformed_row_of_a_run_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    run = write_session(tmp_path) / "s1_run-01.csv"
    run.write_text(run.read_text().replace(old, new))
    with pytest.raises(DataError, match=message):
        import_dataset("optiodom", tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "type,omni3",
            "type,omni2",
            r"s1_metadata\.csv: type is 'omni2'; did you mean 'omni4'\? it must be one of diff",
        ),
        ("Di,0.102,0.102,0.102", "Di,0.102,0.102", r"s1_metadata\.csv: Di is '0\.102, 0\.102', expected 3 numbers"),
        ("Li,0.195", "Lo,0.195", r"s1_metadata\.csv: key 'Li' is missing; did you mean 'Lo'\?"),
        ("ngear,12", "ngear,0", r"s1_metadata\.csv: ngear is 0, it must be above 0"),
        ("encRes,1024", "encRes,many", r"s1_metadata\.csv: encRes is 'many', expected numbers"),
    ],
)
def test_wrong_metadata_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    metadata = write_session(tmp_path) / "s1_metadata.csv"
    metadata.write_text(metadata.read_text().replace(old, new))
    with pytest.raises(DataError, match=message):
        import_dataset("optiodom", tmp_path)


def test_a_malformed_row_of_the_log_is_named(tmp_path: Path) -> None:
    log = write_session(tmp_path) / "s1.csv"
    log.write_text(log.read_text().replace("10.08,100,", "10.08,x,"))
    with pytest.raises(DataError, match=r"s1\.csv, line 7: could not convert"):
        import_dataset("optiodom", tmp_path)


def test_of_different_dimensions_the_commonest_are_the_robots_and_it_is_said(tmp_path: Path) -> None:
    for name in ("s1", "s2", "s3"):
        metadata = write_session(tmp_path, name=name) / f"{name}_metadata.csv"
        if name != "s1":
            metadata.write_text(metadata.read_text().replace("Li,0.195", "Li,0.2,,"))
    data = import_dataset("optiodom", tmp_path)
    assert [wheel.distance for wheel in data.robot.wheels] == [0.2] * 3
    said = "of 2 of 3 are taken, L 0.2 m, D 0.102 m (others: L 0.195 m, D 0.102 m in 1)"
    assert said in data.warnings[0]
    assert said in data.description


def test_of_equally_common_dimensions_those_of_the_first_session_are_taken(tmp_path: Path) -> None:
    write_session(tmp_path, name="s1")
    other = write_session(tmp_path, name="s2") / "s2_metadata.csv"
    other.write_text(other.read_text().replace("Li,0.195", "Li,0.2"))
    assert import_dataset("optiodom", tmp_path).robot.wheels[0].distance == 0.195


def test_a_source_of_several_robots_is_refused_with_the_way_out(tmp_path: Path) -> None:
    write_session(tmp_path, name="s1")
    other = write_session(tmp_path, name="s2") / "s2_metadata.csv"
    other.write_text("type,diff,,\nngear,43.7\nencRes,64\nLi,0.2\nDi,0.084,0.084,\n")
    with pytest.raises(DataError, match=r"it holds recordings of 2 robots, diff, omni3; .* or --set robot=diff"):
        import_dataset("optiodom", tmp_path)
    assert len(import_dataset("optiodom", tmp_path, {"robot": "omni3"}).trajectories) == 2
    with pytest.raises(DataError, match="it holds no recordings of robot tricyc; found: diff, omni3"):
        import_dataset("optiodom", tmp_path, {"robot": "tricyc"})


def test_a_folder_without_sessions_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no \*_metadata\.csv below it"):
        import_dataset("optiodom", tmp_path)
