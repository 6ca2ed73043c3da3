"""Poses in TUM format, headings from quaternions, counters that begin again, and references that are odometry."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sample_robots import APR_02, WHEELED

from omnibench.data import counters
from omnibench.data.dataset import Trajectory, make_dataset
from omnibench.data.importers.tum import planar_headings, read_tum, write_tum
from omnibench.data.spoiled_references import follows_the_wheels
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array, CarDrive, Robot


def write(folder: Path, *rows: str) -> Path:
    file = folder / "run_poses.tum"
    file.write_text("\n".join(rows) + "\n")
    return file


def test_comments_and_blank_lines_are_skipped(tmp_path: Path) -> None:
    track = read_tum(write(tmp_path, "# timestamp tx ty tz qx qy qz qw", "", "10.5 1 2 9 0 0 0 1  # start"))
    assert track.times.tolist() == [10.5]
    assert track.poses.tolist() == [[1.0, 2.0, 0.0]]


@given(arrays(float, 3, elements=st.floats(-0.1, 0.1)), st.floats(-3, 3))
def test_small_roll_and_pitch_hardly_change_the_heading(
    tmp_path_factory: pytest.TempPathFactory, angles: np.ndarray, heading: float
) -> None:
    roll, pitch = angles[0] / 2, angles[1] / 2
    cy, sy, cp, sp, cr, sr = (f(a) for a in (heading / 2, pitch, roll) for f in (math.cos, math.sin))
    quaternion = (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
    folder = tmp_path_factory.mktemp("tum")
    track = read_tum(write(folder, "0 0 0 0 " + " ".join(map(repr, quaternion))))
    assert track.poses[0, 2] == pytest.approx(heading, abs=1e-9)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("1 0 0 0 0 0 1", r"row 2 \(line 3\): qw is missing"),
        ("1 0 0 x 0 0 0 1", r"row 2 \(line 3\): tz is 'x', expected a number"),
        ("1 0 nan 0 0 0 0 1", r"row 2 \(line 3\): ty is nan; remove"),
        ("0.5 0 0 0 0 0 0 1", r"row 2 \(line 3\): timestamp is repeated: 0\.5 after 0\.5"),
        ("0.4 0 0 0 0 0 0 1", r"row 2 \(line 3\): timestamp goes backwards: 0\.4 after 0\.5"),
        ("1 0 0 0 0 0 0 2", r"row 2 \(line 3\): quaternion has length 2, expected 1"),
        ("1 0 0 0 0.7071 0 0 0.7071", r"row 2 \(line 3\): pose is tilted by 90 degrees; .*body \(z up\)"),
    ],
)
def test_a_malformed_row_is_named(tmp_path: Path, row: str, message: str) -> None:
    file = write(tmp_path, "# poses", "0.5 0 0 0 0 0 0 1", row)
    with pytest.raises(DataError, match=r"run_poses\.tum, " + message):
        read_tum(file)


def test_a_file_without_poses_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="it has no rows; a row is timestamp tx ty tz qx qy qz qw"):
        read_tum(write(tmp_path, "# nothing"))
    with pytest.raises(DataError, match=r"none\.tum: no such file"):
        read_tum(tmp_path / "none.tum")


def test_poses_that_were_written_are_read_again(tmp_path: Path) -> None:
    times, poses = np.array([0.0, 0.1, 0.25]), np.array([[0, 0, 0], [0.1, -0.2, 3.1], [1.5, 2, -3.0]])
    write_tum(tmp_path / "run.tum", times, poses)
    track = read_tum(tmp_path / "run.tum")
    np.testing.assert_allclose(track.times, times, atol=1e-9)
    np.testing.assert_allclose(track.poses, poses, atol=1e-8)


def test_poses_that_no_tum_file_can_hold_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"times have shape \(2,\), poses \(3, 3\)"):
        write_tum(tmp_path / "run.tum", [0, 1], np.zeros((3, 3)))
    with pytest.raises(DataError, match="times, row 2: it is 0; times increase"):
        write_tum(tmp_path / "run.tum", [0, 0], np.zeros((2, 3)))
    assert not list(tmp_path.iterdir())


@given(
    heading=st.floats(-math.pi + 1e-9, math.pi - 1e-9), length=st.floats(0.991, 1.009), sign=st.sampled_from([-1, 1])
)
def test_neither_sign_nor_a_length_near_one_changes_the_heading(heading: float, length: float, sign: int) -> None:
    quaternion = sign * length * np.array([0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)])
    found = planar_headings(quaternion[None])
    assert found.headings[0] == pytest.approx(heading, abs=1e-12)
    assert not found.flawed[0]


@pytest.mark.filterwarnings("error")
@given(arrays(float, (3, 4), elements=st.floats(allow_nan=True, allow_infinity=True)))
def test_any_numbers_give_headings_or_a_flaw_in_words(quaternions: np.ndarray) -> None:
    found = planar_headings(quaternions)
    assert np.isfinite(found.headings).all()
    for index in np.flatnonzero(found.flawed):
        assert "expected 1" in found.flaw(index) or "tilted" in found.flaw(index)


def test_each_flaw_is_found_among_good_ones() -> None:
    found = planar_headings(np.array([[0, 0, 0, 1], [0, 0, 0, 0], [0.6, 0, 0, 0.8], [0, 0, 1, 0], [0, 0, np.nan, 1.0]]))
    assert found.flawed.tolist() == [False, True, True, False, True]
    assert found.flaw(1) == "quaternion has length 0, expected 1"
    assert found.flaw(2) == "pose is tilted by 74 degrees; give poses of the robot's body (z up)"


def drive(seed: int, longest: float) -> Array:
    """Counts of a wheel that turns both ways, in steps of at most ``longest``."""
    speeds = np.convolve(np.random.default_rng(seed).normal(size=400), np.ones(30), "same")
    return np.cumsum(np.round(longest * speeds / np.abs(speeds).max()))


def recognised(counts: Array) -> float | None:
    """The range of a counter of ticks whose wheel's turn is far longer."""
    return counters.counter_range([counts], 1e300, True)


