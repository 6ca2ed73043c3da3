"""Figures as files: their names, their number, and one clear line where nothing can draw them."""

from __future__ import annotations

import shutil
from pathlib import Path

import plotly.graph_objects as go
import pytest
from browser import chromium

from omnibench.errors import DataError
from omnibench.report.blocks import Choice, Details, Document, Figure, FigureGrid, LegendItem, Section
from omnibench.report.figure_files import browser, named_grids, write_figures
from omnibench.report.style import plot


def grid(*titles: str, name: str = "") -> FigureGrid:
    curve = go.Scatter(x=[0, 1], y=[1, 2], legendgroup="one")
    figures = tuple(Figure(title, plot(curve, x_title="x (m)"), title, 200) for title in titles)
    return FigureGrid(figures, (LegendItem("one", "a < b & c", "#0072b2", "dash"),), 2, "", name)


def document() -> Document:
    runs = Choice("Run", {"(0.2 m/s, −0.35 rad/s), run-1": (grid("Wheel rates"),)})
    folded = Details("More", (grid("a", "b"),))
    answer = Section("answer", "Answer", (grid("x", name="paths-before-after"),))
    return Document("A report", "", (answer, Section("w", "Wheels", (runs, folded))))


def test_figures_are_named_after_what_stands_above_them() -> None:
    names = list(named_grids(document()))
    assert names == ["paths-before-after", "wheels-0.2-m-s-0.35-rad-s-run-1-wheel-rates", "wheels-more"]


def test_figures_of_one_name_are_numbered() -> None:
    twice = Document("A report", "", (Section("a", "Answer", (grid("x", name="paths"), grid("x", name="paths"))),))
    assert list(named_grids(twice)) == ["paths", "paths-2"]


def test_every_figure_is_written_as_svg_and_png_with_titles_and_legend(tmp_path: Path) -> None:
    chromium()
    names = write_figures(document(), tmp_path / "figures")
    assert len(names) == 3
    assert sorted(file.name for file in (tmp_path / "figures").iterdir()) == sorted(
        f"{name}.{ending}" for name in names for ending in ("svg", "png")
    )
    picture = (tmp_path / "figures" / "wheels-more.svg").read_text(encoding="utf-8")
    assert picture.startswith("<svg")
    assert picture.count('class="main-svg"') >= 2
    assert "a &lt; b &amp; c" in picture
    assert (tmp_path / "figures" / "wheels-more.png").read_bytes()[1:4] == b"PNG"


@pytest.mark.slow
def test_a_figure_of_a_megabyte_is_written(tmp_path: Path) -> None:
    chromium()
    dots = go.Scatter(x=list(range(6000)), y=[1] * 6000, mode="markers")
    grids = (FigureGrid((Figure("many dots", plot(dots), "many dots", 200),), (), 1, "", "dots"),)
    assert write_figures(Document("A report", "", (Section("a", "Answer", grids),)), tmp_path / "figures") == ["dots"]
    assert (tmp_path / "figures" / "dots.svg").stat().st_size > 1e6


def test_without_a_browser_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    monkeypatch.setattr(Path, "exists", lambda _: False)
    with pytest.raises(DataError, match="--figures: no Chromium or Chrome on this machine"):
        browser()
