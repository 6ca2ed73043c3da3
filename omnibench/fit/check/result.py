"""What a check says."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from omnibench.config import Model
from omnibench.data.checks.finding import Finding
from omnibench.data.clock_matching import ClockMatch

Verdict = Literal["ready", "fix", "record more"]


class CheckReport(Model):
    """The check of one recording.

    needed: True if a calibration gains more than chance on runs that it was not fitted to, False if it does not; None
    if that cannot be told. sentence: the verdict in words. gain: what cross-validation says. command: the import with
    all fixes that can be typed; empty if there is none. clocks: of the runs that have poses, in their order; None where
    one does not show.
    """

    verdict: Verdict
    needed: bool | None
    findings: tuple[Finding, ...]
    sentence: str
    gain: str
    command: str = ""
    clocks: tuple[ClockMatch | None, ...] = Field((), exclude=True, repr=False)
