"""The cases of calibrators, costs and importers pass what keeps the contract and fail, case by case, what does not."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from commands import refused
from lanes import slow
from pydantic import Field

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.importer import Importer
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError, NotApplicableError, PluginError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.fit.problem import BudgetSpent, CalibrationProblem
from omnibench.registry import Options
from omnibench.robot.kinematics import Array, Robot, RobotClass, class_of
from omnibench.testing import (
    CalibratorConformance,
    CaseOutcome,
    Conformance,
    CostConformance,
    ImporterConformance,
    Nonconformance,
    run_cases,
    synthetic,
    synthetic_problem,
    synthetic_robot,
    synthetic_trajectories,
)


def suite(base: type[Conformance], cls: type, **attributes: Any) -> Conformance:
    """The cases of ``base`` on instances of ``cls``, which need not be registered for that."""
    return type("Suite", (base,), {"name": cls.__name__, "make": lambda _: cls(cls.Options()), **attributes})()


def failures(base: type[Conformance], cls: type, **attributes: Any) -> dict[str, str]:
    """The cases that instances of ``cls`` fail, and what is said of each."""
    return {result.case: result.message for result in run_cases(suite(base, cls, **attributes)) if not result.passed}


class Honest(Calibrator):
    """Gaussian steps from the best so far; what the bad ones below are made from."""

    generations: ClassVar[int] = 20

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        problem.cost(problem.start[None])
        for _ in range(self.generations):
            self.step(problem, self.normal(problem, (20, int(problem.free.sum()))))
        return Solution(problem.best_vector, f"{self.generations} generations", converged=False)

    def normal(self, problem: CalibrationProblem, shape: tuple[int, int]) -> Array:
        return problem.rng.normal(size=shape)

    def step(self, problem: CalibrationProblem, normal: Array) -> None:
        points = problem.to_unit(problem.best_vector) + 0.1 * normal
        problem.cost(problem.from_unit(np.clip(points, 0, 1)))


class IgnoresBounds(Honest):
    """Steps out of the box."""

    def step(self, problem: CalibrationProblem, normal: Array) -> None:
        width = np.zeros((len(normal), problem.size))
        width[:, problem.free] = normal
        problem.cost(problem.start + width * (problem.upper - problem.lower))


class AnswersOutside(Honest):
    """Keeps the box while it searches, and answers from outside."""

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        return Solution(2 * problem.upper - problem.lower, "outside")


class ScalesTrajectories(Honest):
    """Works in place on what others share."""

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        for trajectory in problem.trajectories:
            trajectory.rates[:] *= 1.01
        return super().calibrate(problem)


class ShiftsReference(Honest):
    """Changes what the cost is measured against."""

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        problem.reference = problem.reference + 0.1
        return super().calibrate(problem)


class Remembers(Honest):
    """Starts its second run where the first one ended."""

    def __init__(self, options: Options) -> None:
        super().__init__(options)
        self.best: Array | None = None

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        if self.best is not None:
            problem.cost(self.best[None])
        solution = super().calibrate(problem)
        self.best = solution.vector
        return solution


class WorseThanStart(Honest):
    """Converged, it says, in a corner of the box."""

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        problem.cost(problem.start[None])
        return Solution(problem.lower, "converged")


class ClaimsTooMuch(Honest):
    """Converged, it says, at the start."""

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        problem.cost(problem.start[None])
        return Solution(problem.start, "converged")


class SearchesUncounted(Honest):
    """Takes costs from where they are not counted."""

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        points = problem.from_unit(problem.rng.uniform(size=(200, int(problem.free.sum()))))
        points[0] = problem.start
        return Solution(points[np.nanargmin(problem.values(points))], "200 candidates", converged=False)


class NeverEnds(Honest):
    """Goes on when the budget is spent."""

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        while True:
            try:
                problem.cost(problem.start[None])
            except Exception:
                continue


class SwallowsBudgetSpent(Honest):
    """Takes the end of the budget for convergence."""

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        try:
            while True:
                problem.cost(problem.start[None])
        except BudgetSpent:
            return Solution(problem.best_vector, "converged")


class DiesOnNan(Honest):
    """Does not expect NaN."""

    def step(self, problem: CalibrationProblem, normal: Array) -> None:
        points = np.clip(0.5 + 0.3 * normal, 0, 1)
        if np.isnan(problem.cost(problem.from_unit(points))).any():
            raise ValueError("NaN in costs")


class PrefersNan(Honest):
    """``argmin`` takes NaN for the least."""

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        points = problem.from_unit(problem.rng.uniform(size=(100, int(problem.free.sum()))))
        return Solution(points[problem.cost(points).argmin()], "100 candidates", converged=False)


class CountsOnNine(Honest):
    """A matrix has nine elements, it thinks."""

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        problem.cost(problem.start.reshape(1, 9))
        return super().calibrate(problem)


class Prints(Honest):
    """Talks."""

    def step(self, problem: CalibrationProblem, normal: Array) -> None:
        print("generation")  # noqa: T201 (the fault that is to be found)
        super().step(problem, normal)


class LeavesFiles(Honest):
    """Logs into the working folder."""

    def step(self, problem: CalibrationProblem, normal: Array) -> None:
        Path("search.log").write_text("generation\n")
        super().step(problem, normal)


class AlwaysRefuses(Honest):
    """Needs a package that is not there."""

    def calibrate(self, problem: CalibrationProblem) -> Solution:  # noqa: ARG002
        raise PluginError("needs the package nowhere; install it: pip install nowhere")


class Undescribed(Honest):
    """An option without a description."""

    class Options(Options):
        count: int = 3


def faulty(**changes: Any) -> type[Calibrator]:
    return type("Faulty", (Honest,), {"__doc__": "Faulty.", **changes})


def legacy_normal(_: Calibrator, __: CalibrationProblem, shape: tuple[int, int]) -> Array:
    return np.random.normal(size=shape)  # noqa: NPY002 (the fault that is to be found)


def plain_normal(_: Calibrator, __: CalibrationProblem, shape: tuple[int, int]) -> Array:
    return np.array([[random.gauss() for _ in range(shape[1])] for _ in range(shape[0])])


MOVES_FIXED_ELEMENTS = faulty(step=lambda _, problem, normal: problem.cost(problem.start[None] + 1e-6 * normal[:, :1]))
UNSEEDED = faulty(normal=lambda _, __, shape: np.random.default_rng().normal(size=shape))
LEGACY, PLAIN = faulty(normal=legacy_normal), faulty(normal=plain_normal)
RETURNS_A_VECTOR = faulty(calibrate=lambda _, problem: problem.start)
NO_REASON = faulty(calibrate=lambda _, problem: Solution(problem.start, " ", converged=False))
CASES_OF_CALIBRATORS = [
    (IgnoresBounds, "bounds are kept", "candidates outside the box, e.g. m"),
    (AnswersOutside, "bounds are kept", "the answer is outside the box (m11, m12"),
    (MOVES_FIXED_ELEMENTS, "bounds are kept", "candidates outside the box, e.g. m12"),
    (ScalesTrajectories, "inputs are left unchanged", "it changed rates of trajectory 01"),
    (ShiftsReference, "inputs are left unchanged", "it changed reference"),
    (UNSEEDED, "same seed twice gives the same answer", "different answers; draw all random numbers from problem.rng"),
    (LEGACY, "same seed twice gives the same answer", "different answers"),
    (LEGACY, "global random state is left alone", "global generator"),
    (PLAIN, "global random state is left alone", "global generator"),
    (faulty(stochastic=False), "seed makes no difference where it says so", "depends on the seed"),
    (Remembers, "same seed twice gives the same answer", "two runs with seed 0"),
    (WorseThanStart, "synthetic problem is solved or honestly reported", "times the cost of the start"),
    (SearchesUncounted, "budget is kept", "200 by problem.values"),
    (NeverEnds, "budget is kept", "calls after BudgetSpent; let that exception through"),
    (NeverEnds, "spent time ends the run", "calls after BudgetSpent; let that exception through"),
    (SwallowsBudgetSpent, "budget is kept", "swallowed BudgetSpent"),
    (DiesOnNan, "nan cost is survived", "calibrate raised ValueError: NaN in costs"),
    (PrefersNan, "nan cost is survived", "the answer's cost is not finite"),
    (CountsOnNine, "four wheels work", "calibrate raised ValueError"),
    (Prints, "it works in silence", "it printed 'generation"),
    (LeavesFiles, "it works in silence", "search.log"),
    (RETURNS_A_VECTOR, "bounds are kept", "calibrate returned ndarray, expected a Solution"),
    (NO_REASON, "synthetic problem is solved or honestly reported", "reason is empty"),
    (AlwaysRefuses, "synthetic problem is solved or honestly reported", "pip install nowhere"),
    (Undescribed, "class and options are documented", "options without a description: count"),
    (faulty(__doc__=None), "class and options are documented", "Faulty has no docstring"),
]


def test_an_honest_calibrator_passes_every_case() -> None:
    assert failures(CalibratorConformance, Honest) == {}


@pytest.mark.parametrize(("cls", "case", "message"), CASES_OF_CALIBRATORS)
def test_a_calibrator_fails_the_case_it_breaks(cls: type[Calibrator], case: str, message: str) -> None:
    with refused((Nonconformance, PluginError), message):
        getattr(suite(CalibratorConformance, cls), f"test_{case.replace(' ', '_')}")()


def test_a_claim_of_convergence_is_measured_by_the_share_that_the_author_sets() -> None:
    suite(CalibratorConformance, ClaimsTooMuch).test_synthetic_problem_is_solved_or_honestly_reported()
    with pytest.raises(Nonconformance, match=r"at 1 of the start's cost, where 0\.001 was expected"):
        suite(CalibratorConformance, ClaimsTooMuch, solved=1e-3).test_synthetic_problem_is_solved_or_honestly_reported()


def test_an_answer_that_does_not_depend_on_the_box_need_not_keep_it() -> None:
    class Published(AnswersOutside):
        """A fixed answer."""

        bounded = False
        fitted = False

    assert failures(CalibratorConformance, Published) == {}


@pytest.mark.slow
def test_the_calibrators_own_parameterisation_is_used() -> None:
    class Geometric(Honest):
        """Searches the wheels."""

        parameterisation = "geometry"

        def calibrate(self, problem: CalibrationProblem) -> Solution:
            if problem.parameterisation.name != "geometry":
                raise ConfigError("geometric searches the geometry parameterisation only")
            return super().calibrate(problem)

    assert failures(CalibratorConformance, Geometric) == {}


@pytest.mark.parametrize("parameterisation", ["matrix", "geometry"])
@pytest.mark.parametrize("wheels", [3, 4])
@pytest.mark.parametrize("fixed", [False, True])
def test_the_synthetic_problem_can_be_solved_to_zero_within_its_box(parameterisation, wheels, fixed) -> None:
    problem = synthetic_problem(parameterisation, wheels=wheels, fixed=fixed)
    true = synthetic.true_robot(synthetic_robot(wheels))
    kinds = ("radius", "distance", "angle")
    geometry = np.array([getattr(wheel, kind) for kind in kinds for wheel in true.wheels])
    vector = true.inverse_kinematic_matrix.ravel() if parameterisation == "matrix" else geometry
    assert problem.inside(vector[None]).all()
    assert problem.values(vector[None])[0] < 1e-12
    assert problem.values(problem.start[None])[0] > 0.05
    assert (problem.free.sum() < problem.size) == (fixed and (parameterisation, wheels) != ("matrix", 4))


@pytest.mark.parametrize("robot", synthetic.synthetic_wheeled_robots(), ids=lambda robot: robot.name)
def test_the_problem_on_fixed_and_steered_wheels_can_be_solved_to_zero_within_its_box(robot: Robot) -> None:
    problem = synthetic_problem(robot=robot)
    vector = synthetic.true_robot(robot).inverse_kinematic_matrix.ravel()
    assert problem.inside(vector[None]).all()
    assert problem.values(vector[None])[0] < 1e-12
    assert problem.values(problem.start[None])[0] > 0.02
    assert make_dataset("synthetic", robot, synthetic.PERIOD, problem.trajectories).warnings == ()


OTHER_CLASSES = ("mecanum", "differential", "skid", "car", "swerve")


def only_for(kind: RobotClass) -> type[Honest]:
    class OnlyForOne(Honest):
        """Searches, for one class of robots."""

        only_for = f"{kind} robots"

        def applies(self, robot: Robot) -> bool:
            return class_of(robot) == kind

    return OnlyForOne


@pytest.mark.parametrize("kind", ["tricycle", *slow(*OTHER_CLASSES)])
def test_a_calibrator_for_one_class_of_robots_is_tested_on_it(kind: RobotClass) -> None:
    tested = suite(CalibratorConformance, only_for(kind))
    assert class_of(tested.problem().robot) == kind
    results = run_cases(tested)
    assert [result for result in results if not result.passed] == []
    skipped = {result.case: result.message for result in results if result.outcome == "skipped"}
    expected = {} if kind == "mecanum" else {"four wheels work": f"it is for {kind} robots"}
    assert {case: skipped[case] for case in skipped if case == "four wheels work"} == expected


def test_a_calibrator_for_no_synthetic_robot_or_path_fails_in_one_line() -> None:
    class ForSpirals(Honest):
        """Wants paths that are not there."""

        def calibrate(self, problem: CalibrationProblem) -> Solution:  # noqa: ARG002
            raise NotApplicableError("it is for spirals, and none was driven")

    (case,) = failures(CalibratorConformance, ForSpirals).items()
    assert case[0] == "synthetic problem is solved or honestly reported"
    assert "not applicable to the runs of synthetic omni (it is for spirals, and none was driven)" in case[1]
    with pytest.raises(Nonconformance, match=r"false for every synthetic robot \(synthetic omni, "):
        suite(CalibratorConformance, only_for("mixed")).test_budget_is_kept()


def test_a_differential_drive_is_driven_along_lines_turns_and_squares_both_ways() -> None:
    robot = next(robot for robot in synthetic.synthetic_robots() if class_of(robot) == "differential")
    ends = {run.command: run.poses[-1] for run in synthetic_trajectories(robot) if run.repetition == 1}
    for sign, line, side in ((1, "forward", "left"), (-1, "backward", "right")):
        assert ends[line] == pytest.approx([sign, 0, 0], abs=0.1)
        assert ends[f"turn {side}"] == pytest.approx([0, 0, sign * np.pi], abs=0.15)
        assert ends[f"square {side}"] == pytest.approx([0, 0, sign * 2 * np.pi], abs=0.4)


def test_a_class_that_cannot_be_made_fails_each_case_in_one_line() -> None:
    class Broken(Honest):
        """Raises when it is made."""

        def __init__(self, options: Options) -> None:  # noqa: ARG002
            raise TypeError("two\nlines")

    found = failures(CalibratorConformance, Broken)
    assert set(found.values()) == {"TypeError: two lines"}
    assert len(found) >= 12


class GoodCost(SumOfNorms):
    """The norm of Eq. (6)."""


def costing(combine: Callable[[Cost, Array, Array], Any]) -> type[Cost]:
    return type("FaultyCost", (GoodCost,), {"__doc__": "Faulty.", "combine": combine})


norms = GoodCost.combine


def raises_on_nan(cost: Cost, errors: Array, trajectory: Array) -> Any:
    if np.isnan(errors).any():
        raise ValueError("NaN")
    return norms(cost, errors, trajectory)


def relative_to_the_worst(*arguments: Any) -> Any:
    values = norms(*arguments)
    return values / max(values.max(), 1e-300)


def squares_in_place(cost: Cost, errors: Array, trajectory: Array) -> Any:
    errors *= errors
    return np.sqrt(errors.sum(axis=-1)) @ cost.shares(trajectory)


OFFSET, RELATIVE = costing(lambda *arguments: norms(*arguments) + 1), costing(relative_to_the_worst)
NAN_STAYS = "nan stays with its candidate"
CASES_OF_COSTS = [
    (costing(lambda *arguments: norms(*arguments).mean()), "every candidate has one cost", "shape ()"),
    (costing(lambda *arguments: np.log(norms(*arguments) + 1e-300)), "costs are finite and not negative", "negative"),
    (OFFSET, "no error costs nothing", "errors of zero cost 1"),
    (OFFSET, "exact recordings cost nothing", "the true matrix costs 1"),
    (type("FreeCost", (GoodCost,), {"weights": (0.0, 0.0, 0.0)}), "errors cost something", "cost nothing"),
    (costing(lambda cost, errors, run: norms(cost, np.nan_to_num(errors), run)), NAN_STAYS, "they must cost NaN"),
    (costing(raises_on_nan), NAN_STAYS, "ValueError: NaN"),
    (RELATIVE, "costs do not depend on the batch", "depends on the others"),
    (RELATIVE, NAN_STAYS, "spoils another's cost"),
    (costing(squares_in_place), "inputs are left unchanged", "combine changed its arguments"),
]


class GoodImporter(Importer):
    """Reads the project's own data set folders."""

    def read(self, source: Path) -> Dataset:
        return load_dataset(source)


