"""The check of a recording as a user types it: verdict, findings, and fixes that mend what they are said to mend."""

import json
import re
import shlex
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from clean_logs import checked
from commands import run_here
from config_robots import experiment
from driven_path import DrivenPath
from hypothesis import example, given
from hypothesis import strategies as st
from wheeled_samples import TRICYCLE, driven

from omnibench import check, save_dataset
from omnibench.check.check import CheckReport
from omnibench.config import as_yaml, parse_settings
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.references import Reference, References
from omnibench.fit.evaluate import command_names
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog
from omnibench.simulate.source import simulate_dataset

Change = Callable[[Trajectory], Trajectory]
command = partial(run_here, cwd=Path())


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@cache
def recording() -> Dataset:
    """Eight drives of a differential robot from rest, in legs, with a reference that scatters."""
    robot = simulate_dataset(experiment("diff")).dataset.robot
    runs = []
    for seed in range(8):
        rng = np.random.default_rng(seed % 4)  # four commands, each twice
        edges = np.arange(0.0, 24.01, 0.04)
        levels = np.vstack([np.zeros((1, 2)), rng.uniform(-4, 5, (8, 2)), [[3.0, 3.0]], [[4.0, 4.0]], np.zeros((2, 2))])
        rates = levels[np.minimum((edges[1:] / 2).astype(int), len(levels) - 1)]
        rates = np.array([np.convolve(each, np.ones(8) / 8)[: len(rates)] for each in rates.T]).T
        matrix = robot.inverse_kinematic_matrix * np.array([[1.03], [1.0], [0.96]])
        noise = np.random.default_rng(100 + seed)
        moved = rates * (1 + 0.01 * noise.normal(size=rates.shape)) * 0.04
        path = DrivenPath(edges[1:], np.zeros(3), moved @ matrix.T, "arc")
        stamps = np.arange(0.0, 24.0, 0.05)
        poses = path.poses(stamps) + noise.normal(0, [0.001, 0.001, 0.003], (len(stamps), 3))
        runs.append(Trajectory(f"run{seed}", "train", edges[1:], rates, stamps, poses, command=f"c{seed % 4}"))
    return make_dataset("base", robot, 0.04, runs)


def changed(change: Change, only: str = "") -> Dataset:
    runs = [change(run) if only in ("", run.id) else run for run in recording().trajectories]
    return make_dataset("base", recording().robot, 0.04, runs)


def without(begin: float, end: float, wheels: bool) -> Change:
    def change(run: Trajectory) -> Trajectory:
        if wheels:
            kept = (run.times < begin) | (run.times > end)
            return replace(run, times=run.times[kept], rates=run.rates[kept])
        kept = (run.pose_times < begin) | (run.pose_times > end)
        return replace(run, pose_times=run.pose_times[kept], poses=run.poses[kept])

    return change


def jumped(run: Trajectory) -> Trajectory:
    return replace(run, poses=run.poses + 0.5 * (run.pose_times > 10)[:, None] * (1, 0, 0))


def standing(run: Trajectory) -> Trajectory:
    half = int(np.searchsorted(run.pose_times, 10.0))
    return replace(
        run, poses=np.vstack([run.poses[:half], np.repeat(run.poses[half : half + 1], len(run.poses) - half, 0)])
    )


def late(run: Trajectory) -> Trajectory:
    stamps = np.append(0.0, run.pose_times + 0.4)
    return replace(run, pose_times=stamps[:-9], poses=np.vstack([run.poses[:1], run.poses])[:-9])


def kinds(report: CheckReport) -> set[str]:
    return {finding.kind for finding in report.findings}


def typed(words: str) -> None:
    """Run a command as the check prints it."""
    program, *arguments = shlex.split(words)
    assert program == "omnibench"
    assert command(*arguments).returncode == 0


def test_a_sound_recording_is_ready_and_its_calibration_is_needed() -> None:
    report = check(recording())
    assert (report.verdict, kinds(report)) == ("ready", set())
    assert report.needed is True


TYPED: dict[str, tuple[Change, str]] = {
    "wheel_dropout": (without(6.0, 8.0, wheels=True), "run1"),
    "reference_dropout": (without(6.0, 8.5, wheels=False), "run1"),
    "reference_jump": (jumped, "run1"),
    "reference_frozen": (standing, "run1"),
    "clock_offset": (late, ""),
    "wheel_negated": (lambda run: replace(run, rates=run.rates * (1, -1)), ""),
    "wheel_scale": (lambda run: replace(run, rates=run.rates * 4), ""),
}

QUICK = ("clock_offset", "wheel_negated", "heading_unit")


