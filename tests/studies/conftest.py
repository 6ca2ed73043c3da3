"""Prints the figures of a benchmark beside its times: ratios, differences, sizes."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

FIGURES = pytest.StashKey[dict[str, dict[str, float]]]()


@pytest.fixture(autouse=True)
def _keep_figures(benchmark: BenchmarkFixture, request: pytest.FixtureRequest) -> Iterator[None]:
    yield
    request.config.stash.setdefault(FIGURES, {})[request.node.name] = benchmark.extra_info


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    found = config.stash.get(FIGURES, {})
    if found:
        terminalreporter.section("figures of the same run")
    for name, figures in found.items():
        terminalreporter.write_line(name)
        for figure, value in figures.items():
            terminalreporter.write_line(f"    {figure:45} {value:.3g}")
