"""The report of a comparison: its words, tables and figures, and published figures beside them."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import pytest
from browser import assert_picture_comes_first, opened
from recording_samples import with_a_tape
from report_page import Page
from report_samples import config, flower, page, run, statistics, usual
from sample_robots import APR02, LEVER_MECANUM
from syrupy.assertion import SnapshotAssertion
from wheeled_samples import ROBOTS

from omnibench.compare.plan import load_robots
from omnibench.compare.report.document import comparison_document, robot_picture
from omnibench.compare.report.paper import (
    ComparedFigure,
    compared_figures,
    paper_paths,
    published_blocks,
)
from omnibench.compare.report.searches import (
    TARGETS,
    courses,
    expected_running_time,
    targets_reached,
)
from omnibench.compare.report.tables import cost_table, matrix_blocks
from omnibench.compare.report.view import DatasetView, views
from omnibench.compare.result import ComparisonResult
from omnibench.data.dataset import Dataset, make_dataset
from omnibench.data.importers.table1 import APR_02
from omnibench.fit.intervals import Interval
from omnibench.fit.problem import Improvement
from omnibench.report.blocks import Callout, Fact, Figure, Table
from omnibench.report.figures import motion_system
from omnibench.report.numbers import fixed
from omnibench.report.render import write_document
from omnibench.robot.kinematics import Array, Robot, relative_deviations, wheel_equations
from omnibench.robot.physical import read_matrix
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import simulate_dataset

FAILING = {"name": "parametric", "label": "hopeless", "parameterisation": "matrix"}
HOSTILE = "<script>alert(1)</script>"
TRAINING, HELD_OUT = (f"flower (simulated): 16 {split} runs, cost final_pose" for split in ("training", "held-out"))
MATRICES = "Matrices M⁻¹ and their differences from the design values"
PARAMETERS = "Physical parameters and their deviation from the design values"

Render = Callable[..., Page]


@pytest.fixture(scope="module")
def result() -> ComparisonResult:
    """Three calibrators that answer and one that fails, on a simulated flower."""
    published = {"label": "GA", "source": "an article", "theoretical_train_cost": 0.1234, "train_cost": 0.0215}
    return run(
        config(calibrators=["theoretical", "closed_form", "random_search", FAILING], published_results=[published])
    )


@pytest.fixture(scope="module")
def report(result: ComparisonResult, tmp_path_factory: pytest.TempPathFactory) -> Page:
    return page(result, tmp_path_factory.mktemp("report"))


@pytest.fixture
def told(tmp_path: Path) -> Render:
    """A function that compares a changed config, and perhaps other data, and gives its report."""

    def render(loaded: dict[str, Dataset] | None = None, /, **changes: Any) -> Page:
        chosen = {"calibrators": ["theoretical", "closed_form"], "seeds": [1], **changes}
        return page(run(config(**chosen), loaded), tmp_path)

    return render


def with_data(result: ComparisonResult, datasets: dict[str, Dataset]) -> ComparisonResult:
    """The comparison with other recordings of its data sets."""
    robots = tuple(replace(robot, dataset=datasets.get(robot.name, robot.dataset)) for robot in result.robots)
    return replace(result, robots=robots)


def with_entry(result: ComparisonResult, label: str, **changes: Any) -> ComparisonResult:
    """The comparison with other statistics of one entry."""
    changed = [replace(entry, **changes) if entry.label == label else entry for entry in result.statistics]
    return replace(result, statistics=tuple(changed))


def simulated(**changes: Any) -> dict[str, Any]:
    return {"flower": {"simulate": flower(**changes)}}


def test_the_report_has_the_sections_and_tables_that_it_had(report: Page, snapshot: SnapshotAssertion) -> None:
    tables = [f"{caption}: {', '.join(rows[0])}" for caption, rows in report.tables.items()]
    assert "\n".join([*report.sections, *tables]) == snapshot


def test_numbers_stand_in_the_units_and_digits_of_the_paper(result: ComparisonResult, report: Page) -> None:
    entry = statistics(result, "closed_form")
    fell, errors = entry.improvements["validation"], entry.typical.scores["validation"].errors
    interval = f"95 % interval {100 * fell.low:.1f} to {100 * fell.high:.1f} %"
    assert f"the cost fell by {100 * fell.value:.1f} % ({interval})" in report.text
    for caption, split in ((TRAINING, "train"), (HELD_OUT, "validation")):
        cost = entry.costs[split]
        cells = report.row(caption, "closed_form")
        assert cells[1] == f"{fixed(cost.value, 4)} | {fixed(cost.low, 4)} to {fixed(cost.high, 4)}"
    assert report.tables[TRAINING][-1][:3] == ["GA | an article", "0.0215 | from 0.1234", "82.58 %"]
    cells = report.row(HELD_OUT, "closed_form")
    assert cells[3].split(" | ")[0] == f"{1e3 * np.hypot(errors[:, 0], errors[:, 1]).mean():.1f}"
    assert cells[4].split(" | ")[0] == f"{np.degrees(np.abs(errors[:, 2]).mean()):.2f}"
    for value in entry.typical.matrix.ravel():
        assert repr(float(value)) in report.text
    assert f"numpy {result.environment.versions['numpy']}" in report.text
    assert result.environment.platform in report.text


def test_recorded_data_notes_and_warnings_are_told(result: ComparisonResult, tmp_path: Path) -> None:
    recorded = {name: replace(dataset, simulated=False) for name, dataset in result.datasets.items()}
    noted = result.config.model_copy(update={"notes": ("Not the authors' data.",)})
    text = page(replace(with_data(result, recorded), config=noted, warnings=("no plug-in x",)), tmp_path).text
    assert "SIMULATED" not in text
    assert "Not the authors' data." in text
    assert "no plug-in x" in text


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"datasets": simulated(validation=None)}, "No runs are held out"),
        ({"datasets": simulated(validation=None)}, "closed_form is the only calibrator with an answer"),
        ({"calibrators": ["theoretical"]}, "Only the design values gave an answer"),
        ({"calibrators": [FAILING]}, "No calibrator gave an answer: 1 run"),
        ({"description": HOSTILE}, HOSTILE),
    ],
)
def test_what_is_special_about_a_comparison_is_told(changes: dict[str, Any], sentence: str, told: Render) -> None:
    report = told(**changes)
    assert sentence in report.text
    assert HOSTILE not in report.html


def test_a_robot_that_is_as_designed_gains_nothing_that_noise_could_not_explain(told: Render) -> None:
    design = {"matrix": Robot.model_validate(APR02).inverse_kinematic_matrix.tolist()}
    text = told(datasets=simulated(truth=design)).text
    assert "No calibrator did better than the design values" in text or "noise alone could explain" in text


def test_entries_that_noise_could_swap_are_not_told_apart_and_the_training_cost_decides(tmp_path: Path) -> None:
    twins = [{"name": "closed_form", "label": name} for name in ("one", "other")]
    result = run(config(calibrators=["theoretical", *twins], seeds=[1]))
    report = page(result, tmp_path)
    best = next(entry.label for entry in result.statistics if entry.is_best)
    (rival,) = {"one", "other"} - {best}
    assert f"Not told apart from it: {rival}; it has the lowest training cost" in report.text
    assert "is best." not in report.text
    assert [report.row(HELD_OUT, name)[-1] for name in (best, rival)] == ["best", "not told apart"]


def test_an_entry_that_the_runs_hardly_judge_is_not_told_apart_and_not_drawn_as_the_best(tmp_path: Path) -> None:
    wide = Interval(0.07, -0.05, 0.2)
    changed = with_entry(usual(), "random_search", difference=wide, practically_equal=True)
    assert "Not told apart from it: random_search;" in page(changed, tmp_path).text
    chart = changed.plot()
    drawn = {words.split(":")[0]: trace for trace in chart.data for words in trace.text or ()}
    assert drawn["closed_form"].marker.color != drawn["random_search"].marker.color
    (row,) = (line for line in repr(changed).splitlines() if line.strip().startswith("random_search"))
    assert row.rstrip().endswith("not told apart")


def test_a_search_that_won_without_finding_the_minimum_is_doubted(tmp_path: Path) -> None:
    lucky = [replace(entry, is_best=entry.label == "random_search") for entry in usual().statistics]
    text = page(replace(usual(), statistics=tuple(lucky)), tmp_path).text
    assert "random_search has not found the minimum" in text


def test_an_entry_below_the_best_by_more_than_noise_is_not_called_worse(tmp_path: Path) -> None:
    below = Interval(-0.01, -0.02, -0.005)
    report = page(with_entry(usual(), "random_search", difference=below, practically_equal=False), tmp_path)
    assert report.row(HELD_OUT, "random_search")[-1] == "lower cost here"


def test_commands_that_the_best_makes_worse_are_listed_with_both_costs(tmp_path: Path) -> None:
    (dataset,) = usual().datasets.values()
    commands = [trajectory.command for trajectory in dataset.split("validation")]
    typical = statistics(usual(), "closed_form").typical
    spoilt = np.array([command == commands[0] for command in commands])
    score, design = typical.scores["validation"], typical.design["validation"]
    costs = np.where(spoilt, design.costs + 0.01, score.costs)
    scores = {**typical.scores, "validation": replace(score, costs=costs)}
    text = page(with_entry(usual(), "closed_form", typical=replace(typical, scores=scores)), tmp_path).text
    was = design.costs[spoilt].mean()
    assert f"on 1 of {len(set(commands))} commands of the held-out runs" in text
    assert f"{commands[0]} {was:.4f} → {was + 0.01:.4f}." in text


def test_intervals_over_runs_are_said_to_be_too_narrow_where_commands_are_repeated(report: Page, told: Render) -> None:
    by_run = told(calibrators=["closed_form"], bootstrap={"unit": "run"}).text
    assert by_run.count("commands that were not driven here the spread is larger") == 1
    assert "bootstrap over 16 runs" in by_run
    assert "the spread is larger" not in report.text
    once = told(datasets=simulated(repetitions=1), calibrators=["closed_form"]).text
    assert "commands that were not driven here" not in once


def test_one_validation_run_gives_no_interval_and_no_best(told: Render) -> None:
    usual_data = usual().datasets["flower"]
    runs = [*usual_data.split("train"), usual_data.split("validation")[0]]
    few = make_dataset("few", usual_data.robot, 0.01, runs, simulated=True)
    report = told({"flower": few}, calibrators=["theoretical", "closed_form", "random_search"])
    answer = report.text.split("Costs")[0]
    assert "Which entry is best cannot be said (no interval from 1 run)" in report.text
    assert "could explain" not in answer
    assert "95 % interval" not in answer
    (caption,) = (name for name in report.tables if "1 held-out run," in name)
    assert report.row(caption, "random_search")[-1] == "undecided"
    assert report.row(caption, "closed_form")[2].endswith("no interval")


def test_of_runs_whose_lengths_alone_are_known_no_heading_error_is_stated(told: Render) -> None:
    (robot,), _ = load_robots(config())
    taped = {robot.name: replace(robot.dataset, trajectories=tuple(map(with_a_tape, robot.dataset.trajectories)))}
    report = told(taped)
    answer = report.text[: report.text.index("All entries")]
    assert "closed_form misses the references by" in answer
    assert "°" not in answer
    assert "heading" not in answer
    assert report.row(HELD_OUT, "closed_form")[4] == "–"


def test_the_design_values_lead_the_tables_even_if_no_entry_asks_for_them(report: Page, told: Render) -> None:
    unasked = told(calibrators=["closed_form"])
    for caption in (TRAINING, HELD_OUT):
        assert unasked.row(caption, "theoretical")[:5] == report.row(caption, "theoretical")[:5]


def test_an_element_that_the_box_holds_is_marked(told: Render) -> None:
    cells = told(box="paper", calibrators=["closed_form"]).row(MATRICES, "closed_form")
    assert [index for index, cell in enumerate(cells) if "‡" in cell] == [2]


def test_several_data_sets_stand_in_the_answer_and_have_a_part_each(told: Render) -> None:
    one = {"simulate": flower(repetitions=1)}
    report = told(datasets={"one": one, "two": one})
    answer = report.text[
        : report.text.index("The odometry calibrated") if "The odometry calibrated" in report.text else None
    ]
    assert all(f"{name} (simulated): 8 held-out runs" in answer for name in ("one", "two"))
    assert {"answer", "data-1-answer", "data-2-answer"} <= set(report.sections)
    assert len(report.sections) == len(set(report.sections))


def test_parameters_are_told_with_their_deviation(tmp_path: Path) -> None:
    search = {"search": "random_search", "search_options": {"candidates": 200}}
    result = run(config(calibrators=["theoretical", {"name": "parametric", "options": search}], seeds=[1]))
    found = {each.name: each for each in result.runs[1].record.parameters}
    radius, report = found["radius_a"], page(result, tmp_path)
    cells = report.row(PARAMETERS, "radius_a")
    assert cells[1] == "0.14800 m"
    assert cells[2] == f"{radius.value:.5f} m | {fixed(radius.deviation_percent, 2, signed=True)} %"
    turned = fixed(math.degrees(found["angle_a"].deviation), 3, signed=True)
    assert report.row(PARAMETERS, "angle_a")[2].endswith(f"| {turned}°")


def test_four_wheels_have_twelve_elements_compared_on_the_driven_span(told: Render) -> None:
    report = told(datasets=simulated(robot=LEVER_MECANUM, truth={"tolerances": {"radius": 0.02, "seed": 1}}))
    assert len(report.row(MATRICES, "closed_form")) == 13
    assert "Compared on the span of drive signals that the data drive" in report.text


@pytest.mark.slow
def test_long_histories_and_runs_make_a_file_below_eight_megabytes(result: ComparisonResult, tmp_path: Path) -> None:
    long_runs = flower(sample_period=0.04, pose_period=0.04, train={"seed": 1, "distance": 12}, repetitions=1)
    dataset = simulate_dataset(FlowerConfig.model_validate(long_runs)).dataset
    steps = [Improvement(2 * k, 1e-3 * k, 0.02 + math.exp(-1e-3 * k)) for k in range(1, 20_000)]
    searched = next(run for run in result.runs if run.record.label == "random_search")
    many = [
        replace(
            searched,
            result=replace(searched.result, history=tuple(steps)),
            row=searched.record.model_copy(update={"seed": seed}),
        )
        for seed in range(100)
    ]
    small = run(config(calibrators=["theoretical", "closed_form"]), {"flower": dataset})
    report = page(replace(small, runs=(*small.runs, *many)), tmp_path)
    assert len(report.html) < 8e6
    assert report.row("Every run", "random_search")


def test_a_browser_draws_every_plot_and_finds_no_fault(result: ComparisonResult, tmp_path: Path) -> None:
    write_document(comparison_document(result), tmp_path / "report.html")
    drawn, complaints = opened(tmp_path / "report.html")
    assert 'data-plots="drawn"' in drawn
    plots = re.findall(r'<figure class="plot">.*?</figure>', drawn, re.DOTALL)
    assert len(plots) >= 6
    assert all('class="main-svg"' in plot and ("<path" in plot) for plot in plots)
    assert not complaints


@pytest.mark.slow
def test_the_paths_before_and_after_stand_in_the_first_900_pixels(result: ComparisonResult, tmp_path: Path) -> None:
    write_document(comparison_document(result), tmp_path / "report.html")
    assert_picture_comes_first(tmp_path / "report.html")


# What the report's plots and differences are made of, and the robot as it draws it.


def test_the_design_values_are_no_search() -> None:
    assert {course.run.record.label for course in courses(usual_view())} == {"closed_form", "random_search"}


def test_a_course_ends_with_the_answer() -> None:
    for course in courses(usual_view()):
        assert course.costs[-1] == pytest.approx(course.run.record.train_cost, rel=1e-12)
        assert course.evaluations[-1] == course.run.record.evaluations


def test_the_exact_optimum_reaches_every_target() -> None:
    exact = [course for course in courses(usual_view()) if course.run.record.label == "closed_form"]
    times, share = targets_reached(exact, 1)
    assert share[-1] == 1.0
    assert (np.diff(times) >= 0).all()


def test_targets_are_counted_by_hand_for_a_random_search() -> None:
    course = next(course for course in courses(usual_view()) if course.run.record.label == "random_search")
    _, share = targets_reached([course], 1)
    lowest = course.costs.min() / course.best_known - 1
    assert len(share) == np.count_nonzero(lowest <= TARGETS)


def test_the_expected_running_time_counts_what_runs_spent_that_missed_the_target() -> None:
    course = next(iter(courses(usual_view())))
    near = course.best_known * (1 + np.array([0.9, 0.09, 0.009]))
    reached = replace(course, costs=near, evaluations=np.array([1.0, 10.0, 100.0]))
    missed = replace(course, costs=near[:2], evaluations=np.array([1.0, 50.0]))
    target = int(np.flatnonzero(TARGETS >= 0.01 - 1e-12)[-1])
    assert expected_running_time([reached, missed], target) == 150
    assert expected_running_time([missed], target) == math.inf


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


def usual_view() -> DatasetView:
    (view,) = views(usual())
    return view


def rectangles(trace: go.Scatter) -> list[Array]:
    """The corners (4, 2) of each drawn wheel, in the robot's frame: x forward, y left."""
    corners = np.array([[np.nan if v is None else v for v in values] for values in (trace.y, trace.x)]).T
    corners[:, 1] *= -1
    return [corners[first : first + 4] for first in range(0, len(corners), 6)]


