"""Recordings as the files of strangers: tables of CSV in plain and in odd forms."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path

import yaml

from strangers.motion import Log, Run

EPOCH = 1_750_000_000.0  # s
Row = Sequence[object]


def text(value: float, digits: int = 4) -> str:
    return f"{value:.{digits}f}".rstrip("0").rstrip(".")


def write_robot(log: Log, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.yaml").write_text(yaml.safe_dump(log.robot, sort_keys=False))
    return folder


def names(log: Log, prefix: str) -> list[str]:
    return ["t", *(f"{prefix}_{wheel}" for wheel in log.wheels), *(f"steer_{wheel}" for wheel in log.steered)]


def wheel_rows(run: Run) -> list[list[str]]:
    return [
        [text(t), *map(text, w), *map(text, s)] for t, w, s in zip(run.times, run.wheels, run.steering, strict=True)
    ]


def pose_rows(run: Run) -> list[list[str]]:
    return [[text(t), *map(text, pose)] for t, pose in zip(run.pose_times, run.poses, strict=True)]


def lines(rows: Iterable[Row], between: str = ",", end: str = "\n") -> str:
    return "".join(between.join(map(str, row)) + end for row in rows)


def write_tables(log: Log, folder: Path, prefix: str = "phi") -> None:
    """robot.yaml and a table a run, rows of wheels and of poses by time, with blanks where there is no sample."""
    head = names(log, prefix)
    for name, run in log.runs.items():
        rows = [[*row, "", "", ""] for row in wheel_rows(run)]
        rows += [[row[0], *[""] * (len(head) - 1), *row[1:]] for row in pose_rows(run)]
        rows.sort(key=lambda row: float(row[0]))
        (write_robot(log, folder) / f"{name}.csv").write_text(lines([[*head, "x", "y", "theta"], *rows]))


def write_positions(log: Log, folder: Path, scale: float = 1.0) -> None:
    """Wheels as tables, and x and y alone as references, in m times a scale."""
    head = ["kind", "t1", "value_x", "value_y", "sigma"]
    for name, run in log.runs.items():
        (write_robot(log, folder) / f"{name}_wheels.csv").write_text(lines([names(log, "phi"), *wheel_rows(run)]))
        places = zip(run.pose_times, run.poses * scale, strict=True)
        rows = [["position", text(t), text(x), text(y), 0.003 * scale] for t, (x, y, _) in places]
        (folder / f"{name}_references.csv").write_text(lines([head, *rows]))


# Forms of tables by name: each writes the files of one run, of poses at the times of the wheels.


def _whole(run: Run, head: list[str]) -> list[list[str]]:
    """Rows with wheels and pose."""
    return [[*head, "x", "y", "theta"], *([*w, *p[1:]] for w, p in zip(wheel_rows(run), pose_rows(run), strict=True))]


def _decimal_commas(run: Run, head: list[str], file: Path) -> None:
    rows = _whole(run, head)
    file.with_suffix(".csv").write_text(lines(rows, ";", "\r\n").replace(".", ","))


def _iso_times(run: Run, head: list[str], file: Path) -> None:
    rows = _whole(run, head)
    for row in rows[1:]:
        row[0] = datetime.fromtimestamp(EPOCH + float(row[0]), UTC).isoformat()
    file.with_suffix(".csv").write_text(lines(rows))


def _byte_order_mark(run: Run, head: list[str], file: Path) -> None:
    rows = _whole(run, head)
    rows[0] = [f'"{name}"' for name in rows[0]]
    file.with_suffix(".csv").write_text(lines(rows, ", ", "\r\n"), encoding="utf-8-sig", newline="")


def _row_of_units(run: Run, head: list[str], file: Path) -> None:
    rows = _whole(run, head)
    units = ["[s]", *["[rad]"] * (len(head) - 1), "[m]", "[m]", "[rad]"]
    file.with_suffix(".csv").write_text(lines([rows[0], units, *rows[1:]]))


def _degrees_to_360(run: Run, head: list[str], file: Path) -> None:
    rows = _whole(run, head)
    for row in rows[1:]:
        row[-1] = text(math.degrees(float(row[-1])) % 360)
    file.with_suffix(".csv").write_text(lines(rows))


def _rostopic(run: Run, head: list[str], file: Path) -> None:
    """What ``rostopic echo -p`` prints of a JointState and of a PoseStamped."""
    joints = [column.removeprefix("phi_") for column in head[1:]]
    start = ["%time", "field.header.seq", "field.header.stamp", "field.header.frame_id"]
    numbers = range(len(joints))
    rows: list[Row] = [[*start, *(f"field.name{n}" for n in numbers), *(f"field.position{n}" for n in numbers)]]
    place, turn = "field.pose.position", "field.pose.orientation"
    poses: list[Row] = [[*start, f"{place}.x", f"{place}.y", f"{place}.z", *(f"{turn}.{axis}" for axis in "xyzw")]]
    for number, (t, wheels, (x, y, heading)) in enumerate(zip(run.times, run.wheels, run.poses, strict=True)):
        stamp = round((EPOCH + t) * 1e9)
        rows.append([stamp, number, stamp, "", *joints, *map(text, wheels)])
        half = (text(math.sin(heading / 2), 6), text(math.cos(heading / 2), 6))
        poses.append([stamp, number, stamp, "map", text(x), text(y), 0, 0, 0, *half])
    file.with_name(f"{file.name}_wheels.csv").write_text(lines(rows))
    file.with_name(f"{file.name}_poses.csv").write_text(lines(poses))


def _motive(run: Run, head: list[str], file: Path) -> None:
    """A rigid body as OptiTrack Motive exports it: 7 lines of header, mm, y up, z to the right."""
    file.with_name(f"{file.name}_wheels.csv").write_text(lines([head, *wheel_rows(run)]))
    settings = (
        "Format Version,1.23,Take Name,take,Rotation Type,Quaternion,Length Units,Millimeters,Coordinate Space,Global"
    )
    rows: list[Row] = [[settings], [], ["", "", *["Rigid Body"] * 8], ["", "", *["bot"] * 8], ["", "", *["id"] * 8]]
    rows.append(["", "", *["Rotation"] * 4, *["Position"] * 3, "Mean Marker Error"])
    rows.append(["Frame", "Time (Seconds)", "X", "Y", "Z", "W", "X", "Y", "Z", ""])
    for number, (t, (x, y, heading)) in enumerate(zip(run.pose_times, run.poses, strict=True)):
        half = (text(math.sin(heading / 2), 6), 0, text(math.cos(heading / 2), 6))
        rows.append([number, text(t), 0, *half, text(1e3 * x, 2), "52.10", text(-1e3 * y, 2), "0.40"])
    file.with_name(f"{file.name}_poses.csv").write_text(lines(rows))


FORMS: dict[str, Callable[[Run, list[str], Path], None]] = {
    "decimal commas": _decimal_commas,
    "ISO-8601 times": _iso_times,
    "BOM, CRLF, quoted names": _byte_order_mark,
    "a row of units": _row_of_units,
    "headings 0..360 deg": _degrees_to_360,
    "rostopic echo -p": _rostopic,
    "OptiTrack Motive": _motive,
}
