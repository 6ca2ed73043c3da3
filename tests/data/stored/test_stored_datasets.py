"""Data sets whose wheel samples stay in their file give what they give in memory, and mend nothing silently."""

import math
import os
import pickle
import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
from lanes import slow
from sample_robots import APR_02, CAR, DIFFERENTIAL, MECANUM, SWERVE
from wheeled_samples import driven

import omnibench.data.stored as stored_samples
import omnibench.robot.stored_odometry as odometry_of_stored
from omnibench.check.check import check
from omnibench.data.dataset import Dataset
from omnibench.data.storage import in_few_words, load_dataset, save_dataset
from omnibench.data.stored import drawn_runs, median_period, read_block
from omnibench.errors import DataError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.certify import LowerBounds, certify_optimum
from omnibench.fit.evaluate import evaluate
from omnibench.fit.inspect import inspect_dataset
from omnibench.fit.problem import Budget, BudgetSpent, CalibrationProblem, make_parameterisation
from omnibench.registry import costs
from omnibench.robot.kinematics import Robot
from omnibench.robot.odometry import Samples, WheelLog


def recorded(robot: Robot = APR_02, runs: int = 12) -> Dataset:
    """Runs of four commands under a reference that is noisy; the later half validates."""
    dataset, rng = driven(robot, runs), np.random.default_rng(1)
    named = [
        replace(
            run,
            command=f"c{number % 4}",
            session="day",
            split="train" if number < runs // 2 else "validation",
            poses=run.poses + rng.normal(0, 0.005, run.poses.shape),
        )
        for number, run in enumerate(dataset.trajectories)
    ]
    return replace(dataset, trajectories=tuple(named))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("stored") / "fleet"
    save_dataset(recorded(runs=32), place)
    return place


@pytest.fixture
def nothing_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """Odometry reads the samples anew whenever it needs them, however few there are."""
    monkeypatch.setattr(odometry_of_stored, "_HELD", 0)
    monkeypatch.setattr(odometry_of_stored, "_TOGETHER", 200)


@pytest.mark.parametrize("robot", [APR_02, MECANUM, DIFFERENTIAL, CAR, SWERVE], ids=lambda robot: robot.name)
def test_what_stays_in_its_file_is_the_data_set_that_was_saved(robot: Robot, tmp_path: Path) -> None:
    save_dataset(recorded(robot), tmp_path / "saved")
    held, stored = load_dataset(tmp_path / "saved"), load_dataset(tmp_path / "saved", most_in_memory=0)
    assert not any(run.samples.held for run in stored.trajectories)
    assert (stored.hash, stored.warnings) == (held.hash, held.warnings)
    assert stored.fingerprints("train") == held.fingerprints("train")


def test_a_run_gives_arrays_and_is_replaced_without_reading_them(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "fleet")
    held, stored = load_dataset(folder).trajectories[3], load_dataset(tmp_path / "fleet", most_in_memory=0)
    run = stored.trajectories[3]
    for name in ("times", "rates", "signals"):
        assert type(getattr(run, name)) is type(getattr(run.final_log, name)) is np.ndarray
        np.testing.assert_array_equal(getattr(run, name), getattr(held, name))
    (tmp_path / "fleet" / "wheels.parquet").unlink()
    read_block.cache_clear()
    other = replace(run, id="other", angles=None).log([0.5])
    assert (other.samples.count, other.samples.end) == (len(held.times), held.times[-1])
    half = replace(run, rates=held.rates / 2)
    np.testing.assert_array_equal(half.rates, held.rates / 2)
    with pytest.raises(DataError, match="cannot be read"):
        _ = half.times


