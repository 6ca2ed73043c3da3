"""What public objects show at a Python prompt and in a notebook, and the notebooks of the handbook."""

import json
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import plotly.graph_objects as go
import polars as pl
import pytest
from commands import CONFIGS, compared_here, prepare
from pydantic import BaseModel
from recording_samples import with_a_tape
from sample_robots import CAR, DIFFERENTIAL, SWERVE, TRICYCLE
from shared_results import shared_folder
from timing import PATIENCE

import omnibench
from omnibench.cli.handbook_topics import HANDBOOK
from omnibench.robot.calibration import read_calibration
from omnibench.robot.kinematics import Robot
from omnibench.views import Shown, brief


@cache
def result(name: str) -> Any:
    """What a public function gives."""
    return MAKERS[name]()


MAKERS: dict[str, Callable[[], Any]] = {
    "dataset": lambda: omnibench.load_dataset(prepare().data),
    "trajectory": lambda: result("dataset").trajectories[0],
    "robot": lambda: result("dataset").robot,
    "swerve": lambda: SWERVE,
    "wheel": lambda: result("dataset").robot.wheels[0],
    "run": lambda: omnibench.calibrate(result("dataset")),
    "calibration": lambda: result("run").calibration,
    "evaluation": lambda: omnibench.evaluate(result("calibration"), result("dataset")),
    "inspection": lambda: omnibench.inspect_dataset(result("dataset")),
    "certified": lambda: omnibench.certify_optimum(result("calibration"), result("dataset"), gap=0.5),
    "exported": lambda: omnibench.export_calibration(result("calibration"), "c_header"),
    "comparison": lambda: compared_here(shared_folder() / "shown"),
    "discovery": lambda: omnibench.discover_effects(result("dataset")),
    "design": lambda: omnibench.design_experiment(prepare().data),
    "compare config": lambda: omnibench.read_compare_config(CONFIGS / "apr02.yaml"),
    "live config": lambda: omnibench.read_live_config(CONFIGS / "live.yaml"),
    "simulation": lambda: omnibench.read_simulation(CONFIGS / "small.yaml"),
    "simulated": lambda: omnibench.simulate_dataset(result("simulation").config),
    "budget": lambda: omnibench.Budget(),
}
LONG = ("certified", "comparison", "discovery", "design")
OBJECTS = [pytest.param(name, marks=pytest.mark.slow if name in LONG else ()) for name in MAKERS]
SHOWN = ("dataset", "trajectory", "robot", "swerve", "run", "calibration", "evaluation", "comparison", "discovery")


def with_parts(found: Any) -> list[Any]:
    """An object and what its fields hold, whose reprs people meet next."""
    if is_dataclass(found):
        return [found, *(getattr(found, field.name) for field in fields(found))]
    return [found, *vars(found).values()] if isinstance(found, BaseModel) else [found]


@pytest.mark.parametrize("name", OBJECTS)
def test_the_repr_of_a_public_object_and_of_what_it_holds_is_a_screenful(name: str) -> None:
    lines = repr(result(name)).splitlines()
    assert 1 <= len(lines) <= 20
    assert max(map(len, lines)) <= 120
    for part in with_parts(result(name)):
        if type(part).__module__.startswith("omnibench"):
            lines = repr(part).splitlines()
            assert len(lines) <= 20, type(part)
            assert max(map(len, lines)) <= 400, type(part)


@pytest.mark.parametrize("name", [each for each in OBJECTS if each.values[0] in SHOWN])
def test_a_result_shows_a_text_a_table_and_a_figure(name: str) -> None:
    found: Shown = result(name)
    html = found._repr_html_()
    assert len(html) < 20_000
    assert "<table" in html
    frame = found.to_frame()
    assert isinstance(frame, pl.DataFrame)
    figure = found.plot()
    assert isinstance(figure, go.Figure)
    assert len(figure.data) > 0


def test_a_calibration_draws_paths_before_and_after_on_a_data_set() -> None:
    figure = result("calibration").plot(dataset=result("dataset"))
    named = {trace.name for trace in figure.data if trace.showlegend}
    assert named == {"reference poses", "design values", "calibration"}


def test_the_matrix_as_a_table_holds_values_and_intervals() -> None:
    run = result("run")
    frame = run.to_frame("matrix")
    assert frame["value"].to_list() == [value for row in run.calibration.matrix for value in row]
    assert (frame["low"] < frame["value"]).all()
    assert (frame["value"] < frame["high"]).all()


def test_an_unknown_table_or_option_of_a_plot_is_refused_with_the_nearest() -> None:
    with pytest.raises(omnibench.OmnibenchError, match="'pose'; did you mean 'poses'"):
        result("dataset").to_frame("pose")
    with pytest.raises(omnibench.OmnibenchError, match="'data'; did you mean 'dataset'"):
        result("calibration").plot(data=result("dataset"))


@pytest.mark.parametrize("robot", [DIFFERENTIAL, TRICYCLE, CAR, SWERVE], ids=lambda robot: robot.name)
def test_every_kind_of_robot_is_drawn_and_described(robot: Robot) -> None:
    assert all(wheel.name in repr(robot) for wheel in robot.wheels)
    assert len(robot.plot().data) > 0


def test_long_values_are_shortened_and_many_fields_are_counted() -> None:
    text = brief("Thing", [(f"field_{number}", "x" * 100) for number in range(30)])
    assert len(text.splitlines()) == 20
    assert "... 13 more lines" in text


def test_an_evaluation_of_runs_without_poses_shows_the_errors_that_there_are() -> None:
    recorded = result("dataset")
    dataset = replace(recorded, trajectories=tuple(map(with_a_tape, recorded.trajectories)))
    evaluation = omnibench.evaluate(omnibench.calibrate(dataset).calibration, dataset)
    assert "distance" in repr(evaluation)
    assert evaluation.splits["train"].heading_mean_rad is None
    assert evaluation.to_frame("references")["kind"].unique().to_list() == ["distance"]
    assert len(evaluation.plot().data) == 2


def test_a_calibration_file_states_deviations_and_no_intervals_that_its_runs_do_not_bear() -> None:
    run = result("run")
    kept, told = run.calibration.to_frame(), run.to_frame()
    assert "low" not in kept.columns
    assert ((told["high"] - told["low"]) > 2 * 1.95 * kept["standard_deviation"]).all()


NOTEBOOKS = sorted((HANDBOOK / "notebooks").glob("*.ipynb"))


@pytest.mark.slow
@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_a_notebook_runs_and_finds_the_robot(file: Path, tmp_path: Path) -> None:
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    notebook: Any = nbformat.read(file, as_version=4)
    nbclient.NotebookClient(notebook, timeout=int(PATIENCE), resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [set(output["data"]) for cell in notebook.cells for output in cell.get("outputs", ()) if "data" in output]
    assert sum("application/vnd.plotly.v1+json" in kinds for kinds in shown) == 4
    assert sum("text/html" in kinds for kinds in shown) >= 3
    matrix = read_calibration(tmp_path / "cart.yaml").matrix_array
    assert matrix[0, 0] == pytest.approx(0.0510 / 2, rel=0.01)
    assert matrix[0, 1] == pytest.approx(0.0485 / 2, rel=0.01)


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_a_notebook_is_kept_without_outputs(file: Path) -> None:
    content = json.loads(file.read_text(encoding="utf-8"))
    assert len(file.read_bytes()) < 20_000
    assert all(not cell.get("outputs") and cell.get("execution_count") is None for cell in content["cells"])