def lanes(cases: Iterable[str]) -> list[Any]:
    return [case if case in QUICK else pytest.param(case, marks=pytest.mark.slow) for case in cases]


@pytest.mark.parametrize("kind", lanes(TYPED))
def test_a_fault_is_found_and_what_is_typed_for_it_mends_it(kind: str) -> None:
    save_dataset(changed(*TYPED[kind]), "log")
    report = check("log")
    assert report.verdict == "fix"
    (fix,) = {finding.fix for finding in report.findings if finding.kind == kind}
    assert fix.split(" --set ")[0] in shlex.split(report.command)
    typed(report.command)
    assert kind not in kinds(check("log_mended"))


def test_no_pose_jumps_beside_counters_of_few_ticks(tmp_path: Path) -> None:
    assert checked("diff", 4, 2, tmp_path).said == ()  # 19 ticks a turn


def test_ticks_without_their_unit_are_told_and_typed_as_ticks() -> None:
    save_dataset(changed(lambda run: replace(run, rates=run.rates * 4096 / (2 * np.pi))), "log")
    command = check("log").command
    (ticks,) = re.findall(r"--set wheel_unit=ticks/s --set ticks_per_turn=(\d+)", command)
    assert float(ticks) == pytest.approx(4096, rel=0.03)
    typed(command)
    assert check("log_mended").verdict == "ready"


def ends(run: Trajectory) -> Trajectory:
    """The run with its first and its last pose alone."""
    return replace(run, pose_times=run.pose_times[[0, -1]], poses=run.poses[[0, -1]])


def taped(run: Trajectory) -> Trajectory:
    """The run with its displacement and its turn, and no poses."""
    (x, y), (begin, end) = (run.poses[-1] - run.poses[0])[:2], run.poses[[0, -1], 2]
    moved = (x * np.cos(begin) + y * np.sin(begin), y * np.cos(begin) - x * np.sin(begin))
    measured = (Reference("displacement", moved, (0.005, 0.005)), Reference("turn", end - begin, 0.01))
    references = References.of(measured, run.times[-1])
    return replace(run, pose_times=np.zeros(1), poses=np.zeros((1, 3)), references=references)


def in_mm(run: Trajectory) -> Trajectory:
    lengths = np.where(run.references.kinds == "displacement", 1000.0, 1.0)[:, None]
    measured = replace(run.references, values=run.references.values * lengths, sigmas=run.references.sigmas * lengths)
    return replace(run, references=measured)


SPARSE: dict[str, Change] = {
    "wheels_swapped": lambda run: replace(ends(run), rates=run.rates[:, ::-1]),
    "heading_unit": lambda run: replace(ends(run), poses=ends(run).poses * (1, 1, 180 / np.pi)),
    "position_unit": lambda run: in_mm(taped(run)),
}


@pytest.mark.parametrize("change", [ends, taped])
def test_sparse_references_that_are_right_tell_that_a_calibration_is_needed(change: Change) -> None:
    report = check(changed(change))
    assert (report.command, report.needed) == ("", True)
    assert report.gain.startswith("cross-validated (8 runs): ")


@pytest.mark.parametrize("kind", lanes(SPARSE))
def test_a_misreading_that_few_references_show_is_found_and_mended_as_typed(kind: str) -> None:
    save_dataset(changed(SPARSE[kind]), "log")
    report = check("log")
    assert (report.verdict, kind in kinds(report)) == ("fix", True)
    typed(report.command)
    assert "warning" not in command("inspect", "log_mended").stderr
    assert check("log_mended").command == ""


def test_a_data_set_in_ms_is_told_and_mended() -> None:
    save_dataset(recording(), "log")
    for file in (Path("log/wheels.parquet"), Path("log/poses.parquet")):
        frame = pl.read_parquet(file)
        frame.with_columns(t=frame["t"] * 1000).write_parquet(file)
    (finding,) = check("log").findings
    assert finding.kind == "time_unit"
    typed(check("log").command)
    assert check("log_mended").verdict == "ready"


def test_a_gain_that_clocks_hide_is_not_told_in_figures() -> None:
    def off(run: Trajectory) -> Trajectory:
        stamps = np.append(0.0, run.pose_times + 1.0)
        return replace(run, pose_times=stamps[:-20], poses=np.vstack([run.poses[:1], run.poses])[:-20])

    runs = [off(run) for run in recording().trajectories if run.command in ("c0", "c1")]
    report = check(make_dataset("base", recording().robot, 0.04, runs))
    assert "clock_offset" in kinds(report)
    assert report.needed is None
    assert "clocks" in report.gain
    assert not re.search(r"\d", report.gain)


