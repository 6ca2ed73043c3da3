"""Slopes of poses by small changes of the motion, against the model itself."""

from __future__ import annotations

import numpy as np
import pytest
from discovery_samples import simulated

from omnibench.discover.fitting.extend import fit_matrix
from omnibench.discover.fitting.model_fit import paths_of
from omnibench.fit.least_squares.usable_runs import usable_runs
from omnibench.registry import effects
from omnibench.robot.effects.effect import ActuatorEffect
from omnibench.robot.effects.term import make_term
from omnibench.robot.model import OdometryModel

# All that odometry or reference have, in any robot; a slope of tyre_wear needs the name of a session.
NAMES = [
    entry.name
    for entry in effects.entries()
    if not issubclass(entry.cls, ActuatorEffect)
    and getattr(entry.cls, "in_catalogue", True)
    and not entry.cls.run_nuisance
]


@pytest.fixture(scope="module")
def fitted():
    dataset = simulated((), start="random")
    runs = usable_runs(dataset.split("train"))[:8]
    return fit_matrix(runs, dataset.robot, dataset.sample_period, dataset.robot.inverse_kinematic_matrix)


@pytest.mark.parametrize("name", NAMES)
def test_slopes_by_an_effect_are_the_models_own(fitted, name: str) -> None:
    paths = paths_of(fitted)
    effect = effects.create(name)
    parameters = effect.parameters(paths.robot, ("earlier", "train"))
    for parameter in (each for each in parameters if not each.choices):
        base = {each.name: each.choices[0] if each.choices else 0.0 for each in parameters}
        step = 1e-3 * parameter.high

        def poses(value: float, base=base, parameter=parameter) -> np.ndarray:
            term = make_term(name, {**base, parameter.name: value}, paths.robot, sessions=("earlier", "train"))
            model = OdometryModel(paths.robot, paths.matrix, "arc", (term,), fitted.model.sample_period)
            return np.concatenate(model.reported(list(paths.logs)))

        expected = (poses(step) - poses(-step)) / (2 * step)
        slopes = paths.of_effect(effect, parameter.name, base)[..., 0]
        # A reference effect's slope is taken over a tenth of its range, along a path with corners at its ramps; in the
        # others the middle of a sample (40 ms) stands for all of it.
        tolerance = 0.05 if effect.stage == "reference" else 3e-4
        assert np.abs(slopes - expected).max() <= tolerance * np.abs(expected).max()


def test_samples_put_together_give_the_same_slopes_of_what_varies_slowly(fitted) -> None:
    effect = effects.create("heading_drift")
    fine, coarse = (paths_of(fitted, together).of_effect(effect, "b", {"b": 0.0}) for together in (0.0, 0.12))
    assert np.abs(fine - coarse).max() < 2e-3 * np.abs(fine).max()
