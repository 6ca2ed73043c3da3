"""Slopes of poses by small changes of the motion, against the model itself."""

from __future__ import annotations

import numpy as np
import pytest
from config_robots import NAMES as NAMES_OF_ROBOTS
from config_robots import settings
from discovery_samples import simulated

from omnibench.config import validate
from omnibench.discover.fitting import Fit, fit_matrix, paths_of
from omnibench.discover.regressors.effect_slopes import slopes_by
from omnibench.fit.trajectory_fit import usable_runs
from omnibench.registry import effects
from omnibench.robot.effects.effect import ActuatorEffect, make_term
from omnibench.robot.model import OdometryModel
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset

# All that odometry or reference have, in any robot; a slope of tyre_wear needs the name of a session.
NAMES = [
    entry.name
    for entry in effects.entries()
    if not issubclass(entry.cls, ActuatorEffect)
    and getattr(entry.cls, "in_catalogue", True)
    and not entry.cls.run_nuisance
]

# A learned effect is no candidate: nothing but training finds its weights.
NAMELESS = [
    entry.name
    for entry in effects.entries()
    if not getattr(entry.cls, "in_catalogue", True) and not getattr(entry.cls, "weighted", False)
]


def on_robot(robot: str) -> Fit:
    """The plain matrix fitted to a few runs of the APR-02 or of a config's robot, the tracked point off its centre."""
    if robot == "three":
        dataset = simulated((), start="random")
    else:
        given = settings(robot)
        weaving = {"variation": {"weave": 0.2, "period": 2.0}, "ramp": 0.3}
        changes = {
            "robot": given["robot"] | {"mount": {"x": 0.1, "y": -0.05, "yaw": 0.2}},
            "commands": given["commands"] | weaving,
            "train": {"seed": 1, "distance": 1.0},
        }
        dataset = simulate_dataset(validate(FlowerConfig, given | changes, robot)).dataset
    runs = usable_runs(dataset.split("train"))[:8]
    return fit_matrix(runs, dataset.robot, dataset.sample_period, dataset.robot.inverse_kinematic_matrix)


@pytest.fixture(scope="module")
def fitted() -> Fit:
    return on_robot("three")


@pytest.mark.parametrize("robot", ["three", *NAMES_OF_ROBOTS])
def test_slopes_by_an_effect_are_the_models_own(robot: str) -> None:
    fit = on_robot(robot)
    applied = [name for name in NAMES if effects.create(name).applies(fit.model.robot)]
    for name in applied:
        check_slopes(fit, name)


@pytest.mark.parametrize("name", NAMELESS)
def test_slopes_by_an_effect_without_a_name_are_the_models_own(fitted: Fit, name: str) -> None:
    check_slopes(fitted, name)


def test_slopes_by_some_parameters_are_those_columns_of_the_slopes_by_all(fitted: Fit) -> None:
    paths, effect = paths_of(fitted), effects.create("smooth_course")
    names = [each.name for each in effect.parameters(paths.robot)]
    values = dict.fromkeys(names, 0.0)
    every, some = (slopes_by(paths, effect, chosen, values) for chosen in (names, names[::-3]))
    np.testing.assert_allclose(some, every[:, :, ::-3], rtol=1e-9, atol=1e-12)


def check_slopes(fitted: Fit, name: str) -> None:
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
        slopes = slopes_by(paths, effect, [parameter.name], base)[..., 0]
        # A reference effect's slope is taken over a tenth of its range, along a path with corners at its ramps; in the
        # others the middle of a sample (40 ms) stands for all of it.
        tolerance = 0.05 if effect.stage == "reference" else 3e-4
        assert np.abs(slopes - expected).max() <= tolerance * np.abs(expected).max(), f"{name}, {parameter.name}"


def test_samples_put_together_give_the_same_slopes_of_what_varies_slowly(fitted: Fit) -> None:
    effect = effects.create("heading_drift")
    fine, coarse = (slopes_by(paths_of(fitted, together), effect, ["b"], {"b": 0.0}) for together in (0.0, 0.12))
    assert np.abs(fine - coarse).max() < 2e-3 * np.abs(fine).max()
