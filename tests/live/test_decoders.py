"""Every message, published by real sessions in every profile, is read by decoders that are not ours."""

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rosbags.highlevel import AnyReader
from samples import COVARIANCE, STAMP, sample
from sessions import Loopback, open_loopback, until
from timing import PATIENCE

from omnibench.live.record import Recorder
from omnibench.live.topics import (
    OUTPUTS,
    TOPICS,
    Frames,
    GraphNode,
    JointStateDecoder,
    KeySpace,
    OdometryEncoder,
    Output,
    Profile,
    Publisher,
    Update,
    filtered_odometry,
    odometry,
    transforms,
)
from omnibench.live.wire import (
    JOINT_STATE,
    ODOMETRY,
    TRANSFORMS,
    Flow,
    JointState,
    MessageError,
    MissedMessages,
    Odometry,
    flow_of,
    packed,
)
from omnibench.robot.odometry import advance

PROFILES: tuple[Profile, ...] = ("plain", "rmw", "humble")

HEADER = {"sec": 1_700_000_000, "nanosec": 123_456_789}


def covariance_36(scale: float) -> list[float]:
    """The samples' covariance of (x, y, heading) in ROS 2's order (x, y, z, roll, pitch, yaw), row by row."""
    full = np.zeros((6, 6))
    full[np.ix_([0, 1, 5], [0, 1, 5])] = scale * COVARIANCE
    full[2, 2] = full[3, 3] = full[4, 4] = 1e-9
    return full.ravel().tolist()


def pose_36(x: float, y: float, heading: float) -> list[float]:
    """Position, quaternion and covariance."""
    return [x, y, 0.0, 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2), *covariance_36(1.0)]


def odometry_read(content: Any) -> list[Any]:
    linear, angular = content.twist.twist.linear, content.twist.twist.angular
    return [
        content.header.frame_id,
        content.child_frame_id,
        *pose_read(content.pose),
        *(linear.x, linear.y, linear.z, angular.x, angular.y, angular.z),
        *content.twist.covariance,
    ]


def pose_read(pose: Any) -> list[float]:
    position, orientation = pose.pose.position, pose.pose.orientation
    return [
        *(position.x, position.y, position.z),
        *(orientation.x, orientation.y, orientation.z, orientation.w),
        *pose.covariance,
    ]


def transform_read(transform: Any) -> list[Any]:
    moved, turned = transform.transform.translation, transform.transform.rotation
    return [
        *(transform.header.stamp.sec, transform.header.stamp.nanosec),
        *(transform.header.frame_id, transform.child_frame_id),
        *(moved.x, moved.y, moved.z, turned.x, turned.y, turned.z, turned.w),
    ]


def read(topic: str, content: Any) -> list[Any]:
    """All that a decoded message holds, whichever decoder made the object."""
    if topic == "tf":
        return [value for transform in content.transforms for value in transform_read(transform)]
    values: list[Any] = [content.header.stamp.sec, content.header.stamp.nanosec]
    if topic == "joint_states":
        return [*values, *content.name, *content.position, *content.velocity, *content.effort]
    if topic == "slam_pose":
        return [*values, content.header.frame_id, *pose_read(content.pose)]
    if topic == "diagnostics":
        for status in content.status:
            values += [int(status.level), status.name, status.message, status.hardware_id]
            values += [text for pair in status.values for text in (pair.key, pair.value)]
        return values
    return [*values, *odometry_read(content)]


def turned(heading: float) -> list[float]:
    return [0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)]