class OpensAnything(GoodImporter):
    """Lets the operating system complain."""

    def read(self, source: Path) -> Dataset:
        (source / "dataset.yaml").read_text()
        return load_dataset(source)


class AcceptsAnything(GoodImporter):
    """Makes something of everything."""

    def read(self, source: Path) -> Dataset:
        try:
            return load_dataset(source)
        except DataError:
            robot: Any = None  # on purpose: an importer that knows no robot
            return Dataset("nothing", robot, 0.1, ())


class Altered(GoodImporter):
    """Changes trajectories after they were made."""

    def read(self, source: Path) -> Dataset:
        dataset = load_dataset(source)
        return replace(dataset, trajectories=tuple(self.alter(run) for run in dataset.trajectories))

    def alter(self, run: Trajectory) -> Trajectory:
        return replace(run, times=run.times[::-1])


class NumpyNumbers(Altered):
    """A speed that is a NumPy number."""

    def alter(self, run: Trajectory) -> Trajectory:
        return replace(run, v=np.float64(0.25))


class Jitters(Altered):
    """Adds noise."""

    def alter(self, run: Trajectory) -> Trajectory:
        return replace(run, rates=run.rates + np.random.default_rng().normal(size=run.rates.shape))


class TidiesUp(GoodImporter):
    """Improves the files that it reads."""

    def read(self, source: Path) -> Dataset:
        dataset = load_dataset(source)
        (source / "dataset.yaml").write_text((source / "dataset.yaml").read_text() + "# read\n")
        return dataset


