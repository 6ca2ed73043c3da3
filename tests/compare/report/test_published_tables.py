"""Our figures beside those that were published: what the report says is alike, what is not, and why."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from report_samples import config, flower, run, statistics

from omnibench.compare.report.published_tables import findings, published_blocks
from omnibench.compare.report.view import DatasetView, views
from omnibench.compare.result import ComparisonResult
from omnibench.report.blocks import Callout


@pytest.fixture(scope="module")
def result() -> ComparisonResult:
    return run(config(calibrators=["theoretical", "closed_form"], seeds=[1]))


def with_published(result: ComparisonResult, *published: dict[str, Any], **changes: Any) -> DatasetView:
    """The comparison's data set, with published figures beside it."""
    given = [{"label": "theirs", "source": "an article", **figures} for figures in published]
    wanted = config(calibrators=["theoretical", "closed_form"], published_results=given, **changes)
    (view,) = views(ComparisonResult(**{**vars(result), "config": wanted}))
    return view


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


def words(view: DatasetView, alike: bool) -> str:
    """The findings of one kind."""
    return "\n".join(found.words for found in findings(view) if found.alike is alike)


def reasons(view: DatasetView) -> str:
    """What is said of why."""
    return "\n".join(next(block.items for block in published_blocks(view) if "Why" in block.title))


def test_figures_equal_to_ours_are_alike(result: ComparisonResult) -> None:
    view = with_published(result, scaled(result, 1.0, 1.0))
    assert words(view, alike=False) == ""
    assert len(findings(view)) == 8
    assert words(view, alike=True).count("inside the interval") == 6


def test_a_published_floor_twice_as_high_is_not_as_ours(result: ComparisonResult) -> None:
    view = with_published(result, scaled(result, 1.0, 2.0))
    told = words(view, alike=False).splitlines()
    assert [line.split(":")[0] for line in told] == [
        "Calibrated cost, training (closed_form)",
        "Improvement, training (closed_form)",
        "Calibrated cost, validation (closed_form)",
        "Improvement, validation (closed_form)",
    ]
    assert told[0].endswith("ours is 50.0 % below.")
    assert "percentage points more" in told[1]
    assert words(view, alike=True).count("Theoretical cost") == 2


def test_a_published_theoretical_cost_half_of_ours_is_not_as_ours(result: ComparisonResult) -> None:
    told = words(with_published(result, scaled(result, 0.5, 1.0)), alike=False)
    assert "Theoretical cost, training" in told
    assert "ours is 100.0 % above." in told


def test_a_cost_that_rises_over_time_as_ours_does_not_is_told(result: ComparisonResult) -> None:
    figures = scaled(result, 1.0, 1.0)
    figures["validation_cost"] *= 3
    told = words(with_published(result, figures), alike=False)
    assert "From training to validation the calibrated cost changes" in told
    assert "more apart than chance explains" in told


def test_the_nearest_of_several_published_figures_counts(result: ComparisonResult) -> None:
    view = with_published(result, scaled(result, 1.0, 2.0), scaled(result, 1.0, 1.0))
    assert words(view, alike=False) == ""


def test_published_figures_without_validation_are_compared_on_training_only(result: ComparisonResult) -> None:
    figures = {name: value for name, value in scaled(result, 1, 1).items() if "validation" not in name}
    told = findings(with_published(result, figures))
    assert len(told) == 3
    assert not any("validation" in found.words for found in told)


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
    told = reasons(with_published(result, scaled(result, 1, 1)))
    scatter = float(told.split("repetitions of one command end ")[1].split(" from")[0])
    # The mean norm of three normal errors of 5 mm or mrad each.
    assert scatter == pytest.approx(0.005 * math.sqrt(8 / math.pi), rel=0.05)
    assert "mostly scatter" in told


def test_data_without_repetitions_say_that_their_noise_cannot_be_told() -> None:
    once = {"f": {"simulate": flower(repetitions=1)}}
    result = run(config(datasets=once, calibrators=["closed_form"], seeds=[1]))
    assert "cannot be told from the data" in reasons(with_published(result, scaled(result, 1, 1)))


def test_the_way_driven_and_the_odometry_are_among_the_reasons(result: ComparisonResult) -> None:
    told = reasons(with_published(result, scaled(result, 1, 1)))
    assert "1.20 m a run here" in told
    assert "exact arcs here" in told
    euler = reasons(with_published(result, scaled(result, 1, 1), integration="euler"))
    assert "exact arcs" not in euler


def test_systematic_error_is_that_of_the_commands_means(result: ComparisonResult) -> None:
    view = with_published(result, scaled(result, 1, 1))
    errors = view.design_errors["validation"]
    commands = [trajectory.command for trajectory in view.dataset.split("validation")]
    means = [np.linalg.norm(errors[[c == name for c in commands]].mean(axis=0)) for name in dict.fromkeys(commands)]
    assert f"runs by {np.mean(means):.4f} on average" in reasons(view)