MOVED = [*pose_36(1.25, -2.5, 0.7), 0.31, -0.12, 0.0, 0.0, 0.0, 0.45, *covariance_36(2.0)]
EXPECTED: dict[str, list[Any]] = {
    "joint_states": [*HEADER.values(), "a", "b", "c", 0.1, 0.2, 0.3, 1.5, -2.5, 3.5],
    "slam_pose": [*HEADER.values(), "map", *pose_36(3.5, -1.25, -2.1)],
    "odom": [*HEADER.values(), "odom", "base_link", *MOVED],
    "odometry/filtered": [*HEADER.values(), "map", "base_link", *MOVED],
    "diagnostics": [*HEADER.values(), 1, "odometry", "late samples", "apr02", "late", "3", "rate_hz", "99.8"],
    "tf": [
        *(*HEADER.values(), "map", "odom", 0.5, 0.25, 0.0, *turned(0.125)),
        *(*HEADER.values(), "odom", "base_link", 1.0, 2.0, 0.0, *turned(-3.0)),
    ],
}


def ros_name(topic: str) -> str:
    return "/tf" if topic == "tf" else f"/apr02/{topic}"


@pytest.fixture(scope="module")
def network() -> Iterator[Loopback]:
    opened = open_loopback()
    yield opened
    opened.close()


@pytest.fixture(scope="module", params=PROFILES)
def profile(request: pytest.FixtureRequest) -> Profile:
    return request.param


@pytest.fixture(scope="module")
def node(network: Loopback, profile: Profile) -> dict[str, Publisher[Any]]:
    """A node's publishers of every topic."""
    graph = GraphNode(network.client(), KeySpace(profile, domain=PROFILES.index(profile)), "omnibench")
    return {topic: graph.publisher("apr02", topic, lossless=True) for topic in TOPICS}


@contextmanager
def samples_of(network: Loopback, publisher: Publisher[Any]) -> Iterator[Callable[[], zenoh.Sample]]:
    """The next sample of a publisher, in another session, time after time; then nobody subscribes to it any more."""
    with network.client().declare_subscriber(publisher.key) as subscriber:
        until(lambda: publisher.matched, "the subscription")

        def sample_that_comes() -> zenoh.Sample:
            found: list[zenoh.Sample] = []

            def comes() -> bool:
                one = subscriber.try_recv()
                found.extend([one] if one else [])
                return bool(found)

            until(comes, "a sample")
            return found[0]

        yield sample_that_comes
    until(lambda: not publisher.matched, "the subscription to go")


