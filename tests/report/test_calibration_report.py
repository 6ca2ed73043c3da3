"""The page of ``calibrate --report`` and ``evaluate --report``."""

import re
from pathlib import Path

from commands import assert_refused, run_here, succeeded

import omnibench
from omnibench.data.storage import save_dataset
from omnibench.report import blocks as page
from omnibench.report.calibration_report import calibration_document
from omnibench.report.render import render
from omnibench.testing.synthetic import synthetic_dataset


def test_the_report_answers_first_and_shows_paths_parameters_and_errors_by_motion() -> None:
    dataset = synthetic_dataset()
    run = omnibench.calibrate(dataset)
    assert run.calibration.provenance is not None
    assert run.calibration.provenance.held_out is not None
    document = calibration_document(run.calibration, dataset, run.calibration.provenance.held_out, run.warnings)
    assert [section.key for section in document.sections] == [
        "answer",
        "parameters",
        "motions",
        "paths",
        "matrix",
        "origin",
    ]
    answer = document.sections[0]
    assert [type(block) for block in answer.blocks[:3]] == [page.Paragraph, page.Facts, page.FigureGrid]
    table = next(block for block in document.sections[1].blocks if isinstance(block, page.Table))
    assert {row.cells[0].text for row in table.rows} == set(run.calibration.physical_parameters)
    text = render(document)
    assert document.badges[0].text in text  # simulated data are called so


def test_calibrate_and_evaluate_write_a_page_that_says_what_to_do_and_do_not_overwrite_one(tmp_path: Path) -> None:
    save_dataset(synthetic_dataset(), tmp_path / "data")
    succeeded(run_here("calibrate", "data", "-o", "c.yaml", "--report", "first.html", cwd=tmp_path))
    ending = succeeded(run_here("evaluate", "c.yaml", "data", "--report", "second.html", cwd=tmp_path)).stderr
    what_to_do, _, command = ending.partition("; next, ")[2].partition(":\n  ")
    for page_file in ("first.html", "second.html"):
        written = re.sub("<[^>]+>", "", (tmp_path / page_file).read_text())
        assert "Radii, lengths and angles" in written
        assert f"Next, {what_to_do}:" in written
        assert command.strip() in written
    assert_refused(run_here("evaluate", "c.yaml", "data", "--report", "second.html", cwd=tmp_path), "second.html")