def test_a_wheel_that_never_turns_is_dead() -> None:
    report = check(changed(lambda run: replace(run, rates=run.rates * (1, 0))))
    assert report.verdict == "record more"
    assert [(f.kind, f.where) for f in report.findings] == [("wheel_dead", f"wheel {recording().robot.wheel_names[1]}")]


def test_poses_of_other_runs_are_not_what_the_wheels_drove() -> None:
    runs = recording().trajectories
    others = [replace(run, poses=other.poses) for run, other in zip(runs, (*runs[1:], runs[0]), strict=True)]
    report = check(make_dataset("base", recording().robot, 0.04, others))
    assert (report.verdict, kinds(report), report.gain) == ("record more", {"reference_foreign"}, "")
    assert repr(report).splitlines()[1].startswith("error: the wheels explain ")


def test_poses_that_end_long_before_the_wheels_are_told() -> None:
    report = check(changed(lambda run: replace(run, pose_times=run.pose_times / 100)))
    assert "reference_foreign" in kinds(report)
    assert "0.24 s of 24 s" in report.sentence


@pytest.mark.parametrize("driven", [24.0, 3.0])
def test_a_reference_that_stands_still_throughout_is_frozen_and_nothing_else(driven: float) -> None:
    def still(run: Trajectory) -> Trajectory:
        rates = run.rates * (np.abs(run.times - 12.0) < driven / 2)[:, None]
        return replace(run, rates=rates, poses=np.repeat(run.poses[:1], len(run.poses), 0))

    report = check(changed(still))
    assert (report.verdict, kinds(report)) == ("record more", {"reference_frozen"})


def test_copies_of_runs_are_named() -> None:
    first, *others = recording().trajectories
    copy = replace(others[3], id="copy", times=others[3].times[:-40], rates=others[3].rates[:-40])
    copy = replace(copy, pose_times=copy.pose_times[:-60], poses=copy.poses[:-60])
    dataset = make_dataset("base", recording().robot, 0.04, [first, *others[1:], copy])
    assert [f.where for f in check(dataset).findings if f.kind == "copies"] == ["run copy"]


@pytest.mark.parametrize("late", [0.0, 0.4])
def test_runs_that_begin_in_motion_are_told_whatever_the_clocks(late: float) -> None:
    def cut(run: Trajectory) -> Trajectory:
        kept, seen = run.times > 5.01, run.pose_times >= 4.99 + late
        moved = {"pose_times": run.pose_times[seen] - run.pose_times[seen][0], "poses": run.poses[seen]}
        return replace(run, times=run.times[kept] - 5.0, rates=run.rates[kept], **moved)

    assert "not_at_rest" in kinds(check(changed(cut)))


def test_a_recording_without_turns_lacks_them_in_words() -> None:
    def straight(run: Trajectory) -> Trajectory:
        kept = run.times > 17.6
        moved = DrivenPath(run.times, np.zeros(3), np.abs(run.rates[:, :1]) * (0.004, 0, 0), "arc")
        noise = np.random.default_rng(0).normal(0, [0.001, 0.001, 0.002], (len(run.pose_times), 3))
        rates = np.repeat(np.abs(run.rates[:, :1]), 2, axis=1)
        assert kept.any()
        return replace(run, rates=rates, poses=moved.poses(run.pose_times) + noise)

    (finding,) = [finding for finding in check(changed(straight)).findings if finding.kind == "motion_missing"]
    assert (finding.what, finding.fix[:17]) == ("the robot never turned", "drive three turns")


def test_json_holds_verdict_need_and_findings_alone() -> None:
    save_dataset(changed(jumped, "run1"), "log")
    document = json.loads(command("check", "log", "--json").stdout)
    assert set(document) == {"verdict", "needed", "findings", "command"}
    assert set(document["findings"][0]) == {"kind", "what", "where", "severity", "fix"}


def test_the_report_shows_stamps_before_and_after() -> None:
    save_dataset(changed(late), "log")
    assert command("check", "log", "--report", "check.html").returncode == 1
    page = Path("check.html").read_text()
    assert "With matched stamps" in page
    assert "clocks=match" in page


@given(st.lists(st.text("0123456789abenotrufxy_./*-: #,", min_size=1, max_size=8), min_size=1, max_size=3))
@example(["01", "no", "1e3", "2024-01-02", "null", "0x10"])
def test_values_are_typed_so_that_they_are_read_as_they_are(names: list[str]) -> None:
    assert parse_settings([f"leave_out={as_yaml(names)}"]) == {"leave_out": names}


