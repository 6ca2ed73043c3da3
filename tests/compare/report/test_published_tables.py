"""Our figures beside those that were published: which are alike, by how much others differ, in which circumstances."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from report_samples import config, flower, run, statistics, usual

from omnibench.compare.report.cost_tables import ComparedFigure, compared_figures, cost_table, published_blocks
from omnibench.compare.report.view import DatasetView, views
from omnibench.compare.result import ComparisonResult
from omnibench.report.blocks import Callout, Row, Table


@pytest.fixture(scope="module")
def result() -> ComparisonResult:
    return run(config(calibrators=["theoretical", "closed_form"], seeds=[1]))


def with_published(result: ComparisonResult, *published: dict[str, Any], **changes: Any) -> DatasetView:
    """The comparison's data set, with published figures beside it."""
    given = [{"label": "theirs", "source": "an article", **figures} for figures in published]
    wanted = config(calibrators=["theoretical", "closed_form"], published_results=given, **changes)
    (view,) = views(ComparisonResult(**{**vars(result), "config": wanted}))
    return view


def recorded(view: DatasetView) -> DatasetView:
    """The view with its data set called a recording."""
    return replace(view, dataset=replace(view.dataset, simulated=False))


def scaled(result: ComparisonResult, before: float, after: float) -> dict[str, float]:
    """Published costs that are multiples of ours: of the design values, and of the calibrated matrix."""
    record = result.runs[0].record
    entry = statistics(result, "closed_form")
    return {
        "theoretical_train_cost": before * record.theoretical_train_cost,
        "train_cost": after * entry.cost("train").value,
        "theoretical_validation_cost": before * record.theoretical_validation_cost,
        "validation_cost": after * entry.cost("validation").value,
    }


def figures(view: DatasetView, alike: bool) -> dict[str, ComparedFigure]:
    """The figures that are like published ones, or those that are not, by name."""
    return {figure.name: figure for figure in compared_figures(view) if figure.alike is alike}


def circumstances(view: DatasetView) -> dict[str, Row]:
    """The rows on circumstances, by the circumstance."""
    _, table = published_blocks(view)
    assert isinstance(table, Table)
    return {row.cells[0].text: row for row in table.rows}


def here(view: DatasetView, circumstance: str) -> str:
    """Our side of a circumstance."""
    return circumstances(view)[circumstance].cells[1].text


SCATTER = "Scatter of a command's repetitions"


def test_figures_equal_to_ours_are_alike(result: ComparisonResult) -> None:
    view = with_published(result, scaled(result, 1.0, 1.0))
    assert not figures(view, alike=False)
    assert len(compared_figures(view)) == 8
    table, _ = published_blocks(recorded(view))
    assert isinstance(table, Table)
    assert [row.cells[-1].text for row in table.rows] == ["as published"] * 8
    assert table.rows[0].cells[3].text == "0.0 %"


def test_simulated_recordings_are_given_no_verdict_as_they_were_chosen(result: ComparisonResult) -> None:
    table, _ = published_blocks(with_published(result, scaled(result, 1.0, 1.0)))
    assert isinstance(table, Table)
    assert [column.title for column in table.columns] == ["Figure", "Here", "Published", "From the nearest"]
    assert {len(row.cells) for row in table.rows} == {4}
    assert "agrees with them by construction" in table.note


def test_improvements_are_shown_as_printed_and_not_from_rounded_costs(result: ComparisonResult) -> None:
    printed = {"theoretical_train_cost": 0.1234, "train_cost": 0.0215, "train_improvement": 0.8261}
    view = with_published(result, printed)
    assert cost_table(view, "train").rows[-1].cells[-1].text == "82.61 %"
    (improvement,) = (figure for figure in compared_figures(view) if figure.name.startswith("Improvement"))
    assert improvement.published == (0.8261,)
    del printed["train_improvement"]
    assert cost_table(with_published(result, printed), "train").rows[-1].cells[-1].text == "82.58 %"


def test_published_times_stand_beside_evaluations_of_the_same_methods() -> None:
    result = usual()
    both = [
        {**scaled(result, 1, 1), "label": "slow", "seconds": 903, "entry": "random_search"},
        {**scaled(result, 1, 1), "label": "fast", "seconds": 637, "entry": "closed_form"},
    ]
    _, _, table = published_blocks(with_published(result, *both))
    assert isinstance(table, Table)
    slow, fast, change = ([cell.text for cell in row.cells] for row in table.rows)
    evaluations = statistics(result, "closed_form").evaluations_median
    assert slow[:3] == ["slow", "903 s", "1,001"]
    assert fast[:3] == ["fast", "637 s", f"{evaluations:.0f}"]
    assert change[:2] == ["fast against slow", "−29 %"]
    assert change[2] == f"−{100 * (1 - evaluations / 1001):.1f} %"
    assert "Hardware and program differ" in table.note