@pytest.mark.usefixtures("nothing_held")
@pytest.mark.parametrize("robot", [SWERVE, *slow(APR_02, MECANUM, DIFFERENTIAL, CAR)], ids=lambda robot: robot.name)
def test_fits_errors_and_checks_are_as_in_memory(robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_dataset(recorded(robot), tmp_path / "saved")
    stored = load_dataset(tmp_path / "saved", most_in_memory=0)
    found = calibrate(stored).calibration
    told = evaluate(found, stored), check(stored), inspect_dataset(stored)
    monkeypatch.setattr(odometry_of_stored, "_HELD", 10**9)
    held = load_dataset(tmp_path / "saved")
    expected = calibrate(held).calibration
    # Held and stored samples are summed in another order, and a fit ends with a step below 1e-9.
    assert found.matrix_array == pytest.approx(expected.matrix_array, rel=1e-8, abs=1e-11)
    assert np.array(found.covariance) == pytest.approx(np.array(expected.covariance), rel=1e-5, abs=1e-15)
    assert told[0].splits["all"].cost == pytest.approx(evaluate(found, held).splits["all"].cost, rel=1e-9)
    assert [finding.what for finding in told[1].findings] == [finding.what for finding in check(held).findings]
    numbers = inspect_dataset(held)
    assert (told[2].wheel_samples, told[2].sample_period_range_s, told[2].driven_shares) == (
        numbers.wheel_samples,
        numbers.sample_period_range_s,
        numbers.driven_shares,
    )


@pytest.mark.usefixtures("nothing_held")
@pytest.mark.parametrize("cost", ["final_pose", *slow("final_position", "final_heading", "trajectory")])
def test_bounds_of_all_costs_are_proven_as_in_memory(folder: Path, cost: str, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = load_dataset(folder, most_in_memory=0)
    found = calibrate(stored, cost=cost).calibration
    proof, sums = certify_optimum(found, stored, parts=20), bounds_of(stored, cost)._stamps
    monkeypatch.setattr(odometry_of_stored, "_HELD", 10**9)
    held = load_dataset(folder)
    expected, held_sums = certify_optimum(found, held, parts=20), bounds_of(held, cost)._stamps
    assert proof.certificate.lower_bound == pytest.approx(expected.certificate.lower_bound, rel=1e-9)
    assert sums.curvature == pytest.approx(held_sums.curvature, rel=1e-12)
    row_3 = np.linspace(-0.02, 0.01, sums.curvature.shape[-1])
    for of_stored, of_held in zip(sums.at(row_3), held_sums.at(row_3), strict=True):
        assert of_stored == pytest.approx(of_held, rel=1e-12, abs=1e-12)


def bounds_of(dataset: Dataset, cost: str) -> LowerBounds:
    return LowerBounds(problem_of(dataset, cost))


def problem_of(dataset: Dataset, cost: str, budget: Budget | None = None) -> CalibrationProblem:
    runs = dataset.split("train")
    searched = make_parameterisation("matrix", dataset.robot, runs)
    return CalibrationProblem(
        dataset.robot, runs, costs.create(cost), searched, integration="arc", budget=budget or Budget(), seed=0
    )


@pytest.mark.slow
@pytest.mark.usefixtures("nothing_held")
def test_a_search_by_evaluators_of_parts_finds_what_one_finds(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("omnibench.fit.problem._WORTH_BUILDING_OF_STORED", 0)
    options = {"budget": None, "seed": 3}
    stored = calibrate(load_dataset(folder, most_in_memory=0), "genetic", **options).result
    monkeypatch.setattr(odometry_of_stored, "_HELD", 10**9)
    assert stored.cost == pytest.approx(calibrate(load_dataset(folder), "genetic", **options).result.cost, rel=1e-3)


@pytest.mark.usefixtures("nothing_held")
@pytest.mark.parametrize(
    ("seconds", "built"), [(0.5, False), pytest.param(600.0, True, marks=pytest.mark.slow), (math.inf, True)]
)
def test_an_evaluator_of_parts_is_built_where_the_time_left_is_enough(
    seconds: float, built: bool, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("omnibench.fit.problem._WORTH_BUILDING_OF_STORED", 20_000)  # some 20 s of evaluations
    problem = problem_of(load_dataset(folder, most_in_memory=0), "final_pose", Budget(seconds=seconds))
    with suppress(BudgetSpent):
        problem.cost(np.tile(problem.start, (20_000, 1)))
    assert (problem._evaluator is not None) == built


@pytest.mark.usefixtures("nothing_held")
def test_a_population_that_takes_too_long_is_cut_there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("omnibench.fit.problem._WORTH_BUILDING_OF_STORED", 10**9)
    problem = problem_of(load_dataset(folder, most_in_memory=0), "final_pose", Budget(seconds=0.5))
    alone = [problem.cost(problem.start * scale)[0] for scale in (0.98, 0.99)]
    with pytest.raises(BudgetSpent, match="time budget"):
        problem.cost(np.tile(problem.start, (50_000, 1)))
    assert 2 < problem.evaluations < 50_000
    assert problem.best_cost < min(alone)


def test_costs_of_poses_that_are_held_in_parts_are_the_same(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = problem_of(load_dataset(folder), "trajectory")
    candidates = problem.start * np.linspace(0.98, 1.02, 7)[:, None]
    whole = problem.values(candidates)
    monkeypatch.setattr("omnibench.fit.problem._MOST_POSES", 3 * len(problem.odometry.trajectory))
    assert problem.values(candidates) == pytest.approx(whole, rel=1e-14)


def test_a_long_run_among_short_ones_is_put_with_few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(odometry_of_stored, "_TOGETHER", 1000)
    counts = [100, 100, 900, *[10] * 200]
    logs = [WheelLog(np.ones(count), np.ones((count, 3)), np.zeros(3), np.ones(1)) for count in counts]
    parts = [[len(log.times) for log in part] for part in odometry_of_stored.together(logs)]
    assert [count for part in parts for count in part] == counts
    assert max(len(part) * max(part) for part in parts) <= 1000
    assert [len(part) for part in parts] == [2, 1, 100, 100]


def test_several_folders_or_a_glob_are_one_data_set(tmp_path: Path) -> None:
    whole = recorded()
    for day in range(3):
        part = replace(whole, name=f"day{day}", trajectories=whole.trajectories[4 * day : 4 * day + 4])
        save_dataset(replace(part, scans=None), tmp_path / f"day{day}")
    by_name = load_dataset([tmp_path / f"day{day}" for day in range(3)])
    by_glob = load_dataset(tmp_path / "day*", most_in_memory=0)
    assert by_name.name == by_glob.name == "day0 to day2"
    assert [run.id for run in by_glob.trajectories] == [run.id for run in whole.trajectories]
    assert by_name.hash == by_glob.hash
    assert in_few_words([tmp_path / f"day{day}" for day in range(3)]) == f"{tmp_path}/day*"
    assert in_few_words([tmp_path / "day0", tmp_path / "day2"]) == f"{tmp_path}/day0 {tmp_path}/day2"
    together = calibrate(replace(by_glob, name=whole.name)).calibration.matrix_array
    assert together == pytest.approx(calibrate(whole).calibration.matrix_array, rel=1e-12)


def test_runs_of_the_same_name_get_that_of_their_folder(tmp_path: Path) -> None:
    for name in ("monday", "tuesday"):
        save_dataset(replace(recorded(runs=4), name=name), tmp_path / name)
    ids = [run.id for run in load_dataset(tmp_path / "*day").trajectories]
    assert ids[0] == "run-0"
    assert ids[4] == "tuesday/run-0"
    assert len(set(ids)) == 8


@pytest.mark.parametrize("most", [0, 10**6])
def test_a_folder_with_brackets_in_its_name_is_that_folder(tmp_path: Path, most: int) -> None:
    save_dataset(recorded(runs=4), tmp_path / "fleet[1]")
    assert len(load_dataset(tmp_path / "fleet[1]", most_in_memory=most).trajectories[0].rates) > 0


def test_a_glob_names_what_does_not_fit(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"day\*: no data set folder matches$"):
        load_dataset(tmp_path / "day*")
    for day in range(2):
        save_dataset(recorded(runs=4), tmp_path / f"day{day}")
    with pytest.raises(DataError, match=r"give '.*/\*'"):
        load_dataset(tmp_path)
    header = tmp_path / "day1" / "dataset.yaml"
    header.write_text(header.read_text().replace(f"radius: {APR_02.wheels[0].radius}", "radius: 0.5", 1))
    with pytest.raises(DataError, match=r"day1: its robot is not that of .*day0 \(wheels\.0\.radius: 0\.5 and 0\."):
        load_dataset(tmp_path / "day*")
    header.unlink()
    (tmp_path / "day.txt").touch()
    with pytest.raises(DataError, match=r"day1: .* no dataset\.yaml"):
        load_dataset(tmp_path / "day*")


def test_a_recording_that_two_folders_hold_is_warned_of(tmp_path: Path) -> None:
    save_dataset(recorded(runs=4), tmp_path / "day")
    shutil.copytree(tmp_path / "day", tmp_path / "day-copy")
    warnings = load_dataset([tmp_path / "day", tmp_path / "day-copy"]).warnings
    assert any("4 runs of another folder there twice" in warning for warning in warnings)
    assert load_dataset([tmp_path / "day", tmp_path / "day" / ".." / "day"]).hash == load_dataset(tmp_path / "day").hash


def test_rows_that_interleave_are_read_whole(tmp_path: Path) -> None:
    save_dataset(recorded(), tmp_path / "saved")
    before = load_dataset(tmp_path / "saved").hash
    file = tmp_path / "saved" / "wheels.parquet"
    pl.read_parquet(file).sort("t", maintain_order=True).write_parquet(file)
    mixed = load_dataset(tmp_path / "saved", most_in_memory=0)
    assert mixed.trajectories[0].samples.held
    assert mixed.hash == before


def test_a_faulty_row_far_into_the_file_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stored_samples, "_ROWS", 50)
    save_dataset(recorded(), tmp_path / "saved")
    file = tmp_path / "saved" / "wheels.parquet"
    table = pl.read_parquet(file)
    late = pl.int_range(pl.len()) == 200  # the first row of a piece, within a run
    table.with_columns(t=pl.when(late).then(0.01).otherwise(pl.col("t"))).write_parquet(file)
    with pytest.raises(DataError, match=r"wheels\.parquet, row 201: t "):
        load_dataset(tmp_path / "saved", most_in_memory=0)


def test_a_file_that_changes_under_the_data_set_is_not_read_on(tmp_path: Path) -> None:
    save_dataset(recorded(), tmp_path / "saved")
    stored = load_dataset(tmp_path / "saved", most_in_memory=0)
    file = tmp_path / "saved" / "wheels.parquet"
    os.utime(file, (1, 1))
    read_block.cache_clear()  # another process has no block in memory
    pickled = pickle.loads(pickle.dumps(stored.trajectories[5]))
    with pytest.raises(DataError, match="the file has changed"):
        _ = pickled.rates


def sampled(times: np.ndarray) -> Any:
    """A run of which only the times matter."""
    return SimpleNamespace(samples=Samples({"times": times}))


def test_the_usual_period_of_many_samples_is_that_of_the_run_in_their_middle(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = [sampled(np.arange(1, 1 + count) * period) for count, period in ((400, 0.1), (900, 0.01), (600, 0.02))]
    monkeypatch.setattr(stored_samples, "MOST_IN_MEMORY", 0)
    assert median_period(runs) == pytest.approx(0.02)
    assert median_period([*runs, sampled(np.array([5.0, 99.0]))]) == pytest.approx(0.02)


def test_some_runs_are_drawn_always_the_same_and_into_memory(folder: Path) -> None:
    runs = load_dataset(folder, most_in_memory=0).trajectories
    some = drawn_runs(runs, most=1840)
    assert len(some) == 23
    assert [run.id for run in some] == [run.id for run in drawn_runs(runs, most=1840)]
    assert all(run.samples.held for run in some)
    assert [run.id for run in runs] == [run.id for run in drawn_runs(runs, most=10**6)]
    rare = [replace(run, command="rare" if number in (9, 31) else "usual") for number, run in enumerate(runs)]
    assert {"run-9", "run-31"} <= {run.id for run in drawn_runs(rare, most=1)}
    assert some[0].fingerprint == next(run for run in runs if run.id == some[0].id).fingerprint