def labels(figure: Figure) -> list[str]:
    return [annotation.text for annotation in figure.plot.layout.annotations]


def test_every_wheel_stands_at_its_distance_and_angle_and_is_as_long_as_its_diameter() -> None:
    (figure,) = motion_system(APR_02).figures
    for wheel, corners in zip(APR_02.wheels, rectangles(figure.plot.data[0]), strict=True):
        place = wheel.distance * np.array([math.cos(wheel.angle), math.sin(wheel.angle)])
        np.testing.assert_allclose(corners.mean(axis=0), place, atol=1e-4)
        assert np.hypot(*(corners[1] - corners[2])) == pytest.approx(2 * wheel.radius, abs=1e-4)
    assert "<b>b</b> r 0.148 m<br>R 0.195 m<br>δ 180.0°" in labels(figure)


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_wheels_given_by_x_and_y_stand_there_along_their_rolling(robot: Robot) -> None:
    (figure,) = motion_system(robot).figures
    for wheel, corners in zip(robot.wheels, rectangles(figure.plot.data[0]), strict=True):
        np.testing.assert_allclose(corners.mean(axis=0), wheel.position, atol=1e-4)
        np.testing.assert_allclose(corners[1] - corners[2], [2 * wheel.radius, 0], atol=1e-4)
    x, y = (f"{value:g}".replace("-", "−") for value in robot.wheels[0].position)
    first = robot.wheels[0]
    assert f"<b>{first.name}</b> r {first.radius:g} m<br>x {x} m<br>y {y} m" in labels(figure)
    arrows = [name for name in labels(figure) if name.startswith("V<sub>")]
    assert arrows == [f"V<sub>{name}</sub>" for name in robot.wheel_names]


