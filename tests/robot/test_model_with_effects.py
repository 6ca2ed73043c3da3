"""A model with effects, ``learned`` among them: in a batch and in a stream, from which signals, and how it fades."""

import base64
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import refused
from driven_path import DrivenPath
from effect_samples import (
    EVERY,
    MOTION,
    PERIOD,
    REFERENCE,
    ROBOTS,
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
from hypothesis.extra.numpy import arrays
from learned_samples import a_learned_calibration, a_network, a_weighted_term, an_extension
from sample_robots import APR_02

from omnibench.errors import DataError, PluginError
from omnibench.registry import effects
from omnibench.robot import corrections
from omnibench.robot.calibration import EffectTerm, extended_model, read_calibration, write_calibration
from omnibench.robot.corrections import needs_of
from omnibench.robot.effects.effect import MOST_BYTES, MotionEffect, Stage, Values, decode_weights, make_term
from omnibench.robot.effects.learned import unpacked
from omnibench.robot.export.formats import export_calibration
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, OdometryStream, WheelLog, advance
from omnibench.robot.signals import Signals, SignalStream, signals_of, smoothing_share

BOTH: tuple[Integration, ...] = ("euler", "arc")
seeds = st.integers(0, 2**32 - 1)


@given(seed=seeds)
def test_the_order_of_effects_does_not_matter(seed: int) -> None:
    log, terms = a_drive(seed), mixture(seed, APR_02)
    shuffled = [terms[index] for index in np.random.default_rng(seed + 1).permutation(len(terms))]
    one, other = (model(*each).poses([log])[0] for each in (terms, shuffled))
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)


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
    signals = signals_of(log, APR_02, chosen.matrix, PERIOD, needs_of(terms))
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


@given(seed=seeds)
def test_without_effects_of_the_reference_the_odometry_is_reported(seed: int) -> None:
    log = a_drive(seed)
    late = replace(log, stamps=np.append(log.stamps, log.times[-1] + 1.0))
    chosen = model(*mixture(seed, APR_02))
    np.testing.assert_array_equal(chosen.reported([late])[0], chosen.poses([late])[0])


def test_effects_of_the_reference_do_nothing_to_the_odometry_and_before_its_start_the_robot_stood() -> None:
    log = a_drive(1)
    chosen = model(*(a_term(name, APR_02) for name in REFERENCE))
    np.testing.assert_array_equal(chosen.poses([log])[0], model().poses([log])[0])
    early = replace(log, stamps=np.array([0.0, 0.19]))
    (found,) = model(term("reference_time_offset", tau=0.2)).reported([early])
    np.testing.assert_array_equal(found, [log.start, log.start])


@given(seed=seeds, tau=st.floats(-0.2, 0.2), latency=st.floats(-0.1, 0.1))
def test_a_pose_is_the_odometrys_when_it_was_taken(seed: int, tau: float, latency: float) -> None:
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
def test_after_the_last_sample_the_robot_goes_on_at_its_last_mean_rate(integration: Integration) -> None:
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


def test_a_later_effect_works_on_what_an_earlier_one_reports() -> None:
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


def test_without_a_session_it_is_one_that_no_calibration_knows() -> None:
    worn, plain = model(term("tyre_wear", radius_morning=0.01)).stream(), model().stream()
    np.testing.assert_allclose(worn.drive(TENTHS, 0.1), plain.drive(TENTHS, 0.1), rtol=0, atol=1e-15)


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


# The effect ``learned``: its network, its weights in the file, and how it fades.

NEAR = [[0.3, 0.0, 0.0], [0.0, 0.0, 1.0]]  # m/s, m/s, rad/s
FAR = [[20.0, 0.0, 0.0]]  # so fast that all else is near to it


def model_of(robot: Robot, driven: list[list[float]] | None, **given: object) -> OdometryModel:
    extension = an_extension(robot, driven or FAR, **given)
    if driven is None:
        extension = extension.model_copy(update={"driven": None, "plain": None, "covariance": None})
    return extended_model(robot, robot.inverse_kinematic_matrix, "arc", PERIOD, extension)


def constant(rates: Array, samples: int = 50) -> WheelLog:
    times = PERIOD * np.arange(1, samples + 1)
    return WheelLog(times, np.tile(rates, (samples, 1)), np.zeros(3), times)


def driven_to(model: OdometryModel, twist: list[float]) -> Array:
    """Pose after one second of a twist."""
    rates = np.linalg.lstsq(model.matrix, np.array(twist), rcond=None)[0]
    return model.poses([constant(rates)])[0][-1]


