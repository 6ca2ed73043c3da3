"""What a node remembers of a robot, on a real disk, and of the stamps that it has published."""

from __future__ import annotations

import json
import re
import time
import zlib
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drives import calibration
from hypothesis import given
from hypothesis import strategies as st
from nodes import as_text

from omnibench.errors import DataError
from omnibench.live.estimation.robot_state import PublishedStamps, RobotMemory, SavedState
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


@pytest.mark.parametrize("wheels", [3, 12, 200, 2000])
def test_the_newest_state_of_any_number_of_wheels_comes_back_as_it_was(memory: RobotMemory, wheels: int) -> None:
    angles = tuple((np.pi * 10.0 ** np.arange(wheels).clip(max=9)).tolist())
    for stamp in range(3):
        state = SavedState(**STATE | {"stamp": stamp, "positions": angles})
        memory.save(state)
        assert memory.load() == state.model_copy(update={"sequence": memory.load().sequence})


@pytest.mark.parametrize(
    "content",
    [b"\x00" * 8192, b"[" * 4096, b"00000000 {", with_checksum({}) * 2, json.dumps(STATE).encode().ljust(4095) + b"\n"],
    ids=["zeros", "brackets", "torn", "nothing in it", "of a version without checksums"],
)
def test_what_is_no_state_is_left_aside(tmp_path: Path, caplog: pytest.LogCaptureFixture, content: bytes) -> None:
    assert loaded(tmp_path, content) is None
    assert ("earlier version" in caplog.text) == (b"positions" in content)


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
def test_a_damaged_state_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture, change: dict[str, Any]) -> None:
    assert loaded(tmp_path, with_checksum(STATE)) is not None
    assert not caplog.text
    assert loaded(tmp_path, with_checksum(STATE | change)) is None
    assert "apr.state.json: damaged" in caplog.text


@pytest.mark.parametrize("wheels", [3, 12, 200])
def test_no_part_of_a_write_torn_at_any_sector_is_taken(tmp_path: Path, memory: RobotMemory, wheels: int) -> None:
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
            taken.append((torn == after, torn == before, state.stamp))
            assert state.pose == state.map_pose == (np.pi * state.stamp,) * 3
    assert {stamp for whole, _, stamp in taken if whole} == {9}
    assert {stamp for whole, _, stamp in taken if not whole} == {8}
    assert sum(not whole and not untouched for whole, untouched, _ in taken) >= 2


@pytest.mark.parametrize(("file_changes", "runs"), [(False, "synthetic 1.1"), (True, "synthetic 0.9")])
def test_a_swap_is_kept_until_the_first_file_changes(tmp_path: Path, file_changes: bool, runs: str) -> None:
    file, elsewhere = tmp_path / "calibration.yaml", tmp_path / "elsewhere.yaml"
    write_calibration(calibration(), file)
    with closing(RobotMemory(tmp_path / "state", "apr")) as memory:
        memory.calibration(file)
        file.rename(elsewhere)  # while the node runs
        memory.keep_calibration(calibration(scale=1.1))
        elsewhere.rename(file)
        if file_changes:
            write_calibration(calibration(scale=0.9), file)
        assert memory.calibration(file).name == runs


def test_a_calibration_that_the_disk_refuses_or_has_damaged_is_named(tmp_path: Path, memory: RobotMemory) -> None:
    kept, file = tmp_path / "apr.calibration.yaml", tmp_path / "calibration.yaml"
    kept.mkdir()
    with pytest.raises(DataError, match=re.escape(kept.name)):
        memory.keep_calibration(calibration())
    kept.rmdir()
    file.write_text(as_text(calibration()))
    kept.write_text("instead_of: 1\n")
    with pytest.raises(DataError, match=rf"remove {re.escape(str(kept))} .*{re.escape(str(file))}"):
        memory.calibration(file)


def test_a_closed_memory_writes_nothing_more(tmp_path: Path) -> None:
    memory = RobotMemory(tmp_path, "apr")
    memory.save(SavedState(**STATE))
    memory.close()
    memory.close()
    before = (tmp_path / "apr.state.json").read_bytes()
    memory.save(SavedState(**STATE))  # of a sample that was on its way
    assert (tmp_path / "apr.state.json").read_bytes() == before


STAMP_PERIOD, SECOND = 10**7, 10**9  # ns


@given(st.lists(st.integers(0, 300), max_size=300), st.lists(st.integers(0, 10**18), unique=True, max_size=100))
def test_no_stamp_comes_twice_and_one_that_is_new_stays_as_it_is(stamps: list[int], new: list[int]) -> None:
    published = PublishedStamps()
    given_out = [published.unique(stamp) for stamp in stamps]
    assert len(set(given_out)) == len(given_out)
    for order in (new, sorted(new)):
        published = PublishedStamps()
        assert [published.unique(stamp) for stamp in order] == order


@given(st.lists(st.integers(0, 60), max_size=300), st.integers(1, 40))
def test_no_stamp_comes_twice_among_those_that_are_remembered(stamps: list[int], remembered: int) -> None:
    published = PublishedStamps(remembered)
    given_out = [published.unique(stamp) for stamp in stamps]
    for begin in range(len(given_out)):
        latest = given_out[begin : begin + remembered + 1]
        assert len(set(latest)) == len(latest)


def test_a_clock_that_jumps_back_over_and_over_repeats_no_stamp() -> None:
    published = PublishedStamps(remembered=1000)
    given_out = [published.unique(STAMP_PERIOD * (k % 100)) for k in range(900)]
    assert len(set(given_out)) == 900
    assert max(abs(out - STAMP_PERIOD * (k % 100)) for k, out in enumerate(given_out)) <= 9  # ns


def test_old_stamps_are_forgotten_and_memory_stays_flat() -> None:
    published = PublishedStamps(remembered=1000)
    for stamp in range(20_000):
        published.unique(stamp)
    assert len(published) == 1000
    assert published.unique(19_500) != 19_500  # among the latest thousand


@pytest.mark.parametrize(
    "stamps",
    [
        pytest.param(
            [STAMP_PERIOD * (k // 2) - 10 * SECOND * (k % 2) for k in range(30_000)], id="two clocks, 10 s apart"
        ),
        pytest.param([STAMP_PERIOD * (k % 1000) for k in range(30_000)], id="a recording of 10 s in a loop"),
        pytest.param([STAMP_PERIOD * (k % 3) for k in range(30_000)], id="three stamps in a loop"),
        pytest.param([STAMP_PERIOD * (k % 3) - SECOND * (k // 3) for k in range(30_000)], id="ever further back"),
        pytest.param([STAMP_PERIOD * (k * 7919 % 29_989) for k in range(30_000)], id="no order at all"),
    ],
)
def test_a_clock_gone_wild_costs_a_sample_no_more_than_20_us(stamps: Iterable[int]) -> None:
    published = PublishedStamps()
    begin = time.thread_time()
    given_out = [published.unique(stamp) for stamp in stamps]
    seconds = time.thread_time() - begin
    assert seconds / len(given_out) < 20e-6
    assert len(set(given_out)) == len(given_out)
