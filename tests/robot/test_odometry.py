"""Odometry: Eq. (1) and (2), exact arcs, batches, streams, derivatives, of arrays, and poses of the plane."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sample_robots import APR_02
from wheeled_samples import DIFF, TRICYCLE, driven

import omnibench
from omnibench.errors import OmnibenchError
from omnibench.robot.kinematics import (
    Array,
    compose,
    correction,
    interpolated,
    moved_to,
    published_matrix,
    relative,
    unit_twist,
    wrapped,
)
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, OdometryBatch, OdometryStream, WheelLog, advance

BOTH: tuple[Integration, ...] = ("euler", "arc")
MATRIX = published_matrix("palacin2023_eq8")


def a_log(seed: int, samples: int = 40, stamps: int = 7, wheels: int = 3) -> WheelLog:
    """Random rates, irregular samples, and stamps anywhere from 0 on, some of them within one sample."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.002, 0.2, samples))
    inside = np.sort(rng.uniform(0, times[-1], stamps - 2))
    return WheelLog(
        times=times,
        rates=rng.normal(0, 4, (samples, wheels)),
        start=rng.normal(0, 2, 3),
        stamps=np.concatenate([[0.0], inside, times[-1:]]),
    )


def at_the_end(log: WheelLog) -> WheelLog:
    return replace(log, stamps=log.times[-1:])


def constant_twist(twist: Array, times: Array, stamps: Array, start: Array | None = None) -> WheelLog:
    rates = np.tile(np.linalg.solve(MATRIX, twist), (len(times), 1))
    return WheelLog(times, rates, np.zeros(3) if start is None else start, stamps)


def on_the_circle(twist: Array, stamps: Array, start: Array) -> Array:
    """Poses (S, 3) of a robot that keeps its twist."""
    vx, vy, w = twist
    turned = w * stamps
    # The integral of exp(i w t); its limit for w = 0 is t.
    arc = stamps if w == 0 else np.expm1(1j * turned) / (1j * w)
    path = (vx + 1j * vy) * arc * np.exp(1j * start[2])
    return np.column_stack([start[0] + path.real, start[1] + path.imag, start[2] + turned])


def streamed(log: WheelLog, matrix: Array, integration: Integration) -> Array:
    """Poses (S, 3) at the stamps, sample by sample; a stamp within a sample is a shorter sample."""
    poses = []
    for stamp in log.stamps:
        stream, before = OdometryStream(matrix, integration, log.start), 0.0
        for time, rates in zip(log.times, log.rates, strict=True):
            stream.drive(rates * (min(time, stamp) - before))
            before = min(time, stamp)
        poses.append(stream.pose)
    return np.array(poses)


def eq_1_and_2(log: WheelLog, matrix: Array) -> Array:
    """The pose (3,) after the last sample, as the article writes it."""
    pose, before = log.start, 0.0
    for time, rates in zip(log.times, log.rates, strict=True):
        cosine, sine = math.cos(pose[2]), math.sin(pose[2])
        rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        pose = pose + (time - before) * rotation @ matrix @ rates
        before = time
    return pose


def test_euler_is_eq_1_and_2_as_written() -> None:
    log = at_the_end(a_log(1))
    (pose,) = OdometryBatch([log], "euler").poses(MATRIX[None])[0]
    np.testing.assert_allclose(pose, eq_1_and_2(log, MATRIX), rtol=0, atol=1e-12)


@pytest.mark.parametrize("integration", BOTH)
@given(
    seed=st.integers(0, 2**32 - 1),
    samples=st.integers(1, 60),
    stamps=st.integers(2, 12),
    wheels=st.sampled_from([3, 4, 6]),
)
def test_a_batch_equals_a_stream(integration: Integration, seed: int, samples: int, stamps: int, wheels: int) -> None:
    log = a_log(seed, samples, stamps, wheels)
    matrix = MATRIX if wheels == 3 else np.random.default_rng(5).normal(0, 0.1, (3, wheels))
    poses = OdometryBatch([log], integration).poses(matrix[None])[0]
    np.testing.assert_allclose(poses, streamed(log, matrix, integration), rtol=0, atol=1e-12)


@pytest.mark.parametrize("integration", BOTH)
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0, 1))
def test_one_stamp_within_the_last_sample_equals_a_stream(integration: Integration, seed: int, share: float) -> None:
    log = a_log(seed, samples=12)
    log = replace(log, stamps=log.times[-2:-1] + share * np.diff(log.times[-2:]))
    poses = OdometryBatch([log], integration).poses(MATRIX[None])[0]
    np.testing.assert_allclose(poses, streamed(log, MATRIX, integration), rtol=0, atol=1e-12)


