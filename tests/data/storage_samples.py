"""A data set in which everything is known, its tables on disk, and what can be changed in them."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import polars as pl
import yaml
from sample_robots import APR_02

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.robot.kinematics import wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import WheelLog

Format = Literal["parquet", "csv"]
FORMATS: tuple[Format, ...] = ("parquet", "csv")


def a_trajectory(identity: str, turn: float, **known: Any) -> Trajectory:
    """Four samples of 0.1 s as the design drives them; poses at 0, 0.2 and 0.4 s."""
    times = 0.1 * np.arange(1, 5)
    rates = np.tile(wheel_equations(APR_02.wheels) @ [0.2, 0.1, turn], (4, 1))
    stamps = np.array([0.0, 0.2, 0.4])
    start = np.array([1 / 3, -0.2, 1.0])
    (poses,) = OdometryModel.of_design(APR_02, "arc").poses([WheelLog(times, rates, start, stamps)])
    defaults: dict[str, Any] = {"split": "train"}
    return Trajectory(identity, times=times, rates=rates, pose_times=stamps, poses=poses, **(defaults | known))


def everything_known() -> Dataset:
    """Two runs of which nothing is unknown; the second validates."""
    runs = []
    for number, (identity, turn) in enumerate((("run-1", 0.5), ("run-2", -0.3)), 1):
        run = a_trajectory(identity, turn)
        covariance = np.random.default_rng(number).normal(size=(3, 3, 3))
        runs.append(
            replace(
                run,
                split="train" if number == 1 else "validation",
                command=f"w{turn}",
                repetition=number,
                session="morning",
                started_at=12.5 * number,
                v=0.2,
                alpha=math.radians(30),
                omega=turn,
                duration=0.4,
                distance=0.08,
                angles=np.cumsum(run.rates * 0.1, axis=0),
                targets=run.rates + 0.01,
                pose_covariances=covariance @ np.swapaxes(covariance, 1, 2),
            )
        )
    return make_dataset(
        "two runs",
        APR_02,
        0.1,
        runs,
        description="as designed; with commas, 'quotes' and ü",
        source="a test",
        licence="MIT",
        simulated=True,
    )


def table_file(folder: Path, name: str) -> Path:
    return next(file for file in folder.iterdir() if file.stem == name)


def read_frame(folder: Path, name: str) -> pl.DataFrame:
    file = table_file(folder, name)
    return pl.read_csv(file) if file.suffix == ".csv" else pl.read_parquet(file)


def write_frame(folder: Path, name: str, frame: pl.DataFrame) -> None:
    file = table_file(folder, name)
    frame.write_csv(file) if file.suffix == ".csv" else frame.write_parquet(file)


Change = Callable[[Path], object]


def set_cell(name: str, row: int, column: str, value: Any) -> Change:
    """Overwrite a cell; rows count from 1, as messages do."""

    def change(folder: Path) -> None:
        frame = read_frame(folder, name)
        values = frame[column].to_list()
        as_text = isinstance(value, list) and frame[column].dtype == pl.String
        values[row - 1] = " ".join(map(str, value)) if as_text else value
        typed = pl.Series(column, [str(v) for v in values] if isinstance(value, str) else values)
        write_frame(folder, name, frame.with_columns(typed))

    return change


def with_frame(name: str, edit: Callable[[pl.DataFrame], pl.DataFrame]) -> Change:
    return lambda folder: write_frame(folder, name, edit(read_frame(folder, name)))


def drop_column(name: str, column: str) -> Change:
    return with_frame(name, lambda frame: frame.drop(column))


def drop_rows(name: str, *rows: int) -> Change:
    return with_frame(name, lambda frame: frame[[i for i in range(len(frame)) if i + 1 not in rows]])


def rename(name: str, old: str, new: str) -> Change:
    return with_frame(name, lambda frame: frame.rename({old: new}))


def remove_file(name: str) -> Change:
    return lambda folder: table_file(folder, name).unlink()


def overwrite(name: str, content: bytes) -> Change:
    return lambda folder: table_file(folder, name).write_bytes(content)


def header(key: str, value: Any) -> Change:
    def change(folder: Path) -> None:
        content = yaml.safe_load((folder / "dataset.yaml").read_text())
        content = {**content, key: value} if value is not None else {k: v for k, v in content.items() if k != key}
        (folder / "dataset.yaml").write_text(yaml.safe_dump(content))

    return change


# In wheels, rows 1 to 4 are run-1's and 5 to 8 are run-2's; in poses 1 to 3 and 4 to 6.
