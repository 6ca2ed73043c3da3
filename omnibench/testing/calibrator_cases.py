"""Conformance cases for calibrators."""

from __future__ import annotations

import io
import tempfile
from contextlib import chdir, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar
from unittest import SkipTest

import numpy as np
from numpy.typing import NDArray

from omnibench.errors import OmnibenchError
from omnibench.fit.calibrator import Calibrator, Outcome, RunResult, Solution, run_calibrator
from omnibench.fit.cost import Cost
from omnibench.fit.parameterisation import ParameterisationName
from omnibench.fit.problem import BudgetSpent, CalibrationProblem
from omnibench.registry import calibrators, costs
from omnibench.robot.kinematics import Array, Robot
from omnibench.testing import synthetic
from omnibench.testing.conformance import (
    Conformance,
    Nonconformance,
    global_random_fingerprint,
    global_random_state,
    require,
)
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
        require(np.isfinite(values).all(), "a cost of finite errors is not finite")
        require((values >= 0).all(), f"a cost is negative: {values.min():.4g}")

    def test_no_error_costs_nothing(self) -> None:
        """Poses equal to the reference cost 0."""
        errors, trajectory = self.errors(2)
        values = self.make().combine(np.zeros_like(errors), trajectory)
        require((values == 0).all(), f"errors of zero cost {values.max():.4g}")

    def test_errors_cost_something(self) -> None:
        """Errors in x, y and heading cost more than 0."""
        values = self.make().combine(*self.errors(6))
        require((values > 0).all(), "errors in x, y and heading cost nothing")

    def test_nan_stays_with_its_candidate(self) -> None:
        """NaN errors give a NaN cost, for that candidate only, without an exception."""
        errors, trajectory = self.errors(3)
        clean = self.make().combine(errors.copy(), trajectory)
        errors[1, -1] = np.nan
        values = self.make().combine(errors, trajectory)
        require(np.isnan(values[1]), f"NaN errors cost {values[1]:.4g}; they must cost NaN")
        require(np.allclose(values[[0, 2]], clean[[0, 2]], rtol=1e-12), "NaN of one candidate spoils another's cost")

    def test_costs_do_not_depend_on_the_batch(self) -> None:
        """A candidate costs the same alone and in a batch of any order, up to rounding."""
        errors, trajectory = self.errors(7)
        together = self.make().combine(errors, trajectory)
        alone = np.concatenate([self.make().combine(errors[[index]], trajectory) for index in range(7)])
        backwards = self.make().combine(errors[::-1].copy(), trajectory)[::-1]
        for values in (alone, backwards):
            require(np.allclose(values, together, rtol=1e-12), "a candidate's cost depends on the others in its batch")

    def test_inputs_are_left_unchanged(self) -> None:
        """The errors are not overwritten."""
        errors, trajectory = self.errors(3)
        before = errors.copy(), trajectory.copy()
        self.make().combine(errors, trajectory)
        same = np.array_equal(before[0], errors) and np.array_equal(before[1], trajectory)
        require(same, "combine changed its arguments; work on copies")

    def test_exact_recordings_cost_nothing(self) -> None:
        """The true matrix costs 0 on recordings without noise, the design matrix more."""
        cost: Cost = self.make()
        robot = synthetic.synthetic_robot()
        runs = synthetic.synthetic_trajectories(robot)
        batch, reference = cost.batch(runs, "arc"), cost.reference(runs)
        require(
            reference.shape == (len(batch.trajectory), 3),
            f"reference gives {reference.shape[0]} poses for the {len(batch.trajectory)} stamps of batch",
        )
        matrices = np.array([synthetic.true_robot(robot).inverse_kinematic_matrix, robot.inverse_kinematic_matrix])
        true, design = cost.combine(batch.poses(matrices) - reference, batch.trajectory)
        require(true <= 1e-9, f"the true matrix costs {true:.4g} on recordings without noise")
        require(design > true, "the design matrix costs no more than the true one")


@dataclass(frozen=True, eq=False)
class Attempt:
    """One run of a calibrator: its result, and the problem after the run.

    solution, error: returned or raised by ``calibrate``. uncounted: candidates that it evaluated without counting them
    against the budget.
    """

    result: RunResult
    problem: synthetic.ObservedProblem
    solution: Any
    error: Exception | None
    uncounted: int


