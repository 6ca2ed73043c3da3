"""What the report says first: who is best, how sure that is, and what speaks against it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from report_page import Page
from report_samples import APR02, config, flower, page, run, statistics, usual

from omnibench.compare.plan import load_datasets
from omnibench.compare.result import ComparisonResult
from omnibench.data.dataset import Trajectory, make_dataset
from omnibench.data.references import Reference, References
from omnibench.fit.ratio_intervals import Interval
from omnibench.robot.kinematics import Robot


@pytest.fixture(scope="module")
def result() -> ComparisonResult:
    return usual()


@pytest.fixture(scope="module")
def report(result: ComparisonResult, tmp_path_factory: pytest.TempPathFactory) -> Page:
    return page(result, tmp_path_factory.mktemp("report"))


def test_the_headline_names_the_best_and_the_improvement_with_its_interval(
    result: ComparisonResult, report: Page
) -> None:
    best = next(entry for entry in result.statistics if entry.is_best)
    fell = best.improvement("validation")
    assert f"{best.label} is best." in report.text
    assert f"the cost fell by {100 * fell.value:.1f} %" in report.text
    assert f"(95 % interval {100 * fell.low:.1f} to {100 * fell.high:.1f} %)" in report.text


def test_without_a_validation_split_the_training_data_are_judged(tmp_path: Path) -> None:
    datasets = {"flower": {"simulate": flower(validation=None)}}
    told = page(run(config(datasets=datasets, calibrators=["theoretical", "closed_form"])), tmp_path)
    assert "No runs are held out" in told.text
    assert "closed_form is the only calibrator with an answer" in told.text
    assert not [caption for caption in told.tables if "held-out" in caption]


def test_the_design_values_alone_are_no_calibration(tmp_path: Path) -> None:
    assert "Only the design values gave an answer" in page(run(config(calibrators=["theoretical"])), tmp_path).text


def test_a_robot_that_is_as_designed_gains_nothing_that_noise_could_not_explain(tmp_path: Path) -> None:
    design = {"matrix": Robot.model_validate(APR02).inverse_kinematic_matrix.tolist()}
    datasets = {"flower": {"simulate": flower(truth=design)}}
    told = page(run(config(datasets=datasets, calibrators=["theoretical", "closed_form"], seeds=[1])), tmp_path)
    assert "No calibrator did better than the design values" in told.text or "noise alone could explain" in told.text


def test_a_search_that_won_without_finding_the_minimum_is_doubted(result: ComparisonResult, tmp_path: Path) -> None:
    lucky = [replace(e, is_best=e.label == "random_search") for e in result.statistics]
    assert "random_search has not found the minimum" in page(replace(result, statistics=tuple(lucky)), tmp_path).text


def test_entries_that_noise_could_swap_are_not_told_apart_and_the_training_cost_decides(tmp_path: Path) -> None:
    twins = [{"name": "closed_form", "label": name} for name in ("one", "other")]
    result = run(config(calibrators=["theoretical", *twins], seeds=[1]))
    told = page(result, tmp_path)
    best = next(entry.label for entry in result.statistics if entry.is_best)
    assert f"Not told apart on the held-out runs: one and other; {best} has the lowest" in told.text
    assert "is best." not in told.text
    assert told.row("Entries over their seeds", best)[-1] == "best | not told apart from 1 other"


def test_an_entry_that_the_runs_hardly_judge_is_not_told_apart_and_not_drawn_as_the_best(
    result: ComparisonResult, tmp_path: Path
) -> None:
    wide = Interval(0.07, -0.05, 0.2)
    far = [
        replace(e, difference=wide, practically_equal=True) if e.label == "random_search" else e
        for e in result.statistics
    ]
    changed = replace(result, statistics=tuple(far))
    told = page(changed, tmp_path)
    assert "One other entry is not told apart from it." in told.text
    assert not re.search(r"\blevel\b", told.text)
    chart = changed.plot()
    drawn = {words.split(":")[0]: trace for trace in chart.data for words in trace.text or ()}
    assert drawn["closed_form"].marker.color != drawn["random_search"].marker.color
    assert "random_search: cost" in (lines := repr(changed))
    assert lines.count(", not told apart from the best") == 1


def test_an_entry_below_the_best_by_more_than_noise_is_not_called_worse(
    result: ComparisonResult, tmp_path: Path
) -> None:
    below = Interval(-0.01, -0.02, -0.005)
    lower = [
        replace(e, difference=below, practically_equal=False) if e.label == "random_search" else e
        for e in result.statistics
    ]
    told = page(replace(result, statistics=tuple(lower)), tmp_path)
    assert "Below closed_form in held-out cost" in told.text
    assert told.row("Entries over their seeds", "random_search")[-1] == "lower cost here | higher training cost"


def test_commands_that_the_best_makes_worse_are_listed_with_both_costs(
    result: ComparisonResult, tmp_path: Path
) -> None:
    (dataset,) = result.datasets.values()
    commands = [trajectory.command for trajectory in dataset.split("validation")]
    typical = statistics(result, "closed_form").typical
    spoilt = np.array([command == commands[0] for command in commands])
    score, design = typical.scores["validation"], typical.design["validation"]
    costs = np.where(spoilt, design.costs + 0.01, score.costs)
    scores = {**typical.scores, "validation": replace(score, costs=costs)}
    changed = [
        replace(e, typical=replace(typical, scores=scores)) if e.label == "closed_form" else e
        for e in result.statistics
    ]
    was = design.costs[spoilt].mean()
    told = page(replace(result, statistics=tuple(changed)), tmp_path).text
    assert f"worse than the design values on 1 of {len(set(commands))} commands of the held-out runs" in told
    assert f"{commands[0]} {was:.4f} → {was + 0.01:.4f}." in told


def test_no_command_is_listed_where_the_best_is_better_on_all(report: Page) -> None:
    assert "worse than the design values" not in report.text


def test_intervals_over_runs_are_said_to_be_too_narrow_where_commands_are_repeated(
    report: Page, tmp_path: Path
) -> None:
    told = page(run(config(calibrators=["closed_form"], seeds=[1], bootstrap={"unit": "run"})), tmp_path)
    assert told.text.count("commands that were not driven here the spread is larger") == 1
    assert "bootstrap over 16 runs" in told.text
    assert "the spread is larger" not in report.text
    assert "Student's t over 8 commands" in report.text


def test_one_validation_run_gives_no_interval_and_no_best(tmp_path: Path) -> None:
    usual_data = usual().datasets["flower"]
    first = usual_data.split("validation")[0]
    few = make_dataset("few", usual_data.robot, 0.01, [*usual_data.split("train"), first], simulated=True)
    told = page(run(config(), {"flower": few}), tmp_path)
    assert "Which entry is best cannot be said (no interval from 1 run)" in told.text
    assert "could explain" not in told.text.split("Costs")[0]
    assert "95 % interval" not in told.text.split("Costs")[0]
    assert "undecided: 1 run cannot show it, hold out 3 or more" in told.text
    assert told.row("Entries over their seeds", "random_search")[-1] == "undecided | no interval from 1 run"
    assert told.row("Cost of 1 held-out run", "closed_form")[-1].endswith("no interval")


def test_what_held_out_runs_say_stands_under_the_result(report: Page) -> None:
    assert "closed_form, held out (16 runs): " in report.text
    assert "better than the design" in report.text


def test_commands_driven_once_make_no_such_remark(tmp_path: Path) -> None:
    datasets = {"flower": {"simulate": flower(repetitions=1)}}
    told = page(run(config(datasets=datasets, calibrators=["closed_form"], seeds=[1])), tmp_path)
    assert "commands that were not driven here" not in told.text


def test_of_runs_whose_lengths_alone_are_known_no_heading_error_is_stated(tmp_path: Path) -> None:
    chosen = config(calibrators=["theoretical", "closed_form"], seeds=[1])
    taped = {name: replace(dataset, trajectories=tuple(map(with_a_tape, dataset.trajectories)))
             for name, dataset in load_datasets(chosen).items()}  # fmt: skip
    told = page(run(chosen, taped), tmp_path)
    answer = told.text[: told.text.index("All entries")]
    assert "closed_form misses the references by" in answer
    assert "Error of lengths and places, mean" in answer
    assert "°" not in answer
    assert "heading" not in answer
    assert told.row("Error of the final pose, held-out runs", "closed_form")[3:] == ["–", "–"]


def with_a_tape(run_: Trajectory) -> Trajectory:
    """A run of which only the length of its way is known."""
    length = float(np.hypot(*np.diff(run_.poses[:, :2], axis=0).T).sum())
    references = References.of([Reference("distance", length, 0.003)], float(run_.times[-1]))
    return replace(run_, pose_times=np.zeros(1), poses=np.zeros((1, 3)), references=references)
