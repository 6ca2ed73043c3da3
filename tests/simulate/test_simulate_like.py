"""A recording simulated again with a model: all as recorded but for the poses, which are the model's."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError
from omnibench.robot.calibration import Calibration, EffectTerm, Noise, matrix_rows
from omnibench.simulate.simulation_request import simulate_like
from omnibench.testing import synthetic_robot, synthetic_trajectories

ROBOT = synthetic_robot()
NOISE = Noise(pose_position=0.02, pose_heading=0.01, bias_position=0.03)


def recording(**changes: Any) -> Dataset:
    """Twelve runs with all that a recording may know of them."""
    runs = []
    for number, run in enumerate(synthetic_trajectories(ROBOT)):
        known: dict[str, Any] = {
            "split": "train" if number % 2 else "validation",
            "command": f"c{number // 2}",
            "repetition": number % 2,
            "session": "morning",
            "started_at": 20.0 * number,
            "angles": np.cumsum(run.rates, axis=0) * 0.2,
            "targets": run.rates,
            "pose_covariances": np.tile(np.eye(3), (len(run.poses), 1, 1)),
            "poses": run.poses + np.array([1.0, 2.0, 0.5]),
        }
        runs.append(replace(run, **(known | changes)))
    return make_dataset("recorded", ROBOT, 0.2, runs, description="A robot drove.", source="here", licence="CC0")


def calibration(*effects: EffectTerm, **changes: Any) -> Calibration:
    matrix = 1.02 * ROBOT.inverse_kinematic_matrix
    plain: dict[str, Any] = {"name": "mine", "robot": ROBOT, "sample_period": 0.2, "integration": "arc"}
    return Calibration(**(plain | {"matrix": matrix_rows(matrix), "effects": effects} | changes))


def eccentric() -> EffectTerm:
    values = dict.fromkeys(("a_a", "b_a", "a_b", "b_b", "a_c", "b_c"), 0.01)
    return EffectTerm(name="wheel_eccentricity", parameters=values)


def test_everything_but_the_poses_is_as_recorded() -> None:
    dataset = recording()
    simulated = simulate_like(dataset, calibration())
    for made, run in zip(simulated.trajectories, dataset.trajectories, strict=True):
        assert made.pose_covariances is None
        for item in {field.name for field in fields(Trajectory)} - {"poses", "pose_covariances"}:
            assert np.array_equal(getattr(made, item), getattr(run, item)), item
    assert (simulated.name, simulated.robot, simulated.sample_period) == ("recorded", ROBOT, 0.2)


def test_poses_are_what_the_model_reports_from_the_recorded_starts() -> None:
    dataset = recording()
    terms = (eccentric(), EffectTerm(name="reference_time_offset", parameters={"tau": 0.1}))
    given = calibration(*terms)
    expected = given.model.reported([run.reference_log for run in dataset.trajectories])
    simulated = simulate_like(dataset, given)
    for made, run, poses in zip(simulated.trajectories, dataset.trajectories, expected, strict=True):
        np.testing.assert_array_equal(made.start, run.start)
        np.testing.assert_allclose(made.poses[1:], poses, atol=1e-12)


def test_it_is_said_to_be_simulated_like_what_and_by_which_model() -> None:
    simulated = simulate_like(recording(), calibration(eccentric()))
    assert simulated.simulated
    assert simulated.description == (
        "Simulated like recorded by calibration mine with wheel_eccentricity, without noise: its wheels, and poses as "
        "the model has them. A robot drove."
    )
    assert simulated.source == "simulated by omnibench from the wheels of recorded (here)"
    assert simulated.licence == "CC0"


def test_the_model_of_what_was_simulated_explains_it_in_full(tmp_path: Path) -> None:
    given = calibration(eccentric())
    save_dataset(simulate_like(recording(), given), tmp_path / "like")
    loaded = load_dataset(tmp_path / "like")
    for run, poses in zip(
        loaded.trajectories, given.model.reported([run.reference_log for run in loaded.trajectories]), strict=True
    ):
        np.testing.assert_allclose(run.poses[1:], poses, atol=1e-9)


def test_a_run_with_its_start_pose_alone_keeps_it() -> None:
    dataset = recording()
    first, *others = dataset.trajectories
    alone = replace(first, pose_times=first.pose_times[:1], poses=first.poses[:1], pose_covariances=None)
    simulated = simulate_like(replace(dataset, trajectories=(alone, *others)), calibration())
    np.testing.assert_array_equal(simulated.trajectories[0].poses, alone.poses)


def test_noise_is_the_calibrations_and_the_seeds() -> None:
    runs = synthetic_trajectories(ROBOT)
    many = [replace(run, id=f"{run.id}-{copy}") for run in runs for copy in range(40)]
    dataset, given = make_dataset("many", ROBOT, 0.2, many), calibration(noise=NOISE)
    plain, noisy, again, other = (simulate_like(dataset, given, seed) for seed in (None, 7, 7, 8))
    assert noisy.hash == again.hash != other.hash
    pairs = zip(noisy.trajectories, plain.trajectories, strict=True)
    errors = np.array([made.poses - run.poses for made, run in pairs])
    np.testing.assert_array_equal(errors[:, 0], 0.0)
    assert errors[:, 1:, :2].std() == pytest.approx(np.hypot(0.02, 0.03), rel=0.1)
    assert errors[:, 1:, 2].std() == pytest.approx(0.01, rel=0.1)
    assert "with its noise, seed 7" in noisy.description


@pytest.mark.parametrize("noise", [None, Noise()])
def test_a_calibration_without_noise_has_none_to_add(noise: Noise | None) -> None:
    with pytest.raises(DataError, match=r"calibration 'mine' has no noise of the reference; leave --noise out"):
        simulate_like(recording(), calibration(noise=noise), 1)


def test_another_robots_calibration_is_refused() -> None:
    other = synthetic_robot(4)
    given = calibration(robot=other, matrix=matrix_rows(other.inverse_kinematic_matrix))
    with pytest.raises(
        DataError, match=r"calibration 'mine' is for wheels fl, fr, rl, rr, the data set recorded has a"
    ):
        simulate_like(recording(), given)


def test_a_recording_that_lacks_what_an_effect_needs_is_refused() -> None:
    with pytest.raises(DataError, match=r"effect 'wheel_eccentricity' needs absolute wheel angles \(phi_\*"):
        simulate_like(recording(angles=None), calibration(eccentric()))
