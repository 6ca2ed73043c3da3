"""What a comparison leaves behind: summary.json, tables, calibrations, and a config that can be run again."""

from __future__ import annotations

import json
import resource
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from commands import (
    Command,
    assert_refused,
    compared_here,
    compared_once,
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
from omnibench.errors import DataError
from omnibench.fit.evaluate import evaluate
from omnibench.robot.calibration import read_calibration

# DESIGN.md, "Commands": the keys of a run in summary.json, and the type of their values.
DOCUMENTED = {
    **dict.fromkeys(("calibrator", "parameterisation", "box", "outcome", "reason"), str),
    **dict.fromkeys(("dataset", "label", "gap_box"), str),
    **dict.fromkeys(("seed", "evaluations"), int),
    **dict.fromkeys(("train_cost", "validation_cost", "train_improvement", "validation_improvement"), float),
    **dict.fromkeys(("theoretical_train_cost", "theoretical_validation_cost", "seconds", "gap"), float),
    **dict.fromkeys(("train_position_m", "train_heading_rad"), float),
    **dict.fromkeys(("validation_position_m", "validation_heading_rad"), float),
    **dict.fromkeys(("matrix", "at_bounds", "held"), list),
    "options": dict,
    "parameters": (list, type(None)),
    "proven_gap": (float, type(None)),
    "reference_seconds": (float, type(None)),
    "machine": (str, type(None)),
}


@pytest.fixture(scope="module")
def output() -> Path:
    return compared_once().output


def test_the_summary_and_its_runs_have_the_documented_keys_and_types(output: Path) -> None:
    found = summary(output)
    assert (found["dataset"], found["cost"], found["name"]) == ("flower", "final_pose", "small")
    assert {*found} == {
        *("name", "dataset", "simulated", "cost", "integration", "budget", "runs", "statistics", "warnings"),
        *("environment", "certificates", "intervals", "held_out", "sessions"),
    }
    stochastic = [(label, seed) for label in ("search", "Eq. (3) [°]") for seed in (1, 2)]
    runs = [("theoretical", 1), ("closed_form", 1), *stochastic]
    assert [(run["label"], run["seed"]) for run in found["runs"]] == runs
    for run in found["runs"]:
        assert {*run} == {*DOCUMENTED}
        for name, kind in DOCUMENTED.items():
            assert isinstance(run[name], kind), (name, run[name])
        assert np.shape(run["matrix"]) == (3, 3)


def test_what_is_infinite_or_not_there_is_null_in_the_summary(tmp_path: Path) -> None:
    data = flower()
    del data["validation"]
    entries = [{"name": "crs", "options": {"tolerance": float("inf")}}]
    budget = {"seconds": float("inf")}
    compared_here(tmp_path, datasets={"flower": {"simulate": data}}, calibrators=entries, budget=budget)
    (run,) = summary(tmp_path)["runs"]
    missing = {name for name, value in run.items() if value is None}
    assert missing - {"parameters", "proven_gap", "gap", "gap_box"} == {name for name in run if "validation" in name}
    assert run["options"]["tolerance"] is None
    assert summary(tmp_path)["budget"]["seconds"] is None


def test_the_parametric_run_reports_its_parameters_and_their_deviations(output: Path) -> None:
    parameters = summary(output)["runs"][-1]["parameters"]
    names = [f"{kind}_{wheel}" for kind in ("radius", "distance", "angle") for wheel in "abc"]
    assert [item["name"] for item in parameters] == names
    for item in parameters:
        assert item["deviation_percent"] == pytest.approx(100 * (item["value"] / item["design"] - 1))
        assert item["unit"] == ("rad" if item["name"].startswith("angle") else "m")


def test_the_tables_of_runs_and_statistics_agree_with_the_summary(output: Path) -> None:
    table = pl.read_parquet(output / "runs.parquet").to_dicts()
    for row in table:
        row |= {name: json.loads(row[name]) for name in ("options", "parameters")}
    assert table == summary(output)["runs"]
    assert pl.read_parquet(output / "statistics.parquet").to_dicts() == summary(output)["statistics"]


def test_the_tables_of_errors_and_histories_agree_with_the_summary(output: Path) -> None:
    errors, history = (pl.read_parquet(output / f"{name}.parquet") for name in ("errors", "history"))
    for run in summary(output)["runs"]:
        own = (pl.col("label") == run["label"]) & (pl.col("seed") == run["seed"])
        for split in ("train", "validation"):
            of_split = errors.filter(own & (pl.col("split") == split))
            assert len(of_split) == 6
            assert of_split["cost"].mean() == pytest.approx(run[f"{split}_cost"], rel=1e-12)
            distances = np.hypot(of_split["x_error_m"], of_split["y_error_m"])
            assert distances.mean() == pytest.approx(run[f"{split}_position_m"], rel=1e-12)
            headings = of_split["heading_error_rad"].abs()
            assert headings.mean() == pytest.approx(run[f"{split}_heading_rad"], rel=1e-12)
        course = history.filter(own)
        assert course["best_cost"].is_sorted(descending=True)
        assert course["evaluations"].max() <= run["evaluations"]
        assert course["best_cost"][-1] == pytest.approx(run["train_cost"], rel=1e-12)


def test_tables_have_the_same_columns_when_no_run_has_an_answer(output: Path, tmp_path: Path) -> None:
    entries = [{"name": "closed_form", "parameterisation": "geometry"}]  # which it refuses
    compared_here(tmp_path, calibrators=entries)
    for name in ("runs", "errors", "history", "statistics"):
        schemas = [pl.read_parquet_schema(folder / f"{name}.parquet") for folder in (output, tmp_path)]
        types = [{column: kind for column, kind in schema.items() if column != "typical_seed"} for schema in schemas]
        assert types[0] == types[1]


def test_the_calibrations_evaluate_to_the_costs_in_the_summary(output: Path) -> None:
    dataset = compared_once().datasets["flower"]
    files = sorted((output / "calibrations").iterdir())
    assert [file.name for file in files] == ["flower-Eq._3.yaml", "flower-closed_form.yaml", "flower-search.yaml"]
    typical = {(entry["label"], entry["typical_seed"]) for entry in summary(output)["statistics"]}
    runs = {run["label"]: run for run in summary(output)["runs"] if (run["label"], run["seed"]) in typical}
    for file, label in zip(files, ("Eq. (3) [°]", "closed_form", "search"), strict=True):
        run, calibration = runs[label], read_calibration(file)
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
    compared_here(tmp_path, calibrators=entries)
    found = {file.stem for file in (tmp_path / "calibrations").iterdir()}
    assert found == {"flower-a_b", "flower-a_b-2", "flower-A_B-3", "flower-", "flower--2"}


def test_the_effective_config_spells_out_every_default_and_gives_the_same_runs(output: Path) -> None:
    text = (output / "config.yaml").read_text()
    for default in ("integration: arc", "programs: 50", "batch: 100", "search: crs", "pose_period: 0.25"):
        assert default in text
    for file in (output.parent / "small.yaml", output / "config.yaml"):
        config = effective_config(read_compare_config(file))
        keys = {run.key for run in make_plan(config, load_datasets(config))}
        assert {f"{key}.json" for key in keys} == {file.name for file in (output / "runs").iterdir()}


def test_results_go_to_a_folder_of_their_own_with_a_link_to_the_latest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folders = [prepare_output(CompareConfig.model_validate(small()), None).resolve() for _ in range(3)]
    assert len(set(folders)) == 3
    assert {folder.parent for folder in folders} == {tmp_path / "results" / "small"}
    assert (tmp_path / "results" / "small" / "latest").resolve() == folders[-1]


@pytest.mark.parametrize(
    ("output", "parts"),
    [
        (".", ["holds other files"]),  # the config's own folder
        ("file", ["is a file"]),
        ("file/deep/er", ["cannot be written", "is not a folder"]),
    ],
)
def test_no_file_is_overwritten_or_replaced_by_results(
    output: str, parts: list[str], command: Command, tmp_path: Path
) -> None:
    config = write_config(tmp_path)
    before = config.read_text()
    (tmp_path / "file").write_text("mine")
    assert_refused(command("compare", config, "--output", tmp_path / output), *parts)
    assert ((tmp_path / "file").read_text(), config.read_text()) == ("mine", before)


def test_the_folder_of_another_comparison_is_left_alone(command: Command, output: Path, tmp_path: Path) -> None:
    before = summary(output)
    run = command("compare", write_config(tmp_path, name="another"), "--output", output)
    assert_refused(run, "'small'", "'another'")
    run = command("compare", write_config(tmp_path, datasets={"d": {"simulate": flower()}}), "--output", output)
    assert_refused(run, "'flower'", "'d'", "--force")
    assert summary(output) == before


def test_a_file_of_somebody_else_among_the_calibrations_is_left_alone_even_by_force(
    command: Command, tmp_path: Path
) -> None:
    mine = tmp_path / "calibrations" / "closed_form.yaml"
    mine.parent.mkdir()
    mine.write_text("precious")
    config = write_config(tmp_path / "c", calibrators=["closed_form"])
    for arguments in (["--force"], []):
        assert command("compare", config, "-o", tmp_path, *arguments).returncode == 0
    assert mine.read_text() == "precious"
    assert {file.name for file in mine.parent.iterdir()} == {"closed_form.yaml", "flower-closed_form.yaml"}


def test_a_disk_that_is_full_after_the_runs_loses_none(tmp_path: Path) -> None:
    output = tmp_path / "out"
    compared_here(output, calibrators=["theoretical"])  # starts the fork server, which shall not inherit the limits
    (output / "report.html").unlink()
    (output / "summary.json").unlink()
    for size, file in ((3000, "summary.json"), (20_000, "report.html")):
        with disk_that_takes(size), pytest.raises(DataError, match=rf"{file}: cannot be written"):
            compared_here(output)
        assert not (output / file).exists()
        assert not list(output.rglob(".*"))
        assert len(list((output / "runs").glob("*.json"))) == 3


@pytest.mark.slow
@pytest.mark.parametrize(("size", "file", "kept"), [(100, "config.yaml", 0), (2500, "runs", 1)])
def test_what_a_full_disk_does_not_take_is_one_line(size: int, file: str, kept: int, tmp_path: Path) -> None:
    entry = {"name": "genetic", "options": {"generations": 100}}  # whose history is longer than the config
    config = write_config(tmp_path, calibrators=["theoretical", entry], budget={"evaluations": 20_000}, workers=1)
    output = tmp_path / "out"
    full = {"preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))}
    run = omnibench("compare", config, "--output", output, **full)
    assert (run.returncode, run.stdout) == (2, "")
    assert run.stderr.splitlines()[-1].startswith(f"error: {output / file}")
    assert "Traceback" not in run.stderr
    assert len(list(output.rglob("runs/*"))) == kept
