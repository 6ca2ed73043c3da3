"""Small comparisons, really run, for the tests of the report."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from report_page import Page
from sample_robots import APR02
from shared_results import made_once

from omnibench.compare.config import CompareConfig, effective_config
from omnibench.compare.plan import PlannedFit, data_set, load_robots, plan_fits
from omnibench.compare.report.document import comparison_document
from omnibench.compare.result import ComparisonResult, EntryStatistics
from omnibench.compare.run import assess
from omnibench.data.dataset import Dataset
from omnibench.fit.calibrator import RunResult, run_calibrator
from omnibench.registry import calibrators
from omnibench.report.render import write_document


def flower(**changes: Any) -> dict[str, Any]:
    """A small flower experiment: what a config's ``simulate`` says."""
    return {
        "robot": APR02,
        "sample_period": 0.05,
        "commands": {"directions_deg": [30, 120, 210, 300], "turn_rates": [-0.35, 0.35]},
        "repetitions": 2,
        "truth": {"published": "palacin2023_eq8"},
        "noise": {"encoder": 0.02, "pose_position": 0.005, "pose_heading": 0.005, "bias_position": 0.008},
        "train": {"seed": 1, "distance": 1.2},
        "validation": {"seed": 2, "distance": 1.2},
        **changes,
    }


def config(**changes: Any) -> CompareConfig:
    """A small comparison."""
    return CompareConfig.model_validate(
        {
            "name": "small",
            "description": "A small comparison.",
            "datasets": {"flower": {"simulate": flower()}},
            "budget": {"evaluations": 2000},
            "calibrators": ["theoretical", "closed_form", {"name": "random_search", "options": {"candidates": 1000}}],
            "seeds": [1, 2],
            "certificate": None,
            **changes,
        }
    )


def run(chosen: CompareConfig, datasets: Mapping[str, Dataset] | None = None) -> ComparisonResult:
    """The comparison of a config, in this process; ``datasets`` in place of the config's own."""
    effective = effective_config(chosen)
    robots, _ = load_robots(effective)
    robots = tuple(data_set(name, dataset) for name, dataset in (datasets or {}).items()) or robots
    fits = plan_fits(effective, robots)
    return assess(effective, robots, fits, [solve(fit) for fit in fits], Path("results"))


@made_once
def usual() -> ComparisonResult:
    """Two calibrators and the design values, with two seeds, on a simulated flower."""
    return run(config())


def solve(planned: PlannedFit) -> RunResult:
    """One planned run, in this process."""
    return run_calibrator(calibrators.create(planned.settings.calibrator, planned.settings.options), planned.problem())


def page(result: ComparisonResult, folder: Path) -> Page:
    """The comparison's report as its reader sees it."""
    write_document(comparison_document(result), folder / "report.html")
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def statistics(result: ComparisonResult, label: str) -> EntryStatistics:
    """Statistics of an entry."""
    return next(entry for entry in result.statistics if entry.label == label)
