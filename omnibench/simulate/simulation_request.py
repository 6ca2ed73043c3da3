"""The job of ``omnibench simulate``: write a config's data set, or a recording simulated again, into a folder.

Simulation of a recording: its own wheel samples, with reference poses by a calibration's model.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from omnibench.config import to_json, to_yaml
from omnibench.data.dataset import Dataset, make_dataset
from omnibench.data.domain_check import extrapolation_warning
from omnibench.data.storage import check_dataset_folder, load_dataset, save_dataset
from omnibench.data.true_poses import POSES_FILE, TRUTH_FILE, write_true_poses
from omnibench.errors import ConfigError, DataError
from omnibench.files import TableFormat, refuse_existing, remove, resolved, write_text
from omnibench.progress import Reporter, no_progress
from omnibench.robot.calibration import Calibration, read_calibration
from omnibench.simulate.source import SimulationSource, check_effect_options, read_simulation
from omnibench.simulate.truth import Simulation, reference_noise
from omnibench.slam.slam_dataset import SlamAccuracy, slam_accuracy


def simulate_like(dataset: Dataset, calibration: Calibration, noise_seed: int | None = None) -> Dataset:
    """The runs of a data set with poses by a calibration's model, from each run's recorded start pose on.

    Everything else (stamps, wheel samples, splits, sessions) is as recorded, so that both can be compared run by run.
    noise_seed: seed of the calibration's noise of the reference, which is added; None: poses without noise. Warnings
    include motions that the calibration's effects were not fitted to. DataError in one line: the calibration is for
    another robot or has no noise, or the recording lacks what one of its effects needs.
    """
    calibration.check_wheels(dataset.robot, f"the data set {dataset.name}")
    reported = calibration.model.reported([run.log(run.pose_times) for run in dataset.trajectories])
    poses = [np.vstack([run.start, path[1:]]) for run, path in zip(dataset.trajectories, reported, strict=True)]
    how = "without noise"
    if noise_seed is not None:
        noise = calibration.noise
        if noise is None or not any(noise.model_dump().values()):
            raise DataError(
                f"calibration {calibration.name!r} has no noise of the reference; leave --noise out, or calibrate with "
                "trajectory_ml, which estimates it"
            )
        rng = np.random.default_rng(noise_seed)
        stamps = [run.pose_times for run in dataset.trajectories]
        poses = [path + reference_noise(noise, times, rng) for path, times in zip(poses, stamps, strict=True)]
        how = f"with its noise, seed {noise_seed}"
    runs = zip(dataset.trajectories, poses, strict=True)
    names = ", ".join(term.name for term in calibration.effects)
    model = f"calibration {calibration.name}" + (f" with {names}" if names else "")
    how_made = f"Simulated like {dataset.name} by {model}, {how}: its wheels, and poses as the model has them."
    simulated = make_dataset(
        dataset.name,
        dataset.robot,
        dataset.sample_period,
        [replace(run, poses=path, pose_covariances=None) for run, path in runs],
        description=f"{how_made} {dataset.description}".strip(),
        source=f"simulated by omnibench from the wheels of {dataset.name}"
        + (f" ({dataset.source})" if dataset.source else ""),
        licence=dataset.licence,
        simulated=True,
    )
    warning = extrapolation_warning(calibration, dataset.trajectories)
    warnings = [] if warning is None else [warning]
    if dataset.scans is not None:
        warnings.append("the recording's scans are left out: they show where its robot was")
    return replace(simulated, warnings=(*simulated.warnings, *warnings))


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
        refuse_existing(
            *([] if self.truth is None else [self.truth / name for name in (TRUTH_FILE, POSES_FILE, ACCURACY_FILE)]),
            force=self.force,
        )
        if self.config is None:
            assert self.like is not None
            assert self.model is not None
            calibration = read_calibration(self.model)
            dataset = simulate_like(load_dataset(self.like), calibration, (self.seed or 0) if self.noise else None)
            save_dataset(dataset, self.output, table_format, overwrite=self.force)
            return WrittenSimulation(dataset)
        check_effect_options(self.effects)
        simulation = self.source.simulate(watch)
        save_dataset(simulation.dataset, self.output, table_format, overwrite=self.force)
        accuracy = slam_accuracy(simulation.dataset, simulation.paths) if simulation.paths else None
        if self.truth is not None:
            write_text(self.truth / TRUTH_FILE, to_yaml(simulation.truth))
            if accuracy is None:
                for name in (POSES_FILE, ACCURACY_FILE):  # an earlier truth's
                    remove(self.truth / name)
            else:
                write_true_poses(self.truth, simulation.paths)
                write_text(self.truth / ACCURACY_FILE, to_json(accuracy) + "\n")
        return WrittenSimulation(simulation.dataset, simulation, accuracy)


def _refuse(options: Iterable[tuple[str, bool]], why: str) -> None:
    for name, given in options:
        if given:
            raise ConfigError(f"{name}: {why}; leave it out")
