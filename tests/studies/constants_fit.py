"""Study of the constants of fit and design: what would change if each were half or twice as large.

    python tests/studies/constants_fit.py --out constants_fit.jsonl [--part fit] [--only jackknife] [--table]

Small simulated recordings; constant_study.py says what the table holds.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from constant_study import Answer, Part, Value, carry_out, estimates, stated, words, work
from interval_coverage import simulated, wheel_equations

from omnibench.data.dataset import Dataset
from omnibench.design.candidates import candidates_of_dataset
from omnibench.design.design import design_experiment
from omnibench.design.report import effort_table
from omnibench.fit.calibrate import CalibrationRun, calibrate
from omnibench.fit.certify import certify_optimum
from omnibench.fit.identifiability import identifiability
from omnibench.fit.problem import Budget, CalibrationProblem, make_parameterisation
from omnibench.fit.trajectory_fit import Nuisances, TrajectoryFit, noise_of_fit
from omnibench.registry import costs
from omnibench.robot.kinematics import Array
from omnibench.robot.model import OdometryModel
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import simulate_dataset

sys.path.insert(0, str(Path(__file__).parents[1] / "fit"))
from motions import RING, driven

FEW_SETS = 60  # sets of few runs
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
    return noise_of_fit(fit, range(3)).deviations


def of_calibration(run: CalibrationRun, usual: Array | None = None) -> Answer:
    """The figures of one calibration."""
    said = run.uncertainty
    deviations = usual if usual is not None else said.standard_deviations if said else np.ones((3, 1))
    answer = {"matrix": estimates(run.result.matrix, deviations), "evaluations": work(run.result.evaluations)}
    answer["words"] = words(run.result.outcome, run.warnings, said.source if said else "", run.result.at_bounds)
    if said:
        answer["deviations"] = stated(said.standard_deviations)
        answer["noise"] = stated(np.array([*said.noise.model_dump().values()]))
    if run.parameters:
        answer["parameters"] = stated(np.array([(each.high or 0.0) - (each.low or 0.0) for each in run.parameters]))
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
        "map": of_calibration(calibrate(plain)),
        "map, clocks": of_calibration(calibrate(plain, options=clocks)),
        "map, misfit": of_calibration(calibrate(hard)),
        "map, starts": of_calibration(calibrate(loose)),
        "map of four wheels": of_calibration(calibrate(four)),
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


def answers_of_design() -> Answer:
    """A design from recordings: the continuous optimum, the choice and its precision."""
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


def answers_of_design_report() -> Answer:
    """The report of a design from recordings. lines: of the table against the number of runs."""
    design = design_experiment(candidates_of_dataset(recorded(3)))
    (of_set,) = design.sets
    return {"lines": Value(kind="lines", values=(len(effort_table(design, of_set).rows),))}


def answers_of_few_runs() -> Answer:
    """Intervals of closed_form, which its matrix's elements fit nearly: from four and five runs without repetition."""
    answer = {}
    for runs in (4, 5):
        covered, deviations = [], []
        for seed in range(FEW_SETS):
            dataset, geometry = simulated("bias", runs, seed)
            once = replace(dataset, trajectories=tuple(run for run in dataset.trajectories if run.repetition == 0))
            said = calibrate(once, "closed_form", cost="trajectory", seed=seed).uncertainty
            if said is not None:
                truth = np.linalg.inv(wheel_equations(geometry))
                covered.append((said.intervals.low <= truth) & (truth <= said.intervals.high))
                deviations.append(said.standard_deviations)
        answer |= {
            f"{runs} runs: deviations": stated(np.array(deviations)),
            f"{runs} runs: covered": Value(kind="covered", values=(100 * float(np.mean(covered)),)),
        }
    return answer


PARTS = {
    "fit": Part("omnibench.fit", answers_of_fit, ("omnibench.fit.certify", "omnibench.fit.evaluator")),
    "bounds": Part("omnibench.fit.certify", answers_of_bounds),
    "evaluator": Part("omnibench.fit.evaluator", answers_of_evaluator),
    "design": Part("omnibench.design", answers_of_design, ("omnibench.design.report",)),
    "design_report": Part("omnibench.design.report", answers_of_design_report),
    "few_runs": Part("omnibench.fit.uncertainty", answers_of_few_runs),
}

if __name__ == "__main__":
    carry_out(PARTS, __doc__)
