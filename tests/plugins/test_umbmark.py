"""The calibrator umbmark of ``plugins/``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

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
    load_plugin(Path(__file__).parents[2] / "plugins" / "umbmark.py")


class TestUmbmark(CalibratorConformance):
    """The cases of every calibrator."""

    name = "umbmark"
    solved = 0.2


@settings(max_examples=15)
@given(st.floats(-0.02, 0.02), st.floats(-0.01, 0.01))
def test_wheelbase_and_wheels_are_found_to_first_order(longer: float, unequal: float) -> None:
    true = worn(ROBOT, 1 - unequal / 2, 1 + unequal / 2, 1 + longer)
    wheelbase, wheels = ratios(solved_on("umbmark", ROBOT, true, "square").matrix)
    size = abs(longer) + abs(unequal)
    assert wheelbase == pytest.approx(1 + longer, abs=8 * size**2 + 1e-9)
    assert wheels == pytest.approx(1 + unequal, abs=8 * size**2 + 1e-9)


def test_the_answer_is_told_in_words() -> None:
    result = solved_on("umbmark", ROBOT, ROBOT)
    assert result.outcome is Outcome.CONVERGED
    assert result.reason == (
        "wheelbase 400.0 mm (E_b 1.0000), radii left 80.000 and right 80.000 mm (E_d 1.0000), from 2 clockwise and 2 "
        "counter-clockwise squares of 1.00 m"
    )


def test_order_and_direction_of_wheels_and_place_of_the_tracked_point_make_no_difference() -> None:
    plain = solved_on("umbmark", ROBOT, worn(ROBOT, 1.004, 0.996, 1.01), "square")
    result = solved_on("umbmark", MOVED, worn(MOVED, 1.004, 0.996, 1.01), "square")
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
    result = solved_on("umbmark", ROBOT, worn(ROBOT, 1.01, 0.99, 1.0), *commands)
    assert result.outcome is Outcome.NOT_APPLICABLE
    assert result.reason == f"it is for closed squares driven both ways from a corner (found: {found})"


def test_it_is_not_for_robots_on_omni_wheels() -> None:
    result = solved("umbmark", synthetic_problem(robot=OMNI))
    assert result.outcome is Outcome.NOT_APPLICABLE
    assert result.reason == "it is for differential drives with two measured wheels, and synthetic omni is none"


def test_another_parameterisation_is_refused() -> None:
    result = solved("umbmark", synthetic_problem("geometry", robot=ROBOT))
    assert (result.outcome, result.reason) == (Outcome.FAILED, "umbmark gives a matrix; say parameterisation: matrix")


def test_runs_of_several_sessions_are_refused() -> None:
    runs = in_sessions(runs_of(ROBOT, ROBOT), "morning", "evening")
    result = solved("umbmark", synthetic_problem(robot=ROBOT, trajectories=runs))
    assert result.outcome is Outcome.NOT_APPLICABLE
    assert result.reason == "its article calibrates from one session, and these are 2"


def test_real_circles_and_lines_are_no_squares() -> None:
    for kind in ("circular", "ivanjko"):
        runs = tuple(replace(run, session=None) for run in published_methods.of_kind(diff(), kind))
        result = solved("umbmark", synthetic_problem(robot=diff().robot, trajectories=runs))
        assert result.outcome is Outcome.NOT_APPLICABLE
        assert result.reason.endswith("(found: none)")


def test_the_figures_that_are_known_on_real_recordings_come_out(monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = diff()
    monkeypatch.setattr(published_methods, "recordings", lambda robot: dataset)  # noqa: ARG005
    method = published_methods.method_called("umbmark")
    for kind, here in published_methods.figures(method).items():
        assert here == pytest.approx(method.known[kind], rel=0.02), kind
