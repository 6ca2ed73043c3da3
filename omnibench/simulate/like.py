"""Simulation of a recording: its own wheel samples, with reference poses by a calibration's model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omnibench.data.dataset import Dataset, make_dataset
from omnibench.data.domain_check import extrapolation_warning
from omnibench.errors import DataError
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array
from omnibench.simulate.pose_noise import reference_noise


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
        poses = _with_noise(dataset, poses, calibration, noise_seed)
        how = f"with its noise, seed {noise_seed}"
    runs = zip(dataset.trajectories, poses, strict=True)
    simulated = make_dataset(
        dataset.name,
        dataset.robot,
        dataset.sample_period,
        [replace(run, poses=path, pose_covariances=None) for run, path in runs],
        description=_described(dataset, calibration, how),
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


def _with_noise(dataset: Dataset, poses: list[Array], calibration: Calibration, seed: int) -> list[Array]:
    noise = calibration.noise
    if noise is None or not any(noise.model_dump().values()):
        raise DataError(
            f"calibration {calibration.name!r} has no noise of the reference; leave --noise out, or calibrate with "
            "trajectory_ml, which estimates it"
        )
    rng = np.random.default_rng(seed)
    stamps = [run.pose_times for run in dataset.trajectories]
    return [path + reference_noise(noise, times, rng) for path, times in zip(poses, stamps, strict=True)]


def _described(dataset: Dataset, calibration: Calibration, how: str) -> str:
    names = ", ".join(term.name for term in calibration.effects)
    model = f"calibration {calibration.name}" + (f" with {names}" if names else "")
    how_made = f"Simulated like {dataset.name} by {model}, {how}: its wheels, and poses as the model has them."
    return f"{how_made} {dataset.description}".strip()
