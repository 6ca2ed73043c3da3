"""Bootstrap intervals about the exact optimum."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from omnibench.errors import ConfigError
from omnibench.fit.bootstrap import bootstrap_intervals
from omnibench.fit.calibrator import run_calibrator
from omnibench.fit.calibrators.closed_form import cone_program
from omnibench.fit.problem import Budget, CalibrationProblem, make_parameterisation
from omnibench.registry import calibrators, costs
from omnibench.simulate.simulate import simulate_dataset
from omnibench.simulate.source import read_simulation

STUDY = Path(__file__).parents[2] / "studies" / "bootstrap_coverage.py"


def study():
    spec = importlib.util.spec_from_file_location("bootstrap_coverage", STUDY)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def flower_problem(parameterisation="matrix", repetitions=1):
    flower = read_simulation(study().CONFIG).config
    dataset = simulate_dataset(flower.model_copy(update={"repetitions": repetitions, "validation": None})).dataset
    training = dataset.split("train")
    searched = make_parameterisation(parameterisation, dataset.robot, training, box="row")
    return CalibrationProblem(
        dataset.robot,
        training,
        costs.create("final_pose"),
        searched,
        integration="euler",
        budget=Budget(),
        seed=1,
    )


def test_a_resampled_optimum_differs_from_a_full_refit_by_far_less_than_the_intervals_width():
    problem = flower_problem()
    optimum = run_calibrator(calibrators.create("closed_form"), problem).vector
    intervals = bootstrap_intervals(problem, optimum, resamples=100, rng=np.random.default_rng(0))
    width = (intervals.high - intervals.low).ravel()
    drawn = np.random.default_rng(5).multinomial(36, np.full(36, 1 / 36))
    shares = problem.objective.shares(problem.odometry.trajectory) * drawn
    linearised = optimum + cone_program(problem, problem.objective, optimum).step(shares)
    refitted = linearised
    for _ in range(6):  # each about the last answer: where it no longer moves, the poses are not linearised any more
        refitted = refitted + cone_program(problem, problem.objective, refitted).step(shares)
    assert np.abs(linearised - optimum).max() > 0.01 * width.max()
    assert (np.abs(refitted - linearised) < 0.01 * width).all()


def test_about_95_percent_of_the_intervals_hold_the_hidden_matrix():
    hits = np.array([study().covered(seed, resamples=150) for seed in range(3)])
    # Binomial, 27 intervals: 95 % of them leaves fewer than 21 inside with a probability of about 4e-4.
    assert hits.sum() >= 21


def test_intervals_shrink_with_more_repetitions():
    widths = []
    for repetitions in (1, 4):
        problem = flower_problem(repetitions=repetitions)
        optimum = run_calibrator(calibrators.create("closed_form"), problem).vector
        intervals = bootstrap_intervals(problem, optimum, resamples=100, rng=np.random.default_rng(0))
        widths.append(np.median(intervals.high - intervals.low))
    assert widths[1] == pytest.approx(widths[0] / 2, rel=0.35)


def test_the_geometry_parameterisation_is_refused_in_words():
    problem = flower_problem("geometry")
    with pytest.raises(ConfigError, match="matrix parameterisation"):
        bootstrap_intervals(problem, problem.start, rng=np.random.default_rng(0))
