"""For plug-in authors: conformance cases, to subclass in pytest or to run by ``omnibench plugin check``.

In a test file, with the plug-in beside it::

    load_plugin(Path(__file__).with_name("my_search.py"))

    class TestMySearch(CalibratorConformance):
        name = "my_search"

pytest is not needed to run the cases: see :func:`run_cases`.
"""

from omnibench.testing.calibrators import Attempt, CalibratorConformance
from omnibench.testing.conformance import CaseOutcome, CaseResult, Conformance, Nonconformance, load_plugin, run_cases
from omnibench.testing.costs import CostConformance
from omnibench.testing.effect_inputs import driven_signals
from omnibench.testing.effects import EffectConformance
from omnibench.testing.importers import ImporterConformance
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
