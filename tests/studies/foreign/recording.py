"""The folder of a recording, and how strongly what is hidden in it shows beyond a free matrix."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

Array = np.ndarray[Any, np.dtype[np.float64]]
STRONG = 1000.0  # the wanted non-centrality


@dataclass(frozen=True)
class Slot:
    """When one command is driven. number: of the command."""

    split: str
    session: str
    number: int
    repetition: int
    started_at: float


def slots(commands: int, repetitions: dict[str, int], run: float, rng: np.random.Generator) -> list[Slot]:
    """All commands in random order, the splits one after another in sessions of their own. run: s, of a run."""
    planned = []
    for session, (split, count) in enumerate(repetitions.items()):
        order = rng.permutation([(number, 1 + time) for number in range(commands) for time in range(count)])
        pauses = run + rng.uniform(6, 14, len(order))
        for (number, repetition), start in zip(order, np.cumsum(pauses) - pauses, strict=True):
            planned.append(Slot(split, "ab"[session], int(number), int(repetition), float(start)))
    return planned


def write(folder: Path, robot: dict[str, Any], planned: Sequence[Slot], recorded: dict[str, Array]) -> None:
    """Write the data set.

    recorded: times (T,), rates, angles (R, T, N), stamps (K,), poses (R, K, 3), and steering (R, T, S) of a robot whose
    wheels steer and are not driven, where it has such.
    """
    wheels = [wheel["name"] for wheel in robot["wheels"] if wheel.get("driven", True)]
    steered = [wheel["name"] for wheel in robot["wheels"] if wheel.get("type") == "steered"]
    names, times, stamps = [f"run{index:03d}" for index in range(len(planned))], recorded["times"], recorded["stamps"]
    header = {
        "format": "omnibench-dataset/1",
        "name": "recording",
        "simulated": True,
        "robot": robot,
        "sample_period": float(np.round(times[1] - times[0], 9)),
        "wheels": wheels,
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "dataset.yaml").write_text(json.dumps(header))  # JSON is YAML
    pl.DataFrame(
        {
            "trajectory": names,
            "command": [f"c{slot.number:02d}" for slot in planned],
            "repetition": [slot.repetition for slot in planned],
            "split": [slot.split for slot in planned],
            "session": [slot.session for slot in planned],
            "started_at": [slot.started_at for slot in planned],
        }
    ).write_parquet(folder / "trajectories.parquet")
    columns: dict[str, Any] = {"trajectory": np.repeat(names, len(times)), "t": np.tile(times, len(names))}
    of_wheels = (("rates", "omega", wheels), ("angles", "phi", wheels), ("steering", "steer", steered))
    for what, prefix, names_of in of_wheels:
        columns |= {f"{prefix}_{wheel}": recorded[what][..., index].ravel() for index, wheel in enumerate(names_of)}
    pl.DataFrame(columns).write_parquet(folder / "wheels.parquet")
    columns = {"trajectory": np.repeat(names, len(stamps)), "t": np.tile(stamps, len(names))}
    columns |= {name: recorded["poses"][..., index].ravel() for index, name in enumerate(("x", "y", "theta"))}
    pl.DataFrame(columns).write_parquet(folder / "poses.parquet")


def noncentrality(effect: Array, columns: Array, covariance: Array) -> float:
    """chi2 of changed poses (R, K, 3) that no combination of columns (P, R, K, 3) makes.

    covariance (R or 1, 3K, 3K): of the noise of a run's poses, in the order of their last two axes.
    """
    root = np.linalg.cholesky(covariance)
    every = np.concatenate([effect[None], columns]).reshape(len(columns) + 1, len(effect), -1)
    white = np.linalg.solve(root, every.transpose(1, 2, 0)).reshape(-1, len(columns) + 1)
    left = white[:, 0] - white[:, 1:] @ np.linalg.lstsq(white[:, 1:], white[:, 0], rcond=1e-10)[0]
    return float(left @ left)


def size_of(effect: Callable[[float], Array], columns: Array, covariance: Array, size: float) -> tuple[float, float]:
    """The size whose changed poses have the wanted non-centrality, and that. size: to begin with."""
    for _ in range(8):
        reached = noncentrality(effect(size), columns, covariance)
        if abs(reached / STRONG - 1) < 0.01:
            break
        size *= (STRONG / reached) ** 0.5
    return size, reached