@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize("driven", [None, NEAR])
@pytest.mark.parametrize("robot", EVERY)
def test_a_stream_gives_the_poses_of_the_batch(robot: str, driven: list[list[float]] | None, alone: bool) -> None:
    model = model_of(EVERY[robot], driven, alone=alone, sizes=(16, 5))
    log = at_every_sample(a_drive(1, 200, EVERY[robot]))
    together = model.poses([log])[0]
    np.testing.assert_allclose(streamed(model.stream(log.start), log), together, rtol=0, atol=1e-12)
    plain = OdometryModel.of_design(EVERY[robot], "arc").poses([log])[0]
    assert np.abs(together - plain).max() > 1e-5


@pytest.mark.parametrize("alone", [False, True])
def test_a_robot_that_stands_stays_exactly_where_it_is(alone: bool) -> None:
    model = model_of(APR_02, NEAR, alone=alone, sizes=(16, 16))
    assert not model.poses([constant(np.zeros(3))])[0].any()
    assert not model.stream().drive(np.zeros(3), PERIOD).any()


def test_a_network_alone_takes_the_place_of_the_matrix() -> None:
    network, term = a_network(APR_02, alone=True), a_weighted_term(APR_02, alone=True).term(APR_02)
    log = a_drive(3)
    signals = signals_of(log, APR_02, APR_02.inverse_kinematic_matrix, PERIOD)
    added = term.effect.correction(signals, term.values)
    np.testing.assert_allclose(signals.twists + added, network.twists(log.rates), rtol=1e-5, atol=1e-8)


def test_the_network_is_its_equation() -> None:
    network = a_network(APR_02, sizes=(4, 2))
    (first, bias), (second, other) = network.layers
    u = np.array([1.0, -2.0, 0.5])
    hidden = np.tanh(first @ (u / network.inputs) + bias) - np.tanh(bias)
    expected = network.outputs * (network.last @ (np.tanh(second @ hidden + other) - np.tanh(other)))
    np.testing.assert_allclose(network.twists(u[None])[0], expected, rtol=1e-12)


def test_far_from_the_training_domain_the_matrix_alone_is_left() -> None:
    model, plain = model_of(APR_02, NEAR), OdometryModel.of_design(APR_02, "arc")
    far = [0.0, 0.5, 0.0]
    np.testing.assert_allclose(driven_to(model, far), driven_to(plain, far), rtol=0, atol=1e-12)
    assert np.abs(driven_to(model_of(APR_02, None), far) - driven_to(plain, far)).max() > 1e-3


@pytest.mark.parametrize("share", [1.0, 0.25])
def test_half_a_width_outside_half_of_the_network_is_left(share: float) -> None:
    plain, unfaded = OdometryModel.of_design(APR_02, "arc"), model_of(APR_02, None, share=share)
    size = np.linalg.norm([0.0, 0.0, APR_02.reach * 2])  # of the largest driven motion
    model = model_of(APR_02, [[0.0, 0.0, 2.0]], share=share)
    twist = [0.0, 0.0, 2.0 + 1.5 * 0.15 * size / APR_02.reach]
    whole = driven_to(unfaded, twist)[2] - driven_to(plain, twist)[2]
    assert (driven_to(model, twist)[2] - driven_to(plain, twist)[2]) / whole == pytest.approx(0.5, abs=1e-6)


def test_a_file_holds_the_weights_and_a_c_header_says_that_they_are_left_out(tmp_path: Path) -> None:
    calibration = a_learned_calibration(APR_02, NEAR, PERIOD)
    write_calibration(calibration, tmp_path / "c.yaml")
    again = read_calibration(tmp_path / "c.yaml")
    assert again == calibration
    log = a_drive(4)
    np.testing.assert_array_equal(again.model.poses([log])[0], calibration.model.poses([log])[0])
    assert f"learned (share 1, {len(PACKED)} weights)" in " ".join(export_calibration(calibration, "c_header").warnings)
    assert "weights" not in EffectTerm(name="heading_drift", parameters={"b": 0.0}).model_dump()


def as_text(numbers: Array) -> str:
    return base64.b64encode(np.asarray(numbers, "<f4").tobytes()).decode()


PACKED = a_network(APR_02).packed()

