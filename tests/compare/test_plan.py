"""From a config to runs: what is refused in one line, and what is a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from commands import CONFIGS, ROOT, flower, omnibench, small, write_config

from omnibench.compare.config import CompareConfig, effective_config, load_calibrators, read_compare_config
from omnibench.compare.plan import PlannedRun, load_datasets, make_plan
from omnibench.config import to_yaml
from omnibench.errors import OmnibenchError

AWAY = {"lower": [[0.5] * 3] * 3, "upper": [[1.0] * 3] * 3}


def planned(folder: Path, **changes: Any) -> list[PlannedRun]:
    """Everything that a comparison does before it runs anything."""
    config = read_compare_config(write_config(folder, **changes))
    load_calibrators(config.plugins, [entry.name for entry in config.calibrators])
    config = effective_config(config)
    return make_plan(config, load_datasets(config))


def complaint(folder: Path, **changes: Any) -> str:
    with pytest.raises(OmnibenchError) as failure:
        planned(folder, **changes)
    assert "\n" not in str(failure.value)
    return str(failure.value)


COMPARISONS = [path for path in sorted(CONFIGS.glob("*.yaml")) if "calibrators:" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        (
            {"calibrtors": []},
            ["unknown key 'calibrtors'; did you mean 'calibrators'? known: backend, bootstrap, box, budget"],
        ),
        ({"budget": {"evalutions": 3}}, ["unknown key 'budget.evalutions'; did you mean 'evaluations'?"]),
        (
            {"calibrators": [{"name": "crs", "optoins": {}}]},
            ["unknown key 'calibrators.0.optoins'; did you mean 'options'? known: box, label, limits, name, options"],
        ),
        (
            {"datasets": {"flower": {"simulate": flower(sample_perid=1)}}},
            ["unknown key 'datasets.flower.simulate.sample_perid'; did you mean 'sample_period'?"],
        ),
        ({"datasets": {"flower": {}}}, ["datasets.flower: give one of path, simulate, import (given: none)"]),
        (
            {"datasets": {"flower": {"simulate": flower(), "path": "x"}}},
            ["give one of path, simulate, import (given: path, simulate)"],
        ),
        ({"datasets": {}}, ["datasets: ", "at least 1 item"]),
        ({"calibrators": []}, ["calibrators: ", "at least 1 item"]),
        ({"name": "../elsewhere"}, ["name: String should match pattern"]),
        ({"name": ".."}, ["name: String should match pattern"]),
        ({"seeds": [1, 1]}, ["seeds: a seed is given twice"]),
        ({"seeds": [-1]}, ["seeds: seeds must not be negative"]),
        ({"seeds": [2**63]}, ["seeds: ", "below 2^63"]),
        ({"budget": {"evaluations": 0}}, ["budget.evaluations: ", "greater than 0 (given: 0)"]),
        ({"budget": {"seconds": float("nan")}}, ["budget.seconds: "]),
        ({"box": "papr"}, ["box"]),
        ({"integration": "eular"}, ["integration: Input should be 'euler' or 'arc' (given: 'eular')"]),
        (
            {"calibrators": ["closed_from"]},
            ["calibrators.0: unknown calibrator 'closed_from'; did you mean 'closed_form'? known: closed_form, "],
        ),
        (
            {"calibrators": ["crs", {"name": "closed_form", "options": {"tolerence": 1}}]},
            [
                "calibrators.1: calibrator 'closed_form': unknown key 'tolerence'; did you mean 'tolerance'?",
                "known: programs, tolerance",
            ],
        ),
        (
            {"calibrators": [{"name": "closed_form", "options": {"tolerance": -1}}]},
            ["calibrators.0: calibrator 'closed_form': tolerance: Input should be greater than 0 (given: -1)"],
        ),
        (
            {"calibrators": [{"name": "parametric", "options": {"search": "parametric"}}]},
            ["calibrators.0: parametric: search must be another calibrator"],
        ),
        (
            {"cost": "final_pos"},
            ["unknown cost 'final_pos'; did you mean 'final_pose'? known: final_heading, final_pose"],
        ),
        ({"cost": {"name": "final_pose", "options": {"x": 1}}}, ["cost 'final_pose': unknown key 'x'; known: none"]),
        ({"plugins": ["nowhere"]}, ["plug-in folder ", "nowhere does not exist; make it or name another"]),
        (
            {"box": AWAY, "calibrators": ["closed_form"]},
            ["calibrator 'closed_form': box: start value -0.0854478 of m11 is outside [0.5, 1]; widen the box"],
        ),
        (
            {"calibrators": [{"name": "parametric", "limits": {"radius": [0.1, 0.2]}}]},
            ["calibrator 'parametric': box: start value 0.148 of radius_a is outside [0.1628, 0.1776]; widen the box"],
        ),
        (
            {"calibrators": [{"name": "crs", "box": {"lower": [[0]], "upper": [[1]]}}]},
            ["calibrator 'crs': box: lower and upper must have 3 rows of 3 values"],
        ),
        (
            {"calibrators": [{"name": "crs", "box": {"lower": [[1.0] * 3] * 3, "upper": [[-1.0] * 3] * 3}}]},
            ["box: lower bound 1 of m11 is above its upper bound -1"],
        ),
        ({"calibrators": ["crs", "crs"]}, ["two entries are called 'crs'; give one a label of its own"]),
        (
            {"calibrators": [{"name": "crs", "label": "a\u00a0b"}]},
            ["calibrators.0.label: contains characters that cannot"],
        ),
        ({"calibrators": [{"name": "crs", "label": "x" * 61}]}, ["calibrators.0.label: String should have at most 60"]),
        ({"bootstrap": {"resamples": 10**9}}, ["bootstrap.resamples: Input should be less than or equal to 100000"]),
        ({"datasets": {"flower": {"path": "nowhere"}}}, ["nowhere: no such folder; a data set is a folder with"]),
        (
            {"datasets": {"flower": {"import": {"format": "optiodum", "source": "."}}}},
            ["unknown importer 'optiodum'; did you mean 'optiodom'?"],
        ),
        (
            {"datasets": {"flower": {"import": {"format": "optiodom", "source": "nowhere"}}}},
            ["nowhere: no such file or folder"],
        ),
    ],
    ids=lambda value: json.dumps(value)[:60] if isinstance(value, dict) else "",
)
def test_a_mistake_in_a_config_is_one_line(changes: dict[str, Any], parts: list[str], tmp_path: Path) -> None:
    found = complaint(tmp_path, **changes)
    for part in parts:
        assert part in found


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("[" * 3000, "exceeded maximum nesting depth"),
        ("name: 2023-99-99\n", "not valid YAML: month must be in 1..12"),
        ("name: 0b_\n", "not valid YAML: invalid literal for int()"),
        ("name: [\n", "not valid YAML: "),
        ("", "keys 'name', 'datasets' and 'calibrators' are missing"),
        ("- a\n", "expected keys and values, found list"),
    ],
)
def test_a_file_that_is_no_config_is_one_line(text: str, part: str, tmp_path: Path) -> None:
    (tmp_path / "broken.yaml").write_text(text)
    with pytest.raises(OmnibenchError) as failure:
        read_compare_config(tmp_path / "broken.yaml")
    assert str(failure.value).startswith(f"{tmp_path / 'broken.yaml'}: ")
    assert part in str(failure.value)
    assert "\n" not in str(failure.value)


@pytest.fixture(scope="module")
def schema() -> dict[str, Any]:
    document: dict[str, Any] = json.loads(omnibench("schema").stdout)
    return document


@pytest.mark.parametrize("config", COMPARISONS, ids=lambda path: path.stem)
def test_a_config_that_we_ship_keeps_to_the_schema_that_editors_get(config: Path, schema: dict[str, Any]) -> None:
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(yaml.safe_load(config.read_text()), schema, jsonschema.Draft202012Validator)


@pytest.mark.parametrize("mistake", [{"calibrtors": []}, {"seeds": []}, {"calibrators": [3]}, {"cost": {"nam": "x"}}])
def test_the_schema_refuses_what_reading_refuses(mistake: dict[str, Any], schema: dict[str, Any]) -> None:
    jsonschema.validate(small(), schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(small(**mistake), schema)


@pytest.mark.parametrize("config", COMPARISONS, ids=lambda path: path.stem)
def test_a_config_that_we_ship_is_read_with_all_its_calibrators(config: Path) -> None:
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


def test_data_named_for_a_simulation_replace_it(tmp_path: Path) -> None:
    chosen = read_compare_config(write_config(tmp_path), {"": tmp_path / "data"})
    assert (chosen.datasets["flower"].path, chosen.datasets["flower"].simulate) == (tmp_path / "data", None)


def test_data_without_a_name_among_several_sets_are_refused(tmp_path: Path) -> None:
    config = write_config(tmp_path, datasets={name: {"path": name} for name in ("one", "two")})
    with pytest.raises(OmnibenchError, match="has several data sets; say which: --data NAME="):
        read_compare_config(config, {"": tmp_path})
    with pytest.raises(OmnibenchError, match=r"unknown data set 'on'; did you mean 'one'\? known: one, two"):
        read_compare_config(config, {"on": tmp_path})


def test_an_empty_training_split_is_refused(tmp_path: Path) -> None:
    run = omnibench("simulate", write_config(tmp_path), "-o", tmp_path / "data", "--format", "csv")
    assert run.returncode == 0, run.stderr
    table = tmp_path / "data" / "trajectories.csv"
    table.write_text(table.read_text().replace(",train,train", ",validation,train"))
    found = complaint(tmp_path, datasets={"flower": {"path": "data"}})
    assert found == "data set flower: the training split is empty; set split to train for some trajectories"


def test_only_what_is_random_is_run_with_every_seed(tmp_path: Path) -> None:
    runs = planned(tmp_path, seeds=[3, 5, 7])
    assert [(run.label, run.seed) for run in runs] == [
        ("theoretical", 3),
        ("closed_form", 3),
        ("search", 3),
        ("search", 5),
        ("search", 7),
    ]


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
