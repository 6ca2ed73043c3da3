"""What a check says."""

from __future__ import annotations

from textwrap import wrap
from typing import Literal

from pydantic import Field

from omnibench.config import Model
from omnibench.data.checks.finding import Finding
from omnibench.data.clock_matching import ClockMatch
from omnibench.views import screenful

_WIDTH = 110  # characters of a line of a report at a Python prompt
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

    def __repr__(self) -> str:
        found = [f"{each.severity}: {each.what} [{each.where}]" for each in self.findings]
        typed = ["its .command mends what can be mended"] if self.command else []
        said = [f"{self.verdict}: {self.sentence}", *found, *filter(None, [self.gain]), *typed]
        return "\n".join(screenful([line for text in said for line in wrap(text, _WIDTH, subsequent_indent="    ")]))
