"""omnibench: compare, run and extend odometry calibrations of robots on omnidirectional wheels."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from omnibench.compare.read_config import read_compare_config
    from omnibench.compare.run import run_comparison
    from omnibench.data.dataset import Dataset, Trajectory, make_dataset
    from omnibench.data.storage import load_dataset, save_dataset
    from omnibench.design.design import design_experiment
    from omnibench.discover.discover import discover_effects
    from omnibench.errors import OmnibenchError
    from omnibench.fit.calibrate import calibrate
    from omnibench.fit.certify import certify_optimum
    from omnibench.fit.evaluate import evaluate
    from omnibench.fit.inspect import inspect_dataset
    from omnibench.live.wire.subscriber import subscribe
    from omnibench.robot.calibration import Calibration, read_calibration, write_calibration
    from omnibench.robot.export.formats import export_calibration
    from omnibench.simulate.simulate import simulate_dataset
    from omnibench.slam.import_dataset import import_dataset

__all__ = [
    "Calibration",
    "Dataset",
    "OmnibenchError",
    "Trajectory",
    "calibrate",
    "certify_optimum",
    "design_experiment",
    "discover_effects",
    "evaluate",
    "export_calibration",
    "import_dataset",
    "inspect_dataset",
    "load_dataset",
    "make_dataset",
    "read_calibration",
    "read_compare_config",
    "run_comparison",
    "save_dataset",
    "simulate_dataset",
    "subscribe",
    "write_calibration",
]

# Imported when first asked for: the command line starts at once, and Ctrl-C finds it listening.
_HOMES = {
    "design.design": ("design_experiment",),
    "compare.read_config": ("read_compare_config",),
    "compare.run": ("run_comparison",),
    "data.dataset": ("Dataset", "Trajectory", "make_dataset"),
    "simulate.simulate": ("simulate_dataset",),
    "slam.import_dataset": ("import_dataset",),
    "data.storage": ("load_dataset", "save_dataset"),
    "discover.discover": ("discover_effects",),
    "errors": ("OmnibenchError",),
    "fit.calibrate": ("calibrate",),
    "fit.certify": ("certify_optimum",),
    "fit.evaluate": ("evaluate",),
    "fit.inspect": ("inspect_dataset",),
    "live.wire.subscriber": ("subscribe",),
    "robot.calibration": ("Calibration", "read_calibration", "write_calibration"),
    "robot.export.formats": ("export_calibration",),
}


def __getattr__(name: str) -> Any:
    for module, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"omnibench.{module}"), name)
    raise AttributeError(f"module 'omnibench' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
