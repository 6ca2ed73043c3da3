"""The runs of the validation split that a model can predict."""

from __future__ import annotations

from dataclasses import replace

from discovery_samples import simulated

from omnibench.data.dataset import Trajectory
from omnibench.discover.fitting import fit_matrix
from omnibench.discover.held_out import validation_runs
from omnibench.fit.trajectory_fit import usable_runs


def test_validation_runs_that_all_stand_are_left_out_with_a_warning() -> None:
    dataset = simulated((), repetitions=2)
    robot = dataset.robot
    fit = fit_matrix(usable_runs(dataset.split("train")), robot, dataset.sample_period, robot.inverse_kinematic_matrix)

    def standing(run: Trajectory) -> Trajectory:
        return replace(run, rates=0 * run.rates) if run.split == "validation" else run

    validation = validation_runs(replace(dataset, trajectories=tuple(map(standing, dataset.trajectories))), fit)
    assert validation.runs == ()
    assert validation.warnings == (
        "the wheels stand in all runs of the split validation; drive some, or check the columns omega_*; "
        "nothing is compared on it.",
    )
