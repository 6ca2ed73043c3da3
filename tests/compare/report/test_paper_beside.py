"""The paper's two methods in the report: Fig. 4, 6 and 7, Eq. (11), and one line for each of its claims."""

from __future__ import annotations

import numpy as np
import pytest
from report_samples import config, flower, run

from omnibench.compare.report.cost_tables import published_blocks
from omnibench.compare.report.error_figures import chosen_trajectories, drawn_models
from omnibench.compare.report.outcome_tables import matrix_section
from omnibench.compare.report.search_figures import search_diagram
from omnibench.compare.report.view import DatasetView, views
from omnibench.report.blocks import Callout, Table
from omnibench.robot.kinematics import relative_deviations

LABELS = {"genetic": "Non-parametric IK", "parametric (GA)": "Parametric IK"}
COSTS = {"theoretical_train_cost": 0.1234, "train_cost": 0.0215}


@pytest.fixture(scope="module")
def view() -> DatasetView:
    """A comparison of the two methods and three others, in the paper's box, of curves and straight runs."""
    commands = {"directions_deg": [30, 120, 210, 300], "turn_rates": [-0.35, 0.0, 0.35]}
    chosen = config(
        datasets={"flower": {"simulate": flower(commands=commands)}},
        box="paper",
        budget={"evaluations": 30_000},
        certificate={"seconds": 5},
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


def claims(view: DatasetView) -> tuple[str, str]:
    """The lines on curves and on local minima."""
    (callout,) = (block for block in published_blocks(view) if isinstance(block, Callout) and "claims" in block.title)
    curves, minima = callout.items
    return curves, minima


def test_the_papers_methods_are_drawn_as_themselves_with_their_published_names(view: DatasetView) -> None:
    models = drawn_models(view, chosen_trajectories(view.dataset.split("validation")))
    by_itself = {model.entries: model.style.label for model in models if len(model.entries) == 1}
    for entry, label in LABELS.items():
        assert by_itself[(entry,)] == f"{entry}, as the paper's {label}"


def test_eq_11_is_printed_for_the_parametric_matrix_over_the_genetic_one(view: DatasetView) -> None:
    (table,) = (
        block for block in matrix_section(view).blocks if isinstance(block, Table) and "Eq. (11)" in block.caption
    )
    (row,) = table.rows
    matrices = {entry.label: np.array(run.matrix) for entry, run in view.calibrated}
    shares = 100 * relative_deviations(matrices["parametric (GA)"], matrices["genetic"]).ravel()
    assert row.cells[0].text == "parametric (GA)"
    shown = [cell.text.replace("−", "-") for cell in row.cells[1:]]
    assert [text for text in shown if "%" in text] == [f"{share:+.3f} %" for share in shares if np.isfinite(share)]
    assert np.flatnonzero(~np.isfinite(shares)).tolist() == [1]  # m12 is 0 in the paper's box
    assert "%" not in shown[1]


def test_fig_4_has_the_settings_of_the_genetic_entry(view: DatasetView) -> None:
    (figure,) = search_diagram(view).figures
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


def test_a_search_without_the_papers_is_drawn_in_general_words(view: DatasetView) -> None:
    other = DatasetView(**{**vars(view), "config": view.config.model_copy(update={"published_results": ()})})
    (figure,) = search_diagram(other).figures
    assert "by the search's own rule" in " ".join(note.text for note in figure.plot.layout.annotations)


def test_a_line_says_eq_6_of_the_design_values_in_curves_and_on_straight_runs(view: DatasetView) -> None:
    runs, errors = view.dataset.split("validation"), np.linalg.norm(view.design_errors["validation"], axis=1)
    turning = np.array([trajectory.omega != 0 for trajectory in runs])
    curves, _ = claims(view)
    assert f"{errors[turning].mean():.3f} on the held-out runs in curves" in curves
    assert f"{errors[~turning].mean():.3f} on straight ones" in curves
    assert "so here" in curves


def test_a_line_says_how_many_searches_from_random_starts_meet_in_one_minimum(view: DatasetView) -> None:
    _, minima = claims(view)
    assert "2 of 2 runs of crs and 0 of 2 runs of random_search ended within 0.01 %" in minima
    assert "by proof no matrix of the box is more than" in minima
    assert "genetic" not in minima
