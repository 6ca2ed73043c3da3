"""Fits by jobs of any backend: comparisons, resamples and proofs are equal to the bit, and times are fair."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import Prepared, compared_here, compared_once, summary, without_seconds
from report_page import on_terminal

from omnibench.cli.terminal.comparison_tables import print_result
from omnibench.data.storage import load_dataset
from omnibench.fit.calibrate import calibrate
from omnibench.fit.certify import certify_optimum
from omnibench.jobs.backend_choice import BackendChoice, open_backend
from omnibench.jobs.job import Backend
from omnibench.jobs.job_process import InPlace, Processes


def test_a_comparison_on_dask_is_equal_to_the_bit_and_goes_on_with_another_backend(tmp_path: Path) -> None:
    compared_here(tmp_path, backend="dask", workers=1)
    assert "backend: dask\n" in (tmp_path / "config.yaml").read_text()
    by_processes = without_seconds(compared_once().output)
    assert all(run in by_processes for run in without_seconds(tmp_path))
    times = {file.name: file.stat().st_mtime_ns for file in (tmp_path / "runs").iterdir()}
    compared_here(tmp_path)
    assert {file.name: file.stat().st_mtime_ns for file in (tmp_path / "runs").iterdir()} == times


@pytest.mark.slow
class TestFits:
    @pytest.fixture(scope="class")
    def dask(self) -> Iterator[Backend]:
        with open_backend(BackendChoice(name="dask", workers=2)) as backend:
            yield backend

    def test_resampled_intervals_are_the_same_by_any_backend(self, prepared: Prepared, dask: Backend) -> None:
        flower = load_dataset(prepared.data)
        alone, *others = (
            calibrate(flower, intervals=True, backend=backend).intervals for backend in (None, Processes(2), dask)
        )
        assert alone is not None
        for each in others:
            assert each is not None
            np.testing.assert_array_equal(each.low, alone.low)
            np.testing.assert_array_equal(each.high, alone.high)

    def test_a_proof_by_jobs_is_the_same_by_any_backend(self, prepared: Prepared, dask: Backend) -> None:
        flower = load_dataset(prepared.data)
        calibration = calibrate(flower).calibration
        one, *others = (
            certify_optimum(calibration, flower, seconds=600, parts=60, backend=backend).proof
            for backend in (InPlace(), Processes(2), dask)
        )
        assert one.boxes >= 60
        assert 0 < one.lower_bound <= one.best_cost
        assert {(each.lower_bound, each.boxes) for each in others} == {(one.lower_bound, one.boxes)}


def test_machines_that_differ_are_compared_by_the_ratio_to_their_reference() -> None:
    result = compared_once()
    for run in summary(result.output)["runs"]:
        assert 0 < run["reference_seconds"] < 1
        assert run["machine"]
    first, *rest = result.runs
    other = replace(first, record=first.record.model_copy(update={"machine": "another"}))
    printed = " ".join(on_terminal(print_result, replace(result, runs=(other, *rest)), width=200).split())
    assert "of the start)" in printed
    assert "since the machines differ" in printed


def test_runs_that_are_not_timed_show_no_seconds(tmp_path: Path) -> None:
    result = compared_here(tmp_path, timing=False, calibrators=["theoretical"])
    assert {run["reference_seconds"] for run in summary(tmp_path)["runs"]} == {None}
    printed = " ".join(on_terminal(print_result, result, width=200).split())
    assert "The runs were not timed." in printed
    assert " ms)" not in printed
