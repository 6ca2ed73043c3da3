"""The report of a comparison: what it says, first and further down, of small comparisons that were really run."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import assert_picture_comes_first, opened
from recording_samples import sample, with_a_tape
from report_page import NUMBER, Page
from report_samples import config, flower, page, run, statistics, usual
from sample_robots import APR02, LEVER_MECANUM
from syrupy.assertion import SnapshotAssertion

from omnibench.compare.plan import load_datasets
from omnibench.compare.report.comparison_report import comparison_document
from omnibench.compare.result import ComparisonResult
from omnibench.data.dataset import Dataset, make_dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.fit.problem import Improvement
from omnibench.fit.ratio_intervals import Interval
from omnibench.report.numbers import fixed
from omnibench.report.render import write_document
from omnibench.robot.kinematics import Robot
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.simulate import simulate_dataset

FAILING = {"name": "parametric", "label": "hopeless", "parameterisation": "matrix"}
HOSTILE = "<script>alert(1)</script>"
TRAINING, HELD_OUT, ENTRIES = "Cost of 16 training runs", "Cost of 16 held-out runs", "Entries over their seeds"
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


def with_entry(result: ComparisonResult, label: str, **changes: Any) -> ComparisonResult:
    """The comparison with other statistics of one entry."""
    changed = [replace(entry, **changes) if entry.label == label else entry for entry in result.statistics]
    return replace(result, statistics=tuple(changed))


def simulated(**changes: Any) -> dict[str, Any]:
    return {"flower": {"simulate": flower(**changes)}}


def test_the_report_reads_as_before(result: ComparisonResult, report: Page, snapshot: SnapshotAssertion) -> None:
    words = report.words()
    for ended in result.runs:  # rounding decides which of its two stopping rules ends a calibrator
        words = words.replace(NUMBER.sub("#", ended.record.reason), ": its reason")
    assert re.sub("(#?< )?# m?s", "# s", words) == snapshot  # a busy machine takes seconds, not milliseconds


def test_numbers_stand_in_the_units_and_digits_of_the_paper(result: ComparisonResult, report: Page) -> None:
    entry = statistics(result, "closed_form")
    fell, errors = entry.improvement("validation"), entry.typical.scores["validation"].errors
    interval = f"95 % interval {100 * fell.low:.1f} to {100 * fell.high:.1f} %"
    assert f"the cost fell by {100 * fell.value:.1f} % ({interval})" in report.text
    for caption, split in ((TRAINING, "train"), (HELD_OUT, "validation")):
        cost = entry.cost(split)
        cells = report.row(caption, "closed_form")
        assert cells[2] == f"{fixed(cost.value, 4)} | {fixed(cost.low, 4)} to {fixed(cost.high, 4)}"
    assert report.tables[TRAINING][-1] == ["GA | an article", "0.1234", "0.0215", "82.58 %"]
    cells = report.row("Error of the final pose, held-out runs", "closed_form")
    assert cells[1] == f"{1e3 * np.hypot(errors[:, 0], errors[:, 1]).mean():.1f}"
    assert cells[3] == f"{np.degrees(np.abs(errors[:, 2]).mean()):.2f}"
    for value in entry.typical.matrix.ravel():
        assert repr(float(value)) in report.text
    assert f"numpy {result.environment.versions['numpy']}" in report.text
    assert result.environment.platform in report.text


def test_a_run_without_an_answer_is_a_row_with_its_reason(result: ComparisonResult, report: Page) -> None:
    record = next(run.record for run in result.runs if run.record.label == "hopeless")
    assert report.row("Every run", "hopeless")[2] == f"failed | {record.reason}"
    assert f"hopeless gave no answer in 2 of 2 runs (failed: {record.reason})" in report.text
    assert len(report.tables["Every run"]) == 1 + len(result.runs)


def test_recorded_data_notes_and_warnings_are_told(result: ComparisonResult, tmp_path: Path) -> None:
    recorded = {name: replace(dataset, simulated=False) for name, dataset in result.datasets.items()}
    noted = result.config.model_copy(update={"notes": ("Not the authors' data.",)})
    text = page(replace(result, datasets=recorded, config=noted, warnings=("no plug-in x",)), tmp_path).text
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
        ({"box": "paper"}, "Held at the design value by a box without width there: m12 (closed_form)."),
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
    assert f"Not told apart on the held-out runs: one and other; {best} has the lowest" in report.text
    assert "is best." not in report.text
    assert report.row(ENTRIES, best)[-1] == "best | not told apart from 1 other"


def test_an_entry_that_the_runs_hardly_judge_is_not_told_apart_and_not_drawn_as_the_best(tmp_path: Path) -> None:
    wide = Interval(0.07, -0.05, 0.2)
    changed = with_entry(usual(), "random_search", difference=wide, practically_equal=True)
    assert "One other entry is not told apart from it." in page(changed, tmp_path).text
    chart = changed.plot()
    drawn = {words.split(":")[0]: trace for trace in chart.data for words in trace.text or ()}
    assert drawn["closed_form"].marker.color != drawn["random_search"].marker.color
    assert "random_search: cost" in (lines := repr(changed))
    assert lines.count(", not told apart from the best") == 1


def test_a_search_that_won_without_finding_the_minimum_is_doubted(tmp_path: Path) -> None:
    lucky = [replace(entry, is_best=entry.label == "random_search") for entry in usual().statistics]
    text = page(replace(usual(), statistics=tuple(lucky)), tmp_path).text
    assert "random_search has not found the minimum" in text


def test_an_entry_below_the_best_by_more_than_noise_is_not_called_worse(tmp_path: Path) -> None:
    below = Interval(-0.01, -0.02, -0.005)
    report = page(with_entry(usual(), "random_search", difference=below, practically_equal=False), tmp_path)
    assert "Below closed_form in held-out cost" in report.text
    assert report.row(ENTRIES, "random_search")[-1] == "lower cost here | higher training cost"


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
    assert report.row(ENTRIES, "random_search")[-1] == "undecided | no interval from 1 run"
    assert report.row("Cost of 1 held-out run", "closed_form")[-1].endswith("no interval")


def test_of_runs_whose_lengths_alone_are_known_no_heading_error_is_stated(told: Render) -> None:
    taped = {name: replace(dataset, trajectories=tuple(map(with_a_tape, dataset.trajectories)))
             for name, dataset in load_datasets(config()).items()}  # fmt: skip
    report = told(taped)
    answer = report.text[: report.text.index("All entries")]
    assert "closed_form misses the references by" in answer
    assert "°" not in answer
    assert "heading" not in answer
    assert report.row("Error of the final pose, held-out runs", "closed_form")[3:] == ["–", "–"]


def test_the_design_values_lead_the_tables_even_if_no_entry_asks_for_them(report: Page, told: Render) -> None:
    unasked = told(calibrators=["closed_form"])
    for caption in (TRAINING, HELD_OUT):
        assert unasked.row(caption, "theoretical")[:2] == report.row(caption, "theoretical")[:2]


def test_an_element_that_the_box_holds_is_marked(told: Render) -> None:
    cells = told(box="paper", calibrators=["closed_form"]).row("Inverse kinematic matrices M⁻¹", "closed_form")
    assert [index for index, cell in enumerate(cells) if cell.endswith("‡")] == [2]


def test_several_data_sets_have_an_overview_and_a_part_each(told: Render) -> None:
    one = {"simulate": flower(repetitions=1)}
    report = told(datasets={"one": one, "two": one})
    assert [row[0] for row in report.tables["Best entry of each data set"][1:]] == [
        "one | simulated",
        "two | simulated",
    ]
    assert {"answer", "data-1-answer", "data-2-answer"} <= set(report.sections)
    assert len(report.sections) == len(set(report.sections))


def test_parameters_are_told_with_their_deviation(tmp_path: Path) -> None:
    search = {"search": "random_search", "search_options": {"candidates": 200}}
    result = run(config(calibrators=["theoretical", {"name": "parametric", "options": search}], seeds=[1]))
    found = {each.name: each for each in result.runs[1].record.parameters}
    radius, report = found["radius_a"], page(result, tmp_path)
    cells = report.row(PARAMETERS, "radius, wheel a")
    assert cells[1] == "0.14800 m"
    assert cells[2] == f"{radius.value:.5f} m | {fixed(radius.deviation_percent, 2, signed=True)} %"
    turned = fixed(math.degrees(found["angle_a"].deviation), 3, signed=True)
    assert report.row(PARAMETERS, "angle, wheel a")[2].endswith(f"| {turned}°")


def test_four_wheels_have_twelve_elements_compared_on_the_driven_span(told: Render) -> None:
    report = told(datasets=simulated(robot=LEVER_MECANUM, truth={"tolerances": {"radius": 0.02, "seed": 1}}))
    assert len(report.row("Differences from the design values", "closed_form")) == 13
    assert "Compared on the span of wheel rates that the data drive" in report.text


def test_data_without_directions_have_boxes_instead_of_a_flower(told: Render) -> None:
    simulation = simulate_dataset(FlowerConfig.model_validate(flower())).dataset
    bare = [replace(t, alpha=None, omega=None, v=None, command=None) for t in simulation.trajectories]
    report = told({"bare": make_dataset("bare", simulation.robot, simulation.sample_period, bare)})
    assert "Every point is a trajectory" in report.text
    assert "direction α" not in report.text


@pytest.mark.slow
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
    small = run(config(calibrators=["theoretical", "closed_form"]), {"flower": dataset})
    report = page(replace(small, runs=(*small.runs, *many)), tmp_path)
    assert len(report.html) < 8e6
    assert report.row("Every run", "random_search")


def test_recordings_with_scans_or_targets_have_their_pictures(told: Render) -> None:
    made = sample().dataset
    report = told({"room": made})
    assert {"recording", "recording-room", "recording-wheels", "recording-player"} <= set(report.sections)
    assert report.row("What was recorded", "LIDAR scans")[1].endswith(" scans")
    plain = replace(made, scans=None, trajectories=tuple(replace(t, targets=None) for t in made.trajectories))
    assert "recording" not in told({"room": plain}).sections


def test_scans_that_cannot_be_read_cost_the_pictures_and_not_the_report(told: Render, tmp_path: Path) -> None:
    save_dataset(sample().dataset, tmp_path / "data")
    dataset = load_dataset(tmp_path / "data")
    (tmp_path / "data" / "scans.parquet").write_bytes(b"broken")
    report = told({"room": dataset})
    assert "scans.parquet: " in report.text
    assert report.row("Every run", "closed_form")


def test_a_browser_draws_every_plot_and_finds_no_fault(result: ComparisonResult, tmp_path: Path) -> None:
    write_document(comparison_document(result), tmp_path / "report.html")
    drawn, complaints = opened(tmp_path / "report.html")
    assert 'data-plots="drawn"' in drawn
    plots = re.findall(r'<figure class="plot">.*?</figure>', drawn, re.DOTALL)
    assert len(plots) >= 20
    assert all('class="main-svg"' in plot and ("<path" in plot) for plot in plots)
    assert not complaints


@pytest.mark.slow
def test_the_paths_before_and_after_stand_in_the_first_900_pixels(result: ComparisonResult, tmp_path: Path) -> None:
    write_document(comparison_document(result), tmp_path / "report.html")
    assert_picture_comes_first(tmp_path / "report.html")
