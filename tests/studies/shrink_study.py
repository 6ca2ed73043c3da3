"""Shrink against keep and fit, and costs against each other, on every real recording with kinds of paths left out.

    python tests/studies/shrink_study.py                 # the default of a robot against the other choices
    python tests/studies/shrink_study.py --factor 0.5    # half of each tolerance, or twice

Of recordings with several kinds of paths every kind is left out once: a calibration is fitted to each other kind by
itself, and to all others together, and judged on the kind left out. Of recordings with one kind the sessions are left
out one by one (of the Robotino quarters of the directions), and of one long drive the second half. What is compared is
the error of the final pose, Eq. (6) of Palacin et al. 2023, run by run.

A rule is judged, not one fit: other runs to train would have given other calibrations. The variance of a mean
difference to the default is therefore the sum of two, each over sessions left out one by one (jackknife): those
trained on, with a new fit each, and those judged. Intervals are by Student's t with the fewer of the two's degrees of
freedom, widened by Bonferroni over all lines of all recordings so that together they hold with 95 %.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import stdtrit

sys.path.insert(0, str(Path(__file__).parents[1]))
from commands import RECORDINGS, ROOT
from corelli import corelli_dataset, half

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.errors import OmnibenchError
from omnibench.fit import prior
from omnibench.fit.calibrate import calibrate
from omnibench.fit.calibrator import run_calibrator
from omnibench.fit.problem import Budget, CalibrationProblem, make_parameterisation
from omnibench.fit.shrinkage import shrunk
from omnibench.registry import calibrators, costs, load_plugin_file
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.slam.import_dataset import import_dataset

DEFAULT = ("final_pose", "shrink")
FOLDS = 20  # about, over all recordings: of each the default is compared with two others
GROUPS = 8  # at most, to leave out one by one


@dataclass(frozen=True)
class Fold:
    """Runs to train, and runs of another kind to judge; words: which."""

    words: str
    train: tuple[Trajectory, ...]
    judge: tuple[Trajectory, ...]


def recordings(only: Sequence[str] | None) -> Iterator[tuple[Dataset, list[Fold]]]:
    """Every recording that is at hand, or those asked for, with what is left out of it."""
    for name in ("diff", "tricyc", "omni3", "omni4"):
        if only and name not in only:
            continue
        yield folds_by_kind(import_dataset("optiodom", RECORDINGS / "optiodom" / name))
    if only and "robotino" not in only:
        return
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


def matrices(dataset: Dataset, runs: Sequence[Trajectory], chosen: Sequence[str]) -> dict[tuple[str, str], Array]:
    """The calibrated matrix by every cost and treatment of what the runs hardly drive."""
    training = tuple(replace(run, split="train") for run in runs)
    found = {}
    for cost in chosen:
        answers = {}
        for treatment in ("shrink", "fit"):
            searched = make_parameterisation("matrix", dataset.robot, training, unidentified=treatment)
            kept = len(getattr(searched, "null"))  # noqa: B009
            if treatment == "fit" and kept == answers["kept"]:  # then it is the same problem
                found[cost, "fit"] = found[cost, "keep"]
                continue
            problem = CalibrationProblem(
                dataset.robot, training, costs.create(cost), searched, integration="arc", budget=Budget(), seed=1,
                shrinks=treatment == "shrink",
            )  # fmt: skip
            result = run_calibrator(calibrators.create("closed_form", None), problem)
            if result.matrix is None:
                raise OmnibenchError(result.reason)
            found[cost, "keep" if treatment == "shrink" else "fit"] = result.matrix
            if treatment == "shrink":
                answers["kept"] = kept
                posterior = shrunk(problem, result).matrix
                assert posterior is not None
                found[cost, "shrink"] = posterior
    return found


def errors(dataset: Dataset, matrix: Array, judged: Sequence[Trajectory]) -> Array:
    """Errors (Z, 3) of the final poses of the runs that were left out, m, m, rad."""
    poses = OdometryModel(dataset.robot, matrix, "arc").poses([run.final_log for run in judged])
    return np.array([own[-1] - run.final_pose for own, run in zip(poses, judged, strict=True)])


def groups(runs: Sequence[Trajectory]) -> list[set[str]]:
    """Ids of the runs of each session, or of each run where these are fewer than three; not more than GROUPS."""
    names = [str(run.session) for run in runs]
    if len(set(names)) < 3:
        names = [run.id for run in runs]
    number = {name: index % GROUPS for index, name in enumerate(dict.fromkeys(names))}
    members: dict[int, set[str]] = {}
    for run, name in zip(runs, names, strict=True):
        members.setdefault(number[name], set()).add(run.id)
    return list(members.values())


def jackknife(values: Array) -> float:
    """Variance of a statistic from its values (G,) with one group left out each (Efron 1982, section 3.1)."""
    count = len(values)
    return float((count - 1) / count * np.square(values - values.mean()).sum())


def study(dataset: Dataset, folds: Sequence[Fold], chosen: Sequence[str]) -> None:
    """Print one line a fold and choice."""
    for fold in folds:
        print(f"\n{dataset.robot.name}: {fold.words} ({len(fold.train)} runs -> {len(fold.judge)})")
        trained, judged = groups(fold.train), groups(fold.judge)
        whole = matrices(dataset, fold.train, chosen)
        others = [matrices(dataset, [run for run in fold.train if run.id not in group], chosen) for group in trained]
        found = {choice: errors(dataset, matrix, fold.judge) for choice, matrix in whole.items()}
        norms = {choice: np.linalg.norm(error, axis=1) for choice, error in found.items()}
        freedom = min(len(trained), len(judged)) - 1
        reach = float(stdtrit(freedom, 1 - 0.05 / (FOLDS * 2) / 2))
        for choice, error in found.items():
            position, heading = np.hypot(*error[:, :2].T).mean(), np.degrees(np.abs(error[:, 2]).mean())
            words = f"  {' '.join(choice):18s} {position:.4f} m {heading:6.2f} deg"
            if choice != DEFAULT:
                difference = norms[choice] - norms[DEFAULT]
                refits = [
                    float(np.diff([np.linalg.norm(errors(dataset, each[one], fold.judge), axis=1).mean()
                                   for one in (DEFAULT, choice)])[0])
                    for each in others
                ]  # fmt: skip
                without = [difference[[run.id not in group for run in fold.judge]].mean() for group in judged]
                spread = reach * math.sqrt(jackknife(np.array(refits)) + jackknife(np.array(without)))
                low, high = difference.mean() - spread, difference.mean() + spread
                verdict = "default worse" if high < 0 else "default better" if low > 0 else "no difference"
                words += f"   {1000 * difference.mean():+7.2f} ({1000 * low:+.2f} to {1000 * high:+.2f}) e-3  {verdict}"
            print(words, flush=True)


def long_drive() -> None:
    """Print the errors along the second half of the drive of tricycle_corelli, from its own start."""
    dataset = corelli_dataset()
    (drive,) = dataset.trajectories
    middle, end = float(drive.pose_times[-1] / 2), float(drive.pose_times[-1])
    judged = half(drive, middle, end)
    print("\ntricycle_corelli: first half of one drive -> second half, steering fitted, cost trajectory")
    for treatment in ("keep", "shrink", "fit"):
        train = replace(dataset, trajectories=(half(drive, 0.0, middle),))
        model = calibrate(train, steering="fit", unidentified=treatment).calibration.model
        error = model.poses([judged.reference_log])[0] - judged.poses[1:]
        position, heading = np.hypot(*error[:, :2].T).mean(), np.degrees(np.abs(error[:, 2]).mean())
        print(f"  {treatment:18s} {position:.4f} m {heading:6.2f} deg", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--factor", type=float, default=1.0, help="of every tolerance")
    parser.add_argument("--costs", nargs="*", default=["final_pose"], help="trajectory takes hours")
    parser.add_argument("--robots", nargs="*", help="names of the recordings")
    arguments = parser.parse_args()
    prior.TOLERANCES = {
        name: prior.Tolerance(
            arguments.factor * each.elements,
            tuple(arguments.factor * row for row in each.rows),  # type: ignore[arg-type]
            arguments.factor * each.centre,
        )
        for name, each in prior.TOLERANCES.items()
    }
    for dataset, folds in recordings(arguments.robots):
        study(dataset, folds, arguments.costs)
    if not arguments.robots or "corelli" in arguments.robots:
        long_drive()


if __name__ == "__main__":
    main()
