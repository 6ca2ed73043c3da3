"""Most probable matrix and lost wheel rate, by the whole paths and by what is known of the robot's design.

The unknowns are x = (z, d): the matrix K = K0 + L z with a root L of the prior's covariance (prior.py), and
the rate d that every turning wheel gains or loses (effect ``wheel_dead_zone``), of standard deviation s. A run's path
is cut into eight stretches and its end. With the medians r = (x, y, heading) of the odometry's errors at the reference
poses of each stretch, which single poses that have jumped do not move,

    minimise  sum_runs 1/T sum_stretches h((r_x^2 + r_y^2) / p^2 + r_h^2 / q^2)  +  |z|^2 + (d / s)^2,      (1)

T being the run's stretches: a run counts as one observation, since what the model misses in it (slip, its start) is the
same along it. h is Huber's, so that stretches that are far off pull in proportion and not by their square. p and q are
the deviations that the errors have at the minimum,

    p^2 = sum w (r_x^2 + r_y^2) / (2 (n - 1)),    q^2 = sum w r_h^2 / (n - 1),                              (2)

with Huber's weights w, scaled to n runs. Gauss-Newton steps solve (1), with p and q taken anew after each. The first
ones take p and q as 1 cm and 10 mrad: from the errors of the design, data would seem to say nothing. h looks at the
mean of the three squares of a stretch.

Runs that are longer, or turn more, err by more than p and q say. So the covariance is not the inverse of the Hessian H
of half of (1), but has the scatter of the n runs in it. With the part H_r of a run in H, and the slope g_r of its part,
which without it would move the minimum by d_r, and the prior's own part 1 in H,

    d_r = (H - H_r)^-1 g_r,    covariance = L (H^-1 H^-1 + (n - 1) / n sum_r d_r d_r^T) L^T                  (3)

(the sandwich with a jackknife's middle, MacKinnon and White, J. Econometrics 29:305, 1985; of one run, L H^-1 L^T). L
has a last row and column for d. Where h is straight, a stretch whose weighted errors are e, with the slopes J, has

    H_s = J^T (1 - e e^T / |e|^2) J.                                                                       (4)

tests/studies/posterior_coverage.py: with slip that differs from run to run the errors are 1.1 to 1.4 stated standard
deviations from six runs on, and 1.4 (ahead) and 2.1 (turning) of four runs.

Source: maximum a posteriori estimate with variances by empirical Bayes, as the shrinkage of shrinkage.py, but along
the whole path, with a physical prior and with the one effect that all robots here have in common.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import block_diag

from omnibench.config import NonNegative
from omnibench.data.dataset import Trajectory
from omnibench.errors import DataError, NotApplicableError
from omnibench.fit.calibrate import corrected_runs
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.prior import physical_prior_root, physical_tolerance
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import Options, calibrators
from omnibench.robot.calibration import EffectTerm, ModelExtension, covariance_rows
from omnibench.robot.effects.effect import Term, make_term
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import OdometryBatch

_EFFECT, _PARAMETER = "wheel_dead_zone", "c"
# Half and twice of stretches and of Huber's constant change the mean error of a robot by 7 % at most (prior_study.py).
_STRETCHES = 8  # stretches that a run's path is cut into (chosen)
_POSES = 12  # most reference poses of a stretch that are looked at: their median is as steady (chosen)
_FIRST, _FIRST_STEPS = 0.01, 4  # m and rad, see the module's docstring
_LEAST = 0.003  # m and rad: smaller deviations are those of motion capture, not of the model (chosen)
_HUBER = 1.0  # deviations: about half of the stretches lie beyond, if three numbers are normal (chosen)
_MOST_STEPS, _RESTING = 40, 1e-5  # steps, and the largest step, in prior deviations, that counts as none
_STEP = 0.1  # share of the prior's deviation by which the lost rate is moved for its derivative


class PosteriorOptions(Options):
    """Option: the lost wheel rate that is fitted beside the matrix."""

    lost_rate: NonNegative | None = Field(
        None,
        description="standard deviation of the rate that turning wheels lose, rad/s; 0: none; default: the class's",
    )


@calibrators.register("posterior")
class Posterior(Calibrator):
    """Most probable wheels, track and lost wheel rate, given the whole paths and the design (maximum a posteriori)."""

    Options = PosteriorOptions
    options: PosteriorOptions
    bounded = False  # its prior takes the place of the box
    as_is = True
    extends = True
    stochastic = False

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Gauss-Newton steps on Eq. (1). NotApplicableError: a run has no reference poses."""
        self.needs_matrix(problem)
        if not all(run.has_poses for run in problem.trajectories):
            raise NotApplicableError("it is for runs with reference poses; take trajectory_ml for other references")
        tolerance = physical_tolerance(problem.robot)
        lost = tolerance.lost_rate if self.options.lost_rate is None else self.options.lost_rate
        fit = _Fit(problem, physical_prior_root(problem.robot, tolerance), lost)
        unknowns, covariance, steps, rests = fit.minimum()
        matrix, rate = fit.answer(unknowns)
        end = f"at rest after {steps} steps" if rests else f"not at rest after {steps} steps"
        extension, words = None, end
        if lost:
            effect = EffectTerm(name=_EFFECT, parameters={_PARAMETER: rate})
            extension = ModelExtension(effects=(effect,), covariance=covariance_rows(covariance))
            words = f"{end}; turning wheels {'gain' if rate > 0 else 'lose'} {abs(rate):.4f} rad/s"
        if not np.isfinite(problem.cost(matrix.reshape(1, -1))).all():
            raise DataError("the cost of its answer is not finite")
        return Solution(matrix.ravel(), words, converged=rests, extension=extension)


