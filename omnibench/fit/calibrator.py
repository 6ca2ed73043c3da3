"""The interface of calibrators, and how one is run so that every run, failed or not, gives a result."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.errors import ConfigError, DataError, NotApplicableError, OmnibenchError, PluginError, one_line
from omnibench.fit.parameterisation import ParameterisationName
from omnibench.fit.prior import MountChoice
from omnibench.fit.problem import BudgetSpent, CalibrationProblem, Improvement
from omnibench.fit.span import Treatment, Unidentified
from omnibench.jobs.job_process import memory_limit
from omnibench.registry import AnyOptions, Options, PluginFailure, calibrators
from omnibench.robot import calibration as saved
from omnibench.robot.kinematics import Array, JsonArray, Robot
from omnibench.robot.model import OdometryModel
from omnibench.views import Brief


class Outcome(StrEnum):
    """The end of a run."""

    CONVERGED = "converged"  # by the calibrator's own rule
    BUDGET = "budget"  # the evaluations were spent
    TIME = "time"  # the seconds were spent
    FAILED = "failed"  # it raised, died, or cannot solve this problem
    INVALID = "invalid"  # its answer is no calibration: NaN, wrong shape, outside the box
    NOT_APPLICABLE = "not applicable"  # it is not for this robot, or not for such paths


@dataclass(frozen=True)
class Solution:
    """A calibrator's answer: the vector (n,) and the reason why it stopped there.

    converged: False when the calibrator hit a limit of its own (generations, programs) before its stopping rule held.
    Calibrators that estimate them also give the covariance (n, n) of the vector, the degrees_of_freedom of its
    variances (one number, or (n,)), by which intervals are made, and the noise of the reference poses; those that weigh
    the design say in covariance_source what the covariance rests on beside it.
    extension: effects that were fitted beside the matrix; the answer's cost is that of the model with these.
    """

    vector: Array
    reason: str
    converged: bool = True
    covariance: Array | None = None
    noise: saved.Noise | None = None
    degrees_of_freedom: Array | float | None = None
    extension: saved.ModelExtension | None = None
    covariance_source: str = ""


class Calibrator(ABC):
    """Finds a vector of low cost. Made with validated options; ``calibrate`` may be called more than once.

    parameterisation: the one it searches unless the config names another.
    bounded: False if the answer does not depend on the box (a published matrix, a closed form of an article).
    as_is: True if its answer stands as it is, as an article's, and is not kept to the design along any motion.
    weighs_design: True if it weighs what the runs say of every motion against the design by itself.
    fitted: False if the answer does not depend on the runs (the design values, a published matrix).
    per_session: True if its article calibrates from the runs of one session, so that it refuses those of several.
    only_for: the robots that it is for, in words, where these are not all; then override ``applies``.
    stochastic: False if the seed makes no difference, so that one run is enough.
    extends: True if its answers may hold effects beside the matrix.
    uses: files or rooms of omnibench (``discover``) and packages whose change may change its answers, beside
    those that all calibrators share; stored runs are then not taken for new ones.
    exact: True if a converged answer is a minimum to rounding, against which others are measured; that it is the
    optimum of the box is not said by this but by a proof, that of ``certify``.
    """

    Options: ClassVar[type[BaseModel]] = Options
    name: ClassVar[str]
    parameterisation: ClassVar[ParameterisationName] = "matrix"
    bounded: ClassVar[bool] = True
    as_is: ClassVar[bool] = False
    weighs_design: ClassVar[bool] = False
    fitted: ClassVar[bool] = True
    per_session: ClassVar[bool] = False
    only_for: ClassVar[str] = ""
    stochastic: ClassVar[bool] = True
    extends: ClassVar[bool] = False
    uses: ClassVar[tuple[str, ...]] = ()
    exact: ClassVar[bool] = False

    def __init__(self, options: Any) -> None:
        self.options = options

    def applies(self, robot: Robot) -> bool:  # noqa: ARG002
        """True for a robot that the method is for."""
        return True

    def needs_matrix(self, problem: CalibrationProblem) -> None:
        """ConfigError: the problem searches a geometry, and the method answers with a matrix."""
        if problem.parameterisation.name != "matrix":
            raise ConfigError(f"{self.name} gives a matrix; say parameterisation: matrix")

    @abstractmethod
    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Minimise ``problem.cost`` within the box and return the best vector.

        ``problem.cost`` raises BudgetSpent when the budget is spent: do not catch it. Raise OmnibenchError when the
        calibrator cannot solve such a problem, NotApplicableError when it is not for paths as these.
        """


