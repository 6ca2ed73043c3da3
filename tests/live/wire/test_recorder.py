"""Recording live topics into MCAP."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_recordings import disk_with_room_for, messages_of, publishers, wait_for_subscribers
from samples import PERIOD, STAMP, sample
from sessions import Loopback, until

from omnibench.errors import ConfigError, DataError, UnknownNameError
from omnibench.live.wire.recorder import Recorder
from omnibench.live.wire.topics import TOPICS, KeySpace, Publisher

KEYS = KeySpace()
ROBOT_TOPICS = tuple(topic for topic in TOPICS if topic != "tf")


@pytest.fixture
def recorder(loopback: Loopback, tmp_path: Path) -> Iterator[Recorder]:
    with Recorder(loopback.client(), KEYS, ["apr02"], tmp_path / "run.mcap") as started:
        yield started


def test_a_recording_holds_every_payload_of_every_topic_as_it_was_sent(loopback: Loopback, recorder: Recorder) -> None:
    each = publishers(loopback)
    wait_for_subscribers(*each.values())
    sent: dict[str, list[bytes]] = {}
    for topic, publisher in each.items():
        name = "/tf" if topic == "tf" else f"/apr02/{topic}"
        sent[name] = [TOPICS[topic].encode(sample(topic, k)) for k in range(50)]
        for payload in sent[name]:
            publisher.put_encoded(payload)
    until(lambda: recorder.messages == 50 * len(TOPICS), "all messages")
    recorder.stop()
    assert messages_of(recorder.path) == sent
    assert dict(recorder.counts) == dict.fromkeys(sent, 50)
    assert recorder.bytes == recorder.path.stat().st_size


def test_times_in_a_recording_are_those_of_header_and_arrival(loopback: Loopback, recorder: Recorder) -> None:
    odom = publishers(loopback)["odom"]
    wait_for_subscribers(odom)
    before = time.time_ns()
    odom.put(sample("odom", 7))
    odom.put(sample("odom", 8))
    until(lambda: recorder.messages == 2, "all messages")
    recorder.stop()
    with recorder.path.open("rb") as file:
        first, second = [message for _, _, message in make_reader(file).iter_messages()]
    assert [first.publish_time, second.publish_time] == [STAMP + 7 * PERIOD, STAMP + 8 * PERIOD]
    assert before < first.log_time <= second.log_time < time.time_ns()


def test_payloads_that_cannot_be_decoded_are_counted_and_left_out(loopback: Loopback, recorder: Recorder) -> None:
    odom = publishers(loopback)["odom"]
    wait_for_subscribers(odom)
    whole = TOPICS["odom"].encode(sample("odom"))
    for broken in (
        b"",
        b"garbage",
        whole[:100],
        whole + b"more",
        TOPICS["joint_states"].encode(sample("joint_states")),
    ):
        odom.put_encoded(broken)
    odom.put_encoded(whole)
    until(lambda: recorder.messages, "the message that can")
    recorder.stop()
    assert messages_of(recorder.path) == {"/apr02/odom": [whole]}
    assert recorder.undecodable == {"/apr02/odom": 5}


def test_several_robots_and_tf_once_are_in_one_file(loopback: Loopback, tmp_path: Path) -> None:
    first, second = publishers(loopback, "apr02"), publishers(loopback, "apr03")
    with Recorder(loopback.client(), KEYS, ["apr02", "apr03"], tmp_path / "fleet.mcap") as recorder:
        for each in (first, second):
            wait_for_subscribers(each["odom"], each["tf"])
            each["odom"].put(sample("odom"))
            each["tf"].put(sample("tf"))
        until(lambda: recorder.messages >= 4, "all messages")
    assert recorder.counts == {"/apr02/odom": 1, "/apr03/odom": 1, "/tf": 2}
    assert {name: len(payloads) for name, payloads in messages_of(recorder.path).items()} == recorder.counts


def test_only_the_topics_that_were_asked_for_are_recorded(loopback: Loopback, tmp_path: Path) -> None:
    each = publishers(loopback)
    with Recorder(loopback.client(), KEYS, ["apr02"], tmp_path / "some.mcap", ["joint_states", "odom"]) as recorder:
        wait_for_subscribers(each["odom"], each["joint_states"])
        for topic in reversed(TOPICS):
            each[topic].put(sample(topic))
        until(lambda: recorder.messages >= 2, "the two messages")
    assert recorder.counts == {"/apr02/odom": 1, "/apr02/joint_states": 1}


def test_a_recording_without_messages_is_a_valid_file(loopback: Loopback, tmp_path: Path) -> None:
    with Recorder(loopback.client(), KEYS, ["apr02"], tmp_path / "empty.mcap"):
        pass
    assert messages_of(tmp_path / "empty.mcap") == {}


def test_a_file_that_exists_is_not_overwritten(loopback: Loopback, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    with pytest.raises(DataError, match=r"run\.mcap: exists already; name another file or remove it"):
        Recorder(loopback.client(), KEYS, ["apr02"], path).start()
    assert path.read_text() == "precious"


def test_a_place_that_is_not_a_folder_is_one_line(loopback: Loopback, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="file"):
        Recorder(loopback.client(), KEYS, ["apr02"], tmp_path / "file" / "run.mcap").start()


def test_a_misspelt_topic_is_answered_with_the_nearest(loopback: Loopback, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'odom'"):
        Recorder(loopback.client(), KEYS, ["apr02"], tmp_path / "run.mcap", ["odm"]).start()
    assert not (tmp_path / "run.mcap").exists()


def test_a_name_that_no_robot_can_have_is_refused(loopback: Loopback, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"robot '\*\*'"):
        Recorder(loopback.client(), KEYS, ["**"], tmp_path / "run.mcap").start()


def fill(recorder: Recorder, publisher: Publisher[Any]) -> None:
    """Publish what does not compress until the disk is full."""
    wait_for_subscribers(publisher)
    publisher.put(sample("joint_states"))
    kind, k = TOPICS["joint_states"], 0

    def full() -> bool:
        nonlocal k
        for _ in range(200):
            k += 1
            message = sample("joint_states", k)
            noise = os.urandom(600).hex()
            publisher.put_encoded(kind.encode(type(message)(message.stamp, (noise, "b", "c"), message.positions)))
        return recorder.failure is not None

    until(full, "the disk to be full")


def test_a_full_disk_ends_the_recording_with_one_line_and_a_file_that_can_be_read(
    loopback: Loopback, tmp_path: Path
) -> None:
    failures: list[str] = []
    path = tmp_path / "run.mcap"
    recorder = Recorder(loopback.client(), KEYS, ["apr02"], path, on_failure=failures.append)
    joints = publishers(loopback)["joint_states"]
    with recorder, disk_with_room_for(1_500_000):
        fill(recorder, joints)
    assert failures == [recorder.failure]
    assert "run.mcap: cannot be written" in failures[0]
    assert "\n" not in failures[0]
    recorded = messages_of(path)["/apr02/joint_states"]
    assert 0 < len(recorded) <= recorder.counts["/apr02/joint_states"]
    assert TOPICS["joint_states"].encode(sample("joint_states")) == recorded[0]
    joints.put(sample("joint_states"))  # who publishes does not notice


def test_a_recorder_whose_session_has_closed_completes_its_file(loopback: Loopback, tmp_path: Path) -> None:
    session, odom = loopback.client(), publishers(loopback)["odom"]
    with Recorder(session, KEYS, ["apr02"], tmp_path / "run.mcap") as recorder:
        wait_for_subscribers(odom)
        odom.put(sample("odom"))
        until(lambda: recorder.messages, "the message")
        session.close()
    assert len(messages_of(tmp_path / "run.mcap")["/apr02/odom"]) == 1


def test_messages_that_never_came_are_counted(loopback: Loopback, recorder: Recorder) -> None:
    odom = publishers(loopback)["odom"]
    wait_for_subscribers(odom)
    odom.put(sample("odom", 0))
    for _ in range(7):
        odom.next_number()  # of a message that is lost
    odom.put(sample("odom", 8))
    until(lambda: recorder.messages == 2, "the two messages")
    assert recorder.missed == {"/apr02/odom": 7}


def test_a_message_that_is_sent_again_is_recorded_once(loopback: Loopback, recorder: Recorder) -> None:
    odom = publishers(loopback)["odom"]
    wait_for_subscribers(odom)
    for number in (1, 2, 2, 1, 3):
        odom.put_numbered(TOPICS["odom"].encode(sample("odom", number)), number, (7, number, 1, False))
    until(lambda: recorder.messages == 3, "the three messages")
    recorder.stop()
    assert messages_of(recorder.path) == {"/apr02/odom": [TOPICS["odom"].encode(sample("odom", k)) for k in (1, 2, 3)]}
