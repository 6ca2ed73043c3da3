"""A newcomer's log: a robot simulated by nothing of omnibench, which writes its own kind of tables.

    python tests/studies/newcomer_log.py DIR [--robot diff|mecanum] [--seed N]

writes DIR/logs/<motion>_<n>.csv, and DIR/truth.json, which nobody reads but he who judges. The logs: 50 Hz, semicolons,
stamps in ms since 1970, encoder ticks that went on counting between runs, positions of a motion capture in mm and
degrees at 20 Hz in the same rows, and blanks in the rows without one.

The robot is integrated in steps of 1 ms by the midpoint rule, its wheels follow trapezoids of speed with a controller's
error, each wheel slips by a random walk, encoders count whole ticks, and the capture is noisy.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Array = NDArray[np.float64]
_STEP, _LOG, _CAPTURE = 0.001, 0.02, 0.05  # s
_EPOCH = 1_714_730_000_000  # ms


@dataclass(frozen=True)
class Machine:
    """A robot. columns: of its encoders; ticks: of a turn of the wheel.

    design, truth: twists (3, N) of the centre, forward, left, counter-clockwise, for wheel rates of 1 rad/s.
    """

    columns: tuple[str, ...]
    ticks: int
    design: Array
    truth: Array
    motions: dict[str, tuple[float, float, float]]


def differential(rng: Generator) -> Machine:
    """Two wheels of 0.075 m, 0.32 m apart; truly a little off."""
    left, right = 0.075 * (1 + rng.uniform(-0.02, 0.02, 2))
    apart = 0.32 * (1 + rng.uniform(-0.03, 0.03))
    motions = {
        "forward": (0.4, 0.0, 0.0), "backward": (-0.4, 0.0, 0.0), "bend_left": (0.35, 0.0, 0.5),
        "bend_right": (0.35, 0.0, -0.5), "tight_left": (0.2, 0.0, 0.9), "tight_right": (0.2, 0.0, -0.9),
        "spin_left": (0.0, 0.0, 0.8), "spin_right": (0.0, 0.0, -0.8),
    }  # fmt: skip
    return Machine(("enc_L", "enc_R"), 2048, _axle(0.075, 0.075, 0.32), _axle(left, right, apart), motions)


def _axle(left: float, right: float, apart: float) -> Array:
    return np.array([[left / 2, right / 2], [0.0, 0.0], [-left / apart, right / apart]])


def mecanum(rng: Generator) -> Machine:
    """Four wheels of 0.06 m at (+-0.21, +-0.17) m; truly a little off, all alike, so that they need not slip."""
    radius, reach = 0.06 * (1 + rng.uniform(-0.02, 0.02)), 0.38 * (1 + rng.uniform(-0.03, 0.03))
    sideways = 1 + rng.uniform(-0.04, 0.0)  # rollers give way
    motions = {
        "forward": (0.4, 0.0, 0.0), "backward": (-0.4, 0.0, 0.0), "left": (0.0, 0.3, 0.0), "right": (0.0, -0.3, 0.0),
        "diagonal": (0.25, 0.25, 0.0), "spin_left": (0.0, 0.0, 0.7), "spin_right": (0.0, 0.0, -0.7),
        "bend_left": (0.3, 0.0, 0.4), "bend_right": (0.3, 0.0, -0.4),
    }  # fmt: skip
    columns = ("m_front_left", "m_front_right", "m_rear_left", "m_rear_right")
    return Machine(columns, 4096, _platform(0.06, 0.38, 1.0), _platform(radius, reach, sideways), motions)


def _platform(radius: float, reach: float, sideways: float) -> Array:
    rows = [[1, 1, 1, 1], [-sideways, sideways, sideways, -sideways], np.array([-1, 1, -1, 1]) / reach]
    return radius / 4 * np.array([np.asarray(row, dtype=float) for row in rows])


ROBOTS = {"diff": differential, "mecanum": mecanum}


def write_logs(folder: Path, robot: str = "diff", seed: int = 1, repetitions: int = 3) -> Machine:
    """Write ``logs`` and ``truth.json`` into a folder."""
    rng = np.random.default_rng([seed, len(robot)])
    machine = ROBOTS[robot](rng)
    logs = folder / "logs"
    logs.mkdir(parents=True)
    stamp, counts = _EPOCH, rng.integers(-5000, 5000, len(machine.columns)).astype(float)
    for repetition in range(1, repetitions + 1):
        for name, twist in machine.motions.items():
            rows, counts = _drive(machine, twist, counts, stamp, rng)
            header = ";".join(["stamp", *machine.columns, "mocap_x", "mocap_y", "mocap_yaw"])
            (logs / f"{name}_{repetition}.csv").write_text("\n".join([header, *rows]) + "\n")
            stamp += 60_000 + int(rng.integers(5000))
    content = {"robot": robot, "columns": machine.columns, "matrix": machine.truth.tolist()}
    (folder / "truth.json").write_text(json.dumps(content, indent=1))
    return machine


def _drive(
    machine: Machine, twist: Sequence[float], counts: Array, stamp: int, rng: Generator
) -> tuple[list[str], Array]:
    """A run's rows, and where its encoders stand afterwards."""
    seconds = 6.0 + float(rng.uniform(0, 1))
    times = np.arange(0, seconds, _STEP)
    ramp = np.clip(np.minimum(times - 0.5, seconds - 0.7 - times) / 0.6, 0, 1)  # rests before and after
    wheels = np.linalg.pinv(machine.design) @ np.asarray(twist)
    spread = 1 + rng.normal(0, 0.01, len(wheels))
    rates = ramp[:, None] * (wheels * spread)
    if len(wheels) == 4:  # without a share that would force it to slip
        rates = rates @ (np.linalg.pinv(machine.design) @ machine.design).T
    angles = np.cumsum(rates, axis=0) * _STEP
    walk = np.cumsum(rng.normal(0, 0.02 * math.sqrt(_STEP), rates.shape), axis=0)
    rolled = rates + np.gradient(walk, _STEP, axis=0) * (np.abs(rates) > 1e-9) * 0.3
    body = rolled @ machine.truth.T
    heading = rng.uniform(-math.pi, math.pi) + np.cumsum(body[:, 2]) * _STEP
    middle = heading - body[:, 2] * _STEP / 2
    x = rng.uniform(-1, 1) + np.cumsum(np.cos(middle) * body[:, 0] - np.sin(middle) * body[:, 1]) * _STEP
    y = rng.uniform(-1, 1) + np.cumsum(np.sin(middle) * body[:, 0] + np.cos(middle) * body[:, 1]) * _STEP
    ticks = np.floor(counts + angles * machine.ticks / (2 * math.pi))
    rows = []
    shown = -1
    for index in range(0, len(times), round(_LOG / _STEP)):
        fields = [str(stamp + round(times[index] * 1000)), *(f"{count:.0f}" for count in ticks[index])]
        frame = int(times[index] / _CAPTURE + 1e-9)
        if frame > shown:
            shown = frame
            yaw = math.degrees(heading[index] + rng.normal(0, 0.003))
            place = (1000 * x[index] + rng.normal(0, 1.5), 1000 * y[index] + rng.normal(0, 1.5))
            fields += [f"{place[0]:.1f}", f"{place[1]:.1f}", f"{(yaw + 180) % 360 - 180:.2f}"]
        else:
            fields += ["", "", ""]
        rows.append(";".join(fields))
    return rows, counts + angles[-1] * machine.ticks / (2 * math.pi)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--robot", choices=list(ROBOTS), default="diff")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    write_logs(given.folder, given.robot, given.seed)


if __name__ == "__main__":
    main()
