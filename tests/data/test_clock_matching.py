"""Reference and wheels brought together: clocks, a common t = 0, and headings that are unwrapped once."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from driven_path import DrivenPath
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_robots import APR_02, fixed, make_robot
from scipy.stats import t

import omnibench
from omnibench.data.clock_matching import ClockMatch, Streams, match_clocks, median_period
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.recording import PoseReadings
from omnibench.data.references import unwrap
from omnibench.data.runs import align
from omnibench.robot.kinematics import Array, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

ROBOT = make_robot("base", fixed("l", 0.0, 0.1), fixed("r", 0.0, -0.1))
OFFSET, DRIFT = 0.12, 0.002  # s, s per s, to be added to the poses' times
LENGTH = 40.0  # s


def streams(
    seed: int,
    offset: float = OFFSET,
    drift: float = DRIFT,
    heading_noise: float = 0.003,
    driven: bool = True,
    position_noise: float = 0.002,
) -> Streams:
    """A drive in legs of two to four seconds at 50 Hz; its reference at 20 Hz is stamped by a clock of its own."""
    rng = np.random.default_rng(seed)
    edges = np.arange(0.0, LENGTH + 0.01, 0.02)
    legs = np.cumsum(rng.uniform(2.0, 4.0, 30))
    levels = rng.uniform(-6.0, 6.0, (31, 2)) if driven else np.full((31, 2), 4.0)
    wanted = levels[np.searchsorted(legs, edges[1:])]
    smooth = np.exp(-np.arange(0, 1, 0.02) / 0.1)
    rates = np.column_stack([np.convolve(each, smooth / smooth.sum())[: len(wanted)] for each in wanted.T])
    if not driven:
        rates = wanted
    moved = rates * 0.02
    path = DrivenPath(edges[1:], np.zeros(3), moved @ (1.05 * ROBOT.inverse_kinematic_matrix).T, "arc")
    stamps = np.arange(0.0, LENGTH - 1.0, 0.05)
    poses = path.poses(stamps + offset + drift * stamps) + rng.normal(
        0.0, [position_noise, position_noise, heading_noise], (len(stamps), 3)
    )
    return Streams(edges, np.vstack([np.zeros(2), np.cumsum(moved, axis=0)]), stamps, poses)


def matched(*runs: Streams) -> list[ClockMatch]:
    """The clocks of runs that all tell them."""
    clocks = match_clocks(ROBOT, runs)
    assert all(clock is not None for clock in clocks)
    return [clock for clock in clocks if clock is not None]


def test_counts_that_come_less_often_than_samples_count_in_the_error_that_is_stated() -> None:
    run, tick = streams(0), 2 * math.pi / 12  # rad; the wheels turn by about 3 rad/s, a tick in 0.17 s
    coarse = replace(run, driven=np.floor(run.driven / tick) * tick)
    (clock,) = matched(coarse)
    assert 0.02 < clock.middle_error < 0.08
    assert np.abs(errors(clock)).max() < 3


def test_chords_in_place_of_arcs_count_in_the_error_that_is_stated() -> None:
    clocks = [matched(streams(seed, heading_noise=1e-9, position_noise=1e-9))[0] for seed in range(4)]
    assert np.abs([errors(clock) for clock in clocks]).max() < 3
    assert all(2e-4 <= clock.middle_error < 4e-4 for clock in clocks)


def test_clocks_do_not_hang_on_the_rounding_of_the_wheels() -> None:
    log = Path(omnibench.__file__).parent / "cli/samples/robot/log"
    data = omnibench.import_dataset("csv", log, {"wheel_unit": "ticks/sample", "ticks_per_turn": 2796.8})
    runs, rng = [Streams.of_run(run) for run in data.trajectories], np.random.default_rng(1)
    rounded = [replace(run, driven=run.driven * (1 + 1e-14 * rng.normal(size=run.driven.shape))) for run in runs]
    clocks, again = (match_clocks(data.robot, each) for each in (runs, rounded))
    assert [clock is None for clock in clocks] == [clock is None for clock in again]
    for clock, other in zip(filter(None, clocks), filter(None, again), strict=True):
        assert (other.offset, other.drift) == pytest.approx((clock.offset, clock.drift), abs=1e-6)


def errors(clock: ClockMatch, offset: float = OFFSET, drift: float = DRIFT) -> Array:
    """Distances of a run's clock from the true one, in standard errors: in the middle, and of the drift."""
    middle = offset + drift * clock.length / 2
    return np.array([(clock.middle - middle) / clock.middle_error, (clock.drift - drift) / clock.drift_error])


@settings(max_examples=15, deadline=None)
@given(st.floats(-1.5, 1.5), st.floats(-0.01, 0.01), st.integers(0, 10_000))
def test_clocks_are_within_five_standard_errors(offset: float, drift: float, seed: int) -> None:
    (clock,) = matched(streams(seed, offset, drift))
    assert np.abs(errors(clock, offset, drift)).max() < 5.0
    assert clock.middle_error < 0.02
    stamps = np.linspace(0.0, clock.length, 5)
    added = clock.middle + clock.drift * (stamps - clock.length / 2)
    np.testing.assert_allclose(clock.corrected(stamps), stamps + added, atol=1e-12)


