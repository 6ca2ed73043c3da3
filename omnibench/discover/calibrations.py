"""Calibration files of the plain and of the extended model."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from omnibench.data.dataset import Dataset
from omnibench.discover.extend import Extended
from omnibench.discover.novelty import driven_motions
from omnibench.environment import package_versions
from omnibench.robot.calibration import Calibration, EffectTerm, Provenance, covariance_rows, matrix_rows
from omnibench.robot.kinematics import Array


def calibration_of(dataset: Dataset, extended: Extended, name: str, options: Mapping[str, object], seed: int,
                   costs: tuple[float, float | None], reason: str) -> Calibration:  # fmt: skip
    """The calibration of a fit, with its noise, its covariance (zero for shapes) and where it comes from.

    costs: Eq. (6) of training and validation.
    """
    terms = tuple(
        EffectTerm(name=term.name, parameters={key: float(value) for key, value in term.values.items()})
        for term in extended.fit.model.terms
    )
    return Calibration(
        name=f"{dataset.name} {name}",
        robot=dataset.robot,
        sample_period=dataset.sample_period,
        matrix=matrix_rows(extended.fit.model.matrix),
        integration=extended.fit.model.integration,
        effects=terms,
        noise=extended.fit.noise.noise,
        covariance=covariance_rows(_with_shapes(extended)),
        session=extended.fit.runs[0].session,
        driven=tuple(tuple(float(value) for value in motion) for motion in driven_motions(extended)),
        provenance=Provenance(
            dataset=dataset.name,
            dataset_hash=dataset.hash,
            simulated=dataset.simulated,
            calibrator="discover",
            options=dict(options),
            seed=seed,
            cost="final_pose",
            box="none",
            versions=package_versions(),
            training_cost=costs[0],
            validation_cost=costs[1],
            outcome="converged",
            reason=reason,
        ),
    )


def _with_shapes(extended: Extended) -> Array:
    """The covariance with rows of zeros for parameters that shape an effect and were chosen, not fitted."""
    elements = extended.fit.model.matrix.size
    places = list(range(elements))
    count = elements
    for group in extended.groups:
        places += range(count, count + len(group.parameters))
        count += len(group.parameters) + len(group.shapes)
    covariance = np.zeros((count, count))
    covariance[np.ix_(places, places)] = (extended.covariance + extended.covariance.T) / 2
    return covariance
