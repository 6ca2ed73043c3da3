"""A user's mistake and a disk that refuses: one line on standard error, exit code 2, nothing lost."""

import os
import shutil
import subprocess
from pathlib import Path

import polars as pl
import pytest
import yaml
from commands import COMMAND, ENVIRONMENT, Command, Prepared, assert_refused, disk_that_takes, omnibench, succeeded


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["compre"], ["'compre'", "'compare'", "--help"]),
        (["compare"], ["CONFIG|DATASET", "omnibench compare --help"]),
        (["compare", "CONFIG", "--outptu", "x"], ["--output"]),
        (["compare", "CONFIG", "--data", "flower=nowhere"], ["--data flower=nowhere"]),
        (["compare", "CONFIG", "--data", "flwer=DATA"], ["'flwer'", "'flower'"]),
        (["compare", "CONFIG", "--data", "CONFIG"], ["is a file", "dataset.yaml"]),
        (["compare", "CONFIG", "--plugins", "nowhere"], ["plug-in folder", "nowhere"]),
        (["compare", "CONFIG", "--output", "x" * 300], ["File name too long"]),
        (["compare", "CONFIG", "--output", "CONFIG"], ["is a file"]),
        (["compare", "CONFIG", "--output", "CONFIG/deep/er"], ["cannot be written", "is not a folder"]),
        (["compare", "."], ["is a folder without dataset.yaml"]),
        (["compare", "CONFIG", "DATA"], ["unexpected extra argument", "compare takes one config, or the folders of"]),
        (["compare", "DATA", "nope"], ["nope: no such folder; compare takes one config"]),
        (["compare", "DATA", "--data", "DATA"], ["--data is for a config", "leave it out"]),
        (["compare", "DATA/dataset.yaml"], ["unknown key 'format'"]),
        (["calibrate", "DATA", "-o", "x", "--calibrator", "crss"], ["--calibrator", "'crss'", "'crs'"]),
        (["calibrate", "DATA", "-o", "x", "--box", "papr"], ["--box", "'papr'", "'paper', 'row'"]),
        (["calibrate", "DATA", "-o", "x", "--evaluations", "many"], ["--evaluations", "valid integer"]),
        (["calibrate", "DATA", "-o", "x", "--seconds", "nan"], ["--seconds"]),
        (["calibrate", "DATA", "-o", "x", "--set", "tolerance"], ["--set tolerance", "KEY=VALUE"]),
        (["calibrate", "DATA", "-o", "x", "--set", "a=2023-99-99"], ["--set a=2023-99-99", "month"]),
        (["calibrate", "DATA", "-o", "x", "--set", "clok=1"], ["'clok'", "clock"]),
        (["calibrate", "DATA", "-o", "DATA"], ["is a folder"]),
        (["calibrate", "DATA", "-o", "CONFIG/x"], ["small.yaml is not a folder"]),
        (["evaluate", "CONFIG", "DATA"], ["omnibench-calibration/1"]),
        (["evaluate", "CALIBRATION", "nowhere"], ["nowhere: no such folder"]),
        (["export", "CALIBRATION", "--to", "c_heder"], ["'c_heder'", "'c_header'"]),
        (["simulate", "CONFIG", "-o", "x", "--truth", "x"], ["--truth"]),
        (["simulate", "CONFIG", "-o", "x", "--dataset", "flour"], ["'flour'", "flower"]),
        (["simulate", "CONFIG", "-o", "x", "--format", "xml"], ["'xml'", "'parquet', 'csv'"]),
        (["import", "csvv", "DATA", "-o", "x"], ["'csvv'", "'csv'"]),
        (["import", "optiodom", "nowhere", "-o", "x"], ["nowhere: no such file or folder"]),
        (["import", "optiodom", "--template", "x"], ["--template is for csv", "omnibench import csv --template x"]),
        (["import", "csv", "DATA", "--template", "x"], ["leave SOURCE and -o out"]),
        (["import", "csv", "DATA", "-o", "x", "--references"], ["--references is for --template DIR"]),
        (["import", "csv", "DATA", "-o", "x", "--robot-type", "diff"], ["--set robot=FILE"]),
        (["compare", "CONFIG", "--plugins", "CONFIG"], ["is a file; name the folder"]),
        (["plugin", "check", "DATA"], ["is a folder"]),
        (["plugin", "new", "My-Search"], ["'My-Search'"]),
        (["plugin", "new", "mine", "--kind", "costt"], ["'costt'", "'cost'"]),
    ],
    ids=lambda value: " ".join(value)[:50],
)
def test_a_mistake_is_one_line(arguments: list[str], parts: list[str], command: Command, prepared: Prepared) -> None:
    places = {"CONFIG": prepared.config, "DATA": prepared.data, "CALIBRATION": prepared.calibration}

    def placed(argument: str) -> str:
        for name, path in places.items():
            argument = argument.replace(name, str(path))
        return argument

    assert_refused(command(*map(placed, arguments)), *parts)


