"""``omnibench slam`` and ``discover`` as a user runs them: their results, folders, and what a terminal shows."""

import json
import math
import re
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
import pytest
import yaml
from commands import ENVIRONMENT, Command, Printed, assert_refused, python, run_here, succeeded
from discovery_samples import EXPERIMENT, SMALL, incomplete, named, nameless, nothing, simulated
from drives import calibration
from nodes import Command as CommandProcess
from recording_samples import in_room
from report_page import Page, on_terminal
from sessions import until

from omnibench.config import parse_yaml
from omnibench.data.dataset import make_dataset
from omnibench.data.scans import ScansInMemory, TrajectoryScans
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.data.true_poses import TruePath, write_true_poses
from omnibench.discover.output import DiscoverOptions, write_discovery
from omnibench.discover.report.discovery_result import DiscoveryResult
from omnibench.discover.result import Discovery
from omnibench.errors import DataError
from omnibench.registry import effects, load_plugins
from omnibench.report.terminal import print_result, print_table
from omnibench.robot.calibration import read_calibration, write_calibration
from omnibench.robot.model import OdometryModel
from omnibench.simulate.floor_plan import RoomPlan, make_plan
from omnibench.simulate.lidar import Lidar, measure_scans, scan_stamps
from omnibench.slam.slam_dataset import distances
from omnibench.testing.synthetic import PERIOD, synthetic_robot, synthetic_trajectories, true_robot

ROBOT = synthetic_robot()
LIDAR = Lidar(rays=540)


class Driven(NamedTuple):
    """A data set with scans, in which the poses recorded are wrong, and its truth."""

    data: Path
    truth: Path


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Driven:
    """Three runs of the synthetic robot in the furnished room; the poses recorded are 5 cm and 1 deg off."""
    folder, rng = tmp_path_factory.mktemp("driven"), np.random.default_rng(4)
    plan = make_plan(RoomPlan(plan="furnished_room"), "test")
    model = OdometryModel(ROBOT, true_robot(ROBOT).inverse_kinematic_matrix, "arc")
    runs, scans, truth = [], {}, {}
    for run in synthetic_trajectories(ROBOT)[:3]:
        times = np.arange(0.0, run.times[-1] + 1e-9, 0.002)
        (path,) = model.poses([run.log(times)])
        stamps = scan_stamps(LIDAR, float(run.times[-1]), rng)
        scans[run.id] = measure_scans(plan, LIDAR, TruePath(times, in_room(plan.start, path)), stamps, rng)
        truth[run.id] = TruePath(times, path)
        wrong = run.poses + np.where(run.pose_times[:, None] > 0, [0.03, 0.04, math.radians(1.0)], 0.0)
        runs.append(replace(run, poses=wrong))
    data = make_dataset("driven", ROBOT, PERIOD, runs, simulated=True, scans=ScansInMemory(LIDAR.scanner, scans))
    save_dataset(data, folder / "data")
    write_true_poses(folder / "truth", truth)
    return Driven(folder / "data", folder / "truth")


class Found(NamedTuple):
    """What the command printed, and the data set that it wrote."""

    run: Printed
    data: Path


@pytest.fixture(scope="module")
def found(driven: Driven, tmp_path_factory: pytest.TempPathFactory) -> Found:
    folder = tmp_path_factory.mktemp("found")
    return Found(run_here("slam", driven.data, "-o", "found", cwd=folder), folder / "found")


