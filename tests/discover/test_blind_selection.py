"""A few blind sets, a third of the benchmark's in size, so that the suite notices when discover goes blind.

The rates are those of the study, tests/studies/discover_study.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hidden.judging import Judgement, judge
from hidden.sets import LEVELS, Kind, make_set

from omnibench.discover.discover import discover_effects

STRONG, MEDIUM = LEVELS["strong"], LEVELS["medium"]


def judged(
    kind: Kind,
    *effects: str,
    level: float = STRONG,
    design: str = "small",
    noise: str = "plain",
    without: Sequence[str] = (),
) -> Judgement:
    dataset, truth = make_set(kind, effects, level, 1000, design=design, noise=noise)
    return judge(discover_effects(dataset, without=without), truth, seconds=0.0)


def test_a_strong_effect_gets_its_name_and_no_other_and_its_size() -> None:
    found = judged("single", "thermal_radius_drift")
    assert (found.outcome, found.confident_wrong) == ("right", False)
    assert found.parameter_error is not None
    assert found.parameter_error < 0.2


def test_a_strong_effect_between_sessions_gets_its_name_and_no_other() -> None:
    found = judged("single", "tyre_wear", design="small_sessions")
    assert (found.outcome, found.confident_wrong) == ("right", False)


def test_a_medium_effect_gets_its_name_or_its_class() -> None:
    found = judged("single", "body_velocity_bias", level=MEDIUM)
    assert found.outcome in ("right", "class")
    assert not found.confident_wrong


def test_where_nothing_is_hidden_nothing_is_named() -> None:
    assert judged("null", level=0.0, noise="mixed").outcome in ("none", "unknown")


@pytest.mark.slow
def test_two_strong_effects_both_get_their_names() -> None:
    assert judged("pair", "thermal_radius_drift", "wheel_eccentricity").both_right


def test_what_no_catalogue_has_is_unknown_and_its_place_is_found() -> None:
    found = judged("outside", "belt")
    assert (found.verdict, found.where_right, found.confident_wrong) == ("unknown", True, False)


def test_without_the_true_name_no_other_is_stated_with_confidence() -> None:
    found = judged("single", "floor_drift", without=["floor_drift"])
    assert not [name for name in found.names if name.wrong or name.weight >= 0.95]


def test_a_nuisance_is_never_named() -> None:
    assert judged("nuisance", "reference_clock_drift").outcome in ("none", "unknown")