def test_a_mistake_is_one_line_in_a_real_process_too(tmp_path: Path) -> None:
    assert_refused(omnibench("compare", tmp_path / "nowhere.yaml"), "nowhere.yaml: no such file")


def test_nothing_typed_shows_the_help(command: Command) -> None:
    printed = command()
    assert printed.returncode == 2
    assert printed.stderr.startswith("Usage: omnibench [OPTIONS] COMMAND")
    assert "\n  compare " in printed.stderr
    assert printed.stdout == ""


def test_a_reader_that_has_gone_is_no_error(prepared: Prepared) -> None:
    shell = f"{COMMAND[0]} -m omnibench inspect {prepared.data} --json | true; exit ${{PIPESTATUS[0]}}"
    run = subprocess.run(["bash", "-c", shell], env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert run.returncode in (0, 1)
    assert run.stderr == ""


@pytest.mark.parametrize("closed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_stream_that_was_closed_before_the_start_is_no_traceback(closed: int) -> None:
    run = succeeded(omnibench("list", preexec_fn=lambda: os.close(closed)))
    assert "Traceback" not in run.stderr
    assert ("closed_form" in run.stdout) == (closed == 2)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_full_disk_behind_standard_output_is_one_line() -> None:
    shell = f"{COMMAND[0]} -m omnibench schema > /dev/full"
    run = subprocess.run(["bash", "-c", shell], env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (2, "error: output: No space left on device\n")


FULL = "cannot be written: File too large"


@pytest.mark.parametrize("arguments", ["calibrate {data} -o new/c.yaml", "plugin new mine", "simulate {config} -o new"])
def test_a_file_too_large_for_the_disk_is_not_there(arguments: str, command: Command, prepared: Prepared) -> None:
    with disk_that_takes(600):  # the line on standard error
        run = command(*arguments.format_map(prepared._asdict()).split())
    assert_refused(run, FULL)
    assert [file for file in Path().rglob("*") if file.is_file()] == []


@pytest.mark.parametrize("name", ["robot", "data set", "session"])
def test_a_very_long_name_is_one_short_line(name: str, command: Command, prepared: Prepared, tmp_path: Path) -> None:
    long, data, file = "x" * 100_000, tmp_path / "data", tmp_path / "calibration.yaml"
    shutil.copytree(prepared.data, data)
    calibration, header = (yaml.safe_load(each.read_text()) for each in (prepared.calibration, data / "dataset.yaml"))
    if name == "robot":
        calibration["robot"]["name"] = long
    elif name == "data set":
        header["name"] = long
    else:
        runs = pl.read_parquet(data / "trajectories.parquet")
        runs.with_columns(session=pl.lit(long)).write_parquet(data / "trajectories.parquet")
    file.write_text(yaml.safe_dump(calibration))
    (data / "dataset.yaml").write_text(yaml.safe_dump(header))
    run = command("evaluate", file, data)
    assert_refused(run, str(tmp_path), "characters")
    assert len(run.stderr) < 500


@pytest.mark.slow
def test_a_disk_that_is_full_is_said_before_the_work(prepared: Prepared, tmp_path: Path) -> None:
    mounted = ["unshare", "--map-root-user", "--mount", "sh", "-c", 'mount -t tmpfs -o size=16k none "$0" && exec "$@"']
    mounted.append(str(tmp_path))
    if subprocess.run([*mounted, "true"], capture_output=True, check=False).returncode:
        pytest.skip("a small disk cannot be mounted here")
    calibrate = [*COMMAND, "calibrate", prepared.data, "-o", tmp_path / "c.yaml", "--plugins", "none"]
    run = subprocess.run([*mounted, *calibrate], capture_output=True, text=True, env=ENVIRONMENT, check=False)
    assert_refused(run, f"{tmp_path}/c.yaml: cannot be written: No space left on device")


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
        Path(name).write_text("written: by hand\n", encoding="utf-8")
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
    succeeded(command(*arguments.split(), "--force"))
    assert contents(here)[written] != before[written]


def test_empty_files_and_folders_are_no_loss_and_other_files_are_even_by_force(command: Command, here: Path) -> None:
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