@given(
    velocity=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
    turn=st.floats(-3, 3).filter(lambda w: w == 0 or abs(w) > 1e-100),
    seed=st.integers(0, 2**32 - 1),
    samples=st.integers(1, 30),
)
def test_arcs_lie_on_the_circle_whatever_the_sampling(
    velocity: tuple[float, float], turn: float, seed: int, samples: int
) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.01, 0.5, samples))
    stamps = np.sort(rng.uniform(0, times[-1], 5))
    start, twist = rng.normal(0, 1, 3), np.array([*velocity, turn])
    poses = OdometryBatch([constant_twist(twist, times, stamps, start)], "arc").poses(MATRIX[None])[0]
    np.testing.assert_allclose(poses, on_the_circle(twist, stamps, start), rtol=0, atol=1e-12)


def test_arcs_pass_smoothly_from_turning_to_straight() -> None:
    times = np.arange(0.1, 3.05, 0.1)
    logs = [constant_twist(np.array([0.3, 0.1, w]), times, times[-1:]) for w in (0.0, 1e-300, 1e-16, 1e-10)]
    poses = OdometryBatch(logs, "arc").poses(MATRIX[None])[0]
    np.testing.assert_allclose(poses, np.tile(poses[0], (4, 1)), rtol=0, atol=1e-9)


@pytest.mark.parametrize("integration", BOTH)
@pytest.mark.parametrize("final_only", [True, False])
def test_trajectories_of_any_lengths_share_a_batch(integration: Integration, final_only: bool) -> None:
    logs = [a_log(seed, samples, stamps=3 + seed) for seed, samples in enumerate((3, 200, 1, 57))]
    logs = [at_the_end(log) for log in logs] if final_only else logs
    together = OdometryBatch(logs, integration)
    poses = together.poses(MATRIX[None])[0]
    for index, log in enumerate(logs):
        alone = OdometryBatch([log], integration).poses(MATRIX[None])[0]
        np.testing.assert_allclose(poses[together.trajectory == index], alone, rtol=0, atol=1e-12)


@pytest.mark.parametrize("integration", BOTH)
@pytest.mark.parametrize("final_only", [True, False])
def test_a_population_is_evaluated_as_one_at_a_time(integration: Integration, final_only: bool) -> None:
    logs = [a_log(seed, samples=900) for seed in range(8)]
    batch = OdometryBatch([at_the_end(log) for log in logs] if final_only else logs, integration)
    population = MATRIX * np.random.default_rng(0).uniform(0.9, 1.1, (50, 3, 3))  # several blocks
    one_at_a_time = np.concatenate([batch.poses(matrix[None]) for matrix in population])
    np.testing.assert_allclose(batch.poses(population), one_at_a_time, rtol=0, atol=1e-12)


