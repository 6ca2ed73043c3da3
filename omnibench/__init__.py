"""omnibench: compare, run and extend odometry calibrations of robots on omnidirectional wheels."""

from omnibench.compare.plan import read_compare_config
from omnibench.compare.run import run_comparison
from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.data.importer import import_dataset
from omnibench.data.simulate.flower import simulate_dataset
from omnibench.data.storage import load_dataset, save_dataset
from omnibench.errors import OmnibenchError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.evaluate import evaluate
from omnibench.fit.inspect import inspect_dataset
from omnibench.robot.calibration import Calibration, read_calibration, write_calibration
from omnibench.robot.export import export_calibration

__all__ = [
    "Calibration",
    "Dataset",
    "OmnibenchError",
    "Trajectory",
    "calibrate",
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
    "write_calibration",
]
