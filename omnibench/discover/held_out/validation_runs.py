"""The runs of the validation split that a model can predict, and warnings about them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.discover.fitting.model_fit import Fit, at_runs
from omnibench.discover.fitting.outliers import inliers_of
from omnibench.errors import DataError
from omnibench.fit.noise import repeating_runs
from omnibench.fit.trajectory_fit import in_start_frames, usable_runs
from omnibench.robot.model import OdometryModel

# Times, and s more than, the latest training run, from where on a session's time counts as new. Nothing but a warning
# hangs on them.
_LATER, _LATER_S = 1.1, 60


@dataclass(frozen=True, eq=False)
class ValidationRuns:
    """Runs of the validation split that the model can predict, which of their poses are outliers, and warnings.

    inliers: True (K,) for the poses of each run that are none; empty if none is an outlier.
    """

    runs: tuple[Trajectory, ...]
    inliers: tuple[NDArray[np.bool_], ...]
    warnings: tuple[str, ...]
    _fits: dict[OdometryModel, Fit] = field(default_factory=dict)

    def under(self, fit: Fit) -> Fit:
        """The model of a fit at the runs; each model is evaluated once."""
        there = self._fits.setdefault(fit.model, at_runs(fit, self.runs))
        nuisances = replace(there.nuisances, deviations=fit.nuisances.deviations)
        again = there.changed(noise=fit.noise, nuisances=nuisances, inliers=self.inliers)
        _ = again.residuals
        self._fits[fit.model] = again
        return again


def validation_runs(dataset: Dataset, fit: Fit) -> ValidationRuns:
    """Runs of the validation split that hold all that the effects of a fit need; jumps are told by its residuals."""
    recorded = [run for run in dataset.split("validation") if len(run.pose_times) > 1]
    able = [run for run in recorded if not _lacks_inputs(fit.model, run)]
    warnings = list(_beyond_training(fit, able))
    if len(able) < len(recorded):
        warnings.append(f"{len(recorded) - len(able)} held-out runs lack what an effect of the model needs: left out.")
    if not able:
        return ValidationRuns((), (), tuple(warnings))
    try:
        runs = usable_runs(able, "validation")
    except DataError as error:
        warnings.append(f"{error}; nothing is compared on it.")
        return ValidationRuns((), (), tuple(warnings))
    there = at_runs(fit, runs)
    there = there.changed(inliers=inliers_of(runs, in_start_frames(runs, there.residuals), fit.noise.noise))
    if there.jumps:
        warnings.append(f"{there.jumps} held-out poses contradict their neighbours; whitened χ² is without them.")
    return ValidationRuns(runs, there.inliers, tuple(warnings), {fit.model: there})


def noise_runs(runs: Sequence[Trajectory], dataset: Dataset) -> tuple[Trajectory, ...]:
    """Runs of the validation split that repeat training runs in their session, where no training run does."""
    try:
        return usable_runs(repeating_runs(runs, dataset.split("validation")), "validation")
    except DataError:
        return ()


def _lacks_inputs(model: OdometryModel, run: Trajectory) -> bool:
    """True if an effect of the model needs what was not recorded in the run."""
    needs = {need for term in model.terms for need in term.effect.needs}
    missing = {
        "wheel_angles": run.angles is None,
        "session_time": run.started_at is None,
        "session": run.session is None,
    }
    return any(missing.get(need, False) for need in needs)


def _beyond_training(fit: Fit, runs: Sequence[Trajectory]) -> Iterator[str]:
    """Warnings of sessions, and times in a session, that effects need and that no training run covers."""
    needs = {need: term.name for term in fit.model.terms for need in term.effect.needs}
    known = {run.session for run in fit.runs}
    if "session" in needs and (new := sorted({str(run.session) for run in runs} - {str(name) for name in known})):
        yield f"{needs['session']} says nothing of sessions that were not trained on: {', '.join(new[:3])}."
    latest = max((run.started_at or 0.0 for run in fit.runs), default=0.0)
    late = [run.id for run in runs if (run.started_at or 0.0) > _LATER * latest + _LATER_S]
    if "session_time" in needs and late:
        yield (
            f"{needs['session_time']} was fitted to the first {latest:.0f} s of a session; {len(late)} held-out runs "
            "are later, where it is not known to hold."
        )
