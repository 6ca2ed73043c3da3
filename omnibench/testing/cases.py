"""Conformance cases of costs, calibrators and importers, their base class, and a runner that works without pytest."""

from __future__ import annotations

import hashlib
import io
import random
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from enum import StrEnum
from inspect import signature
from pathlib import Path
from typing import Any, ClassVar
from unittest import SkipTest

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from omnibench.data.dataset import SPLITS, Dataset, Trajectory
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError, OmnibenchError, PluginError
from omnibench.fit.calibrator import Calibrator, Outcome, RunResult, Solution, run_calibrator
from omnibench.fit.cost import Cost
from omnibench.fit.parameterisation import ParameterisationName
from omnibench.fit.problem import BudgetSpent, CalibrationProblem
from omnibench.progress import Progress, Reporter, no_progress
from omnibench.registry import Options, Registry, calibrators, costs, importers, load_plugin_file
from omnibench.robot.kinematics import Array
from omnibench.testing import synthetic
from omnibench.words import plural

_FOREIGN = b"\x89PNG\r\n\x1a\n not a recording; \xff\xfe\x00 1,2,3\n"


class Nonconformance(AssertionError):  # noqa: N818 (reads as what it is in a test report)
    """A class violates its contract; the message says how, in one line."""


class Conformance:
    """Cases that a registered class must pass; each method ``test_*`` is one.

    name: registered name of the class. options: options of the instance under test.
    """

    registry: ClassVar[Registry[Any]]
    name: ClassVar[str]
    options: ClassVar[Mapping[str, Any]] = {}

    def make(self) -> Any:
        """A new instance of the class under test."""
        return self.registry.create(self.name, self.options)

    def test_class_and_options_are_documented(self) -> None:
        """``omnibench list`` and the JSON schema show these texts."""
        cls = type(self.make())
        require((cls.__doc__ or "").strip(), f"{cls.__name__} has no docstring; its first line is its summary")
        model: type[BaseModel] = getattr(cls, "Options", Options)
        bare = [name for name, field in model.model_fields.items() if not field.description]
        require(not bare, f"options without a description: {', '.join(bare)}; use Field(..., description=...)")


