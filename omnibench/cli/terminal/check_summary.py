"""A check on the terminal: the verdict, each finding with what to type on a line of its own, and what to do next."""

from __future__ import annotations

from typing import TYPE_CHECKING

from omnibench.cli.terminal.console import print_ending

if TYPE_CHECKING:
    from rich.console import Console

    from omnibench.fit.check.checking import CheckReport

_NEEDED = {True: "a calibration is needed", False: "a calibration is hardly needed", None: ""}


def print_check(console: Console, checked: CheckReport, then: str) -> None:
    """Print the report; what can be typed is not wrapped, so that it can be copied.

    then: the command line for a recording that is ready.
    """
    console.print(f"{checked.verdict.upper()}: {checked.sentence}.", soft_wrap=True)
    for finding in checked.findings:
        console.print()
        console.print(f"{finding.severity}: {finding.what} [{finding.where}]", soft_wrap=True)
        if finding.fix.startswith("omnibench "):
            console.out(f"  {finding.fix}", highlight=False)
        elif finding.fix:
            console.print(f"  {finding.fix}", soft_wrap=True)
    if checked.gain:
        needed = _NEEDED[checked.needed]
        console.print()
        console.print(f"{needed}: {checked.gain}" if needed else checked.gain, soft_wrap=True)
    console.print()
    if checked.command:
        print_ending("what can be mended is mended by one import", "type", *_words(checked.command))
    elif checked.verdict == "record more":
        print_ending("nothing of this can be typed", "record what is missing, and check again")
    else:
        words = _words(then)
        print_ending("nothing stands in the way", f"{words[1]} it", *words)


def _words(command: str) -> list[str]:
    import shlex

    return shlex.split(command)
