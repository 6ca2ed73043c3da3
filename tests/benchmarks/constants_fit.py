"""Study of the constants of fit, slam, design and data/checks: what would change if each were half or twice as large.

    python tests/benchmarks/constants_fit.py --out constants_fit.jsonl [--part slam] [--only motion_prior] [--table]

Every number that a module names in capitals is varied by itself on small data. A line of JSON for each, added as it
comes: run again with the same file, and it goes on where it was. Of each the table says

- estimates: largest change of an estimate (matrix, pose, choice of a design), in its standard deviations,
- stated: largest change of a stated standard deviation, as a share of it,
- words: whether outcomes, warnings or verdicts change,
- work: largest change of the work (parts of a box, evaluations), as a share of it.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from named_constants import Constant, constants_of
from slam_study import Run, drive, flower_command

from omnibench.config import Model
from omnibench.data.checks import implausible
from omnibench.data.dataset import Dataset
from omnibench.data.scans import TrajectoryScans
from omnibench.design.design import design_experiment
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.fit.certify import certify_optimum
from omnibench.fit.least_squares.nuisances import Nuisances, deviations_of
from omnibench.fit.least_squares.repetitions import differences_between_repetitions
from omnibench.fit.least_squares.trajectory_fit import TrajectoryFit
from omnibench.fit.problem import Budget, CalibrationProblem, make_parameterisation
from omnibench.fit.uncertainty.identifiability import identifiability
from omnibench.processes import one_thread
from omnibench.registry import costs
from omnibench.robot.calibration import Noise
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.simulate.chain.floor_plan import RoomPlan, make_plan
from omnibench.simulate.chain.lidar import Lidar
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.flower import Command
from omnibench.simulate.simulate import simulate_dataset
from omnibench.slam.slam_options import SlamOptions
from omnibench.slam.slam_run import run_slam

sys.path.insert(0, str(Path(__file__).parents[1] / "fit"))
from motions import RING, driven

FACTORS = (0.5, 2.0)
ANGLES = (1.0471975511965976, 3.141592653589793, 5.235987755982989)
THREE: dict[str, Any] = {
    "robot": {
        "name": "APR-02",
        "wheels": [
            {"name": name, "radius": 0.148, "distance": 0.195, "angle": angle}
            for name, angle in zip("abc", ANGLES, strict=True)
        ],
    },
    "sample_period": 0.05,
    "commands": {"speeds": [0.2], "directions_deg": [0, 60, 120, 180, 240, 300], "turn_rates": [-0.35, 0.35]},
    "repetitions": 3,
    "truth": {"published": "palacin2023_eq8"},
    "noise": {"encoder": 0.02, "pose_position": 0.005, "pose_heading": 0.005, "walk_position": 0.003}
    | {"walk_heading": 0.003, "bias_position": 0.006, "bias_heading": 0.006},
    "train": {"seed": 1, "distance": 1.0},
    "validation": {"seed": 2, "distance": 1.0},
}
CORNERS = (("fl", 1, 1), ("fr", -1, -1), ("rl", 1, -1), ("rr", -1, 1))
FOUR = {
    **THREE,
    "robot": {
        "name": "mecanum",
        "wheels": [
            {
                "name": name,
                "radius": 0.05,
                "distance": 0.35,
                "angle": side * np.pi / 2,
                "roller_angle": roller * np.pi / 4,
            }
            for name, side, roller in CORNERS
        ],
    },
    "truth": {"tolerances": {"radius": 0.02, "distance": 0.03, "angle_deg": 0.5, "seed": 7}},
}


class Value(Model):
    """A figure of an answer. kind: see above. scale: the unit of its change; 0 where only equality counts."""

    kind: str
    values: tuple[float, ...] = ()
    scale: tuple[float, ...] = ()
    words: str = ""

    def change(self, other: Value) -> float:
        """How far another value is from this one: a multiple of the scale, or 1 for other words."""
        if self.kind == "words":
            return float(self.words != other.words)
        if len(self.values) != len(other.values):
            return np.inf
        apart, scale = np.abs(np.subtract(self.values, other.values)), np.array(self.scale)
        return float(np.max(apart[scale > 0] / scale[scale > 0], initial=0.0))


Answer = dict[str, Value]


class Result(Model):
    """The answers with one constant at another value; constant "" for those as they are."""

    part: str
    constant: str
    factor: float
    value: str
    answer: dict[str, Value]
    failure: str = ""


def estimates(values: Array, deviations: Array) -> Value:
    return Value(kind="estimates", values=tuple(np.ravel(values)), scale=tuple(np.ravel(deviations)))


def stated(deviations: Array) -> Value:
    return Value(kind="stated", values=tuple(np.ravel(deviations)), scale=tuple(np.ravel(deviations)))


def work(*amounts: float) -> Value:
    return Value(kind="work", values=amounts, scale=amounts)


def words(*texts: object) -> Value:
    return Value(kind="words", words=" | ".join(map(str, texts)))


@cache
def recorded(wheels: int) -> Dataset:
    """Twelve commands, three times each, of three omni or four mecanum wheels."""
    config = FlowerConfig.model_validate(THREE if wheels == 3 else FOUR)
    return simulate_dataset(config, f"{wheels} wheels").dataset


def sessions_apart(dataset: Dataset) -> Dataset:
    """The recordings with poses that drift from command to command, which no matrix fits."""
    return replace(
        dataset,
        trajectories=tuple(
            replace(run, poses=run.poses + np.linspace(0, 0.03, len(run.poses))[:, None] * ((index // 3) % 4 - 1.5))
            for index, run in enumerate(dataset.trajectories)
        ),
    )


def shaken(dataset: Dataset) -> Dataset:
    """The recordings with wrong start headings (2 cm a metre) and clocks of the reference (0.1 s and 0.3 %)."""
    rng = np.random.default_rng(3)
    runs = []
    for run in dataset.trajectories:
        turn, offset, slope = rng.normal(0.0, [0.02, 0.1, 0.003])
        taken = np.clip(run.pose_times * (1 - slope) - offset, 0.0, None)
        poses = np.stack([np.interp(taken, run.pose_times, column) for column in run.poses.T], axis=1)
        poses[0] = run.poses[0] + [0.0, 0.0, turn]
        runs.append(replace(run, poses=poses))
    return replace(dataset, trajectories=tuple(runs))


def nuisances_of(dataset: Dataset) -> Array:
    """The deviations (3,) of start headings and clocks that repetitions show."""
    model = OdometryModel(dataset.robot, dataset.robot.inverse_kinematic_matrix, "arc")
    runs = dataset.split("train")
    fit = TrajectoryFit(model, runs, Nuisances(np.zeros((len(runs), 3)), np.zeros(3)))
    noise = Noise(pose_position=0.005, pose_heading=0.005, walk_position=0.003, walk_heading=0.003)
    return deviations_of(differences_between_repetitions(runs, fit.residuals, fit.slopes), noise)


def of_calibration(run: CalibrationRun, usual: Array | None = None) -> Answer:
    """The figures of one calibration."""
    said = run.uncertainty
    deviations = usual if usual is not None else said.standard_deviations if said else np.ones((3, 1))
    answer = {"matrix": estimates(run.result.matrix, deviations), "evaluations": work(run.result.evaluations)}
    answer["words"] = words(run.result.outcome, run.warnings, said.source if said else "", run.result.at_bounds)
    if said:
        answer["deviations"] = stated(said.standard_deviations)
        answer["noise"] = stated(np.array([*said.noise.model_dump().values()]))
    if said and said.parameters:
        answer["parameters"] = stated(np.array([each.standard_deviation or 0.0 for each in said.parameters]))
    return answer


def answers_of_fit() -> Answer:
    """Calibrators, uncertainty and identifiability."""
    plain, four = recorded(3), recorded(4)
    hard, loose = sessions_apart(plain), shaken(plain)
    short, clocks = Budget(evaluations=4000), {"clock": "offset_and_slope"}
    closed = calibrate(plain, "closed_form", integration="arc")
    assert closed.uncertainty is not None
    usual = closed.uncertainty.standard_deviations
    found = {
        "closed_form": of_calibration(closed),
        "closed_form of headings": of_calibration(calibrate(plain, "closed_form", cost="final_heading")),
        "closed_form of four wheels": of_calibration(calibrate(four, "closed_form")),
        "closed_form, misfit": of_calibration(calibrate(hard, "closed_form", cost="trajectory")),
        "trajectory_ml": of_calibration(calibrate(plain, "trajectory_ml")),
        "trajectory_ml, clocks": of_calibration(calibrate(plain, "trajectory_ml", options=clocks)),
        "trajectory_ml, misfit": of_calibration(calibrate(hard, "trajectory_ml")),
        "trajectory_ml, starts": of_calibration(calibrate(loose, "trajectory_ml")),
        "trajectory_ml of four wheels": of_calibration(calibrate(four, "trajectory_ml")),
        "genetic": of_calibration(calibrate(plain, "genetic", options={"generations": 20}, budget=short), usual),
        "crs": of_calibration(calibrate(plain, "crs", budget=short), usual),
    }
    found["nuisances"] = {"deviations": stated(nuisances_of(loose))}
    weak = replace(plain, trajectories=tuple(driven(RING, slip=0.02)))
    told = [identifiability(dataset.robot, dataset.trajectories) for dataset in (plain, four, weak)]
    found["identifiability"] = {
        "deviations": stated(np.array([each.deviations or (0, 0, 0) for one in told for each in one.directions])),
        "parameters": stated(np.array([each.deviation or 0.0 for one in told for each in one.parameters])),
        "words": words(*([one.sentences, [each.told for each in one.parameters]] for one in told)),
    }
    return {f"{name}: {figure}": value for name, of in found.items() for figure, value in of.items()}


def answers_of_bounds() -> Answer:
    """Proofs of the optimum: their parts, and how the bound changes in units of the gap that was asked for."""
    plain, answer = recorded(3), {}
    calibration = calibrate(plain, "closed_form").calibration
    for gap in (1e-2, 0.1):
        proof = certify_optimum(calibration, plain, gap=gap, seconds=np.inf, parts=3000).proof
        answer |= {
            f"gap {gap:g}: parts": work(proof.boxes),
            f"gap {gap:g}: bound": Value(kind="stated", values=(proof.lower_bound,), scale=(gap * proof.best_cost,)),
            f"gap {gap:g}: words": words(proof.finished),
        }
    return answer


def answers_of_evaluator() -> Answer:
    """Costs by the fast evaluator, in units of the 1e-11 to which they agree with direct integration, and its size."""
    answer = {}
    dataset = recorded(3)
    runs = dataset.split("train")
    for name in ("matrix", "geometry"):
        for cost in ("final_pose", "trajectory"):
            searched = make_parameterisation("matrix" if name == "matrix" else "geometry", dataset.robot, runs)
            problem = CalibrationProblem(
                dataset.robot, runs, costs.create(cost), searched, integration="arc", budget=Budget(), seed=1
            )
            candidates = np.random.default_rng(0).uniform(problem.lower, problem.upper, (100, 9))
            evaluator = problem.build_evaluator()
            apart = problem.cost(candidates) - problem.values(candidates)
            answer[f"{name}, {cost}: difference"] = estimates(apart, np.full(100, 1e-11))
            answer[f"{name}, {cost}: size"] = work(evaluator.size if evaluator else 0.0)
    return answer


@cache
def scanned(room: str) -> tuple[Run, ...]:
    """Two runs in a room."""
    plan = make_plan(RoomPlan(plan=room), room)
    return tuple(drive(plan, Lidar(), flower_command(n), np.random.default_rng([5, n])) for n in (1, 3))


def of_path(run: Run, start: Literal["odometry", "last_pose"], lidar: Lidar) -> Answer:
    """The figures of one run."""
    path = run_slam(run.scans, lidar.scanner, SlamOptions(start=start), np.zeros(3), run.odometry)
    errors = (path.poses - run.true)[1:]
    deviations = np.sqrt(np.diagonal(path.covariances[1:], axis1=1, axis2=2))
    nees = (errors * np.linalg.solve(path.covariances[1:], errors[:, :, None])[:, :, 0]).sum(axis=1)
    return {
        "poses": estimates(path.poses[1:], deviations),
        "deviations": stated(deviations),
        "words": words(*path.warnings),
        "error mm": Value(kind="error", values=(1e3 * float(np.hypot(*errors[:, :2].T).mean()),)),
        "nees": Value(kind="nees", values=(float(nees.mean()),)),
    }


def answers_of_slam() -> Answer:
    """Poses in three rooms from both starts, their errors and how honest their covariances are."""
    starts: tuple[Literal["odometry", "last_pose"], ...] = ("odometry", "last_pose")
    found = {
        f"{room}, {start}, {index}": of_path(run, start, Lidar())
        for room in ("furnished_room", "hall", "corridor")
        for start in starts
        for index, run in enumerate(scanned(room))
    }
    return {f"{name}: {figure}": value for name, of in found.items() for figure, value in of.items()}


@cache
def hard_runs() -> dict[str, tuple[Run, Lidar]]:
    """Runs in rooms that hide the heading, of a quick robot, and of a scanner that is mounted upside down."""
    runs = {}
    few = Lidar(rays=361)
    for corners, radius, lidar in ((72, 3.0, Lidar()), (400, 8.0, Lidar()), (400, 3.0, few)):
        angles = 2 * np.pi * np.arange(corners) / corners
        boundary = tuple((radius * math.cos(angle), radius * math.sin(angle)) for angle in angles)
        plan = make_plan(RoomPlan(boundary=boundary, start=(0.0, 0.0, 0.0)), "round")
        run = drive(plan, lidar, flower_command(2), np.random.default_rng([5, 2]), distance=0.9)
        runs[f"{corners} corners of {radius:g} m, {lidar.rays} rays"] = run, lidar
    furnished = make_plan(RoomPlan(plan="furnished_room"), "furnished")
    for turn in (-1.2, 1.2):
        run = drive(furnished, Lidar(), Command(0.5, 1.0, turn), np.random.default_rng(7))
        runs[f"quickly, {turn} rad/s"] = run, Lidar()
    right = scanned("furnished_room")[0]
    mirrored = TrajectoryScans(right.scans.times, np.ascontiguousarray(right.scans.ranges[:, ::-1]))
    return runs | {"mirrored": (replace(right, scans=mirrored), Lidar())}


def answers_of_hard_slam() -> Answer:
    """Poses where scans mislead or tell little."""
    found = {
        name: of_path(run, "last_pose" if name.startswith("quickly") else "odometry", lidar)
        for name, (run, lidar) in hard_runs().items()
    }
    return {f"{name}: {figure}": value for name, of in found.items() for figure, value in of.items()}


def answers_of_design() -> Answer:
    """A design from recordings: the continuous optimum, the choice and its precision."""
    from omnibench.design.candidates import candidates_of_dataset

    design = design_experiment(candidates_of_dataset(recorded(3)), per="second")
    (of_set,) = design.sets
    step = of_set.step
    return {
        "shares": Value(
            kind="estimates", values=tuple(of_set.optimum.shares.values()), scale=(0.01,) * len(of_set.optimum.shares)
        ),
        "precision": stated(np.array([*step.row_percent, step.relative])),
        "efficiency": Value(kind="stated", values=(step.efficiency,), scale=(step.efficiency,)),
        "choice": words(*of_set.chosen),
        "steps": work(len(of_set.steps)),
    }


def answers_of_checks() -> Answer:
    """Warnings of recordings in other units, with swapped wheels, and of good ones."""
    answer = {}
    for wheels in (3, 4):
        dataset = recorded(wheels)
        logs = [run.log(run.pose_times) for run in dataset.trajectories]
        poses = [run.poses for run in dataset.trajectories]
        order = [1, 0, *range(2, wheels)]
        variants = {
            "good": (logs, poses),
            "rpm": ([replace(log, rates=log.rates * 60 / (2 * np.pi)) for log in logs], poses),
            "deg/s": ([replace(log, rates=np.degrees(log.rates)) for log in logs], poses),
            "degrees": (logs, [pose * [1, 1, np.degrees(1)] for pose in poses]),
            "mm": (logs, [pose * [1000, 1000, 1] for pose in poses]),
            "cm": (logs, [pose * [100, 100, 1] for pose in poses]),
            "swapped": ([replace(log, rates=log.rates[:, order]) for log in logs], poses),
            "sign": ([replace(log, rates=log.rates * ([-1.0] + [1.0] * (wheels - 1))) for log in logs], poses),
        }
        for name, (changed, seen) in variants.items():
            answer[f"{wheels} wheels, {name}"] = words(*implausible(dataset.robot, changed, seen))
    return answer


# The package or module whose constants a part varies, what is left out of it, and its answers.
PARTS: dict[str, tuple[str, tuple[str, ...], Callable[[], Answer]]] = {
    "fit": ("omnibench.fit", ("omnibench.fit.bounds", "omnibench.fit.evaluator"), answers_of_fit),
    "bounds": ("omnibench.fit.bounds", (), answers_of_bounds),
    "evaluator": ("omnibench.fit.evaluator", (), answers_of_evaluator),
    "slam": ("omnibench.slam", (), answers_of_slam),
    "hard_slam": ("omnibench.slam", (), answers_of_hard_slam),
    "design": ("omnibench.design", ("omnibench.design.report",), answers_of_design),
    "checks": ("omnibench.data.checks", (), answers_of_checks),
}


def study(part: str, only: Sequence[str], done: set[tuple[str, str, float]]) -> Iterator[Result]:
    """The answers of a part as they are, then with each constant varied, if they are not known already."""
    package, elsewhere, answers = PARTS[part]
    varied = [each for each in constants_of(package, elsewhere) if _is_wanted(each, only)]
    wanted = [(each, factor) for each in varied for factor in FACTORS if (part, each.title, factor) not in done]
    with one_thread():
        if (part, "", 1.0) not in done:
            yield Result(part=part, constant="", factor=1.0, value="", answer=answers())
        for constant, factor in wanted:
            answer, failure = {}, ""
            with constant.varied(factor):
                try:
                    answer = answers()
                except Exception as error:  # the study goes on, and the table says so
                    failure = f"{type(error).__name__}: {error}"
            value = str(constant.times(factor)).replace("\n", "")
            yield Result(part=part, constant=constant.title, factor=factor, value=value, answer=answer, failure=failure)


def _is_wanted(constant: Constant, only: Sequence[str]) -> bool:
    return not only or any(part in constant.title for part in only)


def print_table(results: Sequence[Result]) -> None:
    """A line for each constant and factor: the largest change of each kind, and where."""
    usual = {each.part: each.answer for each in results if not each.constant}
    for part, answer in usual.items():
        for kind in ("error", "nees"):
            figures = [value.values[0] for value in answer.values() if value.kind == kind]
            if figures:
                print(f"{part}: median {kind} {np.median(figures):.3f}{' mm' if kind == 'error' else ''}")
    for result in results:
        if result.constant:
            print(f"{result.part} {result.constant:45} {result.value:>12}  {_changes(result, usual[result.part])}")


def _changes(result: Result, usual: Answer) -> str:
    if result.failure:
        return result.failure
    texts = []
    for kind in ("estimates", "stated", "words", "work"):
        changes = {name: value.change(result.answer[name]) for name, value in usual.items() if value.kind == kind}
        worst = max(changes, key=lambda name: changes[name], default="")
        if worst and changes[worst] > 1e-6:
            texts.append(f"{kind} {changes[worst]:.2g} ({worst})" if kind != "words" else f"words ({worst})")
    for kind in ("error", "nees"):
        figures = [
            [answer[name].values[0] for name, value in usual.items() if value.kind == kind]
            for answer in (usual, result.answer)
        ]
        if figures[0] and figures[0] != figures[1]:
            texts.append(f"{kind} {np.median(figures[0]):.3f} -> {np.median(figures[1]):.3f}")
    return "; ".join(texts) or "nothing"


def main() -> None:
    """Carry out what is missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="file of answers, one line of JSON each")
    parser.add_argument("--part", nargs="+", choices=tuple(PARTS), default=tuple(PARTS))
    parser.add_argument("--only", action="append", default=[], metavar="PART", help="of a constant's name")
    parser.add_argument("--table", action="store_true", help="print the table of what is there")
    arguments = parser.parse_args()
    lines = arguments.out.read_text().splitlines() if arguments.out.exists() else []
    results = [Result.model_validate_json(line) for line in lines]
    if not arguments.table:
        done = {(each.part, each.constant, each.factor) for each in results}
        with arguments.out.open("a") as file:
            for part in arguments.part:
                for result in study(part, arguments.only, done):
                    file.write(result.model_dump_json() + "\n")
                    file.flush()
                    results.append(result)
    print_table([each for each in results if each.part in arguments.part])


if __name__ == "__main__":
    main()
