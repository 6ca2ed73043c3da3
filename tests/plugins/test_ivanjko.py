"""The calibrator ivanjko of ``plugins/``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import published_methods
import pytest
from differential_runs import MOVED, OMNI, ROBOT, in_sessions, runs_of, solved, solved_on, worn
from hypothesis import given, settings
from hypothesis import strategies as st
from real_recordings import diff

from omnibench.fit.calibrator import Outcome
from omnibench.testing import CalibratorConformance, load_plugin, synthetic_problem


@pytest.fixture(autouse=True, scope="module")
def plugin(registries_as_before_the_module: None) -> None:  # noqa: ARG001
    load_plugin(Path(__file__).parents[2] / "plugins" / "ivanjko.py")


class TestIvanjko(CalibratorConformance):
    """The cases of every calibrator."""

    name = "ivanjko"
    solved = 1e-09


@settings(max_examples=10)
@given(st.floats(0.95, 1.05), st.floats(0.95, 1.05), st.floats(0.95, 1.05))
def test_radii_and_wheelbase_are_found_exactly(left: float, right: float, wheelbase: float) -> None:
    for robot in (ROBOT, MOVED):
        true = worn(robot, left, right, wheelbase)
        result = solved_on("ivanjko", robot, true, "forward", "turn", "square")
        assert result.outcome is Outcome.CONVERGED
        assert result.matrix == pytest.approx(true.inverse_kinematic_matrix, rel=1e-6, abs=1e-8)


def test_the_answer_is_told_in_words() -> None:
    assert solved_on("ivanjko", ROBOT, ROBOT).reason == (
        "radii left 80.000, right 80.000 mm, wheelbase 400.0 mm, from 4 straight lines, 2 turns to the left and 2 to "
        "the right, after 1 round"
    )


@pytest.mark.parametrize(
    ("commands", "missing"),
    [
        (
            ("square", "curve"),
            "straight lines and no turns on the spot to the left and no turns on the spot to the right",
        ),
        (("forward", "turn left"), "turns on the spot to the right"),
        (("turn",), "straight lines"),
    ],
)
def test_what_is_missing_among_the_paths_is_told(commands: tuple[str, ...], missing: str) -> None:
    runs = runs_of(ROBOT, worn(ROBOT, 1.01, 0.99, 1.0), *commands)
    result = solved("ivanjko", synthetic_problem(robot=ROBOT, trajectories=runs))
    assert result.outcome is Outcome.NOT_APPLICABLE
    assert result.reason == (
        f"it is for straight lines and turns on the spot both ways; among {len(runs)} runs there are no {missing}"
    )


def test_it_is_not_for_robots_on_omni_wheels() -> None:
    result = solved("ivanjko", synthetic_problem(robot=OMNI))
    assert result.outcome is Outcome.NOT_APPLICABLE
    assert result.reason == "it is for differential drives with two measured wheels, and synthetic omni is none"


def test_another_parameterisation_is_refused() -> None:
    result = solved("ivanjko", synthetic_problem("geometry", robot=ROBOT))
    assert (result.outcome, result.reason) == (Outcome.FAILED, "ivanjko gives a matrix; say parameterisation: matrix")


def test_runs_of_several_sessions_are_refused() -> None:
    runs = in_sessions(runs_of(ROBOT, ROBOT), "morning", "evening")
    result = solved("ivanjko", synthetic_problem(robot=ROBOT, trajectories=runs))
    assert result.outcome is Outcome.NOT_APPLICABLE
    assert result.reason == "its article calibrates from one session, and these are 2"


def test_real_circles_and_squares_are_no_lines_and_turns() -> None:
    for kind in ("circular", "square"):
        runs = tuple(replace(run, session=None) for run in published_methods.of_kind(diff(), kind))
        result = solved("ivanjko", synthetic_problem(robot=diff().robot, trajectories=runs))
        assert result.outcome is Outcome.NOT_APPLICABLE
        assert "there are no straight lines and no turns" in result.reason


def test_the_figures_that_are_known_on_real_recordings_come_out(monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = diff()
    monkeypatch.setattr(published_methods, "recordings", lambda robot: dataset)  # noqa: ARG005
    method = published_methods.method_called("ivanjko")
    for kind, here in published_methods.figures(method).items():
        assert here == pytest.approx(method.known[kind], rel=0.02), kind