REFUSED = {
    "no base64": ("***", "base64"),
    "empty": ("", "0 bytes"),
    "half a number": (base64.b64encode(b"abc").decode(), "3 bytes"),
    "too long": (as_text(np.zeros(MOST_BYTES // 4 + 1)), "48 KiB"),
    "NaN": (as_text(np.append(PACKED[:-1], np.nan)), "NaN or infinity"),
    "another version": (as_text(np.append(2.0, PACKED[1:])), "version 1"),
    "other wheels": (as_text(a_network(EVERY["four"]).packed()), "4 drive signals"),
    "no layers": (as_text(np.array([1.0, 0, 0, 3])), "no layers"),
    "a layer of no size": (as_text(np.array([1.0, 0, 1, 3, 0])), "no layers"),
    "one too few": (as_text(PACKED[:-1]), f"{len(PACKED) - 1} numbers"),
    "a scale of 0": (as_text(np.where(np.arange(len(PACKED)) == 5, 0, PACKED)), "scales"),
    "none": (None, "missing"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_weights_that_are_none_are_refused_in_one_line(what: str) -> None:
    text, words = REFUSED[what]
    with refused(DataError, match=f"^c.yaml: effect 'learned'.*{words}"):
        make_term("learned", {"share": 1.0}, APR_02, "c.yaml", **({} if text is None else {"weights": text}))


def test_the_largest_weights_are_read_and_packed_ones_unpacked_as_they_were() -> None:
    assert len(decode_weights(as_text(np.zeros(MOST_BYTES // 4)))) == MOST_BYTES // 4
    network = a_network(APR_02, alone=True, sizes=(7, 3))
    again = unpacked(network.packed(), 3, "here")
    assert again.alone
    np.testing.assert_array_equal(again.packed(), network.packed())


def test_weights_of_an_effect_that_has_none_are_refused() -> None:
    with pytest.raises(DataError, match="heading_drift"):
        make_term("heading_drift", {"b": 0.0}, APR_02, weights=as_text(PACKED))


# Motions that a model was fitted to, which others are far from all of them, and corrections that fade there.

DISTANCE = 0.195  # m, of the APR-02's wheels
FORWARDS = np.array([0.2, 0.0, 0.0])
SIDEWAYS = np.array([0.0, 0.2, 0.0])
ON_THE_SPOT = np.array([0.0, 0.0, 1.0])
STANDING = np.zeros(3)

_twists = st.integers(1, 30).flatmap(lambda count: arrays(float, (count, 3), elements=st.floats(-1, 1)))


def known(*motions: Array) -> corrections.TrainingDomain:
    return corrections.TrainingDomain(APR_02, motions)


def at_wheels(robot: Robot, motions: Array) -> Array:
    return motions * [1.0, 1.0, np.mean([wheel.distance for wheel in robot.wheels])]


@given(_twists, st.sampled_from(sorted(ROBOTS)))
def test_a_few_representatives_are_near_every_motion(motions: Array, robot: str) -> None:
    few = corrections.representatives(ROBOTS[robot], motions)
    own, kept = at_wheels(ROBOTS[robot], motions), at_wheels(ROBOTS[robot], few)
    away = np.linalg.norm(own[:, None] - kept, axis=2).min(axis=1)
    largest = np.linalg.norm(own, axis=1).max()
    assert away.max() <= (1 + np.sqrt(3)) * 0.05 * largest + 1e-9  # a cell of the grid, and one more step
    apart = np.linalg.norm(kept[:, None] - kept, axis=2) + np.diag(np.full(len(kept), np.inf))
    assert apart.min() > 0.05 * largest


@given(_twists, st.sampled_from(sorted(ROBOTS)))
def test_motions_of_a_kind_are_near_its_first_one_and_those_are_far_from_each_other(motions: Array, robot: str) -> None:
    spreads = np.abs(motions[::-1]) / 2
    own = np.hstack([at_wheels(ROBOTS[robot], each) for each in (motions, spreads)])
    kinds = corrections.kinds_of_motion(ROBOTS[robot], motions, spreads)
    near = 0.15 * np.linalg.norm(own, axis=1).max()
    firsts = np.array([own[kinds == kind][0] for kind in range(kinds.max() + 1)])
    assert (np.linalg.norm(own - firsts[kinds], axis=1) <= near + 1e-9).all()
    apart = np.linalg.norm(firsts[:, None] - firsts, axis=2) + np.diag(np.full(len(firsts), np.inf))
    assert apart.min() >= near - 1e-9


def test_the_directions_and_turns_of_a_flower_are_kinds_of_their_own() -> None:
    flower = [[0.2 * np.cos(angle), 0.2 * np.sin(angle), turn]
              for angle in np.radians(np.arange(0, 360, 30)) for turn in (-0.35, 0.0, 0.35)]  # fmt: skip
    assert len(set(corrections.kinds_of_motion(APR_02, np.array(flower), np.zeros((36, 3))).tolist())) == 36


def test_paths_that_end_where_they_began_are_of_as_many_kinds_as_they_swing_differently() -> None:
    swings = np.array([[0.2, 0.0, 0.0], [0.2, 0.0, 0.01], [0.0, 0.0, 1.0], [0.2, 0.0, 1.0]])
    assert corrections.kinds_of_motion(APR_02, 1e-4 * swings, swings).tolist() == [0, 0, 1, 2]


@given(_twists, st.sampled_from(sorted(ROBOTS)))
def test_what_was_driven_is_never_new(motions: Array, robot: str) -> None:
    few = corrections.TrainingDomain(ROBOTS[robot], corrections.representatives(ROBOTS[robot], motions))
    assert not few.outside(motions).any()


@given(_twists, _twists, st.sampled_from(sorted(ROBOTS)))
def test_a_live_node_judges_one_motion_as_all_are_judged_together(driven: Array, others: Array, robot: str) -> None:
    chosen = corrections.TrainingDomain(ROBOTS[robot], driven)
    assert [chosen.is_outside(motion) for motion in others] == chosen.outside(others).tolist()


def test_another_direction_or_speed_is_new_and_what_is_near_or_stands_is_not() -> None:
    new = [SIDEWAYS, ON_THE_SPOT, 1.3 * FORWARDS, -FORWARDS, 0.5 * (FORWARDS + SIDEWAYS)]
    near = [FORWARDS, 1.1 * FORWARDS, FORWARDS + 0.1 * SIDEWAYS, STANDING, 0.01 * SIDEWAYS]
    assert [known(FORWARDS).is_outside(motion) for motion in (*new, *near)] == [True] * 5 + [False] * 5


def test_turning_counts_as_what_it_moves_at_the_wheels() -> None:
    driven, more = known(FORWARDS, ON_THE_SPOT), ON_THE_SPOT * 0.2 / DISTANCE
    assert not driven.is_outside(ON_THE_SPOT + 0.1 * more)
    assert driven.is_outside(ON_THE_SPOT + 0.2 * more)


def test_new_motions_in_passing_do_not_make_a_run_new() -> None:
    passing = np.array([*[FORWARDS] * 97, *[SIDEWAYS] * 3])
    staying = np.array([*[FORWARDS] * 90, *[SIDEWAYS] * 10])
    assert not known(FORWARDS).outside_in_run(passing).any()
    assert known(FORWARDS).outside_in_run(staying).tolist() == [False] * 90 + [True] * 10


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        (ON_THE_SPOT, "turning on the spot"),
        (SIDEWAYS, "driving straight at 0.20 m/s"),
        (np.array([0.3, 0.4, -1.0]), "turning while driving at 0.50 m/s"),
    ],
)
def test_new_motions_are_told_in_words_with_their_share(motion: Array, words: str) -> None:
    run = np.array([*[FORWARDS] * 3, motion])
    assert corrections.extrapolated_share(APR_02, FORWARDS[None], run) == (0.25, words)
    assert corrections.extrapolated_share(APR_02, FORWARDS[None], run[:3]) == (0.0, "")


def test_motions_of_a_run_are_its_twists_smoothed() -> None:
    matrix = APR_02.inverse_kinematic_matrix
    twist = np.array([0.1, -0.2, 0.3])
    times = 0.01 * np.arange(1, 201)
    rates = np.linalg.solve(matrix, twist) + np.where(np.arange(200) % 2, 1.0, -1.0)[:, None]
    found = corrections.motions_of(matrix, times, rates)
    assert len(found) > 10
    assert np.abs(found - twist).max() < 0.05 * np.abs(rates @ matrix.T - twist).max()
    shorter = np.tile(np.linalg.solve(matrix, twist), (5, 1))  # than the smoothing
    np.testing.assert_allclose(corrections.motions_of(matrix, times[:5], shorter), twist[None], atol=1e-12)


def test_it_is_told_what_is_not_known() -> None:
    assert corrections.extrapolation_consequence(["a"]).startswith("a is not known")
    assert "a, b are not known to hold there, fade" in corrections.extrapolation_consequence(
        ["a", "b", "a"], fading=True
    )


GROWN = term("speed_dependent_radius", k=0.01)
PLAIN = 0.9 * APR_02.inverse_kinematic_matrix


def unsure(deviation: float) -> OdometryModel:
    """A model with a radius that grows with the rate, fitted to driving forwards; deviation of its k, s/rad."""
    matrix, covariance = APR_02.inverse_kinematic_matrix, np.zeros((10, 10))
    covariance[9, 9] = deviation**2
    return replace(model(GROWN), fade=corrections.Fade(APR_02, matrix - PLAIN, FORWARDS[None], [GROWN], covariance))


def moved(chosen: OdometryModel, twist: Array) -> Array:
    """The pose after two seconds of a twist by the design values."""
    times = 0.1 * np.arange(1, 21)
    rates = np.tile(np.linalg.solve(APR_02.inverse_kinematic_matrix, twist), (20, 1))
    return chosen.poses([WheelLog(times, rates, np.zeros(3), times)])[0][-1]


def by_plain_matrix(twist: Array) -> Array:
    return moved(OdometryModel(APR_02, PLAIN, "arc"), twist)


@given(seed=st.integers(0, 2**32 - 1), robot=st.sampled_from(sorted(EVERY)), samples=st.integers(2, 60))
def test_a_stream_fades_as_a_batch_does(seed: int, robot: str, samples: int) -> None:
    log, rng = at_every_sample(a_drive(seed, samples, EVERY[robot])), np.random.default_rng(seed)
    terms = mixture(seed, EVERY[robot])
    whole = model(*terms, robot=EVERY[robot])
    shapes = [{each.name for each in one.effect.parameters(EVERY[robot]) if each.choices} for one in terms]
    values = [0.0 if name in of_term else value for one, of_term in zip(terms, shapes, strict=True)
              for name, value in one.values.items()]  # fmt: skip
    deviations = np.append(np.full(whole.matrix.size, 1e-4), 0.2 * np.abs(values))
    root = deviations[:, None] * rng.normal(size=(len(deviations), 3))
    driven = corrections.representatives(EVERY[robot], corrections.motions_of(whole.matrix, log.times, log.signals)[:1])
    change = 1e-3 * rng.normal(size=whole.matrix.shape)
    chosen = replace(whole, fade=corrections.Fade(EVERY[robot], change, driven, terms, root @ root.T))
    stream = chosen.stream(log.start, log.session, log.started_at or 0.0)
    np.testing.assert_allclose(streamed(stream, log), chosen.poses([log])[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("deviation", [0.001, 0.1])
def test_corrections_are_whole_where_the_robot_was_driven(deviation: float) -> None:
    np.testing.assert_array_equal(moved(unsure(deviation), FORWARDS), moved(model(GROWN), FORWARDS))


def test_never_driven_motions_keep_what_is_known_well_and_are_left_the_plain_matrix_elsewhere() -> None:
    np.testing.assert_allclose(moved(unsure(1e-6), SIDEWAYS), moved(model(GROWN), SIDEWAYS), rtol=1e-6)
    np.testing.assert_allclose(moved(unsure(0.1), SIDEWAYS), by_plain_matrix(SIDEWAYS), atol=1e-12)


def test_between_these_a_correction_fades_the_farther_it_is_from_what_was_driven() -> None:
    angles, shares = np.radians([0, 10, 20, 30, 40]), []
    for angle in angles:
        twist = 0.2 * np.array([np.cos(angle), np.sin(angle), 0.0])
        part, whole, none = moved(unsure(0.02), twist), moved(model(GROWN), twist), by_plain_matrix(twist)
        shares.append(np.linalg.norm(part - none) / np.linalg.norm(whole - none))
    assert shares[0] == pytest.approx(1.0)
    assert (np.diff(shares[1:]) < 0).all()
    assert shares[-1] > 0


def test_the_matrix_errs_along_with_the_parameters_that_it_was_fitted_with() -> None:
    """A parameter that a change of the matrix undoes says nothing wrong, however little it is known."""
    scale = term("sample_period_scale", s=0.02)  # every motion is 2 % longer
    matrix, covariance = APR_02.inverse_kinematic_matrix, np.zeros((10, 10))
    along = np.append(-matrix.ravel() / 1.02, 1.0)  # what leaves the motion as it is
    covariance[:] = 0.1**2 * np.outer(along, along)
    fade = corrections.Fade(APR_02, matrix - PLAIN, FORWARDS[None], [scale], covariance)
    kept = moved(replace(model(scale), fade=fade), SIDEWAYS)
    np.testing.assert_allclose(kept, moved(model(scale), SIDEWAYS), rtol=1e-2)
