"""The traces that figures are made of."""

from __future__ import annotations

import math

import numpy as np

from omnibench.report.blocks import LegendItem
from omnibench.report.figures import area, arrows, coordinates, joined, line, marks

ITEM = LegendItem("key", "a <name>", "#0072b2", "dot", "square-open")


def test_a_line_breaks_at_nan_and_between_joined_paths() -> None:
    drawn = line(ITEM, 2.0, *joined([np.zeros((2, 2)), np.ones((1, 2))]).T)
    assert drawn.x == (0.0, 0.0, None, 1.0)
    assert coordinates([math.nan, 1.2345678, 3.0]) == [None, 1.2346, 3.0]


def test_coordinates_are_as_fine_far_from_the_origin_as_near_it() -> None:
    assert coordinates([500000.0, 500000.12345, 500005.0]) == [500000.0, 500000.12345, 500005.0]
    assert coordinates([-500000.0, -500000.1, -500005.0]) == [-500000.0, -500000.1, -500005.0]
    assert coordinates([1e-9, 1.23456789e-6, 1.0]) == [1e-9, 1.2346e-6, 1.0]  # of a logarithmic axis
    assert coordinates([1234.5678] * 2) == [1234.5678] * 2


def test_a_trace_has_the_style_of_its_item_and_is_switched_by_it() -> None:
    drawn = line(ITEM, 2.0, [0.0], [1.0])
    assert (drawn.line.color, drawn.line.dash, drawn.line.width) == ("#0072b2", "dot", 2.0)
    assert marks(ITEM, 5, [0.0], [1.0]).marker.symbol == "square-open"
    assert {trace.legendgroup for trace in (drawn, area("key", "red", [0.0], [1.0]))} == {"key"}


def test_what_has_nothing_to_show_is_not_hovered_over() -> None:
    assert line(ITEM, 2.0, [0.0], [1.0]).hoverinfo == "skip"
    assert marks(ITEM, 5, [0.0], [1.0], hover="%{text}", words=["here"]).hovertemplate == "%{text}<extra></extra>"


def test_names_of_categories_and_words_cannot_be_markup() -> None:
    drawn = marks(ITEM, 5, [1.0], ["<b>"], hover="%{text}", words=["one\n<two>"])
    assert drawn.y == ("&lt;b&gt;",)
    assert drawn.text == ("one<br>&lt;two&gt;",)


def test_arrows_point_from_start_to_tip() -> None:
    starts = np.zeros((3, 2))
    shafts, heads = arrows(ITEM, starts, np.array([[0.0, 1.0], [1.0, 0.0], [-1.0, 0.0]]), ["up", "right", "left"])
    assert shafts.y == (0.0, 1.0, None, 0.0, 0.0, None, 0.0, 0.0)
    assert heads.marker.angle == (0.0, 90.0, -90.0)
