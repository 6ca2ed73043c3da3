"""A finding about a recording: what is wrong, where, how bad it is, and what to type."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field

from omnibench.config import Model

Severity = Literal["error", "warning", "note"]
Kind = Literal[
    "wheels_swapped",
    "wheel_negated",
    "wheels_negated",
    "wheel_scale",
    "wheel_unit",
    "wheel_dead",
    "wheel_dropout",
    "counter_restart",
    "steering_unit",
    "steering_sign",
    "steering_zero",
    "steering_swapped",
    "steering_frozen",
    "heading_unit",
    "position_unit",
    "time_unit",
    "clock_offset",
    "clock_drift",
    "reference_mirrored",
    "reference_turned",
    "reference_dropout",
    "reference_jump",
    "reference_frozen",
    "reference_is_odometry",
    "not_at_rest",
    "motion_missing",
    "references_leave_open",
    "few_repetitions",
    "few_runs",
    "simulated_like",
    "copies",
    "headings_ambiguous",
    "sample_period",
    "late_reference",
]


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
