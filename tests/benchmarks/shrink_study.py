"""Shrink against keep and fit, and costs against each other, on every real recording with kinds of paths left out.

    python tests/benchmarks/shrink_study.py            # the default of a robot against the other choices
    python tests/benchmarks/shrink_study.py --widths   # half of each tolerance, and twice

Of recordings with several kinds of paths every kind is left out once: a calibration is fitted to each other kind by
itself, and to all others together, and judged on the kind left out. Of recordings with one kind the sessions are left
out one by one, and of one long drive the second half. What is compared is the error of the final pose, Eq. (6) of
Palacin et al. 2023, run by run: the mean difference to the default, with an interval from resampled sessions, widened
by Bonferroni over all lines of a robot so that together they hold with 95 %.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from commands import RECORDINGS, ROOT

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.errors import OmnibenchError
from omnibench.fit.calibrate import calibrate
from omnibench.fit.shrinkage.prior import tolerance_of
from omnibench.registry import load_plugin_file
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.slam.import_dataset import import_dataset

DEFAULT = "shrink final_pose"
CHOICES: dict[str, dict[str, Any]] = {
    DEFAULT: {"unidentified": "shrink"},
    "keep final_pose": {"unidentified": "keep"},
    "fit final_pose": {"unidentified": "fit"},
    "shrink trajectory": {"unidentified": "shrink", "cost": "trajectory"},
    "keep trajectory": {"unidentified": "keep", "cost": "trajectory"},
}
RESAMPLES = 10_000


@dataclass(frozen=True)
class Fold:
    """Runs to train, and runs of another kind to judge; words: which."""

    words: str
    train: tuple[Trajectory, ...]
    judge: tuple[Trajectory, ...]


def recordings() -> Iterator[tuple[Dataset, list[Fold]]]:
    """Every recording that is at hand, with what is left out of it."""
    for name in ("diff", "tricyc", "omni3", "omni4"):
        yield folds_by_kind(import_dataset("optiodom", RECORDINGS / "optiodom" / name))
    assert load_plugin_file(ROOT / "plugins" / "robotino.py") is None
    robotino = import_dataset("robotino", RECORDINGS / "robotino")
    yield robotino, list(folds_by_direction(robotino))


def folds_by_kind(dataset: Dataset) -> tuple[Dataset, list[Fold]]:
    runs = dataset.trajectories
    kinds = sorted({run.id.partition("_")[0] for run in runs})
    if len(kinds) == 1:
        sessions = sorted({str(run.session) for run in runs})
        return dataset, [
            Fold(
                f"session {session}",
                tuple(run for run in runs if run.session != session),
                tuple(run for run in runs if run.session == session),
            )
            for session in sessions
        ]
    of = {kind: tuple(run for run in runs if run.id.startswith(f"{kind}_")) for kind in kinds}
    folds = []
    for left_out in kinds:
        others = [kind for kind in kinds if kind != left_out]
        for trained in [*([other] for other in others), *([others] if len(others) > 1 else [])]:
            words = f"{' + '.join(trained)} -> {left_out}"
            folds.append(Fold(words, tuple(run for kind in trained for run in of[kind]), of[left_out]))
    return dataset, folds


def folds_by_direction(dataset: Dataset) -> Iterator[Fold]:
    """Quarters of the directions of driving left out."""
    runs = dataset.trajectories
    quarter = [int((float(run.alpha or 0.0) % (2 * np.pi)) // (np.pi / 2)) for run in runs]
    for number in range(4):
        yield Fold(
            f"directions {90 * number} to {90 * number + 90} deg",
            tuple(run for run, own in zip(runs, quarter, strict=True) if own != number),
            tuple(run for run, own in zip(runs, quarter, strict=True) if own == number),
        )


def errors(dataset: Dataset, fold: Fold, choice: dict[str, Any]) -> Array:
    """Errors (Z, 3) of the final poses of the runs that were left out, m, m, rad."""
    training = tuple(replace(run, split="train") for run in fold.train)
    run = calibrate(replace(dataset, trajectories=training), box="row", **choice)
    model = OdometryModel(dataset.robot, run.calibration.matrix_array, "arc")
    poses = model.poses([judged.final_log for judged in fold.judge])
    return np.array([own[-1] - judged.final_pose for own, judged in zip(poses, fold.judge, strict=True)])


def interval(difference: Array, sessions: Sequence[str], chance: float) -> tuple[float, float]:
    """Interval of the mean of differences (Z,) from resampled sessions."""
    names = sorted(set(sessions))
    sums = np.array([[difference[np.array(sessions) == name].sum(), sessions.count(name)] for name in names])
    drawn = np.random.default_rng(0).integers(0, len(names), (RESAMPLES, len(names)))
    totals = sums[drawn].sum(axis=1)
    low, high = np.quantile(totals[:, 0] / totals[:, 1], [chance / 2, 1 - chance / 2])
    return float(low), float(high)


def study(dataset: Dataset, folds: Sequence[Fold], choices: dict[str, dict[str, Any]]) -> None:
    """Print one line a fold and choice."""
    others = len(folds) * (len(choices) - 1)
    for fold in folds:
        print(f"\n{dataset.robot.name}: {fold.words} ({len(fold.train)} runs -> {len(fold.judge)})")
        sessions = [str(run.session) for run in fold.judge]
        if len(set(sessions)) < 3:
            sessions = [run.id for run in fold.judge]
        base: Array | None = None
        for name, choice in choices.items():
            try:
                found = errors(dataset, fold, choice)
            except OmnibenchError as error:
                print(f"  {name:26s} {error}")
                continue
            norms = np.linalg.norm(found, axis=1)
            position, heading = np.hypot(*found[:, :2].T).mean(), np.degrees(np.abs(found[:, 2]).mean())
            words = f"  {name:26s} {position:.4f} m {heading:6.2f} deg"
            if base is None:
                base = norms
            else:
                low, high = interval(norms - base, sessions, 0.05 / others)
                verdict = "default worse" if high < 0 else "default better" if low > 0 else "no difference"
                mean = (norms - base).mean()
                words += f"   Eq. (6) {1000 * mean:+7.1f} ({1000 * low:+.1f} to {1000 * high:+.1f}) e-3  {verdict}"
            print(words, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--widths", action="store_true")
    arguments = parser.parse_args()
    for dataset, folds in recordings():
        choices = CHOICES
        if arguments.widths:
            width = tolerance_of(dataset.robot).elements
            choices = {DEFAULT: CHOICES[DEFAULT]} | {
                f"tolerance {factor:g} x": CHOICES[DEFAULT] | {"tolerance": factor * width} for factor in (0.5, 1, 2)
            }
        study(dataset, folds, choices)


if __name__ == "__main__":
    main()