class _Fit:
    """Eq. (1) for the runs of a problem. root: of the prior (3M, k). lost: deviation of the rate, rad/s; 0: none."""

    def __init__(self, problem: CalibrationProblem, root: Array, lost: float) -> None:
        self._problem, self._lost = problem, lost
        self._root = block_diag(root, [[lost]]) if lost else root
        self._design = problem.robot.inverse_kinematic_matrix
        self._chosen: list[NDArray[np.intp]] = []  # indices of the reference poses that are looked at
        stretches = []  # the stretch of each of a run's poses; its end, where the robot stands, is one of its own
        for run in problem.trajectories:
            count = len(run.pose_times) - 1
            spread = np.linspace(1, count, min(_POSES * _STRETCHES, count))
            self._chosen.append(np.unique(np.round(spread).astype(np.intp)))
            looked_at = len(self._chosen[-1])
            parts = np.arange(looked_at) * _STRETCHES // looked_at
            parts[-1] = _STRETCHES
            stretches.append(np.unique(parts, return_inverse=True)[1].astype(np.intp))
        offsets = np.cumsum([0, *(int(of_run.max()) + 1 for of_run in stretches)])
        self._firsts = offsets[:-1]  # each run's first stretch
        self._stretch: NDArray[np.intp] = np.concatenate(
            [of_run + offset for of_run, offset in zip(stretches, offsets, strict=False)]
        )
        counts = np.diff(offsets)
        self._shares: Array = np.repeat(1 / counts, counts)  # 1/T of Eq. (1)
        self._runs = len(problem.trajectories)
        self._reference = np.concatenate(
            [run.poses[chosen] for run, chosen in zip(problem.trajectories, self._chosen, strict=True)]
        )

    def answer(self, unknowns: Array) -> tuple[Array, float]:
        """The matrix (3, M), and the rate that turning wheels gain, rad/s."""
        size, values = self._design.size, self._root @ unknowns
        return self._design + values[:size].reshape(self._design.shape), float(values[size]) if self._lost else 0.0

    def minimum(self) -> tuple[Array, Array, int, bool]:
        """The unknowns at the minimum, covariance of matrix and rate, steps, and whether they came to rest."""
        unknowns, weights = np.zeros(self._root.shape[1]), np.ones(len(self._shares))
        scaled, errors, steps, rests = np.empty((0, 3, len(unknowns))), np.empty((0, 3)), 0, False
        while steps < _MOST_STEPS and not rests and (self._problem.seconds_left > 0 or not steps):
            medians, slopes = self._errors(unknowns)
            deviations = np.full(3, _FIRST)
            if steps >= _FIRST_STEPS:  # p, p and q of Eq. (2)
                shares = weights * self._shares
                squares = self._runs / shares.sum() * (shares @ medians**2) / max(self._runs - 1, 1)
                place = (squares[0] + squares[1]) / 2
                deviations = np.maximum(np.sqrt([place, place, squares[2]]), _LEAST)
            weights = 1 / np.maximum(np.sqrt(np.square(medians / deviations).mean(axis=1)) / _HUBER, 1.0)
            scales = np.sqrt(weights * self._shares)[:, None] / deviations
            scaled, errors = slopes * scales[..., None], medians * scales
            information = np.einsum("sci,scj->ij", scaled, scaled) + np.eye(len(unknowns))
            step = np.linalg.solve(information, -np.einsum("sci,sc->i", scaled, errors) - unknowns)
            unknowns, steps = unknowns + step, steps + 1
            rests = steps > _FIRST_STEPS and bool(np.abs(step).max() < _RESTING)
            self._problem.report(steps, _MOST_STEPS, "step")
        return unknowns, self._covariance(scaled, errors, weights < 1), steps, rests

    def _covariance(self, scaled: Array, errors: Array, far: NDArray[np.bool_]) -> Array:
        """Eq. (3) and (4) of matrix and rate, from weighted slopes (S, 3, k), errors (S, 3), and which are far off."""
        slopes = np.einsum("sci,sc->si", scaled, errors)
        bent = slopes * (far / np.maximum(np.linalg.norm(errors, axis=1), np.finfo(float).tiny))[:, None]
        curvatures = np.einsum("sci,scj->sij", scaled, scaled) - np.einsum("si,sj->sij", bent, bent)
        of_runs = np.add.reduceat(curvatures, self._firsts, axis=0)
        whole = of_runs.sum(axis=0) + np.eye(slopes.shape[1])
        inverse = np.linalg.inv(whole)
        if self._runs > 1:
            gradients = np.add.reduceat(slopes, self._firsts, axis=0)
            moved = np.linalg.solve(whole - of_runs, gradients[..., None])[..., 0]
            inverse = inverse @ inverse + (self._runs - 1) / self._runs * moved.T @ moved
        return np.asarray(self._root @ inverse @ self._root.T)

    def _errors(self, unknowns: Array) -> tuple[Array, Array]:
        """Medians (S, 3) of the errors by stretch, and their derivatives (S, 3, k) by the unknowns."""
        (matrix, rate), size = self.answer(unknowns), self._design.size
        odometry = self._odometry(rate)
        poses = odometry.poses(matrix[None])[0]
        slopes = odometry.jacobian(matrix).reshape(len(poses), 3, -1) @ self._root[:size]
        if self._lost:
            further = self._odometry(rate + _STEP * self._lost).poses(matrix[None])[0]
            slopes += ((further - poses) / (_STEP * self._lost))[..., None] * self._root[size]
        # Medians of the errors and means of their derivatives; poses stand in the stretches' order.
        edges = np.searchsorted(self._stretch, np.arange(int(self._stretch[-1]) + 1))
        counts = np.diff([*edges, len(self._stretch)])
        medians = np.array([np.median(part, axis=0) for part in np.split(poses - self._reference, edges[1:])])
        means: Array = np.add.reduceat(slopes, edges, axis=0) / counts[:, None, None]
        return medians, means

    def _odometry(self, rate: float) -> OdometryBatch:
        """The odometry at the poses looked at, of wheels that gain a rate, rad/s, when they turn."""
        problem = self._problem
        runs: Sequence[Trajectory] = problem.trajectories
        if rate:
            term: Term = make_term(_EFFECT, {_PARAMETER: rate}, problem.robot)
            runs = corrected_runs(problem.robot, runs, [term], problem.sample_period)
        logs = [run.log(run.pose_times[chosen]) for run, chosen in zip(runs, self._chosen, strict=True)]
        return OdometryBatch(logs, problem.integration)