class CalibratorConformance(Conformance):
    """Requirements on every calibrator.

    solved: on a problem whose least cost is zero, largest share of the start's cost at which it may claim convergence.
    The default only demands an answer no worse than the start; set it to, say, 1e-3 for an optimiser.
    evaluations: budget of that problem.

    The problems are of the first synthetic robot to which the calibrator applies: on omni wheels, on mecanum wheels,
    a differential drive, a skid-steered robot, a tricycle, a car, a swerve drive. On the problem above it must answer;
    override ``problem`` where none of the synthetic runs is a path that it is for.
    """

    registry = calibrators
    solved: ClassVar[float] = 1.0
    evaluations: ClassVar[int] = 20_000

    def problem(
        self, parameterisation: ParameterisationName | None = None, **changes: Any
    ) -> synthetic.ObservedProblem:
        """A synthetic problem in the calibrator's own parameterisation; see ``synthetic_problem``."""
        calibrator = self.make()
        if "wheels" not in changes:
            robot = next((robot for robot in synthetic.synthetic_robots() if calibrator.applies(robot)), None)
            names = ", ".join(robot.name for robot in synthetic.synthetic_robots())
            require(
                robot is not None,
                f"applies() is false for every synthetic robot ({names}), so nothing can be tested",
            )
            changes = {"robot": robot} | changes
        return synthetic.synthetic_problem(parameterisation or calibrator.parameterisation, **changes)

    def attempt(self, problem: synthetic.ObservedProblem, calibrator: Calibrator | None = None) -> Attempt:
        """Run the calibrator; Nonconformance if it raises a forbidden exception or does not end."""
        calibrator = calibrator or self.make()
        watched = (_Watching if calibrator.bounded else _WatchingUnbounded)(calibrator)
        try:
            result = run_calibrator(watched, problem)
        except synthetic.Runaway:
            require(False, f"it went on for {problem.refusals} calls after BudgetSpent; let that exception through")
        if watched.error is not None and not isinstance(watched.error, BudgetSpent | OmnibenchError):
            require(False, f"calibrate raised {type(watched.error).__name__}: {watched.error}")
        answer = watched.solution
        if watched.error is None:
            require(isinstance(answer, Solution), f"calibrate returned {type(answer).__name__}, expected a Solution")
            require(answer.reason.strip(), "the solution's reason is empty; say why it stopped")
        return Attempt(result, problem, answer, watched.error, watched.uncounted)

    def test_same_seed_twice_gives_the_same_answer(self) -> None:
        """Bit for bit, independent of the global generators; the second run reuses the instance."""
        for seed in (0, 1):
            calibrator = self.make()
            with global_random_state(1):
                first = self.attempt(self.problem(seed=seed), calibrator)
            with global_random_state(2):
                second = self.attempt(self.problem(seed=seed), calibrator)
            same = _bytes(first.result.vector) == _bytes(second.result.vector)
            require(same, f"two runs with seed {seed} gave different answers; draw all random numbers from problem.rng")
            require(
                first.result.evaluations == second.result.evaluations,
                f"two runs with seed {seed} took {first.result.evaluations} and {second.result.evaluations} "
                "evaluations; draw all random numbers from problem.rng and keep nothing between runs",
            )

    def test_seed_makes_no_difference_where_it_says_so(self) -> None:
        """A comparison runs a calibrator with ``stochastic = False`` once, whatever seeds the config lists."""
        if self.make().stochastic:
            raise SkipTest("it is stochastic")
        answers = {_bytes(self.attempt(self.problem(seed=seed)).result.vector) for seed in (0, 1)}
        require(len(answers) == 1, "it says stochastic = False, but its answer depends on the seed")

    def test_global_random_state_is_left_alone(self) -> None:
        """A plug-in that uses the global generators of ``random`` and NumPy would change the runs after it."""
        with global_random_state(1):
            before = global_random_fingerprint()
            self.attempt(self.problem())
            require(before == global_random_fingerprint(), "it used or seeded a global generator; use problem.rng")

    def test_bounds_are_kept(self) -> None:
        """Every candidate and the answer lie in the box, also if the box fixes an element."""
        if not self.make().bounded:
            raise SkipTest("its answer does not depend on the box")
        for fixed in (False, True):
            attempt = self.attempt(self.problem(fixed=fixed))
            problem, strays = attempt.problem, attempt.problem.strays
            if strays:
                stray = strays[0]
                outside = (stray < problem.lower) | (stray > problem.upper) | ~np.isfinite(stray)
                first = int(np.flatnonzero(outside)[0])
                place = f"not in [{problem.lower[first]:.6g}, {problem.upper[first]:.6g}]"
                raise Nonconformance(
                    f"{plural(len(strays), 'candidate')} outside the box, e.g. {problem.names[first]} = "
                    f"{stray[first]:.6g}, {place}"
                )
            require(attempt.result.outcome is not Outcome.INVALID, attempt.result.reason)

    def test_budget_is_kept(self) -> None:
        """The run ends when the evaluations are spent, and does not claim to have converged."""
        for evaluations in (1, 7, 150):
            attempt = self.attempt(self.problem(evaluations=evaluations))
            spent = attempt.result.evaluations + attempt.uncounted
            require(
                spent <= evaluations,
                f"{plural(spent, 'candidate')} evaluated of {evaluations}: {attempt.uncounted} by problem.values, "
                "which is not for searching; use problem.cost",
            )
            _require_honest_end(attempt)

    def test_spent_time_ends_the_run(self) -> None:
        """The run ends when the seconds are spent, and does not claim to have converged."""
        _require_honest_end(self.attempt(self.problem(seconds=1e-9)))

    def test_inputs_are_left_unchanged(self) -> None:
        """Trajectories, start, box and reference are shared with other runs, and the same after a run."""
        problem = self.problem()
        before, cost = _contents(problem), problem.values(problem.start[None])
        self.attempt(problem)
        after = _contents(problem)
        changed = [name for name in before if before[name] != after[name]]
        require(not changed, f"it changed {', '.join(changed)}; work on copies")
        require(_bytes(cost) == _bytes(problem.values(problem.start[None])), "it changed what the problem computes")

    def test_nan_cost_is_survived(self) -> None:
        """The cost is NaN in most of the box, except near the start and the optimum."""
        # Any free element in the upper tenth of its range: 61 % of a box of nine.
        attempt = self.attempt(self.problem(undefined=lambda points: (points > 0.9).any(axis=1)))
        if self.make().bounded:
            require(attempt.result.outcome is not Outcome.INVALID, f"beside NaN costs: {attempt.result.reason}")

    def test_nothing_but_nan_is_survived(self) -> None:
        """The run ends without an answer and without a crash."""
        attempt = self.attempt(self.problem(undefined=lambda points: np.ones(len(points), dtype=bool)))
        require(attempt.result.outcome is not Outcome.CONVERGED, "it claims to have converged where no cost is finite")

    def test_synthetic_problem_is_solved_or_honestly_reported(self) -> None:
        """If it claims convergence, the answer costs at most the share ``solved`` of the start."""
        if not self.make().fitted:
            raise SkipTest("its answer does not depend on the problem")
        problem = self.problem(evaluations=self.evaluations)
        start = float(problem.values(problem.start[None])[0])
        result = self.attempt(problem).result
        require(result.outcome not in (Outcome.FAILED, Outcome.INVALID), f"it ended {result.outcome}: {result.reason}")
        require(
            result.outcome is not Outcome.NOT_APPLICABLE,
            f"it is not applicable to the runs of {problem.robot.name} ({result.reason}), so no case has seen an "
            "answer; say in applies(robot) and only_for which robots it is for, and the runs are of such a robot (for "
            "other paths override problem() in its test, and run pytest)",
        )
        if result.outcome is Outcome.CONVERGED:
            share = (np.inf if result.cost is None else result.cost) / start
            require(share <= 1 + 1e-12, f"it claims to have converged, at {share:.4g} times the cost of the start")
            require(
                share <= self.solved,
                f"it claims to have converged at {share:.2g} of the start's cost, where {self.solved:.2g} was "
                "expected; return Solution(..., converged=False) when in doubt",
            )

    def test_other_parameterisation_is_searched_or_refused(self) -> None:
        """A config may ask for either parameterisation; OmnibenchError refuses one."""
        for parameterisation in ("matrix", "geometry"):
            self.attempt(self.problem(parameterisation))

    def test_four_wheels_work(self) -> None:
        """The number of elements may differ from nine."""
        if not self.make().applies(synthetic.synthetic_robot(4)):
            raise SkipTest(f"it is for {self.make().only_for or 'other robots'}")
        attempt = self.attempt(self.problem(wheels=4))
        if self.make().bounded:
            require(attempt.result.outcome is not Outcome.INVALID, f"with four wheels: {attempt.result.reason}")

    def test_it_works_in_silence(self) -> None:
        """It prints nothing, since standard output belongs to ``--json``, and leaves no files."""
        printed, folder = io.StringIO(), tempfile.TemporaryDirectory()
        with folder as path, chdir(path), redirect_stdout(printed), redirect_stderr(printed):
            self.attempt(self.problem(evaluations=300))
            files = sorted(file.name for file in Path(path).iterdir())
        require(not printed.getvalue(), f"it printed {printed.getvalue()[:60]!r}; put what matters into the reason")
        require(not files, f"it left files in the working folder: {', '.join(files)}")