@pytest.fixture(scope="module")
def recording(
    network: Loopback, profile: Profile, node: dict[str, Publisher[Any]], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """One message of every topic, recorded."""
    path = tmp_path_factory.mktemp("recording") / f"{profile}.mcap"
    keys = KeySpace(profile, domain=PROFILES.index(profile))
    with Recorder(network.client(), keys, ["apr02"], path) as recorder:
        until(lambda: all(publisher.matched for publisher in node.values()), "the recorder's subscriptions")
        for topic, publisher in node.items():
            publisher.put(sample(topic))
        until(lambda: recorder.messages == len(TOPICS), "all messages")
    return path


@pytest.mark.parametrize("topic", TOPICS)
def test_rosbags_and_mcap_ros2_support_read_the_recording(recording: Path, topic: str) -> None:
    with AnyReader([recording]) as reader:
        (connection,) = [each for each in reader.connections if each.topic == ros_name(topic)]
        ((_, _, payload),) = reader.messages([connection])
        assert connection.msgtype == TOPICS[topic].name
        assert read(topic, reader.deserialize(payload, connection.msgtype)) == EXPECTED[topic]
    decoder = pytest.importorskip("mcap_ros2.decoder", reason="mcap-ros2-support is not installed")
    mcap = pytest.importorskip("mcap.reader")
    with recording.open("rb") as file:
        reader = mcap.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        ((schema, _, _, content),) = reader.iter_decoded_messages(topics=[ros_name(topic)])
    assert schema.name == TOPICS[topic].name
    assert read(topic, content) == EXPECTED[topic]


@pytest.fixture(scope="module")
def sdk(network: Loopback) -> Iterator[Any]:
    """zenoh-ros2-sdk, whose one session is connected to our router."""
    package = pytest.importorskip("zenoh_ros2_sdk", reason="zenoh-ros2-sdk is not installed")
    session = package.ZenohSession.get_instance("127.0.0.1", network.port)
    yield package
    session.close()


@pytest.fixture(scope="module")
def rmw_node(network: Loopback) -> Iterator[dict[str, Publisher[Any]]]:
    """A node of another ROS domain."""
    graph = GraphNode(network.client(), KeySpace("rmw", domain=42), "omnibench")
    yield {topic: graph.publisher("apr02", topic, lossless=True) for topic in TOPICS}
    graph.session.close()


def type_hash(topic: str) -> str:
    """As zenoh-ros2-sdk computes it from the definition of a topic's type and those of the types within it."""
    utils = pytest.importorskip("zenoh_ros2_sdk.utils")
    own, *others = TOPICS[topic].definition.split("=" * 80 + "\n")
    within = dict(text.removeprefix("MSG: ").split("\n", 1) for text in others)
    return utils.get_type_hash(TOPICS[topic].name, own, {name.replace("/", "/msg/"): within[name] for name in within})


@pytest.mark.usefixtures("rmw_node")
def test_another_ros_client_lists_the_topics_with_their_types(sdk: Any, network: Loopback) -> None:
    listed: Callable[[], list[tuple[str, list[str]]]] = lambda: sdk.get_topic_names_and_types(  # noqa: E731
        42, "127.0.0.1", network.port
    )
    expected = sorted((ros_name(topic), [kind.name]) for topic, kind in TOPICS.items())
    until(lambda: len(listed()) == len(TOPICS), "all topics in the list")
    assert listed() == expected


@pytest.mark.parametrize("topic", TOPICS)
def test_ros_clients_know_the_qos(sdk: Any, network: Loopback, rmw_node: dict[str, Publisher[Any]], topic: str) -> None:
    assert rmw_node
    info = sdk.get_topic_info(ros_name(topic), 42, "127.0.0.1", network.port, verbose=True)
    (publisher,) = info.publishers
    assert (publisher.node_name, publisher.topic_type) == ("omnibench", TOPICS[topic].name)
    assert publisher.type_hash == type_hash(topic)
    qos = pytest.importorskip("zenoh_ros2_sdk.qos")
    assert qos.QosProfile.decode(publisher.qos) == qos.QosProfile(
        qos.QosReliability.RELIABLE, qos.QosDurability.VOLATILE, qos.QosHistoryKind.KEEP_LAST, 10
    )


@pytest.mark.parametrize("topic", TOPICS)
def test_a_ros_client_reads_all(sdk: Any, network: Loopback, rmw_node: dict[str, Publisher[Any]], topic: str) -> None:
    came, contents = threading.Event(), []

    def callback(content: Any) -> None:
        contents.append(content)
        came.set()

    subscriber = sdk.ROS2Subscriber(
        ros_name(topic),
        TOPICS[topic].name,
        callback,
        msg_definition=TOPICS[topic].definition,
        domain_id=42,
        router_ip="127.0.0.1",
        router_port=network.port,
        type_hash=type_hash(topic),
    )
    try:
        until(lambda: rmw_node[topic].matched, "the subscription")
        rmw_node[topic].put(sample(topic))
        assert came.wait(PATIENCE)
    finally:
        subscriber.close()
    until(lambda: not rmw_node[topic].matched, "the subscription to go")
    assert read(topic, contents[0]) == EXPECTED[topic]


@pytest.mark.parametrize("topic", TOPICS)
def test_each_message_says_who_sent_it(network: Loopback, rmw_node: dict[str, Publisher[Any]], topic: str) -> None:
    package = pytest.importorskip("zenoh_ros2_sdk.attachment", reason="zenoh-ros2-sdk is not installed")
    with samples_of(network, rmw_node[topic]) as next_sample:
        attachments = []
        for _ in range(2):
            rmw_node[topic].put(sample(topic))
            attachment = next_sample().attachment
            attachments.append(package.Attachment.from_bytes(attachment.to_bytes()))
    first, second = attachments
    assert second.sequence_id == first.sequence_id + 1
    assert second.timestamp_ns > first.timestamp_ns
    assert first.gid == second.gid
    assert len(first.gid) == 16


# Outputs and their encoders, attachments, and decoders: byte by byte as rosbags writes and reads.

NUMBERS = st.floats(-1e6, 1e6)
STAMPS = st.integers(0, 2**31 * 10**9 - 1)
NAMES = st.text("abcdefghij/_", min_size=0, max_size=12)


def vector() -> st.SearchStrategy[np.ndarray]:
    return arrays(float, 3, elements=NUMBERS)


def square() -> st.SearchStrategy[np.ndarray]:
    return arrays(float, (3, 3), elements=NUMBERS)


@given(NAMES, NAMES, st.lists(st.tuples(STAMPS, vector(), square(), vector(), square()), min_size=1, max_size=3))
def test_odometry_of_fixed_frames_is_encoded_as_rosbags_does(frame: str, child: str, contents: list[Any]) -> None:
    encoder = OdometryEncoder(frame, child)
    for stamp, *numbers in contents:
        message = Odometry(stamp, frame, child, *numbers)
        assert encoder.encode(message) == ODOMETRY.encode(message)


@st.composite
def joint_states(draw: st.DrawFn) -> list[JointState]:
    """Messages of a sender, and of others in between."""
    senders = draw(st.lists(st.tuples(st.lists(NAMES, max_size=4), NAMES, st.booleans(), st.booleans()), min_size=1))
    messages = []
    for _ in range(draw(st.integers(1, 6))):
        names, frame, positions, velocities = draw(st.sampled_from(senders))
        numbers = arrays(float, len(names), elements=NUMBERS)
        messages.append(
            JointState(
                draw(STAMPS),
                tuple(names),
                draw(numbers) if positions and names else None,
                draw(numbers) if velocities and names else None,
                frame,
            )
        )
    return messages


@given(joint_states())
def test_wheel_messages_are_decoded_as_rosbags_does_whoever_sends_in_between(messages: list[JointState]) -> None:
    decoder = JointStateDecoder()
    for message in messages:
        payload = JOINT_STATE.encode(message)
        for decoded in (decoder.decode(payload), JOINT_STATE.decode(payload)):
            assert (decoded.stamp, decoded.names, decoded.frame) == (message.stamp, message.names, message.frame)
            for found, sent in ((decoded.positions, message.positions), (decoded.velocities, message.velocities)):
                assert (None if found is None else found.tolist()) == (None if sent is None else sent.tolist())


@given(joint_states(), st.data())
def test_a_damaged_message_is_refused_or_read_as_by_rosbags(messages: list[JointState], data: st.DataObject) -> None:
    decoder = JointStateDecoder()
    for message in messages:
        payload = bytearray(JOINT_STATE.encode(message))
        decoder.decode(bytes(payload))
        for _ in range(data.draw(st.integers(1, 3))):
            payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
        damaged = bytes(payload[: data.draw(st.integers(0, len(payload)))])
        outcomes = []
        for decode in (decoder.decode, JOINT_STATE.decode):
            try:
                found = decode(damaged)
            except MessageError:
                outcomes.append(None)
            else:
                numbers = [None if each is None else each.tobytes() for each in (found.positions, found.velocities)]
                outcomes.append((found.stamp, found.names, found.frame, numbers))
        assert outcomes[0] == outcomes[1]


ROBOT_FRAMES = Frames(map="hall", odom="apr/odom", base="apr/base_link")
POSE, IN_MAP = np.array([1.0, 2.0, 0.3]), np.array([4.0, 5.0, -2.0])
UPDATE = Update(STAMP, POSE, COVARIANCE, np.array([0.3, -0.1, 0.4]), 2 * COVARIANCE, (IN_MAP, 3 * COVARIANCE))


def test_frames_and_covariances_are_those_of_the_robot() -> None:
    in_odom, in_map = odometry(UPDATE, ROBOT_FRAMES), filtered_odometry(UPDATE, ROBOT_FRAMES)
    assert (in_odom.frame, in_odom.child_frame) == ("apr/odom", "apr/base_link")
    assert (in_map.frame, in_map.child_frame) == ("hall", "apr/base_link")
    pairs = [(each.frame, each.child_frame) for each in transforms(UPDATE, ROBOT_FRAMES)]
    assert pairs == [("hall", "apr/odom"), ("apr/odom", "apr/base_link")]
    decoded = ODOMETRY.decode(ODOMETRY.encode(in_map))
    np.testing.assert_array_equal(decoded.pose_covariance, 3 * COVARIANCE)
    np.testing.assert_array_equal(decoded.twist_covariance, 2 * COVARIANCE)


def test_the_two_transforms_together_are_the_filtered_pose() -> None:
    to_odom, to_base = (each.pose for each in transforms(UPDATE, ROBOT_FRAMES))
    together = advance(to_odom, to_base, "euler")
    np.testing.assert_allclose(together[:2], IN_MAP[:2], atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * together[2]), np.exp(1j * IN_MAP[2]), atol=1e-12)