calibrators.contract = Calibrator


def as_answered(
    calibrator: type[Calibrator] | Calibrator, unidentified: Unidentified, mount: MountChoice | None
) -> tuple[Treatment, MountChoice | None]:
    """How answers are treated: as asked for, unless they stand as they are or weigh the design by themselves."""
    if calibrator.as_is:
        return "fit", "fit"
    if calibrator.weighs_design:
        return "weigh", mount
    if unidentified == "shrink":
        warnings.warn(
            f"unidentified: shrink is what calibrator map does by itself; {calibrator.name} keeps the design instead",
            FutureWarning,
            stacklevel=2,
        )
        return "keep", mount
    return unidentified, mount


@dataclass(frozen=True)
class Timing:
    """The machine of a run. reference_seconds: it took for one evaluation of the start's cost beside the run."""

    reference_seconds: float
    machine: str


@dataclass(frozen=True, eq=False, repr=False)
class RunResult(Brief):
    """Result of one calibrator on one problem. ``vector``, ``matrix`` and ``cost`` are None if there is no answer.

    at_bounds, held: names of elements on a bound of the box, and of those kept at their start values.
    covariance (n, n), degrees_of_freedom (n,), noise: as in Solution, None if the calibrator does not estimate them.
    timing: None where the seconds are not to be compared.
    extension: effects that belong to the answer beside the matrix, None for none.
    """

    outcome: Outcome
    reason: str
    vector: JsonArray | None
    matrix: JsonArray | None
    cost: float | None
    evaluations: int
    seconds: float
    history: tuple[Improvement, ...]
    at_bounds: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    covariance: JsonArray | None = None
    noise: saved.Noise | None = None
    degrees_of_freedom: JsonArray | None = None
    timing: Timing | None = None
    extension: saved.ModelExtension | None = None
    covariance_source: str = ""


class _FlawError(Exception):
    """An answer is no calibration; its text says why."""


def run_calibrator(calibrator: Calibrator, problem: CalibrationProblem) -> RunResult:
    """Run a calibrator; whatever it raises becomes the outcome and reason of its result."""
    solution: Solution | None = None
    try:
        if refusal := refusal_of(calibrator, problem.robot, problem.trajectories):
            raise NotApplicableError(refusal)
        given: Any = calibrator.calibrate(problem)
        if not isinstance(given, Solution):
            raise PluginError(f"calibrate returned {type(given).__name__}, expected a Solution")
        outcome, reason = Outcome.CONVERGED if given.converged else Outcome.BUDGET, one_line(str(given.reason))
        solution = given
    except BudgetSpent as spent:
        outcome, reason = Outcome(spent.kind), str(spent)
        if np.isfinite(problem.best_cost):
            solution = Solution(problem.best_vector, reason)
        else:
            outcome, reason = Outcome.INVALID, f"{reason}, and no candidate in the box had a finite cost"
    except OmnibenchError as error:
        outcome = Outcome.NOT_APPLICABLE if isinstance(error, NotApplicableError) else Outcome.FAILED
        reason = str(error)
    except (Exception, SystemExit) as error:  # whatever a plug-in raises is this run's outcome
        outcome, reason = Outcome.FAILED, describe_error(error)
    seconds = problem.seconds
    vector, cost, freedom = None, None, None
    if solution is not None:
        try:
            vector, cost, freedom = _examined(calibrator, problem, solution)
        except _FlawError as flaw:
            outcome, reason = Outcome.INVALID, str(flaw)
        except Exception as error:  # a cost may be a plug-in's, too
            outcome, reason = Outcome.FAILED, describe_error(error)
    estimate = solution if solution is not None and vector is not None else Solution(problem.start, "none")
    return RunResult(
        outcome=outcome,
        reason=reason,
        vector=vector,
        matrix=None if vector is None else problem.matrix(vector),
        cost=cost,
        evaluations=problem.evaluations,
        seconds=seconds,
        history=tuple(problem.history),
        at_bounds=problem.at_bounds(vector) if vector is not None and calibrator.bounded else (),
        held=problem.held if calibrator.bounded else (),
        covariance=estimate.covariance,
        noise=estimate.noise,
        degrees_of_freedom=freedom,
        extension=estimate.extension,
        covariance_source=estimate.covariance_source,
    )


