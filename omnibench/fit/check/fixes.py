"""What to type for a finding: the import of its source, with the options that mend it beside those that were given."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from omnibench.data.checks.finding import Finding
from omnibench.errors import OmnibenchError
from omnibench.fit.check.recording_source import RecordingSource
from omnibench.registry import importers
from omnibench.robot.kinematics import Robot

_POSE = ("x", "y", "theta")
_RATES = {"rpm": 2 * 3.141592653589793 / 60, "deg/s": 3.141592653589793 / 180, "rev/s": 2 * 3.141592653589793}
_POSITIONS = {"deg/s": "deg", "rev/s": "rev"}
_IDENTITY = {"position_unit": "m", "heading_unit": "rad", "wheel_time_unit": "s", "pose_time_unit": "s"}


class CannotBeTypedError(Exception):
    """The importer of a recording has no option for a fix."""


def with_fixes(read: RecordingSource, findings: Sequence[Finding]) -> list[Finding]:
    """The findings, each with the command that mends it where there is one."""
    return [
        finding.model_copy(update={"fix": command(read, [finding])})
        if finding.changes and (not finding.fix or finding.severity == "error")
        else finding
        for finding in findings
    ]


def command(read: RecordingSource, findings: Sequence[Finding]) -> str:
    """The command line that reads a recording again, mended; by way of a data set where its importer cannot."""
    changes = [finding.changes for finding in findings if finding.changes]
    if not changes:
        return ""
    try:
        return _import(read.importer, read.source, _mended(read, read.importer, read.options, changes), _target(read))
    except CannotBeTypedError:
        pass
    if read.folder is not None and (read.folder / "dataset.yaml").is_file():
        return _import("dataset", read.folder, _mended(read, "dataset", {}, changes), _beside(read.folder))
    first = _target(read)
    given = _import(read.importer, read.source, read.options, first)
    return f"{given} && {_import('dataset', first, _mended(read, 'dataset', {}, changes), _beside(first))}"


def _target(read: RecordingSource) -> Path:
    """The folder of the data set that is written."""
    if read.folder is None:
        return Path("data") / (read.source.stem or "recording")
    return _beside(read.folder) if read.importer == "dataset" else read.folder


def _beside(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}_mended")


def _import(importer: str, source: Path, options: Mapping[str, Any], output: Path) -> str:
    words = ["omnibench", "import", importer, str(source), "-o", str(output), "--force"]
    for key, value in options.items():
        words += ["--set", f"{key}={as_yaml(value)}"]
    return shlex.join(words)


def as_yaml(value: Any) -> str:
    """A value as ``--set`` takes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        plain = value and all(letter.isalnum() or letter in "._/*-" for letter in value) and value[0] != "*"
        return value if plain else json.dumps(value)
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    if isinstance(value, Mapping):
        return json.dumps(value)
    if isinstance(value, list | tuple):
        return f"[{','.join(as_yaml(item) for item in value)}]"
    return str(value)