@pytest.mark.parametrize("integration", BOTH)
def test_a_candidate_that_is_nan_leaves_the_others_alone(integration: Integration) -> None:
    batch = OdometryBatch([at_the_end(a_log(seed)) for seed in range(4)], integration)
    population = np.array([MATRIX, np.full((3, 3), np.nan), MATRIX])
    with np.errstate(all="ignore"):
        first, spoilt, last = batch.poses(population)
    assert np.isnan(spoilt).all()
    np.testing.assert_allclose(first, batch.poses(MATRIX[None])[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(last, first, rtol=0, atol=1e-12)


@pytest.mark.parametrize("integration", BOTH)
@pytest.mark.parametrize("final_only", [True, False])
def test_a_stamp_after_the_last_sample_has_the_pose_at_its_end(integration: Integration, final_only: bool) -> None:
    log = a_log(6)
    late = replace(log, stamps=log.times[-1:] + 5.0 if final_only else np.append(log.stamps, log.times[-1] + 5.0))
    pose = OdometryBatch([late], integration).poses(MATRIX[None])[0, -1]
    np.testing.assert_allclose(pose, streamed(at_the_end(log), MATRIX, integration)[0], rtol=0, atol=1e-12)


def test_a_stamp_at_zero_has_the_start_pose_and_driven_angles_add_up_to_each_stamp() -> None:
    log = a_log(7)
    batch = OdometryBatch([log], "arc")
    np.testing.assert_array_equal(batch.poses(MATRIX[None])[0, 0], log.start)
    within = np.clip(log.stamps[:, None] - np.append(0.0, log.times[:-1]), 0.0, np.diff(log.times, prepend=0.0))
    np.testing.assert_allclose(batch.driven, within @ log.rates, rtol=0, atol=1e-12)


@pytest.mark.parametrize("integration", BOTH)
@pytest.mark.parametrize("final_only", [True, False])
@pytest.mark.parametrize("wheels", [3, 4])
def test_the_jacobian_equals_central_differences(integration: Integration, final_only: bool, wheels: int) -> None:
    logs = [a_log(seed, samples=30, wheels=wheels) for seed in range(3)]
    logs[1] = replace(logs[1], rates=np.zeros((30, wheels)))  # the arc of a robot at rest has its own branch
    batch = OdometryBatch([at_the_end(log) for log in logs] if final_only else logs, integration)
    matrix = np.random.default_rng(1).normal(0, 0.1, (3, wheels))
    step = 1e-5
    shifts = step * np.eye(3 * wheels).reshape(-1, 3, wheels)
    differences = (batch.poses(matrix + shifts) - batch.poses(matrix - shifts)) / (2 * step)
    expected = np.moveaxis(differences, 0, -1).reshape(-1, 3, 3, wheels)
    np.testing.assert_allclose(batch.jacobian(matrix), expected, rtol=0, atol=1e-7)


@given(turn=st.floats(1e-9, 0.1))
def test_the_jacobian_of_an_arc_has_no_seam_near_straight_runs(turn: float) -> None:
    # sinc's slope is a series below half turns of 1e-2 rad and a quotient above.
    log = WheelLog(np.array([1.0]), np.linalg.solve(MATRIX, [0.3, 0.1, turn])[None], np.zeros(3), np.array([1.0]))
    batch = OdometryBatch([log], "arc")
    step = 1e-4
    shift = np.zeros((3, 3))
    shift[2, 0] = step
    expected = (batch.poses((MATRIX + shift)[None]) - batch.poses((MATRIX - shift)[None]))[0, 0] / (2 * step)
    np.testing.assert_allclose(batch.jacobian(MATRIX)[0, :, 2, 0], expected, rtol=0, atol=1e-7)


def test_positions_are_linear_in_rows_1_and_2_once_the_headings_are_known() -> None:
    logs = [a_log(seed, samples) for seed, samples in ((1, 40), (2, 7))]
    batch = OdometryBatch(logs, "euler")
    headings = [
        log.start[2] + np.append(0.0, np.cumsum(log.rates @ MATRIX[2] * np.diff(log.times, prepend=0.0))[:-1])
        for log in logs
    ]
    path = batch.position_design(headings) @ (MATRIX[0] + 1j * MATRIX[1])
    starts = np.array([log.start for log in logs])[batch.trajectory]
    positions = starts[:, :2] + np.column_stack([path.real, path.imag])
    np.testing.assert_allclose(positions, batch.poses(MATRIX[None])[0, :, :2], rtol=0, atol=1e-12)


def test_a_models_stream_starts_at_the_origin_unless_told_and_does_not_change_the_start() -> None:
    model, start = OdometryModel.of_design(APR_02, "arc"), np.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(model.stream().pose, np.zeros(3))
    stream = model.stream(start)
    np.testing.assert_array_equal(stream.pose, [1.0, 2.0, 3.0])
    stream.drive(np.ones(3))
    np.testing.assert_array_equal(start, [1.0, 2.0, 3.0])


T = np.arange(1, 51) * 0.02


@given(forward=st.floats(-10, 10), turn=st.floats(-10, 10))
def test_the_end_of_an_arc_is_where_its_radius_says(forward: float, turn: float) -> None:
    rates = np.tile([forward + turn, forward - turn], (50, 1))  # right, left
    x, y, heading = omnibench.odometry(DIFF, T, rates)[-1]
    way, angle = 0.042 * forward, 0.042 * turn / 0.1
    chord = np.sinc(angle / 2 / np.pi) * way  # over 1 s
    np.testing.assert_allclose(
        [x, y, heading], [chord * np.cos(angle / 2), chord * np.sin(angle / 2), angle], atol=1e-9
    )


def test_it_is_the_odometry_of_data_sets() -> None:
    dataset = driven(TRICYCLE)
    run = dataset.trajectories[0]
    (wanted,) = OdometryModel.of_design(TRICYCLE, "arc").poses([run.log(run.pose_times)])
    given_arrays = {"steering": run.steering, "start": run.start, "stamps": run.pose_times}
    assert run.steering is not None
    np.testing.assert_array_equal(omnibench.odometry(TRICYCLE, run.times, run.rates, **given_arrays), wanted)


def test_a_calibration_brings_its_matrix_and_integration() -> None:
    run = driven(DIFF).trajectories[0]
    calibration = omnibench.calibrate(driven(DIFF), integration="euler").calibration
    (wanted,) = calibration.model.poses([run.log(run.times)])
    np.testing.assert_array_equal(omnibench.odometry(calibration, run.times, run.rates, start=run.start), wanted)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"rates": np.ones((50, 3))}, r"rates .*\(50, 2\): .*right, left"),
        ({"rates": np.ones(50)}, r"rates .*\(50,\)"),
        ({"rates": [["fast"] * 2] * 50}, "rates"),
        ({"rates": np.r_[np.ones((3, 2)), np.full((47, 2), np.nan)]}, "rates, row 4"),
        ({"times": T - 0.02}, "times, row 1"),
        ({"times": T[::-1]}, "times, row 2"),
        ({"stamps": [-1.0]}, "stamps, row 1"),
        ({"start": [0, 0]}, r"start .*\(2,\)"),
        ({"robot": "robot.yaml"}, "'robot.yaml'"),
        ({"robot": TRICYCLE, "rates": np.ones((50, 1))}, "steering .*front"),
    ],
)
def test_what_does_not_fit_is_named(given: dict[str, Any], message: str) -> None:
    call: dict[str, Any] = {"robot": DIFF, "times": T, "rates": np.ones((50, 2))} | given
    with pytest.raises(OmnibenchError, match=message):
        omnibench.odometry(**call)


