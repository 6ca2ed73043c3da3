"""A model with effects: how they act together, in a batch and in a stream, from which signals, and what they need."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from effect_samples import (
    APPLIED,
    EVERY,
    EVERY_MOTION,
    MOTION,
    PERIOD,
    REFERENCE,
    ROBOTS,
    SMOOTH_MOTION,
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

from omnibench.errors import DataError, PluginError
from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Stage, Values, make_term
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import DrivenPath, Integration, OdometryBatch, OdometryStream, WheelLog, advance
from omnibench.robot.signals import Signals, SignalStream, signals_of, smoothing_share

BOTH: tuple[Integration, ...] = ("euler", "arc")
seeds = st.integers(0, 2**32 - 1)


@given(seed=seeds)
def test_the_order_of_effects_does_not_matter(seed: int) -> None:
    log, terms = a_drive(seed), mixture(seed, APR_02)
    shuffled = [terms[index] for index in np.random.default_rng(seed + 1).permutation(len(terms))]
    one, other = (model(*each).poses([log])[0] for each in (terms, shuffled))
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)


@pytest.mark.parametrize("integration", BOTH)
@given(seed=seeds)
def test_effects_of_size_zero_change_nothing(integration: Integration, seed: int) -> None:
    log = a_drive(seed)
    names = [*MOTION, *REFERENCE]
    zero = model(*(a_term(name, APR_02, seed, scale=0.0) for name in names), integration=integration)
    expected = OdometryBatch([log], integration).poses(zero.matrix[None])[0]
    np.testing.assert_allclose(zero.poses([log])[0], expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(zero.reported([log])[0], expected, rtol=0, atol=1e-12)


def test_a_path_stays_at_its_ends() -> None:
    path = DrivenPath(
        np.array([1.0]), np.array([1.0, 2.0, 0.5]), np.array([[0.3, 0.0, 1.0]]), "arc", np.array([[0.1, 0.2]])
    )
    ends = path.poses(np.array([0.0, 1.0]))
    np.testing.assert_array_equal(path.poses(np.array([7.0, -3.0])), ends[::-1])
    np.testing.assert_array_equal(ends[0], [1.0, 2.0, 0.5])


@pytest.mark.parametrize("integration", BOTH)
@given(seed=seeds)
def test_a_stamp_within_a_sample_has_its_share_of_the_sample(integration: Integration, seed: int) -> None:
    log, terms = a_drive(seed, 5), mixture(seed, APR_02)
    chosen = model(*terms, integration=integration)
    begin, end = log.times[2], log.times[3]
    durations = np.diff(log.times)
    before, within = chosen.poses([replace(log, stamps=np.array([begin, begin + 0.3 * (end - begin)]))])[0]
    signals = signals_of(log, APR_02, chosen.matrix, PERIOD)
    rates, twist, drift = log.rates[3].copy(), np.zeros(3), np.zeros(2)
    for each in terms:
        added = each.effect.correction(signals, each.values)[3]
        if each.effect.stage == "body":
            twist += added
        elif each.effect.stage == "world":
            drift += added
        else:
            rates += added
    passed = 0.3 * durations[2]
    expected = advance(before, (chosen.matrix @ rates + twist) * passed, integration)
    np.testing.assert_allclose(within, expected + np.append(drift * passed, 0.0), rtol=0, atol=1e-12)


def test_a_model_gives_the_poses_of_each_log_by_itself() -> None:
    logs = [a_drive(1, 30), a_drive(2, 7, stamps=3)]
    chosen = model(*mixture(3, APR_02), term("reference_time_offset", tau=0.05))
    for method in (chosen.poses, chosen.reported):
        together = method(logs)
        for log, found in zip(logs, together, strict=True):
            np.testing.assert_allclose(found, method([log])[0], rtol=0, atol=1e-13)


class TestReported:
    @given(seed=seeds)
    def test_without_effects_of_the_reference_it_is_the_odometry(self, seed: int) -> None:
        log = a_drive(seed)
        late = replace(log, stamps=np.append(log.stamps, log.times[-1] + 1.0))
        chosen = model(*mixture(seed, APR_02))
        np.testing.assert_array_equal(chosen.reported([late])[0], chosen.poses([late])[0])

    def test_effects_of_the_reference_do_nothing_to_the_odometry_and_before_its_start_the_robot_stood(self) -> None:
        log = a_drive(1)
        chosen = model(*(a_term(name, APR_02) for name in REFERENCE))
        np.testing.assert_array_equal(chosen.poses([log])[0], model().poses([log])[0])
        early = replace(log, stamps=np.array([0.0, 0.19]))
        (found,) = model(term("reference_time_offset", tau=0.2)).reported([early])
        np.testing.assert_array_equal(found, [log.start, log.start])

    @given(seed=seeds, tau=st.floats(-0.2, 0.2), latency=st.floats(-0.1, 0.1))
    def test_a_pose_is_the_odometrys_when_it_was_taken(self, seed: int, tau: float, latency: float) -> None:
        log = a_drive(seed, 60)
        stamps = log.stamps[(log.stamps > 0.35) & (log.stamps < log.times[-1] - 0.35)]
        chosen = model(*mixture(seed, APR_02))
        delayed = replace(
            chosen, terms=(*chosen.terms, term("reference_time_offset", tau=tau), term("heading_latency", tau=latency))
        )
        (found,) = delayed.reported([replace(log, stamps=stamps)])
        (positions,) = chosen.poses([replace(log, stamps=stamps - tau)])
        (headings,) = chosen.poses([replace(log, stamps=stamps - tau - latency)])
        np.testing.assert_allclose(found, np.column_stack([positions[:, :2], headings[:, 2]]), rtol=0, atol=1e-12)

    @pytest.mark.parametrize("integration", BOTH)
    def test_after_the_last_sample_the_robot_goes_on_at_its_last_mean_rate(self, integration: Integration) -> None:
        log = a_drive(6)
        eccentric = a_term("wheel_eccentricity", APR_02)
        chosen = model(term("reference_time_offset", tau=-0.15), eccentric, integration=integration)
        (found,) = chosen.reported([replace(log, stamps=log.times[-1:])])
        mean = log.rates[-5:].mean(axis=0)
        longer = replace(
            log,
            times=np.append(log.times, log.times[-1] + 0.15),
            rates=np.vstack([log.rates, mean]),
            wheel_angles=np.vstack([log.wheel_angles, log.wheel_angles[-1] + 0.15 * mean]),
            stamps=log.times[-1:] + 0.15,
        )
        np.testing.assert_allclose(found, chosen.poses([longer])[0], rtol=0, atol=1e-12)

    def test_a_later_effect_works_on_what_an_earlier_one_reports(self) -> None:
        log = a_drive(7)
        arm, scale = term("lidar_lever_arm", x=0.05, y=0.02), term("reference_scale", s=0.01)
        (first,) = model(arm).reported([log])
        (both,) = model(arm, scale).reported([log])
        expected = log.start[:2] + 1.01 * (first[:, :2] - log.start[:2])
        np.testing.assert_allclose(both[:, :2], expected, rtol=0, atol=1e-12)


MISSING = {
    "wheel_eccentricity": ("wheel_angles", "phi_*"),
    "roller_ripple": ("wheel_angles", "phi_*"),
    "thermal_radius_drift": ("started_at", "started_at"),
    "tyre_wear": ("session", "session"),
}


@pytest.mark.parametrize("name", MISSING)
def test_a_recording_that_lacks_what_an_effect_needs_is_refused(name: str) -> None:
    field, column = MISSING[name]
    chosen, log = model(a_term(name, APR_02)), replace(a_drive(1), **{field: None})
    for method in (chosen.poses, chosen.reported):
        with pytest.raises(DataError, match=f"effect '{name}' needs .*{re.escape(column)}"):
            method([log])


def test_effects_that_need_nothing_run_on_the_barest_log() -> None:
    bare = replace(a_drive(1), wheel_angles=None, started_at=None, session=None)
    names = [name for name in (*MOTION, *REFERENCE) if name not in MISSING]
    assert np.isfinite(model(*(a_term(name, APR_02) for name in names)).reported([bare])[0]).all()


def test_actuator_effects_do_nothing_to_odometry() -> None:
    log = a_drive(1)
    told = model(term("motor_lag", tau=0.1), term("motor_gain", g=0.05), term("motor_dead_band", band=0.1))
    np.testing.assert_array_equal(told.reported([log])[0], model().poses([log])[0])
    np.testing.assert_array_equal(told.stream().drive(np.ones(3), 0.1), model().stream().drive(np.ones(3), 0.1))


def test_a_model_with_effects_needs_the_sample_period() -> None:
    with pytest.raises(ValueError, match="needs the sample period"):
        OdometryModel(APR_02, APR_02.inverse_kinematic_matrix, "arc", (term("heading_drift", b=0.001),))


@pytest.mark.parametrize(("stage", "shape"), [("wheel", (40, 1)), ("body", (40, 1)), ("world", (40, 3))])
def test_a_correction_of_another_shape_is_not_spread_over_wheels(stage: Stage, shape: tuple[int, int]) -> None:
    @effects.register("careless")
    class Careless(MotionEffect):
        """Gives one column."""

        physics, source, shows_in = "None.", "nobody", "command"

        def correction(self, signals: Signals, values: Values) -> Array:  # noqa: ARG002
            return np.zeros((len(signals.rates), shape[1]))

    Careless.stage = stage
    with pytest.raises(PluginError, match=r"effect 'careless': its correction has shape \(40, \d\), expected \(40, \d"):
        model(make_term("careless", {}, APR_02)).poses([a_drive(1)])


TENTHS = np.full(3, 0.1)  # rad


def stream_of(given_model: OdometryModel, log: WheelLog) -> OdometryStream:
    return given_model.stream(log.start, log.session, log.started_at or 0.0)


@pytest.mark.parametrize("integration", BOTH)
@pytest.mark.parametrize("name", [*EVERY_MOTION, *SMOOTH_MOTION])
@given(seed=seeds, data=st.data(), samples=st.integers(1, 60))
def test_a_stream_equals_a_batch_with_every_effect(
    name: str, integration: Integration, seed: int, data: st.DataObject, samples: int
) -> None:
    robots = ROBOTS if name in SMOOTH_MOTION else [robot for applied, robot in APPLIED if applied == name]
    robot = EVERY[data.draw(st.sampled_from(sorted(robots)))]
    log = at_every_sample(a_drive(seed, samples, robot))
    chosen = model(a_term(name, robot, seed), robot=robot, integration=integration)
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


MATRIX = APR_02.inverse_kinematic_matrix


def of(log: WheelLog) -> Signals:
    return signals_of(log, APR_02, MATRIX, PERIOD)


def test_times_and_angles_are_those_in_the_middle_of_the_sample() -> None:
    log = WheelLog(
        times=np.array([1.0, 3.0]),
        rates=np.array([[1.0, 2.0, 3.0], [-1.0, 0.0, 0.5]]),
        start=np.zeros(3),
        stamps=np.array([3.0]),
        wheel_angles=np.array([[11.0, 12.0, 13.0], [9.0, 12.0, 14.0]]),
        started_at=100.0,
        session="morning",
    )
    found = of(log)
    np.testing.assert_array_equal(found.durations, [1.0, 2.0])
    np.testing.assert_array_equal(found.elapsed, [0.5, 2.0])
    np.testing.assert_array_equal(found.session_time, [100.5, 102.0])
    np.testing.assert_array_equal(found.wheel_angles, [[10.5, 11.0, 11.5], [10.0, 12.0, 13.5]])
    assert found.session == "morning"


def test_what_was_not_recorded_is_not_made_up() -> None:
    found = of(replace(a_drive(1), wheel_angles=None, started_at=None, session=None))
    assert (found.wheel_angles, found.session_time, found.session) == (None, None, None)


def test_an_acceleration_is_the_slope_of_the_smoothed_twist() -> None:
    log, share = a_drive(2), 1 - math.exp(-PERIOD / 0.05)
    found, smoothed = of(log), np.zeros(3)
    for sample, (rates, duration) in enumerate(zip(log.rates, np.diff(log.times, prepend=0.0), strict=True)):
        before, smoothed = smoothed, smoothed + share * (MATRIX @ rates - smoothed)
        np.testing.assert_allclose(found.accelerations[sample], (smoothed - before) / duration, rtol=0, atol=1e-11)


def test_a_steady_acceleration_is_seen_as_it_is() -> None:
    times = PERIOD * np.arange(1, 101)
    direction = np.linalg.solve(MATRIX, [0.5, -0.2, 1.0])
    found = of(WheelLog(times, (times - PERIOD / 2)[:, None] * direction, np.zeros(3), times[-1:]))
    np.testing.assert_allclose(found.accelerations[-1], [0.5, -0.2, 1.0], rtol=1e-9)


def test_the_way_is_counted_from_the_last_rest() -> None:
    forward = np.linalg.solve(MATRIX, [0.5, 0.0, 0.0])
    rates = np.array([forward, forward, 0 * forward, 9e-4 * np.ones(3), forward, -forward])
    found = of(WheelLog(np.arange(1.0, 7.0), rates, np.zeros(3), np.ones(1)))
    np.testing.assert_allclose(found.travelled, [0.25, 0.75, 0.0, 0.0, 0.25, 0.75], rtol=0, atol=1e-12)


@pytest.mark.parametrize("period", [1e-6, 0.01, 0.05, 10.0])
def test_smoothing_takes_a_share_that_depends_on_the_period(period: float) -> None:
    assert smoothing_share(period) == pytest.approx(1 - math.exp(-period / 0.05), rel=1e-9)


def test_a_stream_counts_angles_that_it_is_not_told_from_zero_or_the_last_told_on() -> None:
    stream = SignalStream(APR_02, MATRIX, PERIOD)
    for expected in ([0.5, -1.0, 0.0], [1.5, -3.0, 0.0]):
        found = stream.next(np.array([1.0, -2.0, 0.0]), 1.0)
        np.testing.assert_array_equal(found.wheel_angles, [expected])
    stream.next(np.ones(3), 1.0, np.array([7.0, 8.0, 9.0]))
    np.testing.assert_array_equal(stream.next(np.ones(3), 1.0).wheel_angles, [[7.5, 8.5, 9.5]])
