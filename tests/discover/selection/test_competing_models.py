"""Competing models: of two effects in one place, the one that predicts held-out commands better is used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from discovery_samples import COUPLING, simulated

from omnibench.discover.fitting import Fit, extend, fit_matrix
from omnibench.discover.regressors.columns import Group
from omnibench.discover.selection.competing_models import CompetingModels, competing_models
from omnibench.discover.selection.model_selection import Selection, select_effects
from omnibench.discover.selection.screening import screen_plain
from omnibench.fit.trajectory_fit import usable_runs

Fitted = tuple[Fit, Selection, dict[str, Group]]
RIGHT, WRONG = "rotation_translation_coupling", "acceleration_slip"


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    """The plain fit, the selection of the one effect that is there, and all effects."""
    dataset = simulated(COUPLING, validation=None)
    runs = usable_runs(dataset.split("train"))
    plain = fit_matrix(runs, dataset.robot, dataset.sample_period, dataset.robot.inverse_kinematic_matrix)
    screening = screen_plain(plain, ())
    return plain, select_effects(screening, np.random.default_rng(0)), {g.name: g for g in screening.groups.effects}


def competing(fitted: Fitted, chosen: str, *others: str) -> CompetingModels:
    """Models with the chosen effect, and others that could take its place."""
    plain, selection, groups = fitted
    weights = {chosen: 0.6, **dict.fromkeys(others, 0.4)}
    doubtful = replace(
        selection, chosen=(groups[chosen],), stand_ins=(tuple(groups[name] for name in others),), weights=weights
    )
    return competing_models(plain, doubtful, extend(plain, doubtful.chosen))


def used(models: CompetingModels) -> list[str]:
    return [group.name for group in models.used.groups]


def test_an_effect_that_predicts_held_out_commands_better_takes_the_place_of_the_likelier_one(fitted: Fitted) -> None:
    models = competing(fitted, WRONG, RIGHT)
    assert used(models) == [RIGHT]
    assert [group.name for group in models.selection.chosen] == [RIGHT]
    assert models.selection.confusable == ((WRONG,),)
    assert models.preferred[0].startswith(f"{RIGHT} is used: it predicts commands that were held out better")


def test_an_effect_that_predicts_held_out_commands_better_stays(fitted: Fitted) -> None:
    models = competing(fitted, RIGHT, WRONG)
    assert used(models) == [RIGHT]
    assert models.selection.confusable == ((WRONG,),)
    assert models.preferred[0].startswith(f"{RIGHT} is used")


def test_all_competing_models_keep_the_weights_of_their_names_the_used_one_first(fitted: Fitted) -> None:
    for models in (competing(fitted, WRONG, RIGHT), competing(fitted, RIGHT, WRONG)):
        assert models.weighted[0][1] is models.used
        of_names = {model.groups[0].name: weight for weight, model in models.weighted}
        assert of_names == models.selection.weights


def test_an_effect_without_a_stand_in_has_no_competitor_and_needs_no_reason(fitted: Fitted) -> None:
    models = competing(fitted, RIGHT)
    assert used(models) == [RIGHT]
    assert len(models.weighted) == 1
    assert models.preferred == ("",)