POSES = arrays(float, 3, elements=st.floats(-10, 10))


@given(POSES, POSES)
def test_the_relative_pose_leads_from_the_first_to_the_second(first: np.ndarray, second: np.ndarray) -> None:
    np.testing.assert_allclose(compose(first, relative(first, second)), second, atol=1e-9)


@given(POSES, POSES, POSES)
def test_composing_is_associative(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    np.testing.assert_allclose(compose(compose(a, b), c), compose(a, compose(b, c)), atol=1e-9)


@given(POSES, POSES)
def test_the_correction_takes_odom_to_the_map(in_map: np.ndarray, in_odom: np.ndarray) -> None:
    np.testing.assert_allclose(compose(correction(in_map, in_odom), in_odom), in_map, atol=1e-9)


@given(POSES, arrays(float, (4, 3), elements=st.floats(-10, 10)))
def test_a_path_that_is_moved_begins_there_and_keeps_its_shape(start: np.ndarray, path: np.ndarray) -> None:
    moved = moved_to(start, path)
    np.testing.assert_allclose(moved[0], start, atol=1e-9)
    for one, other in ((0, 1), (1, 3)):
        np.testing.assert_allclose(relative(moved[one], moved[other]), relative(path[one], path[other]), atol=1e-9)


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-np.pi, np.pi))
def test_the_twist_of_a_motion_makes_it_along_an_arc(x: float, y: float, turn: float) -> None:
    motion = np.array([x, y, turn])
    np.testing.assert_allclose(advance(np.zeros(3), unit_twist(motion), "arc"), motion, atol=1e-12)
    np.testing.assert_allclose(unit_twist(np.stack([motion, motion]))[1], unit_twist(motion), atol=1e-12)


@given(st.floats(-20, 20))
def test_the_twist_of_whole_turns_is_finite(turn: float) -> None:
    assert np.isfinite(unit_twist(np.array([1.0, -1.0, turn]))).all()


def test_rows_are_interpolated_by_straight_lines_and_held_beyond_their_stamps() -> None:
    rows = np.array([[0.0, 1.0, 0.0], [2.0, 1.0, -4.0]])
    found = interpolated(np.array([-1.0, 1.5, 9.0]), np.array([1.0, 2.0]), rows)
    np.testing.assert_array_equal(found, [[0.0, 1.0, 0.0], [1.0, 1.0, -2.0], [2.0, 1.0, -4.0]])


def test_wrapped_angles_differ_by_whole_turns() -> None:
    np.testing.assert_allclose(wrapped(np.array([0.1, np.pi, -np.pi, 7.0])), [0.1, -np.pi, -np.pi, 7.0 - 2 * np.pi])
