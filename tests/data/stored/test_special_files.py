"""Pipes, devices, bombs and odd names in the place of files: one line at once, by one door."""

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import polars as pl
import pytest
from commands import assert_refused, omnibench, run_here
from sample_robots import APR_02
from storage_samples import a_trajectory
from timing import PATIENCE

from omnibench.config import read_yaml
from omnibench.data.dataset import make_dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import ConfigError, DataError
from omnibench.files import read_text

_SIZE = 8 << 30  # bytes of a file of holes


def pipe(file: Path) -> None:
    os.mkfifo(file)


def device(file: Path) -> None:
    file.symlink_to("/dev/zero")


def unix_socket(file: Path) -> None:
    here = Path.cwd()
    os.chdir(file.parent)  # its name may have 108 bytes only
    socket.socket(socket.AF_UNIX).bind(file.name)
    os.chdir(here)


def holes(file: Path) -> None:
    file.write_text("trajectory,t,x,y,theta,split\n")
    os.truncate(file, _SIZE)


def few_holes(file: Path) -> None:
    file.write_text("trajectory,t,x,y,theta,split\n")
    os.truncate(file, 1 << 20)


def packed(file: Path) -> None:
    """Rows that would take 1 GB in memory, in a file of some kB."""
    rows = pl.int_range(30_000_000, dtype=pl.Int32)
    names = ("trajectory", "t", "x", "y", "theta")
    one = pl.LazyFrame().select(rows.alias("row"))
    one.select((pl.col("row") * 0.0).alias(name) for name in names).sink_parquet(file, row_group_size=30_000_000)