def test_the_arrow_at_a_wheel_points_where_a_positive_rate_drives_it() -> None:
    (figure,) = motion_system(APR_02).figures
    (shafts,) = (trace for trace in figure.plot.data if trace.legendgroup == "rolling" and trace.mode == "lines")
    ends = np.array([[np.nan if v is None else v for v in values] for values in (shafts.y, shafts.x)]).T
    ends[:, 1] *= -1
    for row, first in zip(wheel_equations(APR_02.wheels), range(0, 9, 3), strict=True):
        way = ends[first + 1] - ends[first]
        np.testing.assert_allclose(way / np.hypot(*way), row[:2] / np.hypot(*row[:2]), atol=1e-3)


def test_the_best_entrys_geometry_is_drawn_over_the_design() -> None:
    view = usual_view()
    (figure,) = robot_picture(view).figures
    (fitted,) = (trace for trace in figure.plot.data if trace.legendgroup == "fitted")
    reading = read_matrix(view.dataset.robot, view.best.typical.matrix)
    radii, distances, angles = np.array([each.value for each in reading.parameters]).reshape(3, 3)
    places = (distances * np.array([np.cos(angles), np.sin(angles)])).T
    drawn = rectangles(fitted)
    np.testing.assert_allclose([corners.mean(axis=0) for corners in drawn], places, atol=1e-4)
    np.testing.assert_allclose([np.hypot(*(each[1] - each[2])) / 2 for each in drawn], radii, atol=1e-4)


