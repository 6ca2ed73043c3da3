"""Models that recordings cannot tell apart: which is used, and their average with its weights and how unsure it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from discovery_samples import COUPLING, plain_fit, simulated

from omnibench.discover.fitting import Extended, Fit, extend
from omnibench.discover.regressors.significance import Group
from omnibench.discover.selection.competing_models import CompetingModels, averaged, competing_models
from omnibench.discover.selection.model_selection import Selection, select_effects
from omnibench.discover.selection.screening import screen_plain

Fitted = tuple[Fit, Selection, dict[str, Group]]
RIGHT, WRONG = "rotation_translation_coupling", "acceleration_slip"


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    """The plain fit, the selection of the one effect that is there, and all effects."""
    plain = plain_fit(simulated(COUPLING, validation=None))
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


def model(fitted: Fitted, name: str) -> Extended:
    return extend(fitted[0], [fitted[2][name]])


def copy_of(extended: Extended) -> Extended:
    """The model with a group of its own, so that it counts as another effect."""
    return replace(extended, groups=tuple(replace(group) for group in extended.groups))


def test_a_model_that_predicts_held_out_commands_far_worse_has_no_share(fitted: Fitted) -> None:
    right, wrong = model(fitted, RIGHT), model(fitted, WRONG)
    average = averaged([(0.1, wrong), (0.9, right)])
    assert average.members == ((1.0, right),)
    assert average.extended is right
    assert average.note == ""


def test_models_that_predict_alike_share_by_the_probabilities_of_their_names(
    fitted: Fitted,
) -> None:
    right = model(fitted, RIGHT)
    average = averaged([(0.3, right), (0.1, copy_of(right))])
    assert [weight for weight, _ in average.members] == pytest.approx([0.75, 0.25])
    np.testing.assert_allclose(average.extended.values, np.append(0.75 * right.values, 0.25 * right.values))
    together, alone = (np.concatenate(extended.fit.poses) for extended in (average.extended, right))
    np.testing.assert_allclose(together, alone, atol=1e-9)
    assert average.note.startswith("The extended model is the average of models that these recordings cannot tell ")


def test_values_that_no_robot_has_cost_a_model_its_share(fitted: Fitted) -> None:
    right = model(fitted, RIGHT)
    narrow = tuple(replace(each, low=each.low / 1e3, high=each.high / 1e3) for each in right.groups[0].parameters)
    absurd = replace(right, groups=(replace(right.groups[0], parameters=narrow),))
    assert averaged([(0.9, absurd), (0.1, right)]).members == ((1.0, right),)


def test_what_members_disagree_on_is_not_known(fitted: Fitted) -> None:
    right = model(fitted, RIGHT)
    opposite = copy_of(right)
    elements = right.fit.model.matrix.size
    average = averaged([(0.5, right), (0.5, opposite)]).extended
    apart = np.zeros((elements + 4, elements + 4))
    half = np.concatenate([np.zeros(elements), right.values, -right.values]) / 2
    within = np.zeros_like(apart)
    for rows in ([*range(elements), elements, elements + 1], [*range(elements), elements + 2, elements + 3]):
        within[np.ix_(rows, rows)] += right.covariance.matrix / 2
    np.testing.assert_allclose(average.covariance.matrix, within + np.outer(half, half), atol=1e-15)
