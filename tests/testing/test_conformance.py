"""Conformance cases and plug-in files: what keeps the contract passes, and what breaks it fails its case."""

import random
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from commands import ENVIRONMENT, Command, assert_refused, python, refused, succeeded
from lanes import slow
from timing import PATIENCE, until

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.importer import Importer
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError, NotApplicableError, OmnibenchError, PluginError
from omnibench.fit.calibrator import Calibrator, Solution, run_calibrator
from omnibench.fit.cost import Cost, SumOfNorms
from omnibench.fit.problem import BudgetSpent, CalibrationProblem
from omnibench.registry import Options, effects, registered_from
from omnibench.robot.effects.effect import ActuatorEffect, Effect, MotionEffect, Parameter, ReferenceEffect, Values
from omnibench.robot.kinematics import Array, Robot, RobotClass, class_of
from omnibench.robot.signals import Signals
from omnibench.testing import (
    CalibratorConformance,
    CaseOutcome,
    Conformance,
    CostConformance,
    EffectConformance,
    ImporterConformance,
    Nonconformance,
    load_plugin,
    run_cases,
    synthetic,
    synthetic_problem,
    synthetic_robot,
    synthetic_trajectories,
)
from omnibench.testing.plugin_files import PLUGIN_KINDS, CheckReport, check_plugin, check_plugin_apart, new_plugin


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


class Frozen(Honest):
    """Takes no attributes."""

    def __setattr__(self, name: str, value: object) -> None:
        assert name == "options"
        super().__setattr__(name, value)


class BeginsWithAnother(Honest):
    """Begins where another calibrator ends, whose answer is scored."""

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        run_calibrator(Honest(self.options), problem)
        return super().calibrate(problem)


