"""A comparison proves what no optimiser can beat, and says of every run how much it could gain at most."""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import compared_here, search, small
from report_samples import config, page, run

from omnibench.cli.terminal.comparison_tables import print_result
from omnibench.cli.terminal.console import make_console
from omnibench.compare.config import CompareConfig
from omnibench.compare.result import ComparisonResult

PROVEN = {"gap": 0.05, "seconds": 1e9, "parts": 2000}
ENTRIES = ["theoretical", "closed_form", {"name": "closed_form", "box": "paper"}, search(), "parametric"]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> ComparisonResult:
    return compared_here(tmp_path_factory.mktemp("proven") / "out", calibrators=ENTRIES, certificate=PROVEN)


def test_every_box_of_matrices_has_its_bound(result: ComparisonResult) -> None:
    assert [certificate.box for certificate in result.certificates] == ["row", "paper"]
    for certificate in result.certificates:
        assert certificate.finished
        assert 0 <= certificate.gap <= 0.05
        assert certificate.lower_bound <= certificate.best_cost


def test_no_run_is_below_the_bound_of_its_box(result: ComparisonResult) -> None:
    bounds = {certificate.box: certificate.lower_bound for certificate in result.certificates}
    for done in result.runs:
        assert done.record.train_cost is not None
        if done.record.box in bounds:
            assert done.record.train_cost >= bounds[done.record.box]
            assert done.record.proven_gap == pytest.approx(1 - bounds[done.record.box] / done.record.train_cost)


def test_the_exact_optimum_has_little_to_gain_and_a_poor_search_much(result: ComparisonResult) -> None:
    gaps = {done.record.label: done.record.proven_gap or 0.0 for done in result.runs}
    assert gaps["closed_form"] <= 0.05
    assert gaps["theoretical"] > 0.5
    assert gaps["search"] > gaps["closed_form"]


def test_a_geometry_is_held_against_a_box_that_contains_its_matrix(result: ComparisonResult) -> None:
    (geometry,) = (done.record for done in result.runs if done.record.parameterisation == "geometry")
    assert geometry.proven_gap is not None


def test_the_terminal_tells_what_is_proven(result: ComparisonResult, capsys: pytest.CaptureFixture[str]) -> None:
    print_result(make_console(), result)
    told = " ".join(capsys.readouterr().out.split())
    assert "Proven: what share of the cost any optimiser could still save in that box, at most" in told


def test_the_report_tells_what_is_proven(tmp_path: Path) -> None:
    found = run(config(certificate=PROVEN))
    text = page(found, tmp_path).text
    assert "What no optimiser can beat" in text
    assert "proven: ≤" in text


def test_a_number_of_parts_ends_a_proof_whatever_the_machine(tmp_path: Path) -> None:
    limited = {"gap": 1e-9, "seconds": 1e9, "parts": 5}
    found = compared_here(tmp_path / "out", calibrators=["closed_form"], certificate=limited)
    assert [(certificate.parts, certificate.finished) for certificate in found.certificates] == [(5, False)]


def test_nothing_is_proven_where_nobody_asks(tmp_path: Path) -> None:
    found = compared_here(tmp_path / "out", certificate=None)
    assert found.certificates == ()
    assert all(done.record.proven_gap is None for done in found.runs)


def test_a_comparison_proves_by_itself() -> None:
    content = {name: value for name, value in small().items() if name != "certificate"}
    assert CompareConfig.model_validate(content).certificate is not None
