"""Every command of the README and of the handbook, typed in processes, as written, and what is known of their results.

The 360 runs of the simulated experiment would go through SLAM again and again: an edit of its config leaves 12.
"""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import rows, summary
from newcomer import PAGES, ten_minutes, typed
from page_figures import EVALUATIONS, PASSAGES, assert_printed, omni3_figures, paper_figures

from omnibench.data.dataset import Dataset

pytestmark = pytest.mark.slow

SIMULATION = ("simulate", "slam")  # the second page goes on with the data of the first
FEWER = {
    "directions_deg: [0, 30, 60, 90, 120, 150, 180, 210, 240, 270, 300, 330]": "directions_deg: [0, 120]",
    "repetitions: 5": "repetitions: 1",
    "seeds: [1, 2, 3, 4, 5]": "seeds: [1]",
}


@pytest.fixture(scope="module")
def ended() -> dict[str, Path]:
    """The folders in which pages ended, by the pages' names."""
    return {}


@pytest.fixture(scope="module")
def paper() -> dict[str, dict[str, Any]]:
    """The entries of the README's comparison on the paper's flower."""
    return rows(ten_minutes() / "results" / "apr02" / "latest")


def test_the_readme_runs_from_its_first_command_to_its_last() -> None:
    assert (ten_minutes() / "calibration.yaml").is_file()


@pytest.mark.parametrize("name", [name for name in PAGES if name not in SIMULATION])
def test_a_page_of_the_handbook_runs_after_the_readme(name: str, ended: dict[str, Path], tmp_path: Path) -> None:
    ended[name] = typed(PAGES[name], shutil.copytree(ten_minutes(), tmp_path / "after"))


def fewer_runs(command: str, folder: Path) -> None:
    """Edit the config before it is simulated."""
    config = folder / "configs" / "apr02_robot.yaml"
    if command.startswith("omnibench simulate configs/apr02_robot.yaml"):
        text = config.read_text(encoding="utf-8")
        for present, fewer in FEWER.items():
            assert text.count(present) == 1
            text = text.replace(present, fewer)
        config.write_text(text, encoding="utf-8")


def test_the_pages_on_simulations_and_slam_run_after_the_readme(tmp_path: Path) -> None:
    folder = shutil.copytree(ten_minutes(), tmp_path / "after")
    for name in SIMULATION:
        assert typed(PAGES[name], folder, fewer_runs) == folder


def test_the_papers_calibrations_improve_as_much_as_in_the_paper(paper: dict[str, dict[str, Any]]) -> None:
    assert paper["theoretical"]["train_cost"] == pytest.approx(0.1234, rel=0.02)
    assert paper["theoretical"]["validation_cost"] == pytest.approx(0.1251, rel=0.03)
    for label in ("closed_form", "crs"):
        assert paper[label]["train_improvement"] >= 0.82
        assert paper[label]["validation_improvement"] >= 0.81


def test_nothing_is_below_the_exact_optimum_which_takes_few_evaluations(paper: dict[str, dict[str, Any]]) -> None:
    assert paper["crs"]["box"] == paper["closed_form"]["box"] == "paper"
    assert paper["crs"]["train_cost"] >= paper["closed_form"]["train_cost"] - 1e-9
    assert -1e-9 <= paper["crs"]["gap"] < 1e-5
    assert paper["closed_form"]["evaluations"] <= 10  # times are measured in tests/studies
    assert paper["closed_form"]["outcome"] == "converged"


def test_the_page_on_the_paper_prints_what_the_comparison_says(paper: dict[str, dict[str, Any]]) -> None:
    figures = paper_figures(ten_minutes() / "results" / "apr02" / "latest")
    assert_printed("paper", figures, EVALUATIONS)  # whose numbers differ between processors
    printed = {name: text for passage in PASSAGES["paper"] for name, text in passage.printed().items()}
    for search, label in (("matrix", "genetic"), ("geometry", "parametric (GA)"), ("crs", "crs")):
        least, most = (int(printed[f"{search}_{end}"].replace(",", "")) for end in ("least", "most"))
        assert 0.8 * least <= paper[label]["evaluations"] <= 1.2 * most, label


def test_a_real_robot_is_calibrated_as_well_as_the_readme_prints(ended: dict[str, Path], omni3: Dataset) -> None:
    if "compare" not in ended:
        pytest.skip("the page on comparisons ended before the real robot's")
    results = ended["compare"] / "results" / "omni3" / "latest"
    assert_printed("omni3", omni3_figures(results, omni3))
    assert summary(results)["simulated"] == {"omni3": False}
    found = rows(results)
    assert found["closed_form"]["train_position_m"] <= 0.045
    assert np.degrees(found["closed_form"]["train_heading_rad"]) <= 3.8
    assert found["closed_form"]["validation_position_m"] <= 0.11
    assert np.degrees(found["closed_form"]["validation_heading_rad"]) <= 5.5
    for name in ("train_position_m", "train_heading_rad", "validation_position_m", "validation_heading_rad"):
        assert found["theoretical"][name] > found["closed_form"][name]
    # Other commands, other shapes: there the poses along the way, their clocks set right, are worth as much or more.
    assert found["map"]["validation_cost"] <= found["closed_form"]["validation_cost"]
