"""A comparison proves what no optimiser can beat, and says of every run how much it could gain at most."""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import compared_here, search, small
from report_page import on_terminal
from report_samples import page, run, usual

from omnibench.cli.terminal.comparison_tables import print_result
from omnibench.compare.config import CertificateChoice, CompareConfig
from omnibench.compare.result import ComparisonResult

PROVEN = {"gap": 0.05, "seconds": 1e9, "parts": 2000}
ENTRIES = ["theoretical", "closed_form", {"name": "closed_form", "box": "paper"}, search(), "parametric"]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> ComparisonResult:
    return compared_here(tmp_path_factory.mktemp("proven") / "out", calibrators=ENTRIES, certificate=PROVEN)


def test_every_box_of_matrices_has_its_bound_and_no_run_is_below_it(result: ComparisonResult) -> None:
    assert [certificate.box for certificate in result.certificates] == ["row", "paper"]
    for certificate in result.certificates:
        assert certificate.finished
        assert 0 <= certificate.gap <= 0.05
        assert certificate.lower_bound <= certificate.best_cost
    bounds = {certificate.box: certificate.lower_bound for certificate in result.certificates}
    for record in (done.record for done in result.runs):
        assert record.train_cost is not None
        assert record.proven_gap is not None  # of a geometry in a box that contains its matrix
        if record.box in bounds:
            assert record.train_cost >= bounds[record.box]
            assert record.proven_gap == pytest.approx(1 - bounds[record.box] / record.train_cost)


def test_the_exact_optimum_has_little_to_gain_and_a_poor_search_much(result: ComparisonResult) -> None:
    gaps = {done.record.label: done.record.proven_gap or 0.0 for done in result.runs}
    assert gaps["closed_form"] <= 0.05
    assert gaps["theoretical"] > 0.5
    assert gaps["search"] > gaps["closed_form"]


def test_terminal_and_report_say_what_is_proven(result: ComparisonResult, tmp_path: Path) -> None:
    assert "Proven: what share of the cost" in on_terminal(print_result, result, width=200)
    text = page(result, tmp_path).text
    assert "What no optimiser can beat" in text
    assert "proven: ≤" in text


def test_a_number_of_parts_ends_a_proof_whatever_the_machine(result: ComparisonResult) -> None:
    config = result.config.model_copy(update={"certificate": CertificateChoice(gap=1e-9, seconds=1e9, parts=5)})
    (found,) = run(config.model_copy(update={"calibrators": config.calibrators[1:2]})).certificates
    assert (found.parts, found.finished) == (5, False)


def test_nothing_is_proven_where_nobody_asks_but_by_default() -> None:
    assert usual().certificates == ()
    assert all(done.record.proven_gap is None for done in usual().runs)
    content = {name: value for name, value in small().items() if name != "certificate"}
    assert CompareConfig.model_validate(content).certificate is not None
