"""Errors of a study's answers on the runs that judge them: final pose, odometry minus reference, from the start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.errors import OmnibenchError
from omnibench.fit.calibrator import Outcome, RunResult
from omnibench.fit.evaluate import final_errors
from omnibench.fit.reference_rows import with_mean_errors
from omnibench.progress import Progress, Reporter
from omnibench.robot.calibration import extended_model
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration
from omnibench.robot.stored_odometry import odometry_of
from omnibench.study.study_plan import PlannedFit, StudiedRobot

_TOGETHER = 64  # matrices that are judged at once (chosen: 164 runs of 1,200 samples take 0.1 GB)


@dataclass(frozen=True, eq=False)
class JudgedFit:
    """A fit with its result and the errors (Z, 3) of its answer on all runs of the robot, m, m, rad; None without one.

    outcome, reason: the result's, or why there is none.
    """

    fit: PlannedFit
    result: RunResult | None
    outcome: Outcome
    reason: str
    errors: Array | None

    @property
    def answered(self) -> bool:
        """True if there is an answer."""
        return self.errors is not None


def judge_fits(
    fits: Sequence[PlannedFit],
    results: Mapping[int, RunResult],
    integration: Integration,
    progress: Reporter,
) -> tuple[tuple[JudgedFit, ...], dict[str, Array]]:
    """Every fit with its errors, and by robot the errors (Z, 3) of the design values.

    results: by the fit's place in ``fits``; those that are missing could not be asked.
    """
    judged: dict[int, JudgedFit] = {}
    design: dict[str, Array] = {}
    robots = {fit.robot.name: fit.robot for fit in fits}
    for name, robot in robots.items():
        judge = _Judge(robot, integration)
        design[name] = judge.of_matrices([robot.dataset.robot.inverse_kinematic_matrix])[0]
        mine = [index for index, fit in enumerate(fits) if fit.robot.name == name]
        progress(Progress("judging", len(judged), len(fits), "answer"))
        plain = [i for i in mine if i in results and results[i].matrix is not None and results[i].extension is None]
        matrices = [results[i].matrix for i in plain]
        errors = dict(zip(plain, judge.of_matrices([m for m in matrices if m is not None]), strict=True))
        for index in mine:
            judged[index] = judge.judged(fits[index], results.get(index), errors.get(index))
    progress(Progress("judging", len(fits), len(fits), "answer"))
    return tuple(judged[index] for index in range(len(fits))), design


class _Judge:
    """Judges answers on all runs of one robot."""

    def __init__(self, robot: StudiedRobot, integration: Integration) -> None:
        self._robot, self._integration = robot.dataset.robot, integration
        self._period, self._runs = robot.dataset.sample_period, robot.dataset.trajectories
        self._ends = np.array([run.final_pose for run in self._runs])
        self._odometry = odometry_of([run.final_log for run in self._runs], integration)

    def of_matrices(self, matrices: Sequence[Array]) -> list[Array]:
        """Errors (Z, 3) of each matrix (3, M)."""
        errors: list[Array] = []
        for first in range(0, len(matrices), _TOGETHER):
            poses = self._odometry.poses(np.array(matrices[first : first + _TOGETHER]))
            errors += [
                with_mean_errors(of_one - self._ends, matrix, self._runs, self._integration)
                for of_one, matrix in zip(poses, matrices[first : first + _TOGETHER], strict=True)
            ]
        return errors

    def judged(self, fit: PlannedFit, result: RunResult | None, errors: Array | None) -> JudgedFit:
        """A fit with its errors; an answer whose effects do not act on some run is a failed one."""
        if result is None:
            return JudgedFit(fit, None, Outcome.NOT_APPLICABLE, fit.reason, None)
        outcome, reason = result.outcome, result.reason
        if errors is None and result.matrix is not None:
            try:
                model = extended_model(
                    self._robot, result.matrix, self._integration, self._period, result.extension, fit.method.shown
                )
                errors = final_errors(model, self._runs)
            except OmnibenchError as error:
                outcome, reason = Outcome.FAILED, str(error)
        if errors is not None and not np.isfinite(errors).all():
            outcome, reason, errors = Outcome.INVALID, "its odometry is not finite on a run that judges it", None
        return JudgedFit(fit, result, outcome, reason, errors)