@given(st.integers(0, 10**6), st.integers(8, 48), st.floats(0.01, 0.24), st.booleans(), st.floats(0, 1))
def test_a_counter_of_any_bits_is_counted_on(seed: int, bits: int, longest: float, signed: bool, start: float) -> None:
    wrap = 2.0**bits
    counts = drive(seed, longest * wrap) + np.round(start * wrap)
    shown = counts % wrap - (wrap / 2 if signed else 0)
    wrapped = bool((np.abs(np.diff(shown)) > wrap / 2).any())
    assert recognised(shown) == (wrap if wrapped else None)
    np.testing.assert_array_equal(np.diff(counters.counted_on(shown, wrap)), np.diff(counts))


def late_drive(seed: int, late: int) -> tuple[Array, Array, Array]:
    """Times, and true and shown counts of a wheel of 200,000 ticks a second by a driver whose register has 16 bits.

    Every so often it reads a quarter of a second late, so that the step loses a turn of the register.
    """
    rng = np.random.default_rng(seed)
    times = 0.04 * np.arange(2000) + rng.uniform(0, 0.01, 2000)
    counts = np.round(200_000 * (times + 0.2 * np.sin(times)) + rng.normal(0, 500, 2000))
    for begin in rng.choice(np.arange(100, 1900, 60), late, replace=False):
        counts[begin : begin + 5] = counts[begin - 1]
    steps = np.diff(counts)
    shown = np.concatenate([counts[:1], counts[0] + np.cumsum(steps - 2**16 * np.round(steps / 2**16))])
    return times, counts, shown


