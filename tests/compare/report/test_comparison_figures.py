"""What the report's plots and differences are made of."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from report_samples import APR02, config, flower, run, usual

from omnibench.compare.report.error_figures import chosen_trajectories
from omnibench.compare.report.search_figures import TARGETS, courses, targets_reached, thinned
from omnibench.compare.report.view import views
from omnibench.report.recording.recording_figures import describe
from omnibench.robot.kinematics import Robot, published_matrix, relative_deviations
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset


def test_differences_are_those_of_the_papers_equation_11() -> None:
    found = 100 * relative_deviations(published_matrix("palacin2023_eq8"), published_matrix("palacin2023_eq9"))
    paper = [[1.091, np.nan, -0.671], [-0.358, 0.195, -0.572], [0.299, 0.103, 0.212]]
    np.testing.assert_array_equal(np.trunc(1000 * found) / 1000, np.array(paper))  # the paper cuts, it does not round


def test_an_element_of_rounding_size_counts_as_zero() -> None:
    reference = np.array([[1.0, -1.2e-17, 1.0]] * 3)
    assert np.isnan(relative_deviations(np.ones((3, 3)), reference)[:, 1]).all()


def trajectories(**changes: object):
    return simulate_dataset(FlowerConfig.model_validate(flower(**changes))).dataset.split("validation")


def test_the_papers_four_commands_are_shown_where_they_were_driven() -> None:
    chosen = chosen_trajectories(trajectories())
    assert [round(np.degrees(t.alpha)) for t in chosen] == [30, 210, 120, 300]
    assert {t.omega for t in chosen} == {0.35}


def test_other_commands_are_shown_as_a_spread_of_the_strongest_turns() -> None:
    commands = {"directions_deg": [0, 72, 144, 216, 288], "turn_rates": [0.0, 0.2, 0.6]}
    chosen = chosen_trajectories(trajectories(commands=commands))
    assert len({t.command for t in chosen}) == 4
    assert {t.omega for t in chosen} == {0.6}


def test_a_single_trajectory_is_shown() -> None:
    (only,) = trajectories()[:1]
    assert chosen_trajectories([only]) == [only]


def test_a_command_is_described_as_the_paper_writes_it() -> None:
    trajectory = next(t for t in trajectories() if t.command == "v0.2_a30_w0.35")
    assert describe(trajectory) == f"(0.2 m/s, 30°, 0.35 rad/s), {trajectory.id}"


@pytest.fixture(scope="module")
def view():
    (found,) = views(usual())
    return found


def test_the_design_values_are_no_search(view) -> None:
    assert {course.run.record.label for course in courses(view)} == {"closed_form", "random_search"}


def test_a_course_ends_with_the_answer(view) -> None:
    for course in courses(view):
        assert course.costs[-1] == pytest.approx(course.run.record.train_cost, rel=1e-12)
        assert course.evaluations[-1] == course.run.record.evaluations


def test_the_exact_optimum_reaches_every_target(view) -> None:
    exact = [course for course in courses(view) if course.run.record.label == "closed_form"]
    times, share = targets_reached(exact, 1, "evaluations")
    assert share[-1] == 1.0
    assert (np.diff(times) >= 0).all()


def test_targets_are_counted_by_hand_for_a_random_search(view) -> None:
    course = next(course for course in courses(view) if course.run.record.label == "random_search")
    _, share = targets_reached([course], 1, "evaluations")
    lowest = course.costs.min() / course.best_known - 1
    assert len(share) == np.count_nonzero(lowest <= TARGETS)


def explicit(share: float) -> dict:
    """A box of so wide a share of the row's largest element on both sides."""
    start = Robot.model_validate(APR02).inverse_kinematic_matrix
    width = share * np.abs(start).max(axis=1, keepdims=True)
    return {"lower": (start - width).tolist(), "upper": (start + width).tolist()}


def test_boxes_that_share_a_name_do_not_share_a_best_known_cost() -> None:
    calibrators = [
        {"name": name, "label": f"{name} {share}", "box": explicit(share)}
        for share in (0.02, 0.2)
        for name in ("closed_form", "random_search")
    ]
    (found,) = views(run(config(calibrators=calibrators, seeds=[1])))
    drawn = {course.run.record.label: course for course in courses(found)}
    assert {course.run.record.box for course in drawn.values()} == {"custom"}
    for course in drawn.values():
        assert course.costs[-1] / course.best_known - 1 == pytest.approx(course.run.record.gap, abs=1e-12)
    assert drawn["closed_form 0.02"].best_known > drawn["closed_form 0.2"].best_known


def test_without_an_exact_optimum_equal_boxes_share_the_lowest_cost() -> None:
    calibrators = [
        {"name": "random_search", "label": label, "box": explicit(share), "options": {"candidates": candidates}}
        for label, share, candidates in (("few", 0.2, 20), ("many", 0.2, 1000), ("narrow", 0.02, 1000))
    ]
    (found,) = views(run(config(calibrators=calibrators, seeds=[1])))
    drawn = {course.run.record.label: course for course in courses(found)}
    costs = {label: course.run.record.train_cost for label, course in drawn.items()}
    assert drawn["few"].best_known == drawn["many"].best_known == min(costs["few"], costs["many"])
    assert drawn["narrow"].best_known == costs["narrow"]


def test_a_run_without_a_course_counts_as_targets_missed(view) -> None:
    exact = [course for course in courses(view) if course.run.record.label == "closed_form"]
    assert targets_reached(exact, 2, "evaluations")[1][-1] == 0.5


@given(
    hnp.arrays(float, st.integers(1, 3000), elements=st.floats(0.5, 1.0)),
    st.integers(24, 200),
)
def test_thinning_keeps_the_ends_the_order_and_the_limit(shrink: np.ndarray, limit: int) -> None:
    gaps = np.maximum(np.cumprod(shrink), 1e-10)
    along = np.arange(1.0, len(gaps) + 1)
    kept = thinned(along, gaps, limit)
    assert kept[0] == 0
    assert kept[-1] == len(gaps) - 1
    assert kept == sorted(set(kept))
    assert len(kept) <= limit + 4


def test_thinning_does_not_move_a_curve_by_more_than_a_hair() -> None:
    along = np.arange(1.0, 20_001)
    gaps = np.exp(-along / 2000)
    kept = thinned(along, gaps, 200)
    drawn = gaps[kept][np.searchsorted(kept, np.arange(len(along)), side="right") - 1]
    assert np.abs(np.log10(drawn) - np.log10(gaps)).max() < 0.1
