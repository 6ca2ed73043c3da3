"""The command ``discover`` and the folder that it writes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl
import pytest
from commands import COMMAND, ENVIRONMENT, Command, assert_refused, omnibench
from discovery_samples import EXPERIMENT, named, nothing, simulated
from timing import PATIENCE

from omnibench.config import parse_yaml
from omnibench.data.dataset import Dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.discover.output import DiscoverOptions, write_discovery
from omnibench.errors import DataError
from omnibench.fit.evaluate import evaluate
from omnibench.robot.calibration import read_calibration

OPTIONS = DiscoverOptions(dataset="data")
# As the design document has them, in its order.
KEYS = ["verdict", "effects", "where", "absorbed", "gap", "held_out", "model"]
FILES = {
    "config.yaml", "discovery.json", "report.html", "model.yaml", "plain.yaml", "residuals.parquet",
}  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small data set with a strong hidden effect, as a folder."""
    folder = tmp_path_factory.mktemp("discover") / "data"
    save_dataset(small(), folder)
    return folder


class Told(NamedTuple):
    """A run of the command and its folder."""

    run: subprocess.CompletedProcess[str]
    folder: Path

    @property
    def document(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads(self.run.stdout)
        return content


def small() -> Dataset:
    commands = {"directions_deg": [0, 120, 240], "turn_rates": [-0.35, 0.35], "ramp": 0.3}
    return simulated(commands=commands, repetitions=2)


@pytest.fixture(scope="module")
def told(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Told:
    """What the command says of the data, in one real process."""
    folder = tmp_path_factory.mktemp("told") / "out"
    return Told(omnibench("discover", data, "--output", folder, "--json"), folder)


def test_json_is_one_document_and_the_same_as_the_file(told: Told) -> None:
    assert told.run.returncode == 0
    assert told.run.stdout == (told.folder / "discovery.json").read_text(encoding="utf-8")
    assert list(told.document)[: len(KEYS)] == KEYS
    assert {path.name for path in told.folder.iterdir()} == FILES


def test_the_hidden_effect_is_named_and_is_in_the_extended_calibration(told: Told) -> None:
    document = told.document
    assert document["verdict"] == "named"
    assert [effect["name"] for effect in document["effects"]] == ["rotation_translation_coupling"]
    assert set(document["held_out"]) == {"repetitions", "session"}
    extended = read_calibration(document["model"])
    assert [term.name for term in extended.effects] == ["rotation_translation_coupling"]
    assert not read_calibration(document["plain_model"]).effects


def test_the_extended_model_is_better_on_the_held_out_session(told: Told, data: Path) -> None:
    costs = {
        name: evaluate(read_calibration(told.document[name]), load_dataset(data)).splits["validation"].cost
        for name in ("model", "plain_model")
    }
    assert costs["model"] < 0.3 * costs["plain_model"]


def test_stages_are_told_on_standard_error(told: Told) -> None:
    assert "fitting the plain matrix\n" in told.run.stderr
    assert told.run.stderr.endswith("writing the report\n")


def test_the_default_folder_has_the_name_of_the_data_and_the_newest_is_linked(command: Command, data: Path) -> None:
    run = command("discover", data, "--without", "rotation_translation_coupling", "--seed", 3)
    assert run.returncode == 0
    assert "added: rotation_translation_coupling" not in run.stdout
    latest = Path("results/flower/latest")
    assert latest.is_symlink()
    assert {path.name for path in latest.iterdir()} >= FILES - {"model.yaml"}  # nothing was added
    assert parse_yaml((latest / "config.yaml").read_text(encoding="utf-8"), "config") == {
        "dataset": str(data),
        "model": None,
        "without": ["rotation_translation_coupling"],
        "unknown_term": True,
        "seed": 3,
        "plugins": [],
    }
    assert f"report: {Path('results/flower')}" in run.stdout


def test_an_unknown_effect_gets_the_nearest_name(command: Command, data: Path) -> None:
    run = command("discover", data, "--without", "centripetal_slipp")
    assert_refused(run, "--without", "did you mean 'centripetal_slip'?")


def test_a_missing_data_set_is_one_line(command: Command) -> None:
    assert_refused(command("discover", "nowhere"), "nowhere")


def test_another_robots_calibration_is_refused(command: Command, told: Told, data: Path) -> None:
    plain = (told.folder / "plain.yaml").read_text(encoding="utf-8")
    Path("other.yaml").write_text(plain.replace("{name: ", "{name: w"), encoding="utf-8")
    assert_refused(command("discover", data, "--model", "other.yaml"), "wheels wa, wb, wc")


def test_somebody_elses_folder_is_refused_before_any_work(command: Command, data: Path) -> None:
    Path("mine").mkdir()
    Path("mine/notes.txt").write_text("mine", encoding="utf-8")
    run = command("discover", data, "--output", "mine")
    assert_refused(run, "mine", "holds other files", "name a new folder")
    assert_refused(command("discover", data, "--output", "mine/notes.txt"), "is a file")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a discovery with two experiments."""
    folder = tmp_path_factory.mktemp("written") / "out"
    return write_discovery(replace(named(), experiments=(EXPERIMENT, EXPERIMENT)), OPTIONS, folder)


def test_an_earlier_discovery_is_replaced_with_all_its_files(written: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(written, tmp_path / "out")
    assert (folder / "experiment-2.yaml").read_text(encoding="utf-8") == EXPERIMENT.config
    write_discovery(replace(nothing(), experiments=(EXPERIMENT,)), OPTIONS, folder)
    assert {path.name for path in folder.iterdir()} == {*FILES, "experiment-1.yaml"} - {"model.yaml"}
    assert json.loads((folder / "discovery.json").read_text(encoding="utf-8"))["verdict"] == "none"


def test_a_disk_that_refuses_one_file_leaves_all_as_they_were(written: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(written, tmp_path / "out")
    (folder / "report.html").unlink()
    (folder / "report.html").mkdir()
    before = (folder / "discovery.json").read_bytes()
    with pytest.raises(DataError, match=r"report\.html: cannot be written"):
        write_discovery(nothing(), OPTIONS, folder)
    assert (folder / "discovery.json").read_bytes() == before
    assert {path.name for path in folder.iterdir()} == {*FILES, "experiment-1.yaml", "experiment-2.yaml"}


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(DataError, match="cannot be written"):
        write_discovery(nothing(), OPTIONS, tmp_path / "file" / "out")


def test_every_pose_has_a_row_with_its_residuals(written: Path) -> None:
    found = named()
    table = pl.read_parquet(written / "residuals.parquet")
    assert len(table) == found.poses
    first = table.filter(pl.col("trajectory") == found.trajectories[0])
    assert first["before_heading_rad"].to_list() == found.before[0][:, 2].tolist()
    assert first["after_x_m"].to_list() == found.after[0][:, 0].tolist()
    assert set(first["command"]) <= {run.command for run in found.dataset.trajectories}


def test_names_of_data_sets_become_folders_that_can_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, folder in (("../a b/c", "a_b_c"), ("..", "dataset")):
        dataset = replace(nothing().dataset, name=name)
        written = write_discovery(replace(nothing(), dataset=dataset), OPTIONS)
        assert written.parent == Path("results") / folder


def test_ctrl_c_leaves_nothing_half_written(data: Path, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [*COMMAND, "discover", str(data)], cwd=tmp_path, env=ENVIRONMENT, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert process.stderr is not None
    try:
        assert process.stderr.readline() == "fitting the plain matrix\n"
        os.kill(process.pid, signal.SIGINT)
        _, told = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    assert process.returncode == 130
    assert told.splitlines()[-1] == "interrupted; the same command begins anew"
    assert not (tmp_path / "results").exists()
