"""How the rosbag importer cuts a recording into runs."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from bag_samples import (
    DRIVE,
    EPOCH,
    PERIOD,
    REST,
    RUN,
    SLAM,
    WHEELS,
    Sent,
    changed,
    edited,
    header,
    joint_state,
    messages,
    odometry_error,
    part,
    read,
    text,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
)
from hypothesis import given
from hypothesis import strategies as st

from omnibench.data.importers.rosbag.bag_recording import between_rests
from omnibench.data.importers.runs.recording_runs import find_rests
from omnibench.robot.kinematics import Array


def test_runs_keep_a_little_rest_with_a_reference_pose_at_both_ends(bag: Path) -> None:
    for run, begin in zip(read(bag).trajectories, DRIVE.begins, strict=True):
        assert run.started_at is not None
        assert 0.25 <= begin - run.started_at <= 0.75
        assert 0.25 <= run.started_at + run.pose_times[-1] - (begin + RUN) <= 0.75
        assert (run.rates[0] == 0).all()
        assert (run.rates[-1] == 0).all()


def test_shorter_rests_do_not_cut(bag: Path) -> None:
    data = read(bag, least_rest=2.0)
    assert len(data.trajectories) == 1
    assert "no rest of 2 s cuts it; --set cut=topic or cut=windows" in data.warnings[0]
    assert odometry_error(data) < 1e-9


def test_short_drives_are_left_out_and_counted(tmp_path: Path) -> None:
    data = read(write_mcap(tmp_path / "drive", part(REST + RUN + REST + 0.6)), least_run=0.5)
    assert len(data.trajectories) == 2
    bumped = part(REST + RUN + REST + 0.3)
    data = read(write_mcap(tmp_path / "bumped", bumped))
    assert len(data.trajectories) == 1
    assert "1 of 2 drives left out: 1 shorter than 1 s (least_run)" in data.warnings[0]


def test_the_messages_of_a_topic_begin_runs_and_name_their_commands(tmp_path: Path) -> None:
    offset = 4 * 10**9  # the recorder's clock is not that of the robot
    sent = [Sent(each.topic, each.kind, each.content, each.logged + offset) for each in messages(DRIVE)]
    words = ["left", "right", "left", "right", "", "left"] * 2
    sent += [
        text(word, EPOCH + offset + int((begin - 0.1) * 1e9)) for word, begin in zip(words, DRIVE.begins, strict=True)
    ]
    data = read(write_mcap(tmp_path / "drive", sent), cut="topic", cut_topic="/robot/command")
    assert [run.command for run in data.trajectories] == [word or None for word in words]
    assert [run.id for run in data.trajectories][:5] == ["001-left", "002-right", "003-left", "004-right", "005"]
    assert [run.repetition for run in data.trajectories][:6] == [1, 1, 2, 2, None, 3]
    assert [run.split for run in data.trajectories][:4] == ["train", "train", "validation", "validation"]
    assert odometry_error(data) < 1e-9
    for run, begin in zip(data.trajectories, DRIVE.begins, strict=True):
        assert run.started_at is not None
        assert 0 <= begin - run.started_at <= 0.35  # the pose at rest before the command
        assert run.pose_times[-1] > RUN


def test_a_topic_of_any_type_cuts_at_its_stamps(tmp_path: Path) -> None:
    goals = [
        Sent("/goal", "geometry_msgs/msg/PoseStamped", {"header": header(EPOCH + int(begin * 1e9))}, EPOCH)
        for begin in DRIVE.begins
    ]
    data = read(write_mcap(tmp_path / "drive", [*messages(DRIVE), *goals]), cut="topic", cut_topic="goal")
    assert len(data.trajectories) == 12
    assert {run.command for run in data.trajectories} == {None}
    assert odometry_error(data) < 1e-9


def test_windows_cut_by_time(bag: Path) -> None:
    data = read(bag, cut="windows", window=10)
    assert len(data.trajectories) == 7  # of 67.5 s
    assert all(run.duration is not None and 9 < run.duration < 10.1 for run in data.trajectories[:6])
    assert odometry_error(data) < 1e-9


def test_without_cuts_a_bag_is_one_run(bag: Path) -> None:
    data = read(bag, cut="none")
    assert [run.id for run in data.trajectories] == ["001"]
    assert odometry_error(data) < 1e-9


def test_a_hole_in_the_wheel_samples_ends_a_run(tmp_path: Path) -> None:
    hole = (EPOCH + int((DRIVE.begins[1] + 1.5) * 1e9), EPOCH + int((DRIVE.begins[1] + 2.5) * 1e9))
    sent = [each for each in messages(DRIVE) if each.topic == SLAM or not hole[0] < each.logged < hole[1]]
    data = read(write_mcap(tmp_path / "drive", sent))
    assert len(data.trajectories) == 13
    assert "wheel samples are missing 1 time while the wheels turned, up to 1.02 s" in data.warnings[0]
    assert odometry_error(data) < 1e-9
    assert [run.session for run in data.trajectories] == ["drive"] * 2 + ["drive#2"] * 11


def test_drivers_that_are_silent_at_rest_leave_no_hole(tmp_path: Path) -> None:
    moving = [DRIVE.rates[min(row, len(DRIVE.rates) - 1)].any() for row in range(len(DRIVE.stamps))]
    loud = dict(zip(DRIVE.stamps.tolist(), moving, strict=True))
    sent = [each for each in messages(DRIVE) if each.topic == SLAM or loud[each.logged - 3_000_000]]
    sent += [
        joint_state(
            DRIVE.stamps[round((begin + RUN) * 1e9) // PERIOD], DRIVE.angles[round((begin + RUN) * 1e9) // PERIOD]
        )
        for begin in DRIVE.begins
    ]
    data = read(write_mcap(tmp_path / "drive", sent))
    assert len(data.trajectories) == 12
    assert data.warnings == ()
    assert odometry_error(data) < 1e-9


def test_a_counter_that_begins_anew_ends_a_run_and_its_session(tmp_path: Path) -> None:
    restart = EPOCH + int((DRIVE.begins[2] + 2) * 1e9)

    def restarted(each: Sent) -> Sent:
        late = each.logged > restart
        return changed(each, position=[angle - 500 for angle in each.content["position"]]) if late else each

    data = read(write_mcap(tmp_path / "drive", edited(messages(DRIVE), WHEELS, restarted)))
    assert "the positions begin anew 1 time, faster than any wheel turns (if that is a counter" in data.warnings[0]
    assert [run.session for run in data.trajectories] == ["drive"] * 3 + ["drive#2"] * 10
    assert odometry_error(data) < 1e-9


def test_a_folder_of_bags_has_a_session_each(tmp_path: Path) -> None:
    write_mcap(tmp_path / "monday", part(12.4))
    write_rosbag2(tmp_path / "tuesday", part(12.4))
    write_rosbag1(tmp_path / "wednesday", part(12.4))
    data = read(tmp_path, validation="tuesday/*")
    assert {run.id: run.split for run in data.trajectories} == {
        f"{day}/{number}": "validation" if day == "tuesday" else "train"
        for day in ("monday", "tuesday", "wednesday")
        for number in ("001", "002")
    }
    assert {run.session for run in data.trajectories} == {"monday", "tuesday", "wednesday"}
    assert odometry_error(data) < 1e-9


@given(
    lengths=st.lists(st.tuples(st.floats(0.6, 3), st.floats(1, 5)), min_size=1, max_size=5),
    first=st.floats(0, 0.5),
    period=st.floats(0.05, 2.0),
)
def test_pieces_between_rests_follow_one_another_and_hold_their_drives(
    lengths: list[tuple[float, float]], first: float, period: float
) -> None:
    times, angles = moving(lengths)
    rests = find_rests(times, angles, 0.5, 0.025)
    assert len(rests) == len(lengths) + 1
    stamps = np.arange(first, times[-1], period)
    pieces = between_rests((times[0], times[-1]), rests, stamps)
    assert len(pieces) == len(lengths)
    for piece, before, after in zip(pieces, rests[:-1], rests[1:], strict=True):
        assert before[0] <= piece.begin <= before[1]
        assert after[0] <= piece.end <= after[1]
        for (begin, end), instant in ((before, piece.begin), (after, piece.end)):
            inside = stamps[(stamps >= begin) & (stamps <= end)]
            assert not len(inside) or instant in inside
    assert all(one.end <= other.begin for one, other in pairwise(pieces))


def moving(lengths: Sequence[tuple[float, float]]) -> tuple[Array, Array]:
    """Times and angles of two wheels that rest and turn in turns, and rest at the end; they tick as encoders do."""
    rates = [0.0]
    for rest, run in lengths:
        rates += [0.0] * round(rest / 0.01) + [2.0] * round(run / 0.01)
    rates += [0.0] * 100
    driven = np.cumsum(np.array(rates) * 0.01)
    ticks = np.round(np.column_stack([driven, -driven]) / 0.0015) * 0.0015
    return 0.01 * np.arange(len(rates)), ticks


def test_a_reversal_is_no_rest() -> None:
    times = 0.01 * np.arange(400)
    angles = np.abs(times - 2.0)[:, None]
    assert find_rests(times, angles, 0.5, 0.025) == []