@pytest.fixture(scope="module")
def document(driven: Driven, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the command prints as JSON of poses that it does not write."""
    folder = tmp_path_factory.mktemp("json")
    run = run_here("slam", driven.data, "--json", "--truth", driven.truth, cwd=folder)
    assert not list(folder.iterdir())
    return json.loads(run.stdout)


def test_the_poses_are_those_of_the_truth_and_the_rest_is_as_it_was(found: Found, driven: Driven) -> None:
    assert found.run.returncode == 0, found.run.stderr
    before, after = load_dataset(driven.data), load_dataset(found.data)
    assert (after.name, after.simulated, after.scans.scanner) == ("driven", True, before.scans.scanner)
    true = pl.read_parquet(driven.truth / "poses.parquet")
    for old, new in zip(before.trajectories, after.trajectories, strict=True):
        assert (old.id, old.split) == (new.id, new.split)
        np.testing.assert_array_equal(old.rates, new.rates)
        np.testing.assert_array_equal(after.scans.of(new.id).ranges, before.scans.of(old.id).ranges)
        np.testing.assert_array_equal(new.pose_times, before.scans.times(old.id))
        path = true.filter(pl.col("trajectory") == new.id)
        ends = [np.interp(new.pose_times[-1], path["t"], path[name]) for name in ("x", "y", "theta")]
        np.testing.assert_allclose(new.final_pose, ends, rtol=0, atol=0.01)
        assert new.pose_covariances is not None
    count = sum(len(before.scans.times(run.id)) for run in before.trajectories)
    assert "driven, simulated data: reference poses from the scans" in found.run.stdout
    assert f"3 runs, {count} scans; " in found.run.stdout
    assert re.search(r"^poses +– +12 *$", found.run.stdout, re.MULTILINE)  # that are compared with the recorded ones
    assert "truth" not in found.run.stdout
    # A busy machine is told every 10 s how far it is; the last sentence has two lines.
    assert all(line.startswith("SLAM: ") for line in found.run.stderr.splitlines()[:-2])


def test_json_holds_the_same_figures(document: dict[str, Any]) -> None:
    assert (document["dataset"], document["simulated"], document["runs"]) == ("driven", True, 3)
    assert 0.2 < document["matched_min"] <= document["matched_mean"] <= 1
    assert 1e-4 < document["position_deviation_mean_m"] <= document["position_deviation_max_m"] < 0.01
    recorded, accuracy = document["recorded"], document["accuracy"]
    assert recorded["position_mean_m"] == pytest.approx(0.05, abs=0.01)
    assert recorded["heading_mean_rad"] == pytest.approx(math.radians(1.0), abs=0.005)
    assert accuracy["final"]["position_mean_m"] < 0.01
    assert accuracy["final"]["heading_mean_rad"] < math.radians(0.3)


@pytest.mark.slow
def test_the_search_can_start_from_the_last_pose(command: Command, driven: Driven, document: dict[str, Any]) -> None:
    figures = {"odometry": document["accuracy"]["every"]["position_mean_m"]}
    for name, arguments in {
        "last": ["--start", "last_pose"],
        "skewed": ["--no-deskew"],
        "set": ["--set", "deskew=false"],
    }.items():
        run = command("slam", driven.data, "--json", "--truth", driven.truth, *arguments)
        figures[name] = json.loads(run.stdout)["accuracy"]["every"]["position_mean_m"]
    assert figures["last"] < 0.01
    assert figures["last"] != figures["odometry"]
    assert figures["skewed"] == figures["set"] != figures["odometry"]


def test_a_calibration_can_give_the_odometry(command: Command, driven: Driven, found: Found) -> None:
    assert command("calibrate", found.data, "-o", "calibration.yaml").returncode == 0
    succeeded(command("slam", driven.data, "-o", "second", "--model", "calibration.yaml"))
    apart = distances(load_dataset(found.data), load_dataset("second"))
    assert apart.position_p95_m < 0.001


@pytest.mark.slow
def test_an_effect_of_a_plug_in_works_in_the_calibration(command: Command, driven: Driven) -> None:
    assert command("plugin", "new", "swerve", "--effect").returncode == 0
    assert command("calibrate", driven.data, "-o", "calibration.yaml").returncode == 0
    fitted = yaml.safe_load(Path("calibration.yaml").read_text())
    fitted["covariance"] = None
    load_plugins(["plugins"], installed=False)
    parameters = effects.entry("swerve", "test").cls().parameters(ROBOT)
    fitted["effects"] = [{"name": "swerve", "parameters": {parameter.name: 0.0 for parameter in parameters}}]
    Path("calibration.yaml").write_text(yaml.safe_dump(fitted))
    succeeded(command("slam", driven.data, "-o", "found", "--model", "calibration.yaml", "--plugins", "plugins"))
    assert len(load_dataset("found").trajectories) == 3


def test_the_truth_gives_errors_bias_and_drift_and_a_report(command: Command, driven: Driven, found: Found) -> None:
    run = command(
        *("slam", driven.data, "-o", "csv", "--format", "csv"), *("--report", "slam.html", "--truth", driven.truth)
    )
    assert run.returncode == 0, run.stderr
    assert "Errors of the reference poses against the truth" in run.stdout
    for row in ("position mean (mm)", "heading p95 (°)", "bias forward (mm)", "bias left (mm)", "nees mean"):
        assert re.search(rf"^{re.escape(row)} +[−+\d]", run.stdout, re.MULTILINE)
    assert re.search(r"3 runs, [23]\.\d+ m in all; drift \S+ mm", run.stdout)
    assert "SIMULATED DATA" in Path("slam.html").read_text(encoding="utf-8")
    assert {file.suffix for file in Path("csv").iterdir()} == {".yaml", ".csv"}
    assert load_dataset("csv").hash == load_dataset(found.data).hash


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["DATA"], ["-o DATASET"]),
        (["DATA", "-o", "DATA"], ["is the recording itself"]),
        (["nowhere", "-o", "found"], ["nowhere: no such folder"]),
        (["BARE", "-o", "found"], ["data set driven", "scans.parquet"]),
        (["PART", "-o", "found"], ["trajectory 02 has no scans"]),
        (["EMPTY", "-o", "found"], ["scans.parquet, row 2", "trajectory 01"]),
        (["DATA", "-o", "EMPTY/dataset.yaml"], ["is a file"]),
        (["DATA", "-o", "PLUGINS"], ["holds other files"]),
        (["DATA", "-o", "found", "--start", "lastpose"], ["--start", "'lastpose'"]),
        (["DATA", "-o", "found", "--set", "spacng=1"], ["slam --set", "'spacng'", "'spacing'"]),
        (["DATA", "-o", "found", "--set", "spacing=-1"], ["slam --set: spacing: ", "given: -1"]),
        (["DATA", "-o", "found", "--truth", "nowhere"], ["nowhere: no poses.parquet"]),
        (["DATA", "-o", "found", "--truth", "OTHER"], ["trajectory 01 is not in the truth"]),
        (["DATA", "-o", "found", "--model", "nowhere"], ["nowhere: no such file"]),
        (["DATA", "-o", "found", "--model", "x.yaml", "--start", "last_pose"], ["--model x.yaml", "--start odometry"]),
        (["DATA", "-o", "found", "--model", "FOUR"], ["fl, fr, rl, rr", "a, b, c"]),
    ],
)
def test_a_mistake_is_one_line_and_writes_nothing(
    command: Command, driven: Driven, places: dict[str, Path], arguments: list[str], parts: list[str]
) -> None:
    named = [_placed(argument, places) for argument in arguments]
    before = load_dataset(driven.data).hash
    printed = command("slam", *named)
    told = printed.stderr.splitlines()  # that SLAM begins, where only its work finds the mistake, and the line
    assert_refused(printed._replace(stderr=told[-1] + "\n"), *parts)
    assert set(told[:-1]) <= {"SLAM: 1 run"}
    assert not Path("found").exists()
    assert load_dataset(driven.data).hash == before


def _placed(argument: str, places: dict[str, Path]) -> str:
    first, _, rest = argument.partition("/")
    return str(places[first] / rest) if first in places else argument


@pytest.fixture(scope="module")
def places(driven: Driven, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Data sets with one thing wrong in each, and other things that are none."""
    folder, data = tmp_path_factory.mktemp("places"), load_dataset(driven.data)
    places = {name: folder / name.lower() for name in ("BARE", "PART", "EMPTY", "OTHER", "PLUGINS")}
    save_dataset(replace(data, scans=None), places["BARE"])
    one = ScansInMemory(data.scans.scanner, {"01": data.scans.of("01")})
    save_dataset(replace(data, scans=one), places["PART"])
    broken = data.scans.of("01")
    broken.ranges[1] = np.inf
    save_dataset(
        replace(data, trajectories=data.trajectories[:1], scans=ScansInMemory(one.scanner, {"01": broken})),
        places["EMPTY"],
    )
    write_true_poses(places["OTHER"], {"99": TruePath(np.array([0.0, 1.0]), np.zeros((2, 3)))})
    places["PLUGINS"].mkdir()
    (places["PLUGINS"] / "notes.txt").write_text("mine")
    write_calibration(calibration(wheels=4), folder / "four.yaml")
    return places | {"DATA": driven.data, "FOUR": folder / "four.yaml"}


def first_scans(driven: Driven) -> TrajectoryScans:
    """The scans of the first run that was driven."""
    data = load_dataset(driven.data)
    return data.scans.of(data.trajectories[0].id)


def save_runs(driven: Driven, folder: Path, scans: dict[str, TrajectoryScans]) -> None:
    """Save the first run that was driven once under each name, with these scans."""
    data = load_dataset(driven.data)
    runs = tuple(replace(data.trajectories[0], id=name) for name in scans)
    save_dataset(replace(data, trajectories=runs, scans=ScansInMemory(data.scans.scanner, scans)), folder)


@pytest.mark.slow
def test_ctrl_c_keeps_paths(command: Command, driven: Driven, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scans = first_scans(driven)
    save_runs(driven, tmp_path / "many", {f"{number:04d}": scans for number in range(16)})
    with CommandProcess("slam", "many", "-o", "found", cwd=tmp_path) as slam:
        while not (kept := len(list((tmp_path / "found.slam-paths").glob("*.json")))):
            assert slam.process.poll() is None
            time.sleep(0.01)
        out, err = slam.stop()
    assert (slam.process.returncode, out) == (130, "")
    files = {file: file.stat().st_mtime_ns for file in (tmp_path / "found.slam-paths").iterdir()}
    assert kept <= len(files) < 16
    (line,) = [line for line in err.splitlines() if not line.startswith("SLAM: ")]
    assert "found.slam-paths" in line
    assert {file.name for file in tmp_path.iterdir()} == {"many", "found.slam-paths"}
    monkeypatch.chdir(tmp_path)
    succeeded(command("slam", "many", "-o", "found"))
    assert {file.name for file in tmp_path.iterdir()} == {"many", "found"}
    poses = {trajectory.poses.tobytes() for trajectory in load_dataset("found").trajectories}
    assert len(poses) == 1  # of one run, whoever found its path


def test_errors_keep_paths(command: Command, driven: Driven, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scans = first_scans(driven)
    empty = replace(scans, ranges=np.zeros_like(scans.ranges))
    # Two are worked on at a time: others end before the last begins.
    save_runs(driven, tmp_path / "four", {"1": scans, "2": scans, "3": scans, "4": empty})
    monkeypatch.chdir(tmp_path)
    run = command("slam", "four", "-o", "found")
    assert (run.returncode, run.stdout) == (2, "")
    for part in ("four/scans.parquet, row 49", "trajectory 4", "found.slam-paths"):
        assert part in run.stderr.splitlines()[-1]
    assert {file.name for file in tmp_path.iterdir()} == {"four", "found.slam-paths"}


def test_ctrl_c_before_the_first_path_leaves_nothing(driven: Driven, tmp_path: Path) -> None:
    program = "import os, signal, sys, threading; sys.argv[0] = 'omnibench'; "
    program += "from omnibench.__main__ import main; import omnibench.cli.app, omnibench.slam.slam_dataset; "
    program += "threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start(); main()"
    run = python(program, "slam", driven.data, "-o", "found", cwd=tmp_path, env=ENVIRONMENT)
    assert run.returncode == 130
    assert [line for line in run.stderr.splitlines() if line][-1].startswith("interrupted")  # by imports, or later
    assert list(tmp_path.iterdir()) == []


def test_inspect_says_what_scans_there_are(command: Command, driven: Driven) -> None:
    run = command("inspect", driven.data)
    assert "540 ranges over 270°, to 30 m" in run.stdout
    assert "scans: 100% of the rays measured" in run.stdout
    document = json.loads(command("inspect", driven.data, "--json").stdout)["scans"]
    scans = load_dataset(driven.data).scans
    assert document["scans"] == sum(len(scans.times(name)) for name in scans.trajectories)
    assert (document["trajectories"], document["rays"]) == (3, 540)
    assert 0.2 <= document["scan_period_s"] <= 0.3
    assert 0.99 < document["seen_share"] < 1


def test_inspect_names_runs_without_scans_and_refuses_broken_ones(command: Command, places: dict[str, Path]) -> None:
    assert json.loads(command("inspect", places["BARE"], "--json").stdout)["scans"] is None
    assert "2 trajectories have no scans, e.g. 02, 03" in command("inspect", places["PART"]).stdout
    assert_refused(command("inspect", places["EMPTY"]), "row 2: the scan of trajectory 01")


# The command ``discover``, the folder that it writes, and what it shows on a terminal.

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
    extended, plain = (read_calibration(told.document[name]) for name in ("model", "plain_model"))
    assert [term.name for term in extended.effects] == ["rotation_translation_coupling"]
    assert not plain.effects


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
    assert "\nslip:" in plain  # so that evaluate predicts its errors on paths
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
LEFT_OVER = ("wheel rate (2 × 10⁻¹¹)", "v0.4_a90_w1 turns at 1.0 rad/s", "experiment-1.yaml")
SHOWN: dict[Callable[[], Discovery], tuple[str, ...]] = {
    named: ("(simulated data): 36 training runs", "verdict: named", "held-out session: 36 runs", "now/model.yaml"),
    nameless: ("verdict: unknown",),
    incomplete: DRIVE + LEFT_OVER,
    in_doubt: ("load_transfer", "few turns"),
    many_notes: ("verdict: none", "- note 2 6 more remarks in the report", "report: results/flower/now/report.html"),
}


@pytest.mark.parametrize("make", SHOWN)
def test_what_is_found_is_told_on_a_screen_of_eighty_columns(make: Callable[[], Discovery]) -> None:
    result = DiscoveryResult(make(), Path("results/flower/now"))
    for table in result.tables():
        assert max(len(line.rstrip()) for line in on_terminal(print_table, table).splitlines()) <= 80
    text = " ".join(on_terminal(print_result, result).split())
    assert "…" not in text
    for part in SHOWN[make]:
        assert part in text
    assert make != named or re.search(r"rotation_translation_coupling \(body\), weight 9[5-9]\.\d %", text)
