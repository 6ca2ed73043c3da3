"""Recordings that lack something or have too much of it, and what discover says of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from discovery_samples import DELAY, named, repeated, shorn, simulated

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.discover.discover import discover_effects
from omnibench.discover.fitting import fit_matrix
from omnibench.errors import DataError
from omnibench.fit.evaluate import evaluate
from omnibench.fit.trajectory_fit import usable_runs


def with_runs(dataset: Dataset, change) -> Dataset:
    return replace(dataset, trajectories=tuple(change(run) for run in dataset.trajectories))


def turned(run: Trajectory, angle: float) -> Trajectory:
    """The run as a start heading that is off by an angle would report it."""
    poses, (x, y) = run.poses.copy(), (run.poses[1:, :2] - run.poses[0, :2]).T
    poses[1:, 0] = poses[0, 0] + np.cos(angle) * x - np.sin(angle) * y
    poses[1:, 1] = poses[0, 1] + np.sin(angle) * x + np.cos(angle) * y
    poses[1:, 2] += angle
    return replace(run, poses=poses)


@pytest.mark.slow
def test_start_headings_that_scatter_are_not_taken_for_clocks_and_hide_no_delay() -> None:
    rng = np.random.default_rng(6)
    dataset = with_runs(simulated(DELAY, repetitions=4, validation=None), lambda run: turned(run, rng.normal(0, 0.03)))
    runs = usable_runs(dataset.split("train"))
    fit = fit_matrix(runs, dataset.robot, dataset.sample_period, dataset.robot.inverse_kinematic_matrix)
    heading, offset, slope = fit.nuisances.deviations
    assert 0.02 < heading < 0.04
    assert offset < 0.01
    assert slope < 0.005
    assert [effect.name for effect in discover_effects(dataset).effects] == ["reference_time_offset"]


def test_without_repetitions_no_gap_is_said_to_be_closed() -> None:
    found = discover_effects(shorn(simulated(), command=None))
    assert [effect.name for effect in found.effects] == ["rotation_translation_coupling"]
    assert all(gap.closed is None for each in found.held_out for gap in (each.eq6, each.chi2))
    assert any("Without repetitions" in note for note in found.notes)


def test_results_do_not_depend_on_where_and_in_which_heading_runs_start() -> None:
    rng = np.random.default_rng(7)

    def moved(run: Trajectory) -> Trajectory:
        angle, shift = rng.uniform(-np.pi, np.pi), rng.uniform(-2, 2, 2)
        cosine, sine = np.cos(angle), np.sin(angle)
        x, y, heading = run.poses.T
        return replace(run, poses=np.column_stack([cosine * x - sine * y + shift[0], sine * x + cosine * y + shift[1],
                                                   heading + angle]))  # fmt: skip

    found = repeated()
    elsewhere = discover_effects(with_runs(simulated(repetitions=4), moved))
    assert elsewhere.noise.noise.model_dump() == pytest.approx(found.noise.noise.model_dump(), rel=1e-3, abs=1e-6)
    assert elsewhere.gap.floor == pytest.approx(found.gap.floor, rel=1e-3)
    ours, theirs = ([each.value for each in own.effects[0].parameters] for own in (found, elsewhere))
    assert theirs == pytest.approx(ours, rel=1e-3)


def test_errors_are_those_that_evaluate_finds() -> None:
    rng = np.random.default_rng(8)
    dataset = with_runs(simulated(), lambda run: turned(run, rng.normal(0, 0.02)))
    found = discover_effects(dataset)
    model = found.extended.model
    finals = [run.final_pose - model.reported([run.final_log])[0][-1] for run in dataset.split("validation")]
    assert found.held_out[-1].eq6.after == pytest.approx(float(np.mean(np.linalg.norm(finals, axis=1))), rel=1e-6)
    assert found.extended.provenance is not None
    assert found.extended.provenance.validation_cost == pytest.approx(found.held_out[-1].eq6.after, rel=1e-6)
    assert evaluate(found.extended, dataset).held_out.runs == tuple(run.id for run in dataset.split("validation"))


def test_a_warm_up_that_ends_is_not_carried_on_without_a_warning() -> None:
    drift = ({"name": "thermal_radius_drift", "parameters": {"k": 2e-5}},)
    dataset = simulated(drift, repetitions=6)
    late = with_runs(
        dataset,
        lambda run: replace(run, started_at=run.started_at + 20_000) if run.split == "validation" else run,
    )
    found = discover_effects(late)
    assert [effect.name for effect in found.effects] == ["thermal_radius_drift"]
    assert "Beware" in found.headline
    assert any("not known to hold" in note for note in found.notes)


def test_final_poses_alone_are_enough_to_look_at() -> None:
    def ends(run: Trajectory) -> Trajectory:
        return replace(run, pose_times=run.pose_times[[0, -1]], poses=run.poses[[0, -1]])

    found = discover_effects(with_runs(simulated(validation=None), ends))
    assert [effect.name for effect in found.effects] == ["rotation_translation_coupling"]


def test_validation_runs_that_lack_what_an_effect_needs_are_left_out() -> None:
    wheel = ({"name": "wheel_eccentricity", "parameters": {"a_a": 0.03, "b_b": -0.03}},)
    dataset = simulated(wheel)
    found = discover_effects(
        with_runs(dataset, lambda run: replace(run, angles=None) if run.split == "validation" else run)
    )
    assert [effect.name for effect in found.effects] == ["wheel_eccentricity"]
    assert [each.data for each in found.held_out] == ["repetitions"]
    assert any("left out" in note for note in found.notes)


def test_a_robot_that_stands_is_refused_in_one_line() -> None:
    with pytest.raises(DataError, match="wheels stand"):
        discover_effects(with_runs(simulated(), lambda run: replace(run, rates=0 * run.rates)))


def test_targets_that_were_never_filled_switch_off_the_motors_only() -> None:
    found = discover_effects(with_runs(simulated(validation=None), lambda run: replace(run, targets=0 * run.rates)))
    assert [effect.stage for effect in found.effects] == ["body"]


def test_a_calibration_with_effects_is_no_start() -> None:
    with pytest.raises(DataError, match="plain"):
        discover_effects(simulated(), calibration=named().extended)
