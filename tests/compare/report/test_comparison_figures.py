"""What the report's plots and differences are made of, and the robot as it draws it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import plotly.graph_objects as go
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from report_samples import APR02, config, flower, run, usual
from sample_robots import LEVER_MECANUM
from wheeled_samples import CAR, ROBOTS, TRICYCLE

from omnibench.compare.report.comparison_report import data_section, robot_section
from omnibench.compare.report.error_figures import chosen_trajectories
from omnibench.compare.report.search_figures import TARGETS, courses, search_section, targets_reached, thinned
from omnibench.compare.report.view import DatasetView, views
from omnibench.data.importers.table1 import APR_02
from omnibench.fit.identifiability import geometry_of
from omnibench.report.blocks import Facts, Figure, FigureGrid
from omnibench.report.figures import motion_system, parameters
from omnibench.report.recording.recording_figures import describe
from omnibench.robot.kinematics import Array, Robot, relative_deviations, wheel_equations
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset


def test_an_element_of_rounding_size_counts_as_zero() -> None:
    reference = np.array([[1.0, -1.2e-17, 1.0]] * 3)
    assert np.isnan(relative_deviations(np.ones((3, 3)), reference)[:, 1]).all()


def trajectories(**changes: object):
    return simulate_dataset(FlowerConfig.model_validate(flower(**changes))).dataset.split("validation")


def test_the_papers_four_commands_are_shown_where_they_were_driven() -> None:
    chosen = chosen_trajectories(trajectories())
    assert [round(np.degrees(t.alpha)) for t in chosen] == [30, 210, 120, 300]
    assert {t.omega for t in chosen} == {0.35}
    assert chosen_trajectories(chosen[:1]) == chosen[:1]


def test_other_commands_are_shown_as_a_spread_of_the_strongest_turns() -> None:
    commands = {"directions_deg": [0, 72, 144, 216, 288], "turn_rates": [0.0, 0.2, 0.6]}
    chosen = chosen_trajectories(trajectories(commands=commands))
    assert len({t.command for t in chosen}) == 4
    assert {t.omega for t in chosen} == {0.6}


def test_a_command_is_described_as_the_paper_writes_it() -> None:
    trajectory = next(t for t in trajectories() if t.command == "v0.2_a30_w0.35")
    assert describe(trajectory) == f"(0.2 m/s, 30°, 0.35 rad/s), {trajectory.id}"


def test_the_design_values_are_no_search() -> None:
    assert {course.run.record.label for course in courses(usual_view())} == {"closed_form", "random_search"}


def test_a_course_ends_with_the_answer() -> None:
    for course in courses(usual_view()):
        assert course.costs[-1] == pytest.approx(course.run.record.train_cost, rel=1e-12)
        assert course.evaluations[-1] == course.run.record.evaluations


def test_the_exact_optimum_reaches_every_target() -> None:
    exact = [course for course in courses(usual_view()) if course.run.record.label == "closed_form"]
    times, share = targets_reached(exact, 1, "evaluations")
    assert share[-1] == 1.0
    assert (np.diff(times) >= 0).all()


def test_targets_are_counted_by_hand_for_a_random_search() -> None:
    course = next(course for course in courses(usual_view()) if course.run.record.label == "random_search")
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


def usual_view() -> DatasetView:
    (view,) = views(usual())
    return view


def grids(view: DatasetView) -> list[FigureGrid]:
    return [block for section in robot_section(view) for block in section.blocks if isinstance(block, FigureGrid)]


def rectangles(trace: go.Scatter) -> list[Array]:
    """The corners (4, 2) of each drawn wheel, in the robot's frame: x forward, y left."""
    corners = np.array([[np.nan if v is None else v for v in values] for values in (trace.y, trace.x)]).T
    corners[:, 1] *= -1
    return [corners[first : first + 4] for first in range(0, len(corners), 6)]


def labels(figure: Figure) -> list[str]:
    return [annotation.text for annotation in figure.plot.layout.annotations]


