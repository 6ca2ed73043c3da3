"""No command writes over what is there: each refuses in one line before its work, and takes --force."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from commands import Command, Prepared, assert_refused

MINE = "written: by hand\n"
OPTIONS = "# The effective options of a discovery; the results beside it were made with them.\ndataset: another\n"
COMPARISON = "# The effective config of a comparison; the results beside it were made with it.\nname: another\n"


@pytest.fixture
def here(command: Command, prepared: Prepared, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that ``command`` runs in: a config, a data set, a calibration, and files of the user's own."""
    assert command  # changes the folder, too
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    shutil.copy(prepared.config, "config.yaml")
    shutil.copy(prepared.calibration, "model.yaml")
    for copy in ("data", "other"):
        shutil.copytree(prepared.data, copy)
    mine = ("mine.yaml", "mine.html", "mine.py", "mine.mcap", "truth/truth.yaml", "keys/node.pem", "configs/apr02.yaml")
    for name in (*mine, "results/report.html"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(MINE, encoding="utf-8")
    for name, text in (("discovery", OPTIONS), ("comparison", COMPARISON)):
        Path(name).mkdir()
        Path(name, "config.yaml").write_text(text, encoding="utf-8")
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    "arguments",
    [
        "calibrate data -o mine.yaml",
        "export model.yaml --to c_header -o mine.yaml",
        "simulate config.yaml -o data",
        "simulate config.yaml -o new --report mine.html",
        "simulate config.yaml -o new --truth truth",
        "simulate --like data --model model.yaml -o other",
        "import csv nowhere -o data",
        "slam data -o other",
        "slam data --json --report mine.html",
        "design data -o results",
        "discover data -o discovery",
        "discover data -o data",
        "compare config.yaml -o comparison",
        "compare config.yaml -o data",
        "keys keys node",
        "record apr02 -o mine.mcap",
        "example apr02 -o .",
        "plugin new mine -o .",
    ],
)
def test_what_is_there_is_not_written_over_and_force_is_named(command: Command, here: Path, arguments: str) -> None:
    before = contents(here)
    assert_refused(command(*arguments.split()), "--force")
    assert contents(here) == before


@pytest.mark.parametrize(
    ("arguments", "written"),
    [
        ("calibrate data -o mine.yaml", "mine.yaml"),
        ("export model.yaml --to c_header -o mine.yaml", "mine.yaml"),
        ("simulate config.yaml -o data --format csv --truth truth --report mine.html", "mine.html"),
        ("simulate --like data --model model.yaml -o other", "other/poses.parquet"),
        pytest.param("design data -o results", "results/report.html", marks=pytest.mark.slow),
        pytest.param("compare config.yaml -o comparison", "comparison/config.yaml", marks=pytest.mark.slow),
        ("keys keys node", "keys/node.pem"),
        ("example apr02 -o .", "configs/apr02.yaml"),
        ("plugin new mine -o .", "mine.py"),
    ],
)
def test_it_is_written_over_by_force(command: Command, here: Path, arguments: str, written: str) -> None:
    before = contents(here)
    run = command(*arguments.split(), "--force")
    assert run.returncode == 0, run.stderr
    assert contents(here)[written] != before[written]


def test_an_empty_file_and_an_empty_folder_are_no_loss_and_other_files_are_even_by_force(
    command: Command, here: Path
) -> None:
    Path("empty.yaml").touch()
    Path("empty").mkdir()
    assert command("calibrate", "data", "-o", "empty.yaml").returncode == 0
    assert command("simulate", "config.yaml", "-o", "empty").returncode == 0
    before = contents(here)
    assert_refused(command("simulate", "config.yaml", "-o", "truth", "--force"), "holds other files")
    assert contents(here) == before


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    "arguments",
    [
        "calibrate data -o loop",
        "simulate config.yaml -o loop",
        "simulate --like data --model model.yaml -o loop",
        "design data -o loop",
        "compare config.yaml -o loop",
        "example apr02 -o loop",
    ],
)
def test_a_link_that_leads_to_itself_is_one_line(command: Command, arguments: str) -> None:
    Path("loop").symlink_to("loop")
    assert_refused(command(*arguments.split()), "loop", "link")