def test_a_short_run_with_sparse_poses_is_not_surer_of_its_clock_than_its_scatter_allows() -> None:
    whole = [streams(seed, heading_noise=0.02, position_noise=0.01) for seed in range(150)]
    short = [replace(run, pose_times=run.pose_times[:221:10], poses=run.poses[:221:10]) for run in whole]
    clocks = [clock for clock in match_clocks(ROBOT, short) if clock is not None]
    chances = [t.sf(np.abs(errors(clock)), clock.freedom) for clock in clocks]
    assert len(clocks) > 75
    assert np.mean(np.array(chances) < 0.005) < 0.03  # 0.01 where errors are as stated, of either sign


def test_a_noisy_heading_does_not_hide_the_clock() -> None:
    (clock,) = matched(streams(2, heading_noise=0.3))
    assert np.abs(errors(clock)).max() < 5.0
    assert clock.middle_error < 0.02


@pytest.mark.parametrize("misread", ["swapped", "negated", "degrees", "mirrored"])
def test_a_misread_recording_keeps_its_clock(misread: str) -> None:
    run = streams(3)
    (right,) = matched(run)
    poses = run.poses.copy()
    poses[:, 2] *= {"degrees": 180 / np.pi, "mirrored": -1.0}.get(misread, 1.0)
    driven = {"swapped": run.driven[:, ::-1], "negated": run.driven * (1, -1)}.get(misread, run.driven)
    (clock,) = matched(replace(run, driven=driven, poses=poses))
    assert clock.middle == pytest.approx(right.middle, abs=0.01)


def test_an_even_drive_and_a_reference_that_stands_still_do_not_tell_their_clocks() -> None:
    of = streams(4)
    still = replace(of, poses=np.zeros_like(of.poses))
    assert match_clocks(ROBOT, [streams(4, driven=False), still]) == [None, None]


def test_a_short_run_has_an_offset_and_no_drift() -> None:
    run = streams(7, drift=0.0)
    kept = run.pose_times < 8.0
    (clock,) = matched(replace(run, pose_times=run.pose_times[kept], poses=run.poses[kept]))
    assert (clock.drift, clock.drift_error) == (0.0, np.inf)
    assert clock.offset == pytest.approx(OFFSET, abs=0.03)


def test_clocks_of_a_real_robot_run_behind_by_a_tenth_of_a_second_a_minute(omni3: Dataset) -> None:
    clocks = match_clocks(omni3.robot, [Streams.of_run(run) for run in omni3.trajectories])
    drifts = np.array([60 * clock.drift for clock in clocks if clock is not None])
    assert len(drifts) == len(omni3.trajectories)
    assert np.median(drifts) == pytest.approx(
        -0.106, abs=0.02
    )  # s a minute; data/README: about 0.1, the other way round


@pytest.mark.slow
def test_clocks_that_are_a_second_off_are_followed_until_they_settle(tricyc: Dataset) -> None:
    runs = [Streams.of_run(run) for run in tricyc.trajectories[:4]]
    later = [replace(run, pose_times=run.pose_times + 0.35) for run in runs]
    pairs = zip(match_clocks(tricyc.robot, runs), match_clocks(tricyc.robot, later), strict=True)
    # The loss of ticks is rough: its minima are 2 ms apart.
    off = [(other.middle + 0.35 - clock.middle) / clock.middle_error for clock, other in pairs if clock and other]
    assert off == pytest.approx([0.0] * 4, abs=0.5)


TURN = 2 * math.pi


def driven(turn_rates: Array, stamps: Array, start: float = 0.3) -> WheelLog:
    """A run at 0.2 m/s that turns at each rate for 0.1 s."""
    twists = np.column_stack([np.full(len(turn_rates), 0.2), np.zeros(len(turn_rates)), turn_rates])
    times = 0.1 * np.arange(1, len(turn_rates) + 1)
    return WheelLog(times, twists @ wheel_equations(APR_02.wheels).T, np.array([0.0, 0.0, start]), stamps)


def true_headings(log: WheelLog) -> Array:
    return OdometryModel.of_design(APR_02, "arc").poses([log])[0][:, 2]


def wrapped(headings: Array) -> Array:
    return (headings + math.pi) % TURN - math.pi


def unwrapped(log: WheelLog, headings: Array) -> Array:
    (found,), _ = unwrap(APR_02, [log], [headings])
    return found


@pytest.mark.parametrize("rate", [-1.5, 0.0, 0.02, 1.5])
def test_dense_headings_that_wrap_become_continuous_even_if_the_odometry_is_far_off(rate: float) -> None:
    log = driven(np.full(300, rate), np.arange(0, 30, 0.25))
    for share in (1.0, 0.4):  # of what the odometry turns
        headings = 0.3 + (true_headings(log) - 0.3) * share
        for shown in (wrapped(headings), headings % TURN):
            np.testing.assert_allclose(unwrapped(log, shown), headings, atol=1e-9)


