"""Panels before and after: the scale on which their curves can be read."""

from __future__ import annotations

import numpy as np
import pytest

from omnibench.discover.report.residuals import PLAIN, Curve, Panel, drawn


def scale_of(values: list[float], half_width: list[float]) -> float:
    curve = Curve(PLAIN, np.array(values), np.array(half_width))
    panel = Panel("a panel", np.arange(float(len(values))), (curve,), "x", "y", "mm")
    low, high = drawn([panel])[0].layout.yaxis.range
    assert low == -high
    return float(high)


@pytest.mark.parametrize(
    ("last", "half_width", "shown"),
    [(50.0, 60.0, False), (50.0, 2.0, True), (50.0, 20.0, True), (np.nan, np.nan, False)],
    ids=["within a wide band", "beyond the usual band", "beyond a wide band", "unknown"],
)
def test_a_value_sets_the_scale_unless_it_lies_within_a_band_wider_than_usual(
    last: float, half_width: float, shown: bool
) -> None:
    scale = scale_of([1.0, -2.0, 1.5, 2.0, -1.0, last], [2.0, 2.0, 2.0, 2.0, 2.0, half_width])
    assert scale == pytest.approx(1.1 * (50.0 if shown else 1.3 * 2.0))