def _mended(
    read: RecordingSource, importer: str, given: Mapping[str, Any], changes: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """The options with all changes. CannotBeTypedError: the importer lacks one of them."""
    options = dict(given)
    for change in changes:
        for key, value in change.items():
            options = _with_change(read, importer, options, key, value)
    fields = importers.entry(importer).options.model_fields
    for key in options:
        if key not in fields:
            raise CannotBeTypedError(key)
    return options


def _with_change(
    read: RecordingSource, importer: str, options: Mapping[str, Any], key: str, value: Any
) -> dict[str, Any]:
    """The options after one change, relative to them."""
    robot = read.dataset.robot
    changed = dict(options)
    if key == "wheel_order":
        names = _columns(read, importer, options, robot)
        changed["wheel_columns"] = [names[column] for column in value]
        for option in ("wheel_signs", "ticks_per_turn", "gear_ratio"):
            if isinstance(options.get(option), list | tuple) and len(options[option]) == len(value):
                changed[option] = [options[option][column] for column in value]
    elif key == "wheel_signs":
        changed["wheel_signs"] = _product(options.get("wheel_signs"), value)
    elif key == "rate_factors":
        option = "ticks_per_turn" if options.get("ticks_per_turn") else "gear_ratio"
        changed[option] = _one_or_all(_product(options.get(option), value))
    elif key == "wheel_unit":
        changed |= _wheel_unit(options, value, len(robot.wheel_names))
    elif key == "steering_order":
        names = list(options.get("steering_columns") or _steering_names(importer, robot))
        changed["steering_columns"] = [names[column] for column in value]
    elif key == "steering_signs":
        changed["steering_signs"] = _product(options.get("steering_signs"), value)
        if options.get("steering_offsets_deg"):
            changed["steering_offsets_deg"] = _product(options["steering_offsets_deg"], value)
    elif key == "steering_factors":
        changed["steering_scale"] = _one_or_all(_product(options.get("steering_scale"), value))
    elif key == "steering_offsets_deg":
        changed[key] = _one_or_all(_sum(options.get(key), value))
    elif key == "pose_order":
        names = list(options.get("pose_columns") or _POSE)
        changed["pose_columns"] = [names[column] for column in value]
    elif key == "pose_signs":
        changed[key] = _product(options.get(key), value)
    elif key == "heading_offset_deg":
        changed[key] = round(float(options.get(key, 0.0)) + value, 3)
    elif key == "leave_out":
        before = options.get(key, [])
        changed[key] = [*([before] if isinstance(before, str) else before), *map(_pattern, value)]
    elif key in _IDENTITY and options.get(key) not in (None, _IDENTITY[key], value):
        raise CannotBeTypedError(key)
    else:
        changed[key] = value
    return changed


def _wheel_unit(options: Mapping[str, Any], unit: str, count: int) -> dict[str, Any]:
    present = options.get("wheel_unit", "rad/s")
    if present == "rad/s":
        return {"wheel_unit": unit}
    if present == "rad" and unit in _POSITIONS:
        return {"wheel_unit": _POSITIONS[unit]}
    option = "ticks_per_turn" if options.get("ticks_per_turn") else "gear_ratio"
    return {option: _one_or_all(_product(options.get(option), [float(f"{1 / _RATES[unit]:.6g}")] * count))}


def _columns(read: RecordingSource, importer: str, options: Mapping[str, Any], robot: Robot) -> list[Any]:
    """Names of the wheels' columns, in the robot's order, as they are read."""
    if options.get("wheel_columns"):
        return list(options["wheel_columns"])
    if importer == "dataset":
        return list(robot.wheel_names)
    entry = importers.entry(importer)
    try:
        validated: BaseModel = entry.options.model_validate(entry.cls.completed(options, read.source))
    except (ValueError, OmnibenchError):
        raise CannotBeTypedError("wheel_columns") from None
    columns = getattr(validated, "columns", None)
    if not isinstance(columns, tuple) or len(columns) != len(robot.wheel_names):
        raise CannotBeTypedError("wheel_columns")
    return list(columns)


def _steering_names(importer: str, robot: Robot) -> list[str]:
    prefix = "" if importer == "dataset" else "steer_"
    return [prefix + wheel for wheel in robot.drive.steered]


def _pattern(name: str) -> str:
    """A pattern that matches one run only."""
    return "".join(f"[{letter}]" if letter in "*?[" else letter for letter in name)


def _listed(present: Any, count: int, default: float) -> list[float]:
    values = present if isinstance(present, list | tuple) else [] if present is None else [present]
    return list(values) * count if len(values) == 1 else list(values) or [default] * count


def _product(present: Any, factors: Sequence[float]) -> list[float]:
    count = max(len(factors), len(present) if isinstance(present, list | tuple) else 1)
    both = zip(_listed(present, count, 1), _listed(list(factors), count, 1), strict=True)
    return [
        value if isinstance(value, int) else float(f"{value:.6g}") for value in (one * other for one, other in both)
    ]


def _sum(present: Any, offsets: Sequence[float]) -> list[float]:
    both = zip(_listed(present, len(offsets), 0.0), offsets, strict=True)
    return [round(one + other, 3) for one, other in both]


def _one_or_all(values: Sequence[float]) -> Any:
    """One value where all are the same."""
    return values[0] if len(set(values)) == 1 else list(values)
