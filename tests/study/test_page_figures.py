"""Figures of the page on the paper that take minutes: the simulated robots from command to SLAM."""

from __future__ import annotations

from pathlib import Path

import pytest
from page_figures import assert_printed, chain_figures, chain_results


@pytest.mark.slow
def test_the_page_on_the_paper_prints_the_costs_of_the_simulated_robots(tmp_path: Path) -> None:
    assert_printed("chain", chain_figures(chain_results(tmp_path)))
