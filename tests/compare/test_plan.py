"""From a config, or a data set without one, to runs, and what a comparison leaves behind."""

import json
import shutil
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import polars as pl
import pytest
import yaml
from commands import (
    CONFIGS,
    ROOT,
    Command,
    Prepared,
    assert_refused,
    compared_here,
    compared_once,
    disk_that_takes,
    flower,
    refused,
    registries_restored,
    run_here,
    search,
    small,
    summary,
    write_config,
    write_plugin,
)
from config_robots import NAMES, experiment

from omnibench.compare.config import (
    CertificateChoice,
    CompareConfig,
    effective_config,
    load_calibrators,
    read_compare_config,
    recording_config,
    suitable_calibrators,
)
from omnibench.compare.output import prepare_output
from omnibench.compare.plan import PlannedFit, load_robots, plan_fits
from omnibench.compare.score import certify
from omnibench.config import to_yaml
from omnibench.errors import DataError, OmnibenchError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.evaluate import evaluate
from omnibench.robot.calibration import read_calibration
from omnibench.simulate.source import simulate_dataset

COMPARISONS = [path for path in sorted(CONFIGS.glob("*.yaml")) if "calibrators:" in path.read_text(encoding="utf-8")]


def simulated(**changes: Any) -> dict[str, Any]:
    return {"datasets": {"flower": {"simulate": flower(**changes)}}}


def calibrator(name: str, **entry: Any) -> dict[str, Any]:
    return {"calibrators": [{"name": name, **entry}]}


def box(lower: float, upper: float) -> dict[str, Any]:
    return {"lower": [[lower] * 3] * 3, "upper": [[upper] * 3] * 3}


def planned(folder: Path, **changes: Any) -> list[PlannedFit]:
    """Everything that a comparison does before it runs anything."""
    config = read_compare_config(write_config(folder, **changes))
    load_calibrators(config.plugins, [entry.name for entry in config.calibrators])
    config = effective_config(config)
    return plan_fits(config, load_robots(config)[0])


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"calibrtors": []}, "'calibrtors' 'calibrators'"),
        (simulated(sample_perid=1), "'datasets.flower.simulate.sample_perid' 'sample_period'"),
        ({"datasets": {"flower": {}}}, "datasets.flower: path, simulate, import none"),
        ({"datasets": {"flower": {"simulate": flower(), "path": "x"}}}, "path, simulate, import"),
        ({"datasets": {}}, "datasets:"),
        ({"calibrators": []}, "calibrators:"),
        ({"name": "../elsewhere"}, "name: pattern"),
        ({"seeds": [1, 1]}, "seeds: twice"),
        ({"seeds": [-1]}, "seeds: negative"),
        ({"seeds": [2**63]}, "seeds: 2^63"),
        ({"budget": {"evaluations": 0}}, "budget.evaluations: (given: 0)"),
        ({"budget": {"seconds": float("nan")}}, "budget.seconds:"),
        ({"box": "papr"}, "box"),
        ({"calibrators": ["closed_from"]}, "calibrators.0: 'closed_from' 'closed_form'"),
        (calibrator("closed_form", options={"tolerence": 1}), "calibrators.0: 'closed_form' 'tolerence' 'tolerance'"),
        (calibrator("closed_form", options={"tolerance": -1}), "calibrators.0: 'closed_form' tolerance: (given: -1)"),
        (calibrator("parametric", options={"search": "parametric"}), "calibrators.0: parametric: search"),
        (calibrator("parametric", limits={"radius": [0.1, 0.2]}), "'parametric' radius_a [0.1628, 0.1776]"),
        (calibrator("closed_form", box=box(0.5, 1.0)), "'closed_form' m11 [0.5, 1]"),
        (calibrator("crs", box={"lower": [[0]], "upper": [[1]]}), "'crs' box: 3"),
        (calibrator("crs", box=box(1.0, -1.0)), "box: m11 lower 1 upper -1"),
        (calibrator("crs", label="a\u00a0b"), "calibrators.0.label:"),
        (calibrator("crs", label="x" * 61), "calibrators.0.label: 60"),
        ({"calibrators": ["crs", "crs"]}, "'crs' label"),
        ({"cost": "final_pos"}, "'final_pos' 'final_pose'"),
        ({"cost": {"name": "final_pose", "options": {"x": 1}}}, "'final_pose' 'x'"),
        ({"plugins": ["nowhere"]}, "plug-in nowhere"),
        ({"bootstrap": {"resamples": 10**9}}, "bootstrap.resamples: 100000"),
        ({"datasets": {"flower": {"path": "nowhere"}}}, "nowhere:"),
        ({"datasets": {"flower": {"import": {"format": "optiodum", "source": "."}}}}, "'optiodum' 'optiodom'"),
        ({"datasets": {"flower": {"import": {"format": "optiodom", "source": "nowhere"}}}}, "nowhere:"),
    ],
    ids=lambda value: json.dumps(value)[:60] if isinstance(value, dict) else "",
)
def test_a_mistake_in_a_config_is_one_line_that_names_it(changes: dict[str, Any], parts: str, tmp_path: Path) -> None:
    with refused(OmnibenchError, *parts.split()):
        planned(tmp_path, **changes)