def test_wheels_whose_position_is_not_known_are_not_drawn() -> None:
    mecanum = flower(robot=LEVER_MECANUM, truth={"tolerances": {"radius": 0.01}})
    (view,) = views(run(config(datasets={"f": {"simulate": mecanum}}, calibrators=["theoretical"], seeds=[1])))
    assert robot_picture(view) is None


# Our figures and methods beside those that were published: what is alike, and by how much others differ.


@pytest.fixture(scope="module")
def two_entries() -> ComparisonResult:
    return run(config(calibrators=["theoretical", "closed_form"], seeds=[1]))


def with_published(two_entries: ComparisonResult, *published: dict[str, Any], **changes: Any) -> DatasetView:
    """The comparison's data set, with published figures beside it."""
    given = [{"label": "theirs", "source": "an article", **figures} for figures in published]
    wanted = config(calibrators=["theoretical", "closed_form"], published_results=given, **changes)
    (view,) = views(replace(two_entries, config=wanted))
    return view


def scaled(two_entries: ComparisonResult, before: float, after: float) -> dict[str, float]:
    """Published costs that are multiples of ours: of the design values, and of the calibrated matrix."""
    record = two_entries.runs[0].record
    entry = statistics(two_entries, "closed_form")
    return {
        "theoretical_train_cost": before * record.theoretical_train_cost,
        "train_cost": after * entry.costs["train"].value,
        "theoretical_validation_cost": before * record.theoretical_validation_cost,
        "validation_cost": after * entry.costs["validation"].value,
    }


