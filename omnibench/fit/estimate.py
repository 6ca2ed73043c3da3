"""The most probable odometry model of a robot: by its references, and by what is known of its design.

The unknowns u are independent standard normal numbers before the robot has been driven. They are what the matrix K has
beyond its design K0, by a root L of the class's prior (prior.py), the parameters b of effects beside the matrix, and
the offsets of gyros, one a session:

    K = K0 + L z,    b = b0 + s e,    u = (z, e, o).                                                            (1)

Everything that was observed is a row of errors r of x, y and heading (or of a length, or an angle), predicted less
observed, which has the standard deviation sigma by what measured it. A run's poses are cut into five stretches of its
path and its end; a stretch is one row, the medians of its errors, sigma 0, which single poses that have jumped do not
move. What the model misses, such as slip, is the same along a run, however often it is measured: with T rows of one
kind in a run, a row counts with the variance

    v = sigma^2 + T w^2,                                                                                   (2)

so that a run counts as one observation of what its rows share, and as T of what measured them. What is minimised is

    sum over rows  rho(r) / v  +  |u|^2,    rho by the loss at  x^2 = sum r^2 / (sigma^2 + w^2),           (3)

with Huber's corner, so that rows that are far off pull in proportion and not by their square. w is what the errors of a
kind show beyond sigma at the minimum: with the loss's weights h, and over the n runs that have some,

    w^2 = n / (n - 1) sum (h/T) r^2 / sum (h/T)  -  sum (h/T) sigma^2 / sum (h/T).                         (4)

Gauss-Newton steps solve (3), with w and h taken anew after each. The first ones take w as 1 cm and 10 mrad: from the
errors of the design, data would seem to say nothing.

Nuisances of a run, its start heading or the offset and slope of its reference's clock, have normal priors, too, and are
eliminated from the normal equations of their run (Schur complement).

Source: maximum a posteriori estimate with variances by empirical Bayes (Efron and Morris, J. Am. Stat. Assoc. 70:311,
1975), which bears a model that is wrong in small things: the errors that it cannot explain set the weights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Trajectory
from omnibench.data.stored import median_period
from omnibench.errors import ConfigError, DataError
from omnibench.fit.loss import Loss, LossName, make_loss
from omnibench.fit.prior import physical_prior_root, physical_tolerance
from omnibench.fit.reference_rows import ReferenceBatch, reference_rows
from omnibench.registry import effects
from omnibench.robot.corrections import driven_signals
from omnibench.robot.effects.effect import Term, make_term
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, OdometryBatch, WheelLog
from omnibench.robot.stored_odometry import together

# 5, 8 and 12 stretches make the same mean error on six real robots within 4 % (the cells of configs/real_robots.yaml).
_STRETCHES = 5  # stretches that a run's path is cut into; chosen
_POSES = 12  # most reference poses of a stretch that are looked at: their median is as steady; chosen
_FIRST, _FIRST_STEPS = 0.01, 4  # m and rad, and steps: see the module's docstring
LEAST = 0.003  # m and rad: smaller errors along a path are those of motion capture, not of the model; chosen
_STEP = 0.1  # prior deviations by which a parameter of an effect is moved for its derivative
_MOST_STEPS, _RESTING = 40, 1e-4  # steps, and the largest step, in prior deviations, that counts as none
_UNTOLD = 1e3  # times its sigma: weight of a position of a run that hardly leaves its place, and tells no heading
LOST_RATE = ("wheel_dead_zone", "c")  # the effect that every robot has, and its parameter
# rad and s, of start headings and of clocks that were set by hand; with them the mean error on the same robots is 0.98
# times as large as without, with none of the robots more than 1 % worse; of the two chosen.
USUAL_NUISANCES = (0.005, 0.1)
PLACE, HEADING = "pose position", "pose heading"  # kinds of error of poses


@dataclass(frozen=True)
class Unknown:
    """A parameter of an effect on wheels or steering that is estimated beside the matrix.

    middle, deviation: mean and standard deviation of its prior, in the parameter's unit.
    """

    effect: str
    parameter: str
    deviation: float
    middle: float = 0.0


@dataclass(frozen=True)
class Nuisances:
    """Prior standard deviations of what is estimated of each run with poses: rad, s, s per s; 0: known exactly."""

    start_heading: float = 0.0
    clock_offset: float = 0.0
    clock_slope: float = 0.0

    @property
    def deviations(self) -> Array:
        """The deviations (3,)."""
        return np.array([self.start_heading, self.clock_offset, self.clock_slope])


@dataclass(frozen=True, eq=False)
class Estimate:
    """The most probable model, and what each run says of it.

    matrix (3, M), m and rad per rad. terms: effects beside it. unknowns (k,): as in Eq. (1). root (3M + p, k):
    derivatives of the matrix elements, row by row, and of the p parameters of the effects by these. information
    (Z, k, k) and scores (Z, k): Hessian and slope of half of each run's part of Eq. (3) at the minimum. excess: w of
    Eq. (4) by the kind of error, m or rad. values (3M + p,): matrix elements, row by row, and parameters.
    """

    matrix: Array
    terms: tuple[Term, ...]
    unknowns: Array
    root: Array
    information: Array
    scores: Array
    excess: dict[str, float]
    steps: int
    at_rest: bool
    values: Array

    @property
    def error(self) -> float:
        """The product of the excess errors: the smaller, the better the runs are explained."""
        return float(np.prod(list(self.excess.values())))

    def model(self, problem: EstimateProblem) -> OdometryModel:
        """The odometry model that was estimated for a problem."""
        return OdometryModel(problem.robot, self.matrix, problem.integration, self.terms, problem.sample_period)


@dataclass(frozen=True, eq=False)
class EstimateProblem:
    """The runs, the prior and the options of an estimate.

    root (3M, q): of the prior's covariance of the matrix elements about the design. sample_period: nominal, s.
    """

    robot: Robot
    runs: Sequence[Trajectory]
    root: Array
    integration: Integration
    sample_period: float
    unknowns: tuple[Unknown, ...] = ()
    nuisances: Nuisances = Nuisances()
    loss: LossName = "huber"
    stretches: int = _STRETCHES

    @property
    def size(self) -> int:
        """Number of matrix elements and parameters of effects."""
        return len(self.root) + len(self.unknowns)

    def values(self, unknowns: Array) -> Array:
        """The matrix elements, row by row, and the parameters of effects of unknowns (k,), Eq. (1)."""
        count = self.root.shape[1]
        elements = self.robot.inverse_kinematic_matrix.ravel() + self.root @ unknowns[:count]
        shares = zip(self.unknowns, unknowns[count:].tolist(), strict=False)
        return np.append(elements, [unknown.middle + share * unknown.deviation for unknown, share in shares])

    def answer(self, unknowns: Array) -> tuple[Array, tuple[Term, ...]]:
        """The matrix (3, M) and the effects of unknowns (k,)."""
        values = self.values(unknowns)
        by_effect: dict[str, dict[str, float]] = {}
        for unknown, value in zip(self.unknowns, values[len(self.root) :].tolist(), strict=True):
            by_effect.setdefault(unknown.effect, {})[unknown.parameter] = value
        terms = tuple(make_term(name, parameters, self.robot) for name, parameters in by_effect.items())
        return values[: len(self.root)].reshape(self.robot.inverse_kinematic_matrix.shape), terms


@dataclass(frozen=True, eq=False)
class Linearisation:
    """A model at the runs of a problem, in whose place its slopes stand near it.

    values (3M + p,): the matrix elements, row by row, and the parameters of effects. errors (K, 3), columns
    (K, 3, 3M + p) and drifts (K, 3, 3) of each run: predicted less observed poses after the start, and their
    derivatives by the values and by the run's nuisances.
    """

    values: Array
    errors: Sequence[Array]
    columns: Sequence[Array]
    drifts: Sequence[Array]


def usual_problem(robot: Robot, runs: Sequence[Trajectory], integration: Integration = "arc") -> EstimateProblem:
    """What the calibrator map estimates by its default options: matrix, lost rate, start headings and clocks."""
    tolerance = physical_tolerance(robot)
    root = physical_prior_root(robot, tolerance)
    lost = (Unknown(*LOST_RATE, tolerance.lost_rate),)
    return EstimateProblem(robot, runs, root, integration, median_period(runs), lost, Nuisances(*USUAL_NUISANCES))


STEERING = ("steering_gain", "steering_play", "steering_offset", "steering_coupling")
# Factors on the measured angle about which a gain is looked for, each with itself as the standard deviation, so that
# its neighbours are within one: gears between an encoder and its wheel are seldom known worse.
_FACTORS = (0.5, 1.0, 2.0, 4.0, 8.0)


def estimate_with_steering(problem: EstimateProblem, may_go_on: Callable[[int], bool] = lambda _: True) -> Estimate:
    """The estimate with the steering's gain, play and coupling, or a car's zero, beside the problem's unknowns.

    A gain is looked for about each of some factors, and the one that explains the runs best is taken. The plausible
    ranges are the prior's standard deviations, but a gain's is its factor. A lag is not among them: a wrong clock of
    the reference looks alike, and ``discover`` tells when it can. ConfigError: the robot has no steering.
    """
    robot = problem.robot
    steering = [effect for effect in map(effects.create, STEERING) if effect.applies(robot)]
    if not steering:
        raise ConfigError(f"steering: fit is for wheels that steer; robot {robot.name} has none")
    tries = []
    for factor in _FACTORS:
        more = [
            Unknown(
                effect.name, number.name, *((factor, factor - 1) if effect.name == STEERING[0] else (number.largest,))
            )
            for effect in steering
            for number in effect.parameters(robot)
        ]
        tries.append(estimate(replace(problem, unknowns=(*problem.unknowns, *more)), may_go_on))
    return min(tries, key=lambda tried: tried.error)


def estimate(
    problem: EstimateProblem,
    may_go_on: Callable[[int], bool] = lambda _: True,
    near: Estimate | None = None,
    about: Linearisation | None = None,
) -> Estimate:
    """The minimum of Eq. (3) by Gauss-Newton steps. DataError: no run has a reference after its start.

    may_go_on: asked before each step but the first, with the number of those that were made. near: where the steps
    begin, in the place of the design. about: a linearisation that stands for the model, whose terms are the caller's;
    then references other than poses do not count.
    """
    rows, loss = _Rows(problem) if about is None else _LinearRows(problem, about), make_loss(problem.loss, 3)
    unknowns = np.zeros(problem.root.shape[1] + len(problem.unknowns) + rows.gyros)
    if near is not None:
        common = min(len(unknowns), len(near.unknowns)) if near.root.shape[0] == problem.size else problem.root.shape[1]
        unknowns[:common] = near.unknowns[:common]
    excess: Array = np.full(len(rows.kinds), _FIRST)
    weights: Array = np.ones(len(rows.run))
    first = 0 if near is None else _FIRST_STEPS
    steps, at_rest = first, False
    drifts: Array = np.empty(0)
    while steps < _MOST_STEPS and not at_rest and (steps == first or may_go_on(steps)):
        errors, slopes = rows.linearised(unknowns)
        if steps in (first, _FIRST_STEPS):  # they change by shares of a per cent with the matrix
            drifts = rows.drifts(unknowns)
        if drifts.shape[2]:  # each run's nuisances at their likeliest
            inner, along = rows.of_nuisances(drifts, weights[:, None] * rows.precisions(excess), errors[..., None])
            likeliest = -np.linalg.solve(inner, along)[..., 0]
            errors = errors + np.einsum("scm,sm->sc", drifts, likeliest[rows.run])
        if steps >= _FIRST_STEPS:
            excess = rows.excess(errors, weights)
        weights = loss.weights(np.sqrt(np.nansum(np.square(errors) / rows.variances(excess), axis=1)))
        weights = weights / loss.weights(np.zeros(1))
        information, scores = rows.normal_equations(errors, slopes, drifts, weights[:, None] * rows.precisions(excess))
        step = -np.linalg.solve(information.sum(axis=0) + np.eye(len(unknowns)), scores.sum(axis=0) + unknowns)
        unknowns, steps = unknowns + step, steps + 1
        at_rest = steps > _FIRST_STEPS and bool(np.abs(step).max() < _RESTING)
    values = problem.values(unknowns)
    matrix = values[: len(problem.root)].reshape(problem.robot.inverse_kinematic_matrix.shape)
    terms = problem.answer(unknowns)[1] if about is None else ()
    root = np.zeros((problem.size, len(unknowns)))
    root[: matrix.size, : problem.root.shape[1]] = problem.root
    for number, unknown in enumerate(problem.unknowns):
        root[matrix.size + number, problem.root.shape[1] + number] = unknown.deviation
    information = rows.curvature(errors, slopes, drifts, weights, excess, loss)
    kinds = dict(zip(rows.kinds, excess.tolist(), strict=True))
    return Estimate(matrix, terms, unknowns, root, information, scores, kinds, steps - first, at_rest, values)


class _Rows:
    """The rows of errors of a problem.

    run (S,): index of each row's run. sigmas (S, 3): NaN where nothing was measured. kinds: names of the kinds of
    error. gyros: number of the sessions whose gyro has an offset.
    """

    def __init__(self, problem: EstimateProblem) -> None:
        self._problem = problem
        self._posed = [index for index, run in enumerate(problem.runs) if run.has_poses]
        self._chosen = [_chosen(len(problem.runs[index].pose_times), problem.stretches) for index in self._posed]
        counts = [len(firsts) for _, firsts in self._chosen]
        self.run = np.repeat(np.array(self._posed, dtype=np.intp), counts)
        self.sigmas, names = np.zeros((len(self.run), 3)), [(PLACE, PLACE, HEADING)] * len(self.run)
        measured = [index for index, run in enumerate(problem.runs) if run.references is not None]
        self._references = reference_rows([problem.runs[index] for index in measured], "none") if measured else None
        self._offsets = np.zeros((len(self.run), 3, 0))
        if self._references is not None:
            rows = self._references
            self.run = np.append(self.run, np.array(measured, dtype=np.intp)[rows.trajectory])
            sigmas = np.where(rows.tells_no_heading[:, None] & [True, True, False], _UNTOLD, 1.0) * rows.sigmas
            self.sigmas = np.vstack([self.sigmas, sigmas])
            # A displacement's error ahead is the way's, to the side the heading's
            sides = {"displacement": ("displacement ahead", "displacement aside")}
            names += [
                (*sides.get(length, (length, length)), angle)
                for length, angle in zip(rows.lengths.tolist(), rows.angles.tolist(), strict=True)
            ]
            # Parts of a recording, cut where samples are missing, are sessions with a number: name#2
            sessions = [(run.session or "").partition("#")[0] for run in rows.runs]
            with_offset = [bool(run.references and run.references.rate_sigma) for run in rows.runs]
            gyros = list(dict.fromkeys(name for name, gyro in zip(sessions, with_offset, strict=True) if gyro))
            columns = np.array([[name == gyro for gyro in gyros] for name in sessions], dtype=float)
            of_rows = rows.offset_sigmas[..., None] * columns.reshape(len(sessions), -1)[rows.trajectory][:, None]
            self._offsets = np.concatenate([np.zeros((len(self.run) - len(of_rows), *of_rows.shape[1:])), of_rows])
        if not len(self.run):
            raise DataError("no trajectory has a reference pose after its start; nothing can be fitted")
        self.gyros = self._offsets.shape[2]
        seen = ~np.isnan(self.sigmas)
        self.kinds = list(dict.fromkeys(np.array(names)[seen].tolist()))
        self._kind = np.array([[self.kinds.index(name) if name in self.kinds else 0 for name in row] for row in names])
        # T of Eq. (2)
        self._together = np.ones(self.sigmas.shape)
        for kind in range(len(self.kinds)):
            of_kind = seen & (self._kind == kind)
            in_runs = np.bincount(self.run[of_kind.any(axis=1)], minlength=len(problem.runs))
            self._together[of_kind] = np.broadcast_to(in_runs[self.run][:, None], of_kind.shape)[of_kind]

    def linearised(self, unknowns: Array) -> tuple[Array, Array]:
        """Errors (S, 3) and their derivatives (S, 3, k) by the unknowns; 0 for what was not measured."""
        problem, count = self._problem, self._problem.root.shape[1]
        errors, jacobian = self._of_model(*problem.answer(unknowns), slopes=True)
        columns = [jacobian @ problem.root]
        for number in range(len(problem.unknowns)):
            moved = unknowns.copy()
            moved[count + number] += _STEP
            further, _ = self._of_model(*problem.answer(moved), slopes=False)
            columns.append(((further - errors) / _STEP)[..., None])
        offsets = unknowns[count + len(problem.unknowns) :]
        return errors + self._offsets @ offsets, np.concatenate([*columns, self._offsets], axis=2)

    def drifts(self, unknowns: Array) -> Array:
        """Derivatives (S, 3, m) of the errors by the nuisances that are estimated, in their deviations."""
        deviations = self._problem.nuisances.deviations
        used, stretches = deviations > 0, list[Array]()
        if not used.any():
            return np.zeros((len(self.run), 3, 0))
        matrix, terms = self._problem.answer(unknowns)
        for logs, firsts, _ in self._driven(terms):
            odometry = OdometryBatch(logs, self._problem.integration)
            poses, stamps = odometry.poses(matrix[None])[0], np.concatenate([log.stamps for log in logs])
            path = poses - np.array([log.start for log in logs])[odometry.trajectory]
            turned, velocity = np.stack([-path[:, 1], path[:, 0], np.ones(len(path))], axis=1), np.zeros(poses.shape)
            if used[1:].any():
                # Differences over two samples: the rate of a single one has its full encoder noise
                period = self._problem.sample_period
                shifted = (
                    [replace(log, stamps=log.stamps + by).continued(float(log.stamps[-1] + by)) for log in logs]
                    for by in (period, -period)
                )
                late, early = (
                    OdometryBatch(each, self._problem.integration).poses(matrix[None])[0] for each in shifted
                )
                velocity = (late - early) / (2 * period)
            columns = np.stack([turned, -velocity, -velocity * stamps[:, None]], axis=2) * deviations
            stretches.append(_means(columns[..., used], firsts))
        others = len(self.run) - sum(map(len, stretches))
        return np.concatenate([*stretches, np.zeros((others, 3, int(used.sum())))])

    def _of_model(self, matrix: Array, terms: Sequence[Term], *, slopes: bool) -> tuple[Array, Array]:
        """Errors (S, 3) by a matrix (3, M) and effects, and their derivatives (S, 3, 3M) by its elements, if wanted."""
        errors, jacobians = list[Array](), list[Array]()
        for logs, firsts, seen in self._driven(terms):
            odometry = OdometryBatch(logs, self._problem.integration)
            poses = odometry.poses(matrix[None])[0]
            errors += list(_medians(poses - seen, firsts))
            if slopes:
                jacobians.append(_means(odometry.jacobian(matrix).reshape(len(poses), 3, -1), firsts))
        if self._references is not None:
            rows = replace(self._references, runs=self._corrected(self._references.runs, terms))
            batch = ReferenceBatch(rows, self._problem.integration)
            predicted = batch.poses(matrix[None])[0]
            errors += list(np.where(rows.measured, predicted - rows.observed, 0.0))
            if slopes:
                jacobian = batch.jacobian(matrix).reshape(len(predicted), 3, -1)
                jacobians.append(np.where(rows.measured[..., None], jacobian, 0.0))
        return np.array(errors), np.concatenate(jacobians) if slopes else np.empty(0)

    def _driven(self, terms: Sequence[Term]) -> Iterator[tuple[list[WheelLog], NDArray[np.intp], Array]]:
        """Logs of the runs with poses, corrected by effects, a part at a time.

        With each part come the indices of its stretches' first poses, and the reference poses (K, 3).
        """
        number = 0
        for part in together([self._problem.runs[index] for index in self._posed]):
            chosen = self._chosen[number : number + len(part)]
            number += len(part)
            seen = np.concatenate([run.poses[index] for run, (index, _) in zip(part, chosen, strict=True)])
            starts = np.cumsum([0, *(len(index) for index, _ in chosen)])
            firsts = np.concatenate([first + start for (_, first), start in zip(chosen, starts, strict=False)])
            driven = self._corrected(part, terms)
            yield [run.log(run.pose_times[index]) for run, (index, _) in zip(driven, chosen, strict=True)], firsts, seen

    def _corrected(self, runs: Sequence[Trajectory], terms: Sequence[Term]) -> tuple[Trajectory, ...]:
        acting = [term for term in terms if any(term.values.values())]
        problem = self._problem
        return corrected_runs(problem.robot, runs, acting, problem.sample_period) if acting else tuple(runs)

    def excess(self, errors: Array, weights: Array) -> Array:
        """w of Eq. (4) by kind, of errors (S, 3) with the loss's weights (S,)."""
        values = np.zeros(len(self.kinds))
        for number, kind in enumerate(self.kinds):
            rows, axes = np.nonzero((self._kind == number) & ~np.isnan(self.sigmas))
            shares = weights[rows] / self._together[rows, axes]
            count = len(np.unique(self.run[rows]))
            seen = count / max(count - 1, 1) * float(shares @ np.square(errors[rows, axes])) / shares.sum()
            known = float(shares @ np.square(self.sigmas[rows, axes])) / shares.sum()
            least = LEAST if kind in (PLACE, HEADING) else 0.0
            values[number] = np.sqrt(max(seen - known, least**2))
        return values

    def variances(self, excess: Array) -> Array:
        """sigma^2 + w^2 (S, 3) of each row by itself; NaN where nothing was measured."""
        return np.square(self.sigmas) + np.square(excess)[self._kind]

    def precisions(self, excess: Array) -> Array:
        """1/v (S, 3) of Eq. (2); 0 where nothing was measured."""
        return np.nan_to_num(1 / (np.square(self.sigmas) + self._together * np.square(excess)[self._kind]))

    def normal_equations(self, errors: Array, slopes: Array, drifts: Array, precisions: Array) -> tuple[Array, Array]:
        """Hessians (Z, k, k) and slopes (Z, k) of half of the runs' parts of Eq. (3), nuisances eliminated.

        errors (S, 3): with nuisances at their likeliest.
        """
        roots = np.sqrt(precisions)
        columns = slopes * roots[..., None]
        scores = self._by_run(np.einsum("sci,sc->si", columns, errors * roots))
        information = self._by_run(np.einsum("sci,scj->sij", columns, columns))
        if drifts.shape[2]:
            inner, along = self.of_nuisances(drifts, precisions, slopes)
            information = information - np.swapaxes(along, 1, 2) @ np.linalg.solve(inner, along)
        return information, scores

    def curvature(
        self, errors: Array, slopes: Array, drifts: Array, weights: Array, excess: Array, loss: Loss
    ) -> Array:
        """Hessians (Z, k, k) of half of the runs' parts of Eq. (3), nuisances eliminated.

        A row lacks x h'(x) of its weight along its error, where the loss is no parabola: of itself and of nuisances.
        """
        ratios = np.sqrt(np.nansum(np.square(errors) / self.variances(excess), axis=1))
        lost = np.clip(-loss.slopes(ratios) / loss.weights(np.zeros(1)), 0.0, weights)
        roots = np.sqrt(self.precisions(excess))
        scaled = errors * roots
        units = scaled / np.maximum(np.linalg.norm(scaled, axis=1), np.finfo(float).tiny)[:, None]
        whole, count = np.concatenate([slopes, drifts], axis=2) * roots[..., None], slopes.shape[2]
        along = np.einsum("sci,sc->si", whole, units) * np.sqrt(lost)[:, None]
        weighted = np.einsum("sci,scj->sij", whole * weights[:, None, None], whole)
        sums = self._by_run(weighted - along[:, :, None] * along[:, None, :])
        inner, beside = sums[:, count:, count:] + np.eye(drifts.shape[2]), sums[:, count:, :count]
        return sums[:, :count, :count] - np.swapaxes(beside, 1, 2) @ np.linalg.solve(inner, beside)

    def of_nuisances(self, drifts: Array, precisions: Array, slopes: Array) -> tuple[Array, Array]:
        """1 + N'PN (Z, m, m) and N'P J (Z, m, k) for the columns N of nuisances and J of others."""
        weighted = drifts * precisions[..., None]
        inner = self._by_run(np.einsum("sci,scj->sij", weighted, drifts)) + np.eye(drifts.shape[2])
        return inner, self._by_run(np.einsum("sci,scj->sij", weighted, slopes))

    def _by_run(self, values: Array) -> Array:
        """Sums (Z, ...) over the rows of each run."""
        sums = np.zeros((len(self._problem.runs), *values.shape[1:]))
        np.add.at(sums, self.run, values)
        return sums


