"""Sessions that differ, and what a discovery and its report say of them."""

from dataclasses import replace
from pathlib import Path

import pytest
from discovery_samples import held_out, shorn
from hidden.session_sets import session_set
from report_page import Page, on_terminal
from shared_results import made_once

from omnibench.data.dataset import Dataset
from omnibench.discover.discover import discover_effects
from omnibench.discover.report.discovery_report import discovery_report
from omnibench.discover.report.discovery_result import DiscoveryResult
from omnibench.discover.report.tables import VERDICTS, verdict_in_words
from omnibench.discover.result import Discovery, discovery_document
from omnibench.report.render import render
from omnibench.report.terminal import print_result


@made_once
def worn() -> Discovery:
    """Wheels that are 2 % larger in the session that is held out."""
    return discover_effects(session_set("small", 3, change=0.02))


def page(found: Discovery) -> Page:
    return Page(render(discovery_report(found, "seed: 0\n")))


def printed(found: Discovery) -> str:
    return on_terminal(print_result, DiscoveryResult(found, Path("found")))


def test_nothing_is_not_said_to_be_missing_where_the_held_out_session_has_other_wheels() -> None:
    found = worn()
    assert found.verdict == "none"
    assert found.headline.startswith("The sessions differ: in s2 against s1")
    assert "Nothing is missing" not in found.headline
    assert verdict_in_words(found) != VERDICTS["none"]
    assert "the sessions differ" in printed(found)
    assert "residuals of the plain matrix are what the noise leaves" not in page(found).text


@pytest.mark.slow
def test_nothing_is_not_said_to_be_missing_where_sessions_cannot_be_compared() -> None:
    found = discover_effects(shorn(session_set("small", 3, change=0.02), command=None))
    assert found.verdict == "none"
    assert "Whether the sessions differ cannot be said: no session repeats a command" in found.headline
    told, report = printed(found), page(found).text
    for words in (found.headline, verdict_in_words(found), told, report):
        assert "othing is missing" not in words
    assert "whether the sessions differ cannot be said" in " ".join(told.split())
    assert ", sessions not compared" in report


def test_a_change_of_the_radii_closes_the_gap_to_the_held_out_session() -> None:
    found = worn()
    gap = held_out(found, "session").eq6
    assert found.eq6_of_sessions < gap.floor + 0.05 * (gap.before - gap.floor)
    assert "tyre_wear" in found.headline
    assert "tyre_wear" not in found.absorbed
    document = discovery_document(found, Path("found"))
    assert document["sessions"]["differences"][0]["session"] == "s2"


@pytest.mark.slow
def test_sessions_that_both_train_give_tyre_wear_its_name() -> None:
    found = discover_effects(shorn(session_set("small", 3, change=0.02), split="train"))
    assert [effect.name for effect in found.effects] == ["tyre_wear"]
    assert found.verdict == "named"
    assert found.sessions.differences == ()


def halved(dataset: Dataset, *, validate: bool) -> Dataset:
    """Of two repetitions in every session the first trains, and the second validates or is left out."""
    halves = [replace(run, split="train" if run.repetition == 1 else "validation") for run in dataset.trajectories]
    kept = [run for run in halves if validate or run.split == "train"]
    return replace(dataset, trajectories=tuple(kept))


@pytest.mark.slow
def test_sessions_that_train_on_one_run_a_command_each_give_tyre_wear_its_name() -> None:
    found = discover_effects(halved(session_set("small", 3, change=0.02, repetitions=2), validate=True))
    assert [effect.name for effect in found.effects] == ["tyre_wear"]
    assert found.sessions.differences == ()
    assert "if both sessions train" not in found.headline
    assert "so that the noise has seen validation runs" in found.noise.description
    assert all(held.eq6.floor is None or held.eq6.floor <= held.eq6.after for held in found.held_out)


@pytest.mark.slow
def test_without_repetitions_in_a_session_the_runs_of_another_are_none() -> None:
    found = discover_effects(halved(session_set("small", 3, change=0.02, repetitions=2), validate=False))
    assert found.noise.source == "within runs"
    assert "no session repeats a command" in found.noise.description
    assert all(held.eq6.floor is None for held in found.held_out)


def test_of_one_run_nothing_is_held_out_and_there_is_no_floor() -> None:
    dataset = session_set("small", 3)
    found = discover_effects(replace(dataset, trajectories=dataset.split("train")[:1]))
    document = discovery_document(found, Path("found"))
    assert document["held_out"] is None
    assert (document["gap"]["floor"], document["gap"]["standard_error"]) == (None, None)
    for words in (printed(found), page(found).text):
        assert "held-out" not in words
        assert "held out" not in words


@pytest.mark.slow
def test_what_is_left_over_is_looked_for_again_once_a_term_without_a_name_is_added() -> None:
    dataset = session_set("small", 3, effect="speed_dependent_radius")
    plain, extended = (
        discover_effects(dataset, without=("speed_dependent_radius", "load_transfer"), unknown_term=unknown_term)
        for unknown_term in (False, True)
    )
    assert any("The extended model holds an unnamed term over wheel rate" in note for note in extended.notes)
    assert sum(each.excess for each in extended.left) < 0.5 * sum(each.excess for each in plain.left)
