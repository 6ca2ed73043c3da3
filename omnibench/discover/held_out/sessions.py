"""Sessions of training and validation runs compared by a discovery's model, and what their changes make of its errors.

Where both sessions are trained on, tyre_wear is an effect of the catalogue as any other. Where one is held out, the
change that explains its deviation is fitted here, beside the model.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.discover.fitting.extend import Extended
from omnibench.discover.fitting.model_fit import model_with
from omnibench.discover.held_out.validation_runs import ValidationRuns
from omnibench.fit.evaluate import final_errors
from omnibench.fit.sessions.session_contrast import sessions_of
from omnibench.fit.sessions.session_differences import SessionComparison, compare_sessions


def compare_with_validation(extended: Extended, validation: ValidationRuns) -> SessionComparison:
    """Comparison of all sessions by the extended model, as ``evaluate`` compares them."""
    fit = extended.fit
    held_out = validation.under(fit).at_inliers.runs if validation.runs else ()
    return compare_sessions(fit.model, [*fit.at_inliers.runs, *held_out])


def eq6_with_changes(extended: Extended, runs: Sequence[Trajectory], comparison: SessionComparison) -> float | None:
    """Eq. (6) on validation runs, m and rad, with the matrices of sessions that differ changed; None if none does."""
    names = sessions_of([*extended.fit.runs, *runs])[len(extended.fit.runs) :]
    changes = {each.session: np.array(each.matrix) for each in comparison.differences}
    if not changes.keys() & set(names):
        return None
    model, errors = extended.fit.model, list[float]()
    for name in dict.fromkeys(names):
        changed = model_with(model, model.matrix + changes.get(name, 0.0), model.terms)
        of_session = [run for run, other in zip(runs, names, strict=True) if other == name]
        errors += np.linalg.norm(final_errors(changed, of_session), axis=1).tolist()
    return float(np.mean(errors))