class _LinearRows(_Rows):
    """The rows of errors of a problem about a linearisation."""

    def __init__(self, problem: EstimateProblem, about: Linearisation) -> None:
        super().__init__(replace(problem, runs=[replace(run, references=None) for run in problem.runs]))
        index = [chosen - 1 for chosen, _ in self._chosen]  # of the poses after the start
        starts = np.cumsum([0, *map(len, index)])
        self._firsts = np.concatenate([first + start for (_, first), start in zip(self._chosen, starts, strict=False)])
        self._about = about.values
        self._errors, self._columns, self._drifts = (
            np.concatenate([of_run[rows] for of_run, rows in zip(values, index, strict=True)])
            for values in (about.errors, about.columns, about.drifts)
        )

    def linearised(self, unknowns: Array) -> tuple[Array, Array]:
        problem, elements = self._problem, len(self._problem.root)
        apart = self._errors + self._columns @ (problem.values(unknowns) - self._about)
        errors = _medians(apart, self._firsts)
        columns = [_means(self._columns[..., :elements], self._firsts) @ problem.root]
        for number, unknown in enumerate(problem.unknowns):
            further = apart + _STEP * unknown.deviation * self._columns[..., elements + number]
            columns.append(((_medians(further, self._firsts) - errors) / _STEP)[..., None])
        return errors, np.concatenate(columns, axis=2)

    def drifts(self, unknowns: Array) -> Array:  # noqa: ARG002
        deviations = self._problem.nuisances.deviations
        return _means((self._drifts * deviations)[..., deviations > 0], self._firsts)


