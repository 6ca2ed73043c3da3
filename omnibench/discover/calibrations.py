"""Calibration files of the plain and of the extended model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.discover.fitting.extend import Extended
from omnibench.discover.selection.extrapolation import training_domain
from omnibench.environment import package_versions
from omnibench.errors import DataError
from omnibench.registry import costs
from omnibench.robot.calibration import (
    Calibration,
    EffectTerm,
    Provenance,
    covariance_rows,
    fitted_calibration,
    matrix_rows,
)


@dataclass(frozen=True)
class Request:
    """The options of a discovery, as discover_effects was called with them."""

    without: tuple[str, ...]
    unknown_term: bool
    seed: int


def calibration_of(
    dataset: Dataset,
    extended: Extended,
    name: str,
    request: Request,
    reason: str,
    plain: Extended | None = None,
) -> Calibration:
    """The calibration of a fit with its noise, covariance and provenance.

    reason: why the fit ended, in words. plain: the fit of the plain matrix, to which the effects of a model fade.
    """
    terms = tuple(EffectTerm.of(term) for term in extended.fit.model.terms)
    return fitted_calibration(
        name=f"{dataset.name} {name}",
        robot=dataset.robot,
        sample_period=dataset.sample_period,
        matrix=matrix_rows(extended.fit.model.matrix),
        integration=extended.fit.model.integration,
        effects=terms,
        noise=extended.fit.noise.noise,
        covariance=covariance_rows(extended.covariance_of_terms),
        session=extended.fit.runs[0].session,
        driven=tuple(tuple(float(value) for value in motion) for motion in training_domain(extended)),
        plain=matrix_rows(plain.fit.model.matrix) if plain is not None and terms else None,
        provenance=Provenance(
            dataset=dataset.name,
            dataset_hash=dataset.hash,
            fitted=dataset.fingerprints("train"),
            simulated=dataset.simulated,
            calibrator="discover",
            options={"without": list(request.without), "unknown_term": request.unknown_term},
            seed=request.seed,
            cost="final_pose",
            box="none",
            versions=package_versions(),
            training_cost=_cost(extended, dataset.split("train")),
            validation_cost=_cost(extended, dataset.split("validation")),
            outcome="converged",
            reason=reason,
        ),
    )


def _cost(extended: Extended, runs: Sequence[Trajectory]) -> float | None:
    """Eq. (6), m and rad, of runs as recorded; None without runs, or where they lack what an effect needs."""
    if not runs:
        return None
    try:
        return costs.create("final_pose").of_model(extended.fit.model, runs)
    except DataError:
        return None
