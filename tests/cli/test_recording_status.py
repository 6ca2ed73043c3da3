"""``omnibench record``: what it prints and how it ends, with real sessions."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from threading import Event, Thread

import pytest
from mcap.reader import make_reader
from mcap_recordings import disk_with_room_for, messages_of, publishers
from rich.console import Console
from samples import sample
from sessions import Loopback, until
from timing import PATIENCE

from omnibench.cli.terminal.live_tables import record
from omnibench.errors import DataError
from omnibench.live.wire.topics import KeySpace

KEYS = KeySpace()


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


RECORDING_PROCESS = """
import sys
from pathlib import Path
from rich.console import Console
from omnibench.cli.terminal.live_tables import record
from omnibench.live.stopping import stop_on_signals
from omnibench.live.wire.topics import KeySpace
from sessions import raw_session

session = raw_session("client", connect=[sys.argv[1]])
with stop_on_signals() as stop:
    record(session, KeySpace(), ["apr02"], Path(sys.argv[2]), Console(), stop)
"""


@contextmanager
def recording_process(loopback: Loopback, path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that records to ``path``, from which messages come already."""
    joints = publishers(loopback)["joint_states"]
    process = subprocess.Popen(
        [sys.executable, "-c", RECORDING_PROCESS, loopback.address, str(path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )

    def some_are_written() -> bool:
        joints.put(sample("joint_states"))
        assert process.poll() is None, process.communicate()[1]
        return path.exists() and path.stat().st_size > 1000

    try:
        until(some_are_written, "the other process to have written something")
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_recording_that_is_told_to_stop_is_complete(
    loopback: Loopback, tmp_path: Path, number: signal.Signals
) -> None:
    path = tmp_path / "run.mcap"
    with recording_process(loopback, path) as process:
        process.send_signal(number)
        output, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, errors
    assert errors == ""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert f"{summary.statistics.message_count:,} messages" in output


def test_a_killed_recorder_leaves_a_file_that_rosbags_and_mcap_read(loopback: Loopback, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with recording_process(loopback, path) as process:
        process.kill()
        process.communicate()
    recorded = messages_of(path)["/apr02/joint_states"]
    assert len(recorded) > 10
    with path.open("rb") as file:
        assert [message.data for _, _, message in make_reader(file).iter_messages()] == recorded
