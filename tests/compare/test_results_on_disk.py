"""What a comparison leaves behind: summary.json, tables, calibrations, and a config that can be run again."""

from __future__ import annotations

import json
import resource
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from commands import (
    Command,
    assert_refused,
    compared,
    compared_here,
    disk_that_takes,
    flower,
    omnibench,
    search,
    small,
    summary,
    write_config,
)

from omnibench.compare.config import CompareConfig, effective_config, read_compare_config
from omnibench.compare.output import prepare_output
from omnibench.compare.plan import load_datasets, make_plan
from omnibench.compare.run import run_comparison
from omnibench.errors import DataError
from omnibench.fit.evaluate import evaluate
from omnibench.robot.calibration import read_calibration

NUMBER = (int, float)
# DESIGN.md, "Commands": the keys of a run in summary.json. None: no answer, or no such split.
DOCUMENTED = {
    "calibrator": str,
    "parameterisation": str,
    "box": str,
    "seed": int,
    "outcome": str,
    "reason": str,
    "train_cost": float,
    "validation_cost": float,
    "theoretical_train_cost": float,
    "theoretical_validation_cost": float,
    "train_improvement": float,
    "validation_improvement": float,
    "validation_position_m": float,
    "validation_heading_rad": float,
    "evaluations": int,
    "seconds": float,
    "matrix": list,
}
FURTHER = {
    "dataset": str,
    "label": str,
    "options": dict,
    "train_position_m": float,
    "train_heading_rad": float,
    "parameters": (list, type(None)),
    "at_bounds": list,
    "held": list,
    "gap": float,
    "gap_box": str,
    "proven_gap": (float, type(None)),
    "reference_seconds": (float, type(None)),
    "machine": (str, type(None)),
}


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    entries = ["theoretical", "closed_form", search(), {"name": "parametric", "label": "Eq. (3) [°]"}]
    compared(write_config(folder, calibrators=entries, seeds=[1, 2]), folder / "out")
    return folder / "out"


def test_the_summary_has_the_documented_keys(output: Path) -> None:
    found = summary(output)
    assert (found["dataset"], found["cost"], found["name"]) == ("flower", "final_pose", "small")
    assert {*found} == {
        *("name", "dataset", "simulated", "cost", "integration", "budget", "runs", "statistics", "warnings"),
        *("environment", "certificates", "intervals", "held_out", "sessions"),
    }
    assert [(run["label"], run["seed"]) for run in found["runs"]] == [
        ("theoretical", 1),
        ("closed_form", 1),
        ("search", 1),
        ("search", 2),
        ("Eq. (3) [°]", 1),
        ("Eq. (3) [°]", 2),
    ]


def test_a_run_in_the_summary_has_the_documented_keys_and_types(output: Path) -> None:
    for run in summary(output)["runs"]:
        assert {*run} == {*DOCUMENTED, *FURTHER}
        for name, kind in (DOCUMENTED | FURTHER).items():
            assert isinstance(run[name], kind), (name, run[name])
        assert np.shape(run["matrix"]) == (3, 3)


def test_a_run_without_validation_data_says_null(tmp_path: Path) -> None:
    data = flower()
    del data["validation"]
    compared_here(tmp_path / "out", datasets={"flower": {"simulate": data}})
    for run in summary(tmp_path / "out")["runs"]:
        missing = {name for name, value in run.items() if value is None and name not in ("parameters", "proven_gap")}
        assert missing == {name for name in run if "validation" in name}


def test_the_parametric_run_reports_its_parameters_and_their_deviations(output: Path) -> None:
    parameters = summary(output)["runs"][-1]["parameters"]
    assert [item["name"] for item in parameters] == [
        f"{kind}_{wheel}" for kind in ("radius", "distance", "angle") for wheel in "abc"
    ]
    for item in parameters:
        assert item["deviation_percent"] == pytest.approx(100 * (item["value"] / item["design"] - 1))
        assert item["unit"] == ("rad" if item["name"].startswith("angle") else "m")


def test_infinity_in_an_option_is_null_in_the_summary(tmp_path: Path) -> None:
    entries = [{"name": "crs", "options": {"tolerance": float("inf")}}]
    compared_here(tmp_path / "out", calibrators=entries, budget={"seconds": float("inf")})
    assert summary(tmp_path / "out")["runs"][0]["options"]["tolerance"] is None
    assert summary(tmp_path / "out")["budget"]["seconds"] is None


def test_the_table_of_runs_agrees_with_the_summary(output: Path) -> None:
    table = pl.read_parquet(output / "runs.parquet").to_dicts()
    for row in table:
        row |= {name: json.loads(row[name]) for name in ("options", "parameters")}
    assert table == summary(output)["runs"]


def test_the_table_of_statistics_agrees_with_the_summary(output: Path) -> None:
    assert pl.read_parquet(output / "statistics.parquet").to_dicts() == summary(output)["statistics"]


