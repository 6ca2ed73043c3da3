"""``--figures DIR`` of every command with a report: each figure of the report as SVG and as PNG."""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import Command, Prepared
from recording_samples import sample

from omnibench.data.storage import save_dataset
from omnibench.errors import DataError
from omnibench.report.figure_files import browser

QUICK = ("inspect", "{data}", "--report", "out/report.html")
LONG = (
    ("check", "{data}", "--report", "out/report.html"),
    ("compare", "{config}", "-o", "out"),
    ("design", "{data}", "-o", "out"),
    ("discover", "{data}", "-o", "out"),
    ("simulate", "{config}", "-o", "out/data", "--report", "out/report.html"),
    ("slam", "scans", "-o", "out/data", "--report", "out/report.html"),
)


@pytest.mark.parametrize(
    "typed", [QUICK, *(pytest.param(typed, marks=pytest.mark.slow) for typed in LONG)], ids=lambda typed: typed[0]
)
def test_every_figure_of_the_report_is_written_as_svg_and_png(
    command: Command, prepared: Prepared, typed: tuple[str, ...]
) -> None:
    try:
        browser()
    except DataError:
        pytest.skip("no Chromium on this machine to draw figures with")
    if "scans" in typed:
        save_dataset(sample(repetitions=1, rays=360).dataset, Path("scans"))
    Path("out").mkdir()
    printed = command(*(word.format_map(prepared._asdict()) for word in typed), "--figures", "pictures")
    assert printed.returncode == 0, printed.stderr
    drawn = Path("out/report.html").read_text(encoding="utf-8").count('<div class="figures">')
    assert f"figures: pictures ({drawn}, each as SVG and PNG" in printed.stderr
    pictures = list(Path("pictures").iterdir())
    for ending, begins in ((".svg", b"<svg"), (".png", b"\x89PNG")):
        written = [file for file in pictures if file.suffix == ending]
        assert len(written) == drawn
        assert all(file.read_bytes().startswith(begins) for file in written)
