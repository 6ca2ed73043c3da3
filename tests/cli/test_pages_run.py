"""Every command of the README and of the handbook, run in order, as written, and what is known of their results."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import rows, summary
from newcomer import ELSEWHERE, PAGES, lines_of, ten_minutes, typed
from page_figures import EVALUATIONS, PASSAGES, assert_printed, omni3_figures, paper_figures

from omnibench.data.dataset import Dataset

ELSEWHERE_TYPED = ("simulate", "slam")  # in test_simulation_pages_run.py


@pytest.fixture(scope="module")
def ended() -> dict[str, Path]:
    """The folders in which pages ended, by the pages' names."""
    return {}


def test_the_readme_runs_from_its_first_command_to_its_last() -> None:
    assert (ten_minutes() / "calibration.yaml").is_file()


@pytest.mark.parametrize("name", [name for name in PAGES if name not in ELSEWHERE_TYPED])
def test_a_page_of_the_handbook_runs_after_the_readme(name: str, ended: dict[str, Path], tmp_path: Path) -> None:
    ended[name] = typed(PAGES[name], shutil.copytree(ten_minutes(), tmp_path / "after"))


@pytest.mark.parametrize("name", ELSEWHERE)
def test_what_a_page_leaves_to_another_stands_there_word_for_word(name: str) -> None:
    for line, page in ELSEWHERE[name].items():
        assert line in lines_of(PAGES[name])
        assert line in lines_of(PAGES[page])


@pytest.fixture(scope="module")
def paper() -> dict[str, dict[str, Any]]:
    """The entries of the README's comparison on the paper's flower."""
    return rows(ten_minutes() / "results" / "apr02" / "latest")


def test_the_theoretical_matrix_costs_what_the_paper_says(paper: dict[str, dict[str, Any]]) -> None:
    assert paper["theoretical"]["train_cost"] == pytest.approx(0.1234, rel=0.02)
    assert paper["theoretical"]["validation_cost"] == pytest.approx(0.1251, rel=0.03)


@pytest.mark.parametrize("label", ["closed_form", "crs"])
def test_a_calibration_improves_as_much_as_in_the_paper(label: str, paper: dict[str, dict[str, Any]]) -> None:
    assert paper[label]["train_improvement"] >= 0.82
    assert paper[label]["validation_improvement"] >= 0.81


def test_nothing_is_below_the_exact_optimum_in_the_same_box(paper: dict[str, dict[str, Any]]) -> None:
    assert paper["crs"]["box"] == paper["closed_form"]["box"] == "paper"
    assert paper["crs"]["train_cost"] >= paper["closed_form"]["train_cost"] - 1e-9
    assert -1e-9 <= paper["crs"]["gap"] < 1e-5


def test_the_exact_optimum_takes_a_handful_of_evaluations(paper: dict[str, dict[str, Any]]) -> None:
    assert paper["closed_form"]["evaluations"] <= 10  # times are measured in tests/studies
    assert paper["closed_form"]["outcome"] == "converged"


def test_the_page_on_the_paper_prints_what_the_comparison_says() -> None:
    figures = paper_figures(ten_minutes() / "results" / "apr02" / "latest")
    assert_printed("paper", figures, EVALUATIONS)  # whose numbers differ between processors


@pytest.mark.parametrize(("search", "label"), [("matrix", "genetic"), ("geometry", "parametric (GA)"), ("crs", "crs")])
def test_the_evaluations_that_the_page_prints_are_those_of_this_processor_too(
    search: str, label: str, paper: dict[str, dict[str, Any]]
) -> None:
    printed = {name: text for passage in PASSAGES["paper"] for name, text in passage.printed().items()}
    least, most = (int(printed[f"{search}_{end}"].replace(",", "")) for end in ("least", "most"))
    assert 0.8 * least <= paper[label]["evaluations"] <= 1.2 * most


def test_the_readme_prints_the_real_robots_improvement_with_both_intervals(
    ended: dict[str, Path], omni3: Dataset
) -> None:
    if "compare" not in ended:
        pytest.skip("the page on comparisons ended before the real robot's")
    assert_printed("omni3", omni3_figures(ended["compare"] / "results" / "omni3" / "latest", omni3))


def test_a_real_robot_is_calibrated_as_well_as_was_measured(ended: dict[str, Path]) -> None:
    if "compare" not in ended:
        pytest.skip("the page on comparisons ended before the real robot's")
    results = ended["compare"] / "results" / "omni3" / "latest"
    assert summary(results)["simulated"] == {"omni3": False}
    found = rows(results)
    assert found["closed_form"]["train_position_m"] <= 0.045
    assert np.degrees(found["closed_form"]["train_heading_rad"]) <= 3.8
    assert found["closed_form"]["validation_position_m"] <= 0.11
    assert np.degrees(found["closed_form"]["validation_heading_rad"]) <= 5.5
    for name in ("train_position_m", "train_heading_rad", "validation_position_m", "validation_heading_rad"):
        assert found["theoretical"][name] > found["closed_form"][name]
    # Other commands, other shapes: there the poses along the way, their clocks set right, are worth as much or more.
    assert found["trajectory_ml"]["validation_cost"] <= found["closed_form"]["validation_cost"]