@pytest.mark.parametrize("split", ["train", "validation"])
def test_the_table_of_errors_agrees_with_the_summary(output: Path, split: str) -> None:
    errors = pl.read_parquet(output / "errors.parquet").filter(pl.col("split") == split)
    for run in summary(output)["runs"]:
        own = errors.filter((pl.col("label") == run["label"]) & (pl.col("seed") == run["seed"]))
        assert len(own) == 6
        assert own["cost"].mean() == pytest.approx(run[f"{split}_cost"], rel=1e-12)
        distances = np.hypot(own["x_error_m"], own["y_error_m"])
        assert distances.mean() == pytest.approx(run[f"{split}_position_m"], rel=1e-12)
        assert own["heading_error_rad"].abs().mean() == pytest.approx(run[f"{split}_heading_rad"], rel=1e-12)


def test_the_history_of_a_run_ends_at_its_training_cost(output: Path) -> None:
    history = pl.read_parquet(output / "history.parquet")
    for run in summary(output)["runs"]:
        own = history.filter((pl.col("label") == run["label"]) & (pl.col("seed") == run["seed"]))
        assert own["best_cost"].is_sorted(descending=True)
        assert own["evaluations"].max() <= run["evaluations"]
        assert own["best_cost"][-1] == pytest.approx(run["train_cost"], rel=1e-12)


def test_tables_have_the_same_columns_when_no_run_has_an_answer(output: Path, tmp_path: Path) -> None:
    entries = [{"name": "closed_form", "parameterisation": "geometry"}]  # which it refuses
    compared_here(tmp_path / "out", calibrators=entries)
    for name in ("runs", "errors", "history", "statistics"):
        schemas = [pl.read_parquet_schema(folder / f"{name}.parquet") for folder in (output, tmp_path / "out")]
        types = [{column: kind for column, kind in schema.items() if column != "typical_seed"} for schema in schemas]
        assert types[0] == types[1]


def test_the_calibrations_evaluate_to_the_costs_in_the_summary(output: Path, tmp_path: Path) -> None:
    config = write_config(tmp_path)
    dataset = load_datasets(read_compare_config(config))["flower"]
    files = sorted((output / "calibrations").iterdir())
    assert [file.name for file in files] == ["flower-Eq._3.yaml", "flower-closed_form.yaml", "flower-search.yaml"]
    typical = {(entry["label"], entry["typical_seed"]) for entry in summary(output)["statistics"]}
    for file, label in zip(files, ("Eq. (3) [°]", "closed_form", "search"), strict=True):
        run = next(run for run in summary(output)["runs"] if run["label"] == label and (label, run["seed"]) in typical)
        calibration = read_calibration(file)
        for split, errors in evaluate(calibration, dataset).splits.items():
            if split != "all":
                assert errors.cost == pytest.approx(run[f"{split}_cost"], rel=1e-12)
                assert errors.position_mean_m == pytest.approx(run[f"{split}_position_m"], rel=1e-12)
                assert errors.heading_mean_rad == pytest.approx(run[f"{split}_heading_rad"], rel=1e-12)
        assert calibration.provenance is not None
        assert calibration.provenance.training_cost == run["train_cost"]
        assert calibration.provenance.fitted == dataset.fingerprints("train")


def test_calibrations_of_labels_that_look_alike_do_not_overwrite_each_other(tmp_path: Path) -> None:
    entries = [search(label, count) for label, count in (("a b", 10), ("a_b", 20), ("A/B", 30), ("最", 40), ("良", 50))]
    compared_here(tmp_path / "out", calibrators=entries)
    found = {file.stem for file in (tmp_path / "out" / "calibrations").iterdir()}
    assert found == {"flower-a_b", "flower-a_b-2", "flower-A_B-3", "flower-", "flower--2"}


def test_the_effective_config_gives_the_same_keys(output: Path) -> None:
    def keys(config: CompareConfig) -> list[str]:
        return [run.key for run in make_plan(config, load_datasets(config))]

    original = effective_config(read_compare_config(output.parent / "small.yaml"))
    assert keys(effective_config(read_compare_config(output / "config.yaml"))) == keys(original)
    assert {f"{key}.json" for key in keys(original)} == {file.name for file in (output / "runs").iterdir()}


def test_the_effective_config_spells_out_every_default(output: Path) -> None:
    text = (output / "config.yaml").read_text()
    for default in ("integration: arc", "programs: 50", "batch: 100", "search: crs", "pose_period: 0.25"):
        assert default in text


def test_the_effective_config_can_be_run_again_in_its_place(output: Path) -> None:
    before = {file.name: file.stat().st_mtime_ns for file in (output / "runs").iterdir()}
    run_comparison(read_compare_config(output / "config.yaml"), output)
    assert {file.name: file.stat().st_mtime_ns for file in (output / "runs").iterdir()} == before


