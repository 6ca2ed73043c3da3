"""The quick encoders write what rosbags writes, byte by byte, and the quick decoder reads what rosbags reads."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from omnibench.live.wire.messages import (
    JOINT_STATE,
    ODOMETRY,
    TRANSFORMS,
    JointState,
    MessageError,
    Odometry,
    Transform,
)
from omnibench.live.wire.outputs import JointStateDecoder, OdometryEncoder, TransformsEncoder

NUMBERS = st.floats(-1e6, 1e6)
STAMPS = st.integers(0, 2**31 * 10**9 - 1)
FRAMES = st.text("abcdefghij/_", min_size=0, max_size=12)


def vector() -> st.SearchStrategy[np.ndarray]:
    return arrays(float, 3, elements=NUMBERS)


def square() -> st.SearchStrategy[np.ndarray]:
    return arrays(float, (3, 3), elements=NUMBERS)


@given(FRAMES, FRAMES, st.lists(st.tuples(STAMPS, vector(), square(), vector(), square()), min_size=1, max_size=3))
def test_odometry_of_fixed_frames_is_encoded_as_rosbags_does(frame: str, child: str, contents: list[Any]) -> None:
    encoder = OdometryEncoder(frame, child)
    for stamp, *numbers in contents:
        message = Odometry(stamp, frame, child, *numbers)
        assert encoder.encode(message) == ODOMETRY.encode(message)


@given(st.lists(st.tuples(FRAMES, FRAMES), min_size=1, max_size=3), st.data())
def test_transforms_of_fixed_frames_are_encoded_as_rosbags_does(frames: list[Any], data: st.DataObject) -> None:
    encoder = TransformsEncoder(frames)
    for _ in range(2):
        transforms = [Transform(data.draw(STAMPS), *pair, data.draw(vector())) for pair in frames]
        assert encoder.encode(transforms) == TRANSFORMS.encode(transforms)


@st.composite
def joint_states(draw: st.DrawFn) -> list[JointState]:
    """Messages of a sender, and of others in between."""
    senders = draw(st.lists(st.tuples(st.lists(FRAMES, max_size=4), FRAMES, st.booleans(), st.booleans()), min_size=1))
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
def test_a_damaged_wheel_message_is_refused_or_read_as_rosbags_reads_it(
    messages: list[JointState], data: st.DataObject
) -> None:
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
