"""Calibrate the odometry of wheeled robots, compare calibrators, find missing physics, run the result live."""

from __future__ import annotations

TYPE_CHECKING = False  # that of ``typing`` would take its import, during which Ctrl-C prints a traceback

# Modules with the public names in them. A name is imported when it is first asked for, so that the command line starts
# at once.
_MODULES = {
    "check.check": "check",
    "compare.config": "read_compare_config",
    "compare.run": "run_comparison",
    "data.dataset": "Dataset Trajectory make_dataset",
    "data.importers.tum": "read_tum write_tum",
    "data.references": "Reference References",
    "data.storage": "load_dataset save_dataset",
    "design.design": "design_experiment",
    "discover.discover": "discover_effects",
    "errors": "OmnibenchError",
    "fit.calibrate": "calibrate",
    "fit.certify": "certify_optimum",
    "fit.evaluate": "evaluate",
    "fit.inspect": "inspect_dataset",
    "fit.settings": "Budget FitSettings",
    "live.config": "read_live_config",
    "live.node": "LiveNode",
    "live.subscriber": "subscribe",
    "registry": "load_plugins",
    "robot.calibration": "Calibration odometry read_calibration write_calibration",
    "robot.export.formats": "export_calibration",
    "robot.kinematics": "Robot Wheel",
    "simulate.source": "read_simulation simulate_dataset",
    "slam.import_dataset": "import_dataset",
}
_PUBLIC = {name: module for module, names in _MODULES.items() for name in names.split()}
__all__ = sorted(_PUBLIC)

__version__: str  # of the installed package, "unknown" in a folder of source files that is not installed

if TYPE_CHECKING:  # imports for type checkers; tests/ground/test_package.py holds them equal to the list
    from typing import Any

    from omnibench.check.check import check as check
    from omnibench.compare.config import read_compare_config as read_compare_config
    from omnibench.compare.run import run_comparison as run_comparison
    from omnibench.data.dataset import Dataset as Dataset
    from omnibench.data.dataset import Trajectory as Trajectory
    from omnibench.data.dataset import make_dataset as make_dataset
    from omnibench.data.importers.tum import read_tum as read_tum
    from omnibench.data.importers.tum import write_tum as write_tum
    from omnibench.data.references import Reference as Reference
    from omnibench.data.references import References as References
    from omnibench.data.storage import load_dataset as load_dataset
    from omnibench.data.storage import save_dataset as save_dataset
    from omnibench.design.design import design_experiment as design_experiment
    from omnibench.discover.discover import discover_effects as discover_effects
    from omnibench.errors import OmnibenchError as OmnibenchError
    from omnibench.fit.calibrate import calibrate as calibrate
    from omnibench.fit.certify import certify_optimum as certify_optimum
    from omnibench.fit.evaluate import evaluate as evaluate
    from omnibench.fit.inspect import inspect_dataset as inspect_dataset
    from omnibench.fit.settings import Budget as Budget
    from omnibench.fit.settings import FitSettings as FitSettings
    from omnibench.live.config import read_live_config as read_live_config
    from omnibench.live.node import LiveNode as LiveNode
    from omnibench.live.subscriber import subscribe as subscribe
    from omnibench.registry import load_plugins as load_plugins
    from omnibench.robot.calibration import Calibration as Calibration
    from omnibench.robot.calibration import odometry as odometry
    from omnibench.robot.calibration import read_calibration as read_calibration
    from omnibench.robot.calibration import write_calibration as write_calibration
    from omnibench.robot.export.formats import export_calibration as export_calibration
    from omnibench.robot.kinematics import Robot as Robot
    from omnibench.robot.kinematics import Wheel as Wheel
    from omnibench.simulate.source import read_simulation as read_simulation
    from omnibench.simulate.source import simulate_dataset as simulate_dataset
    from omnibench.slam.import_dataset import import_dataset as import_dataset


def __getattr__(name: str) -> Any:
    if name == "__version__":  # looked up when it is asked for, since that takes as long as all else here
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("omnibench")
        except PackageNotFoundError:
            return "unknown"
    if name not in _PUBLIC:
        raise AttributeError(f"module 'omnibench' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"omnibench.{_PUBLIC[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