def figures(view: DatasetView, alike: bool) -> dict[str, ComparedFigure]:
    """The figures that are like published ones, or those that are not, by name."""
    return {figure.name: figure for figure in compared_figures(view) if figure.alike is alike}


def circumstances(view: DatasetView) -> dict[str, Fact]:
    """The circumstances of the recordings here, by name."""
    _, facts, *_ = published_blocks(view)
    return {fact.name: fact for fact in facts.items}


SCATTER = "Scatter of a command's repetitions, which no matrix removes"


def test_figures_equal_to_ours_are_alike(two_entries: ComparisonResult) -> None:
    assert list(published_blocks(with_published(two_entries))) == []
    remarked = {**scaled(two_entries, 1.0, 1.0), "remarks": ["A misprint."]}
    view = with_published(two_entries, remarked, remarked)
    assert not figures(view, alike=False)
    assert len(compared_figures(view)) == 8
    real = {name: replace(dataset, simulated=False) for name, dataset in view.result.datasets.items()}
    table, _, _, remarks = published_blocks(replace(view, result=with_data(view.result, real)))
    assert remarks.items == ("A misprint.",)
    assert [row.cells[-1].text for row in table.rows] == ["as published"] * 8
    assert table.rows[0].cells[3].text == "0.0 %"


def test_simulated_recordings_are_given_no_verdict_as_they_were_chosen(two_entries: ComparisonResult) -> None:
    table, *_ = published_blocks(with_published(two_entries, scaled(two_entries, 1.0, 1.0)))
    assert {row.cells[-1].text for row in table.rows} == {"simulated"}
    assert "agrees with them by construction" in table.note


