"""A discovery on a terminal."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest
from discovery_samples import incomplete, named, nameless, nothing
from rich.console import Console

from omnibench.cli.terminal.discovery_summary import print_discovery
from omnibench.discover.result import Discovery


def printed(found: Discovery, width: int = 80) -> str:
    console = Console(file=StringIO(), width=width, markup=False, emoji=False, highlight=False)
    print_discovery(console, found, Path("results/flower/now"))
    assert isinstance(console.file, StringIO)
    return console.file.getvalue()


@pytest.mark.parametrize("make", [named, nothing, nameless, incomplete])
def test_eighty_columns_are_enough_and_nothing_is_cut(make: Callable[[], Discovery]) -> None:
    told = printed(make())
    assert max(len(line.rstrip()) for line in told.splitlines()) <= 80
    assert "…" not in told


def test_an_answer_fits_on_a_screen() -> None:
    assert len(printed(named()).splitlines()) < 60


def test_verdict_effect_places_gap_and_files_are_told() -> None:
    told = printed(named())
    assert "flower (simulated data): 36 training runs" in told
    assert "verdict: named (found and named)" in told
    assert re.search(r"rotation_translation_coupling \(body\), weight 9[5-9]\.\d %; as in the textbook", told)
    assert "Where the plain matrix fails" in told
    assert "held-out session: 36 runs" in told
    assert "results/flower/now/report.html" in told
    assert "results/flower/now/model.yaml" in told


def test_a_class_and_its_doubts_are_told() -> None:
    effect = replace(named().effects[0], confusable_with=("load_transfer",), in_doubt="few turns")
    told = " ".join(printed(replace(named(), verdict="class", effects=(effect,))).split())
    assert "cannot be told from load_transfer" in told
    assert "In doubt: rotation_translation_coupling: few turns." in told


def test_what_to_drive_to_tell_look_alikes_apart_is_told() -> None:
    told = " ".join(printed(incomplete()).split())
    assert "What to drive to tell acceleration_slip from its look-alikes" in told
    assert "turning left on the spot at 1 rad/s 12.5 4" in told
    assert "Drive 4 runs, 1.8 minutes" in told


def test_what_is_left_and_new_motions_are_told() -> None:
    told = " ".join(printed(incomplete()).split())
    assert "Left over: the residuals still depend on wheel rate (2 × 10⁻¹¹)" in told
    assert "warning: not driven in training: v0.4_a90_w1" in told
    assert "experiment-1.yaml" in told


def test_many_notes_leave_the_screen_to_the_answer() -> None:
    told = printed(replace(nothing(), notes=tuple(f"note {number}" for number in range(9))))
    assert "- note 2" in told
    assert "- note 3" not in told
    assert "6 more notes in the report" in told
