"""Speed and size of ``omnibench discover``: seconds, the same in direct least squares of the matrix, and memory.

    python tests/studies/discover_speed.py [--repetitions 5 50] [--times 1]

The robot and the commands are those of configs/hidden_effect.yaml, once with its effect and once without any, each
command as often as said: 5 repetitions are 180 + 180 runs, 50 are 1,800 + 1,800. A process of its own reads each data
set from Parquet and discovers with one thread. The direct fit is timed in the same process, so that the ratio holds on
a busy machine; the memory is the most that the process ever had, data set and libraries included.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from omnibench.config import read_yaml, validate
from omnibench.data.dataset import Trajectory
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.discover.discover import discover_effects
from omnibench.processes import one_thread
from omnibench.robot.kinematics import Array
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import simulate_dataset

CONFIG = Path(__file__).parents[2] / "configs" / "hidden_effect.yaml"
Result = TypeVar("Result")


def main() -> None:
    """Print a line for each data set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, nargs="+", default=[5, 50])
    parser.add_argument(
        "--times", type=int, default=1, help="discoveries of each data set, of which the fastest counts"
    )
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        print(json.dumps(measured(arguments.measure, arguments.times)))
        return
    for repetitions in arguments.repetitions:
        for effect in (True, False):
            with tempfile.TemporaryDirectory() as folder:
                runs = simulate(Path(folder), repetitions, effect)
                print(f"{runs} runs, {'an effect' if effect else 'no effect'}: {in_a_process(Path(folder), arguments)}")


def simulate(folder: Path, repetitions: int, effect: bool) -> str:
    """Simulate and save a data set. Its numbers of runs to train and to validate."""
    settings = read_yaml(CONFIG)["datasets"]["hidden"]["simulate"] | {"repetitions": repetitions}
    if not effect:
        settings["truth"]["effects"] = []
    dataset = simulate_dataset(validate(FlowerConfig, settings, str(CONFIG))).dataset
    save_dataset(dataset, folder)
    return " + ".join(f"{len(dataset.split(split)):,}" for split in ("train", "validation"))


def in_a_process(folder: Path, arguments: argparse.Namespace) -> str:
    """The figures of a process of its own, in words."""
    command = [sys.executable, __file__, "--measure", str(folder), "--times", str(arguments.times)]
    found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True, env=os.environ).stdout)
    return (
        f"{found['verdict']} {found['names']}, {found['wall']:.1f} s ({found['processor']:.1f} s of the processor, as "
        f"long as {found['processor'] / found['direct']:.0f} direct fits), {found['resident'] / 1e6:.2f} GB at most, "
        f"{found['before'] / 1e6:.2f} GB before"
    )


def measured(folder: Path, times: int) -> dict[str, object]:
    """Seconds of a discovery, wall and processor's, and of a direct fit; kB of memory at most, and before."""
    with one_thread():
        dataset = load_dataset(folder)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        direct = min(seconds_of(lambda: direct_fit(dataset.split("train")))[1] for _ in range(5))
        results = [seconds_of(lambda: discover_effects(dataset)) for _ in range(times)]
    wall, processor, found = min(results, key=lambda result: result[1])
    return {
        "wall": wall,
        "processor": processor,
        "direct": direct,
        "resident": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "before": before,
        "verdict": found.verdict,
        "names": ", ".join(effect.name for effect in found.effects),
    }


def seconds_of(call: Callable[[], Result]) -> tuple[float, float, Result]:
    """Wall and processor time of a call, s, and its result."""
    wall, processor = time.perf_counter(), time.process_time()
    result = call()
    return time.perf_counter() - wall, time.process_time() - processor, result


def direct_fit(runs: Sequence[Trajectory]) -> Array:
    """Least squares of a matrix (3, N) at all reference poses: its third row by the headings, then the others."""
    driven, turned = [], []
    for run in runs:
        angles = np.cumsum(run.rates * np.diff(run.times, prepend=0.0)[:, None], axis=0)
        driven.append(_at(run, angles))
        turned.append(run.poses[1:, 2] - run.start[2])
    turning = np.linalg.lstsq(np.concatenate(driven), np.concatenate(turned))[0]
    places, columns = [], []
    for run in runs:
        steps = run.rates * np.diff(run.times, prepend=0.0)[:, None]
        headings = run.start[2] + (np.cumsum(steps, axis=0) - steps / 2) @ turning
        moved = np.cumsum(steps * np.exp(1j * headings)[:, None], axis=0)
        columns.append(_at(run, moved.real) + 1j * _at(run, moved.imag))
        away = run.poses[1:, :2] - run.start[:2]
        places.append(away[:, 0] + 1j * away[:, 1])
    way = np.linalg.lstsq(np.concatenate(columns), np.concatenate(places))[0]
    return np.array([way.real, way.imag, turning])


def _at(run: Trajectory, values: Array) -> Array:
    """Values (F, n) at the ends of a run's samples, at the stamps of its poses (K, n)."""
    return np.stack([np.interp(run.pose_times[1:], run.times, column) for column in values.T], axis=1)


if __name__ == "__main__":
    main()