def test_improvements_are_shown_as_printed_and_not_from_rounded_costs(two_entries: ComparisonResult) -> None:
    printed = {"theoretical_train_cost": 0.1234, "train_cost": 0.0215, "train_improvement": 0.8261}
    view = with_published(two_entries, printed)
    assert cost_table(view, "train").rows[-1].cells[2].text == "82.61 %"
    (improvement,) = (figure for figure in compared_figures(view) if figure.name.startswith("Improvement"))
    assert improvement.published == (0.8261,)
    del printed["train_improvement"]
    table = cost_table(with_published(two_entries, printed), "train")
    assert table.rows[-1].cells[2].text == "82.58 %"


def test_published_times_stand_beside_evaluations_of_the_same_methods() -> None:
    two_entries = usual()
    both = [
        {**scaled(two_entries, 1, 1), "label": "slow", "seconds": 903, "entry": "random_search"},
        {**scaled(two_entries, 1, 1), "label": "fast", "seconds": 637, "entry": "closed_form"},
    ]
    table, *_ = published_blocks(with_published(two_entries, *both))
    slow, fast = (row.cells for row in table.rows[-2:])
    evaluations = statistics(two_entries, "closed_form").evaluations_median
    assert [slow[0].text, slow[1].note, slow[2].text] == ["Time, median (random_search)", "1,001 evaluations", "903 s"]
    assert [fast[1].note, fast[2].text] == [f"{evaluations:.0f} evaluations", "637 s"]
    assert fast[-1].text == "other hardware, program"


