"""A small calibration problem with a known answer: noise-free recordings of a robot that differs from its design."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.fit.cost import FinalPose
from omnibench.fit.geometry import GeometryLimits
from omnibench.fit.parameterisation import ParameterisationName
from omnibench.fit.problem import Budget, BudgetSpent, CalibrationProblem, make_parameterisation
from omnibench.registry import Options
from omnibench.robot.kinematics import Array, Robot, Wheel, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, WheelLog
from omnibench.robot.wheels.wheel import WheelType

PERIOD = 0.2  # s between wheel samples
_SAMPLES = 20  # wheel samples of a run
_SPEED = 0.25  # m/s
# True radii and distances as shares of the design values. One factor for all distances keeps zeros of the matrix zero,
# so that the answer lies in every box that omnibench offers.
_RADII = (1.04, 0.97, 1.02, 0.99)
_DISTANCE = 1.06
_PATIENCE = 100  # calls after BudgetSpent that are refused before the run is stopped


class Runaway(BaseException):  # no Exception: a calibrator that swallows BudgetSpent would swallow it, too
    """Ends a run that keeps asking for costs after the budget is spent."""


def synthetic_robot(wheels: Literal[3, 4] = 3) -> Robot:
    """Three omni wheels like those of the APR-02, or four mecanum wheels."""
    if wheels == 3:
        angles = (math.pi / 3, math.pi, -math.pi / 3)
        omni = (Wheel(name=n, radius=0.148, distance=0.195, angle=a) for n, a in zip("abc", angles, strict=True))
        return Robot(name="synthetic omni", wheels=tuple(omni))
    corners = (("fl", 1, 1), ("fr", -1, -1), ("rl", 1, -1), ("rr", -1, 1))
    mecanum = (
        Wheel(name=n, radius=0.08, distance=0.45, angle=side * math.pi / 2, roller_angle=roller * math.pi / 4)
        for n, side, roller in corners
    )
    return Robot(name="synthetic mecanum", wheels=tuple(mecanum))


def synthetic_wheeled_robots() -> tuple[Robot, ...]:
    """A differential and a skid-steered robot, a tricycle, a car, and a swerve drive on two modules."""

    def wheels(kind: WheelType, places: Mapping[str, tuple[float, float]], **more: bool) -> tuple[Wheel, ...]:
        return tuple(Wheel(name=n, type=kind, radius=0.08, x=x, y=y, **more) for n, (x, y) in places.items())

    rear = {"left": (0.0, 0.2), "right": (0.0, -0.2)}
    corners = {"fl": (0.2, 0.2), "fr": (0.2, -0.2), "rl": (-0.2, 0.2), "rr": (-0.2, -0.2)}
    guided, front = wheels("fixed", rear, measured=False), {"front": (0.5, 0.0)}
    return (
        Robot(name="synthetic differential", wheels=wheels("fixed", rear)),
        Robot(name="synthetic skid", wheels=wheels("fixed", corners), skid=True),
        Robot(name="synthetic tricycle", wheels=(*wheels("steered", front), *guided)),
        Robot(name="synthetic car", wheels=(*wheels("fixed", rear), *wheels("steered", front, driven=False))),
        Robot(name="synthetic swerve", wheels=wheels("steered", {"front": (0.3, 0.0), "rear": (-0.3, 0.0)})),
    )


def true_robot(robot: Robot) -> Robot:
    """The true robot: radii 3 % below to 4 % above the design, distances 6 % above."""
    wheels = (
        wheel.model_copy(update={"radius": wheel.radius * share, "distance": wheel.lever * _DISTANCE})
        for wheel, share in zip(robot.wheels, _RADII, strict=False)
    )
    return robot.model_copy(update={"wheels": tuple(wheels)})


def synthetic_trajectories(robot: Robot, integration: Integration = "arc") -> tuple[Trajectory, ...]:
    """Twelve runs of 4 s: four directions, straight and turning either way; reference poses every 0.8 s, exact."""
    model = OdometryModel(robot, true_robot(robot).inverse_kinematic_matrix, integration)
    times: Array = (PERIOD * np.arange(1, _SAMPLES + 1)).astype(float)
    stamps = np.append(0.0, times[3::4])
    runs: list[Trajectory] = []
    for direction, turn in product((0.2, 1.8, 3.3, 4.9), (-0.4, 0.0, 0.4)):
        twist = np.array([_SPEED * math.cos(direction), _SPEED * math.sin(direction), turn])
        rates = np.tile(wheel_equations(robot.wheels) @ twist, (_SAMPLES, 1))
        poses = model.poses([WheelLog(times, rates, np.zeros(3), stamps)])[0]
        runs.append(Trajectory(f"{len(runs) + 1:02d}", "train", times, rates, stamps, poses))
    return tuple(runs)


def synthetic_dataset(wheels: Literal[3, 4] = 3) -> Dataset:
    """The recordings as a data set."""
    robot = synthetic_robot(wheels)
    return make_dataset("synthetic", robot, PERIOD, synthetic_trajectories(robot), simulated=True)


class ObservedProblem(CalibrationProblem):
    """A calibration problem that records how it is used.

    strays: candidates outside the box. uncounted: candidates evaluated by ``values``, which the budget does not count.
    refusals: calls of ``cost`` that raised BudgetSpent. undefined: maps points (P, f) of the unit cube of the f free
    elements to (P,) of bool, True where the cost is NaN.
    """

    def __init__(
        self,
        *arguments: Any,
        undefined: Callable[[Array], NDArray[np.bool_]] | None = None,
        **keywords: Any,
    ) -> None:
        super().__init__(*arguments, **keywords)
        self.strays: list[Array] = []
        self.uncounted = 0
        self.refusals = 0
        self._undefined = undefined
        self._counting = False

    def cost(self, candidates: Array) -> Array:
        """Costs (P,) as in every problem; records candidates outside the box and refused calls."""
        vectors = np.array(candidates, dtype=float, ndmin=2)
        if vectors.shape[1:] == self.start.shape:
            self.strays.extend(vectors[np.logical_not(self.inside(vectors))])
        if self.refusals > _PATIENCE:
            raise Runaway
        self._counting = True
        try:
            return super().cost(vectors)
        except BudgetSpent:
            self.refusals += 1
            raise
        finally:
            self._counting = False

    def values(self, candidates: Array) -> Array:
        """Costs (P,) as in every problem, but NaN where the cost is undefined."""
        if not self._counting:
            self.uncounted += len(candidates)
        values = super().values(candidates)
        if self._undefined is not None:
            values[self._undefined(self.to_unit(candidates))] = np.nan
        return values


def synthetic_problem(
    parameterisation: ParameterisationName = "matrix",
    *,
    wheels: Literal[3, 4] = 3,
    fixed: bool = False,
    seed: int = 0,
    evaluations: int = 2_000,
    seconds: float = 600.0,
    undefined: Callable[[Array], NDArray[np.bool_]] | None = None,
    trajectories: Sequence[Trajectory] | None = None,
) -> ObservedProblem:
    """The problem of Eq. (6) on the recordings; its least cost is 0, up to rounding.

    fixed: use a box that fixes some elements (zeros of the matrix, or the wheels' angles).
    """
    robot = synthetic_robot(wheels)
    runs = synthetic_trajectories(robot) if trajectories is None else tuple(trajectories)
    limits = GeometryLimits(angle_deg=0.0) if fixed else GeometryLimits()
    return ObservedProblem(
        robot,
        runs,
        FinalPose(Options()),
        make_parameterisation(parameterisation, robot, runs, box="paper" if fixed else "row", limits=limits),
        integration="arc",
        budget=Budget(evaluations=evaluations, seconds=seconds),
        seed=seed,
        undefined=undefined,
    )
