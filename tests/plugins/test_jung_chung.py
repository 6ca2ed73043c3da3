"""The calibrator jung_chung of ``plugins/``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import published_methods
import pytest
from differential_runs import MOVED, OMNI, ROBOT, in_sessions, ratios, runs_of, solved, solved_on, worn
from hypothesis import given, settings
from hypothesis import strategies as st
from real_recordings import diff

from omnibench.fit.calibrator import Outcome
from omnibench.testing import CalibratorConformance, load_plugin, synthetic_problem


@pytest.fixture(autouse=True, scope="module")
def plugin(registries_as_before_the_module: None) -> None:  # noqa: ARG001
    load_plugin(Path(__file__).parents[2] / "plugins" / "jung_chung.py")


class TestJungChung(CalibratorConformance):
    """The cases of every calibrator."""

    name = "jung_chung"
    solved = 0.4


@settings(max_examples=15)
@given(st.floats(-0.05, 0.05))
def test_the_wheelbase_is_found_exactly_where_the_wheels_are_equal(longer: float) -> None:
    wheelbase, wheels = ratios(solved_on("jung_chung", ROBOT, worn(ROBOT, 1.0, 1.0, 1 + longer), "square").matrix)
    assert (wheelbase, wheels) == pytest.approx((1 + longer, 1.0), abs=1e-9)


@settings(max_examples=15)
@given(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02))
def test_wheels_are_found_and_the_wheelbase_with_half_of_what_they_differ_by(longer: float, unequal: float) -> None:
    true = worn(ROBOT, 1 - unequal / 2, 1 + unequal / 2, 1 + longer)
    wheelbase, wheels = ratios(solved_on("jung_chung", ROBOT, true, "square").matrix)
    size = abs(longer) + abs(unequal)
    assert wheelbase == pytest.approx((1 + longer) * (1 + unequal / 2), abs=2 * size**2 + 1e-9)
    assert wheels == pytest.approx(1 + unequal, abs=2 * size**2 + 1e-9)


def test_the_answer_is_told_in_words() -> None:
    result = solved_on("jung_chung", ROBOT, ROBOT)
    assert result.outcome is Outcome.CONVERGED
    assert result.reason == (
        "wheelbase 400.0 mm (E_b 1.0000), radii left 80.000 and right 80.000 mm (E_d 1.0000), from 2 clockwise and 2 "
        "counter-clockwise squares of 1.00 m"
    )


def test_order_and_direction_of_wheels_and_place_of_the_tracked_point_make_no_difference() -> None:
    plain = solved_on("jung_chung", ROBOT, worn(ROBOT, 1.004, 0.996, 1.01), "square")
    result = solved_on("jung_chung", MOVED, worn(MOVED, 1.004, 0.996, 1.01), "square")
    wheelbase, wheels = ratios(plain.matrix)
    share = {"left": 2 / (1 + wheels), "right": 2 / (1 + 1 / wheels)}
    expected = worn(MOVED, share["left"], share["right"], wheelbase).inverse_kinematic_matrix
    assert result.matrix == pytest.approx(expected, rel=1e-3, abs=1e-5)


@pytest.mark.parametrize(
    ("commands", "found"),
    [
        (("curve", "forward", "turn"), "none"),
        (("square left", "forward"), "2 squares among 4 runs, none clockwise"),
        (("square right",), "2 squares among 2 runs, none counter-clockwise"),
    ],
)
def test_other_paths_than_squares_both_ways_are_refused(commands: tuple[str, ...], found: str) -> None:
    result = solved_on("jung_chung", ROBOT, worn(ROBOT, 1.01, 0.99, 1.0), *commands)
    assert result.outcome is Outcome.NOT_APPLICABLE
    assert result.reason == f"it is for closed squares driven both ways from a corner (found: {found})"


def test_it_is_not_for_robots_on_omni_wheels() -> None:
    result = solved("jung_chung", synthetic_problem(robot=OMNI))
    assert result.outcome is Outcome.NOT_APPLICABLE
    assert result.reason == "it is for differential drives with two measured wheels, and synthetic omni is none"


def test_another_parameterisation_is_refused() -> None:
    result = solved("jung_chung", synthetic_problem("geometry", robot=ROBOT))
    assert (result.outcome, result.reason) == (
        Outcome.FAILED,
        "jung_chung gives a matrix; say parameterisation: matrix",
    )


def test_runs_of_several_sessions_are_refused() -> None:
    runs = in_sessions(runs_of(ROBOT, ROBOT), "morning", "evening")
    result = solved("jung_chung", synthetic_problem(robot=ROBOT, trajectories=runs))
    assert result.outcome is Outcome.NOT_APPLICABLE
    assert result.reason == "its article calibrates from one session, and these are 2"


def test_real_circles_and_lines_are_no_squares() -> None:
    for kind in ("circular", "ivanjko"):
        runs = tuple(replace(run, session=None) for run in published_methods.of_kind(diff(), kind))
        result = solved("jung_chung", synthetic_problem(robot=diff().robot, trajectories=runs))
        assert result.outcome is Outcome.NOT_APPLICABLE
        assert result.reason.endswith("(found: none)")


def test_the_figures_that_are_known_on_real_recordings_come_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """The known ones are of a program that divides the mean heading errors once more, which the plug-in does not."""
    dataset = diff()
    monkeypatch.setattr(published_methods, "recordings", lambda robot: dataset)  # noqa: ARG005
    published_methods.register_divided_twice()
    divided, plain = (published_methods.method_called(label) for label in ("jung_chung, divided twice", "jung_chung"))
    here = published_methods.figures(divided), published_methods.figures(plain)
    for kind, known in divided.known.items():
        assert here[0][kind] == pytest.approx(known, rel=0.02), kind
        assert np.all(np.array(here[1][kind]) <= np.array(known)), kind
