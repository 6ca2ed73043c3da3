"""Methods of the literature on OptiOdom's recordings, beside the figures that were measured for them elsewhere.

    python tests/studies/published_methods.py [--methods umbmark ivanjko]      # from the project's folder

A row is a method, the kind of path that it was calibrated on, the kind that it is judged on, and the mean error of the
final pose, m and degrees: as known, here, and the ratio of the two. The recipe by which the known figures come out:

- the robot's design is L 0.2 m and D 0.084 m (diff), whatever a session's metadata say;
- a method of one session is calibrated on each session of its kind, all others on all runs of the kind together;
- every answer is judged by one odometry, arcs from the ground truth's pose at t = 0, on all runs of a kind, those of
  its own session among them; the figure is the mean over these runs, and then over the sessions;
- the error is the distance of the last reference pose, and the difference of the headings, without turns taken off.

The known figures of omni4 are over 68 runs, of which 24 are here; the design's tell how much milder these are. Those of
OptiOdom on omni3 are of a step that turns an exact arc by another half of its angle: with it the plug-in has
.0624 / 4.55 and .1496 / 7.47. On tricyc its search rests before the minimum, so that details count: with the steering
angle at the end of a sample, and not in its middle, the plug-in has .0396 / 4.73 and .0823 / 3.41.

The known figures of Jung and Chung are those of OptiOdom's program, which divides the mean heading errors by the number
of runs once more. The row "jung_chung, divided twice" does so, too; the plug-in does not.

A method is a row of METHODS, with the plug-in file that has its name, if there is one.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.errors import OmnibenchError
from omnibench.fit.calibrator import Calibrator, model_of_answer, run_calibrator
from omnibench.fit.cost import FinalPose
from omnibench.fit.problem import Budget, CalibrationProblem, make_parameterisation
from omnibench.registry import Options, calibrators, load_plugin_file
from omnibench.robot.model import OdometryModel
from omnibench.slam.import_dataset import import_dataset

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data" / "optiodom"
Figure = tuple[float, float]  # mean error of the final pose, m and degrees


@dataclass(frozen=True)
class Method:
    """A method on a robot. calibrator: its registered name. trained_on: the kind of path. known: figures by kind."""

    robot: str
    label: str
    calibrator: str
    trained_on: str
    known: dict[str, Figure]
    options: dict[str, Any] = field(default_factory=dict)


METHODS = (
    Method(
        "diff",
        "design",
        "theoretical",
        "circular",
        {"circular": (0.0657, 9.24), "square": (0.0385, 3.19), "ivanjko": (0.0052, 1.19)},
    ),
    Method(
        "diff",
        "umbmark",
        "umbmark",
        "square",
        {"circular": (0.0297, 4.06), "square": (0.0108, 1.05), "ivanjko": (0.0050, 0.46)},
    ),
    Method(
        "diff",
        "jung_chung",
        "jung_chung",
        "square",
        {"circular": (0.0429, 5.93), "square": (0.0235, 1.98), "ivanjko": (0.0051, 0.79)},
    ),
    Method(
        "diff",
        "jung_chung, divided twice",
        "jung_chung_divided_twice",
        "square",
        {"circular": (0.0429, 5.93), "square": (0.0235, 1.98), "ivanjko": (0.0051, 0.79)},
    ),
    Method(
        "diff",
        "ivanjko",
        "ivanjko",
        "ivanjko",
        {"circular": (0.0296, 3.79), "square": (0.0285, 1.90), "ivanjko": (0.0057, 0.60)},
    ),
    # Known are those of the same three parameters fitted to whole trajectories with heading.
    Method(
        "diff",
        "censi",
        "censi",
        "circular",
        {"circular": (0.0083, 1.00), "square": (0.0253, 1.73), "ivanjko": (0.0048, 0.86)},
    ),
    Method(
        "diff",
        "optiodom",
        "optiodom",
        "circular",
        {"circular": (0.0130, 1.77), "square": (0.0346, 2.36), "ivanjko": (0.0073, 1.11)},
    ),
    Method("tricyc", "design", "theoretical", "circular", {"circular": (0.664, 64.9), "square": (0.771, 39.8)}),
    Method("tricyc", "optiodom", "optiodom", "circular", {"circular": (0.0398, 4.80), "square": (0.0821, 3.39)}),
    Method("tricyc", "kallasi", "kallasi", "circular", {"circular": (0.0481, 3.33), "square": (0.0880, 2.93)}),
    Method("omni3", "design", "theoretical", "circular", {"circular": (0.170, 14.8), "square": (0.1415, 7.12)}),
    Method("omni3", "optiodom", "optiodom", "circular", {"circular": (0.0621, 4.50), "square": (0.1487, 7.43)}),
    Method("omni3", "lin", "lin", "circular", {"circular": (0.0515, 3.67), "square": (0.1070, 5.31)}),
    Method("omni4", "design", "theoretical", "circular", {"circular": (0.185, 20.2)}),
    Method("omni4", "optiodom", "optiodom", "circular", {"circular": (0.0528, 5.07)}),
    Method("omni4", "lin", "lin", "circular", {"circular": (0.0507, 4.97)}),
)


def load_methods() -> None:
    """Register the plug-ins of the methods."""
    for name in {method.calibrator for method in METHODS}:
        file = ROOT / "plugins" / f"{name}.py"
        if file.exists() and name not in {entry.name for entry in calibrators.entries()}:
            failure = load_plugin_file(file)
            assert failure is None, failure
    register_divided_twice()


def register_divided_twice() -> None:
    """Register the variant of Jung and Chung's method that OptiOdom's program computes."""
    plain: Any = type(calibrators.create("jung_chung"))

    @calibrators.register("jung_chung_divided_twice")
    class _DividedTwice(plain):
        """Jung and Chung with the mean heading errors divided by the number of runs once more."""

        def mean_error(self, squares: Sequence[Any]) -> float:
            return float(super().mean_error(squares)) / len(squares)


def method_called(label: str) -> Method:
    """The row of METHODS with a label."""
    return next(method for method in METHODS if method.label == label)


@cache
def recordings(robot: str) -> Dataset:
    """OptiOdom's recordings of a robot."""
    return import_dataset("optiodom", DATA / robot)


