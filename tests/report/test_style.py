"""Colours and axes of plots."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omnibench.report.blocks import LegendItem
from omnibench.report.figures import path
from omnibench.report.style import PALETTE, REFERENCE, THEORETICAL, colours, logarithmic, plan, plot, text, wrapped


def test_an_entry_gets_the_colour_that_it_wants() -> None:
    assert colours({"crs": "#e69f00", "other": None})["crs"] == ("#e69f00", "solid")


def test_the_second_to_want_a_colour_gets_another() -> None:
    given_styles = colours({"first": "#0072b2", "second": "#0072b2"})
    assert given_styles["first"] == ("#0072b2", "solid")
    assert given_styles["second"] != given_styles["first"]


@given(st.lists(st.sampled_from([*PALETTE, None]), max_size=30))
def test_up_to_thirty_entries_look_different(wanted: list[str | None]) -> None:
    styles = colours({f"entry {index}": colour for index, colour in enumerate(wanted)})
    assert len(set(styles.values())) == len(wanted)
    assert not {REFERENCE, THEORETICAL} & {colour for colour, _ in styles.values()}


@given(
    st.floats(min_value=-12, max_value=6),
    st.floats(min_value=0, max_value=14),
)
def test_a_logarithmic_axis_holds_its_data_and_has_labels(low: float, decades: float) -> None:
    figure = plot()
    logarithmic(figure, "y", 10**low, 10 ** (low + decades))
    bottom, top = figure.layout.yaxis.range
    assert bottom <= low
    assert low + decades <= top
    ticks = [math.log10(tick) for tick in figure.layout.yaxis.tickvals]
    assert len(ticks) == len(figure.layout.yaxis.ticktext)
    assert sum(bottom <= tick <= top for tick in ticks) <= 10
    if decades >= 1:
        assert any(bottom <= tick <= top for tick in ticks)


@pytest.mark.parametrize("name", ["a<b>", "x & y", "</script>"])
def test_names_cannot_be_markup_in_a_plot(name: str) -> None:
    assert "<" not in text(name)
    assert "& " not in text(name)


def test_a_path_far_from_the_origin_is_drawn_from_a_round_value_that_its_axis_and_its_hover_text_name() -> None:
    poses = np.array([[500_000.25, 4_600_000.5], [500_001.25, 4_600_001.0]])
    item = LegendItem("a", "a path", "#111111")
    trace = path(item, poses, 2.0)
    for _ in range(2):  # a trace may be in several figures
        figure = plan(trace, window=np.array([[499_999.0, 500_002.0], [4_599_999.0, 4_600_002.0]]))
        assert figure.data[0].x == pytest.approx([0.25, 1.25])
        assert figure.data[0].y == pytest.approx([0.5, 1.0])
        assert figure.layout.xaxis.title.text == "x − 500,000 (m)"
        assert figure.layout.yaxis.title.text == "y − 4,600,000 (m)"
        assert figure.layout.xaxis.range == (-1.0, 2.0)
        assert "y − 4,600,000 = %{y:.3f} m" in figure.data[0].hovertemplate


def test_long_labels_break_after_their_words_and_within_a_word_that_is_too_long() -> None:
    assert wrapped("held-out: square_a90_turn+360_v0.2_r0.8x1") == "held-out: square_a90_\nturn+360_v0.2_r0.8x1"
    assert wrapped("abcdefgh", 3) == "abc\ndef\ngh"
    assert wrapped("design values") == "design values"


def test_a_path_near_the_origin_is_drawn_as_it_is() -> None:
    figure = plan(path(LegendItem("a", "a path", "#111111"), np.array([[90.0, 2.0], [91.0, 3.0]]), 2.0))
    assert (figure.data[0].x, figure.layout.xaxis.title.text) == ((90.0, 91.0), "x (m)")
