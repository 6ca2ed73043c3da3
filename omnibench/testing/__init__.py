"""Conformance cases for authors of plug-ins: subclass them in pytest, or run ``omnibench plugin check``.

In a test file, with the plug-in beside it::

    load_plugin(Path(__file__).with_name("my_search.py"))

    class TestMySearch(CalibratorConformance):
        name = "my_search"

pytest is not needed to run the cases: see :func:`run_cases`.
"""

from omnibench.testing.cases import (
    Attempt,
    CalibratorConformance,
    CaseOutcome,
    CaseResult,
    Conformance,
    CostConformance,
    ImporterConformance,
    Nonconformance,
    load_plugin,
    run_cases,
)
from omnibench.testing.effect_cases import EffectConformance, driven_signals
from omnibench.testing.synthetic import ObservedProblem, synthetic_problem, synthetic_robot, synthetic_trajectories

__all__ = [
    "Attempt",
    "CalibratorConformance",
    "CaseOutcome",
    "CaseResult",
    "Conformance",
    "CostConformance",
    "EffectConformance",
    "ImporterConformance",
    "Nonconformance",
    "ObservedProblem",
    "driven_signals",
    "load_plugin",
    "run_cases",
    "synthetic_problem",
    "synthetic_robot",
    "synthetic_trajectories",
]
