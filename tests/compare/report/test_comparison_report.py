"""The report of a comparison: what it says, of small comparisons that were really run."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import first_picture, opened
from recording_samples import sample
from report_page import Page
from report_samples import config, flower, page, run, statistics

from omnibench.compare.report.comparison_report import comparison_document
from omnibench.compare.result import ComparisonResult
from omnibench.data.dataset import make_dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError
from omnibench.fit.problem import Improvement
from omnibench.report.numbers import fixed
from omnibench.report.render import write_document
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset

FAILING = {"name": "parametric", "label": "hopeless", "parameterisation": "matrix"}
MECANUM = {
    "name": "mecanum",
    "wheels": [
        {"name": name, "radius": 0.05, "distance": 0.35, "angle": math.radians(90 * side), "roller_angle": roller}
        for name, side, roller in (("fl", 1, 0.785), ("fr", -1, -0.785), ("rl", 1, -0.785), ("rr", -1, 0.785))
    ],
}


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


def test_simulated_data_wear_a_badge(report: Page) -> None:
    assert "SIMULATED DATA" in report.text


def test_recorded_data_wear_no_badge(result: ComparisonResult, tmp_path: Path) -> None:
    recorded = {name: replace(dataset, simulated=False) for name, dataset in result.datasets.items()}
    assert "SIMULATED" not in page(replace(result, datasets=recorded), tmp_path).text


@pytest.mark.parametrize(("split", "number"), [("training", 2), ("held-out", 3)])
def test_costs_stand_in_tables_like_the_papers(result: ComparisonResult, report: Page, split: str, number: int) -> None:
    caption = f"Cost of 16 {split} runs"
    entry = statistics(result, "closed_form")
    interval = entry.cost("train" if split == "training" else "validation")
    cells = report.row(caption, "closed_form")
    assert report.tables[caption][0] == ["Entry", "Cost, design values", f"Cost, {split}", "Improvement"]
    assert cells[2] == f"{fixed(interval.value, 4)} | {fixed(interval.low, 4)} to {fixed(interval.high, 4)}"
    assert f"As Table {number} of the paper" in report.text


def test_published_figures_stand_apart_and_are_said_to_be_of_other_data(report: Page) -> None:
    rows = report.tables["Cost of 16 training runs"]
    assert rows[-2] == ["Published, on other data: not comparable row by row"]
    assert rows[-1] == ["GA | an article", "0.1234", "0.0215", "82.58 %"]
    assert "Published" not in str(report.tables["Cost of 16 held-out runs"])


def test_a_run_without_an_answer_is_a_row_with_its_reason(result: ComparisonResult, report: Page) -> None:
    record = next(run.record for run in result.runs if run.record.label == "hopeless")
    assert report.row("Every run", "hopeless")[2] == f"failed | {record.reason}"
    assert report.row("Cost of 16 training runs", "hopeless")[2] == "no answer | failed"
    assert f"hopeless gave no answer in 2 of 2 runs (failed: {record.reason})" in report.text


def test_every_run_has_a_row(result: ComparisonResult, report: Page) -> None:
    assert len(report.tables["Every run"]) == 1 + len(result.runs)


def test_entries_are_compared_with_the_best(result: ComparisonResult, report: Page) -> None:
    best = next(entry for entry in result.statistics if entry.is_best)
    verdicts = {row[0].split(" | ")[0]: row[-1] for row in report.tables["Entries over their seeds"]}
    assert verdicts[best.label] == "best"
    assert verdicts["theoretical"] == "worse"
    assert verdicts["hopeless"] == "no answer"


def test_final_errors_are_in_millimetres_and_degrees(result: ComparisonResult, report: Page) -> None:
    errors = statistics(result, "closed_form").typical.scores["validation"].errors
    cells = report.row("Error of the final pose, held-out runs", "closed_form")
    assert cells[1] == f"{1e3 * np.hypot(errors[:, 0], errors[:, 1]).mean():.1f}"
    assert cells[3] == f"{np.degrees(np.abs(errors[:, 2]).mean()):.2f}"


def test_matrices_can_be_copied_with_all_their_digits(result: ComparisonResult, report: Page) -> None:
    for run_ in (statistics(result, label).typical for label in ("closed_form", "random_search")):
        for value in run_.matrix.ravel():
            assert repr(float(value)) in report.text


def test_an_element_that_is_zero_by_design_has_no_percentage(report: Page) -> None:
    cells = report.row("Differences from the design values", "closed_form")
    assert cells[2].endswith("| m/rad")
    assert cells[1].endswith(" %")


def test_config_versions_and_hardware_are_told(result: ComparisonResult, report: Page) -> None:
    assert "name: closed_form" in report.text
    assert f"numpy {result.environment.versions['numpy']}" in report.text
    assert result.environment.platform in report.text
    assert "omnibench compare config.yaml -o again" in report.text


def test_notes_and_warnings_are_told(result: ComparisonResult, tmp_path: Path) -> None:
    noted = result.config.model_copy(update={"notes": ("Not the authors' data.",)})
    told = page(replace(result, config=noted, warnings=("plug-in x cannot be imported",)), tmp_path).text
    assert "Not the authors' data." in told
    assert "plug-in x cannot be imported" in told


def test_hostile_labels_stay_words(tmp_path: Path) -> None:
    label = "<script>alert(1)</script>"
    calibrators = ["theoretical", {"name": "random_search", "label": label, "options": {"candidates": 50}}]
    told = page(run(config(calibrators=calibrators, seeds=[1], description=label)), tmp_path)
    assert label in told.text
    assert label not in told.html


def test_failed_runs_alone_still_make_a_report(tmp_path: Path) -> None:
    told = page(run(config(calibrators=[FAILING], seeds=[1])), tmp_path)
    assert "No calibrator gave an answer: 1 run" in told.text
    assert told.row("Every run", "hopeless")[2].startswith("failed | ")


def test_the_design_values_lead_the_tables_even_if_no_entry_asks_for_them(tmp_path: Path) -> None:
    result = run(config(calibrators=["closed_form"]))
    told = page(result, tmp_path)
    theoretical = fixed(result.runs[0].record.theoretical_validation_cost, 4)
    listed = run(config(calibrators=["theoretical", "closed_form"])).statistics[0].cost("validation")
    assert told.row("Cost of 16 held-out runs", "theoretical")[1].split(" | ")[0] == theoretical
    assert told.row("Cost of 16 held-out runs", "closed_form")[1] == theoretical
    interval = f"{fixed(listed.low, 4)} to {fixed(listed.high, 4)}"
    assert told.row("Cost of 16 held-out runs", "theoretical")[1] == f"{theoretical} | {interval}"


def test_an_element_that_the_box_holds_is_marked_and_named(tmp_path: Path) -> None:
    told = page(run(config(box="paper", calibrators=["closed_form"], seeds=[1])), tmp_path)
    cells = told.row("Inverse kinematic matrices M⁻¹", "closed_form")
    assert [index for index, cell in enumerate(cells) if cell.endswith("‡")] == [2]
    assert "‡ held by the box" in told.text
    assert "Held at the design value by a box without width there: m12 (closed_form)." in told.text


def test_a_box_with_width_everywhere_holds_nothing(report: Page) -> None:
    assert "‡" not in report.text
    assert "Held at the design value" not in report.text


def test_several_data_sets_have_an_overview_and_a_part_each(tmp_path: Path) -> None:
    one = {"simulate": flower(repetitions=1)}
    told = page(run(config(datasets={"one": one, "two": one}, calibrators=["theoretical", "closed_form"])), tmp_path)
    assert [row[0] for row in told.tables["Best entry of each data set"][1:]] == ["one | simulated", "two | simulated"]
    assert {"answer", "data-1-answer", "data-2-answer"} <= set(told.sections)
    assert len(told.sections) == len(set(told.sections))


def test_parameters_are_told_with_their_deviation(tmp_path: Path) -> None:
    search = {"search": "random_search", "search_options": {"candidates": 200}}
    result = run(config(calibrators=["theoretical", {"name": "parametric", "options": search}], seeds=[1]))
    radius = result.runs[1].record.parameters[0]
    cells = page(result, tmp_path).row(
        "Physical parameters and their deviation from the design values", "radius, wheel a"
    )
    assert cells[1] == "0.14800 m"
    assert cells[2] == f"{radius.value:.5f} m | {fixed(radius.deviation_percent, 2, signed=True)} %"
    angle = next(each for each in result.runs[1].record.parameters if each.name == "angle_a")
    told = page(result, tmp_path).row(
        "Physical parameters and their deviation from the design values", "angle, wheel a"
    )
    assert told[2].endswith(f"| {fixed(math.degrees(angle.deviation), 3, signed=True)}°")


def test_four_wheels_have_twelve_elements_compared_on_the_driven_span(tmp_path: Path) -> None:
    truth = {"tolerances": {"radius": 0.02, "seed": 1}}
    datasets = {"mecanum": {"simulate": flower(robot=MECANUM, truth=truth)}}
    told = page(run(config(datasets=datasets, calibrators=["theoretical", "closed_form"], seeds=[1])), tmp_path)
    assert len(told.row("Differences from the design values", "closed_form")) == 13
    assert "Compared on the span of wheel rates that the data drive" in told.text


def test_data_without_directions_have_boxes_instead_of_a_flower(tmp_path: Path) -> None:
    simulated = simulate_dataset(FlowerConfig.model_validate(flower())).dataset
    bare = [replace(t, alpha=None, omega=None, v=None, command=None) for t in simulated.trajectories]
    dataset = make_dataset("bare", simulated.robot, simulated.sample_period, bare)
    told = page(run(config(datasets={"bare": {"path": "bare"}}), {"bare": dataset}), tmp_path)
    assert "Every point is a trajectory" in told.text
    assert "direction α" not in told.text


def test_long_histories_and_long_runs_make_a_file_below_eight_megabytes(
    result: ComparisonResult, tmp_path: Path
) -> None:
    long_runs = flower(sample_period=0.04, pose_period=0.04, train={"seed": 1, "distance": 12}, repetitions=1)
    dataset = simulate_dataset(FlowerConfig.model_validate(long_runs)).dataset
    steps = [Improvement(2 * k, 1e-3 * k, 0.02 + math.exp(-1e-3 * k)) for k in range(1, 20_000)]
    searched = next(run for run in result.runs if run.record.label == "random_search")
    many = [
        replace(searched, history=tuple(steps), record=searched.record.model_copy(update={"seed": seed}))
        for seed in range(100)
    ]
    small = run(
        config(datasets={"flower": {"path": "x"}}, calibrators=["theoretical", "closed_form"]), {"flower": dataset}
    )
    told = page(replace(small, runs=(*small.runs, *many)), tmp_path)
    assert len(told.html) < 8e6
    assert told.row("Every run", "random_search")


def test_recordings_with_scans_or_targets_have_their_pictures(tmp_path: Path) -> None:
    told = page(run(config(datasets={"room": {"path": "x"}}, seeds=[1]), {"room": sample().dataset}), tmp_path)
    assert {"recording", "recording-room", "recording-wheels", "recording-player"} <= set(told.sections)
    assert told.row("What was recorded", "LIDAR scans")[1].endswith(" scans")
    made = sample().dataset
    plain = replace(made, scans=None, trajectories=tuple(replace(t, targets=None) for t in made.trajectories))
    told = page(run(config(datasets={"room": {"path": "x"}}, seeds=[1]), {"room": plain}), tmp_path)
    assert "recording" not in told.sections


def test_scans_that_cannot_be_read_cost_the_pictures_and_not_the_report(tmp_path: Path) -> None:
    save_dataset(sample().dataset, tmp_path / "data")
    dataset = load_dataset(tmp_path / "data")
    (tmp_path / "data" / "scans.parquet").write_bytes(b"broken")
    told = page(run(config(datasets={"room": {"path": "x"}}, seeds=[1]), {"room": dataset}), tmp_path)
    assert "scans.parquet: " in told.text
    assert told.row("Every run", "closed_form")


def test_a_report_that_cannot_be_written_is_one_line(result: ComparisonResult, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(DataError, match="cannot be written"):
        write_document(comparison_document(result), tmp_path / "file" / "report.html")


def test_a_browser_draws_every_plot_and_finds_no_fault(result: ComparisonResult, tmp_path: Path) -> None:
    write_document(comparison_document(result), tmp_path / "report.html")
    drawn, complaints = opened(tmp_path / "report.html")
    assert 'data-plots="drawn"' in drawn
    plots = re.findall(r'<figure class="plot">.*?</figure>', drawn, re.DOTALL)
    assert len(plots) >= 20
    assert all('class="main-svg"' in plot and ("<path" in plot) for plot in plots)
    assert not complaints


def test_the_paths_before_and_after_stand_in_the_first_900_pixels(result: ComparisonResult, tmp_path: Path) -> None:
    write_document(comparison_document(result), tmp_path / "report.html")
    bottom, width = first_picture(tmp_path / "report.html")
    assert bottom <= 900
    assert width <= 1280
