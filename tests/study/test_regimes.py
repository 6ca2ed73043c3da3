"""Training runs made worse."""

from __future__ import annotations

import numpy as np
import pytest
from sample_robots import DIFFERENTIAL
from studied import robot_dataset

from omnibench.data.dataset import Trajectory
from omnibench.study.config import RegimeChoice
from omnibench.study.trainings import in_regime


@pytest.fixture(scope="module")
def runs() -> tuple[Trajectory, ...]:
    return robot_dataset(DIFFERENTIAL, "two wheels", 1).trajectories


def changes(runs: tuple[Trajectory, ...], regime: RegimeChoice, seed: int = 1) -> np.ndarray:
    """Changes (K, 3) of all poses."""
    worse = in_regime(runs, regime, seed)
    return np.concatenate([after.poses - before.poses for before, after in zip(runs, worse, strict=True)])


def test_as_recorded_nothing_changes(runs: tuple[Trajectory, ...]) -> None:
    assert all(after is before for before, after in zip(runs, in_regime(runs, RegimeChoice(), 1), strict=True))


def test_noise_has_the_deviations_that_are_said(runs: tuple[Trajectory, ...]) -> None:
    moved = changes(runs, RegimeChoice(noise_position=0.02, noise_heading_deg=2.0))
    assert moved.std(axis=0) == pytest.approx([0.02, 0.02, np.radians(2.0)], rel=0.25)


def test_outliers_are_so_many_and_so_far_and_keep_their_headings(runs: tuple[Trajectory, ...]) -> None:
    moved = changes(runs, RegimeChoice(outlier_share=0.25, outlier_size=1.0))
    far = np.hypot(moved[:, 0], moved[:, 1])
    assert set(np.round(far, 12)) == {0.0, 1.0}
    assert (far > 0).mean() == pytest.approx(0.25, abs=0.1)
    assert not moved[:, 2].any()


def test_a_late_clock_shows_where_the_robot_was_before(runs: tuple[Trajectory, ...]) -> None:
    run = runs[0]
    (late,) = in_regime([run], RegimeChoice(clock_offset=0.2), 1)
    speed = np.hypot(*np.diff(run.poses[:, :2], axis=0).T).mean() / np.diff(run.pose_times).mean()
    behind = np.hypot(*(late.poses - run.poses)[1:-1, :2].T) / speed
    assert behind == pytest.approx(behind.mean(), rel=0.2)
    assert 0 < behind.mean() < 1.0


def test_chance_hangs_on_the_seed_and_on_the_run_not_on_its_place(runs: tuple[Trajectory, ...]) -> None:
    regime = RegimeChoice(noise_position=0.02)
    whole, part = in_regime(runs, regime, 1), in_regime(runs[5:], regime, 1)
    assert np.array_equal(whole[5].poses, part[0].poses)
    assert not np.array_equal(whole[5].poses, in_regime(runs, regime, 2)[5].poses)


def test_fewer_runs_are_the_first_of_each_command(runs: tuple[Trajectory, ...]) -> None:
    kept = in_regime(runs, RegimeChoice(runs_per_command=1), 1)
    assert len(kept) == len({run.command for run in runs})
    assert {run.repetition for run in kept} == {1}
