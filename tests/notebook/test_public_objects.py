"""What public objects show at a Python prompt and in a notebook."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any

import numpy as np
import plotly.graph_objects as go
import polars as pl
import pytest
from commands import CONFIGS, compared_here, prepare
from pydantic import BaseModel
from shared_results import shared_folder
from wheeled_samples import CAR, DIFF, SWERVE, TRICYCLE

import omnibench
from omnibench.data.dataset import Dataset, Split, Trajectory, make_dataset
from omnibench.data.references import Reference, References
from omnibench.robot.kinematics import Robot
from omnibench.views import Shown, brief


@cache
def results() -> dict[str, Any]:
    """An object of every kind that public functions give."""
    dataset = omnibench.load_dataset(prepare().data)
    run = omnibench.calibrate(dataset)
    return {
        "dataset": dataset,
        "trajectory": dataset.trajectories[0],
        "robot": dataset.robot,
        "swerve": SWERVE,
        "wheel": dataset.robot.wheels[0],
        "run": run,
        "calibration": run.calibration,
        "evaluation": omnibench.evaluate(run.calibration, dataset),
        "inspection": omnibench.inspect_dataset(dataset),
        "certified": omnibench.certify_optimum(run.calibration, dataset, gap=0.5),
        "exported": omnibench.export_calibration(run.calibration, "c_header"),
        "comparison": compared_here(shared_folder() / "shown"),
        "discovery": omnibench.discover_effects(dataset),
        "design": omnibench.design_experiment(prepare().data),
        "compare config": omnibench.read_compare_config(CONFIGS / "apr02.yaml"),
        "live config": omnibench.read_live_config(CONFIGS / "live.yaml"),
        "simulation": omnibench.read_simulation(CONFIGS / "small.yaml"),
        "simulated": omnibench.simulate_dataset(omnibench.read_simulation(CONFIGS / "small.yaml").config),
        "budget": omnibench.Budget(),
    }


NAMES = (
    *("dataset", "trajectory", "robot", "swerve", "wheel", "run", "calibration", "evaluation", "inspection"),
    *("certified", "exported", "comparison", "discovery", "design", "compare config", "live config", "simulation"),
    *("simulated", "budget"),
)
SHOWN = [name for name in NAMES if name in ("dataset", "trajectory", "robot", "swerve", "run", "calibration")]
SHOWN += ["evaluation", "comparison", "discovery"]


def with_parts(found: Any) -> list[Any]:
    """An object and what its fields hold, whose reprs people meet next."""
    if is_dataclass(found):
        return [found, *(getattr(found, field.name) for field in fields(found))]
    return [found, *vars(found).values()] if isinstance(found, BaseModel) else [found]


def test_there_is_an_object_of_every_kind() -> None:
    assert set(results()) == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_the_repr_of_a_public_object_is_a_screenful(name: str) -> None:
    lines = repr(results()[name]).splitlines()
    assert 1 <= len(lines) <= 20
    assert max(map(len, lines)) <= 120


@pytest.mark.parametrize("name", NAMES)
def test_the_repr_of_an_object_that_a_public_one_holds_is_a_screenful(name: str) -> None:
    for part in with_parts(results()[name]):
        if type(part).__module__.startswith("omnibench"):
            lines = repr(part).splitlines()
            assert len(lines) <= 20, type(part)
            assert max(map(len, lines)) <= 400, type(part)


@pytest.mark.parametrize("name", SHOWN)
def test_a_result_shows_a_text_a_table_and_a_figure(name: str) -> None:
    found: Shown = results()[name]
    html = found._repr_html_()
    assert len(html) < 20_000
    assert "<table" in html
    frame = found.to_frame()
    assert isinstance(frame, pl.DataFrame)
    figure = found.plot()
    assert isinstance(figure, go.Figure)
    assert len(figure.data) > 0


def test_a_calibration_draws_paths_before_and_after_on_a_data_set() -> None:
    figure = results()["calibration"].plot(dataset=results()["dataset"])
    named = {trace.name for trace in figure.data if trace.showlegend}
    assert named == {"reference poses", "design values", "calibration"}


def test_the_matrix_as_a_table_holds_values_and_intervals() -> None:
    run = results()["run"]
    frame = run.to_frame("matrix")
    assert frame["value"].to_list() == [value for row in run.calibration.matrix for value in row]
    assert (frame["low"] < frame["value"]).all()
    assert (frame["value"] < frame["high"]).all()


def test_an_unknown_table_is_refused_with_those_that_there_are() -> None:
    with pytest.raises(omnibench.OmnibenchError, match=r"unknown table 'pose'; did you mean 'poses'\?"):
        results()["dataset"].to_frame("pose")


def test_an_unknown_option_of_a_plot_is_refused() -> None:
    with pytest.raises(omnibench.OmnibenchError, match=r"unknown option of plot 'data'; did you mean 'dataset'\?"):
        results()["calibration"].plot(data=results()["dataset"])


@pytest.mark.parametrize("robot", [DIFF, TRICYCLE, CAR, SWERVE], ids=lambda robot: robot.name)
def test_every_kind_of_robot_is_drawn_and_described(robot: Robot) -> None:
    assert len(repr(robot).splitlines()) == len(robot.wheels) + 1
    assert len(robot.plot().data) > 0


def test_a_data_set_is_the_same_after_it_was_made_of_its_own_tables() -> None:
    dataset: Dataset = results()["dataset"]
    tables = {name: dataset.to_frame(name) for name in ("trajectories", "wheels", "poses")}
    again = omnibench.make_dataset(dataset.name, dataset.robot, dataset.sample_period, **tables, simulated=True)
    assert again.hash == dataset.hash


def test_long_values_are_shortened_and_many_fields_are_counted() -> None:
    text = brief("Thing", [(f"field_{number}", "x" * 100) for number in range(30)])
    assert len(text.splitlines()) == 20
    assert "... 13 more lines" in text


def test_an_evaluation_of_runs_without_poses_shows_the_errors_that_there_are() -> None:
    robot, rolled = DIFF, np.linspace(0.0, 10.0, 101)[1:]
    signals = robot.signal_equations @ np.array([0.3, 0.0, 0.0])
    runs = []
    for index in range(4):
        tape = Reference("distance", 3.0 + 0.01 * index, 0.01)
        references = References.of([tape], rolled[-1])
        rates = np.tile(signals, (100, 1))
        split: Split = "train" if index < 3 else "validation"
        runs.append(
            Trajectory(f"run{index}", split, rolled, rates, np.zeros(1), np.zeros((1, 3)), references=references)
        )
    dataset = make_dataset("tape", robot, 0.1, runs)
    evaluation = omnibench.evaluate(omnibench.calibrate(dataset).calibration, dataset)
    assert "mean position error" in repr(evaluation)
    assert "heading error" not in repr(evaluation)
    assert evaluation.to_frame("references")["kind"].unique().to_list() == ["distance"]
    assert len(evaluation.plot().data) == 2


def test_a_calibration_file_states_deviations_and_no_intervals_that_its_runs_do_not_bear() -> None:
    run = results()["run"]
    kept, told = run.calibration.to_frame(), run.to_frame()
    assert "low" not in kept.columns
    assert ((told["high"] - told["low"]) > 2 * 1.95 * kept["deviation"]).all()