def _medians(values: Array, firsts: NDArray[np.intp]) -> Array:
    """Medians (S, 3) of values (K, 3) over stretches that begin at ``firsts``, those of one length at once."""
    counts, medians = np.diff([*firsts, len(values)]), np.empty((len(firsts), 3))
    for count in np.unique(counts).tolist():
        alike = np.flatnonzero(counts == count)
        medians[alike] = np.median(values[firsts[alike][:, None] + np.arange(count)], axis=1)
    return medians


def _means(values: Array, firsts: NDArray[np.intp]) -> Array:
    """Means (S, ...) of values (K, ...) over stretches that begin at ``firsts``."""
    counts = np.diff([*firsts, len(values)]).reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray(np.add.reduceat(values, firsts, axis=0) / counts)


def chosen_poses(run: Trajectory) -> NDArray[np.intp]:
    """Indices of the poses of a run that an estimate looks at."""
    return _chosen(len(run.pose_times), _STRETCHES)[0]


def _chosen(poses: int, stretches: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices of the poses of a run that are looked at, and of the first of each stretch among these.

    The last pose, where the robot stands, is a stretch of its own.
    """
    spread = np.linspace(1, poses - 1, min(_POSES * stretches, poses - 1))
    index = np.unique(np.round(spread).astype(np.intp))
    parts = np.arange(len(index)) * stretches // len(index)
    parts[-1] = stretches
    return index, np.unique(parts, return_index=True)[1].astype(np.intp)


def corrected_runs(
    robot: Robot, runs: Sequence[Trajectory], terms: Sequence[Term], sample_period: float
) -> tuple[Trajectory, ...]:
    """Runs whose rates are the drive signals (F, M) of a robot with effects on its wheels and steering angles."""
    design, made = robot.inverse_kinematic_matrix, list[Trajectory]()
    for part in together(runs):
        signals = driven_signals(terms, [run.final_log for run in part], robot, design, sample_period)
        for run, driven in zip(part, signals, strict=True):
            made.append(replace(run, rates=driven, steering=None, drive=None, angles=None))
    return tuple(made)
