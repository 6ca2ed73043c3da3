"""Outputs and their encoders, attachments, and decoders: byte by byte as rosbags writes and reads."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from samples import COVARIANCE, STAMP

from omnibench.live.wire.messages import (
    JOINT_STATE,
    ODOMETRY,
    TRANSFORMS,
    Flow,
    JointState,
    MessageError,
    MissedMessages,
    Odometry,
    Transform,
    flow_of,
    packed,
)
from omnibench.live.wire.outputs import (
    OUTPUTS,
    Frames,
    JointStateDecoder,
    OdometryEncoder,
    Output,
    TransformsEncoder,
    Update,
    filtered_odometry,
    odometry,
    transforms,
)
from omnibench.live.wire.topics import TOPICS
from omnibench.robot.odometry import advance

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


@given(st.lists(st.tuples(NAMES, NAMES), min_size=1, max_size=3), st.data())
def test_transforms_of_fixed_frames_are_encoded_as_rosbags_does(frames: list[Any], data: st.DataObject) -> None:
    encoder = TransformsEncoder(frames)
    for _ in range(2):
        transforms = [Transform(data.draw(STAMPS), *pair, data.draw(vector())) for pair in frames]
        assert encoder.encode(transforms) == TRANSFORMS.encode(transforms)


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


class TestMissedMessages:
    def test_gaps_in_a_publishers_numbers_are_counted(self) -> None:
        missed = MissedMessages()
        assert [missed.take(numbered(number)) for number in (5, 6, 9, 10, 20)] == [0, 0, 2, 0, 9]
        assert missed.count == 2 + 9

    @pytest.mark.parametrize("flow", [None, (1, 2, 3, False)])
    def test_one_that_comes_late_is_not_missed_and_again_in_a_flow_not_new(self, flow: Flow | None) -> None:
        missed = MissedMessages()
        came = [missed.take(numbered(number, flow=flow)) for number in (1, 4, 2, 2, 4, 3)]
        again = 0 if flow is None else None
        assert came == [0, 2, 0, again, again, 0]
        assert missed.count == 0

    def test_publishers_have_numbers_of_their_own(self) -> None:
        missed = MissedMessages()
        for number in (1, 2, 3):
            missed.take(numbered(number))
            missed.take(numbered(100 * number, b"another publisher"[:16]))
        assert missed.count == 2 * 99

    @pytest.mark.parametrize("length", [0, 14, 33, 58, 90])
    def test_messages_of_other_programs_tell_nothing(self, length: int) -> None:
        missed = MissedMessages()
        messages = [None, zenoh.ZBytes(b"x" * length), zenoh.ZBytes(b"x" * length)]
        assert [missed.take(each) for each in messages] == [0, 0, 0]
        assert missed.count == 0
        assert flow_of(b"x" * length) is None

    def test_many_that_are_missed_are_counted_at_once(self) -> None:
        missed = MissedMessages()
        for number in range(1, 500_000, 50_000):
            missed.take(numbered(number))
        assert missed.count == 9 * 49_999


def test_a_flow_adds_to_an_attachment_what_ros_passes_over() -> None:
    plain, flow = packed(3, bytes(16)), packed(3, bytes(16), (7, 8, 9, True))
    assert (len(plain), flow_of(plain), flow_of(None)) == (33, None, None)
    assert flow[:8] == plain[:8]
    assert flow_of(flow) == (7, 8, 9, True)
