"""Our figures and methods beside those that were published: what is alike, and by how much others differ."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from report_samples import config, flower, run, statistics, usual

from omnibench.compare.report.cost_tables import ComparedFigure, compared_figures, cost_table, published_blocks
from omnibench.compare.report.error_figures import chosen_trajectories, drawn_models
from omnibench.compare.report.outcome_tables import matrix_section
from omnibench.compare.report.search_figures import search_diagram
from omnibench.compare.report.view import DatasetView, views
from omnibench.compare.result import ComparisonResult
from omnibench.report.blocks import Callout, Row, Table
from omnibench.robot.kinematics import relative_deviations


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
    assert published_blocks(with_published(result)) == ()
    remarked = {**scaled(result, 1.0, 1.0), "remarks": ["A misprint."]}
    view = with_published(result, remarked, remarked)
    assert not figures(view, alike=False)
    assert len(compared_figures(view)) == 8
    table, _, remarks = published_blocks(recorded(view))
    assert isinstance(table, Table)
    assert isinstance(remarks, Callout)
    assert remarks.items == ("A misprint.",)
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
    differ = figures(with_published(result, scaled(result, 0.5, 1.0)), alike=False)
    assert differ["Theoretical cost, training"].difference == "+100.0 %"


def test_a_cost_that_rises_over_time_as_ours_does_not_is_told(result: ComparisonResult) -> None:
    published = scaled(result, 1.0, 1.0)
    published["validation_cost"] *= 3
    different = figures(with_published(result, published), alike=False)
    assert "Change of the calibrated cost to validation (closed_form)" in different


def test_published_figures_without_validation_are_compared_on_training_only(result: ComparisonResult) -> None:
    published = {name: value for name, value in scaled(result, 1, 1).items() if "validation" not in name}
    compared = compared_figures(with_published(result, published))
    assert len(compared) == 3
    assert not any("validation" in figure.name for figure in compared)


def test_costs_of_another_kind_are_not_set_beside_the_published_ones(result: ComparisonResult) -> None:
    (block,) = published_blocks(with_published(result, scaled(result, 1, 1), cost="trajectory"))
    assert isinstance(block, Callout)
    assert block.items == ("They are of the cost final_pose, Eq. (6); this comparison's is trajectory.",)


def test_the_scatter_of_repetitions_is_what_noise_alone_makes() -> None:
    noise = {"pose_position": 0.005, "pose_heading": 0.005}
    truth = {"published": "palacin2023_eq8"}
    many = flower(noise=noise, truth=truth, repetitions=40)
    result = run(config(datasets={"f": {"simulate": many}}, calibrators=["closed_form"], seeds=[1]))
    cell = circumstances(with_published(result, scaled(result, 1, 1)))[SCATTER].cells[1]
    # The mean norm of three normal errors of 5 mm or mrad each.
    assert float(cell.text) == pytest.approx(0.005 * math.sqrt(8 / math.pi), rel=0.05)
    assert float(cell.note.split(" %")[0]) > 75
    once = run(config(datasets={"f": {"simulate": flower(repetitions=1)}}, calibrators=["closed_form"], seeds=[1]))
    assert here(with_published(once, scaled(once, 1, 1)), SCATTER) == "no command was repeated"


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
    models = drawn_models(methods, chosen_trajectories(methods.dataset.split("validation")))
    by_itself = {model.entries: model.style.label for model in models if len(model.entries) == 1}
    for entry, label in LABELS.items():
        assert by_itself[(entry,)] == f"{entry}, as the paper's {label}"


def test_eq_11_is_printed_for_the_parametric_matrix_over_the_genetic_one(methods: DatasetView) -> None:
    (table,) = (
        block for block in matrix_section(methods).blocks if isinstance(block, Table) and "Eq. (11)" in block.caption
    )
    (row,) = table.rows
    matrices = {entry.label: np.array(run.matrix) for entry, run in methods.calibrated}
    shares = 100 * relative_deviations(matrices["parametric (GA)"], matrices["genetic"]).ravel()
    assert row.cells[0].text == "parametric (GA)"
    shown = [cell.text.replace("−", "-") for cell in row.cells[1:]]
    assert [text for text in shown if "%" in text] == [f"{share:+.3f} %" for share in shares if np.isfinite(share)]
    assert np.flatnonzero(~np.isfinite(shares)).tolist() == [1]  # m12 is 0 in the paper's box
    assert "%" not in shown[1]


def test_fig_4_has_the_settings_of_the_genetic_entry(methods: DatasetView) -> None:
    (figure,) = search_diagram(methods).figures
    boxes = " ".join(note.text for note in figure.plot.layout.annotations)
    for words in (
        "Population of 200",
        "±10 % of V",
        "Crossover</b> of 80 %",
        "adaptive feasible",
        "≤ 1e-06",
        "Eq. (6)",
    ):
        assert words in boxes


def test_a_search_without_the_papers_is_drawn_in_general_words(methods: DatasetView) -> None:
    other = DatasetView(**{**vars(methods), "config": methods.config.model_copy(update={"published_results": ()})})
    (figure,) = search_diagram(other).figures
    assert "by the search's own rule" in " ".join(note.text for note in figure.plot.layout.annotations)


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
