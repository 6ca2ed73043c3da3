"""The arithmetic of the study's table, on answers whose marks are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from discover_study import every_result, print_tables, results_of
from hidden.figures import Row, further_table, issue_table, rate, right, right_or_class, weight_error
from hidden.forms import FORMS
from hidden.judging import Judgement, Name, ParameterError
from hidden.tasks import GROUPS, Group, Result, Task, tasks

from omnibench.jobs.job import ResultStore

TRUE, OTHER = "heading_drift", "floor_drift"


def answer(
    *names: tuple[str, float], verdict: str = "named", confusable: bool = False, covariate_found: bool = False
) -> Judgement:
    given = tuple(
        Name(name=name, weight=weight, right=name == TRUE, in_class=confusable or name == TRUE)
        for name, weight in names
    )
    return Judgement(
        verdict=verdict,
        names=given,
        both_right=False,
        where=("heading",),
        where_right=covariate_found,
        parameters=(),
        closed_said_chi2=None,
        closed_said_eq6=None,
        closed_true_chi2=None,
        closed_true_eq6=None,
        seconds=1.0,
    )


def result(judgement: Judgement | None, group: Group = "single", seed: int = 0, level: float = 1000.0) -> Result:
    task = Task(group=group, effects=(TRUE,), level=level, seed=seed)
    return Result(task=task, design="rich", noise="plain", size=1.0, reachable=True, judgement=judgement, failure="")


def seen(figure: str, *results: Result) -> str:
    return shown(issue_table, figure, *results)


def shown(table: Callable[[Sequence[Result]], list[Row]], figure: str, *results: Result) -> str:
    return next(row.seen for row in table(results) if row.figure.startswith(figure))


@pytest.mark.parametrize(
    ("judgement", "outcome"),
    [
        (answer((TRUE, 0.99)), "right"),
        (answer((TRUE, 0.99), verdict="incomplete"), "right"),
        (answer((OTHER, 0.6), verdict="class", confusable=True), "class"),
        (answer((TRUE, 0.6), verdict="class"), "class"),
        (answer((OTHER, 0.99)), "wrong"),
        (answer((TRUE, 0.6), verdict="unknown"), "unknown"),
        (answer(verdict="none"), "none"),
    ],
)
def test_an_answer_is_marked_as_the_issue_says(judgement: Judgement, outcome: str) -> None:
    assert judgement.outcome == outcome


def test_a_right_name_beside_a_confident_wrong_one_does_not_count() -> None:
    both = answer((TRUE, 0.99), (OTHER, 0.97))
    assert not right(both)
    assert not right_or_class(both)
    assert right(answer((TRUE, 0.99), (OTHER, 0.5)))


def test_a_failure_of_the_workflow_counts_against_it() -> None:
    assert rate([result(answer((TRUE, 0.99))), result(None)], right).startswith("50.0%")
    assert seen("wrong name where nothing is hidden", result(None, "null")).startswith("100.0%")
    assert seen("true effect removed", result(None, "removed")).startswith("100.0%")


def test_unknown_is_no_name_where_nothing_is_hidden() -> None:
    unknown, named = (result(answer(*names, verdict=verdict), "null") for names, verdict in NULLS)
    assert seen("wrong name where nothing is hidden", unknown, named).startswith("50.0%")


NULLS = (((), "unknown"), (((OTHER, 0.5),), "class"))


def test_outside_the_catalogue_it_must_be_flagged_with_or_without_a_name() -> None:
    flagged, not_flagged = (
        result(answer(verdict=verdict), "fine", seed=seed) for seed, verdict in enumerate(("incomplete", "none"))
    )
    assert seen("outside the catalogue", flagged, not_flagged).startswith("50.0%")


def test_weights_that_are_what_they_say_have_no_error() -> None:
    fair = [result(answer((TRUE if index < 3 else OTHER, 0.75)), seed=index) for index in range(4)]
    assert weight_error(fair).startswith("0.000")
    assert weight_error([result(answer((OTHER, 0.75)))]).startswith("0.750")


def test_parameters_are_compared_by_length_and_by_interval() -> None:
    estimated = tuple(
        ParameterError(name=name, true=true, value=value, low=value - 0.2, high=value + 0.2)
        for name, true, value in (("kx", 3.0, 3.0), ("ky", 4.0, 4.5))
    )
    judgement = answer((TRUE, 0.99)).model_copy(update={"parameters": estimated})
    assert judgement.parameter_error == pytest.approx(0.1)
    assert shown(further_table, "coverage", result(judgement)).startswith("50.0%")


def test_twenty_seeds_are_twenty_sets_an_effect_and_twelve_hundred_of_nothing() -> None:
    every = list(tasks(range(20), (1000.0, 300.0), GROUPS))
    assert len({task.key for task in every}) == len(every)
    assert sum(task.group == "null" for task in every) == 1200
    assert all(sum(task.effects == (name,) and task.group == "single" for task in every) == 40 for name in FORMS)


def test_results_of_other_code_are_told_from_those_of_this(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole, store = result(answer((TRUE, 0.99))), ResultStore(tmp_path, Result)
    store.put("0123456789", whole)
    assert results_of([whole.task], store) == []
    assert every_result(store) == [whole]
    print_tables(every_result(store), other_code=True)
    assert "of other versions of the code" in capsys.readouterr().out
