"""``omnibench listen`` and ``omnibench record``: what they print and how they end, from real sessions."""

import json
import math
import re
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from io import StringIO
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest
from commands import omnibench
from mcap.reader import make_reader
from nodes import Command
from rich.console import Console
from samples import AnnouncedRobot, disk_with_room_for, messages_of, odometry, publishers, sample
from sessions import Loopback, until
from syrupy.assertion import SnapshotAssertion
from timing import PATIENCE

from omnibench.cli.terminal.live_tables import listen, plain_line, record, view
from omnibench.errors import ConfigError, DataError
from omnibench.live.monitor import HealthSummary, OdometryStatus, RobotMonitor, RobotStatus
from omnibench.live.topics import KeySpace

KEYS = KeySpace()


@pytest.fixture
def apr02(loopback: Loopback) -> AnnouncedRobot:
    return AnnouncedRobot(loopback.router, "apr02")


def listened(loopback: Loopback, robot: str | None, **options: Any) -> str:
    """The output of ``listen`` after one reading."""
    text = StringIO()
    console = Console(file=text, width=100)
    listen(robot, loopback.client(), KEYS, console, Event(), **{"seconds": 0.05, "patience": PATIENCE, **options})
    return text.getvalue()


def test_a_robot_that_is_not_there_or_has_no_name_is_one_line(loopback: Loopback) -> None:
    with pytest.raises(DataError, match="no robot is alive"):
        listened(loopback, "apr02", patience=0.5)
    robot = AnnouncedRobot(loopback.router, "apr02")
    assert robot.token
    with pytest.raises(DataError, match=r"'apr2': .*did you mean 'apr02'\?"):
        listened(loopback, "apr2", patience=0.5)
    with pytest.raises(ConfigError, match="a robot's name is one word"):
        listened(loopback, "apr02/odom")


def test_control_characters_of_a_robot_do_not_reach_the_terminal(loopback: Loopback, apr02: AnnouncedRobot) -> None:
    apr02.answer_health("stale", "\x1b[2Jgone \u202eback\x07")
    run = omnibench("listen", "apr02", "--connect", loopback.address, "--seconds", "4")
    assert "apr02: no odometry yet, stale: ?[2Jgone ?back?" in run.stdout
    assert (run.stdout + run.stderr).replace("\n", "").isprintable()


def test_listening_to_all_goes_on_while_nobody_is_there(loopback: Loopback) -> None:
    assert listened(loopback, None) == "no robot seen yet\n"


def test_a_piped_listener_prints_plain_lines(loopback: Loopback, apr02: AnnouncedRobot) -> None:
    apr02.answer_health("ok", "calibrated")
    stop = Event()

    class TwoLines(StringIO):
        """Stops after two lines."""

        def write(self, text: str) -> int:
            written = super().write(text)
            if self.getvalue().count("\n") == 2:
                stop.set()
            return written

    text = TwoLines()
    listen("apr02", loopback.client(), KEYS, Console(file=text, width=100), stop, PATIENCE, patience=PATIENCE)
    lines = text.getvalue().splitlines()
    assert len(lines) == 2
    assert lines[1].startswith("apr02: no odometry yet, ok: calibrated")


def test_json_is_one_document_a_line_without_nan(loopback: Loopback, apr02: AnnouncedRobot) -> None:
    with RobotMonitor(loopback.client(), KEYS, None):
        apr02.wait_for_subscribers()
    stop = Event()
    bad = replace(odometry(), twist=np.array([math.nan, 0.0, math.inf]), stamp=time.time_ns())

    class Feeder(StringIO):
        """Publishes a message whenever a line is printed."""

        def write(self, text: str) -> int:
            if '"odom": {' in text:
                stop.set()
            apr02.odom.put(bad)
            return super().write(text)

    text = Feeder()
    listen("apr02", loopback.client(), KEYS, Console(file=text, width=80), stop, seconds=PATIENCE, as_json=True)
    document = json.loads(text.getvalue().splitlines()[-1], parse_constant=pytest.fail)  # NaN, Infinity
    assert document["robot"] == "apr02"
    assert document["odom"]["pose"] == pytest.approx(odometry().pose.tolist())
    assert document["odom"]["twist"] == [None, 0.0, None]


def test_listening_ends_at_once_when_told_to(loopback: Loopback) -> None:
    stop = Event()
    listener = Thread(target=listen, args=(None, loopback.client(), KEYS, Console(file=StringIO()), stop))
    listener.start()
    stop.set()
    listener.join(PATIENCE)
    assert not listener.is_alive()


