"""What each command prints and leaves behind: documents on standard output, files, plug-ins."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from browser import chromium
from commands import (
    COMMAND,
    CONFIGS,
    ENVIRONMENT,
    Command,
    Prepared,
    Printed,
    assert_refused,
    succeeded,
    write_config,
    write_plugin,
)
from lanes import slow
from recording_samples import sample
from timing import PATIENCE

from omnibench.data.storage import load_dataset, save_dataset
from omnibench.robot.calibration import EffectTerm, read_calibration, write_calibration
from omnibench.testing.synthetic import synthetic_robot


def document(printed: Printed) -> Any:
    """Standard output as one strict JSON document."""
    assert printed.returncode == 0, printed.stderr

    def no_constant(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    return json.loads(printed.stdout, parse_constant=no_constant)


def test_evaluate_prints_the_documented_document(command: Command, prepared: Prepared) -> None:
    found = document(command("evaluate", prepared.calibration, prepared.data, "--json"))
    assert [*found] == ["dataset", "trajectories", "splits", "held_out", "sessions", "warnings", "paths"]
    assert found["warnings"] == []
    assert (found["dataset"], found["trajectories"]) == ("flower", 12)
    assert [*found["splits"]] == ["train", "validation", "all"]
    for split in found["splits"].values():
        assert [*split] == ["cost", "position_mean_m", "position_max_m", "heading_mean_rad", "heading_max_rad"]
        assert {type(value) for value in split.values()} == {float}
        assert split["position_mean_m"] <= split["position_max_m"]
    both = [found["splits"][name]["cost"] for name in ("train", "validation")]
    assert found["splits"]["all"]["cost"] == pytest.approx(np.mean(both))


def test_evaluate_shows_the_design_values_and_how_many_runs_were_held_out(command: Command, prepared: Prepared) -> None:
    shown = command("evaluate", prepared.calibration, prepared.data).stdout
    assert "(simulated data)" in shown
    for split in ("train: 6 runs, none held out", "validation: 6 runs, all held out"):
        assert re.search(rf"^{split}\ncalibration ", shown, re.MULTILINE)
    assert len(shown.splitlines()) <= 25


def test_evaluate_predicts_the_errors_on_usual_paths_and_on_those_that_are_named(
    command: Command, prepared: Prepared
) -> None:
    keys = ["path", "model", "position_m", "position_95_m", "heading_rad", "heading_95_rad"]
    usual = document(command("evaluate", prepared.calibration, prepared.data, "--json"))["paths"]
    assert [*dict.fromkeys(each["path"] for each in usual)] == [
        *("straight 1.0", "turn 360", "circle 1.0 left", "square 1.0 left")
    ]
    named = command("evaluate", prepared.calibration, "--path", "circle 0.5 right", "--path", "turn 90", "--json")
    found = document(named)
    assert [*found] == ["paths", "warnings"]
    assert [(each["path"], each["model"]) for each in found["paths"]] == [
        (path, model) for path in ("circle 0.5 right", "turn 90") for model in ("calibration", "design")
    ]
    for each in [*usual, *found["paths"]]:
        assert [*each] == keys
        assert 0 < each["position_m"] < each["position_95_m"]
        assert 0 < each["heading_rad"] < each["heading_95_rad"]


def test_evaluate_shows_a_table_of_paths(command: Command, prepared: Prepared) -> None:
    printed = succeeded(command("evaluate", prepared.calibration, "--path", "square 2.0 right"))
    assert "errors to expect at a path's end (95 % lie within); slip as of 6 training runs" in printed.stdout
    assert any(line.startswith("square 2.0 right") for line in printed.stdout.splitlines())
    assert "evaluate" in printed.stderr
    wrong = command("evaluate", prepared.calibration, "--path", "sqare 1.0")
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert "did you mean 'square 1.0 left'" in wrong.stderr


def test_a_calibration_of_an_older_version_says_what_its_regions_lack(
    command: Command, prepared: Prepared, tmp_path: Path
) -> None:
    old = read_calibration(prepared.calibration).model_copy(update={"slip": None})
    write_calibration(old, tmp_path / "old.yaml")
    assert "slip" not in (tmp_path / "old.yaml").read_text()
    found = document(command("evaluate", tmp_path / "old.yaml", "--json"))
    assert ["uncertainty alone" in warning for warning in found["warnings"]] == [True]
    assert len(found["paths"]) == 8


def test_calibrate_prints_what_it_would_write(command: Command, prepared: Prepared, tmp_path: Path) -> None:
    found = document(command("calibrate", prepared.data, "--json", "-o", tmp_path / "c.yaml"))
    assert found == json.loads(read_calibration(tmp_path / "c.yaml").model_dump_json())
    of_wheels = [f"{kind}_{wheel}" for kind in ("radius", "distance", "angle") for wheel in "abc"]
    assert list(found["parameters"]) == [*of_wheels, "mount_x", "mount_y", "lost_rate"]
    assert list(found["parameters"]["radius_a"]) == ["design", "value", "unit", "low", "high"]
    assert found["format"] == "omnibench-calibration/1"
    assert np.shape(found["matrix"]) == (3, 3)


def test_calibrate_warns_of_what_a_box_holds(command: Command, prepared: Prepared) -> None:
    printed = succeeded(command("calibrate", prepared.data, "--calibrator", "closed_form", "--box", "paper"))
    assert "not fitted, kept at the start value by the box 'paper' or the cost: m12" in printed.stderr


def test_calibrate_and_evaluate_end_with_what_held_out_runs_say(command: Command, prepared: Prepared) -> None:
    calibrated = command("calibrate", prepared.data, "-o", "c.yaml").stdout.splitlines()
    evaluated = command("evaluate", "c.yaml", prepared.data).stdout.splitlines()
    found = document(command("evaluate", "c.yaml", prepared.data, "--json"))["held_out"]
    assert (found["verdict"], found["unit"], found["units"], len(found["runs"])) == ("better", "run", 6, 6)
    assert [calibrated.count(found["sentence"]), evaluated.count(found["sentence"])] == [1, 1]


def test_what_only_a_live_node_can_run_is_not_exported(command: Command, prepared: Prepared, tmp_path: Path) -> None:
    fitted = read_calibration(prepared.calibration)
    term = EffectTerm(name="centripetal_slip", parameters={"k": -0.001})
    effects = {"effects": (term,), "covariance": None, "plain": None}
    write_calibration(fitted.model_copy(update=effects), tmp_path / "effects.yaml")
    ending = command("evaluate", tmp_path / "effects.yaml", prepared.data).stderr
    assert ending.endswith(":\n  omnibench guide live\n")
    assert " export " in command("evaluate", prepared.calibration, prepared.data).stderr


def test_settings_reach_the_calibrator_and_infinity_is_null_in_json(command: Command, prepared: Prepared) -> None:
    options = ("--set", "population=20", "--set", "generations=2", "--set", "tolerance=.inf")
    choices = ("--calibrator", "genetic", "--seed", "5", "--unidentified", "fit")
    found = document(command("calibrate", prepared.data, "--json", *choices, *options))
    recorded = found["provenance"]["options"]
    assert (recorded["population"], recorded["generations"], recorded["tolerance"]) == (20, 2, None)
    assert (found["provenance"]["seed"], found["provenance"]["unidentified"]) == (5, "fit")


@pytest.mark.parametrize("name", ["raises", "says_nan"])
def test_a_missing_answer_is_one_line(name: str, command: Command, prepared: Prepared, tmp_path: Path) -> None:
    body = {"raises": "raise ValueError('oh')", "says_nan": "return Solution(np.full(problem.size, np.nan), 'x')"}[name]
    text = f"@calibrators.register('{name}')\nclass A(Calibrator):\n    def calibrate(self, problem):\n        {body}\n"
    plugins = write_plugin(tmp_path / "p", name, text)
    printed = command("calibrate", prepared.data, "-o", "x.yaml", "--plugins", plugins, "--calibrator", name)
    assert_refused(printed, f"calibrator '{name}' gave no answer")
    assert not Path("x.yaml").exists()


CHATTY = """
print("on import")

