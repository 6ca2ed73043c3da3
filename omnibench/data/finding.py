"""A finding about a recording: what is wrong, where, how bad it is, and what to type; and a warning that holds one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
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
    "wheel_unsigned",
    "wheel_dropout",
    "counter_restart",
    "steering_unit",
    "steering_sign",
    "steering_zero",
    "steering_swapped",
    "steering_frozen",
    "steering_lag",
    "design_distance",
    "design_rollers",
    "design_mount",
    "design_unknown",
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
    "reference_foreign",
    "runs_drawn",
]

UNITS: tuple[Kind, ...] = ("wheel_unit", "steering_unit", "heading_unit", "position_unit", "time_unit")


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


class FindingWarning(str):
    """A warning of a data set that holds a finding.

    finding: what ``check`` says of it. unit: a unit cannot be right, by the magnitude of what was recorded.
    """

    finding: Finding
    unit: bool

    @classmethod
    def of(cls, finding: Finding, text: str = "", *, unit: bool = False) -> FindingWarning:
        """The warning of a finding, in its words unless a text is given."""
        warning = cls(text or finding.what)
        warning.finding, warning.unit = finding, unit
        return warning

    @classmethod
    def of_restart(cls, note: str) -> FindingWarning:
        """An importer's note on counters that began again, which it has mended."""
        return cls.of(Finding(kind="counter_restart", what=note, where="all wheels", severity="note"))


def findings_of(warnings: Iterable[str]) -> list[Finding]:
    """The findings that warnings hold."""
    return [warning.finding for warning in warnings if isinstance(warning, FindingWarning)]
