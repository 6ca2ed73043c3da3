"""Conformance cases for costs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omnibench.fit.cost import Cost
from omnibench.registry import costs
from omnibench.robot.kinematics import Array
from omnibench.testing.conformance import Conformance, require
from omnibench.testing.synthetic import synthetic_robot, synthetic_trajectories, true_robot
from omnibench.words import plural


class CostConformance(Conformance):
    """Requirements on every cost."""

    registry = costs

    def errors(self, candidates: int) -> tuple[Array, NDArray[np.intp]]:
        """Pose errors (P, S, 3) of P candidates, from small to large, and the trajectory (S,) of each stamp."""
        trajectory = np.repeat(np.arange(4), 1 if self.make().stamps == "final" else 5)
        rng = np.random.default_rng(0)
        size = np.logspace(-4, 1, candidates)[:, None, None]
        return size * rng.normal(size=(candidates, len(trajectory), 3)), trajectory

    def test_every_candidate_has_one_cost(self) -> None:
        """Shape (P,), also for one candidate."""
        for candidates in (1, 6):
            shape = np.shape(self.make().combine(*self.errors(candidates)))
            require(
                shape == (candidates,), f"combine gave shape {shape} for {plural(candidates, 'candidate')}, not (P,)"
            )

    def test_costs_are_finite_and_not_negative(self) -> None:
        """Finite errors have finite costs >= 0."""
        values = self.make().combine(*self.errors(20))
        require(bool(np.isfinite(values).all()), "a cost of finite errors is not finite")
        require(bool((values >= 0).all()), f"a cost is negative: {values.min():.4g}")

    def test_no_error_costs_nothing(self) -> None:
        """Poses equal to the reference cost 0."""
        errors, trajectory = self.errors(2)
        values = self.make().combine(np.zeros_like(errors), trajectory)
        require(bool((values == 0).all()), f"errors of zero cost {values.max():.4g}")

    def test_errors_cost_something(self) -> None:
        """Errors in x, y and heading cost more than 0."""
        values = self.make().combine(*self.errors(6))
        require(bool((values > 0).all()), "errors in x, y and heading cost nothing")

    def test_nan_stays_with_its_candidate(self) -> None:
        """NaN errors give a NaN cost, for that candidate only, without an exception."""
        errors, trajectory = self.errors(3)
        clean = self.make().combine(errors.copy(), trajectory)
        errors[1, -1] = np.nan
        values = self.make().combine(errors, trajectory)
        require(bool(np.isnan(values[1])), f"NaN errors cost {values[1]:.4g}; they must cost NaN")
        require(
            bool(np.allclose(values[[0, 2]], clean[[0, 2]], rtol=1e-12)), "NaN of one candidate spoils another's cost"
        )

    def test_costs_do_not_depend_on_the_batch(self) -> None:
        """A candidate costs the same alone and in a batch of any order, up to rounding."""
        errors, trajectory = self.errors(7)
        together = self.make().combine(errors, trajectory)
        alone = np.concatenate([self.make().combine(errors[[index]], trajectory) for index in range(7)])
        backwards = self.make().combine(errors[::-1].copy(), trajectory)[::-1]
        for values in (alone, backwards):
            require(
                bool(np.allclose(values, together, rtol=1e-12)), "a candidate's cost depends on the others in its batch"
            )

    def test_inputs_are_left_unchanged(self) -> None:
        """The errors are not overwritten."""
        errors, trajectory = self.errors(3)
        kept, kept_trajectory = errors.copy(), trajectory.copy()
        self.make().combine(errors, trajectory)
        require(
            np.array_equal(kept, errors) and np.array_equal(kept_trajectory, trajectory),
            "combine changed its arguments; work on copies",
        )

    def test_exact_recordings_cost_nothing(self) -> None:
        """The true matrix costs 0 on recordings without noise, the design matrix more."""
        cost: Cost = self.make()
        robot = synthetic_robot()
        runs = synthetic_trajectories(robot)
        batch, reference = cost.batch(runs, "arc"), cost.reference(runs)
        require(
            reference.shape == (len(batch.trajectory), 3),
            f"reference gives {reference.shape[0]} poses for the {len(batch.trajectory)} stamps of batch",
        )
        matrices = np.array([true_robot(robot).inverse_kinematic_matrix, robot.inverse_kinematic_matrix])
        true, design = cost.combine(batch.poses(matrices) - reference, batch.trajectory)
        require(true <= 1e-9, f"the true matrix costs {true:.4g} on recordings without noise")
        require(design > true, "the design matrix costs no more than the true one")