def test_values_from_python_are_typed_as_their_text() -> None:
    values = (Path("robots/a.yaml"), np.int64(3), 2.0, True)
    assert list(map(as_yaml, values)) == ["robots/a.yaml", "3", "2", "true"]


def test_a_data_set_in_memory_is_to_be_saved_before_its_fix_is_typed_whatever_folder_has_its_name() -> None:
    swapped = changed(lambda run: replace(run, rates=run.rates[:, ::-1]))
    alone = check(swapped)
    assert alone.command.endswith("# after save_dataset(dataset, 'base')")
    save_dataset(recording(), "base")
    assert check(swapped) == alone


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_robot_that_never_moved_is_not_ready() -> None:
    rest = changed(lambda run: replace(run, rates=0 * run.rates, poses=0 * run.poses + (1.0, 2.0, 0.5)))
    report = check(rest)
    assert report.verdict != "ready"
    assert "the robot never moved" in {finding.what for finding in report.findings}


def test_runs_with_a_tape_count_beside_runs_with_poses() -> None:
    tape = References.of([Reference("distance", 3.0, 0.01)], 24.0)

    def taped(run: Trajectory) -> Trajectory:
        if run.id in ("run0", "run4"):
            return run
        return replace(run, pose_times=np.zeros(1), poses=np.zeros((1, 3)), references=tape)

    kinds = {finding.kind for finding in check(changed(taped)).findings}
    assert not kinds & {"few_runs", "motion_missing"}


def test_wheel_samples_that_are_missing_are_told_of_runs_with_a_tape_too() -> None:
    gap = without(6.0, 9.0, wheels=True)
    report = check(changed(lambda run: gap(taped(run)) if run.id == "run1" else taped(run)))
    assert [(f.kind, f.where) for f in report.findings if f.severity == "error"] == [("wheel_dropout", "run run1")]


def test_a_tape_in_mm_is_told_beside_poses_in_m() -> None:
    report = check(changed(lambda run: run if run.id in ("run0", "run4") else in_mm(taped(run))))
    (finding,) = [each for each in report.findings if each.kind == "position_unit"]
    assert finding.where == "references of kind displacement"
    assert "import again" in finding.fix


def test_runs_without_a_command_share_a_name_where_their_wheels_turn_alike() -> None:
    runs = [replace(run, command=run.command if run.id == "run3" else None) for run in recording().trajectories]
    names = ["like run0", "like run1", "like run2", "c3"]
    assert command_names(runs) == [*names[:3], "c3", *names[:3], "like run7"]


def test_two_units_that_are_wrong_at_once_are_both_typed() -> None:
    sound = driven(TRICYCLE, 8, 200)
    runs = [
        replace(run, steering=np.degrees(run.steering), poses=run.poses * (1, 1, 180 / np.pi))
        for run in sound.trajectories
    ]
    save_dataset(make_dataset("trike", TRICYCLE, sound.sample_period, runs), "log")
    assert {"steering_unit=deg", "heading_unit=deg"} <= set(shlex.split(check("log").command))


def steered_runs(duration: float, reported: bool, noise: float, held: dict[str, tuple[float, float]]) -> Dataset:
    """Runs of a tricycle, each at a wheel rate, rad/s, and a steering angle, rad; its steering reports 0 if it is not
    ``reported``."""
    count = round(duration / 0.05)
    times, stamps = 0.05 * np.arange(1, count + 1), np.arange(0.0, duration, 0.1)
    runs = []
    for name, (rate, angle) in held.items():
        rates, angles = np.full((count, 1), rate), np.full((count, 1), angle)
        log = WheelLog(times, rates, np.zeros(3), stamps, steering=angles, drive=TRICYCLE.drive)
        (poses,) = OdometryModel.of_design(TRICYCLE, "arc").poses([log])
        scattered = poses + np.random.default_rng(len(runs)).normal(0, noise, poses.shape)
        runs.append(Trajectory(name, "train", times, rates, stamps, scattered, steering=angles * reported))
    return make_dataset("held", TRICYCLE, 0.05, runs)


def test_a_steering_that_is_held_is_frozen_only_if_it_counts_nothing() -> None:
    """Held forward and backward, its turns differ in sign by the way the wheels roll, and by nothing else."""
    held = {"f1": (6.0, 0.4), "b1": (-6.0, 0.4), "f2": (5.0, 0.4), "b2": (-5.0, 0.4)}
    assert "steering_frozen" not in kinds(check(steered_runs(10.0, True, 0.001, held)))
    circle_and_line = {"circle": (6.0, 0.15), "line": (6.0, 0.0)}
    assert "steering_frozen" in kinds(check(steered_runs(20.0, False, 0.003, circle_and_line)))
