"""The cases of importers pass what keeps the contract and fail, case by case, what does not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conformance_suites import failures, suite
from pydantic import Field

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.data.importer import Importer
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError
from omnibench.registry import Options
from omnibench.testing import (
    CaseOutcome,
    ImporterConformance,
    run_cases,
)
from omnibench.testing.synthetic import synthetic_dataset


class GoodImporter(Importer):
    """Reads the project's own data set folders."""

    def read(self, source: Path) -> Dataset:
        return load_dataset(source)


class OpensAnything(GoodImporter):
    """Lets the operating system complain."""

    def read(self, source: Path) -> Dataset:
        (source / "dataset.yaml").read_text()
        return load_dataset(source)


class AcceptsAnything(GoodImporter):
    """Makes something of everything."""

    def read(self, source: Path) -> Dataset:
        try:
            return load_dataset(source)
        except DataError:
            robot: Any = None  # on purpose: an importer that knows no robot
            return Dataset("nothing", robot, 0.1, ())


class Altered(GoodImporter):
    """Changes trajectories after they were made."""

    def read(self, source: Path) -> Dataset:
        dataset = load_dataset(source)
        return replace(dataset, trajectories=tuple(self.alter(run) for run in dataset.trajectories))

    def alter(self, run: Trajectory) -> Trajectory:
        return replace(run, times=run.times[::-1])


class NumpyNumbers(Altered):
    """A speed that is a NumPy number."""

    def alter(self, run: Trajectory) -> Trajectory:
        return replace(run, v=np.float64(0.25))


class Jitters(Altered):
    """Adds noise."""

    def alter(self, run: Trajectory) -> Trajectory:
        return replace(run, rates=run.rates + np.random.default_rng().normal(size=run.rates.shape))


class TidiesUp(GoodImporter):
    """Improves the files that it reads."""

    def read(self, source: Path) -> Dataset:
        dataset = load_dataset(source)
        (source / "dataset.yaml").write_text((source / "dataset.yaml").read_text() + "# read\n")
        return dataset


CASES_OF_IMPORTERS = [
    (OpensAnything, "missing source is refused", "it raised FileNotFoundError"),
    (AcceptsAnything, "empty folder is refused", "read without complaint"),
    (Altered, "sample is a valid data set", "trajectory 01: times must increase"),
    (NumpyNumbers, "sample saves and loads back equal", "v of trajectory 01"),
    (Jitters, "sample reads the same twice", "different data sets"),
    (TidiesUp, "sample is left unchanged", "it changed the files"),
]


@pytest.fixture
def sample(tmp_path: Path) -> Path:
    save_dataset(synthetic_dataset(), tmp_path / "sample")
    return tmp_path / "sample"


def test_a_good_importer_passes_every_case(sample: Path) -> None:
    assert failures(ImporterConformance, GoodImporter, source=sample) == {}


@pytest.mark.parametrize(("cls", "case", "message"), CASES_OF_IMPORTERS)
def test_an_importer_fails_the_case_it_breaks(cls: type[Importer], case: str, message: str, sample: Path) -> None:
    assert message in failures(ImporterConformance, cls, source=sample)[case]


def test_an_importer_without_a_sample_is_tried_on_refusals_only() -> None:
    outcomes = {result.case: result.outcome for result in run_cases(suite(ImporterConformance, GoodImporter))}
    assert outcomes["empty file is refused"] is CaseOutcome.PASSED
    assert outcomes["sample is a valid data set"] is CaseOutcome.SKIPPED


def test_an_option_that_is_not_described_fails_an_importer() -> None:
    class Bare(GoodImporter):
        """Has an option."""

        class Options(Options):
            rate: float = Field(1.0, gt=0)

    assert "rate" in failures(ImporterConformance, Bare)["class and options are documented"]
