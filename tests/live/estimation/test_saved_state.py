"""What a node remembers of a robot, on a real disk."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drives import calibration
from nodes import as_text

from omnibench.errors import DataError
from omnibench.live.estimation.saved_state import RobotMemory, SavedState
from omnibench.robot.calibration import write_calibration

STATE: dict[str, Any] = {
    "sequence": 5,
    "stamp": 10**18,
    "wall": 1.8e9,
    "positions": [1.0, 2.0, 3.0],
    "pose": [1.0, 2.0, 0.3],
    "covariance": [1e-4, 0, 0, 0, 1e-4, 0, 0, 0, 1e-5],
}


@pytest.fixture
def memory(tmp_path: Path) -> Iterator[RobotMemory]:
    opened = RobotMemory(tmp_path, "apr")
    yield opened
    opened.close()


def loaded(folder: Path, content: bytes) -> SavedState | None:
    """What a node makes of such a file."""
    (folder / "apr.state.json").write_bytes(content)
    memory = RobotMemory(folder, "apr")
    try:
        return memory.load()
    finally:
        memory.close()


def with_checksum(document: dict[str, Any]) -> bytes:
    """The line of a state."""
    text = json.dumps(document).encode()
    return b"%08x %s\n" % (zlib.crc32(text), text)


def test_a_state_comes_back_as_it_was(memory: RobotMemory) -> None:
    memory.save(SavedState(**STATE))
    found = memory.load()
    assert found is not None
    assert found.pose == (1.0, 2.0, 0.3)
    np.testing.assert_array_equal(np.reshape(found.covariance, (3, 3)), np.diag([1e-4, 1e-4, 1e-5]))


@pytest.mark.parametrize("wheels", [12, 200, 2000])
def test_the_newest_state_of_any_number_of_wheels_comes_back(memory: RobotMemory, wheels: int) -> None:
    angles = tuple((np.pi * 10.0 ** np.arange(wheels).clip(max=9)).tolist())
    for stamp in range(3):
        memory.save(SavedState(**STATE | {"stamp": stamp, "positions": angles}))
        found = memory.load()
        assert found is not None
        assert (found.stamp, found.positions) == (stamp, angles)


def test_the_state_of_the_examples_below_is_taken(tmp_path: Path) -> None:
    found = loaded(tmp_path, with_checksum(STATE))
    assert found is not None
    assert found.positions == (1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    "change",
    [
        {"covariance": [1e-4] * 8},
        {"covariance": [float("nan")] * 9},
        {"covariance": [-1e-4, 0, 0, 0, 1e-4, 0, 0, 0, 1e-5]},
        {"map_covariance": [1e-4] * 10},
        {"pose": [1.0, float("inf"), 0.3]},
        {"pose": [1.0, 2.0]},
        {"map_pose": [float("nan"), 0.0, 0.0]},
        {"positions": [1.0, float("nan"), 3.0]},
        {"stamp": 10**30},
        {"wall": float("nan")},
        {"more": 1},
        {"pose": [1e300, 2.0, 0.3]},
        {"pose": [1.0, 2.0, 1e10]},
        {"map_pose": [0.0, -1e10, 0.0]},
        {"covariance": [1e300, 0, 0, 0, 1e-4, 0, 0, 0, 1e-5]},
        {"positions": [1.0, 1e300, 3.0]},
        {"steering": [1e300]},
        {"wall": 1e300},
        {"session_time": 1e300},
        {"sequence": 2**64},
        {"flows": {"1": 2**64}},
    ],
)
def test_a_damaged_state_is_left_aside_and_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, change: dict[str, Any]
) -> None:
    assert loaded(tmp_path, with_checksum(STATE | change)) is None
    assert "apr.state.json: damaged; odom starts at its origin" in caplog.text


@pytest.mark.parametrize("wheels", [3, 12, 200])
def test_of_a_write_that_is_torn_at_any_sector_no_part_is_taken(
    tmp_path: Path, memory: RobotMemory, wheels: int
) -> None:
    def save(step: int) -> bytes:
        place, angles = [np.pi * step] * 3, (np.pi * (np.arange(wheels) + step)).tolist()
        covariance = (1e-4 * np.pi * step * (np.eye(3) + 0.1)).ravel().tolist()
        poses = {"pose": place, "covariance": covariance, "map_pose": place, "map_covariance": covariance}
        memory.save(SavedState(**STATE | poses | {"stamp": step, "positions": angles}))
        return (tmp_path / "apr.state.json").read_bytes()

    for step in range(1, 9):
        before = save(step)
    after = save(9)
    memory.close()
    taken = []
    for sector in range(0, len(after) + 512, 512):
        for torn in (after[:sector] + before[sector:], before[:sector] + after[sector:]):
            state = loaded(tmp_path, torn)
            assert state is not None
            taken.append((torn == after, torn == before, state.stamp))
            assert state.pose == state.map_pose == (np.pi * state.stamp,) * 3
    assert {stamp for whole, _, stamp in taken if whole} == {9}
    assert {stamp for whole, _, stamp in taken if not whole} == {8}
    assert sum(not whole and not untouched for whole, untouched, _ in taken) >= 2


@pytest.mark.parametrize("content", [b"\x00" * 8192, b"[" * 4096, b"00000000 {", with_checksum({}) * 2])
def test_what_is_no_state_at_all_is_left_aside(tmp_path: Path, content: bytes) -> None:
    assert loaded(tmp_path, content) is None


def test_the_state_of_an_earlier_version_is_refused_in_a_line(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert loaded(tmp_path, json.dumps(STATE).encode().ljust(4095) + b"\n") is None
    assert [record.getMessage() for record in caplog.records] == [
        f"{tmp_path}/apr.state.json: of an earlier version, without checksums; odom starts at its origin"
    ]


def test_a_robot_without_a_state_begins_without_a_word(memory: RobotMemory, caplog: pytest.LogCaptureFixture) -> None:
    assert memory.load() is None
    assert not caplog.text


def test_a_swapped_calibration_is_kept_for_the_file_that_the_node_started_with(tmp_path: Path) -> None:
    file, elsewhere = tmp_path / "calibration.yaml", tmp_path / "elsewhere.yaml"
    write_calibration(calibration(), file)
    memory = RobotMemory(tmp_path / "state", "apr")
    memory.calibration(file)
    file.rename(elsewhere)  # while the node runs
    memory.keep_calibration(calibration(scale=1.1))
    elsewhere.rename(file)
    assert memory.calibration(file).name == "synthetic 1.1"
    memory.close()


def test_a_file_that_changed_takes_the_place_of_what_was_swapped_in(tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"
    write_calibration(calibration(), file)
    memory = RobotMemory(tmp_path / "state", "apr")
    memory.calibration(file)
    memory.keep_calibration(calibration(scale=1.1))
    write_calibration(calibration(scale=0.9), file)
    assert memory.calibration(file).name == "synthetic 0.9"
    memory.close()


def test_a_calibration_that_the_disk_refuses_is_one_line(tmp_path: Path, memory: RobotMemory) -> None:
    (tmp_path / "apr.calibration.yaml").mkdir()
    with pytest.raises(DataError, match=r"apr\.calibration\.yaml: cannot be written: is a folder; name a file"):
        memory.keep_calibration(calibration())


def test_a_kept_calibration_that_is_damaged_says_which_file_to_remove(tmp_path: Path, memory: RobotMemory) -> None:
    (tmp_path / "calibration.yaml").write_text(as_text(calibration()))
    (tmp_path / "apr.calibration.yaml").write_text("instead_of: 1\n")
    with pytest.raises(DataError, match=r"remove \S+apr\.calibration\.yaml to start with \S+/calibration\.yaml"):
        memory.calibration(tmp_path / "calibration.yaml")


def test_a_closed_memory_writes_nothing_more(tmp_path: Path) -> None:
    memory = RobotMemory(tmp_path, "apr")
    memory.save(SavedState(**STATE))
    memory.close()
    memory.close()
    before = (tmp_path / "apr.state.json").read_bytes()
    memory.save(SavedState(**STATE))  # of a sample that was on its way
    assert (tmp_path / "apr.state.json").read_bytes() == before