@given(st.integers(0, 10**6), st.integers(1, 5))
def test_turns_that_a_register_lost_are_restored(seed: int, late: int) -> None:
    times, counts, shown = late_drive(seed, late)
    lost = not np.array_equal(counts, shown)
    assert counters.lost_register(shown, times, counters.POWERS_OF_TWO) == (2**16 if lost else None)
    np.testing.assert_array_equal(counters.turns_restored(shown, times, 2**16), counts)


@given(st.integers(0, 10**6), st.integers(8, 20), st.floats(0.01, 0.24))
def test_a_wheel_that_turns_back_has_lost_no_turns(seed: int, bits: int, longest: float) -> None:
    counts = drive(seed, longest * 2.0**bits)
    assert counters.lost_register(counts, 0.05 * np.arange(len(counts)), counters.POWERS_OF_TWO) is None


@given(st.integers(0, 10**6), st.integers(300, 10**6))
def test_a_counter_that_is_set_to_zero_does_not_begin_again(seed: int, before: int) -> None:
    counts = np.abs(drive(seed, 3.0))
    assert recognised(np.concatenate([before + counts, counts])) in (None, power_near(before))


def power_near(number: int) -> float | None:
    """The power of two that a step of this many cannot be told from, if there is one."""
    power = 2.0 ** round(np.log2(number))
    return power if abs(power - number) < 0.05 * power else None


@pytest.mark.parametrize("before", [8_000, 8_100])
def test_a_counter_that_is_set_to_zero_while_its_wheel_turns_has_lost_no_turn(before: int) -> None:
    counts = np.append(np.arange(0, before, 290), np.arange(0, 30_000, 290)).astype(float)
    assert counters.lost_register(counts, 0.03 * np.arange(len(counts)), counters.POWERS_OF_TWO) is None


def test_steps_of_a_third_of_the_range_are_not_unambiguous() -> None:
    assert recognised(np.arange(0, 40000.0, 85) % 256) is None


@pytest.mark.parametrize("start", [0.0, 100.0, 8191.0])
def test_an_absolute_encoder_that_counts_from_zero_is_read_about_zero(start: float) -> None:
    angle = 2000 * np.sin(np.linspace(0, 20, 300) + start)
    np.testing.assert_allclose(counters.about_zero(angle % 8192, 8192), angle, atol=1e-9)


def test_an_absolute_encoder_that_counts_both_ways_stays_as_it_is() -> None:
    angle = np.linspace(-3, 3.1, 50)
    np.testing.assert_array_equal(counters.about_zero(angle, 2 * np.pi), angle)


def test_a_potentiometer_that_passes_half_a_turn_makes_no_jump() -> None:
    shown = 512 + 400 * np.sin(np.linspace(0, 6, 100))
    np.testing.assert_array_equal(counters.about_zero(shown, 1229), shown)


def test_only_readings_logged_again_in_the_middle_of_a_drive_are_repeated() -> None:
    steps = np.array([0, 0, 100, 120, 0, 110, 100, 0, 0, 100, 100, 0, 0])
    angles = np.append(0, np.cumsum(steps)).astype(float)[:, None]
    times = np.arange(len(angles), dtype=float)
    assert np.flatnonzero(counters.repeated_readings(times, angles, None)).tolist() == [5]
    steers = np.zeros_like(angles)
    steers[5:] = 0.1  # the steering encoder was read anew
    assert not counters.repeated_readings(times, angles, steers).any()
    rest = times + 3 * (times >= 5)
    assert not counters.repeated_readings(rest, angles, None).any()


def test_a_wheel_that_creeps_from_tick_to_tick_repeats_nothing() -> None:
    angles = np.floor(np.arange(100) * 0.7)[:, None]
    assert not counters.repeated_readings(np.arange(100.0), angles, None).any()


PERIOD, SAMPLES = 0.02, 3000  # s: a minute of driving
EVERY = 3  # samples from one reference pose to the next
each_robot = pytest.mark.parametrize("robot", [APR_02, *WHEELED], ids=lambda robot: robot.name)