class CaseOutcome(StrEnum):
    """The end of a case."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"  # it does not apply; the message says why


@dataclass(frozen=True)
class CaseResult:
    """Result of one case on one registered class. case: in words. message: the violation, or why it was skipped."""

    kind: str
    name: str
    case: str
    outcome: CaseOutcome
    message: str = ""

    @property
    def passed(self) -> bool:
        """True unless the case failed."""
        return self.outcome is not CaseOutcome.FAILED


def run_cases(suite: Conformance, watch: Reporter = no_progress) -> list[CaseResult]:
    """Run every case of ``suite``, in the order of definition; an exception becomes the case's result.

    watch: told of each before it runs.
    """
    defined = [name for cls in reversed(type(suite).__mro__) for name in vars(cls) if name.startswith("test_")]
    results = []
    for method in dict.fromkeys(defined):
        case = method.removeprefix("test_").replace("_", " ")
        watch(Progress(f"{suite.registry.kind} {suite.name} is tested: {case}"))
        outcome, message = CaseOutcome.PASSED, ""
        try:
            getattr(suite, method)()
        except SkipTest as skipped:
            outcome, message = CaseOutcome.SKIPPED, str(skipped)
        except (Nonconformance, OmnibenchError) as error:
            outcome, message = CaseOutcome.FAILED, str(error)
        except (Exception, SystemExit) as error:  # a plug-in may raise anything
            outcome, message = CaseOutcome.FAILED, f"{type(error).__name__}: {error}"
        results.append(CaseResult(suite.registry.kind, suite.name, case, outcome, " ".join(message.split())))
    return results


def load_plugin(path: Path) -> None:
    """Load a plug-in file for a test. PluginError names the file and why it cannot be loaded."""
    if path.is_dir():
        raise PluginError(f"{path}: is a folder; name the plug-in's file in it")
    if not path.is_file():
        raise PluginError(f"{path}: no such file")
    failure = load_plugin_file(path)
    if failure is not None:
        raise PluginError(f"{failure.origin} cannot be loaded: {failure.error}")


def require(condition: object, message: str) -> None:
    """Nonconformance with ``message`` unless ``condition`` holds."""
    if not condition:
        raise Nonconformance(" ".join(message.split()))


@contextmanager
def global_random_state(seed: int) -> Iterator[None]:
    """Seed the global generators of ``random`` and NumPy within the block, and restore them after it."""
    before, numpy_before = random.getstate(), np.random.get_state()  # noqa: NPY002 (what a plug-in must not use)
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(before)
        np.random.set_state(numpy_before)  # noqa: NPY002


def global_random_fingerprint() -> str:
    """The state of the global generators of ``random`` and NumPy, as text."""
    return f"{random.getstate()!r} {[np.asarray(part).tobytes() for part in np.random.get_state()]!r}"  # noqa: NPY002


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
            of = plural(candidates, "candidate")
            require(shape == (candidates,), f"combine gave shape {shape} for {of}, not (P,)")

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
        stamps, poses = len(batch.trajectory), len(reference)
        require(reference.shape == (stamps, 3), f"reference gives {poses} poses for the {stamps} stamps of batch")
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
            robots = synthetic.synthetic_robots()
            names = ", ".join(robot.name for robot in robots)
            robot = next((robot for robot in robots if calibrator.applies(robot)), None)
            require(robot, f"applies() is false for every synthetic robot ({names}), so nothing can be tested")
            changes = {"robot": robot} | changes
        return synthetic.synthetic_problem(parameterisation or calibrator.parameterisation, **changes)

    def attempt(self, problem: synthetic.ObservedProblem, calibrator: Calibrator | None = None) -> Attempt:
        """Run the calibrator; Nonconformance if it raises a forbidden exception or does not end."""
        calibrator = calibrator or self.make()
        search, before, uncounted = calibrator.calibrate, problem.uncounted, 0
        answers: list[Any] = [None]
        errors: list[Exception | None] = [None]

        def watched(searched: CalibrationProblem) -> Solution:
            nonlocal uncounted
            try:
                answers.append(search(searched))
            except Exception as error:
                errors.append(error)
                raise
            finally:
                uncounted = problem.uncounted - before
            return answers[-1]

        vars(calibrator)["calibrate"] = watched  # also of an instance that is frozen
        try:
            result = run_calibrator(calibrator, problem)
        except synthetic.Runaway:
            require(False, f"it went on for {problem.refusals} calls after BudgetSpent; let that exception through")
        finally:
            del vars(calibrator)["calibrate"]
        answer, error = answers[-1], errors[-1]
        if error is None:
            require(isinstance(answer, Solution), f"calibrate returned {type(answer).__name__}, expected a Solution")
            require(answer.reason.strip(), "the solution's reason is empty; say why it stopped")
        elif not isinstance(error, BudgetSpent | OmnibenchError):
            require(False, f"calibrate raised {type(error).__name__}: {error}")
        return Attempt(result, problem, answer, error, uncounted)

    def test_same_seed_twice_gives_the_same_answer(self) -> None:
        """Bit for bit, independent of the global generators; the second run reuses the instance."""
        for seed in (0, 1):
            calibrator = self.make()
            with global_random_state(1):
                first = self.attempt(self.problem(seed=seed), calibrator)
            with global_random_state(2):
                second = self.attempt(self.problem(seed=seed), calibrator)
            way = "draw all random numbers from problem.rng and keep nothing between runs"
            same = _bytes(first.result.vector) == _bytes(second.result.vector)
            require(same, f"two runs with seed {seed} gave different answers; {way}")
            same = first.result.evaluations == second.result.evaluations
            require(same, f"two runs with seed {seed} took different numbers of evaluations; {way}")

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
            for stray in strays[:1]:
                outside = (stray < problem.lower) | (stray > problem.upper) | ~np.isfinite(stray)
                first = int(np.flatnonzero(outside)[0])
                place = f"not in [{problem.lower[first]:.6g}, {problem.upper[first]:.6g}]"
                example = f"{problem.names[first]} = {stray[first]:.6g}, {place}"
                require(False, f"{plural(len(strays), 'candidate')} outside the box, e.g. {example}")
            require(attempt.result.outcome is not Outcome.INVALID, attempt.result.reason)

    def test_budget_is_kept(self) -> None:
        """The run ends when the evaluations are spent, and does not claim to have converged."""
        for evaluations in (1, 7, 150):
            attempt = self.attempt(self.problem(evaluations=evaluations))
            spent = attempt.result.evaluations + attempt.uncounted
            uncounted = f"{attempt.uncounted} by problem.values, which is not for searching; use problem.cost"
            require(spent <= evaluations, f"{plural(spent, 'candidate')} evaluated of {evaluations}: {uncounted}")
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
            claim = f"it claims to have converged at {share:.2g} of the start's cost, where {self.solved:.2g} was"
            require(share <= self.solved, f"{claim} expected; return Solution(..., converged=False) when in doubt")

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


def _require_honest_end(attempt: Attempt) -> None:
    # A wrapped library may ask for a few more costs until its stop takes effect; only the claim is checked.
    claims = attempt.result.outcome is Outcome.CONVERGED and attempt.problem.refusals
    require(not claims, "it swallowed BudgetSpent and claims to have converged; let that exception through")


def _contents(problem: CalibrationProblem) -> dict[str, bytes]:
    contents = {name: _bytes(getattr(problem, name)) for name in ("start", "lower", "upper", "free", "reference")}
    for trajectory in problem.trajectories:
        for name in ("times", "rates", "pose_times", "poses"):
            contents[f"{name} of trajectory {trajectory.id}"] = _bytes(getattr(trajectory, name))
    return contents


def _bytes(array: Any) -> bytes:
    return b"" if array is None else np.asarray(array).tobytes()


class ImporterConformance(Conformance):
    """Requirements on every importer.

    source: sample recordings; without them, only refusals are tested.
    """

    registry = importers
    source: ClassVar[Path | None] = None

    def read_sample(self) -> Dataset:
        """The data set read from the sample; skips the case if there is none."""
        if self.source is None:
            raise SkipTest("no sample; set source in a subclass of ImporterConformance")
        dataset = self.make().read(self.source)
        require(isinstance(dataset, Dataset), f"read returned {type(dataset).__name__}, expected a Dataset")
        assert isinstance(dataset, Dataset)
        return dataset

    def test_missing_source_is_refused(self) -> None:
        """DataError, in one line."""
        self._require_refusal("a missing source", lambda _: None)

    def test_empty_folder_is_refused(self) -> None:
        """DataError says which files are missing."""
        self._require_refusal("an empty folder", Path.mkdir)

    def test_empty_file_is_refused(self) -> None:
        """DataError names the file."""
        self._require_refusal("an empty file", Path.touch)

    def test_foreign_file_is_refused(self) -> None:
        """DataError for bytes that are no recording."""
        self._require_refusal("a file of other content", lambda path: path.write_bytes(_FOREIGN))

    def test_folder_of_foreign_files_is_refused(self) -> None:
        """DataError for a folder that holds only files of other content."""

        def fill(path: Path) -> None:
            path.mkdir()
            for name in ("run.csv", "notes.txt", "metadata.yaml", "data.parquet"):
                (path / name).write_bytes(_FOREIGN)

        self._require_refusal("a folder of other files", fill)

    def test_sample_is_a_valid_data_set(self) -> None:
        """Shapes, times and splits are as in a data set folder."""
        dataset = self.read_sample()
        wheels = len(dataset.robot.wheel_names)
        require(len(dataset.trajectories) > 0, "the data set has no trajectory; make it with make_dataset")
        for run in dataset.trajectories:
            place = f"trajectory {run.id}"
            shapes, expected = (run.rates.shape, run.poses.shape), ((len(run.times), wheels), (len(run.pose_times), 3))
            require(shapes == expected, f"{place}: rates and poses have shapes {shapes}, expected {expected}")
            for name in ("times", "rates", "pose_times", "poses"):
                require(np.isfinite(getattr(run, name)).all(), f"{place}: {name} holds NaN or infinity")
            require(run.split in SPLITS, f"{place}: split is {run.split!r}; it must be one of {', '.join(SPLITS)}")
            require(len(run.times) > 0 and run.times[0] > 0, f"{place}: wheel samples must start after t = 0")
            require(len(run.pose_times) > 1 and run.pose_times[0] == 0, f"{place}: poses must start at t = 0 and go on")
            steps = np.concatenate([np.diff(run.times), np.diff(run.pose_times)])
            require((steps > 0).all(), f"{place}: times must increase")

    def test_sample_raises_no_warning(self) -> None:
        """``make_dataset`` does not warn of implausible units or wheels."""
        warnings = self.read_sample().warnings
        require(not warnings, f"the data set warns: {'; '.join(warnings)}")

    def test_sample_saves_and_loads_back_equal(self) -> None:
        """Saving to a data set folder loses nothing."""
        dataset = self.read_sample()
        with tempfile.TemporaryDirectory() as folder:
            save_dataset(dataset, Path(folder) / "dataset")
            loaded = load_dataset(Path(folder) / "dataset")
        difference = _difference(dataset, loaded)
        require(not difference, f"saving and loading changes {difference}")
        require(dataset.hash == loaded.hash, "the hash of the data set changes by saving and loading")

    def test_sample_reads_the_same_twice(self) -> None:
        """The result does not depend on the order of files on the disk, the time or chance."""
        require(self.read_sample().hash == self.read_sample().hash, "two readings gave different data sets")

    def test_sample_is_left_unchanged(self) -> None:
        """The files of the sample are not changed."""
        before = _fingerprint(self.source)
        self.read_sample()
        require(before == _fingerprint(self.source), f"it changed the files of {self.source}")

    def _require_refusal(self, what: str, prepare: Callable[[Path], object]) -> None:
        with tempfile.TemporaryDirectory() as folder:
            source = Path(folder) / "source"
            prepare(source)
            try:
                self.make().read(source)
            except DataError as error:
                require(str(error).strip(), f"{what}: the DataError has no message")
            except Exception as error:
                require(False, f"{what}: it raised {type(error).__name__}: {error}; raise DataError in one line")
            else:
                require(False, f"{what} was read without complaint; raise DataError in one line")


def _difference(made: Dataset, loaded: Dataset) -> str:
    """The first difference in value or type between two data sets, in words; empty if there is none."""
    if (made.robot, made.sample_period) != (loaded.robot, loaded.sample_period):
        return "the robot or the sample period"
    for before, after in zip(made.trajectories, loaded.trajectories, strict=True):
        for name in (given for given in signature(Trajectory).parameters if given != "samples"):
            old, new = getattr(before, name), getattr(after, name)
            place = f"{name} of trajectory {before.id}"
            if isinstance(old, np.ndarray) and isinstance(new, np.ndarray):
                if old.dtype != new.dtype or not np.array_equal(old, new):
                    return f"{place} (an array of {old.dtype}, then of {new.dtype})"
            elif repr(old) != repr(new):
                return f"{place}: {old!r} becomes {new!r}"
    return ""


def _fingerprint(source: Path | None) -> str:
    if source is None:
        return ""
    files = [source] if source.is_file() else sorted(path for path in source.rglob("*") if path.is_file())
    digest = hashlib.sha256()
    for path in files:
        digest.update(str(path).encode() + path.read_bytes())
    return digest.hexdigest()
