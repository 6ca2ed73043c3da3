"""Verdicts and headlines, from the effects that were named and what the residuals depend on."""

from dataclasses import replace

import pytest
from syrupy.assertion import SnapshotAssertion

from omnibench.discover.conclude import headline_of
from omnibench.discover.result import CovariateDependence, NamedEffect, Verdict, lacks_a_name, verdict_of
from omnibench.robot.effects.effect import Stage


def effect(
    name: str = "heading_drift", weight: float = 0.99, confusable: tuple[str, ...] = (), stage: Stage = "body"
) -> NamedEffect:
    """A named effect; its class is certain."""
    class_weight = 0.99 if confusable else weight
    return NamedEffect(name, stage, weight, (), confusable, "", "", 100.0, 1, "", class_weight)


def dependence(p_value: float = 1e-9, stage: Stage = "body", *, within_ticks: bool = False) -> CovariateDependence:
    words = "the residual depends on the heading" if stage == "body" else "the rates depend on the targets"
    return CovariateDependence("heading", stage, p_value, 50.0, 3, words, within_ticks)


PATCH = replace(dependence(), covariate="place", description="the residual depends on a patch of the floor", weight=0.3)
LIKELIER = replace(dependence(), weight=0.6)
SEEN, CHANCE, TICKS = dependence(), dependence(0.005), dependence(within_ticks=True)
MOTORS = dependence(stage="actuator")
LAG = effect("motor_lag", stage="actuator")
ONE_OF_TWO = effect(weight=0.5, confusable=("floor_drift",))


@pytest.mark.parametrize(
    ("effects", "where", "left", "verdict"),
    [
        ((), (), (), "none"),
        ((), (CHANCE,), (), "none"),
        ((), (TICKS,), (), "none"),
        ((), (SEEN,), (SEEN,), "unknown"),
        ((effect(),), (SEEN,), (), "named"),
        ((effect(),), (SEEN,), (CHANCE, TICKS), "named"),
        ((effect(),), (SEEN,), (SEEN,), "incomplete"),
        ((effect(weight=0.94),), (SEEN,), (), "unknown"),
        ((effect(), effect("floor_drift", 0.6)), (SEEN,), (), "incomplete"),
        ((ONE_OF_TWO,), (SEEN,), (), "class"),
        ((effect("floor_drift"), ONE_OF_TWO), (SEEN,), (SEEN,), "class"),
        # Motors are judged by themselves, and the odometry first.
        ((), (MOTORS,), (MOTORS,), "none"),  # what a controller does without a name is nothing that the odometry lacks
        ((LAG,), (MOTORS,), (), "named"),
        ((LAG,), (MOTORS,), (MOTORS,), "named"),
        ((LAG,), (MOTORS, SEEN), (SEEN,), "unknown"),  # the motors' name explains nothing of the odometry
        ((effect(), LAG), (SEEN, MOTORS), (MOTORS,), "named"),
    ],
)
def test_the_verdict_follows_from_names_and_from_what_is_left(
    effects: tuple[NamedEffect, ...],
    where: tuple[CovariateDependence, ...],
    left: tuple[CovariateDependence, ...],
    verdict: Verdict,
) -> None:
    assert verdict_of(effects, where, left) == verdict


def test_of_few_runs_the_headline_says_that_they_can_show_hardly_anything() -> None:
    headline = headline_of("none", (), (), (), "2 runs of 1 command")
    assert "2 runs of 1 command" in headline
    assert "Nothing is missing" not in headline


@pytest.mark.parametrize(("effects", "where"), [((), ()), ((), (MOTORS,)), ((LAG,), (MOTORS,))])
@pytest.mark.parametrize("doubt", ["differ", "untested"])
def test_where_sessions_differ_or_could_not_be_compared_no_headline_says_that_nothing_is_missing(
    effects: tuple[NamedEffect, ...], where: tuple[CovariateDependence, ...], doubt: str
) -> None:
    verdict: Verdict = "named" if effects else "none"
    headline = headline_of(verdict, effects, where, (), differ=doubt == "differ", untested=doubt == "untested")
    assert headline.startswith("Nothing else was found" if doubt == "differ" else "Nothing was found")
    assert "Nothing is missing" not in headline


def test_a_name_is_lacking_where_something_is_left_or_nothing_explains_it() -> None:
    assert [name for name in ("none", "named", "class", "incomplete", "unknown") if lacks_a_name(name)] == [
        "incomplete",
        "unknown",
    ]


def test_headlines_say_what_is_missing_and_how_sure(snapshot: SnapshotAssertion) -> None:
    assert [
        headline_of("none", (), (), ()),
        headline_of("none", (), (MOTORS,), ()),
        headline_of("named", (effect(),), (SEEN,), ()),
        headline_of("named", (effect(weight=0.99999),), (SEEN,), ()),
        headline_of("named", (LAG,), (MOTORS,), ()),
        headline_of("incomplete", (effect(),), (SEEN,), (SEEN,)),
        headline_of("class", (ONE_OF_TWO,), (SEEN,), ()),
        headline_of("unknown", (), (SEEN,), (SEEN,)),
        headline_of("unknown", (), (PATCH, LIKELIER), ()),
        headline_of("incomplete", (effect(),), (SEEN,), (PATCH, LIKELIER)),
        headline_of("unknown", (effect(weight=0.7),), (SEEN,), (SEEN,)),
        headline_of("unknown", (LAG,), (MOTORS, SEEN), (SEEN,)),
    ] == snapshot