@pytest.mark.parametrize("text", ["[" * 3000, "name: 2023-99-99\n", "name: 0b_\n", "name: [\n", "", "- a\n"])
def test_a_file_that_is_no_config_is_one_line(text: str, tmp_path: Path) -> None:
    (tmp_path / "broken.yaml").write_text(text)
    with refused(OmnibenchError, start=f"{tmp_path / 'broken.yaml'}: "):
        read_compare_config(tmp_path / "broken.yaml")


@pytest.fixture(scope="module")
def schema(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(run_here("schema", cwd=tmp_path_factory.mktemp("schema")).stdout)
    return document


@pytest.mark.parametrize("mistake", [{"calibrtors": []}, {"seeds": []}, {"calibrators": [3]}, {"cost": {"nam": "x"}}])
def test_the_schema_refuses_what_reading_refuses(mistake: dict[str, Any], schema: dict[str, Any]) -> None:
    jsonschema.validate(small(), schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(small(**mistake), schema)


@pytest.mark.parametrize("config", COMPARISONS, ids=lambda path: path.stem)
def test_a_config_that_we_ship_keeps_to_the_schema_and_is_read_with_all_its_calibrators(
    config: Path, schema: dict[str, Any]
) -> None:
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(yaml.safe_load(config.read_text()), schema, jsonschema.Draft202012Validator)
    chosen = read_compare_config(config)
    assert load_calibrators(chosen.plugins, [entry.name for entry in chosen.calibrators]) == []
    assert CompareConfig.model_validate(yaml.safe_load(to_yaml(effective_config(chosen)))) == effective_config(chosen)


def test_paths_are_relative_to_the_config_not_to_where_one_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = {"one": {"path": "data/one"}, "two": {"import": {"format": "csv", "source": "../two"}}}
    config = write_config(tmp_path / "configs", datasets=data, plugins=["../plugins", str(ROOT / "plugins")])
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    chosen = read_compare_config(Path("../configs") / config.name)
    assert chosen.datasets["one"].path == tmp_path / "configs" / "data" / "one"
    assert chosen.datasets["two"].import_.source == tmp_path / "two"
    assert chosen.plugins == (tmp_path / "plugins", ROOT / "plugins")


def test_other_data_can_be_named_without_touching_the_config(tmp_path: Path) -> None:
    data = {"one": {"path": "one"}, "two": {"import": {"format": "csv", "source": "two"}}}
    config = write_config(tmp_path, datasets=data)
    (tmp_path / "a").mkdir()
    chosen = read_compare_config(config, {"one": tmp_path / "a", "two": tmp_path / "b"})
    assert chosen.datasets["one"].path == tmp_path / "a"
    assert chosen.datasets["two"].import_.source == tmp_path / "b"
    with pytest.raises(OmnibenchError, match="--data NAME="):
        read_compare_config(config, {"": tmp_path})
    with pytest.raises(OmnibenchError, match=r"'on'.*'one'.*two"):
        read_compare_config(config, {"on": tmp_path})
    chosen = read_compare_config(write_config(tmp_path), {"": tmp_path / "data"})
    assert (chosen.datasets["flower"].path, chosen.datasets["flower"].simulate) == (tmp_path / "data", None)


def test_an_empty_training_split_is_refused(tmp_path: Path) -> None:
    run_here("simulate", write_config(tmp_path), "-o", tmp_path / "data", "--format", "csv", cwd=tmp_path)
    table = tmp_path / "data" / "trajectories.csv"
    table.write_text(table.read_text().replace(",train,train", ",validation,train"))
    with refused(OmnibenchError, start="data set flower: the training split is empty"):
        planned(tmp_path, datasets={"flower": {"path": "data"}})


def test_only_what_is_random_is_run_with_every_seed(tmp_path: Path) -> None:
    runs = planned(tmp_path, seeds=[3, 5, 7])
    once, often = [("theoretical", 3), ("closed_form", 3)], [("search", seed) for seed in (3, 5, 7)]
    assert [(run.label, run.settings.seed) for run in runs] == [*once, *often]


def test_every_data_set_is_met_by_every_calibrator(tmp_path: Path) -> None:
    sets = {name: {"simulate": flower(sample_period=period)} for name, period in (("coarse", 0.1), ("fine", 0.05))}
    runs = planned(tmp_path, datasets=sets, calibrators=["theoretical", "closed_form"])
    labels = [(run.robot.name, run.label) for run in runs]
    assert labels == [(name, label) for name in sets for label in ("theoretical", "closed_form")]


def test_labels_tell_boxes_and_parameterisations_apart(tmp_path: Path) -> None:
    entries = ["crs", {"name": "crs", "box": "paper"}, {"name": "crs", "parameterisation": "geometry"}]
    entries += [{"name": "crs", "label": "mine"}]
    runs = planned(tmp_path, calibrators=entries)
    assert [(run.label, run.box_name) for run in runs] == [
        ("crs", "row"),
        ("crs (paper box)", "paper"),
        ("crs (geometry)", "limits"),
        ("mine", "row"),
    ]


SEARCHES = {"crs", "genetic", "isres", "random_search", "parametric"}


def test_a_data_set_is_compared_by_all_calibrators_that_suit_it(
    command: Command, prepared: Prepared, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("omnibench.compare.config._QUICK_EVALUATIONS", 300)
    proof = CertificateChoice(seconds=0.5)
    monkeypatch.setattr("omnibench.compare.run.certify", lambda _, *runs: certify(proof, *runs))
    printed = command("compare", prepared.data, "-o", "out")
    assert printed.returncode == 0, printed.stderr
    first = printed.stderr.splitlines()[0]
    assert first.startswith("no config is given: theoretical, closed_form, crs, ")
    labels = {run["label"] for run in summary(Path("out"))["runs"]}
    assert labels == {"theoretical", "closed_form", "least_squares", "map", *SEARCHES}
    config = CompareConfig.model_validate(yaml.safe_load(Path("out/config.yaml").read_text()))
    assert config.budget.evaluations == 300
    assert config.unidentified == "keep"


@pytest.mark.parametrize("name", NAMES)
def test_every_kind_of_robot_has_calibrators_that_suit(name: str) -> None:
    dataset = simulate_dataset(experiment(name), name).dataset
    names = suitable_calibrators(dataset)
    assert names[0] == "theoretical"
    assert {"closed_form", "map"} <= set(names)
    assert "published" not in names


def test_a_plugins_calibrator_takes_part(prepared: Prepared, tmp_path: Path) -> None:
    body = """
class Mine(Calibrator):
    '''Starts and stays.'''
    def calibrate(self, problem):
        return Solution(problem.start, "stays")
calibrators.register("mine")(Mine)
"""
    with registries_restored():
        config = recording_config(prepared.data, [write_plugin(tmp_path / "plugins", "mine", body)])
    assert "mine" in [entry.name for entry in config.calibrators]


def test_folders_of_a_data_set_are_compared_as_one(
    command: Command, prepared: Prepared, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("omnibench.compare.config.suitable_calibrators", lambda _: ["theoretical"])
    for day in ("day1", "day2"):
        shutil.copytree(prepared.data, day)
    by_glob = command("compare", "day*", "-o", "by_glob")
    one_by_one = command("compare", "day1", "day2", "--plugins", "none", "-o", "one_by_one")
    assert (by_glob.returncode, one_by_one.returncode) == (0, 0), by_glob.stderr + one_by_one.stderr
    (named,) = yaml.safe_load(Path("by_glob/config.yaml").read_text())["datasets"].values()
    assert [Path(path).name for path in named["path"]] == ["day1", "day2"]
    assert summary(Path("by_glob"))["runs"][0]["train_cost"] == summary(Path("one_by_one"))["runs"][0]["train_cost"]


# What a comparison leaves behind: summary.json, tables, calibrations, and a config that can be run again.

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
def results() -> Path:
    return compared_once().output


def test_the_summary_and_its_runs_have_the_documented_keys_and_types(results: Path) -> None:
    found = summary(results)
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


def test_the_parametric_run_reports_its_parameters_and_their_deviations(results: Path) -> None:
    parameters = summary(results)["runs"][-1]["parameters"]
    names = [f"{kind}_{wheel}" for kind in ("radius", "distance", "angle") for wheel in "abc"]
    assert [item["name"] for item in parameters] == names
    for item in parameters:
        assert item["deviation_percent"] == pytest.approx(100 * (item["value"] / item["design"] - 1))
        assert item["unit"] == ("rad" if item["name"].startswith("angle") else "m")


def test_the_tables_of_runs_and_statistics_agree_with_the_summary(results: Path) -> None:
    table = pl.read_parquet(results / "runs.parquet").to_dicts()
    for row in table:
        row |= {name: json.loads(row[name]) for name in ("options", "parameters")}
    assert table == summary(results)["runs"]
    assert pl.read_parquet(results / "statistics.parquet").to_dicts() == summary(results)["statistics"]


def test_the_tables_of_errors_and_histories_agree_with_the_summary(results: Path) -> None:
    errors, history = (pl.read_parquet(results / f"{name}.parquet") for name in ("errors", "history"))
    for run in summary(results)["runs"]:
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


def test_tables_have_the_same_columns_when_no_run_has_an_answer(results: Path, tmp_path: Path) -> None:
    entries = [{"name": "closed_form", "parameterisation": "geometry"}]  # which it refuses
    compared_here(tmp_path, calibrators=entries)
    for name in ("runs", "errors", "history", "statistics"):
        schemas = [pl.read_parquet_schema(folder / f"{name}.parquet") for folder in (results, tmp_path)]
        types = [{column: kind for column, kind in schema.items() if column != "typical_seed"} for schema in schemas]
        assert types[0] == types[1]


def test_the_calibrations_evaluate_to_the_costs_in_the_summary(results: Path) -> None:
    dataset = compared_once().datasets["flower"]
    files = sorted((results / "calibrations").iterdir())
    assert [file.name for file in files] == ["flower-Eq._3.yaml", "flower-closed_form.yaml", "flower-search.yaml"]
    typical = {(entry["label"], entry["typical_seed"]) for entry in summary(results)["statistics"]}
    runs = {run["label"]: run for run in summary(results)["runs"] if (run["label"], run["seed"]) in typical}
    for file, label in zip(files, ("Eq. (3) [°]", "closed_form", "search"), strict=True):
        run, calibration = runs[label], read_calibration(file)
        for split, errors in evaluate(calibration, dataset).splits.items():
            if split != "all":
                assert errors.cost == pytest.approx(run[f"{split}_cost"], rel=1e-12)
                assert errors.position_mean_m == pytest.approx(run[f"{split}_position_m"], rel=1e-12)
                assert errors.heading_mean_rad == pytest.approx(run[f"{split}_heading_rad"], rel=1e-12)
        assert calibration.provenance.training_cost == run["train_cost"]
        assert calibration.provenance.fitted == dataset.fingerprints("train")


@pytest.mark.parametrize("name", ["closed_form", "map"])
def test_a_comparison_writes_the_physical_parameters_that_calibrate_does(name: str, tmp_path: Path) -> None:
    dataset = compared_here(tmp_path, calibrators=[name]).datasets["flower"]
    expected = calibrate(dataset, name, cost="final_pose").calibration.parameters
    found = read_calibration(tmp_path / "calibrations" / f"flower-{name}.yaml").parameters
    assert set(found) == set(expected)
    assert ("mount_x" in found) is (name == "map")
    for parameter, wanted in expected.items():
        assert found[parameter].value == pytest.approx(wanted.value, rel=1e-6, abs=1e-9)
        assert found[parameter].low == pytest.approx(wanted.low, rel=1e-4, abs=1e-9)


def test_calibrations_of_labels_that_look_alike_do_not_overwrite_each_other(tmp_path: Path) -> None:
    entries = [search(label, count) for label, count in (("a b", 10), ("a_b", 20), ("A/B", 30), ("最", 40), ("良", 50))]
    compared_here(tmp_path, calibrators=entries)
    found = {file.stem for file in (tmp_path / "calibrations").iterdir()}
    assert found == {"flower-a_b", "flower-a_b-2", "flower-A_B-3", "flower-", "flower--2"}


def test_the_effective_config_spells_out_every_default_and_gives_the_same_runs(results: Path) -> None:
    text = (results / "config.yaml").read_text()
    for default in ("integration: arc", "programs: 50", "batch: 100", "search: crs", "pose_period: 0.25"):
        assert default in text
    for file in (results.parent / "small.yaml", results / "config.yaml"):
        config = effective_config(read_compare_config(file))
        keys = {run.key for run in plan_fits(config, load_robots(config)[0])}
        assert {f"{key}.json" for key in keys} == {file.name for file in (results / "runs").iterdir()}


def test_results_go_to_a_folder_of_their_own_with_a_link_to_the_latest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folders = [prepare_output(CompareConfig.model_validate(small()), None).resolve() for _ in range(3)]
    assert len(set(folders)) == 3
    assert {folder.parent for folder in folders} == {tmp_path / "results" / "small"}
    assert (tmp_path / "results" / "small" / "latest").resolve() == folders[-1]


def test_the_folder_of_another_comparison_is_left_alone(command: Command, results: Path, tmp_path: Path) -> None:
    before = summary(results)
    run = command("compare", write_config(tmp_path, name="another"), "--output", results)
    assert_refused(run, "'small'", "'another'")
    run = command("compare", write_config(tmp_path, datasets={"d": {"simulate": flower()}}), "--output", results)
    assert_refused(run, "'flower'", "'d'", "--force")
    assert summary(results) == before


def test_somebodys_file_among_the_calibrations_is_left_alone_even_by_force(command: Command, tmp_path: Path) -> None:
    mine = tmp_path / "calibrations" / "closed_form.yaml"
    mine.parent.mkdir()
    mine.write_text("precious")
    config = write_config(tmp_path / "c", calibrators=["closed_form"])
    for arguments in (["--force"], []):
        assert command("compare", config, "-o", tmp_path, *arguments).returncode == 0
    assert mine.read_text() == "precious"
    assert {file.name for file in mine.parent.iterdir()} == {"closed_form.yaml", "flower-closed_form.yaml"}


def test_a_disk_that_is_full_after_the_runs_loses_none(tmp_path: Path) -> None:
    results = tmp_path / "out"
    compared_here(results, calibrators=["theoretical"])  # starts the fork server, which shall not inherit the limits
    (results / "report.html").unlink()
    (results / "summary.json").unlink()
    for size, file in ((3000, "summary.json"), (20_000, "report.html")):
        with disk_that_takes(size), pytest.raises(DataError, match=rf"{file}: cannot be written"):
            compared_here(results)
        assert not (results / file).exists()
        assert not list(results.rglob(".*"))
        assert len(list((results / "runs").glob("*.json"))) == 3


def test_a_strangers_method_is_compared_and_the_fits_of_the_others_are_kept_for_the_next(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    body = """
class Mine(Calibrator):
    '''Starts and stays.'''
    stochastic = False
    def calibrate(self, problem):
        return Solution(problem.start, "{word}")
calibrators.register("mine")(Mine)
"""
    config = write_config(tmp_path)
    for word, new in (("stays", 4), ("remains", 1)):
        folder = write_plugin(tmp_path / word, "mine", body.format(word=word))
        with registries_restored():
            run = command("compare", config, "--add", folder / "mine.py", "-o", tmp_path / f"out-{word}")
        assert run.returncode == 0, run.stderr
        fitted = [line for line in run.stderr.splitlines() if line.startswith("[") and "kept" not in line]
        assert len(fitted) == new
        assert summary(tmp_path / f"out-{word}")["runs"][-1]["reason"] == word
    none = write_plugin(tmp_path / "none", "none", "VALUE = 1")
    refusal = command("compare", config, "--add", none / "none.py")
    assert refusal.returncode == 2
    assert "registers no calibrator" in refusal.stderr


def test_the_courses_of_searches_are_written_as_iohinspector_reads_them(command: Command, tmp_path: Path) -> None:
    run = command("compare", write_config(tmp_path), "-o", tmp_path / "out", "--traces", tmp_path / "traces")
    assert run.returncode == 0, run.stderr
    (file,) = (tmp_path / "traces" / "flower" / "search").glob("*.json")
    head = json.loads(file.read_text())
    (scenario,) = head["scenarios"]
    (searched,) = (each for each in summary(tmp_path / "out")["runs"] if each["label"] == "search")
    assert scenario["dimension"] == 9
    assert scenario["runs"][0]["evals"] == searched["evaluations"]
    first, *rows = (file.parent / scenario["path"]).read_text().splitlines()
    assert first == "evaluations raw_y"
    assert float(rows[-1].split()[1]) == pytest.approx(searched["train_cost"], rel=1e-12)
    there = command("compare", tmp_path / "small.yaml", "-o", tmp_path / "out", "--traces", tmp_path / "small.yaml")
    assert there.returncode == 2
    assert "Traceback" not in there.stderr
    assert "small.yaml" in there.stderr.splitlines()[-1]
    assert_refused(command("compare", CONFIGS / "real_robots.yaml", "--data", tmp_path, "--traces", "t"), "--traces")
