"""A learned calibration in a running node: the batch's numbers, and a swap without a jump."""

from __future__ import annotations

import numpy as np
from drives import NOISE, PERIOD, drive
from drives import calibration as plain
from learned_samples import a_learned_calibration

from omnibench.config import to_yaml
from omnibench.live.control.request_queue import LONGEST
from omnibench.live.estimation.tracker import RobotTracker
from omnibench.live.wire.outputs import Update
from omnibench.robot.calibration import Calibration, parse_calibration
from omnibench.robot.effects.effect import MOST_BYTES, encode_weights
from omnibench.testing.synthetic import synthetic_robot

DRIVEN = [[20.0, 0.0, 0.0]]  # m/s, m/s, rad/s: so fast that all that is driven here is near to it


def learned() -> Calibration:
    return a_learned_calibration(synthetic_robot(3), DRIVEN, PERIOD).model_copy(update={"noise": NOISE})


def fed(robot: RobotTracker, payloads: list[bytes]) -> list[Update]:
    return [update for index, payload in enumerate(payloads) for update in robot.take_wheels(payload, 0.01 * index)]


def test_odometry_of_the_node_is_that_of_the_batch() -> None:
    path = drive(3.0, using=learned())
    poses = np.array([update.pose for update in fed(RobotTracker("apr", learned()), path.payloads())])
    np.testing.assert_allclose(poses, path.poses, rtol=0, atol=1e-9)  # stamps are whole nanoseconds
    design = drive(3.0, using=learned().model_copy(update={"effects": (), "covariance": None, "plain": None}))
    assert np.abs(poses - design.poses).max() > 1e-4


def test_the_largest_weights_with_many_motions_fit_in_a_request() -> None:
    """487 motions are driven in OptiOdom's circles of omni3, the most of all recordings here."""
    motions = tuple((-0.123456789, 0.123456789, -0.123456789) for _ in range(600))
    (term,) = learned().effects
    weights = encode_weights(np.ones(MOST_BYTES // 4))
    largest = learned().model_copy(
        update={"driven": motions, "effects": (term.model_copy(update={"weights": weights}),)}
    )
    assert len(to_yaml(largest).encode()) < LONGEST


def test_a_swap_to_a_learned_calibration_is_read_from_its_message_and_does_not_jump() -> None:
    text = to_yaml(learned())
    path, robot = drive(2.0, using=plain()), RobotTracker("apr", plain())
    payloads = path.payloads()
    before = fed(robot, payloads[:100])
    robot.swap(parse_calibration(text, "request"))
    after = [
        update for index, each in enumerate(payloads[100:], 100) for update in robot.take_wheels(each, 0.01 * index)
    ]
    assert np.abs(after[0].pose - before[-1].pose).max() < 0.1
    stayed = fed(RobotTracker("apr", plain()), payloads)
    assert np.abs(after[-1].pose - stayed[-1].pose).max() > 1e-4
