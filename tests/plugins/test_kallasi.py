"""The calibrator kallasi of ``plugins/``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from real_recordings import tricyc

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.fit.calibrator import Outcome, RunResult, run_calibrator
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array, Mount, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import OdometryBatch
from omnibench.testing import (
    CalibratorConformance,
    load_plugin,
    synthetic_problem,
    synthetic_trajectories,
)
from omnibench.testing.synthetic import synthetic_robots

__all__ = ["tricyc"]


@pytest.fixture(autouse=True, scope="module")
def plugin(registries_as_before_the_module: None) -> None:  # noqa: ARG001
    load_plugin(Path(__file__).parents[2] / "plugins" / "kallasi.py")


class TestKallasi(CalibratorConformance):
    """The cases of every calibrator."""

    name = "kallasi"
    solved = 0.5  # the wheel's true distance from the axle is not the designed one, which the method cannot see


def tricycle(mount: Mount | None = None) -> Robot:
    (robot,) = (robot for robot in synthetic_robots() if "tricycle" in robot.name)
    return robot.model_copy(update={"mount": mount})


def driven(robot: Robot, share: float, offset: float) -> tuple[tuple[Trajectory, ...], Array]:
    """The synthetic recordings with another radius and a steering offset, rad, and the matrix (3, 2) that they have."""
    cosine, sine = math.cos(offset), math.sin(offset)
    matrix = share * robot.inverse_kinematic_matrix @ np.array([[cosine, -sine], [sine, cosine]])
    model = OdometryModel(robot, matrix, "arc")
    runs = synthetic_trajectories(robot)
    return tuple(replace(run, poses=model.poses([run.log(run.pose_times)])[0]) for run in runs), matrix


def fit(robot: Robot, runs: Sequence[Trajectory]) -> RunResult:
    return run_calibrator(calibrators.create("kallasi"), synthetic_problem(robot=robot, trajectories=runs))


def errors(runs: Sequence[Trajectory], matrix: Array) -> tuple[float, float]:
    """Mean final error, m and degrees."""
    batch = OdometryBatch([run.final_log for run in runs], "arc")
    off = batch.poses(matrix[None])[0] - np.array([run.final_pose for run in runs])
    return float(np.hypot(off[:, 0], off[:, 1]).mean()), float(np.degrees(np.abs(off[:, 2])).mean())


@settings(max_examples=10, deadline=None)
@given(st.floats(0.9, 1.1), st.floats(-0.1, 0.1), st.sampled_from([None, Mount(x=0.3, y=-0.1, yaw=0.2)]))
def test_scale_and_offset_are_found(share: float, offset: float, mount: Mount | None) -> None:
    robot = tricycle(mount)
    runs, truth = driven(robot, share, offset)
    assert fit(robot, runs).matrix == pytest.approx(truth, rel=1e-8, abs=1e-10)


def test_they_are_reported() -> None:
    runs, _ = driven(tricycle(), 1.05, math.radians(2))
    reason = fit(tricycle(), runs).reason
    assert reason.startswith("steering offset +2.000 deg, driving scale 0.08400 m per rad (1.0500 of the design)")


def test_other_robots_are_refused() -> None:
    for robot in synthetic_robots():
        if robot != tricycle():
            result = fit(robot, synthetic_trajectories(robot))
            assert result.outcome is Outcome.NOT_APPLICABLE
            assert result.reason.startswith("it is for tricycles with one driven and steered wheel")


def test_straight_lines_are_refused() -> None:
    straight = [run for run in synthetic_trajectories(tricycle()) if run.command in ("forward", "backward")]
    result = fit(tricycle(), straight)
    assert (result.outcome, "paths that turn" in result.reason) == (Outcome.NOT_APPLICABLE, True)


def test_the_figures_of_the_authors_of_optiodom_are_reached(tricyc: Dataset) -> None:
    circles, squares = ([run for run in tricyc.trajectories if run.id.startswith(k)] for k in ("circular", "square"))
    matrix = fit(tricyc.robot, circles).matrix
    assert errors(circles, matrix) == pytest.approx((0.0481, 3.33), rel=0.02)
    assert errors(squares, matrix) == pytest.approx((0.0880, 2.93), rel=0.02)
