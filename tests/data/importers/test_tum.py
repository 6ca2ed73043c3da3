"""Poses in TUM format."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from omnibench.data.importers.tum import read_tum, write_tum
from omnibench.errors import DataError


def write(folder: Path, *rows: str) -> Path:
    file = folder / "run_poses.tum"
    file.write_text("\n".join(rows) + "\n")
    return file


def test_comments_and_blank_lines_are_skipped(tmp_path: Path) -> None:
    track = read_tum(write(tmp_path, "# timestamp tx ty tz qx qy qz qw", "", "10.5 1 2 9 0 0 0 1  # start"))
    assert track.times.tolist() == [10.5]
    assert track.poses.tolist() == [[1.0, 2.0, 0.0]]


@given(heading=st.floats(-math.pi + 1e-9, math.pi - 1e-9), sign=st.sampled_from([-1.0, 1.0]))
def test_the_heading_is_the_yaw_of_either_quaternion(
    tmp_path_factory: pytest.TempPathFactory, heading: float, sign: float
) -> None:
    folder = tmp_path_factory.mktemp("tum")
    qz, qw = sign * math.sin(heading / 2), sign * math.cos(heading / 2)
    track = read_tum(write(folder, f"0 0 0 0 0 0 {qz!r} {qw!r}"))
    assert track.poses[0, 2] == pytest.approx(heading, abs=1e-12)


@given(arrays(float, 3, elements=st.floats(-0.1, 0.1)), st.floats(-3, 3))
def test_small_roll_and_pitch_hardly_change_the_heading(
    tmp_path_factory: pytest.TempPathFactory, angles: np.ndarray, heading: float
) -> None:
    roll, pitch = angles[0] / 2, angles[1] / 2
    cy, sy, cp, sp, cr, sr = (f(a) for a in (heading / 2, pitch, roll) for f in (math.cos, math.sin))
    quaternion = (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
    folder = tmp_path_factory.mktemp("tum")
    track = read_tum(write(folder, "0 0 0 0 " + " ".join(map(repr, quaternion))))
    assert track.poses[0, 2] == pytest.approx(heading, abs=1e-9)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("1 0 0 0 0 0 1", r"row 2 \(line 3\): it has 7 fields, expected 8"),
        ("1 0 0 x 0 0 0 1", r"row 2 \(line 3\): tz is 'x', expected a number"),
        ("1 0 nan 0 0 0 0 1", r"row 2 \(line 3\): ty is nan"),
        ("0.5 0 0 0 0 0 0 1", r"row 2 \(line 3\): timestamp is repeated: 0\.5 after 0\.5"),
        ("0.4 0 0 0 0 0 0 1", r"row 2 \(line 3\): timestamp goes backwards: 0\.4 after 0\.5"),
        ("1 0 0 0 0 0 0 2", r"row 2 \(line 3\): quaternion has length 2, expected 1"),
        ("1 0 0 0 0.7071 0 0 0.7071", r"row 2 \(line 3\): pose is tilted by 90 degrees; .*body \(z up\)"),
    ],
)
def test_a_malformed_row_is_named(tmp_path: Path, row: str, message: str) -> None:
    file = write(tmp_path, "# poses", "0.5 0 0 0 0 0 0 1", row)
    with pytest.raises(DataError, match=r"run_poses\.tum, " + message):
        read_tum(file)


def test_a_file_without_poses_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="it has no rows; a row is timestamp tx ty tz qx qy qz qw"):
        read_tum(write(tmp_path, "# nothing"))


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.tum: no such file"):
        read_tum(tmp_path / "none.tum")


def test_poses_that_were_written_are_read_again(tmp_path: Path) -> None:
    times, poses = np.array([0.0, 0.1, 0.25]), np.array([[0, 0, 0], [0.1, -0.2, 3.1], [1.5, 2, -3.0]])
    write_tum(tmp_path / "run.tum", times, poses)
    track = read_tum(tmp_path / "run.tum")
    np.testing.assert_allclose(track.times, times, atol=1e-9)
    np.testing.assert_allclose(track.poses, poses, atol=1e-8)


def test_poses_that_no_tum_file_can_hold_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"times have shape \(2,\), poses \(3, 3\)"):
        write_tum(tmp_path / "run.tum", [0, 1], np.zeros((3, 3)))
    with pytest.raises(DataError, match="times, row 2: it is 0; times increase"):
        write_tum(tmp_path / "run.tum", [0, 0], np.zeros((2, 3)))
    assert not list(tmp_path.iterdir())


def test_a_track_of_many_poses_is_shown_in_a_line(tmp_path: Path) -> None:
    lines = [f"{0.1 * row:.1f} {row} 0 0 0 0 0 1" for row in range(300)]
    (tmp_path / "long.tum").write_text("\n".join(lines), encoding="utf-8")
    assert repr(read_tum(tmp_path / "long.tum")) == "PoseTrack(times=<array (300,)>, poses=<array (300, 3)>)"