def driven(robot: Robot) -> tuple[Array, Array, Array]:
    """Rates (F, N), steering angles (F, S) at the samples' ends, and twists (F, 3) of a smooth drive from rest."""
    times = PERIOD * np.arange(1, SAMPLES + 1)
    ahead, turn = robot.motions[0], robot.motions[-1]
    speed = 0.3 * np.minimum(times, 1.0)
    bend = np.sin(times / 2) + 0.4 * np.sin(1.3 * times + 1)
    twists = speed[:, None] * (ahead + 0.9 * bend[:, None] * turn)
    if len(robot.motions) == 3:
        twists += speed[:, None] * 0.3 * np.cos(times / 3)[:, None] * robot.motions[1]
    rates, steering = robot.drive.commands(twists @ robot.signal_equations.T)
    return rates, np.unwrap(steering, axis=0), twists


def run(robot: Robot, rates: Array, steering: Array, headings: Array, late: int) -> Trajectory:
    """A run with a reference that shows the headings (F + 1,) at the samples' ends, some samples late."""
    times = PERIOD * np.arange(SAMPLES + 1)
    shown = np.arange(0, SAMPLES + 1, EVERY)
    poses = np.column_stack([np.zeros((len(shown), 2)), headings[np.maximum(shown - late, 0)]])
    angles = steering if robot.drive.steered else None
    data = make_dataset(
        robot.name, robot, PERIOD, [Trajectory("run", "train", times[1:], rates, times[shown], poses, steering=angles)]
    )
    return data.trajectories[0]


def odometry(robot: Robot, rates: Array, steering: Array, of_a_driver: bool = False) -> Array:
    """Headings (F + 1,) of a controller with wrong radii and distances, which takes the newest steering angle.

    of_a_driver: a car's by the tangent of its mean angle; of a robot that steers, after a wrong zero and scale.
    """
    drive = robot.drive
    if isinstance(drive, CarDrive) and of_a_driver:
        turns = 1.07 * rates.mean(axis=1) * robot.wheels[0].radius * np.tan(steering.mean(axis=1) + 0.02) / 0.5
    else:
        wrong = robot.inverse_kinematic_matrix[2] * np.linspace(0.9, 1.1, len(drive.names))
        turns = drive.signals(rates, 1.02 * steering + 0.02 if of_a_driver else steering) @ wrong
    return np.append(0.0, np.cumsum(turns * PERIOD))


@each_robot
@pytest.mark.parametrize("late", [0, 1, 2])
def test_the_robot_s_own_odometry_is_recognised(robot: Robot, late: int) -> None:
    rates, steering, _ = driven(robot)
    noisy = rates * (1 + 0.01 * np.random.default_rng(1).normal(size=rates.shape))
    residual = follows_the_wheels([run(robot, noisy, steering, odometry(robot, noisy, steering), late)])
    assert residual is not None
    assert residual < 3e-4


@pytest.mark.parametrize("robot", [each for each in WHEELED if each.drive.steered], ids=lambda robot: robot.name)
def test_odometry_that_reads_the_steering_otherwise_is_recognised(robot: Robot) -> None:
    rates, steering, _ = driven(robot)
    headings = odometry(robot, rates, steering, of_a_driver=True)
    assert follows_the_wheels([run(robot, rates, steering, headings, 0)]) is not None


@each_robot
def test_an_independent_reference_is_not_taken_for_odometry(robot: Robot) -> None:
    rng = np.random.default_rng(2)
    rates, steering, twists = driven(robot)
    noisy = rates * (1 + 0.01 * rng.normal(size=rates.shape))  # slip
    true = np.append(0.0, np.cumsum(twists[:, 2] * PERIOD)) + 1e-3 * rng.normal(size=SAMPLES + 1)
    assert follows_the_wheels([run(robot, noisy, steering, true, 0)]) is None
