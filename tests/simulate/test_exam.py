"""Exams: sets that show nothing of what is hidden, a key that only its seed opens, and marks."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Command, assert_refused, refused, succeeded

from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, Interrupted, OmnibenchError
from omnibench.registry import effects
from omnibench.robot.calibration import EffectTerm
from omnibench.robot.kinematics import class_of
from omnibench.simulate.exam import LEVELS, ROBOTS, EffectView, ExamOptions, draw_sets, key_hash, make_exam, open_exam
from omnibench.simulate.exam_marks import answer_schema, mark_exam, rate, read_answers, shows_in

SEED = 5
SMALL: dict[str, Any] = {"sets": 2, "robots": "differential,omni", "size": "strong", "runs": 12}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exam") / "exam"
    assert make_exam(folder, ExamOptions(**SMALL), answer_schema(), SEED) == SEED
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def answers(folder: Path, **content: Any) -> Path:
    file = folder / "answers.json"
    file.write_text(json.dumps({name.replace("set", "set-00"): answer for name, answer in content.items()}))
    return file


def hidden_in(*names: str) -> Any:
    """A config in which effects of these names are hidden."""
    config = next(iter(draw_sets(ExamOptions(**SMALL), SEED).values()))
    terms = tuple(EffectTerm(name=name) for name in names)
    return config.model_copy(update={"truth": config.truth.model_copy(update={"effects": terms})})


# Sets


def test_sets_are_plain_data_sets_without_a_trace_of_the_truth(made: Path) -> None:
    truths = open_exam(made, SEED)
    assert any(config.truth.effects for config in truths.values())
    for name, config in truths.items():
        dataset = load_dataset(made / name)
        assert (dataset.name, dataset.simulated, dataset.robot) == (name, True, config.robot)
        assert [len(dataset.split(split)) for split in ("train", "validation")] == [12, 12]
        text = b"\n".join(contents(made / name).values())
        assert not [entry.name for entry in effects.entries() if entry.name.encode() in text]
        values = [value for term in config.truth.effects for value in term.parameters.values()]
        long = [repr(value) for value in values if len(repr(abs(value)).strip("0.")) > 2]  # 0.32 may be a time, too
        assert not [value for value in long if value.encode() in text]
        seeds = [config.train.seed, config.truth.tolerances.seed if config.truth.tolerances else 0]
        assert not [seed for seed in seeds if str(seed).encode() in text]


def test_the_same_seed_and_options_make_the_same_bytes(made: Path, tmp_path: Path) -> None:
    make_exam(tmp_path / "again", ExamOptions(**SMALL), answer_schema(), SEED)
    assert contents(tmp_path / "again") == contents(made)
    configs, sealed = draw_sets(ExamOptions(**SMALL), SEED), json.loads((made / "sealed.json").read_text())
    assert key_hash(configs, SEED) == sealed["key_sha256"]
    assert key_hash(configs, SEED + 1) != sealed["key_sha256"]  # truths that are guessed do not give the hash


@pytest.mark.parametrize("kind", ROBOTS)
def test_every_class_of_robot_drives_and_shows_an_effect(kind: str) -> None:
    options = ExamOptions(sets=1, robots=(kind,), effects=("floor_drift",), size="weak", runs=12)
    configs = [config for seed in range(2) for config in draw_sets(options, seed).values()]
    assert {class_of(config.robot) for config in configs} == {kind}
    assert {term.name for config in configs for term in config.truth.effects} == {"floor_drift"}
    for config in configs:
        assert config.left_out == ()
        assert config.runs == 24


def test_an_effect_has_the_non_centrality_of_its_size_and_a_reference_effect_none() -> None:
    options = ExamOptions(sets=1, robots=("omni",), effects=("floor_drift",), size="strong", runs=12)
    configs = [config for seed in range(4) for config in draw_sets(options, seed).values()]
    config = next(config for config in configs if config.truth.effects)
    view = EffectView(config)
    reached = view.noncentrality(view.signature(config.truth.effects[0]))
    assert reached == pytest.approx(LEVELS["strong"], rel=0.05)
    absorbed = view.signature(EffectTerm(name="lidar_yaw", parameters={"beta": 1e-4}))
    assert view.noncentrality(absorbed) < 1e-3 * float(absorbed @ absorbed)


def test_an_exam_of_effects_that_no_set_shows_is_refused() -> None:
    options = ExamOptions(sets=9, robots=("omni",), effects=("lidar_yaw", "motor_gain", "icr_shift"), runs=12)
    with refused(ConfigError, "no effect that is allowed shows", "--effects"):
        draw_sets(options, 1)


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        ({"robots": "differental"}, ["'differental'", "did you mean 'differential'"]),
        ({"effects": ["heading_drift,floor_drft"]}, ["'floor_drft'", "did you mean 'floor_drift'"]),
        ({"effects": "reference_clock_drift"}, ["unknown effect"]),
    ],
)
def test_unknown_names_are_refused_with_the_nearest(options: dict[str, Any], parts: list[str]) -> None:
    with refused(OmnibenchError, *parts):
        ExamOptions(**options)


# The key


def test_a_wrong_seed_opens_nothing(made: Path) -> None:
    with refused(ConfigError, "--seed 6 does not open", "sealed.json"):
        open_exam(made, SEED + 1)


def test_a_changed_option_in_sealed_json_breaks_the_seal(made: Path, tmp_path: Path) -> None:
    sealed = json.loads((made / "sealed.json").read_text())
    sealed["options"]["size"] = "weak"
    (tmp_path / "sealed.json").write_text(json.dumps(sealed | {"omnibench": "0.0.1"}))
    with refused(ConfigError, "does not open", "made by omnibench 0.0.1"):
        open_exam(tmp_path, SEED)


def test_a_drawn_seed_is_in_no_file(tmp_path: Path) -> None:
    seed = make_exam(tmp_path / "exam", ExamOptions(**SMALL | {"sets": 1}), answer_schema())
    assert seed > 2**32
    assert str(seed).encode() not in b"".join(contents(tmp_path / "exam").values())


def test_another_folder_or_exam_is_not_written_over(made: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    for folder, changes, seed, reason in (
        (tmp_path, {}, SEED, "holds other files"),
        (tmp_path / "notes.txt", {}, SEED, "holds other files"),
        (made, {}, None, "holds an exam; name a new folder"),
        (made, {"size": "weak"}, SEED, "holds an exam; name a new folder"),
        (made, {}, SEED + 1, "an exam of another seed"),
    ):
        with refused(ConfigError, reason):
            make_exam(folder, ExamOptions(**SMALL | changes), answer_schema(), seed)


def test_an_interrupted_exam_goes_on(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt_at_the_second(dataset: Any, folder: Path) -> None:
        if folder.name == "set-002":
            raise KeyboardInterrupt
        save_dataset(dataset, folder)

    folder, options = tmp_path / "exam", ExamOptions(**SMALL)
    with monkeypatch.context() as patched:
        patched.setattr("omnibench.simulate.exam.save_dataset", interrupt_at_the_second)
        with refused(Interrupted, "1 of 2 sets are written", f"--seed {SEED} goes on"):
            make_exam(folder, options, answer_schema(), SEED)
    before = (folder / "set-001" / "dataset.yaml").stat().st_mtime_ns
    make_exam(folder, options, answer_schema(), SEED)
    assert contents(folder) == contents(made)
    assert (folder / "set-001" / "dataset.yaml").stat().st_mtime_ns == before


# Marks


def marked(folder: Path, configs: dict[str, Any], **given: Any) -> dict[str, Any]:
    return mark_exam(configs, read_answers(answers(folder, **given), configs)).document


def test_names_classes_and_places_are_marked(tmp_path: Path) -> None:
    configs = {
        "set-001": hidden_in("floor_drift", "wheel_dead_zone"),
        "set-002": hidden_in("heading_drift"),
        "set-003": hidden_in(),
        "set-004": hidden_in(),
        "set-005": hidden_in("wheel_eccentricity"),
    }
    found = marked(
        tmp_path,
        configs,
        set1={
            "verdict": "named",
            "effects": [{"name": "floor_drift", "weight": 0.97}, {"name": "coulomb_creep", "weight": 0.95}],
            "where": [{"covariate": "heading", "weight": 0.7}, {"covariate": "stamps", "weight": 0.01}],
        },
        set2={
            "verdict": "class",
            "effects": [{"name": "body_velocity_bias", "weight": 0.6, "confusable_with": ["heading_drift"]}],
            "where": ["elapsed time", "place"],
        },
        set3={"verdict": "none"},
        set4={"verdict": "named", "effects": [{"name": "motor_lag"}]},
    )
    counts = {name: found[name] for name in ("right", "class", "unknown", "wrong", "none_right", "false_alarms")}
    assert counts == {"right": 1, "class": 1, "unknown": 2, "wrong": 2, "none_right": 1, "false_alarms": 1}
    assert (found["sets"], found["answered"], found["hidden"]) == (5, 4, 4)
    assert found["place_f1"] == pytest.approx(2 * 2 / (2 * 2 + 1 + 2))  # heading, elapsed time; place; two not seen
    assert [each["wrong"] for each in found["by_set"]] == [("coulomb_creep",), (), (), ("motor_lag",), ()]
    assert found["by_set"][4]["verdict"] == "no answer"
    assert found["rates"]["right"] == {"count": 1, "of": 4, "share": 0.25, "low": pytest.approx(0.0456, abs=1e-4),
                                       "high": pytest.approx(0.6994, abs=1e-4)}  # fmt: skip


def test_what_an_answer_calls_unknown_is_no_class(tmp_path: Path) -> None:
    configs = {"set-001": hidden_in("heading_drift"), "set-002": hidden_in()}
    at_best = {"verdict": "unknown", "effects": [{"name": "heading_drift", "weight": 0.7}]}
    found = marked(tmp_path, configs, set1=at_best, set2=at_best)
    assert [found[name] for name in ("right", "class", "unknown", "false_alarms")] == [0, 0, 1, 0]


def test_an_effect_shows_in_its_own_covariate_and_those_of_its_family() -> None:
    assert shows_in("coulomb_creep") == {"wheel rate", "command"}
    assert shows_in("reference_time_offset") == {"acceleration", "stamps"}
    assert shows_in("heading_drift") == {"elapsed time", "order of runs"}


def test_an_interval_is_as_wilson_has_it() -> None:
    from scipy.stats import binomtest

    for hits, count in ((0, 3), (2, 7), (9, 9)):
        interval, found = binomtest(hits, count).proportion_ci(0.95, "wilson"), rate(hits, count)
        assert np.allclose([found.low, found.high], [interval.low, interval.high], atol=1e-6)
    assert rate(0, 0).share is None


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        ({"set1": {"verdict": "nothing"}}, ["set-001", "verdict"]),
        (
            {"set1": {"verdict": "named", "effects": [{"name": "floor_drit"}]}},
            ["did you mean 'floor_drift'"],
        ),
        ({"set1": {"verdict": "unknown", "where": ["headng"]}}, ["set-001", "did you mean 'heading'"]),
        ({"set1": {"verdict": "unknown", "where": 3}}, ["set-001", "where"]),
        ({"set9": {"verdict": "none"}}, ["unknown set 'set-009'"]),
        ({"set1": ["none"]}, ["set-001", "expected keys and values"]),
    ],
)
def test_a_wrong_answer_file_is_refused_in_one_line(content: dict[str, Any], parts: list[str], tmp_path: Path) -> None:
    with refused(OmnibenchError, *parts):
        read_answers(answers(tmp_path, **content), {"set-001": None})


def test_files_that_hold_no_answers_are_refused(tmp_path: Path) -> None:
    (tmp_path / "list.json").write_text("[1]")
    (tmp_path / "broken.json").write_text("{")
    for name, reason in (
        ("list.json", "expected answers by the names of sets, found list"),
        ("broken.json", "not valid JSON"),
        ("nowhere.json", "no such file"),
        (".", "holds no SET/discovery.json, such as set-001/discovery.json"),
    ):
        with refused(OmnibenchError, reason):
            read_answers(tmp_path / name, {"set-001": None})


# Commands


def test_an_exam_is_made_and_graded_by_commands(command: Command, made: Path, tmp_path: Path) -> None:
    folder, given = tmp_path / "exam", answers(tmp_path, set1={"verdict": "none"})
    options = [f"--{name}={value}" for name, value in SMALL.items()]
    printed = succeeded(command("exam", "make", folder, *options, "--seed", SEED))
    assert printed.stdout == f"seed {SEED} (keep this: it opens the exam)\n"
    assert contents(folder) == contents(made)
    shown = succeeded(command("exam", "grade", folder, given, "--seed", SEED))
    assert "hidden effects: right name" in shown.stdout
    assert "no answer on 1 set, which count as unknown" in shown.stderr
    document = json.loads(succeeded(command("exam", "grade", folder, given, "--seed", SEED, "--json")).stdout)
    assert {"right", "class", "wrong", "unknown", "place_f1", "none_right", "false_alarms", "rates"} <= {*document}
    assert_refused(command("exam", "grade", folder, given, "--seed", SEED + 1, "--json"), "does not open")
    assert_refused(command("exam", "make", tmp_path / "new", "--effects", "headin_drift"), "did you mean")


@pytest.mark.slow
def test_discover_sits_an_exam(command: Command, tmp_path: Path) -> None:
    options = ("--sets", "3", "--robots", "omni,differential", "--size", "strong", "--runs", "60", "--seed", "3")
    succeeded(command("exam", "make", tmp_path / "exam", *options))
    for name in ("set-001", "set-002", "set-003"):
        succeeded(command("discover", tmp_path / "exam" / name, "-o", tmp_path / "answers" / name))
    graded = succeeded(command("exam", "grade", tmp_path / "exam", tmp_path / "answers", "--seed", "3", "--json"))
    document = json.loads(graded.stdout)
    assert (document["sets"], document["answered"]) == (3, 3)
    assert document["right"] + document["class"] + document["unknown"] == document["hidden"]
    assert document["wrong"] + document["false_alarms"] + document["unknown"] <= 1
