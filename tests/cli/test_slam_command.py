"""``omnibench slam`` as a user runs it: poses from the scans of a data set, and how good they are."""

from __future__ import annotations

import json
import math
import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
import pytest
import yaml
from commands import ENVIRONMENT, Command, Printed, assert_refused, python, run_here, succeeded
from drives import calibration
from nodes import Command as CommandProcess
from recording_samples import in_room

from omnibench.data.dataset import make_dataset
from omnibench.data.scans import ScansInMemory, TrajectoryScans
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.data.true_poses import TruePath, write_true_poses
from omnibench.registry import effects, load_plugins
from omnibench.robot.calibration import write_calibration
from omnibench.robot.model import OdometryModel
from omnibench.simulate.floor_plan import RoomPlan, make_plan
from omnibench.simulate.lidar import Lidar, measure_scans, scan_stamps
from omnibench.slam.slam_request import distances
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
    assert f"driven: simulated data; 3 runs, {count} scans, " in found.run.stdout
    assert "distance from the recorded reference (12 poses)" in " ".join(found.run.stdout.split())
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
    assert "last of each run (3 poses)" in run.stdout
    assert re.search(r"Mean error along the robot's axes\n[^─]*forward[^─]*left[^─]*heading", run.stdout)
    assert re.search(r"3 runs, [23]\.\d+ m in all", run.stdout)
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
        (["DATA", "-o", "found", "--truth", "OTHER"], ["trajectory 01 is not in it"]),
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


def test_an_error_keeps_paths(
    command: Command, driven: Driven, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    program += "from omnibench.__main__ import main; import omnibench.cli.app, omnibench.slam.slam_request; "
    program += "threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start(); main()"
    run = python(program, "slam", driven.data, "-o", "found", cwd=tmp_path, env=ENVIRONMENT)
    assert run.returncode == 130
    assert [line for line in run.stderr.splitlines() if line][-1].startswith("interrupted")  # by imports, or later
    assert list(tmp_path.iterdir()) == []


def test_inspect_says_what_scans_there_are(command: Command, driven: Driven) -> None:
    run = command("inspect", driven.data)
    assert "540 rays over 270 deg up to 30 m, of which 100% measured something" in run.stdout
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
