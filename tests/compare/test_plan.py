"""From a config, or a data set without one, to runs: what is refused in one line, and what is a run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from commands import (
    CONFIGS,
    ROOT,
    Command,
    Prepared,
    flower,
    refused,
    registries_restored,
    run_here,
    small,
    summary,
    write_config,
    write_plugin,
)
from config_robots import NAMES, experiment

from omnibench.compare.config import CompareConfig, effective_config, load_calibrators, read_compare_config
from omnibench.compare.plan import PlannedRun, load_datasets, make_plan
from omnibench.compare.recording_config import recording_config, suitable_calibrators
from omnibench.config import to_yaml
from omnibench.errors import OmnibenchError
from omnibench.simulate.simulate import simulate_dataset

COMPARISONS = [path for path in sorted(CONFIGS.glob("*.yaml")) if "calibrators:" in path.read_text(encoding="utf-8")]


def simulated(**changes: Any) -> dict[str, Any]:
    return {"datasets": {"flower": {"simulate": flower(**changes)}}}


def calibrator(name: str, **entry: Any) -> dict[str, Any]:
    return {"calibrators": [{"name": name, **entry}]}


def box(lower: float, upper: float) -> dict[str, Any]:
    return {"lower": [[lower] * 3] * 3, "upper": [[upper] * 3] * 3}


def planned(folder: Path, **changes: Any) -> list[PlannedRun]:
    """Everything that a comparison does before it runs anything."""
    config = read_compare_config(write_config(folder, **changes))
    load_calibrators(config.plugins, [entry.name for entry in config.calibrators])
    config = effective_config(config)
    return make_plan(config, load_datasets(config))


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"calibrtors": []}, "'calibrtors' 'calibrators'"),
        ({"budget": {"evalutions": 3}}, "'budget.evalutions' 'evaluations'"),
        ({"calibrators": [{"name": "crs", "optoins": {}}]}, "'calibrators.0.optoins' 'options'"),
        (simulated(sample_perid=1), "'datasets.flower.simulate.sample_perid' 'sample_period'"),
        ({"datasets": {"flower": {}}}, "datasets.flower: path, simulate, import none"),
        ({"datasets": {"flower": {"simulate": flower(), "path": "x"}}}, "path, simulate, import"),
        ({"datasets": {}}, "datasets:"),
        ({"calibrators": []}, "calibrators:"),
        ({"name": "../elsewhere"}, "name: pattern"),
        ({"name": ".."}, "name: pattern"),
        ({"seeds": [1, 1]}, "seeds: twice"),
        ({"seeds": [-1]}, "seeds: negative"),
        ({"seeds": [2**63]}, "seeds: 2^63"),
        ({"budget": {"evaluations": 0}}, "budget.evaluations: (given: 0)"),
        ({"budget": {"seconds": float("nan")}}, "budget.seconds:"),
        ({"box": "papr"}, "box"),
        ({"integration": "eular"}, "integration: 'euler' 'arc' 'eular'"),
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
    assert chosen.datasets["two"].import_ is not None
    assert chosen.datasets["two"].import_.source == tmp_path / "two"
    assert chosen.plugins == (tmp_path / "plugins", ROOT / "plugins")


def test_other_data_can_be_named_without_touching_the_config(tmp_path: Path) -> None:
    data = {"one": {"path": "one"}, "two": {"import": {"format": "csv", "source": "two"}}}
    config = write_config(tmp_path, datasets=data)
    (tmp_path / "a").mkdir()
    chosen = read_compare_config(config, {"one": tmp_path / "a", "two": tmp_path / "b"})
    assert chosen.datasets["one"].path == tmp_path / "a"
    assert chosen.datasets["two"].import_ is not None
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
    sets = {name: {"simulate": flower(sample_period=period)} for name, period in (("fine", 0.05), ("coarse", 0.1))}
    runs = planned(tmp_path, datasets=sets, calibrators=["theoretical", "closed_form"])
    assert {(run.dataset_name, run.label) for run in runs} == {
        (name, label) for name in sets for label in ("theoretical", "closed_form")
    }


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
    monkeypatch.setattr("omnibench.compare.recording_config._EVALUATIONS", 300)
    printed = command("compare", prepared.data, "-o", "out")
    assert printed.returncode == 0, printed.stderr
    first = printed.stderr.splitlines()[0]
    assert first.startswith("no config is given: theoretical, closed_form, crs, ")
    labels = {run["label"] for run in summary(Path("out"))["runs"]}
    assert labels == {"theoretical", "closed_form", "least_squares", "posterior", "trajectory_ml", *SEARCHES}
    config = CompareConfig.model_validate(yaml.safe_load(Path("out/config.yaml").read_text()))
    assert config.budget.evaluations == 300
    assert config.unidentified == "keep"


@pytest.mark.parametrize("name", NAMES)
def test_every_kind_of_robot_has_calibrators_that_suit(name: str) -> None:
    dataset = simulate_dataset(experiment(name), name).dataset
    names = suitable_calibrators(dataset)
    assert names[0] == "theoretical"
    assert {"closed_form", "trajectory_ml"} <= set(names)
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
    monkeypatch.setattr("omnibench.compare.recording_config.suitable_calibrators", lambda _: ["theoretical"])
    for day in ("day1", "day2"):
        shutil.copytree(prepared.data, day)
    by_glob = command("compare", "day*", "-o", "by_glob")
    one_by_one = command("compare", "day1", "day2", "--plugins", "none", "-o", "one_by_one")
    assert (by_glob.returncode, one_by_one.returncode) == (0, 0), by_glob.stderr + one_by_one.stderr
    (named,) = yaml.safe_load(Path("by_glob/config.yaml").read_text())["datasets"].values()
    assert [Path(path).name for path in named["path"]] == ["day1", "day2"]
    assert summary(Path("by_glob"))["runs"][0]["train_cost"] == summary(Path("one_by_one"))["runs"][0]["train_cost"]