def test_every_wheel_stands_at_its_distance_and_angle_and_is_as_long_as_its_diameter() -> None:
    figure = parameters(APR_02)
    for wheel, corners in zip(APR_02.wheels, rectangles(figure.plot.data[0]), strict=True):
        place = wheel.distance * np.array([math.cos(wheel.angle), math.sin(wheel.angle)])
        np.testing.assert_allclose(corners.mean(axis=0), place, atol=1e-4)
        assert np.hypot(*(corners[1] - corners[2])) == pytest.approx(2 * wheel.radius, abs=1e-4)
    assert "<b>b</b> r 0.148 m<br>R 0.195 m<br>δ 180.0°" in labels(figure)


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_wheels_given_by_x_and_y_stand_there_along_their_rolling(robot: Robot) -> None:
    figure, _ = motion_system(robot)
    for wheel, corners in zip(robot.wheels, rectangles(figure.plot.data[0]), strict=True):
        np.testing.assert_allclose(corners.mean(axis=0), wheel.position, atol=1e-4)
        np.testing.assert_allclose(corners[1] - corners[2], [2 * wheel.radius, 0], atol=1e-4)
    x, y = (f"{value:g}".replace("-", "−") for value in robot.wheels[0].position)
    first = robot.wheels[0]
    assert f"<b>{first.name}</b> r {first.radius:g} m<br>x {x} m<br>y {y} m" in labels(parameters(robot))
    arrows = [name for name in labels(figure) if name.startswith("V<sub>")]
    assert arrows == [f"V<sub>{name}</sub>" for name in robot.wheel_names]


@pytest.mark.parametrize(
    ("robot", "first", "last"),
    [
        (CAR, "rl: fixed, radius 0.03 m, x 0 m, y 0.1 m; ", "steered, radius 0.03 m, x 0.3 m, y −0.1 m, not driven"),
        (TRICYCLE, "front: steered, radius 0.0325 m, x 0.15 m, y 0 m; ", "x 0 m, y −0.08 m, not measured"),
    ],
)
def test_the_section_on_the_data_says_where_wheels_stand_and_which_are_not_driven_or_not_measured(
    robot: Robot, first: str, last: str
) -> None:
    view = usual_view()
    facts = data_section(replace(view, dataset=replace(view.dataset, robot=robot))).blocks[0]
    assert isinstance(facts, Facts)
    (fact,) = (fact for fact in facts.items if fact.name == "Robot")
    assert fact.note.startswith(first)
    assert fact.note.endswith(last)


def test_the_arrow_at_a_wheel_points_where_a_positive_rate_drives_it() -> None:
    figure, _ = motion_system(APR_02)
    (shafts,) = (trace for trace in figure.plot.data if trace.legendgroup == "rolling" and trace.mode == "lines")
    ends = np.array([[np.nan if v is None else v for v in values] for values in (shafts.y, shafts.x)]).T
    ends[:, 1] *= -1
    for row, first in zip(wheel_equations(APR_02.wheels), range(0, 9, 3), strict=True):
        way = ends[first + 1] - ends[first]
        np.testing.assert_allclose(way / np.hypot(*way), row[:2] / np.hypot(*row[:2]), atol=1e-3)


def test_the_best_entrys_geometry_is_drawn_over_the_design() -> None:
    view = usual_view()
    assert view.best is not None
    assert view.best.typical is not None
    assert view.best.typical.matrix is not None
    _, figure = grids(view)[0].figures
    (fitted,) = (trace for trace in figure.plot.data if trace.legendgroup == "fitted")
    radii, distances, angles = geometry_of(view.best.typical.matrix, view.dataset.robot).reshape(3, 3)
    places = (distances * np.array([np.cos(angles), np.sin(angles)])).T
    drawn = rectangles(fitted)
    np.testing.assert_allclose([corners.mean(axis=0) for corners in drawn], places, atol=1e-4)
    np.testing.assert_allclose([np.hypot(*(each[1] - each[2])) / 2 for each in drawn], radii, atol=1e-4)


def test_without_a_section_on_the_recording_the_tracks_of_every_command_are_drawn() -> None:
    view = usual_view()
    assert len(grids(view)) == 1
    bare = [replace(run, targets=None, angles=None) for run in view.dataset.trajectories]
    _, tracks = grids(replace(view, dataset=replace(view.dataset, trajectories=tuple(bare))))
    assert tracks.figures[0].title == "Reference paths of 8 runs from one start, held-out"
    assert [item.label for item in tracks.legend] == ["ω = −0.35 rad/s", "ω = 0.35 rad/s"]


def test_wheels_whose_position_is_not_known_are_not_drawn() -> None:
    mecanum = flower(robot=LEVER_MECANUM, truth={"tolerances": {"radius": 0.01}})
    (view,) = views(run(config(datasets={"f": {"simulate": mecanum}}, calibrators=["theoretical"], seeds=[1])))
    assert robot_section(view) == ()


def test_the_diagram_of_the_search_names_the_cost_the_budget_and_the_runs() -> None:
    *_, diagram = search_section(usual_view()).blocks
    assert isinstance(diagram, FigureGrid)
    told = " ".join(labels(diagram.figures[0]))
    assert all(
        words in told for words in ("final_pose", "Eq. (6)", "2,000 evaluations", "16 training runs", "exact arcs")
    )