def test_each_published_method_stands_beside_the_entry_that_it_names() -> None:
    two_entries = usual()
    both = [{**scaled(two_entries, 1, 1), "label": label, "entry": label} for label in ("random_search", "closed_form")]
    calibrated = [figure for figure in compared_figures(with_published(two_entries, *both)) if figure.methods]
    assert {figure.methods for figure in calibrated} == {("random_search",), ("closed_form",)}
    for figure in calibrated:
        (label,) = figure.methods
        assert figure.name.endswith(f"({label})")
        if figure.name.startswith("Calibrated cost, training"):
            assert figure.ours == statistics(two_entries, label).costs["train"]


def test_a_published_floor_twice_as_high_is_not_as_ours(two_entries: ComparisonResult) -> None:
    view = with_published(two_entries, scaled(two_entries, 1.0, 2.0))
    differ = figures(view, alike=False)
    assert list(differ) == [
        "Calibrated cost, training (closed_form)",
        "Improvement, training (closed_form)",
        "Calibrated cost, held-out (closed_form)",
        "Improvement, held-out (closed_form)",
    ]
    assert differ["Calibrated cost, training (closed_form)"].difference == "−50.0 %"
    improvement = differ["Improvement, training (closed_form)"].difference
    assert improvement.startswith("+")
    assert improvement.endswith(" points")
    assert {"Theoretical cost, training", "Theoretical cost, held-out"} <= set(figures(view, alike=True))
    differ = figures(with_published(two_entries, scaled(two_entries, 0.5, 1.0)), alike=False)
    assert differ["Theoretical cost, training"].difference == "+100.0 %"


def test_a_cost_that_rises_over_time_as_ours_does_not_is_told(two_entries: ComparisonResult) -> None:
    published = scaled(two_entries, 1.0, 1.0)
    published["validation_cost"] *= 3
    different = figures(with_published(two_entries, published), alike=False)
    assert "Change of the calibrated cost to validation (closed_form)" in different


def test_published_figures_without_validation_are_compared_on_training_only(two_entries: ComparisonResult) -> None:
    published = {name: value for name, value in scaled(two_entries, 1, 1).items() if "validation" not in name}
    compared = compared_figures(with_published(two_entries, published))
    assert len(compared) == 3
    assert not any("validation" in figure.name for figure in compared)


def test_costs_of_another_kind_are_not_set_beside_the_published_ones(two_entries: ComparisonResult) -> None:
    (block,) = published_blocks(with_published(two_entries, scaled(two_entries, 1, 1), cost="trajectory"))
    assert block.items == ("They are of the cost final_pose, Eq. (6); this comparison's is trajectory.",)


def test_the_scatter_of_repetitions_is_what_noise_alone_makes() -> None:
    noise = {"pose_position": 0.005, "pose_heading": 0.005}
    truth = {"published": "palacin2023_eq8"}
    many = flower(noise=noise, truth=truth, repetitions=40)
    two_entries = run(config(datasets={"f": {"simulate": many}}, calibrators=["closed_form"], seeds=[1]))
    fact = circumstances(with_published(two_entries, scaled(two_entries, 1, 1)))[SCATTER]
    # The mean norm of three normal errors of 5 mm or mrad each.
    assert float(fact.value) == pytest.approx(0.005 * math.sqrt(8 / math.pi), rel=0.05)
    assert float(fact.note.split(" %")[0]) > 75
    once = run(config(datasets={"f": {"simulate": flower(repetitions=1)}}, calibrators=["closed_form"], seeds=[1]))
    assert circumstances(with_published(once, scaled(once, 1, 1)))[SCATTER].value == "no command was repeated"


def test_the_way_driven_and_the_odometry_are_among_the_circumstances(two_entries: ComparisonResult) -> None:
    view = with_published(two_entries, scaled(two_entries, 1, 1))
    assert circumstances(view)["Distance of a run, mean"].value == "1.20 m"
    assert circumstances(view)["Odometry"].value == "exact arcs"
    by_steps = with_published(two_entries, scaled(two_entries, 1, 1), integration="euler")
    assert circumstances(by_steps)["Odometry"].value == "Euler steps"