def _examined(
    calibrator: Calibrator, problem: CalibrationProblem, solution: Solution
) -> tuple[Array, float, Array | None]:
    """The answer as a vector (n,), its cost, and its variances' degrees of freedom (n,).

    _FlawError: it is no calibration of the problem.
    """
    freedom = None
    if solution.degrees_of_freedom is not None:
        freedom = np.broadcast_to(np.asarray(solution.degrees_of_freedom, dtype=float), problem.size)
    try:
        vector = np.array(solution.vector, dtype=float)
    except (TypeError, ValueError):
        raise _FlawError("the answer is not a vector of numbers") from None
    if vector.shape != problem.start.shape:
        raise _FlawError(f"the answer has shape {vector.shape}, expected ({problem.size},)")
    if not np.isfinite(vector).all():
        raise _FlawError("the answer holds NaN or infinity")
    if calibrator.bounded and not problem.inside(vector[None])[0]:
        outside = np.array(problem.names)[(vector < problem.lower) | (vector > problem.upper)]
        raise _FlawError(f"the answer is outside the box ({', '.join(outside)})")
    if freedom is not None and not (freedom > 0).all():
        raise _FlawError(f"degrees_of_freedom of the answer's variances must be above 0, found {freedom.min():g}")
    if flaw := saved.matrix_flaw(problem.matrix(vector)):
        raise _FlawError(f"the answer's matrix holds {flaw}")
    if solution.extension is None:
        cost = problem.answer_cost(vector)
    else:
        model = model_of_answer(problem, problem.matrix(vector), solution.extension)
        cost = problem.objective.of_model(model, problem.trajectories)
    if not np.isfinite(cost):
        raise _FlawError("the answer's cost is not finite")
    return vector, cost, freedom


def refusal_of(calibrator: Calibrator, robot: Robot, runs: Sequence[Trajectory]) -> str:
    """Why a calibrator is not for a robot, or not for runs of several sessions; empty if it is."""
    if not calibrator.applies(robot):
        return f"it is for {calibrator.only_for}, and {robot.name} is none"
    sessions = {run.session for run in runs}
    if calibrator.per_session and len(sessions) > 1:
        return f"its article calibrates from one session, and these are {len(sessions)}"
    return ""


def model_of_answer(
    problem: CalibrationProblem, matrix: Array, extension: saved.ModelExtension | None
) -> OdometryModel:
    """The odometry model of a matrix (3, M), with what extends it. OmnibenchError: an effect does not fit the robot."""
    return saved.extended_model(problem.robot, matrix, problem.integration, problem.sample_period, extension)


def calibration_of_fit(
    name: str, dataset: Dataset, matrix: Array, provenance: Mapping[str, Any], **fields: Any
) -> saved.Calibration:
    """The calibration with a matrix (3, M) that was fitted to a data set's training runs.

    provenance: fields of Provenance, without those of the data set. fields: the other fields of Calibration. DataError:
    the recordings led to values that no robot has.
    """
    origin = saved.Provenance(
        dataset=dataset.name,
        dataset_hash=dataset.hash,
        fitted=dataset.fingerprints("train"),
        simulated=dataset.simulated,
        **provenance,
    )
    try:
        return saved.Calibration(
            name=name,
            robot=dataset.robot,
            sample_period=dataset.sample_period,
            matrix=saved.matrix_rows(matrix),
            provenance=origin,
            **fields,
        )
    except ConfigError as error:
        reason = f"{error}".removeprefix("Calibration: ")
        raise DataError(
            f"calibration {name!r}: {reason}; check the recordings for poses and rates far from all others"
        ) from None


def describe_error(error: BaseException) -> str:
    """Type and message of an exception, in one line."""
    if isinstance(error, MemoryError) and (limit := memory_limit()) is not None:
        return f"out of memory (limit {limit:g} MB)"
    try:
        return one_line(f"{type(error).__name__}: {error}").removesuffix(":")
    except Exception:  # its own __str__ raises
        return type(error).__name__


def unloadable(failure: PluginFailure) -> type[Calibrator]:
    """A stand-in for a plug-in that cannot be imported: each of its runs fails with the reason."""

    class Unloadable(Calibrator):
        """A plug-in that cannot be imported."""

        Options = AnyOptions
        stochastic = False

        def calibrate(self, problem: CalibrationProblem) -> Solution:  # noqa: ARG002
            raise PluginError(f"{failure.origin} cannot be imported: {failure.error}")

    return Unloadable
