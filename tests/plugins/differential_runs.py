"""Runs of a differential drive whose wheels, wheelbase and tracked point are not as designed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.fit.calibrator import RunResult, run_calibrator
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array, Mount, Robot, Wheel
from omnibench.robot.model import OdometryModel
from omnibench.testing import synthetic_problem, synthetic_trajectories
from omnibench.testing.synthetic import synthetic_robots

LEFT, RIGHT, OMNI = synthetic_robots()[2].wheels[0], synthetic_robots()[2].wheels[1], synthetic_robots()[0]
ROBOT = Robot(name="plain", wheels=(LEFT, RIGHT))
# The same axle with its wheels in the other order, one of them the other way round, and its middle neither the robot's
# centre nor the tracked point.
MOVED = Robot(
    name="moved",
    wheels=(
        Wheel(name="right", type="fixed", radius=0.08, x=0.1, y=-0.15, angle=np.pi),
        Wheel(name="left", type="fixed", radius=0.08, x=0.1, y=0.25),
    ),
    mount=Mount(x=0.2, y=-0.1, yaw=0.3),
)


def worn(robot: Robot, left: float, right: float, wheelbase: float) -> Robot:
    """The robot with radii of the left and right wheel, and the wheelbase about its middle, times factors."""
    middle = np.mean([wheel.position for wheel in robot.wheels], axis=0)
    wheels = []
    for wheel in robot.wheels:
        x, y = (middle + wheelbase * (np.array(wheel.position) - middle)).tolist()
        share = left if wheel.name == "left" else right
        wheels.append(wheel.model_copy(update={"radius": wheel.radius * share, "x": x, "y": y}))
    return robot.model_copy(update={"wheels": tuple(wheels)})


def runs_of(robot: Robot, true: Robot, *commands: str) -> tuple[Trajectory, ...]:
    """Noise-free runs of the true robot, driven by the design ``robot`` (ROBOT or MOVED).

    commands: only the runs whose command begins with one of these.
    """
    model, chosen = OdometryModel(robot, true.inverse_kinematic_matrix, "arc"), list[Trajectory]()
    for run in synthetic_trajectories(ROBOT):
        if not commands or (run.command or "").startswith(commands):
            left, right = run.rates.T
            driven = replace(run, rates=run.rates if robot.wheels[0] == LEFT else np.column_stack([-right, left]))
            chosen.append(replace(driven, poses=model.poses([driven.log(run.pose_times)])[0]))
    return tuple(chosen)


def solved(calibrator: str, problem: CalibrationProblem) -> RunResult:
    """The result of a calibrator with its default options."""
    return run_calibrator(calibrators.create(calibrator), problem)


def solved_on(calibrator: str, robot: Robot, true: Robot, *commands: str) -> RunResult:
    """The result on the runs of a true robot with these commands."""
    return solved(calibrator, synthetic_problem(robot=robot, trajectories=runs_of(robot, true, *commands)))


def ratios(matrix: Array, design: Robot = ROBOT) -> tuple[float, float]:
    """Wheelbase over that of the design, and right radius over left radius, of a plain robot's matrix (left, right)."""
    wheelbase = 2 * matrix[0, 1] / matrix[2, 1]
    return float(wheelbase / sum(abs(wheel.position[1]) for wheel in design.wheels)), float(matrix[0, 1] / matrix[0, 0])


def in_sessions(runs: Sequence[Trajectory], *sessions: str) -> tuple[Trajectory, ...]:
    """The runs in sessions by turns."""
    return tuple(replace(run, session=sessions[number % len(sessions)]) for number, run in enumerate(runs))
