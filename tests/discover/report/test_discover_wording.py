"""A discovery's figures as people read them, and the scale on which its panels are drawn."""

import math
from dataclasses import replace

import numpy as np
import pytest
from discovery_samples import held_out, named

from omnibench.discover.report.figures import PLAIN, Curve, Panel, error_grid, grid
from omnibench.discover.report.tables import (
    answer,
    chance,
    closed_share,
    extrapolation_table,
    gap_values,
    held_out_runs,
    reading,
    value_and_interval,
    weight_in_words,
)
from omnibench.discover.result import EstimatedParameter, Extrapolation, Gap


@pytest.mark.parametrize(
    ("unit", "factor", "shown"),
    [
        ("s", 1e3, "ms"),
        ("m", 1e3, "mm"),
        ("1", 100, "%"),
        ("s/rad", 1, "s/rad"),
        ("s2/m", 1, "s²/m"),
        ("1/s", 3.6e5, "%/h"),
    ],
)
def test_quantities_are_read_in_the_units_of_people(unit: str, factor: float, shown: str) -> None:
    assert reading(unit) == (factor, shown)


def test_a_parameter_shares_its_decimals_with_its_interval() -> None:
    parameter = EstimatedParameter("tau", 0.0312, "s", 0.0301, 0.0323)
    assert value_and_interval(parameter) == ("+31.2", "+30.1 to +32.3", "ms")


def test_a_length_that_was_chosen_keeps_its_unit_and_a_number_has_none() -> None:
    assert value_and_interval(EstimatedParameter("rollers", 10.0, "1", 10.0, 10.0, shape=True)) == ("10", "", "")
    assert value_and_interval(EstimatedParameter("length", 0.1, "m", 0.1, 0.1, shape=True)) == ("100", "", "mm")


@pytest.mark.parametrize(
    ("weight", "words"),
    [(1.0, "> 99.9 %"), (0.9994, "> 99.9 %"), (0.951, "95.1 %"), (0.5, "50.0 %"), (0.0004, "< 0.1 %")],
)
def test_a_weight_is_never_certain(weight: float, words: str) -> None:
    assert weight_in_words(weight) == words


def test_a_chance_below_any_meaning_is_cut() -> None:
    assert chance(0.0) == "< 10⁻⁹⁹"
    assert chance(0.0123) == "0.012"
    assert chance(4.4e-12) == "4 × 10⁻¹²"


def test_no_gap_is_not_a_gap_that_stayed_open() -> None:
    assert closed_share(Gap("eq6", 1.0, 1.0, 1.0, None, 0.1)) == "no gap to close"
    assert closed_share(Gap("eq6", 1.0, 0.4, None, None, 0.1)) == "no share known"
    assert gap_values(Gap("eq6", 0.0412, 0.0213, 0.0205, 0.961, 0.001)) == ("0.0412", "0.0213", "0.0205")


@pytest.mark.parametrize(("after", "shown"), [(0.3, "300"), (8.14, "cannot be said"), (math.nan, "cannot be said")])
def test_a_bound_many_times_the_plain_matrix_s_is_not_given_as_a_figure(after: float, shown: str) -> None:
    (row,) = extrapolation_table((Extrapolation("square", "turns", 0.158, after),)).rows
    assert [cell.text for cell in row.cells] == ["square", "turns", "158", shown]


def test_runs_of_which_none_is_repeated_are_not_called_repetitions() -> None:
    found = named()
    repetitions = held_out(found, "repetitions")
    assert held_out_runs(found, repetitions) == "held-out repetitions: 36 runs"
    alone = replace(found, noise=replace(found.noise, source="within runs"))
    assert held_out_runs(alone, repetitions) == "held-out runs: 36 runs"


def test_a_cause_that_is_not_sure_is_said_to_be_the_likeliest() -> None:
    found = named()
    (effect,) = found.effects
    doubtful = replace(found, effects=(replace(effect, class_weight=0.5),))
    assert not answer(found).startswith("Likeliest")
    assert answer(doubtful) == f"Likeliest, but not sure: {answer(found)}"


def test_the_errors_after_each_effect_stand_between_the_plain_matrix_and_the_extended_model() -> None:
    found = named()
    first, last = found.steps
    between = replace(last, name="+ wheel_dead_zone", eq6_held_out=0.02, held_out=9.0)
    found = replace(found, steps=(first, between, last))
    bars = [[trace.y[0] for trace in figure.plot.data] for figure in error_grid(found).figures]
    assert bars[0] == ["plain matrix", "+ wheel_dead_zone", "extended model", "floor"]
    unknown = replace(found, steps=(first, replace(between, eq6_held_out=None, held_out=None), last))
    assert [trace.y[0] for trace in error_grid(unknown).figures[0].plot.data] == [bars[0][0], *bars[0][2:]]


def scale_of(values: list[float], half_width: list[float]) -> float:
    curve = Curve(PLAIN, np.array(values), np.array(half_width))
    panel = Panel("a panel", np.arange(float(len(values))), "x", "mm", (curve,))
    low, high = grid([panel], (PLAIN,)).figures[0].plot.layout.yaxis.range
    assert low == -high
    return float(high)


@pytest.mark.parametrize(
    ("last", "half_width", "shown"),
    [(50.0, 60.0, False), (50.0, 2.0, True), (50.0, 20.0, True), (np.nan, np.nan, False)],
    ids=["within a wide band", "beyond the usual band", "beyond a wide band", "unknown"],
)
def test_a_value_sets_the_scale_unless_in_a_band_wider_than_usual(last: float, half_width: float, shown: bool) -> None:
    scale = scale_of([1.0, -2.0, 1.5, 2.0, -1.0, last], [2.0, 2.0, 2.0, 2.0, 2.0, half_width])
    assert scale == pytest.approx(1.1 * (50.0 if shown else 1.3 * 2.0))
