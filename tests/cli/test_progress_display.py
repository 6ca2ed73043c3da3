"""How the progress of tasks is shown: lines in a pipe, bars on a terminal."""

from __future__ import annotations

from io import StringIO

import pytest
from rich.console import Console

from omnibench.cli.terminal.progress_display import ProgressDisplay
from omnibench.progress import Progress, Stages

ALWAYS, NEVER = 0.0, 1e9  # s between two lines of a task that goes on


def shown(*events: Progress, period: float = NEVER, terminal: bool = False, width: int = 80) -> str:
    """Everything that is written while the events come."""
    text = StringIO()
    console = Console(file=text, width=width, force_terminal=terminal, color_system=None, highlight=False)
    with ProgressDisplay(console, period) as display:
        for event in events:
            display(event)
    return text.getvalue()


def test_a_pipe_is_told_that_a_task_begins_and_of_how_many_steps() -> None:
    steps = [Progress("SLAM", done, 3, "run") for done in range(4)]
    assert shown(*steps) == "SLAM: 3 runs\n"


def test_a_pipe_gets_the_stages_line_by_line() -> None:
    events: list[Progress] = []
    stages = Stages(events.append)
    stages.begin("fitting the plain matrix")
    stages.begin("looking where it fails")
    stages.end()
    assert shown(*events) == "fitting the plain matrix\nlooking where it fails\n"


def test_a_pipe_is_told_how_far_a_task_is_at_most_once_a_period() -> None:
    steps = [
        Progress("search", 100, 2000, "evaluation", best=float("inf")),
        Progress("search", 1200, 2000, "evaluation", best=0.25, note="still falling"),
    ]
    assert shown(*steps) == ""
    assert shown(*steps, period=ALWAYS) == (
        "search: 100 of 2,000\nsearch: 1,200 of 2,000, best 0.250000, still falling\n"
    )


def test_tasks_within_a_task_begin_in_silence_and_end_with_the_line_that_they_give() -> None:
    events = [
        Progress("comparing", 0, 2, "run"),
        Progress("one", 0, 50),
        Progress("two", 0, 50),
        Progress("two", 7, 50, result="[1/2] two: failed"),
        Progress("one", 50, 50, result="[2/2] one: done [at last]"),
        Progress("comparing", 2, 2, "run"),
    ]
    assert shown(*events) == "comparing: 2 runs\n[1/2] two: failed\n[2/2] one: done [at last]\n"


@pytest.mark.parametrize("width", [60, 80, 160])
def test_a_terminal_shows_all_tasks_at_once_and_cuts_nothing(width: int) -> None:
    events = [
        Progress("comparing", 3, 36, "run"),
        Progress("apr02 closed_form seed 1", 1200, 60000, "evaluation", best=0.138732),
    ]
    words = shown(*events, terminal=True, width=width)
    assert "…" not in words
    told = " ".join(words.split())
    for word in ("comparing", "3 of 36", "0:00:00", "seed", "60,000", "0.138732"):
        assert word in told


def test_a_terminal_keeps_the_results_and_forgets_the_bars() -> None:
    text = shown(Progress("one", 0, 50), Progress("one", 7, 50, result="one: failed"), terminal=True)
    assert "one: failed\n" in text
    assert "of 50" not in text.split("one: failed")[1]