class IgnoresBounds(Honest):
    """Steps out of the box."""

    def step(self, problem: CalibrationProblem, normal: Array) -> None:
        width = np.zeros((len(normal), problem.size))
        width[:, problem.free] = normal
        problem.cost(problem.start + width * (problem.upper - problem.lower))


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
ANSWERS_OUTSIDE = faulty(calibrate=lambda _, problem: Solution(2 * problem.upper - problem.lower, "outside"))
RETURNS_A_VECTOR = faulty(calibrate=lambda _, problem: problem.start)
NO_REASON = faulty(calibrate=lambda _, problem: Solution(problem.start, " ", converged=False))
CASES_OF_CALIBRATORS = [
    (IgnoresBounds, "bounds are kept", "candidates outside the box, e.g. m"),
    (ANSWERS_OUTSIDE, "bounds are kept", "the answer is outside the box (m11, m12"),
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


@pytest.mark.parametrize("cls", [Honest, Frozen, BeginsWithAnother])
def test_an_honest_calibrator_passes_every_case(cls: type[Calibrator]) -> None:
    assert failures(CalibratorConformance, cls) == {}


@pytest.mark.parametrize(("cls", "case", "message"), CASES_OF_CALIBRATORS)
def test_a_calibrator_fails_the_case_it_breaks(cls: type[Calibrator], case: str, message: str) -> None:
    with refused((Nonconformance, PluginError), message):
        getattr(suite(CalibratorConformance, cls), f"test_{case.replace(' ', '_')}")()


def test_a_claim_of_convergence_is_measured_by_the_share_that_the_author_sets() -> None:
    suite(CalibratorConformance, ClaimsTooMuch).test_synthetic_problem_is_solved_or_honestly_reported()
    with pytest.raises(Nonconformance, match=r"at 1 of the start's cost, where 0\.001 was expected"):
        suite(CalibratorConformance, ClaimsTooMuch, solved=1e-3).test_synthetic_problem_is_solved_or_honestly_reported()


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


def test_an_undefined_cost_is_nan_however_many_candidates_are_evaluated() -> None:
    problem = synthetic_problem(undefined=lambda points: points[:, 0] > 0.5)
    points = problem.rng.uniform(size=(100, problem.size))  # enough for the fast evaluator
    np.testing.assert_array_equal(np.isnan(problem.cost(problem.from_unit(points))), points[:, 0] > 0.5)


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


# The conformance cases of effects pass all of the catalogue and fail, case by case, what breaks the contract.

GAIN = Parameter("k", "1", -0.1, 0.1, "share that is added")


class HonestEffect(MotionEffect):
    """Wheels that are a little larger; what the bad ones below are made from."""

    stage: ClassVar[Any] = "wheel"
    physics: ClassVar[str] = "Tyres grow."
    source: ClassVar[str] = "first principles"
    shows_in: ClassVar[str] = "command"
    fixed_parameters: ClassVar[tuple[Parameter, ...]] = (GAIN,)

    def correction(self, signals: Signals, values: Values) -> Array:
        return values["k"] * signals.rates


class HonestReference(ReferenceEffect):
    """Late by a constant, and a map at another scale."""

    physics: ClassVar[str] = "The LIDAR is slow and the map is large."
    source: ClassVar[str] = "first principles"
    shows_in: ClassVar[str] = "stamps"
    fixed_parameters: ClassVar[tuple[Parameter, ...]] = (GAIN,)

    def delays(self, stamps: Array, values: Values) -> tuple[Array, Array]:
        return values["k"] * np.ones(len(stamps)), 0 * stamps

    def reported(self, poses: Array, start: Array, values: Values) -> Array:
        return self.scaled(poses, start, 1 + values["k"])

    def corrected(self, poses: Array, start: Array, values: Values) -> Array:
        return self.scaled(poses, start, 1 / (1 + values["k"]))

    def scaled(self, poses: Array, start: Array, scale: float) -> Array:
        return start + (poses - start) * [scale, scale, 1.0]


class HonestActuator(ActuatorEffect):
    """Motors that turn a share faster than they are told."""

    physics: ClassVar[str] = "The gain is wrong."
    source: ClassVar[str] = "first principles"
    shows_in: ClassVar[str] = "command"
    fixed_parameters: ClassVar[tuple[Parameter, ...]] = (GAIN,)

    def driven(self, durations: Array, targets: Array, values: Values) -> Array:  # noqa: ARG002
        return (1 + values["k"]) * targets


def effect_suite(cls: type[Effect]) -> EffectConformance:
    return type("Suite", (EffectConformance,), {"name": cls.__name__, "make": lambda _: cls()})()


def honest(**changes: Any) -> type[Effect]:
    return type("Changed", (HonestEffect,), {"__doc__": "Changed.", **changes})


def correcting(correction: Callable[[Signals, Values], Array], **changes: Any) -> type[Effect]:
    return honest(correction=lambda _, signals, values: correction(signals, values), **changes)


def with_parameter(**changes: Any) -> type[Effect]:
    return honest(fixed_parameters=(replace(GAIN, **changes),))


@pytest.mark.parametrize("name", [entry.name for entry in effects.entries() if entry.origin == "built in"])
def test_an_effect_of_the_catalogue_keeps_the_contract(name: str) -> None:
    results = run_cases(type("Suite", (EffectConformance,), {"name": name})())
    assert [result for result in results if not result.passed] == []
    assert len([result for result in results if result.outcome is CaseOutcome.PASSED]) >= 13


@pytest.mark.parametrize("cls", [HonestEffect, HonestReference, HonestActuator])
def test_an_honest_effect_of_each_kind_passes(cls: type[Effect]) -> None:
    assert [result for result in run_cases(effect_suite(cls)) if not result.passed] == []


def scales_in_place(signals: Signals, values: Values) -> Array:
    signals.rates[:] *= 1 + values["k"]
    return values["k"] * signals.rates


def divides(signals: Signals, values: Values) -> Array:
    with np.errstate(all="ignore"):
        return values["k"] * signals.rates / signals.rates


def trembles(signals: Signals, values: Values) -> Array:
    return values["k"] * signals.rates * np.random.random()  # noqa: NPY002 (the fault that is to be found)


def trembles_by_itself(signals: Signals, values: Values) -> Array:
    return values["k"] * signals.rates * np.random.default_rng().random()


CALLS = count()

RANGES, SHAPES = "parameters have units and plausible ranges", "shapes are those of the contract"
STAGE, PHYSICS = "stage is one of its kind", "physics and source are given"
NAMES, ALONE = "parameters have names of their own", "each sample is corrected by itself"
ZERO, LINEAR, CAUSAL = "zero parameters change nothing", "it is linear in its parameters", "motors are causal"
DRAWS, NEEDS, TRUE = "results are reproducible", "needs names all that is used", "corrected poses are the true ones"
OUT_OF_RANGE = Parameter("n", "1", 3, 16, "rollers", choices=(3.0, 17.0))


def renamed(*_: Any) -> tuple[Parameter, ...]:
    return (replace(GAIN, description=f"{next(CALLS)}"),)


def reference(**changes: Any) -> type[Effect]:
    return type("Wrong", (HonestReference,), {"__doc__": "Wrong.", **changes})


def motors(driven: Callable[[Array, Values], Array]) -> type[Effect]:
    by_targets = {"driven": lambda _, __, targets, values: driven(targets, values)}
    return type("Wrong", (HonestActuator,), {"__doc__": "Wrong.", **by_targets})


# s: signals, v: values of the parameters.
BROKEN: dict[str, tuple[type[Effect], str, str]] = {
    "no docstring": (honest(__doc__=None), "class and options are documented", "has no docstring"),
    "no physics": (honest(physics=" "), PHYSICS, "physics is missing"),
    "no source": (honest(source=""), PHYSICS, "source is missing"),
    "no covariate": (honest(shows_in=""), PHYSICS, "shows_in is missing"),
    "an unknown stage": (honest(stage="tyre"), STAGE, "stage is 'tyre'; of a MotionEffect"),
    "another kind's stage": (honest(stage="reference"), STAGE, "wheel, steering, clock"),
    "a reference effect on wheels": (reference(stage="wheel"), STAGE, "'wheel'"),
    "an unknown need": (honest(needs=frozenset({"weather"})), "needs are known", "['weather']; known are wheel_angles"),
    "no parameter": (honest(fixed_parameters=()), RANGES, "without choices"),
    "a list of parameters": (honest(fixed_parameters=[GAIN]), RANGES, "tuple of Parameter"),
    "only a shape": (with_parameter(choices=(0.05,)), RANGES, "without choices"),
    "no unit": (with_parameter(unit=""), RANGES, "'k' has no unit"),
    "no description": (with_parameter(description=""), RANGES, "description"),
    "a range upside down": (with_parameter(low=0.1, high=-0.1), RANGES, "low 0.1"),
    "a range without 0": (with_parameter(low=0.9, high=1.1), RANGES, "not within 0.9 and 1.1"),
    "an endless range": (with_parameter(high=np.inf), RANGES, "not finite"),
    "a choice out of range": (honest(fixed_parameters=(GAIN, OUT_OF_RANGE)), RANGES, "'n'"),
    "one name twice": (honest(fixed_parameters=(GAIN, GAIN)), NAMES, "one name: k, k"),
    "names that change": (honest(parameters=renamed), NAMES, "second call"),
    "three wheels only": (correcting(lambda s, v: v["k"] * s.rates[:, :3]), SHAPES, "(1, 3), expected (1, 4)"),
    "a body's correction on wheels": (correcting(lambda s, v: v["k"] * s.twists), SHAPES, "expected (1, 4)"),
    "one number for all samples": (correcting(lambda s, v: v["k"] * s.rates[-1]), SHAPES, "(3,), expected (1, 3)"),
    "a constant": (correcting(lambda s, v: (0.01 + v["k"]) * s.rates), ZERO, "parameters of 0"),
    "nothing at all": (correcting(lambda s, _: 0 * s.rates), "parameters change something", "3 wheels"),
    "0/0": (correcting(divides), "results are finite", "not finite"),
    "a square": (correcting(lambda s, v: v["k"] ** 2 * s.rates), LINEAR, "not linear"),
    "a magnitude": (correcting(lambda s, v: abs(v["k"]) * s.rates), LINEAR, "not linear"),
    "work in place": (correcting(scales_in_place), "inputs are left unchanged", "it changed its arguments"),
    "a sum over samples": (correcting(lambda s, v: v["k"] * np.cumsum(s.rates, axis=0)), ALONE, "row 7 differs"),
    "a mean over samples": (correcting(lambda s, v: v["k"] * (s.rates - s.rates.mean(axis=0))), ALONE, "other"),
    "the global generator": (correcting(trembles), DRAWS, "it draws random numbers"),
    "a generator of its own": (correcting(trembles_by_itself), DRAWS, "results differ"),
    "angles it did not ask for": (correcting(lambda s, v: v["k"] * np.cos(s.wheel_angles)), NEEDS, "name it in needs"),
    "a correction the wrong way": (reference(corrected=HonestReference.reported), TRUE, "corrected(reported(poses))"),
    "delays of one kind": (
        reference(delays=lambda _, stamps, __: (0 * stamps,)),
        SHAPES,
        "not enough values to unpack",
    ),
    "one delay for all": (reference(delays=lambda _, __, v: (v["k"], 0.0)), SHAPES, "(), expected (1,)"),
    "a reference that is always wrong": (reference(reported=lambda _, poses, *__: poses + 0.1), ZERO, "by 0.1"),
    "motors that foresee": (motors(lambda targets, v: targets + v["k"] * targets[-1]), CAUSAL, "earlier"),
    "motors that creep": (motors(lambda targets, v: targets + v["k"]), CAUSAL, "targets are 0"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_effect_fails_the_case_it_breaks(fault: str) -> None:
    cls, case, words = BROKEN[fault]
    with pytest.raises(Exception) as failure:
        getattr(effect_suite(cls), f"test_{case.replace(' ', '_')}")()
    assert words in str(failure.value)


def test_an_effect_is_made_checked_and_listed_on_the_command_line(command: Command) -> None:
    assert command("plugin", "new", "first_slip", "--effect").returncode == 0
    assert command("plugin", "new", "second_slip", "--kind", "effect").returncode == 0
    checked = succeeded(command("plugin", "check", "plugins/first_slip.py"))
    assert "passed  effect first_slip: it is linear in its parameters" in checked.stdout
    assert_refused(command("plugin", "new", "slip", "--effect", "--kind", "cost"), "--effect", "--kind cost")
    listed = command("list", "effects").stdout
    row = next(line for line in listed.splitlines() if "second_slip" in line)
    assert "The faster the robot drives" in row
    assert "second_slip.py" in "".join(listed.split())  # a long path is broken
    assert "built in" in next(line for line in listed.splitlines() if "heading_drift" in line)


# Writing the first version of a plug-in, and checking one.

FLAWED = """
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.registry import calibrators


@calibrators.register("flawed_{number}")
class Flawed(Calibrator):
    '''Answers from outside the box.'''

    def calibrate(self, problem):
        problem.cost(problem.start[None])
        return Solution(2 * problem.start + 1, "somewhere")
"""


CRASHING = FLAWED.format(number=7).replace("problem.cost(problem.start[None])", "import os; os._exit(4)")


def outcomes(report: CheckReport) -> dict[str, CaseOutcome]:
    return {result.case: result.outcome for result in report.results}


@pytest.mark.parametrize("kind", PLUGIN_KINDS)
def test_a_new_plugin_passes_its_check(kind: str, tmp_path: Path) -> None:
    written = new_plugin("my_first", kind, tmp_path / "made" / "for_it")
    assert [path.name for path in written] == ["my_first.py", "test_my_first.py"]
    report = check_plugin(written[0])
    assert report.passed, report.failures
    assert {(result.kind, result.name) for result in report.results} == {(kind, "my_first")}


@pytest.mark.slow
def test_the_tests_of_new_plugins_pass_in_pytest(tmp_path: Path) -> None:
    for kind in PLUGIN_KINDS:
        new_plugin(f"my_{kind}", kind, tmp_path)
    program = "import sys, pytest; sys.exit(pytest.main(sys.argv[1:]))"
    run = python(program, "-v", "-p", "no:cacheprovider", tmp_path, cwd=tmp_path, env=ENVIRONMENT)
    assert run.returncode == 0, run.stdout + run.stderr
    assert run.stdout.count("SKIPPED") == 3  # the seed of a calibrator that is stochastic, other kinds of effects
    assert all(f"test_my_{kind}.py" in run.stdout for kind in PLUGIN_KINDS)


@pytest.mark.slow
def test_the_cases_run_where_pytest_is_not_installed(tmp_path: Path) -> None:
    new_plugin("bare_search", "calibrator", tmp_path)
    program = (
        "import sys; sys.modules['pytest'] = None\n"
        "from omnibench.testing.plugin_files import check_plugin\n"
        f"print(check_plugin({str(tmp_path / 'bare_search.py')!r}).passed)"
    )
    run = python(program)
    assert run.stdout == "True\n", run.stderr


@pytest.mark.parametrize("kind", PLUGIN_KINDS)
def test_a_new_plugin_whose_class_would_hide_an_import_is_called_otherwise(kind: str, tmp_path: Path) -> None:
    name = {"calibrator": "solution", "importer": "trajectory_", "cost": "cost_", "effect": "signals"}[kind]
    file, _ = new_plugin(name, kind, tmp_path)
    load_plugin(file)
    ((_, entry),) = registered_from(file)
    assert entry.cls.__name__ == f"{name.strip('_').capitalize()}{kind.capitalize()}"


@pytest.mark.parametrize(
    ("name", "kind", "folder", "named"),
    [
        *(
            (name, "calibrator", "", "cannot name a plug-in")
            for name in ("my-search", "2opt", "My", "class", "", "_private", "test_mine", "größe", "../x")
        ),
        ("theoretical", "calibrator", "", r"'theoretical' already \(built in\)"),
        ("random", "calibrator", "", "Python module 'random'"),
        ("mine", "calibrater", "", "'calibrater'; did you mean 'calibrator'"),
        ("mine", "calibrator", "", r"test_mine\.py"),
        ("mine", "calibrator", "test_mine.py", "cannot be written"),
    ],
)
def test_what_cannot_be_written_is_named(name: str, kind: str, folder: str, named: str, tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text("mine")
    with pytest.raises((ConfigError, DataError), match=named):
        new_plugin(name, kind, tmp_path / folder)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_flawed_plugins_fail_the_case_they_break(tmp_path: Path) -> None:
    (tmp_path / "two.py").write_text(FLAWED.format(number=1) + FLAWED.format(number=2))
    report = check_plugin(tmp_path / "two.py")
    assert {result.name for result in report.results} == {"flawed_1", "flawed_2"}
    assert not report.passed
    assert outcomes(report)["it works in silence"] is CaseOutcome.PASSED
    failures = [result for result in report.failures if result.case == "bounds are kept"]
    assert [(failure.kind, failure.name) for failure in failures] == [("calibrator", f"flawed_{k}") for k in (1, 2)]
    assert failures[0].message.startswith("the answer is outside the box (m11")
    demanding = "    class Options(Options):\n        rate: float\n\n    def calibrate"
    content = FLAWED.format(number=5).replace("    def calibrate", demanding)
    (tmp_path / "demanding.py").write_text("from omnibench.registry import Options\n" + content)
    (result,) = check_plugin(tmp_path / "demanding.py").results
    assert "'flawed_5': key 'rate' is missing" in result.message


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("import os; os._exit(3)", "exit code 3"),
        pytest.param("import os; os.kill(os.getpid(), 11)", "SIGSEGV", marks=pytest.mark.slow),
        pytest.param("while True: pass", "limit 1 s", marks=pytest.mark.slow),
        pytest.param("1 / 0", "ZeroDivisionError: division by zero", marks=pytest.mark.slow),
        pytest.param(CRASHING, "exit code 4) while calibrator flawed_7 is tested", marks=pytest.mark.slow),
    ],
    ids=["exit", "crash", "hang", "error", "exit in a case"],
)
def test_a_plugin_that_ends_its_process_or_never_ends_is_named(content: str, named: str, tmp_path: Path) -> None:
    file = tmp_path / "wild.py"
    file.write_text(content)
    with pytest.raises(PluginError, match=re.escape(named)):
        check_plugin_apart(file, seconds=1.0 if "limit" in named else PATIENCE)


@pytest.mark.slow
@pytest.mark.parametrize("child", ["time.sleep(10_000)", "pass"], ids=["that stays", "that goes on as its twin"])
def test_a_fork_is_named_and_ended(child: str, tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    fork = f"import os, time\npid = os.fork()\nif pid == 0:\n    {child}\n"
    note = f"else:\n    open({str(pid_file)!r}, 'w').write(str(pid))\n"
    (tmp_path / "forking.py").write_text(fork + note + FLAWED.format(number=8))
    report = check_plugin_apart(tmp_path / "forking.py", seconds=PATIENCE)
    assert outcomes(report)["it leaves no process behind"] is CaseOutcome.FAILED
    assert len([result for result in report.results if result.case == "bounds are kept"]) == 1
    state = Path(f"/proc/{pid_file.read_text()}/stat")
    until(lambda: not state.exists() or " Z " in state.read_text(), "the fork to end")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("import nowhere_at_all\n", "ModuleNotFoundError: No module named 'nowhere_at_all'"),
        ("import numpy\n", "registers nothing"),
        (FLAWED.format(number=4).replace("flawed_4", "genetic"), "'genetic' is registered already"),
        (None, "no such file"),
    ],
)
def test_a_file_without_a_working_plugin_is_one_line(content: str | None, message: str, tmp_path: Path) -> None:
    file = tmp_path / "faulty.py"
    if content is not None:
        file.write_text(content)
    with refused(OmnibenchError, message, str(file)):
        check_plugin(file)


def test_an_importer_is_checked_on_the_sample_that_is_given(tmp_path: Path) -> None:
    new_plugin("sampled", "importer", tmp_path)
    rows = "\n".join(f"{0.1 * k:.1f},0,0,{0.05 * k:.2f},2,2,2" for k in range(11))
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "one.csv").write_text(f"t,x,y,heading,a,b,c\n{rows}\n")
    report = check_plugin(tmp_path / "sampled.py", tmp_path / "runs")
    assert set(outcomes(report).values()) == {CaseOutcome.PASSED}