def test_systematic_error_is_that_of_the_commands_means(two_entries: ComparisonResult) -> None:
    view = with_published(two_entries, scaled(two_entries, 1, 1))
    errors = view.design_errors["validation"]
    commands = [trajectory.command for trajectory in view.dataset.split("validation")]
    means = [np.linalg.norm(errors[[c == name for c in commands]].mean(axis=0)) for name in dict.fromkeys(commands)]
    fact = circumstances(view)["Miss of a command's mean end by the design values"]
    assert fact.value == f"{np.mean(means):.4f}"


LABELS = {"genetic": "Non-parametric IK", "parametric (GA)": "Parametric IK"}
COSTS = {"theoretical_train_cost": 0.1234, "train_cost": 0.0215}


@pytest.fixture(scope="module")
def methods() -> DatasetView:
    """A comparison of the two methods and three others, in the paper's box, of curves and straight runs."""
    commands = {"directions_deg": [30, 120, 210, 300], "turn_rates": [-0.35, 0.0, 0.35]}
    chosen = config(
        datasets={"flower": {"simulate": flower(commands=commands)}},
        box="paper",
        budget={"evaluations": 30_000},
        certificate={"seconds": 1e9, "parts": 20},
        calibrators=[
            "closed_form",
            "genetic",
            {"name": "parametric", "label": "parametric (GA)", "options": {"search": "genetic"}},
            "crs",
            {"name": "random_search", "options": {"candidates": 200}},
        ],
        published_results=[
            {"label": label, "source": "the paper", "entry": entry, **COSTS} for entry, label in LABELS.items()
        ],
    )
    (found,) = views(run(chosen))
    return found


def test_the_papers_methods_are_drawn_as_themselves_with_their_published_names(methods: DatasetView) -> None:
    (grid,) = paper_paths(methods)
    drawn = [item.label for item in grid.legend]
    assert drawn[2:] == [f"{entry}, as the paper's {label}" for entry, label in LABELS.items()]
    assert len(grid.figures) == 4


def test_eq_11_is_printed_for_the_parametric_matrix_over_the_genetic_one(methods: DatasetView) -> None:
    (table,) = (
        block for block in matrix_blocks(methods) if isinstance(block, Table) and block.caption.endswith("from genetic")
    )
    _, row = table.rows
    matrices = {entry.label: run.matrix for entry, run in methods.calibrated}
    shares = 100 * relative_deviations(matrices["parametric (GA)"], matrices["genetic"]).ravel()
    assert row.cells[0].text == "parametric (GA)"
    shown = [cell.note.replace("−", "-") for cell in row.cells[1:]]
    assert [text for text in shown if "%" in text] == [f"{share:+.3f} %" for share in shares if np.isfinite(share)]
    assert np.flatnonzero(~np.isfinite(shares)).tolist() == [1]  # m12 is 0 in the paper's box
    assert "%" not in shown[1]


def test_fig_4_has_the_settings_of_the_genetic_entry(methods: DatasetView) -> None:
    *_, grid = published_blocks(methods)
    (figure,) = grid.figures
    boxes = " ".join(note.text for note in figure.plot.layout.annotations)
    for word in ("Population of 200", "±10 % of V", "Crossover</b> of 80 %", "adaptive feasible", "≤ 1e-06", "Eq. (6)"):
        assert word in boxes


def test_the_papers_claims_on_curves_and_on_local_minima_are_checked_in_a_line_each(methods: DatasetView) -> None:
    blocks = published_blocks(methods)
    (callout,) = (block for block in blocks if isinstance(block, Callout) and "claims" in block.title)
    curves, minima = callout.items
    runs, errors = methods.dataset.split("validation"), np.linalg.norm(methods.design_errors["validation"], axis=1)
    turning = np.array([trajectory.omega != 0 for trajectory in runs])
    assert f"{errors[turning].mean():.3f} on the held-out runs in curves" in curves
    assert f"{errors[~turning].mean():.3f} on straight ones" in curves
    assert "2 of 2 runs of crs and 0 of 2 runs of random_search ended within 0.01 %" in minima
    assert "by proof no matrix of the box is more than" in minima
    assert "genetic" not in minima
