"""The robot as the report draws it, after Fig. 2 and 3 of the paper, and its tracks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import plotly.graph_objects as go
import pytest
from report_samples import config, flower, run, usual
from wheeled_samples import CAR, ROBOTS, TRICYCLE

from omnibench.compare.report.comparison_report import data_section, robot_section
from omnibench.compare.report.search_figures import search_section
from omnibench.compare.report.view import DatasetView, views
from omnibench.data.importers.table1 import APR_02
from omnibench.fit.identifiability import geometry_of
from omnibench.report.blocks import Facts, Figure, FigureGrid
from omnibench.report.figures import motion_system, parameters
from omnibench.robot.kinematics import Array, Robot, wheel_equations


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
    sides = (("a", 1, 0.8), ("b", -1, -0.8), ("c", 1, -0.8), ("d", -1, 0.8))
    wheels = [
        {"name": name, "radius": 0.05, "distance": 0.35, "angle": math.radians(90 * side), "roller_angle": roller}
        for name, side, roller in sides
    ]
    mecanum = flower(robot={"name": "mecanum", "wheels": wheels}, truth={"tolerances": {"radius": 0.01}})
    (view,) = views(run(config(datasets={"f": {"simulate": mecanum}}, calibrators=["theoretical"], seeds=[1])))
    assert robot_section(view) == ()


def test_the_diagram_of_the_search_names_the_cost_the_budget_and_the_runs() -> None:
    *_, diagram = search_section(usual_view()).blocks
    assert isinstance(diagram, FigureGrid)
    told = " ".join(labels(diagram.figures[0]))
    assert all(
        words in told for words in ("final_pose", "Eq. (6)", "2,000 evaluations", "16 training runs", "exact arcs")
    )
