"""Errors that a discovery states are those of final poses, as ``evaluate`` has them, outliers or not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from discovery_samples import simulated
from shared_results import made_once

from omnibench.data.dataset import Dataset
from omnibench.discover.discover import discover_effects
from omnibench.discover.result import Discovery
from omnibench.fit.evaluate import Evaluation, evaluate


def thrown_at_the_end() -> Dataset:
    """A recording whose reference jumps by 0.3 m at the end of every ninth run."""
    dataset = simulated((), repetitions=4)
    runs = []
    for number, run in enumerate(dataset.trajectories):
        poses = run.poses.copy()
        poses[-1, 0] += 0.3 * (number % 9 == 0)
        runs.append(replace(run, poses=poses))
    return replace(dataset, trajectories=tuple(runs))


@made_once
def both() -> tuple[Discovery, Evaluation]:
    """What discover says of the recording, and what evaluate says of its plain calibration."""
    dataset = thrown_at_the_end()
    discovery = discover_effects(dataset, unknown_term=False)
    return discovery, evaluate(discovery.plain, dataset)


def test_the_poses_that_are_thrown_are_outliers() -> None:
    discovery, _ = both()
    assert discovery.outliers >= 8


def test_before_on_training_runs_is_what_evaluate_says_of_the_plain_calibration() -> None:
    discovery, evaluation = both()
    assert discovery.steps[0].eq6_train == pytest.approx(evaluation.splits["train"].cost, rel=1e-9)


def test_before_on_held_out_runs_is_what_evaluate_says_of_the_plain_calibration() -> None:
    discovery, evaluation = both()
    repetitions, session = discovery.held_out
    errors = evaluation.splits["validation"]
    assert session.eq6.before == pytest.approx(errors.cost, rel=1e-9)
    assert session.position_m[0] == pytest.approx(errors.position_mean_m, rel=1e-9)
    assert session.heading_rad[0] == pytest.approx(errors.heading_mean_rad, rel=1e-9)
    # Cross-validated: a little more than of the fit to all runs.
    assert repetitions.eq6.before == pytest.approx(evaluation.splits["train"].cost, rel=0.03)
    assert np.isfinite(repetitions.chi2.before)