MADE: dict[Callable[[Path], None], str] = {
    pipe: "is a pipe; write its content to a file",
    device: "is a device; write its content to a file",
    unix_socket: "is a socket; write its content to a file",
    holes: "more than the",
    few_holes: "is not a text file",
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded") / "data"
    runs = [a_trajectory(name, 0.4, command="a") for name in ("r1", "r2")]
    save_dataset(make_dataset("recorded", APR_02, 0.1, runs), folder, "csv")
    return folder


@pytest.fixture
def folder(recorded: Path, tmp_path: Path) -> Path:
    shutil.copytree(recorded, tmp_path / "data")
    return tmp_path / "data"


@pytest.mark.parametrize("made", MADE, ids=lambda made: made.__name__)
@pytest.mark.parametrize("name", ["dataset.yaml", "wheels.csv", "poses.csv", "trajectories.csv"])
def test_a_data_set_with_a_special_file_is_refused(folder: Path, name: str, made: Callable[[Path], None]) -> None:
    (folder / name).unlink()
    made(folder / name)
    with pytest.raises(DataError, match=rf"{name}: .*{MADE[made] if name != 'dataset.yaml' else ''}"):
        load_dataset(folder)


@pytest.mark.parametrize("made", MADE, ids=lambda made: made.__name__)
def test_a_special_file_is_neither_yaml_nor_text(tmp_path: Path, made: Callable[[Path], None]) -> None:
    made(tmp_path / "robot.yaml")
    with pytest.raises(ConfigError, match=r"robot\.yaml: "):
        read_yaml(tmp_path / "robot.yaml")
    with pytest.raises(DataError, match=MADE[made]):
        read_text(tmp_path / "robot.yaml")


@pytest.mark.parametrize(
    "arguments",
    [
        ("check", "FILE"),
        ("import", "csv", "FILE", "-o", "new"),
        ("import", "rosbag", "FILE", "-o", "new"),
        ("evaluate", "FILE", "data"),
        ("export", "FILE", "--to", "ros2_controllers"),
        ("compare", "FILE"),
        ("live", "FILE"),
        ("design", "--robot", "FILE"),
        ("discover", "data", "--model", "FILE", "-o", "new"),
        ("replay", "FILE"),
        ("listen", "apr", "--config", "FILE"),
        ("plugin", "check", "FILE"),
    ],
    ids=" ".join,
)
def test_a_command_refuses_a_pipe_in_one_line(folder: Path, arguments: tuple[str, ...]) -> None:
    pipe(folder.parent / "FILE")
    assert_refused(run_here(*arguments, cwd=folder.parent), "FILE")


@pytest.mark.parametrize("name", ["wheels", "trajectories"])
def test_a_small_table_that_unpacks_to_gigabytes_is_refused_before_it_is_read(folder: Path, name: str) -> None:
    (folder / f"{name}.csv").unlink()
    packed(folder / f"{name}.parquet")
    assert (folder / f"{name}.parquet").stat().st_size < 1_000_000
    with pytest.raises(DataError, match=rf"{name}\.parquet: its .* MB would unpack to 1\.2 GB \(30,000,000 rows\)"):
        load_dataset(folder)


@pytest.mark.parametrize(
    ("name", "made", "message"),
    [
        ("metadata.yaml", pipe, "metadata.yaml: is a pipe"),
        ("metadata.yaml", lambda file: file.write_text("a: &a [1]\nb: *a\n"), "metadata.yaml: not valid YAML: line 2"),
        ("data.xyz", pipe, "data.xyz: is a pipe"),
    ],
)
def test_a_bag_with_special_files_is_refused(
    tmp_path: Path, name: str, made: Callable[[Path], object], message: str
) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    (tmp_path / "robot.yaml").write_text(APR_02.model_dump_json())
    if name != "metadata.yaml":
        (bag / "metadata.yaml").write_text(f"rosbag2_bagfile_information: {{relative_file_paths: [{name}]}}\n")
    made(bag / name)
    assert_refused(run_here("import", "rosbag", "bag", "-o", "new", cwd=tmp_path), message)


def write_log(folder: Path, table: str) -> None:
    """A folder of one table of a run, and its robot."""
    folder.mkdir()
    (folder / "robot.yaml").write_text(APR_02.model_dump_json())
    rows = "".join(f"{0.1 * number},1,1,1,0,0,0\n" for number in range(1, 30))
    (folder / table).write_text(f"t,omega_a,omega_b,omega_c,x,y,theta\n{rows}")


def test_a_pipe_among_the_tables_of_a_folder_is_refused(tmp_path: Path) -> None:
    write_log(tmp_path / "log", "run.csv")
    pipe(tmp_path / "log" / "runs.csv")
    assert_refused(run_here("import", "csv", "log", "-o", "new", cwd=tmp_path), "runs.csv: is a pipe")


@pytest.mark.skipif(not Path("/proc/self/pagemap").exists(), reason="files that the system makes are those of Linux")
def test_a_file_that_the_system_makes_is_refused(tmp_path: Path) -> None:
    (tmp_path / "calibration.yaml").symlink_to("/proc/self/pagemap")
    with pytest.raises(DataError, match=r"calibration\.yaml: has no size"):
        read_text(tmp_path / "calibration.yaml")


def test_a_table_with_a_text_that_is_no_name_is_refused(folder: Path) -> None:
    (folder / "poses.csv").unlink()
    columns = dict.fromkeys(("t", "x", "y", "theta"), 0.0)
    frame = pl.DataFrame({"trajectory": ["x" * 3_000_000] * 20, **{name: [0.0] * 20 for name in columns}})
    frame.write_parquet(folder / "poses.parquet")
    with pytest.raises(DataError, match=r"'trajectory' has a text of 3,000,000 characters"):
        load_dataset(folder)


def test_names_that_are_not_in_utf_8_are_refused_in_one_line(folder: Path) -> None:
    name = os.fsdecode(b"d\xe4ta")
    folder.rename(folder.with_name(name))
    assert_refused(omnibench("inspect", name, cwd=folder.parent), "d?ta: this name is not in UTF-8")
    for arguments in (("inspect", "--json", name), ("calibrate", name, "-o", "c.yaml")):
        assert_refused(run_here(*arguments, cwd=folder.parent), "this name is not in UTF-8")
    write_log(folder.parent / "log", os.fsdecode(b"r\xe4n.csv"))
    assert_refused(run_here("import", "csv", "log", "-o", "new", cwd=folder.parent), "not in UTF-8")


def test_names_that_spreadsheets_would_run_are_quoted_in_csv_and_come_back(tmp_path: Path) -> None:
    names = ("=1+2", "+a", "-x", "@sum", "'=a", "-1.5", "plain")
    runs = [a_trajectory(name, 0.4, command=name, session=name) for name in names]
    save_dataset(make_dataset("odd", APR_02, 0.1, runs), tmp_path / "d", "csv")
    for table in ("trajectories", "wheels", "poses"):
        cells = (tmp_path / "d" / f"{table}.csv").read_text().replace("\n", ",").split(",")
        assert not [cell for cell in cells if cell[:1] in "=+@" and cell]
        assert "-1.5" in cells
    read = load_dataset(tmp_path / "d").trajectories
    assert [(run.id, run.command, run.session) for run in read] == [(name,) * 3 for name in names]


def test_a_plugin_whose_import_never_ends_is_refused_by_every_command(tmp_path: Path) -> None:
    (tmp_path / "loop.py").write_text("while True:\n    pass\n")
    program = "import omnibench.registry as registry; registry._IMPORT_SECONDS = 0.5\n"
    program += f"import sys; sys.argv = ['omnibench', 'list', '--plugins', {str(tmp_path)!r}]\n"
    program += "from omnibench.__main__ import main; main()"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert run.returncode == 0
    assert "loop.py cannot be imported: PluginError: " in run.stderr
    assert "not imported within 0.5 s" in run.stderr