def test_each_published_method_stands_beside_the_entry_that_it_names() -> None:
    result = usual()
    both = [{**scaled(result, 1, 1), "label": label, "entry": label} for label in ("random_search", "closed_form")]
    calibrated = [figure for figure in compared_figures(with_published(result, *both)) if figure.methods]
    assert {figure.methods for figure in calibrated} == {("random_search",), ("closed_form",)}
    for figure in calibrated:
        (label,) = figure.methods
        assert figure.name.endswith(f"({label})")
        if figure.name.startswith("Calibrated cost, training"):
            assert figure.ours == statistics(result, label).cost("train")


def test_remarks_on_published_figures_are_shown_once(result: ComparisonResult) -> None:
    remarked = {**scaled(result, 1, 1), "remarks": ["A misprint."]}
    *_, remarks = published_blocks(with_published(result, remarked, remarked))
    assert isinstance(remarks, Callout)
    assert remarks.items == ("A misprint.",)


def test_a_published_floor_twice_as_high_is_not_as_ours(result: ComparisonResult) -> None:
    view = with_published(result, scaled(result, 1.0, 2.0))
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


def test_a_published_theoretical_cost_half_of_ours_is_not_as_ours(result: ComparisonResult) -> None:
    differ = figures(with_published(result, scaled(result, 0.5, 1.0)), alike=False)
    assert differ["Theoretical cost, training"].difference == "+100.0 %"


def test_a_cost_that_rises_over_time_as_ours_does_not_is_told(result: ComparisonResult) -> None:
    published = scaled(result, 1.0, 1.0)
    published["validation_cost"] *= 3
    different = figures(with_published(result, published), alike=False)
    assert "Change of the calibrated cost to validation (closed_form)" in different


def test_the_nearest_of_several_published_figures_counts(result: ComparisonResult) -> None:
    view = with_published(result, scaled(result, 1.0, 2.0), scaled(result, 1.0, 1.0))
    assert not figures(view, alike=False)


def test_published_figures_without_validation_are_compared_on_training_only(result: ComparisonResult) -> None:
    published = {name: value for name, value in scaled(result, 1, 1).items() if "validation" not in name}
    compared = compared_figures(with_published(result, published))
    assert len(compared) == 3
    assert not any("validation" in figure.name for figure in compared)


def test_costs_of_another_kind_are_not_set_beside_the_published_ones(result: ComparisonResult) -> None:
    (block,) = published_blocks(with_published(result, scaled(result, 1, 1), cost="trajectory"))
    assert isinstance(block, Callout)
    assert block.items == ("They are of the cost final_pose, Eq. (6); this comparison's is trajectory.",)


def test_without_published_figures_nothing_is_said(result: ComparisonResult) -> None:
    assert published_blocks(with_published(result)) == ()


def test_the_scatter_of_repetitions_is_what_noise_alone_makes() -> None:
    noise = {"pose_position": 0.005, "pose_heading": 0.005}
    truth = {"published": "palacin2023_eq8"}
    many = flower(noise=noise, truth=truth, repetitions=40)
    result = run(config(datasets={"f": {"simulate": many}}, calibrators=["closed_form"], seeds=[1]))
    cell = circumstances(with_published(result, scaled(result, 1, 1)))[SCATTER].cells[1]
    # The mean norm of three normal errors of 5 mm or mrad each.
    assert float(cell.text) == pytest.approx(0.005 * math.sqrt(8 / math.pi), rel=0.05)
    assert float(cell.note.split(" %")[0]) > 75


def test_data_without_repetitions_say_that_their_noise_cannot_be_told() -> None:
    once = {"f": {"simulate": flower(repetitions=1)}}
    result = run(config(datasets=once, calibrators=["closed_form"], seeds=[1]))
    assert here(with_published(result, scaled(result, 1, 1)), SCATTER) == "no command was repeated"


def test_the_way_driven_and_the_odometry_are_among_the_circumstances(result: ComparisonResult) -> None:
    view = with_published(result, scaled(result, 1, 1))
    assert here(view, "Distance of a run, mean") == "1.20 m"
    assert here(view, "Odometry") == "exact arcs"
    assert here(with_published(result, scaled(result, 1, 1), integration="euler"), "Odometry") == "Euler steps"


def test_systematic_error_is_that_of_the_commands_means(result: ComparisonResult) -> None:
    view = with_published(result, scaled(result, 1, 1))
    errors = view.design_errors["validation"]
    commands = [trajectory.command for trajectory in view.dataset.split("validation")]
    means = [np.linalg.norm(errors[[c == name for c in commands]].mean(axis=0)) for name in dict.fromkeys(commands)]
    assert here(view, "Miss of a command's mean end by the design values") == f"{np.mean(means):.4f}"