def test_results_go_to_a_folder_of_their_own_with_a_link_to_the_latest(tmp_path: Path) -> None:
    config = CompareConfig.model_validate(small())
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        folders = [prepare_output(config, None).resolve() for _ in range(3)]
    assert len(set(folders)) == 3
    assert {folder.parent for folder in folders} == {tmp_path / "results" / "small"}
    assert (tmp_path / "results" / "small" / "latest").resolve() == folders[-1]


@pytest.mark.parametrize("name", ["notes.txt", "config.yaml"])
def test_a_folder_that_holds_something_else_is_left_alone(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("mine: precious\n")
    with pytest.raises(DataError, match="holds other files; name a new folder"):
        prepare_output(CompareConfig.model_validate(small()), tmp_path)
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [(name, "mine: precious\n")]


def test_the_folder_of_the_config_itself_is_no_place_for_results(command: Command, tmp_path: Path) -> None:
    config = write_config(tmp_path)
    before = config.read_text()
    assert_refused(command("compare", config, "--output", tmp_path), "holds other files")
    assert config.read_text() == before


def test_the_folder_of_another_comparison_is_left_alone(command: Command, output: Path, tmp_path: Path) -> None:
    before = summary(output)
    run = command("compare", write_config(tmp_path, name="another"), "--output", output)
    assert_refused(run, "holds the comparison 'small'; name another folder for 'another'")
    assert summary(output) == before


def test_a_comparison_of_that_name_on_other_data_is_left_alone(command: Command, output: Path, tmp_path: Path) -> None:
    before = summary(output)
    run = command("compare", write_config(tmp_path, datasets={"d": {"simulate": flower()}}), "--output", output)
    assert_refused(run, "holds a comparison on 'flower'; name another folder for 'd', or --force")
    assert summary(output) == before


def test_a_file_of_somebody_else_among_the_calibrations_is_left_alone_even_by_force(tmp_path: Path) -> None:
    mine = tmp_path / "calibrations" / "closed_form.yaml"
    mine.parent.mkdir()
    mine.write_text("precious")
    compared(write_config(tmp_path / "c"), tmp_path, "--force")
    compared(write_config(tmp_path / "c", calibrators=["closed_form"]), tmp_path)
    assert mine.read_text() == "precious"
    assert {file.name for file in mine.parent.iterdir()} == {"closed_form.yaml", "flower-closed_form.yaml"}


def test_a_file_in_place_of_a_folder_is_refused(command: Command, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    run = command("compare", write_config(tmp_path / "c"), "--output", tmp_path / "file")
    assert_refused(run, str(tmp_path / "file"), "is a file; name a folder for the results")
    assert (tmp_path / "file").read_text() == "mine"


def test_a_folder_below_a_file_is_refused(command: Command, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    run = command("compare", write_config(tmp_path / "c"), "--output", tmp_path / "file" / "deep" / "er")
    assert_refused(run, "cannot be written", "is not a folder; choose another place")
    assert (tmp_path / "file").read_text() == "mine"


def at_most(size: int) -> Callable[[], None]:
    """For a process: the disk takes no file larger than ``size`` bytes."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def test_a_full_disk_is_one_line(tmp_path: Path) -> None:
    output = tmp_path / "out"
    run = omnibench("compare", write_config(tmp_path), "--output", output, preexec_fn=at_most(100))
    assert (run.returncode, run.stdout) == (2, "")
    advice = "cannot be written: File too large; free space or choose another place"
    *progress, error = run.stderr.splitlines()
    assert error == f"error: {output / 'config.yaml'}: {advice}"
    assert all(line.startswith("simulating") for line in progress)  # printed where the simulation takes long
    assert "Traceback" not in run.stderr
    assert [file for file in output.rglob("*") if file.is_file()] == []


def test_a_disk_that_is_full_after_the_runs_loses_none(tmp_path: Path) -> None:
    output = tmp_path / "out"
    compared_here(output, calibrators=["theoretical"])  # starts the fork server, which shall not inherit the limits
    (output / "report.html").unlink()
    (output / "summary.json").unlink()
    for size, file in ((3000, "summary.json"), (20_000, "report.html")):
        problem = rf"{file}: cannot be written: File too large; free space"
        with disk_that_takes(size), pytest.raises(DataError, match=problem):
            compared_here(output)
        assert not (output / file).exists()
        assert not list(output.rglob(".*"))
        assert len(list((output / "runs").glob("*.json"))) == 3


def test_a_run_that_the_disk_does_not_take_is_one_line(tmp_path: Path) -> None:
    entry = {"name": "genetic", "options": {"generations": 100}}  # whose history is longer than the config
    config = write_config(tmp_path, calibrators=["theoretical", entry], budget={"evaluations": 20_000}, workers=1)
    run = omnibench("compare", config, "--output", tmp_path / "out", preexec_fn=at_most(2500))
    assert run.returncode == 2
    assert "Traceback" not in run.stderr
    assert f"error: {tmp_path / 'out' / 'runs'}" in run.stderr.splitlines()[-1]
    assert len(list((tmp_path / "out" / "runs").iterdir())) == 1