HEALTHY = HealthSummary("ok", "calibrated odometry", {})
SEEN = OdometryStatus(odometry(), rate=100.0, age=0.004, stamp_age=0.012, undecodable=0)
FAR = replace(odometry(), pose=np.array([-123.4567, -98.7654, -3.1]), twist=np.array([-1.5, -0.25, -3.1]))
REFUSED = HealthSummary("degraded", "poses are refused", {"late": 3, "pose_rejected": 2})
ROBOTS = [
    RobotStatus("apr02", "alive", SEEN, replace(SEEN, message=odometry(0, "map")), HEALTHY),
    RobotStatus("apr03", "alive", replace(SEEN, message=FAR, rate=1000.0, undecodable=1), None, REFUSED),
    RobotStatus("silent", "alive", replace(SEEN, age=3.21), None, HEALTHY),
    RobotStatus("gone", "left", replace(SEEN, age=0.1), None, HEALTHY),
]


@pytest.mark.parametrize("width", [80, 120, 160])
def test_the_table_fits_the_terminal_with_every_figure_whole(width: int, snapshot: SnapshotAssertion) -> None:
    console = Console(file=StringIO(), width=width)
    console.print(view(ROBOTS, console))
    text = console.file.getvalue()
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    assert text == snapshot


def test_a_line_gives_pose_twist_sigma_rate_and_age_with_units_or_what_is_amiss(snapshot: SnapshotAssertion) -> None:
    assert "\n".join(plain_line(robot) for robot in ROBOTS) == snapshot


def test_the_command_ends_with_one_line_when_the_disk_is_full(loopback: Loopback, tmp_path: Path) -> None:
    joints = publishers(loopback)["joint_states"]
    with pytest.raises(DataError, match="cannot be written"):
        run_record(loopback, tmp_path / "run.mcap", 10.0, lambda: joints.put(sample("joint_states")), room=300)
    assert messages_of(tmp_path / "run.mcap") == {}


def run_record(
    loopback: Loopback, path: Path, seconds: float, feed: Callable[[], None], robot: str = "apr02", room: int = 10**9
) -> str:
    """What ``record`` prints when it is piped, with ``feed`` called meanwhile and a disk that has so much room."""
    stop, text, session = Event(), StringIO(), loopback.client()

    def keep_feeding() -> None:
        while not stop.wait(0.01):
            feed()

    feeder = Thread(target=keep_feeding)
    feeder.start()
    try:
        with disk_with_room_for(room):
            console = Console(file=text, width=160)
            record(session, KEYS, [robot], path, console, Event(), seconds=seconds, patience=0.2)
    finally:
        stop.set()
        feeder.join()
    return text.getvalue()


def test_the_command_says_what_it_recorded(loopback: Loopback, tmp_path: Path) -> None:
    odom = publishers(loopback)["odom"]
    said = run_record(loopback, tmp_path / "run.mcap", 0.5, lambda: odom.put(sample("odom")))
    count = len(messages_of(tmp_path / "run.mcap")["/apr02/odom"])
    assert re.search(rf"run\.mcap: \d\.\d s, {count} messages, 0\.\d\d MB\n", said)
    assert f"/apr02/odom: {count}" in said


def test_the_command_ends_at_once_when_it_was_told_to_before(loopback: Loopback, tmp_path: Path) -> None:
    stop = Event()
    stop.set()
    recorder = record(loopback.client(), KEYS, ["apr02"], tmp_path / "run.mcap", Console(file=StringIO()), stop)
    assert recorder.messages == 0


def test_the_command_says_when_nothing_comes_from_a_robot_and_who_is_there(loopback: Loopback, tmp_path: Path) -> None:
    _token = loopback.router.liveliness().declare_token("omnibench/apr02/alive")
    said = run_record(loopback, tmp_path / "run.mcap", 0.5, lambda: None, "apr20")
    assert "robot 'apr20': nothing was received from it in" in said
    assert "did you mean 'apr02'? alive: apr02; recording goes on" in said


@contextmanager
def recording_process(loopback: Loopback, path: Path) -> Iterator[Command]:
    """Another process that records to ``path``, from which messages come already."""
    joints = publishers(loopback)["joint_states"]
    with Command("record", "apr02", "-o", path, "--connect", loopback.address) as recorder:

        def some_are_written() -> bool:
            joints.put(sample("joint_states"))
            assert recorder.process.poll() is None, recorder.said()
            return path.exists() and path.stat().st_size > 1000

        until(some_are_written, "the other process to have written something")
        yield recorder


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_recording_that_is_stopped_is_complete(loopback: Loopback, tmp_path: Path, number: signal.Signals) -> None:
    path = tmp_path / "run.mcap"
    with recording_process(loopback, path) as recorder:
        output, errors = recorder.stop(number)
    assert recorder.process.returncode == 0, errors
    assert "Traceback" not in errors
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert f"{summary.statistics.message_count:,} messages" in output


@pytest.mark.slow
def test_a_killed_recorder_leaves_a_file_that_rosbags_and_mcap_read(loopback: Loopback, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with recording_process(loopback, path) as recorder:
        recorder.kill()
    recorded = messages_of(path)["/apr02/joint_states"]
    assert len(recorded) > 10
    with path.open("rb") as file:
        assert [message.data for _, _, message in make_reader(file).iter_messages()] == recorded
