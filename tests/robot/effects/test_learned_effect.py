"""The effect ``learned``: its network, its weights in the file, and how it fades."""

from __future__ import annotations

import base64
from pathlib import Path

import numpy as np
import pytest
from effect_samples import EVERY, PERIOD, a_drive, at_every_sample, streamed
from learned_samples import a_learned_calibration, a_network, a_weighted_term, an_extension
from sample_robots import APR_02

from omnibench.errors import DataError
from omnibench.robot.calibration import EffectTerm, extended_model, read_calibration, write_calibration
from omnibench.robot.effects.effect import MOST_BYTES, decode_weights, make_term
from omnibench.robot.effects.learned import unpacked
from omnibench.robot.export.c_header import c_header
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.robot.signals import signals_of

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
    assert f"learned (share 1, {len(PACKED)} weights)" in " ".join(c_header(calibration, "apr")[1])
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
    "infinity": (as_text(np.append(PACKED[:-1], np.inf)), "NaN or infinity"),
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
    with pytest.raises(DataError, match=f"^c.yaml: effect 'learned'.*{words}") as refused:
        make_term("learned", {"share": 1.0}, APR_02, "c.yaml", **({} if text is None else {"weights": text}))
    assert "\n" not in str(refused.value)


def test_the_largest_weights_are_read_and_packed_ones_unpacked_as_they_were() -> None:
    assert len(decode_weights(as_text(np.zeros(MOST_BYTES // 4)))) == MOST_BYTES // 4
    network = a_network(APR_02, alone=True, sizes=(7, 3))
    again = unpacked(network.packed(), 3, "here")
    assert again.alone
    np.testing.assert_array_equal(again.packed(), network.packed())


def test_weights_of_an_effect_that_has_none_are_refused() -> None:
    with pytest.raises(DataError, match="heading_drift"):
        make_term("heading_drift", {"b": 0.0}, APR_02, weights=as_text(PACKED))