@pytest.mark.parametrize("output", [*OUTPUTS, Output("extra", ODOMETRY, odometry)], ids=lambda output: output.topic)
def test_an_output_is_encoded_as_its_message_type_does(output: Output) -> None:
    encoded = output.encoding(ROBOT_FRAMES)
    for update in (UPDATE, Update(STAMP + 1, IN_MAP, COVARIANCE, np.zeros(3), COVARIANCE, (POSE, COVARIANCE))):
        assert encoded(update) == output.message_type.encode(output.message(update, ROBOT_FRAMES))


def test_every_output_is_a_topic_and_those_in_the_map_need_a_pose_in_the_map() -> None:
    assert {output.topic: output.message_type for output in OUTPUTS}.items() <= TOPICS.items()
    assert TOPICS["tf"] is TRANSFORMS
    with pytest.raises(ValueError, match="fusion"):
        transforms(Update(STAMP, POSE, COVARIANCE, np.zeros(3), COVARIANCE), ROBOT_FRAMES)


def numbered(number: int, publisher: bytes = bytes(16), flow: Flow | None = None) -> zenoh.ZBytes:
    return zenoh.ZBytes(packed(number, publisher, flow))


@pytest.mark.parametrize("flow", [None, (1, 2, 3, False)])
def test_a_message_that_comes_late_is_not_missed_and_again_in_a_flow_not_new(flow: Flow | None) -> None:
    missed = MissedMessages()
    came = [missed.take(numbered(number, flow=flow)) for number in (1, 4, 2, 2, 4, 3)]
    again = 0 if flow is None else None
    assert came == [0, 2, 0, again, again, 0]
    assert missed.count == 0


def test_publishers_have_numbers_of_their_own_and_what_is_missed_of_one_is_counted_at_once() -> None:
    missed = MissedMessages()
    for number in (1, 2, 3):
        missed.take(numbered(number))
        missed.take(numbered(50_000 * number, b"another publisher"[:16]))
    assert missed.count == 2 * 49_999


@pytest.mark.parametrize("length", [0, 14, 33, 58, 90])
def test_messages_of_other_programs_tell_nothing(length: int) -> None:
    missed = MissedMessages()
    messages = [None, zenoh.ZBytes(b"x" * length), zenoh.ZBytes(b"x" * length)]
    assert [missed.take(each) for each in messages] == [0, 0, 0]
    assert missed.count == 0
    assert flow_of(b"x" * length) is None


def test_a_flow_adds_to_an_attachment_what_ros_passes_over() -> None:
    plain, flow = packed(3, bytes(16)), packed(3, bytes(16), (7, 8, 9, True))
    assert (len(plain), flow_of(plain), flow_of(None)) == (33, None, None)
    assert flow[:8] == plain[:8]
    assert flow_of(flow) == (7, 8, 9, True)