@calibrators.register("chatty")
class Chatty(Calibrator):
    "Talks."

    def calibrate(self, problem):
        print("while it works")
        return Solution(problem.start, "done")
"""


def test_what_a_plugin_prints_does_not_spoil_the_document(command: Command, prepared: Prepared, tmp_path: Path) -> None:
    plugins = write_plugin(tmp_path / "p", "chatty", CHATTY)
    printed = command("calibrate", prepared.data, "--json", "--plugins", plugins, "--calibrator", "chatty")
    assert document(printed)["provenance"]["calibrator"] == "chatty"
    assert "on import" in printed.stderr
    assert "while it works" in printed.stderr


@pytest.mark.slow
def test_a_terminal_without_a_letter_shows_another(prepared: Prepared, tmp_path: Path) -> None:
    data = shutil.copytree(prepared.data, tmp_path / "data")
    header = (data / "dataset.yaml").read_text()
    (data / "dataset.yaml").write_text(header.replace("name: flower", "name: Größe"))
    command = [*COMMAND, "inspect", str(data)]
    environment = ENVIRONMENT | {"PYTHONIOENCODING": "ascii"}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert run.returncode == 0
    assert "Traceback" not in run.stderr
    assert run.stdout.startswith("Gr??e, robot APR-02: simulated data")


def test_list_names_everything_that_a_config_can_name(command: Command) -> None:
    found = document(command("list", "--plugins", CONFIGS.parent / "plugins", "--json"))
    assert {*found} == {"calibrators", "costs", "effects", "importers", "failures"}
    names = {kind: {row["name"] for row in found[kind]} for kind in ("calibrators", "costs", "importers")}
    built_in = {"closed_form", "crs", "genetic", "isres", "parametric", "published", "random_search", "theoretical"}
    assert names["calibrators"] >= built_in | {"cmaes", "differential_evolution", "maddahi"}
    assert names["costs"] >= {"final_pose", "final_position", "final_heading", "trajectory"}
    assert names["importers"] >= {"optiodom", "table1", "csv", "robotino"}
    origins = {row["name"]: row["from"] for row in found["calibrators"]}
    assert origins["crs"] == "built in"
    assert origins["cmaes"] == str(CONFIGS.parent / "plugins" / "cmaes.py")
    assert found["failures"] == []
    assert document(command("list", "costs", "--json")) == {"costs": found["costs"], "failures": []}


def test_list_shows_the_names_of_all_kinds_in_forty_lines(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    printed = command("list", "--plugins", CONFIGS.parent / "plugins")
    assert len((printed.stdout + printed.stderr).splitlines()) <= 40
    assert all(len(line) <= 80 for line in printed.stdout.splitlines())
    found = document(command("list", "--plugins", CONFIGS.parent / "plugins", "--json"))
    for kind in ("calibrators", "costs", "effects", "importers"):
        assert f"{kind} ({len(found[kind])})" in printed.stdout
        assert {row["name"] for row in found[kind]} <= {*re.findall(r"\w+", printed.stdout)}


def test_list_takes_the_plugins_of_the_folder_one_is_in(command: Command, tmp_path: Path) -> None:
    write_plugin(tmp_path / "plugins", "chatty", CHATTY)
    printed = command("list")
    assert "chatty" in printed.stdout
    assert "plug-ins of ./plugins" in printed.stderr


@pytest.mark.parametrize("by_variable", [False, True])
def test_unwanted_plugins_are_not_loaded(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, by_variable: bool
) -> None:
    write_plugin(tmp_path / "plugins", "unwanted", "raise SystemExit('it ran')\n")
    if by_variable:
        monkeypatch.setenv("OMNIBENCH_PLUGINS", "none")
    printed = command("list", *([] if by_variable else ["--plugins", "none"]))
    assert "closed_form" in printed.stdout
    assert "unwanted" not in printed.stderr
    assert "plug-ins of ./plugins" not in printed.stderr


def test_list_goes_on_past_a_plugin_that_cannot_be_imported(command: Command, tmp_path: Path) -> None:
    plugins = write_plugin(tmp_path / "p", "aaa_broken", "import nothing_of_the_kind\n")
    write_plugin(plugins, "chatty", CHATTY)
    printed = command("list", "--plugins", plugins, "--json")
    found = document(printed)
    assert {"chatty", "closed_form", "theoretical"} <= {row["name"] for row in found["calibrators"]}
    assert [row["error"] for row in found["failures"]] == ["ModuleNotFoundError: No module named 'nothing_of_the_kind'"]
    assert f"warning: plug-in {plugins / 'aaa_broken.py'} cannot be imported" in printed.stderr


def test_export_writes_to_standard_output_or_to_a_file(command: Command, prepared: Prepared, tmp_path: Path) -> None:
    shown = succeeded(command("export", prepared.calibration, "--to", "c_header"))
    written = command("export", prepared.calibration, "--to", "c_header", "-o", tmp_path / "m.h")
    assert (tmp_path / "m.h").read_text() == shown.stdout
    assert written.stdout == ""
    warning, ending = written.stderr.splitlines()
    assert warning.startswith("warning: simulated")
    assert ending.startswith(f"{tmp_path / 'm.h'} ")


def test_a_data_set_has_the_name_of_its_folder_unless_another_is_given(command: Command, tmp_path: Path) -> None:
    recording = tmp_path / "recording"
    recording.mkdir()
    (recording / "r_wheels.csv").write_text("t,omega_a,omega_b,omega_c\n0.1,1,0,-1\n0.2,1,0,-1\n")
    (recording / "r_poses.csv").write_text("t,x,y,theta\n0,0,0,0\n0.2,0.02,0,0\n")
    Path("robot.yaml").write_text(yaml.safe_dump(synthetic_robot().model_dump(mode="json")))
    given = ("--set", "robot=robot.yaml")
    assert command("import", "csv", recording, "-o", "data/day1", *given).returncode == 0
    assert command("import", "csv", recording, "-o", "day2", *given, "--set", "name=lab").returncode == 0
    assert (load_dataset("data/day1").name, load_dataset("day2").name) == ("day1", "lab")


def test_a_plugin_that_breaks_the_contract_fails_its_check_with_exit_code_1(command: Command, tmp_path: Path) -> None:
    text = "@calibrators.register('outside')\nclass Outside(Calibrator):\n    'Outside.'\n"
    text += "    def calibrate(self, problem):\n        return Solution(problem.upper + 1, 'x')\n"
    write_plugin(tmp_path, "outside", text)
    printed = command("plugin", "check", tmp_path / "outside.py")
    assert printed.returncode == 1
    assert "failed  calibrator outside: bounds are kept" in printed.stdout


def test_certify_says_what_is_proven(command: Command, prepared: Prepared) -> None:
    found = document(command("certify", prepared.calibration, prepared.data, "--gap", 0.3, "--json"))
    assert [*found] == ["cost", "lower_bound", "gap", "box", "seconds"]
    assert 0 < found["lower_bound"] <= found["cost"]
    assert found["gap"] == pytest.approx(1 - found["lower_bound"] / found["cost"])
    assert found["box"] == "row"
    printed = command("certify", prepared.calibration, prepared.data, "--parts", 1)
    assert "(simulated data), training split" in printed.stdout
    assert re.search(r"proven lower bound +0\.\d", printed.stdout)
    assert "the box 'row'" in printed.stdout
    assert "1 part of the box examined" in printed.stdout


def test_design_prints_one_document_and_writes_its_report(command: Command, tmp_path: Path) -> None:
    config = write_config(tmp_path)
    found = document(command("design", config, "--output", tmp_path / "out", "--json"))
    assert json.loads((tmp_path / "out" / "design.json").read_text(encoding="utf-8")) == found
    assert found["sets"][0]["step"]["efficiency"] > 0.99
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000


QUICK = ("inspect", "{data}", "--report", "out/report.html")
LONG = (
    ("check", "{data}", "--report", "out/report.html"),
    ("compare", "{config}", "-o", "out"),
    ("design", "{data}", "-o", "out"),
    ("discover", "{data}", "-o", "out"),
    ("simulate", "{config}", "-o", "out/data", "--report", "out/report.html"),
    ("slam", "scans", "-o", "out/data", "--report", "out/report.html"),
)


@pytest.mark.parametrize("typed", [QUICK, *slow(*LONG)], ids=lambda typed: typed[0])
def test_every_figure_is_written_as_svg_and_png(command: Command, prepared: Prepared, typed: tuple[str, ...]) -> None:
    chromium()
    if "scans" in typed:
        save_dataset(sample(repetitions=1, rays=360).dataset, Path("scans"))
    Path("out").mkdir()
    printed = command(*(word.format_map(prepared._asdict()) for word in typed), "--figures", "pictures")
    assert printed.returncode == (1 if typed[0] == "check" else 0), printed.stderr  # its runs lack motions
    drawn = Path("out/report.html").read_text(encoding="utf-8").count('<div class="figures">')
    assert f"figures: pictures ({drawn}, each as SVG and PNG" in printed.stderr
    pictures = list(Path("pictures").iterdir())
    for ending, begins in ((".svg", b"<svg"), (".png", b"\x89PNG")):
        written = [file for file in pictures if file.suffix == ending]
        assert len(written) == drawn
        assert all(file.read_bytes().startswith(begins) for file in written)
