"""Arrays and tables that a user gives, and wheel logs of these: of arrays, a run, or a table of one run or several."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from omnibench.errors import DataError
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.odometry import WheelLog

if TYPE_CHECKING:
    import polars as pl

_ORIGIN = (0.0, 0.0, 0.0)


def finite_array(name: str, values: ArrayLike, dimensions: int) -> Array:
    """An array of finite numbers. DataError names it, and the row (1 is the first) of what is wrong."""
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise DataError(f"{name}: expected numbers, in rows of one length") from None
    if array.ndim != dimensions or not array.size:
        axes = "(rows,)" if dimensions == 1 else "(rows, columns)"
        raise DataError(f"{name} has shape {array.shape}, expected {axes}")
    for row in np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))[:1]:
        raise DataError(f"{name}, row {row + 1}: it holds a value that is missing or infinite")
    return array


def frame_of(name: str, content: Any) -> pl.DataFrame:
    """A data frame or a dict of columns as a Polars frame. DataError names the table and the column that is unfit."""
    import polars as pl  # takes longer than all that imports this module

    if isinstance(content, pl.DataFrame):
        return content
    names = content if isinstance(content, Mapping) else getattr(content, "columns", None)  # as pandas has them
    if names is None:
        raise DataError(f"{name}: expected a data frame or a dict of arrays, found {type(content).__name__}")
    arrays = {str(column): np.atleast_1d(np.asarray(content[column])) for column in names}
    for column, array in arrays.items():
        first = next(iter(arrays))
        if array.ndim != 1:
            raise DataError(f"{name}: column {column!r} has shape {array.shape}; give a column for each wheel or axis")
        if len(array) != len(arrays[first]):
            raise DataError(f"{name}: column {column!r} has {len(array)} rows, {first!r} has {len(arrays[first])}")
    return pl.DataFrame(
        {column: array.tolist() if array.dtype == object else array for column, array in arrays.items()}, strict=False
    )


def log_of_arrays(
    robot: Robot,
    times: ArrayLike,
    rates: ArrayLike,
    *,
    start: ArrayLike = _ORIGIN,
    stamps: ArrayLike | None = None,
    steering: ArrayLike | None = None,
    angles: ArrayLike | None = None,
) -> WheelLog:
    """The wheel log of a robot from arrays; ``odometry`` says what they are. stamps: default: ``times``.

    DataError: a shape, a time or a value is wrong.
    """
    log = WheelLog(
        times=finite_array("times", times, 1),
        rates=finite_array("rates", rates, 2),
        start=finite_array("start", start, 1),
        stamps=finite_array("stamps", times if stamps is None else stamps, 1),
        wheel_angles=None if angles is None else finite_array("angles", angles, 2),
        steering=None if steering is None else finite_array("steering", steering, 2),
        drive=None if robot.drive.direct else robot.drive,
    )
    # Shapes that agree with each other and the robot, and times that increase
    steered = robot.drive.steered
    if steered and log.steering is None:
        raise DataError(f"steering is missing: angles (F, {len(steered)}) of the wheels {', '.join(steered)}, rad")
    samples = len(log.times)
    rows = "a row for each of the times, a column for each of the wheels"
    of_wheels, of_steered = f"{rows} {', '.join(robot.wheel_names)}", f"{rows} {', '.join(steered)}"
    for name, array, shape, axes in (
        ("rates", log.rates, (samples, len(robot.wheel_names)), of_wheels),
        ("angles", log.wheel_angles, (samples, len(robot.wheel_names)), of_wheels),
        ("steering", log.steering, (samples, len(steered)), of_steered),
        ("start", log.start, (3,), "x, y in m and heading in rad"),
    ):
        if array is not None and array.shape != shape:
            raise DataError(f"{name} has shape {array.shape}, expected {shape}: {axes}")
    for name, values, least in (("times", log.times, np.nextafter(0.0, 1.0)), ("stamps", log.stamps, 0.0)):
        steps = np.diff(values, prepend=values[0] - 1.0)
        for row in np.flatnonzero((steps <= 0) | (values < least))[:1]:
            rule = "> 0" if name == "times" else ">= 0"
            raise DataError(f"{name}, row {row + 1}: it is {values[row]:g}; times increase and are {rule}")
    return log


def logs_of(robot: Robot, wheels: Any, start: ArrayLike | None) -> Iterator[tuple[str | None, WheelLog]]:
    """The wheel logs of a run, or of a table with the columns of a data set's wheels; stamps at 0 and every sample.

    Each with the run's name, None where the table has no column ``trajectory``. start: that of all runs; default: of a
    run its own, of a table the origin. DataError: columns are missing or values are wrong.
    """
    if hasattr(wheels, "pose_times"):  # a Trajectory
        log = log_of_arrays(
            robot,
            wheels.times,
            wheels.rates,
            start=wheels.start if start is None else start,
            stamps=np.append(0.0, wheels.times),
            steering=wheels.steering,
            angles=wheels.angles,
        )
        yield None, replace(log, started_at=wheels.started_at, session=wheels.session)
        return
    table = frame_of("wheels", wheels)
    steered, named = robot.drive.steered, "trajectory" in table.columns
    needed = ["t", *(f"omega_{name}" for name in robot.wheel_names), *(f"steer_{name}" for name in steered)]
    if missing := [name for name in needed if name not in table.columns]:
        raise DataError(f"wheels: column {missing[0]} is missing; a table has {', '.join(needed)}")
    phases = [f"phi_{name}" for name in robot.wheel_names]
    for name, run in table.group_by("trajectory", maintain_order=True) if named else [((None,), table)]:
        yield (
            name[0],
            log_of_arrays(
                robot,
                run["t"],
                run.select(f"omega_{wheel}" for wheel in robot.wheel_names),
                start=_ORIGIN if start is None else start,
                stamps=np.append(0.0, run["t"]),
                steering=run.select(f"steer_{wheel}" for wheel in steered) if steered else None,
                angles=run.select(phases) if set(phases) <= set(table.columns) else None,
            ),
        )
