"""A stream with effects: the numbers of the batch, one sample at a time."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from effect_samples import (
    APPLIED,
    EVERY,
    EVERY_MOTION,
    a_drive,
    a_term,
    at_every_sample,
    mixture,
    model,
    streamed,
    term,
)
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02

from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, OdometryStream, WheelLog, advance

BOTH: tuple[Integration, ...] = ("euler", "arc")
TENTHS = np.full(3, 0.1)  # rad
seeds = st.integers(0, 2**32 - 1)


def stream_of(given_model: OdometryModel, log: WheelLog) -> OdometryStream:
    return given_model.stream(log.start, log.session, log.started_at or 0.0)


@pytest.mark.parametrize("integration", BOTH)
@pytest.mark.parametrize("name", EVERY_MOTION)
@given(seed=seeds, data=st.data(), samples=st.integers(1, 60))
def test_a_stream_equals_a_batch_with_every_effect(
    name: str, integration: Integration, seed: int, data: st.DataObject, samples: int
) -> None:
    robot = EVERY[data.draw(st.sampled_from([robot for applied, robot in APPLIED if applied == name]))]
    log = at_every_sample(a_drive(seed, samples, robot))
    chosen = model(a_term(name, robot, seed), robot=robot, integration=integration)
    np.testing.assert_allclose(streamed(stream_of(chosen, log), log), chosen.poses([log])[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("integration", BOTH)
@given(seed=seeds, robot=st.sampled_from(sorted(EVERY)), samples=st.integers(1, 60))
def test_a_stream_equals_a_batch_with_any_mixture_of_effects(
    integration: Integration, seed: int, robot: str, samples: int
) -> None:
    log = at_every_sample(a_drive(seed, samples, EVERY[robot]))
    chosen = model(*mixture(seed, EVERY[robot]), robot=EVERY[robot], integration=integration)
    np.testing.assert_allclose(streamed(stream_of(chosen, log), log), chosen.poses([log])[0], rtol=0, atol=1e-12)


@given(seed=seeds)
def test_moved_leads_from_pose_to_pose(seed: int) -> None:
    log = a_drive(seed, 30)
    stream = stream_of(model(*mixture(seed, APR_02), term("floor_drift", dx=0.02, dy=-0.01)), log)
    stream.frame_heading = 0.7
    for rates, duration in zip(log.rates, np.diff(log.times, prepend=0.0), strict=True):
        before = stream.pose
        after = stream.drive(rates * duration, duration)
        np.testing.assert_allclose(advance(before, stream.moved, "arc"), after, rtol=0, atol=1e-12)


def test_the_floor_drifts_in_the_references_frame() -> None:
    log = at_every_sample(a_drive(4))
    chosen = model(term("floor_drift", dx=0.02, dy=0.01))
    in_map = chosen.poses([log])[0]
    stream = stream_of(chosen, replace(log, start=np.zeros(3)))
    stream.frame_heading = log.start[2]
    found = streamed(stream, log)
    cosine, sine = math.cos(log.start[2]), math.sin(log.start[2])
    turned = found[:, :2] @ np.array([[cosine, sine], [-sine, cosine]])
    np.testing.assert_allclose(turned + log.start[:2], in_map[:, :2], rtol=0, atol=1e-12)


def test_angles_that_are_not_told_are_counted_from_zero() -> None:
    chosen, log = model(a_term("wheel_eccentricity", APR_02)), at_every_sample(a_drive(5))
    counted = replace(log, wheel_angles=np.cumsum(log.rates * np.diff(log.times, prepend=0.0)[:, None], axis=0))
    stream = stream_of(chosen, log)
    for rates, duration in zip(log.rates, np.diff(log.times, prepend=0.0), strict=True):
        stream.drive(rates * duration, duration)
    np.testing.assert_allclose(stream.pose, chosen.poses([counted])[0][-1], rtol=0, atol=1e-12)


def test_without_a_session_it_is_one_that_no_calibration_knows() -> None:
    worn, plain = model(term("tyre_wear", radius_morning=0.01)).stream(), model().stream()
    np.testing.assert_allclose(worn.drive(TENTHS, 0.1), plain.drive(TENTHS, 0.1), rtol=0, atol=1e-15)


def test_session_time_begins_where_it_is_told() -> None:
    warm = model(term("thermal_radius_drift", k=1e-5))
    late = warm.stream(session_time=1000.0)
    late.drive(TENTHS, 0.1)
    np.testing.assert_allclose(late.moved, 1.010_000_5 * (warm.matrix @ np.ones(3)) * 0.1, rtol=0, atol=1e-14)


def test_a_motion_that_takes_no_time_is_the_matrix_alone() -> None:
    stream = model(term("heading_drift", b=0.005), term("acceleration_slip", k=0.1)).stream()
    stream.drive(TENTHS, 0.1)
    stream.drive(np.array([0.1, 0.2, 0.3]), 0.0)
    np.testing.assert_allclose(stream.moved, APR_02.inverse_kinematic_matrix @ [0.1, 0.2, 0.3], rtol=1e-15)
    assert np.isfinite(stream.drive(TENTHS, 0.1)).all()


def test_effects_ask_for_the_duration() -> None:
    with pytest.raises(ValueError, match="needs the duration of every sample"):
        model(term("heading_drift", b=0.005)).stream().drive(np.ones(3))


def test_without_effects_of_motion_it_needs_no_duration() -> None:
    for chosen in (model(), model(term("lidar_yaw", beta=0.01))):
        np.testing.assert_array_equal(chosen.stream().drive(np.ones(3)), model().stream().drive(np.ones(3), 1.0))
