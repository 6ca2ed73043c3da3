"""Live odometry: the batch's numbers, with covariances that mean what they say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drives import NOISE, calibration, drive
from hypothesis import given
from hypothesis import strategies as st

from omnibench.live.estimation.live_odometry import LiveOdometry
from omnibench.live.wheels.wheel_input import WheelStep
from omnibench.robot.calibration import Calibration, Noise, Provenance
from omnibench.robot.kinematics import rotation
from omnibench.robot.odometry import Integration, OdometryBatch, WheelLog


def driven(odometry: LiveOdometry, angles: np.ndarray, durations: np.ndarray) -> LiveOdometry:
    for turned, duration in zip(np.diff(angles, axis=0), durations, strict=True):
        odometry.step(WheelStep(0, float(duration), turned, turned / duration))
    return odometry


@given(st.integers(0, 10_000), st.sampled_from(["euler", "arc"]), st.sampled_from([3, 4]))
def test_poses_are_those_of_the_batch(seed: int, integration: Integration, wheels: int) -> None:
    path = drive(1.0, seed=seed, using=calibration(integration=integration, wheels=wheels))
    live = driven(LiveOdometry(path.calibration), path.angles, np.full(100, 0.01))
    np.testing.assert_allclose(live.pose, path.poses[-1], atol=1e-12)


@pytest.mark.parametrize("integration", ["euler", "arc"])
def test_the_covariance_of_the_matrix_spreads_as_the_batch_derivatives_say(integration: Integration) -> None:
    path = drive(4.0, using=calibration(integration=integration))
    rates = np.diff(path.angles, axis=0) / 0.01
    log = WheelLog(path.times, rates, np.zeros(3), path.times[-1:])
    slopes = OdometryBatch([log], integration).jacobian(path.calibration.matrix_array)[0].reshape(3, 9)
    expected = slopes @ np.array(path.calibration.covariance) @ slopes.T
    quiet = path.calibration.model_copy(update={"noise": Noise(walk_position=1e-9, walk_heading=1e-9)})
    live = driven(LiveOdometry(quiet), path.angles, np.full(400, 0.01))
    np.testing.assert_allclose(live.covariance, expected, rtol=2e-3, atol=1e-3 * np.abs(expected).max())


def test_the_random_walk_spreads_as_simulations_of_it_do() -> None:
    path = drive(4.0, using=calibration(deviation=None))
    rng = np.random.default_rng(5)
    live = driven(LiveOdometry(path.calibration), path.angles, np.full(400, 0.01))
    matrix, steps = path.calibration.matrix_array, np.diff(path.angles, axis=0)
    count = 4000
    pose = np.zeros((count, 3))
    for moved in steps @ matrix.T:
        direction = pose[:, 2] + moved[2] / 2
        pose[:, 0] += moved[0] * np.cos(direction) - moved[1] * np.sin(direction)
        pose[:, 1] += moved[0] * np.sin(direction) + moved[1] * np.cos(direction)
        pose[:, 2] += moved[2]
        pose += 0.1 * rng.standard_normal((count, 3)) * [NOISE.walk_position, NOISE.walk_position, NOISE.walk_heading]
    seen = np.cov(pose.T)
    np.testing.assert_allclose(np.diag(live.covariance), np.diag(seen), rtol=0.1)
    assert np.corrcoef(pose.T)[0, 2] == pytest.approx(
        live.covariance[0, 2] / np.sqrt(live.covariance[0, 0] * live.covariance[2, 2]), abs=0.05
    )


@given(st.floats(0.6, 1.4), st.integers(1, 99))
def test_a_swapped_calibration_moves_the_next_sample_and_not_the_pose(scale: float, place: int) -> None:
    path, other = drive(1.0), calibration(scale=scale, integration="euler")
    durations = np.full(100, 0.01)
    live = driven(LiveOdometry(path.calibration), path.angles[: place + 1], durations[:place])
    before, spread = live.pose.copy(), live.covariance
    live = live.continued(other)
    np.testing.assert_array_equal(live.pose, before)
    np.testing.assert_allclose(live.covariance, spread, rtol=1e-12)
    live.step(step(0.01, [0.01, 0.0, 0.0]))
    moved = other.matrix_array @ [0.01, 0.0, 0.0]
    assert np.linalg.norm(live.pose[:2] - before[:2]) == pytest.approx(np.linalg.norm(moved[:2]), rel=1e-9)


def test_the_twist_is_the_matrix_times_the_rates_in_the_robots_frame() -> None:
    live = LiveOdometry(calibration())
    for _ in range(3):
        live.step(step(0.01, [0.01, -0.02, 0.005]))
    np.testing.assert_allclose(live.twist, live_matrix(calibration()) @ [1.0, -2.0, 0.5], atol=1e-12)
    assert np.linalg.eigvalsh(live.twist_covariance)[0] > 0


def step(duration: float, angles: list[float], blind: float = 0.0) -> WheelStep:
    return WheelStep(0, duration, np.array(angles), np.array(angles) / duration, blind)


def live_matrix(of: Calibration) -> np.ndarray:
    return of.matrix_array


def test_noise_shrinks_while_no_wheel_turns() -> None:
    still, moving = (LiveOdometry(calibration(deviation=None), standstill=0.01) for _ in range(2))
    for _ in range(100):
        still.step(step(0.01, [0.0, 0.0, 0.0]))
        moving.step(step(0.01, [0.02, 0.02, 0.02]))
    assert still.covariance[2, 2] == pytest.approx(0.01 * moving.covariance[2, 2], rel=1e-6)


def test_what_nobody_saw_makes_the_pose_less_certain() -> None:
    seen, unseen = LiveOdometry(calibration()), LiveOdometry(calibration())
    for live, blind in ((seen, 0.0), (unseen, 3.0)):
        live.step(step(0.01, [0.02, 0.01, -0.02]))
        live.step(step(3.0, [6.0, 3.0, -6.0], blind=blind))
    assert unseen.covariance[0, 0] > seen.covariance[0, 0] + 0.01


def test_the_covariance_grows_while_nothing_comes() -> None:
    live = LiveOdometry(calibration())
    live.step(step(0.01, [0.02, 0.01, -0.02]))
    traces = [float(np.trace(live.covariance_after_silence(seconds))) for seconds in (0.0, 0.5, 1.0, 5.0)]
    assert traces == sorted(traces)
    assert traces[-1] > 2 * traces[0]


def test_a_calibration_without_noise_or_covariance_still_has_an_uncertain_pose() -> None:
    bare = calibration(deviation=None).model_copy(update={"noise": None})
    live = LiveOdometry(bare)
    live.step(step(0.01, [0.02, 0.01, -0.02]))
    assert np.linalg.eigvalsh(live.covariance)[0] > 0


def test_a_calibration_with_numbers_on_a_bound_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    origin = Provenance(
        dataset="d", dataset_hash="0", calibrator="crs", seed=1, cost="final_pose", box="row", outcome="converged"
    )
    LiveOdometry(calibration().model_copy(update={"provenance": origin}))
    assert not caplog.messages
    LiveOdometry(calibration().model_copy(update={"provenance": origin.model_copy(update={"on_bounds": ("m23",)})}))
    assert "m23 on a bound of the box, of which no variance is known: covariances are too small" in caplog.text


@pytest.mark.parametrize("heading", [0.7, -2.0])
def test_the_covariance_of_a_path_that_begins_turned_is_turned_with_it(heading: float) -> None:
    path, turn = drive(4.0), rotation(heading)
    straight, turned = LiveOdometry(path.calibration), LiveOdometry(path.calibration)
    turned.resume(np.array([0.0, 0.0, heading]), np.zeros((3, 3)))
    for live in (straight, turned):
        driven(live, path.angles, np.full(400, 0.01))
    expected = turn @ straight.covariance @ turn.T
    np.testing.assert_allclose(turned.covariance, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_a_filter_takes_the_error_of_the_matrix_as_noise_that_lasts_a_second() -> None:
    """What the matrix adds to the twist's variances, v2 for a velocity, adds v2 x 1 s x dt to the motion's."""
    exact, doubtful = LiveOdometry(calibration(deviation=None)), LiveOdometry(calibration(deviation=2e-3))
    quiet, noisy = (live.step(step(0.02, [0.01, -0.02, 0.005])) for live in (exact, doubtful))
    along_x, along_y, turning = np.diag(doubtful.twist_covariance - exact.twist_covariance)
    assert min(along_x, along_y, turning) > 0
    added = noisy.position_variance - quiet.position_variance, noisy.heading_variance - quiet.heading_variance
    assert added == pytest.approx((0.02 * (along_x + along_y) / 2, 0.02 * turning))


def test_held_steering_angles_make_a_way_as_doubtful_in_many_steps_as_in_one() -> None:
    """The angle is wrong in the same way all along, so that deviations add up, and not variances."""
    once, often = (LiveOdometry(calibration(deviation=None)) for _ in range(2))
    whole = [once.step(replace(step(1.0, [1.0, 1.0, 1.0], blind=1.0), held=True))]
    parts = [often.step(replace(step(0.1, [0.1, 0.1, 0.1], blind=0.1), held=True)) for _ in range(10)]
    for name in ("position_variance", "heading_variance"):
        assert sum(getattr(part, name) for part in parts) == pytest.approx(getattr(whole[0], name))
