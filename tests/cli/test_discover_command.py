"""The command ``discover``, the folder that it writes, and what it shows on a terminal."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl
import pytest
from commands import Command, Printed, assert_refused, run_here, succeeded
from discovery_samples import EXPERIMENT, SMALL, incomplete, named, nameless, nothing, simulated
from nodes import Command as CommandProcess
from report_page import Page, on_terminal
from sessions import until

from omnibench.cli.terminal.discovery_summary import print_discovery
from omnibench.config import parse_yaml
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.discover.output import DiscoverOptions, write_discovery
from omnibench.discover.result import Discovery
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
    save_dataset(simulated(commands=SMALL), folder)
    return folder


class Told(NamedTuple):
    """A run of the command and its folder."""

    run: Printed
    folder: Path

    @property
    def document(self) -> dict[str, Any]:
        return json.loads(self.run.stdout)


@pytest.fixture(scope="module")
def told(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Told:
    """What the command says of the data."""
    folder = tmp_path_factory.mktemp("told") / "out"
    return Told(run_here("discover", data, "--output", folder, "--json", cwd=folder.parent), folder)


def test_json_is_one_document_and_the_same_as_the_file(told: Told) -> None:
    assert told.run.returncode == 0
    assert "fitting the plain matrix\n" in told.run.stderr
    assert told.run.stderr.endswith("writing the report\n")
    assert told.run.stdout == (told.folder / "discovery.json").read_text(encoding="utf-8")
    assert list(told.document)[: len(KEYS)] == KEYS
    assert {path.name for path in told.folder.iterdir()} == FILES


def test_the_hidden_effect_is_named_and_the_extended_calibration_is_better(told: Told, data: Path) -> None:
    document = told.document
    assert document["verdict"] == "named"
    assert [effect["name"] for effect in document["effects"]] == ["rotation_translation_coupling"]
    assert set(document["held_out"]) == {"repetitions", "session"}
    extended, plain = (read_calibration(document[name]) for name in ("model", "plain_model"))
    assert [term.name for term in extended.effects] == ["rotation_translation_coupling"]
    assert not plain.effects
    costs = [evaluate(model, load_dataset(data)).splits["validation"].cost for model in (extended, plain)]
    assert costs[0] < 0.3 * costs[1]


@pytest.mark.slow
def test_the_default_folder_has_the_name_of_the_data_and_the_newest_is_linked(command: Command, data: Path) -> None:
    run = succeeded(command("discover", data, "--without", "rotation_translation_coupling", "--seed", 3))
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


def test_a_mistake_is_refused_before_any_work(command: Command, told: Told, data: Path) -> None:
    plain = (told.folder / "plain.yaml").read_text(encoding="utf-8")
    Path("other.yaml").write_text(plain.replace("{name: ", "{name: w"), encoding="utf-8")
    Path("mine").mkdir()
    Path("mine/notes.txt").write_text("mine", encoding="utf-8")
    for arguments, parts in (
        ((data, "--without", "centripetal_slipp"), ("--without", "'centripetal_slip'")),
        (("nowhere",), ("nowhere",)),
        ((data, "--model", "other.yaml"), ("wa, wb, wc",)),
        ((data, "--output", "mine"), ("mine", "holds other files")),
        ((data, "--output", "mine/notes.txt"), ("is a file",)),
    ):
        assert_refused(command("discover", *arguments), *parts)


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
    document = json.loads((folder / "discovery.json").read_text(encoding="utf-8"))
    assert (document["verdict"], document["model"]) == ("none", None)
    assert "model.yaml" not in Page((folder / "report.html").read_text(encoding="utf-8")).text


def test_a_disk_that_refuses_one_file_leaves_all_as_they_were(written: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(written, tmp_path / "out")
    (folder / "report.html").unlink()
    (folder / "report.html").mkdir()
    before = (folder / "discovery.json").read_bytes()
    with pytest.raises(DataError, match=r"report\.html: cannot be written"):
        write_discovery(nothing(), OPTIONS, folder)
    assert (folder / "discovery.json").read_bytes() == before
    assert {path.name for path in folder.iterdir()} == {*FILES, "experiment-1.yaml", "experiment-2.yaml"}


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


@pytest.mark.slow
def test_ctrl_c_leaves_nothing_half_written(data: Path, tmp_path: Path) -> None:
    with CommandProcess("discover", data, cwd=tmp_path) as discover:
        until(lambda: "fitting the plain matrix\n" in discover.said(), "the work to begin")
        _, told = discover.stop()
    assert discover.process.returncode == 130
    assert told.splitlines()[-1] == "interrupted; the same command begins anew"
    assert not (tmp_path / "results").exists()


def in_doubt() -> Discovery:
    doubtful = replace(named().effects[0], confusable_with=("load_transfer",), in_doubt="few turns")
    return replace(named(), verdict="class", effects=(doubtful,))


def many_notes() -> Discovery:
    return replace(nothing(), notes=tuple(f"note {n}" for n in range(9)))


DRIVE = ("acceleration_slip", "turning left on the spot at 1 rad/s 12.5 4", "Drive 4 runs, 1.8 minutes")
LEFT_OVER = ("wheel rate (2 × 10⁻¹¹)", "warning: not driven in training: v0.4_a90_w1", "experiment-1.yaml")
SHOWN: dict[Callable[[], Discovery], tuple[str, ...]] = {
    named: ("(simulated data): 36 training runs", "verdict: named", "held-out session: 36 runs", "now/model.yaml"),
    nameless: ("verdict: unknown",),
    incomplete: DRIVE + LEFT_OVER,
    in_doubt: ("load_transfer", "few turns"),
    many_notes: ("verdict: none", "- note 2 6 more notes", "report: results/flower/now/report.html"),
}


@pytest.mark.parametrize("make", SHOWN)
def test_what_is_found_is_told_on_a_screen_of_eighty_columns(make: Callable[[], Discovery]) -> None:
    lines = on_terminal(print_discovery, make(), Path("results/flower/now")).splitlines()
    assert max(len(line.rstrip()) for line in lines) <= 80
    text = " ".join(" ".join(lines).split())
    assert "…" not in text
    for part in SHOWN[make]:
        assert part in text
    assert make != named or re.search(r"rotation_translation_coupling \(body\), weight 9[5-9]\.\d %", text)
