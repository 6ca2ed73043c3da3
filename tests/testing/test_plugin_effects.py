"""An effect of one's own, from its scaffold to every command that reads a calibration with it."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from commands import Command, assert_refused, flower, omnibench, succeeded

from omnibench.data.storage import load_dataset
from omnibench.registry import load_plugins
from omnibench.robot.calibration import Calibration, read_calibration, write_calibration
from omnibench.robot.corrections import motions_of, representatives

pytestmark = pytest.mark.slow  # one real discovery
TRUE_K = 0.15  # s/m
COMMANDS = {"speeds": [0.1, 0.4], "directions_deg": [0, 120, 240], "turn_rates": [-0.5, 0.5], "ramp": 0.3}


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the plug-in drag, which is hidden in data, and what discover made of them in out."""
    folder = tmp_path_factory.mktemp("drag")
    config = {"datasets": {"flower": {"simulate": flower(commands=COMMANDS, repetitions=2)}}}
    (folder / "simulation.yaml").write_text(yaml.safe_dump(config))
    for arguments in (
        ("plugin", "new", "drag", "--effect"),
        ("simulate", "simulation.yaml", "-o", "data", "--effect", f"drag: {{k: {TRUE_K}}}"),
        ("discover", "data", "--output", "out"),
    ):
        succeeded(omnibench(*arguments, cwd=folder))
    return folder


def known_to(work: Path) -> Calibration:
    """The calibration with the effect, as this process can read it."""
    load_plugins([work / "plugins"], installed=False)
    return read_calibration(work / "out" / "model.yaml")


@pytest.fixture
def extended(work: Path, tmp_path: Path) -> Path:
    """The calibration with the effect, as discover wrote it, in a folder without plug-ins."""
    file = tmp_path / "extended.yaml"
    file.write_bytes((work / "out" / "model.yaml").read_bytes())
    return file


def test_it_is_found_by_name_where_it_was_hidden(work: Path) -> None:
    found = json.loads((work / "out" / "discovery.json").read_text(encoding="utf-8"))
    assert found["verdict"] == "named"
    (effect,) = found["effects"]
    assert effect["name"] == "drag"
    found_k = effect["parameters"]["k"]
    standard_error = (found_k["high"] - found_k["low"]) / 4
    assert abs(found_k["value"] - TRUE_K) < 3 * standard_error  # one 95 % interval in twenty misses


def test_evaluate_takes_plugins(command: Command, work: Path, extended: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = succeeded(command("evaluate", extended, work / "data", "--json", "--plugins", work / "plugins"))
    with_it = json.loads(run.stdout)
    without = json.loads(succeeded(command("evaluate", work / "out" / "plain.yaml", work / "data", "--json")).stdout)
    assert with_it["splits"]["validation"]["cost"] < 0.8 * without["splits"]["validation"]["cost"]
    assert with_it["warnings"] == []
    monkeypatch.chdir(work)
    succeeded(command("evaluate", "out/model.yaml", "data"))


def test_evaluate_warns_of_runs_that_the_effect_was_not_fitted_to(command: Command, work: Path, extended: Path) -> None:
    known = known_to(work)
    slow = [run for run in load_dataset(work / "data").trajectories if run.v == 0.1]
    motions = np.concatenate([motions_of(known.matrix_array, run.times, run.rates) for run in slow])
    driven = tuple(map(tuple, representatives(known.robot, motions).tolist()))
    write_calibration(known.model_copy(update={"driven": driven}), extended)
    run = succeeded(command("evaluate", extended, work / "data", "--json", "--plugins", work / "plugins"))
    (warning,) = json.loads(run.stdout)["warnings"]
    for part in ("24 of 48 runs", "'flower extended'", "such as turning while driving at 0.4", "drag"):
        assert part in warning
    assert run.stderr == f"warning: {warning}\n"
    again = succeeded(
        command("simulate", "--like", work / "data", "--model", extended, "-o", "like", "--plugins", work / "plugins")
    )
    assert again.stderr.startswith(f"warning: {warning}\n")


def test_a_calibration_without_its_plugin_is_refused_in_one_line(command: Command, work: Path, extended: Path) -> None:
    for arguments in (
        ("evaluate", extended, work / "data"),
        ("certify", extended, work / "data"),
        ("export", extended, "--to", "c_header"),
        ("simulate", "--like", work / "data", "--model", extended, "-o", "like"),
    ):
        assert_refused(command(*arguments), "unknown effect 'drag'")


def test_export_certify_and_swap_say_what_becomes_of_the_effect(command: Command, work: Path, extended: Path) -> None:
    known = ("--plugins", work / "plugins")
    exported = succeeded(command("export", extended, "--to", "c_header", *known))
    assert "other effects are left out: drag" in exported.stderr
    certified = succeeded(command("certify", extended, work / "data", "--seconds", "2", *known))
    assert "optimum of the matrix alone" in certified.stdout + certified.stderr
    # swap knows it before it asks for a node
    assert_refused(command("swap", "apr", extended, "--connect", "tcp/127.0.0.1:1", *known), "nothing listens there")
