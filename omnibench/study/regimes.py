"""Regimes: training runs made worse, to see which method breaks where. Runs that judge are never touched."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.data.splits import repetitions
from omnibench.robot.kinematics import Array, interpolated
from omnibench.study.config import RECORDED, RegimeChoice

AS_RECORDED = RECORDED


def in_regime(runs: Sequence[Trajectory], regime: RegimeChoice, seed: int) -> tuple[Trajectory, ...]:
    """The training runs under a regime. Chance hangs on the seed and each run's content alone.

    Runs without poses are only reduced in number. The first pose of a run is noisy, too, but stays at t = 0.
    """
    kept = runs
    if regime.runs_per_command is not None:
        numbers = repetitions([run.command or run.id for run in runs])
        kept = [run for run, number in zip(runs, numbers, strict=True) if number <= regime.runs_per_command]
    return tuple(_worsened(run, regime, seed) if run.has_poses else run for run in kept)


def _worsened(run: Trajectory, regime: RegimeChoice, seed: int) -> Trajectory:
    poses = _late(run, regime, _chance(run, seed, "clock"))
    rng = _chance(run, seed, "noise")
    deviations = [regime.noise_position, regime.noise_position, math.radians(regime.noise_heading_deg)]
    if any(deviations):
        poses = poses + rng.normal(0.0, deviations, poses.shape)
    if regime.outlier_share:
        rng = _chance(run, seed, "outliers")
        far = rng.random(len(poses)) < regime.outlier_share
        directions = rng.uniform(0.0, 2 * math.pi, len(poses))
        away = regime.outlier_size * np.column_stack([np.cos(directions), np.sin(directions)])
        poses = poses + np.where(far[:, None], np.column_stack([away, np.zeros(len(poses))]), 0.0)
    return run if poses is run.poses else replace(run, poses=poses)


def _late(run: Trajectory, regime: RegimeChoice, rng: np.random.Generator) -> Array:
    """Poses (K, 3) whose stamps t are late: each was taken at t - (offset + drift t)."""
    if not (regime.clock_offset or regime.clock_drift):
        return run.poses
    offset, drift = rng.normal(0.0, [regime.clock_offset, regime.clock_drift])
    taken = np.clip(run.pose_times - offset - drift * run.pose_times, 0.0, run.pose_times[-1])
    return interpolated(taken, run.pose_times, run.poses)


def _chance(run: Trajectory, seed: int, what: str) -> np.random.Generator:
    digest = hashlib.sha256(f"{run.fingerprint} {what}".encode()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "big")])