class _Watching(Calibrator):
    """A wrapper around a calibrator that records its solution or exception."""

    def __init__(self, inner: Calibrator) -> None:
        super().__init__(inner.options)
        self.inner = inner
        self.solution: Any = None
        self.error: Exception | None = None
        self.uncounted = 0

    def applies(self, robot: Robot) -> bool:
        return self.inner.applies(robot)

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        assert isinstance(problem, synthetic.ObservedProblem)
        before = problem.uncounted
        try:
            self.solution = self.inner.calibrate(problem)
        except Exception as error:
            self.error = error
            raise
        finally:
            self.uncounted = problem.uncounted - before
        solution: Solution = self.solution
        return solution


class _WatchingUnbounded(_Watching):
    bounded = False


def _require_honest_end(attempt: Attempt) -> None:
    # A wrapped library may ask for a few more costs until its stop takes effect; only the claim is checked.
    require(
        attempt.result.outcome is not Outcome.CONVERGED or not attempt.problem.refusals,
        "it swallowed BudgetSpent and claims to have converged; let that exception through",
    )


def _contents(problem: CalibrationProblem) -> dict[str, bytes]:
    contents = {name: _bytes(getattr(problem, name)) for name in ("start", "lower", "upper", "free", "reference")}
    for trajectory in problem.trajectories:
        for name in ("times", "rates", "pose_times", "poses"):
            contents[f"{name} of trajectory {trajectory.id}"] = _bytes(getattr(trajectory, name))
    return contents


def _bytes(array: Any) -> bytes:
    return b"" if array is None else np.asarray(array).tobytes()