@pytest.mark.parametrize("rate", [-1.5, -0.7, 0.7, 1.5])
def test_the_odometry_decides_where_only_start_and_end_are_known(rate: float) -> None:
    log = driven(np.full(100, rate), np.array([0.0, 10.0]))
    assert abs(true_headings(log)[1] - true_headings(log)[0]) > TURN
    for factor in (1.0, 1.05):  # the robot may have turned by 5 % more than designed
        truth = true_headings(log) * [1.0, factor]
        np.testing.assert_allclose(unwrapped(log, wrapped(truth)), truth, atol=1e-9)


@given(seed=st.integers(0, 2**16), gap=st.sampled_from([0.1, 0.5, 3.0]))
def test_continuous_headings_stay_as_they_are_to_the_bit_and_whole_turns_change_nothing(seed: int, gap: float) -> None:
    rng = np.random.default_rng(seed)
    log = driven(rng.normal(0, 2, 100), np.arange(0, 10, gap))
    headings = true_headings(log) + rng.normal(0, 0.05, len(log.stamps))
    assert unwrapped(log, headings).tobytes() == headings.tobytes()
    whole_turns = TURN * rng.integers(-3, 4, len(headings))
    found = unwrapped(log, headings + whole_turns)
    np.testing.assert_allclose(found - found[0], headings - headings[0], atol=1e-9)


def test_a_data_set_holds_unwrapped_headings_and_warns_of_doubtful_ones() -> None:
    stamps = np.array([0.0, 10.0])
    log = driven(np.full(100, 1.5), stamps)
    poses = OdometryModel.of_design(APR_02, "arc").poses([log])[0]
    truth = poses[:, 2]
    sound = Trajectory("sound", "train", log.times, log.rates, stamps, np.column_stack([poses[:, :2], wrapped(truth)]))
    odd = replace(sound, id="odd", poses=np.column_stack([poses[:, :2], wrapped(truth * [1.0, 1.12])]))
    dataset = make_dataset("turns", APR_02, 0.1, [sound, odd])
    np.testing.assert_allclose(dataset.trajectories[0].poses[:, 2], truth, atol=1e-9)
    (warning,) = dataset.warnings
    assert warning.endswith(": odd")


def poses_at(times: np.ndarray, epoch: float = 0.0) -> PoseReadings:
    """A robot at constant speed, turning through +-pi, by a clock of an epoch."""
    heading = 3.0 + 2.0 * times
    wrapped_headings = (heading + math.pi) % (2 * math.pi) - math.pi
    return PoseReadings(times + epoch, np.column_stack([0.2 * times, -0.1 * times, wrapped_headings]))


@given(epoch=st.floats(-1e6, 1e6), first=st.floats(-0.2, 0.5), period=st.floats(0.05, 0.3))
def test_the_epoch_of_the_clock_does_not_matter(epoch: float, first: float, period: float) -> None:
    stamps = np.arange(first, 1.2, period)
    (here, seen), (there, later) = (align(zero, zero + 1.0, poses_at(stamps, zero)) for zero in (0.0, epoch))
    assert there - epoch == pytest.approx(here, abs=1e-8)
    np.testing.assert_allclose(later.times, seen.times, atol=1e-8)


@given(first=st.floats(-0.3, -1e-3), period=st.floats(0.05, 0.3))
def test_the_start_pose_is_interpolated_through_the_heading_s_wrap(first: float, period: float) -> None:
    zero, seen = align(0.0, 1.0, poses_at(np.arange(first, 1.0, period)))
    assert zero == 0.0
    np.testing.assert_allclose(seen.poses[0, :2], [0, 0], atol=1e-9)
    assert math.remainder(seen.poses[0, 2] - 3.0, 2 * math.pi) == pytest.approx(0, abs=1e-9)


def test_a_pose_at_the_wheels_begin_is_taken_as_it_is() -> None:
    recorded = poses_at(np.array([-0.1, 0.0, 0.5]))
    _, seen = align(0.0, 1.0, recorded)
    assert seen.poses[0].tolist() == recorded.poses[1].tolist()
    assert seen.times.tolist() == [0.0, 0.5]


@pytest.mark.parametrize("stamps", [[5.0, 6.0], [-6.0, -5.0], [0.5, 3.0], [-1.0, 2.0], [0.5]])
def test_streams_that_share_no_two_poses_are_told(stamps: list[float]) -> None:
    assert align(0.0, 1.0, poses_at(np.array(stamps))) is None


def test_the_median_period_ignores_gaps_and_rounding() -> None:
    times = np.concatenate([0.01 * np.arange(1, 50), [3.0]])
    assert median_period([times, times + 1e-9]) == 0.01
