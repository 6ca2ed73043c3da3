"""Conformance cases for importers."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable
from inspect import signature
from pathlib import Path
from typing import ClassVar
from unittest import SkipTest

import numpy as np

from omnibench.data.dataset import SPLITS, Dataset, Trajectory
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import DataError
from omnibench.registry import importers
from omnibench.testing.conformance import Conformance, require

_FOREIGN = b"\x89PNG\r\n\x1a\n not a recording; \xff\xfe\x00 1,2,3\n"


class ImporterConformance(Conformance):
    """Requirements on every importer.

    source: sample recordings; without them, only refusals are tested.
    """

    registry = importers
    source: ClassVar[Path | None] = None

    def read_sample(self) -> Dataset:
        """The data set read from the sample; skips the case if there is none."""
        if self.source is None:
            raise SkipTest("no sample; set source in a subclass of ImporterConformance")
        dataset = self.make().read(self.source)
        require(isinstance(dataset, Dataset), f"read returned {type(dataset).__name__}, expected a Dataset")
        assert isinstance(dataset, Dataset)
        return dataset

    def test_missing_source_is_refused(self) -> None:
        """DataError, in one line."""
        self._require_refusal("a missing source", lambda _: None)

    def test_empty_folder_is_refused(self) -> None:
        """DataError says which files are missing."""
        self._require_refusal("an empty folder", Path.mkdir)

    def test_empty_file_is_refused(self) -> None:
        """DataError names the file."""
        self._require_refusal("an empty file", Path.touch)

    def test_foreign_file_is_refused(self) -> None:
        """DataError for bytes that are no recording."""
        self._require_refusal("a file of other content", lambda path: path.write_bytes(_FOREIGN))

    def test_folder_of_foreign_files_is_refused(self) -> None:
        """DataError for a folder that holds only files of other content."""

        def fill(path: Path) -> None:
            path.mkdir()
            for name in ("run.csv", "notes.txt", "metadata.yaml", "data.parquet"):
                (path / name).write_bytes(_FOREIGN)

        self._require_refusal("a folder of other files", fill)

    def test_sample_is_a_valid_data_set(self) -> None:
        """Shapes, times and splits are as in a data set folder."""
        dataset = self.read_sample()
        wheels = len(dataset.robot.wheel_names)
        require(len(dataset.trajectories) > 0, "the data set has no trajectory; make it with make_dataset")
        for run in dataset.trajectories:
            place = f"trajectory {run.id}"
            shapes = (run.rates.shape, run.poses.shape)
            expected = ((len(run.times), wheels), (len(run.pose_times), 3))
            require(shapes == expected, f"{place}: rates and poses have shapes {shapes}, expected {expected}")
            for name in ("times", "rates", "pose_times", "poses"):
                require(np.isfinite(getattr(run, name)).all(), f"{place}: {name} holds NaN or infinity")
            require(run.split in SPLITS, f"{place}: split is {run.split!r}; it must be one of {', '.join(SPLITS)}")
            require(len(run.times) > 0 and run.times[0] > 0, f"{place}: wheel samples must start after t = 0")
            require(len(run.pose_times) > 1 and run.pose_times[0] == 0, f"{place}: poses must start at t = 0 and go on")
            steps = np.concatenate([np.diff(run.times), np.diff(run.pose_times)])
            require((steps > 0).all(), f"{place}: times must increase")

    def test_sample_raises_no_warning(self) -> None:
        """``make_dataset`` does not warn of implausible units or wheels."""
        warnings = self.read_sample().warnings
        require(not warnings, f"the data set warns: {'; '.join(warnings)}")

    def test_sample_saves_and_loads_back_equal(self) -> None:
        """Saving to a data set folder loses nothing."""
        dataset = self.read_sample()
        with tempfile.TemporaryDirectory() as folder:
            save_dataset(dataset, Path(folder) / "dataset")
            loaded = load_dataset(Path(folder) / "dataset")
        difference = _difference(dataset, loaded)
        require(not difference, f"saving and loading changes {difference}")
        require(dataset.hash == loaded.hash, "the hash of the data set changes by saving and loading")

    def test_sample_reads_the_same_twice(self) -> None:
        """The result does not depend on the order of files on the disk, the time or chance."""
        require(self.read_sample().hash == self.read_sample().hash, "two readings gave different data sets")

    def test_sample_is_left_unchanged(self) -> None:
        """The files of the sample are not changed."""
        before = _fingerprint(self.source)
        self.read_sample()
        require(before == _fingerprint(self.source), f"it changed the files of {self.source}")

    def _require_refusal(self, what: str, prepare: Callable[[Path], object]) -> None:
        with tempfile.TemporaryDirectory() as folder:
            source = Path(folder) / "source"
            prepare(source)
            try:
                self.make().read(source)
            except DataError as error:
                require(str(error).strip(), f"{what}: the DataError has no message")
                return
            except Exception as error:
                require(False, f"{what}: it raised {type(error).__name__}: {error}; raise DataError in one line")
        require(False, f"{what} was read without complaint; raise DataError in one line")


def _difference(made: Dataset, loaded: Dataset) -> str:
    """The first difference in value or type between two data sets, in words; empty if there is none."""
    if (made.robot, made.sample_period) != (loaded.robot, loaded.sample_period):
        return "the robot or the sample period"
    for before, after in zip(made.trajectories, loaded.trajectories, strict=True):
        for name in (given for given in signature(Trajectory).parameters if given != "samples"):
            old, new = getattr(before, name), getattr(after, name)
            place = f"{name} of trajectory {before.id}"
            if isinstance(old, np.ndarray) and isinstance(new, np.ndarray):
                if old.dtype != new.dtype or not np.array_equal(old, new):
                    return f"{place} (an array of {old.dtype}, then of {new.dtype})"
            elif repr(old) != repr(new):
                return f"{place}: {old!r} becomes {new!r}"
    return ""


def _fingerprint(source: Path | None) -> str:
    if source is None:
        return ""
    files = [source] if source.is_file() else sorted(path for path in source.rglob("*") if path.is_file())
    digest = hashlib.sha256()
    for path in files:
        digest.update(str(path).encode() + path.read_bytes())
    return digest.hexdigest()
