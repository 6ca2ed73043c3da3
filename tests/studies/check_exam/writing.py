"""A recording as the files of somebody else: CSV tables with a robot.yaml, or a data set's folder; and read back."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl
import yaml
from numpy.typing import NDArray

from check_exam.faults import DATASET, ONE_TABLE, POSITIONS, RADIANS, TABLES, Damage
from check_exam.recordings import TURN, Array, Recording, Run

_PATTERN = r"^(c\d+[^_]*)_"  # the command in a run's name


@dataclass(frozen=True)
class Source:
    """What to type: ``omnibench check <options>`` in ``folder``. importing: the options alone that are for import."""

    folder: Path
    name: str
    options: tuple[str, ...]
    form: str


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of equal length by name; not a number is written as a blank."""

    columns: dict[str, Array] = field(default_factory=dict)

    def write(self, file: Path, digits: dict[str, int]) -> None:
        texts = [
            ["" if np.isnan(value) else f"{value:.{digits.get(name, 6)}f}" for value in values]
            for name, values in self.columns.items()
        ]
        rows = [",".join(self.columns), *(",".join(row) for row in zip(*texts, strict=True))]
        file.write_text("\n".join(rows) + "\n")


def write(damage: Damage, form: str, folder: Path) -> Source:
    """The recording's files, and how they are named to omnibench."""
    folder.mkdir(parents=True)
    recording = damage.recording
    if form == DATASET:
        _write_dataset(damage, folder / "drives")
        return Source(folder, "drives", (), form)
    (folder / "robot.yaml").write_text(yaml.safe_dump(recording.description, sort_keys=False))
    (folder / "log").mkdir()
    for run in recording.runs:
        if form == ONE_TABLE:
            _one_table(damage, run).write(folder / "log" / f"{file_name(run)}_log.csv", {})
            continue
        wheels = _wheels(damage, run, form)
        wheels.write(folder / "log" / f"{file_name(run)}_wheels.csv", {})
        poses = _poses(run, run.pose_times * damage.pose_stamps)
        poses.write(folder / "log" / f"{file_name(run)}_poses.csv", {})
    sets = [f"command_pattern={_PATTERN}"]
    if form in (POSITIONS, ONE_TABLE):
        sets += ["wheel_unit=ticks", f"ticks_per_turn={recording.ticks:g}"]
    if form == RADIANS:
        sets += ["wheel_unit=rad"]
    if form == ONE_TABLE:
        sets += ["wheel_suffix=_log.csv", "pose_suffix=_log.csv"]
    return Source(folder, "log", ("--robot", "robot.yaml", *(word for each in sets for word in ("--set", each))), form)


def file_name(run: Run) -> str:
    return f"{run.command}_{run.name}"


def _rates(recording: Recording, run: Run) -> Array:
    """Mean rates (F, N), rad/s, since the row before; the first row holds 0."""
    steps = np.diff(run.counts, axis=0) * (TURN / recording.ticks)
    return np.vstack([np.zeros(steps.shape[1]), steps / np.diff(run.times)[:, None]])


def _wheels(damage: Damage, run: Run, form: str) -> Table:
    recording = damage.recording
    kept: NDArray[np.bool_] = ~damage.lost.get(run.name, np.zeros(len(run.times), dtype=bool))
    if form == TABLES:
        prefix, values = "omega_", _rates(recording, run)
    elif form == RADIANS:
        prefix, values = "phi_", run.counts * (TURN / recording.ticks)
    else:
        prefix, values = "ticks_", run.counts
    columns = {"t": run.times * damage.wheel_stamps}
    columns |= {prefix + name: column for name, column in zip(recording.wheels, values.T, strict=True)}
    columns |= {f"steer_{name}": column for name, column in zip(recording.steered, run.steering.T, strict=True)}
    return Table({name: values[kept] for name, values in columns.items()})


def _poses(run: Run, stamps: Array) -> Table:
    return Table({"t": stamps, "x": run.poses[:, 0], "y": run.poses[:, 1], "theta": run.poses[:, 2]})


def _one_table(damage: Damage, run: Run) -> Table:
    """Wheels and poses by one clock in the same rows; blanks where there is no pose."""
    recording = damage.recording
    columns = {"t": run.times * damage.wheel_stamps}
    columns |= {f"ticks_{name}": column for name, column in zip(recording.wheels, run.counts.T, strict=True)}
    columns |= {f"steer_{name}": column for name, column in zip(recording.steered, run.steering.T, strict=True)}
    poses = np.full((len(run.times), 3), np.nan)
    rows = np.searchsorted(run.times, run.pose_times - 1e-9)
    poses[rows] = run.poses
    return Table(columns | dict(zip(("x", "y", "theta"), poses.T, strict=True)))


