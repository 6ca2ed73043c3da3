"""The figures of a report as SVG and PNG files, drawn by an installed Chromium as the report's page draws them."""

from __future__ import annotations

import base64
import re
import shutil
import subprocess
import tempfile
import unicodedata
from pathlib import Path

from omnibench.errors import DataError
from omnibench.files import write_files
from omnibench.report.blocks import Document, FigureGrid
from omnibench.report.render import figures_page, grids_of

_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
_ELSEWHERE = (
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
    "C:/Program Files/Google/Chrome/Application/chrome.exe",
    "C:/Program Files (x86)/Microsoft/Edge/Application/msedge.exe",
)
_FLAGS = (  # the page is our own and loads nothing, so that it needs no sandbox, which containers often refuse
    *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync", "--disable-extensions"),
    *("--disable-background-networking", "--disable-component-update", "--virtual-time-budget=600000", "--dump-dom"),
)
_PATIENCE = 600  # s: a report of fifty figures takes 20 s (chosen)
_LONGEST = 60  # characters of a file's name (chosen)


def write_figures(document: Document, folder: Path) -> list[str]:
    """Write each figure of a report, with titles and legend, as ``NAME.svg`` and ``NAME.png``; their names.

    DataError in one line: no browser, or one that fails; the folder cannot be written.
    """
    program = browser()
    grids = named_grids(document)
    if not grids:
        return []
    with tempfile.TemporaryDirectory() as scratch:
        page = Path(scratch, "figures.html")
        page.write_text(figures_page(grids), encoding="utf-8")
        command = [program, *_FLAGS, f"--user-data-dir={scratch}/profile", page.as_uri()]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise DataError(f"--figures: {program} did not draw the figures: {error}") from None
    drawn = re.findall(r'<pre data-name="([^"]+)">([^<]*)</pre>', done.stdout)
    if len(drawn) != 2 * len(grids):
        raise DataError(f"--figures: {program} drew {len(drawn)} of {2 * len(grids)} figures; try it again")
    write_files({folder / name: base64.b64decode(content) for name, content in drawn})
    return list(grids)


def browser() -> str:
    """The program of a browser that can draw. DataError: there is none."""
    known = [*map(shutil.which, _BROWSERS), *(place for place in _ELSEWHERE if Path(place).exists())]
    program = next(filter(None, known), None)
    if program is None:
        raise DataError("--figures: no Chromium or Chrome on this machine to draw with; install one, or leave it out")
    return program


def named_grids(document: Document) -> dict[str, FigureGrid]:
    """Every grid of figures by a name of its own: its given one, or made of the titles above it."""
    named: dict[str, FigureGrid] = {}
    for titles, grid in grids_of(document):
        title = grid.figures[0].title if len(grid.figures) == 1 else ""
        name = grid.name or _slug(" ".join([*titles[-2:], title]))
        chosen = name if grid.name == "" or len(titles) < 2 else _slug(f"{' '.join(titles[1:])} {name}")
        number = 1
        while (unique := chosen if number == 1 else f"{chosen}-{number}") in named:
            number += 1
        named[unique] = grid
    return named


def _slug(words: str) -> str:
    plain = unicodedata.normalize("NFKD", words.replace("ω", "w").replace("−", "-")).encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z0-9.]+", "-", plain.lower())[:_LONGEST].strip("-.") or "figure"
