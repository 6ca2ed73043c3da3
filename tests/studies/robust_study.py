"""Reference poses that jump: what a robust loss loses where five in a hundred are off by a metre.

    python tests/studies/robust_study.py                       # every recording, trajectory cost
    python tests/studies/robust_study.py --cost final_pose --only sim

Runs are the real recordings in ../shared/data, of at most 80 reference poses each, and simulated ones. Of half of them,
drawn at random, the poses are contaminated by this script: each pose, starts among them, is moved with a probability of
5 % by 1 m in a random direction. A calibration is fitted to these runs, and judged on the others, which stay as
recorded: by the mean error of the final pose, m and rad alike (Eq. 6 of Palacin et al. 2023). Each figure is divided by
that of the fit of the same calibrator to the same runs as recorded, without a robust loss.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from commands import RECORDINGS, ROOT
from contamination import with_jumps
from sample_robots import fixed, make_robot, steered
from wheeled_recordings import recorded

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.errors import OmnibenchError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.evaluate import final_errors
from omnibench.fit.loss import LossName
from omnibench.fit.problem import Budget
from omnibench.fit.trajectory_fit import usable_runs
from omnibench.registry import load_plugin_file
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.slam.import_dataset import import_dataset

CALIBRATORS = ("least_squares", "closed_form", "map", "crs")
LOSSES: tuple[LossName, ...] = ("squares", "huber", "student_t")
DIFF = make_robot("diff", *(fixed(name, 0, y, radius=0.042) for name, y in (("right", -0.1), ("left", 0.1))))
TRICYCLE = make_robot(
    "tricycle",
    steered("front", 0.15, 0, radius=0.0325),
    *(fixed(name, 0, y, radius=0.0325, measured=False) for name, y in (("left", 0.08), ("right", -0.08))),
)
SWERVE = make_robot("swerve", steered("fl", 0.2, 0.2), steered("fr", 0.2, -0.2), steered("rear", -0.2, 0.0))
SHARE, OFF = 0.05, 1.0  # of the poses, and by how much they are moved, m


def data_sets() -> Iterator[tuple[str, Dataset]]:
    """Name and recordings: simulated ones, then the real ones that are at hand."""
    for robot in (DIFF, TRICYCLE, SWERVE):
        rng = np.random.default_rng(1)
        design = robot.inverse_kinematic_matrix
        truth = design * (1 + 0.02 * rng.standard_normal(design.shape))
        yield f"simulated {robot.name}", make_dataset(robot.name, robot, 0.1, recorded(robot, truth, rng, samples=120))
    if not RECORDINGS.exists():
        return
    for name in ("diff", "omni4", "tricyc"):
        whole = import_dataset("optiodom", RECORDINGS / "optiodom" / name)
        yield name, replace(whole, trajectories=tuple(r for r in whole.trajectories if r.id.startswith("circular")))
    assert load_plugin_file(ROOT / "plugins" / "robotino.py") is None
    yield "robotino", import_dataset("robotino", RECORDINGS / "robotino")


def errors(
    dataset: Dataset, train: Sequence[Trajectory], judged: Sequence[Trajectory], **choice: Any
) -> tuple[Array, str]:
    """Errors (Z, 3) of the final poses of the judged runs, m, m, rad, and the reason of the fit's end."""
    run = calibrate(
        replace(dataset, trajectories=tuple(train)), integration="arc", budget=Budget(evaluations=20_000), **choice
    )
    return final_errors(OdometryModel(dataset.robot, run.calibration.matrix_array, "arc"), judged), run.result.reason


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cost", default="trajectory")
    parser.add_argument("--only", default="", help="beginning of the name of a data set")
    parser.add_argument("--calibrators", nargs="*", default=CALIBRATORS)
    parser.add_argument("--seeds", type=int, default=3, help="contaminations, of which the mean ratio is shown")
    parser.add_argument("--unidentified", default=None)
    arguments = parser.parse_args()
    for name, dataset in data_sets():
        if not name.startswith(arguments.only):
            continue
        order = np.random.default_rng(0).permutation(len(dataset.trajectories))
        half = len(order) // 2
        train = usable_runs([replace(dataset.trajectories[index], split="train") for index in sorted(order[:half])])
        judged = [replace(dataset.trajectories[index], split="validation") for index in sorted(order[half:])]
        poses = sum(len(run.poses) for run in train)
        print(f"\n{name}, cost {arguments.cost}: {len(train)} runs, {poses} poses -> {len(judged)} runs", flush=True)
        for calibrator in arguments.calibrators:
            choice = {"calibrator": calibrator, "cost": arguments.cost, "unidentified": arguments.unidentified}
            base: float | None = None
            for loss in LOSSES:
                line, began = f"  {calibrator:14s} {loss:10s}", time.perf_counter()
                try:
                    clean, _ = errors(dataset, train, judged, loss=loss, **choice)
                    usual = float(np.linalg.norm(clean, axis=1).mean())
                    base = usual if base is None else base
                    ratios = []
                    for seed in range(arguments.seeds):
                        moved = with_jumps(train, SHARE, OFF, np.random.default_rng(seed))
                        found, _ = errors(dataset, moved, judged, loss=loss, **choice)
                        ratios.append(float(np.linalg.norm(found, axis=1).mean()) / base)
                except OmnibenchError as error:
                    print(f"{line} {error}", flush=True)
                    continue
                worst = f"contaminated {np.mean(ratios):5.2f} x (worst {max(ratios):5.2f})"
                print(f"{line} clean {usual:.4f} = {usual / base:4.2f} x   {worst}   "
                      f"{time.perf_counter() - began:5.1f} s", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