def _write_dataset(damage: Damage, folder: Path) -> None:
    """A data set of CSV tables: t = 0 is the first pose, or the begin of the wheels if that is later."""
    folder.mkdir()
    recording = damage.recording
    tables: dict[str, list[pl.DataFrame]] = {"trajectories": [], "wheels": [], "poses": []}
    seen: dict[str, int] = {}
    periods = []
    for run in recording.runs:
        seen[run.command] = seen.get(run.command, 0) + 1
        zero = max(run.times[0], run.pose_times[0])
        rates = _rates(recording, run)
        kept = (run.times > zero + 1e-9) & ~damage.lost.get(run.name, np.zeros(len(run.times), dtype=bool))
        shown = (run.pose_times > zero + 1e-9) & (run.pose_times <= run.times[-1] + 1e-9)
        start = [np.interp(zero, run.pose_times, column) for column in run.poses.T]
        poses = np.vstack([start, run.poses[shown]])
        stamps = np.append(0.0, run.pose_times[shown] - zero) * damage.pose_stamps
        name = file_name(run)
        split = "train" if seen[run.command] % 2 else "validation"
        row = {"trajectory": name, "split": split, "command": run.command, "repetition": seen[run.command]}
        tables["trajectories"].append(pl.DataFrame([row]))
        columns = {"t": (run.times[kept] - zero) * damage.wheel_stamps}
        columns |= {f"omega_{wheel}": values for wheel, values in zip(recording.wheels, rates[kept].T, strict=True)}
        columns |= {f"steer_{wheel}": v for wheel, v in zip(recording.steered, run.steering[kept].T, strict=True)}
        tables["wheels"].append(pl.DataFrame({"trajectory": [name] * int(kept.sum())} | columns))
        columns = {"t": stamps} | dict(zip(("x", "y", "theta"), poses.T, strict=True))
        tables["poses"].append(pl.DataFrame({"trajectory": [name] * len(poses)} | columns))
        periods.append(float(np.median(np.diff(run.times))) * damage.wheel_stamps)
    for name, parts in tables.items():
        pl.concat(parts).write_csv(folder / f"{name}.csv")
    header = {
        "format": "omnibench-dataset/1",
        "name": recording.robot,
        "description": "a recording of the exam",
        "robot": recording.description,
        "sample_period": round(float(np.median(periods)), 6),
        "wheels": list(recording.wheels),
    }
    (folder / "dataset.yaml").write_text(yaml.safe_dump(header, sort_keys=False))


def read_dataset(folder: Path, sound: Recording) -> Recording:
    """A data set that omnibench wrote, as a recording of the same robot, with counts by its rates.

    Where its wheels have other radii, the counts are those by which the sound robot's wheels roll as far.
    """
    wheels, poses = (_table(folder, name) for name in ("wheels", "poses"))
    written = yaml.safe_load((folder / "dataset.yaml").read_text())["robot"]
    radii, sound_radii = (
        {wheel["name"]: float(wheel["radius"]) for wheel in robot["wheels"]} for robot in (written, sound.description)
    )
    larger = np.array([radii[wheel] / sound_radii[wheel] for wheel in sound.wheels])
    runs = []
    for (name,), rows in wheels.group_by("trajectory", maintain_order=True):
        rates = rows.select([f"omega_{wheel}" for wheel in sound.wheels]).to_numpy()
        times = np.append(0.0, rows["t"].to_numpy())
        steps = rates * larger * np.diff(times)[:, None] * (sound.ticks / TURN)
        counts = np.vstack([np.zeros(rates.shape[1]), np.cumsum(steps, axis=0)])
        steering = rows.select([f"steer_{wheel}" for wheel in sound.steered]).to_numpy().reshape(len(rows), -1)
        steering = np.vstack([steering[:1], steering])
        track = poses.filter(pl.col("trajectory") == name)
        path = track.select("x", "y", "theta").to_numpy()
        runs.append(Run(str(name), "", "", times, counts, steering, track["t"].to_numpy(), path))
    return sound.of(runs)


def _table(folder: Path, name: str) -> pl.DataFrame:
    parquet = folder / f"{name}.parquet"
    return pl.read_parquet(parquet) if parquet.is_file() else pl.read_csv(folder / f"{name}.csv")
