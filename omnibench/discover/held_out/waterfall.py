"""The waterfall: errors on training and held-out runs, step by step as effects are added."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omnibench.discover.fitting.extend import Extended, extend
from omnibench.discover.fitting.model_fit import Fit
from omnibench.discover.held_out.gaps import errors_on
from omnibench.discover.held_out.validation_runs import ValidationRuns
from omnibench.discover.regressors.column_group import Group
from omnibench.discover.result import Step
from omnibench.robot.kinematics import Array


def waterfall_steps(
    plain: Fit, baseline: Extended, used: Extended, extended: Extended, validation: ValidationRuns
) -> tuple[Step, ...]:
    """The plain matrix (baseline), then the models with one effect more each; all under the extended model's noise.

    used: the model with the effects that are named, one after another. extended: the last model, which may be the
    average of that one and others. plain: the fit that models between the first and the last are extended from.
    """
    models = [("plain matrix", baseline)]
    for count in group_counts(used.groups):
        model = extended if count == len(used.groups) else extend(plain, used.groups[:count])
        models.append((f"+ {step_name(used.groups[count - 1])}", model))
    return tuple(_step(name, model.fit, extended.fit, validation) for name, model in models)


def group_counts(groups: Sequence[Group]) -> list[int]:
    """The number of groups after each step: named effects come one by one, terms without a name all at once."""
    named = sum(group.basis is None for group in groups)
    return [*range(1, named + 1), *([len(groups)] if len(groups) > named else [])]


def step_name(group: Group) -> str:
    """The name of the step that adds a group."""
    return group.name if group.basis is None else f"unnamed, over {group.basis.covariate}"


def _step(name: str, fit: Fit, extended: Fit, validation: ValidationRuns) -> Step:
    """Errors of a step's model; on held-out runs as ``compare_held_out`` has them."""
    errors = errors_on(replace(extended, model=fit.model), validation) if validation.runs else None
    return Step(
        name,
        _chi2(fit.changed(noise=extended.noise)),
        None if errors is None else float(errors.chi2.mean()),
        _eq6(fit.nuisance_free_residuals),
        None if errors is None else float(errors.eq6.mean()),
    )


def _chi2(fit: Fit) -> float:
    white = np.concatenate([weigh(values) for weigh, values in zip(fit.weightings, fit.residuals, strict=True)])
    return float(np.square(white).mean())


def _eq6(residuals: Sequence[Array]) -> float:
    return float(np.mean([np.linalg.norm(values[-1]) for values in residuals]))