CASES_OF_IMPORTERS = [
    (OpensAnything, "missing source is refused", "it raised FileNotFoundError"),
    (AcceptsAnything, "empty folder is refused", "read without complaint"),
    (Altered, "sample is a valid data set", "trajectory 01: times must increase"),
    (NumpyNumbers, "sample saves and loads back equal", "v of trajectory 01"),
    (Jitters, "sample reads the same twice", "different data sets"),
    (TidiesUp, "sample is left unchanged", "it changed the files"),
]


@pytest.fixture
def sample(tmp_path: Path) -> Path:
    save_dataset(synthetic.synthetic_dataset(), tmp_path / "sample")
    return tmp_path / "sample"


def test_a_good_cost_and_a_good_importer_pass_every_case(sample: Path) -> None:
    assert failures(CostConformance, GoodCost) == {}
    assert failures(ImporterConformance, GoodImporter, source=sample) == {}


@pytest.mark.parametrize(("cls", "case", "message"), [*CASES_OF_COSTS, *CASES_OF_IMPORTERS])
def test_a_cost_or_importer_fails_its_case(cls: type[Cost | Importer], case: str, message: str, sample: Path) -> None:
    of_cost = issubclass(cls, Cost)
    found = failures(CostConformance, cls) if of_cost else failures(ImporterConformance, cls, source=sample)
    assert message in found[case]


def test_an_importer_without_a_sample_is_tried_on_refusals_only() -> None:
    outcomes = {result.case: result.outcome for result in run_cases(suite(ImporterConformance, GoodImporter))}
    assert outcomes["empty file is refused"] is CaseOutcome.PASSED
    assert outcomes["sample is a valid data set"] is CaseOutcome.SKIPPED


def test_an_option_that_is_not_described_fails_an_importer() -> None:
    class Bare(GoodImporter):
        """Has an option."""

        class Options(Options):
            rate: float = Field(1.0, gt=0)

    assert "rate" in failures(ImporterConformance, Bare)["class and options are documented"]
