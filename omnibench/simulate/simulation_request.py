"""The job of ``omnibench simulate``: write a config's data set, or a recording simulated again, into a folder."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from omnibench.config import to_json, to_yaml
from omnibench.data.dataset import Dataset
from omnibench.data.storage import check_dataset_folder, load_whole, save_dataset
from omnibench.data.true_poses import POSES_FILE, TRUTH_FILE, write_true_poses
from omnibench.errors import ConfigError
from omnibench.files import TableFormat, refuse_existing, remove, resolved, write_text
from omnibench.progress import Reporter, no_progress
from omnibench.robot.calibration import read_calibration
from omnibench.simulate.like import simulate_like
from omnibench.simulate.simulation import Simulation
from omnibench.simulate.source import SimulationSource, check_effect_options, read_simulation
from omnibench.slam.accuracy import SlamAccuracy, slam_accuracy

ACCURACY_FILE = "slam_accuracy.json"


@dataclass(frozen=True)
class WrittenSimulation:
    """A data set that was written. simulation: with its truth, if it came from a config. accuracy: of SLAM."""

    dataset: Dataset
    simulation: Simulation | None = None
    accuracy: SlamAccuracy | None = None


@dataclass(frozen=True)
class SimulationRequest:
    """Arguments of ``omnibench simulate``: either ``config``, or ``like`` with ``model``.

    effects: to hide besides those of the config, each as YAML. noise: add the calibration's noise (with ``like``).
    seed: of that noise; default 0. force: replace what is there. ConfigError in one line: options that exclude each
    other.
    """

    output: Path
    config: Path | None = None
    truth: Path | None = None
    dataset: str | None = None
    effects: tuple[str, ...] = ()
    like: Path | None = None
    model: Path | None = None
    noise: bool = False
    seed: int | None = None
    force: bool = False

    def __post_init__(self) -> None:
        if self.like is None and self.model is None:
            if self.config is None:
                raise ConfigError(
                    "name a CONFIG with a simulated data set, or a recording with --like DATASET --model CALIBRATION"
                )
            why = "is for --like; a config has its own noise and seeds"
            _refuse((("--noise", self.noise), ("--seed", self.seed is not None)), why)
        elif self.like is None:
            raise ConfigError(f"--model {self.model}: say with --like DATASET which recording it is to drive again")
        elif self.model is None:
            raise ConfigError(f"--like {self.like}: say with --model CALIBRATION by which model")
        else:
            self._check_like()
        if self.truth is not None and resolved(self.truth).is_relative_to(resolved(self.output)):
            raise ConfigError("--truth: must be a folder apart from the data set's")

    @cached_property
    def source(self) -> SimulationSource:
        """The config's data set, with the effects. ConfigError as for ``read_simulation``."""
        assert self.config is not None
        return read_simulation(self.config, self.dataset).with_effects(self.effects)

    @property
    def plugins(self) -> tuple[Path, ...]:
        """Folders of plug-ins that the config's effects may come from."""
        return () if self.config is None else self.source.effect_plugins

    def write(self, table_format: TableFormat = "parquet", watch: Reporter = no_progress) -> WrittenSimulation:
        """Simulate and write the data set; write the truth to its own folder, if one is named.

        OmnibenchError in one line: the config, the recording or the calibration is wrong, files are there already, or
        the disk refuses.
        """
        check_dataset_folder(self.output)
        refuse_existing(self.output, force=self.force, folders=True)
        refuse_existing(*self._truth_files, force=self.force)
        if self.config is None:
            assert self.like is not None
            assert self.model is not None
            calibration = read_calibration(self.model)
            dataset = simulate_like(load_whole(self.like), calibration, (self.seed or 0) if self.noise else None)
            save_dataset(dataset, self.output, table_format, overwrite=self.force)
            return WrittenSimulation(dataset)
        check_effect_options(self.effects)
        simulation = self.source.simulate(watch)
        save_dataset(simulation.dataset, self.output, table_format, overwrite=self.force)
        accuracy = slam_accuracy(simulation.dataset, simulation.paths) if simulation.paths else None
        if self.truth is not None:
            self._write_truth(self.truth, simulation, accuracy)
        return WrittenSimulation(simulation.dataset, simulation, accuracy)

    @property
    def _truth_files(self) -> list[Path]:
        """Files of a truth that would be replaced."""
        return [] if self.truth is None else [self.truth / name for name in (TRUTH_FILE, POSES_FILE, ACCURACY_FILE)]

    def _write_truth(self, folder: Path, simulation: Simulation, accuracy: SlamAccuracy | None) -> None:
        write_text(folder / TRUTH_FILE, to_yaml(simulation.truth))
        if accuracy is None:
            for name in (POSES_FILE, ACCURACY_FILE):  # an earlier truth's
                remove(folder / name)
            return
        write_true_poses(folder, simulation.paths)
        write_text(folder / ACCURACY_FILE, to_json(accuracy) + "\n")

    def _check_like(self) -> None:
        assert self.like is not None
        given = (
            (f"CONFIG {self.config}", self.config is not None),
            ("--truth", self.truth is not None),
            ("--dataset", self.dataset is not None),
            ("--effect", bool(self.effects)),
        )
        _refuse(given, "does not go with --like, which takes all from the recording and the calibration")
        if self.seed is not None and not self.noise:
            raise ConfigError("--seed: is for --noise, which is not asked for; add --noise, or leave --seed out")
        if resolved(self.output) == resolved(self.like):
            raise ConfigError(f"-o {self.output}: is the recording itself; name another folder")


def _refuse(options: Iterable[tuple[str, bool]], why: str) -> None:
    for name, given in options:
        if given:
            raise ConfigError(f"{name}: {why}; leave it out")
