"""Commands on a terminal of 80 columns, and of 60: no word is cut, and no line is longer."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from commands import Command, Prepared, omnibench
from shared_results import made_once, shared_folder

from omnibench.cli.examples import bundled_folder

_SHOWN = (
    ("list", "--plugins", "none"),
    ("calibrate", "{data}"),
    ("calibrate", "{swerve}"),
    ("calibrate", "{data}", "--calibrator", "parametric", "--evaluations", "300"),
    ("evaluate", "{calibration}", "{data}"),
    ("certify", "{calibration}", "{data}", "--gap", "0.5"),
    ("inspect", "{data}"),
    ("inspect", "{swerve}"),
    ("design", "{data}"),
    ("compare", "{config}", "-o", "compared"),
    ("discover", "{data}", "-o", "found"),
    ("guide",),
    ("guide", "data"),
    ("example",),
)


@made_once
def swerve() -> Path:
    """Simulated recordings of a robot whose matrix has eight columns."""
    folder = shared_folder() / "swerve"
    run = omnibench("simulate", bundled_folder() / "configs/swerve.yaml", "-o", folder)
    assert run.returncode == 0, run.stderr
    return folder


def words(text: str) -> set[str]:
    return set(re.findall(r"[A-Za-z]+", text))


@pytest.mark.parametrize("width", [80, 60])
@pytest.mark.parametrize("typed", _SHOWN, ids=" ".join)
def test_no_word_is_cut_and_no_line_is_longer_than_the_terminal(
    command: Command, prepared: Prepared, monkeypatch: pytest.MonkeyPatch, typed: tuple[str, ...], width: int
) -> None:
    places = {**prepared._asdict(), "swerve": swerve()} if "{" in " ".join(typed) else {}
    filled = [word.format_map(places) for word in typed]
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    shown = {}
    for columns in (width, 500):
        monkeypatch.setenv("COLUMNS", str(columns))
        printed = command(*filled, *(["--force"] if "-o" in typed else []))
        assert printed.returncode == 0, printed.stderr
        shown[columns] = re.sub(r"\x1b\[[^m]*m", "", printed.stdout)
    paths = ("report: ", "calibration: ", "plain calibration", "extended calibration")
    long = [line for line in shown[width].splitlines() if len(line) > width and not line.startswith(paths)]
    assert not long
    left_out = words(" ".join(re.findall(r"left out for want of room: .*", shown[width]))) | {
        *("left", "out", "for", "want", "of", "room", "columns", "show", "all")
    }
    assert words(shown[width]) - words(shown[500]) - left_out == set()
