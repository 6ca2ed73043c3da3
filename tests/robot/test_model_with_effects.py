"""A model with effects: how they act together, what the reference reports, what a recording has to hold."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from effect_samples import MOTION, PERIOD, REFERENCE, a_drive, a_term, mixture, model, term
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02
from timing import processor_time

from omnibench.errors import DataError, PluginError
from omnibench.registry import effects
from omnibench.robot.effects.effect import MotionEffect, Stage, Values, make_term
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, OdometryBatch, Path, WheelLog, advance
from omnibench.robot.signals import Signals, signals_of

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


@pytest.mark.parametrize("integration", BOTH)
@given(seed=seeds, samples=st.integers(1, 60), stamps=st.integers(2, 12))
def test_a_path_is_the_odometry_of_its_motions(integration: Integration, seed: int, samples: int, stamps: int) -> None:
    log = a_drive(seed, samples, stamps=stamps)
    durations = np.diff(log.times, prepend=0.0)[:, None]
    moved = log.rates @ APR_02.inverse_kinematic_matrix.T * durations
    expected = OdometryBatch([log], integration).poses(APR_02.inverse_kinematic_matrix[None])[0]
    found = Path(log.times, log.start, moved, integration).poses(log.stamps)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_a_path_stays_at_its_ends() -> None:
    path = Path(np.array([1.0]), np.array([1.0, 2.0, 0.5]), np.array([[0.3, 0.0, 1.0]]), "arc", np.array([[0.1, 0.2]]))
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
        assert isinstance(each.effect, MotionEffect)
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

    def test_effects_of_the_reference_do_nothing_to_the_odometry(self) -> None:
        log = a_drive(1)
        chosen = model(*(a_term(name, APR_02) for name in REFERENCE))
        np.testing.assert_array_equal(chosen.poses([log])[0], model().poses([log])[0])

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

    def test_before_its_start_the_robot_stood(self) -> None:
        log = a_drive(2)
        (found,) = model(term("reference_time_offset", tau=0.2)).reported([replace(log, stamps=np.array([0.0, 0.19]))])
        np.testing.assert_array_equal(found, [log.start, log.start])

    def test_after_the_last_sample_the_robot_goes_on_at_its_last_mean_rate(self) -> None:
        log = replace(a_drive(3), stamps=np.zeros(1))
        end, mean = log.times[-1], log.rates[-5:].mean(axis=0)
        for integration in BOTH:
            chosen = model(term("reference_time_offset", tau=-0.15), integration=integration)
            (found,) = chosen.reported([replace(log, stamps=np.array([end]))])
            (last,) = chosen.poses([replace(log, stamps=np.array([end]))])
            expected = advance(last[0], chosen.matrix @ mean * 0.15, integration)
            np.testing.assert_allclose(found[0], expected, rtol=0, atol=1e-12)

    def test_motion_effects_go_on_too(self) -> None:
        log = a_drive(6)
        chosen = model(term("reference_time_offset", tau=-0.15), a_term("wheel_eccentricity", APR_02))
        (found,) = chosen.reported([replace(log, stamps=log.times[-1:])])
        assert log.wheel_angles is not None
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
    "wheel_eccentricity": ("wheel_angles", "absolute wheel angles (phi_* in wheels), which were not recorded"),
    "roller_ripple": ("wheel_angles", "absolute wheel angles (phi_* in wheels), which were not recorded"),
    "thermal_radius_drift": ("started_at", "the time since the session's start (started_at in trajectories)"),
    "tyre_wear": ("session", "the session's name (session in trajectories), which is not known"),
}


@pytest.mark.parametrize("name", MISSING)
def test_a_recording_that_lacks_what_an_effect_needs_is_refused_in_one_line(name: str) -> None:
    field, words = MISSING[name]
    unknown: dict[str, Any] = {field: None}
    chosen, log = model(a_term(name, APR_02)), replace(a_drive(1), **unknown)
    for method in (chosen.poses, chosen.reported):
        with pytest.raises(DataError) as refusal:
            method([log])
        assert str(refusal.value).startswith(f"effect {name!r} needs {words}")
        assert str(refusal.value).endswith("; record it, or take the effect out of the calibration")


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


def test_ten_times_as_many_runs_with_two_effects_take_about_ten_times_as_long() -> None:
    times = 0.01 * np.arange(1, 601)
    angles = np.cumsum(np.ones((600, 3)) * 0.01, axis=0)
    run = WheelLog(times, np.ones((600, 3)), np.zeros(3), times[24::25], angles, 0.0, "morning")
    chosen = model(a_term("wheel_eccentricity", APR_02), a_term("load_transfer", APR_02))
    chosen.reported([run])
    few, many = (processor_time(lambda count=count: chosen.reported([run] * count)) for count in (18, 180))
    assert many < 20 * few
