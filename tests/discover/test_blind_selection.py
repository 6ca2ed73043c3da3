"""A few of the benchmark's blind sets, so that the suite notices when discover goes blind. The study has the rates."""

from __future__ import annotations

import pytest
from hidden.judging import Judgement
from hidden.sets import LEVELS
from hidden.tasks import Group, Task, carry_out

STRONG, MEDIUM = LEVELS["strong"], LEVELS["medium"]


def judged(group: Group, *effects: str, level: float = STRONG, seed: int = 1000) -> Judgement:
    result = carry_out(Task(group=group, effects=effects, level=level, seed=seed))
    assert result.judgement is not None, result.failure
    return result.judgement


@pytest.mark.parametrize(
    ("effect", "seed"),  # even seeds drive the rich design, odd ones the flower
    [("thermal_radius_drift", 1001), ("wheel_eccentricity", 1001), ("tyre_wear", 1000)],
)
def test_a_strong_effect_gets_its_name_and_no_other(effect: str, seed: int) -> None:
    found = judged("single", effect, seed=seed)
    assert (found.outcome, found.confident_wrong) == ("right", False)
    assert found.parameter_error is not None
    assert found.parameter_error < 0.2


def test_a_medium_effect_gets_its_name_or_its_class() -> None:
    found = judged("single", "body_velocity_bias", level=MEDIUM)
    assert found.outcome in ("right", "class")
    assert not found.confident_wrong


@pytest.mark.parametrize("seed", [1003, 1000], ids=["outliers", "mixed noise"])
def test_where_nothing_is_hidden_nothing_is_named(seed: int) -> None:
    assert judged("null", level=0.0, seed=seed).outcome in ("none", "unknown")


def test_two_strong_effects_both_get_their_names() -> None:
    assert judged("pair", "thermal_radius_drift", "wheel_eccentricity").both_right


@pytest.mark.parametrize("effect", ["slow_wave", "belt"])
def test_what_no_catalogue_has_is_unknown_and_its_place_is_found(effect: str) -> None:
    found = judged("outside", effect)
    assert (found.verdict, found.where_right, found.confident_wrong) == ("unknown", True, False)


def test_without_the_true_name_no_other_is_stated_with_confidence() -> None:
    assert not [name for name in judged("removed", "floor_drift").names if name.wrong or name.weight >= 0.95]


@pytest.mark.parametrize(("group", "effect"), [("absorbed", "lidar_lever_arm"), ("nuisance", "reference_clock_drift")])
def test_what_a_matrix_absorbs_and_what_is_a_nuisance_is_never_named(group: Group, effect: str) -> None:
    assert judged(group, effect).outcome in ("none", "unknown")
