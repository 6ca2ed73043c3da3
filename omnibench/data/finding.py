"""A finding about a recording: what is wrong, where, how bad it is, what to type; and a warning that becomes one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

from pydantic import Field

from omnibench.config import Model

Severity = Literal["error", "warning", "note"]
WheelReading = Literal["wheels_swapped", "wheel_negated", "wheels_negated", "wheel_scale", "wheel_unit"]
SteeringReading = Literal["steering_unit", "steering_sign", "steering_zero", "steering_swapped", "steering_lag"]
ReferenceReading = Literal["heading_unit", "position_unit", "time_unit", "reference_mirrored", "reference_turned"]
DesignMistake = Literal["design_distance", "design_radius", "design_rollers", "design_mount", "design_unknown"]
Misreading = Literal[WheelReading, SteeringReading, ReferenceReading, DesignMistake]
Spoiled = Literal["reference_frozen", "reference_is_odometry"]
Unreadable = Literal[Spoiled, "reference_foreign", "steering_frozen", "wheel_dead", "wheel_unsigned"]
Disturbed = Literal["wheel_dropout", "reference_dropout", "reference_jump", "counter_restart", "not_at_rest", "copies"]
Clock = Literal["clock_offset", "clock_drift"]
Lacking = Literal["motion_missing", "few_runs", "few_repetitions"]
Kind = Literal[Misreading, Unreadable, Disturbed, Clock, Lacking, "references_leave_open", "runs_drawn"]

UNITS: tuple[Kind, ...] = ("wheel_unit", "steering_unit", "heading_unit", "position_unit", "time_unit")
MISREAD, LACKING, CLOCKS = frozenset(get_args(Misreading)), get_args(Lacking), frozenset(get_args(Clock))
SPOILED = frozenset(get_args(Spoiled))  # the reference tells nothing
UNREAD = frozenset(get_args(Unreadable))  # no other reading mends it


class Finding(Model):
    """Something about a recording that a calibration suffers from, or that its user should know.

    changes: options of an importer that mend it, relative to those by which the recording was read; a list of signs
    multiplies the present ones, an offset is added. fix: what to type, or to do where no option helps.
    """

    kind: Kind
    what: str
    where: str
    severity: Severity
    fix: str = ""
    changes: Mapping[str, Any] = Field(default_factory=dict, exclude=True)


def error(kind: Kind, what: str, where: str, changes: Mapping[str, Any] | None = None, *, fix: str = "") -> Finding:
    """The finding of an error, with the options that mend it, or what to do."""
    return Finding(kind=kind, what=what, where=where, severity="error", fix=fix, changes=changes or {})


class CounterRestart(str):
    """A warning of a data set: counters began again, which its importer has mended. ``check`` tells it as a note."""