def of_kind(dataset: Dataset, kind: str) -> list[Trajectory]:
    """The runs of a kind of path, with which their ids begin."""
    return [run for run in dataset.trajectories if run.id.startswith(f"{kind}_")]


def answers(method: Method) -> list[OdometryModel]:
    """The method's models: of each session of its kind, or of all of them together."""
    dataset = recordings(method.robot)
    runs = of_kind(dataset, method.trained_on)
    calibrator: Calibrator = calibrators.create(method.calibrator, method.options)
    if not calibrator.per_session:
        return [answer(calibrator, dataset, runs)]
    sessions = sorted({run.session for run in runs if run.session is not None})
    return [answer(calibrator, dataset, [run for run in runs if run.session == session]) for session in sessions]


def answer(calibrator: Calibrator, dataset: Dataset, runs: Sequence[Trajectory]) -> OdometryModel:
    """The model that a calibrator makes of runs."""
    searched = make_parameterisation(calibrator.parameterisation, dataset.robot, runs)
    problem = CalibrationProblem(
        dataset.robot, runs, FinalPose(Options()), searched, integration="arc", budget=Budget(), seed=0
    )
    result = run_calibrator(calibrator, problem)
    if result.matrix is None:
        raise OmnibenchError(f"{type(calibrator).__name__} on {dataset.robot.name}: {result.reason}")
    return model_of_answer(problem, result.matrix, result.extension)


def figure(models: Sequence[OdometryModel], runs: Sequence[Trajectory]) -> Figure:
    """Mean error of the final pose over runs and models."""
    truth = np.array([run.final_pose for run in runs])
    ends = np.array([np.concatenate(model.poses([run.final_log for run in runs])) for model in models])
    errors = np.abs(ends - truth)
    return float(np.hypot(errors[..., 0], errors[..., 1]).mean()), float(np.degrees(errors[..., 2].mean()))


def figures(method: Method) -> dict[str, Figure]:
    """The method's figure on every kind of path that one is known on."""
    models = answers(method)
    return {kind: figure(models, of_kind(recordings(method.robot), kind)) for kind in method.known}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="*", help="calibrators; default: all")
    chosen = parser.parse_args().methods
    load_methods()
    print(f"{'robot':7} {'method':27} {'judged on':10} {'known m / deg':>15} {'here m / deg':>15} {'ratio':>13}")
    for method in METHODS:
        if chosen and method.calibrator not in chosen:
            continue
        for kind, (metres, degrees) in figures(method).items():
            known = method.known[kind]
            print(
                f"{method.robot:7} {method.label:27} {kind:10} {known[0]:8.4f} /{known[1]:5.2f} "
                f"{metres:8.4f} /{degrees:5.2f} {metres / known[0]:6.3f} /{degrees / known[1]:5.3f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
