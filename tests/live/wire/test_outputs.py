"""Outputs: the messages that a node publishes of every update."""

from __future__ import annotations

import numpy as np
import pytest
from samples import COVARIANCE, STAMP

from omnibench.live.wire.messages import ODOMETRY, TRANSFORMS
from omnibench.live.wire.outputs import OUTPUTS, Frames, Output, Update, filtered_odometry, odometry, transforms
from omnibench.live.wire.topics import TOPICS
from omnibench.robot.odometry import advance

FRAMES = Frames(map="hall", odom="apr/odom", base="apr/base_link")
POSE, IN_MAP = np.array([1.0, 2.0, 0.3]), np.array([4.0, 5.0, -2.0])
UPDATE = Update(STAMP, POSE, COVARIANCE, np.array([0.3, -0.1, 0.4]), 2 * COVARIANCE, (IN_MAP, 3 * COVARIANCE))


def test_frames_are_those_of_the_robot() -> None:
    in_odom, in_map = odometry(UPDATE, FRAMES), filtered_odometry(UPDATE, FRAMES)
    assert (in_odom.frame, in_odom.child_frame) == ("apr/odom", "apr/base_link")
    assert (in_map.frame, in_map.child_frame) == ("hall", "apr/base_link")
    assert [(each.frame, each.child_frame) for each in transforms(UPDATE, FRAMES)] == [
        ("hall", "apr/odom"),
        ("apr/odom", "apr/base_link"),
    ]


def test_the_two_transforms_together_are_the_filtered_pose() -> None:
    to_odom, to_base = (each.pose for each in transforms(UPDATE, FRAMES))
    together = advance(to_odom, to_base, "euler")
    np.testing.assert_allclose(together[:2], IN_MAP[:2], atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * together[2]), np.exp(1j * IN_MAP[2]), atol=1e-12)


@pytest.mark.parametrize("output", OUTPUTS, ids=lambda output: output.topic)
def test_an_output_is_encoded_as_its_message_type_does(output: Output) -> None:
    encoded = output.encoding(FRAMES)
    for update in (UPDATE, Update(STAMP + 1, IN_MAP, COVARIANCE, np.zeros(3), COVARIANCE, (POSE, COVARIANCE))):
        assert encoded(update) == output.message_type.encode(output.message(update, FRAMES))


def test_an_output_without_an_encoder_of_its_own_is_encoded_by_its_message_type() -> None:
    plain = Output("extra", ODOMETRY, odometry)
    assert plain.encoding(FRAMES)(UPDATE) == ODOMETRY.encode(odometry(UPDATE, FRAMES))


def test_covariances_reach_the_messages() -> None:
    decoded = ODOMETRY.decode(ODOMETRY.encode(filtered_odometry(UPDATE, FRAMES)))
    np.testing.assert_array_equal(decoded.pose_covariance, 3 * COVARIANCE)
    np.testing.assert_array_equal(decoded.twist_covariance, 2 * COVARIANCE)


def test_every_output_is_a_topic() -> None:
    assert {output.topic: output.message_type for output in OUTPUTS}.items() <= TOPICS.items()
    assert TOPICS["tf"] is TRANSFORMS


def test_outputs_in_the_map_need_a_pose_in_the_map() -> None:
    alone = Update(STAMP, POSE, COVARIANCE, np.zeros(3), COVARIANCE)
    with pytest.raises(ValueError, match="needs fusion"):
        transforms(alone, FRAMES)
