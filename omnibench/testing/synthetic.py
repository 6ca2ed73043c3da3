"""A small calibration problem with a known answer: noise-free recordings of a robot that differs from its design."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle, product
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from omnibench.data.dataset import Dataset, Trajectory, make_dataset
from omnibench.fit.cost import FinalPose
from omnibench.fit.evaluator import RunsEvaluator
from omnibench.fit.geometry import GeometryLimits
from omnibench.fit.parameterisation import ParameterisationName
from omnibench.fit.problem import Budget, BudgetSpent, CalibrationProblem, make_parameterisation
from omnibench.registry import Options
from omnibench.robot.kinematics import Array, CarDrive, Robot, Wheel, WheelType, class_of, wheel_equations
from omnibench.robot.model import OdometryModel
from omnibench.robot.odometry import Integration, WheelLog

PERIOD = 0.2  # s between wheel samples
_SAMPLES = 20  # wheel samples of a run
_SPEED = 0.25  # m/s
# True radii and distances as shares of the design values. One factor for all distances keeps zeros of the matrix zero,
# so that the answer lies in every box that omnibench offers.
_RADII = (1.04, 0.97, 1.02, 0.99)
_DISTANCE = 1.06
# The same of robots on fixed and steered wheels. They are milder: methods for these take errors as small.
_WHEELED_RADII = (1.012, 0.992, 1.004, 0.996)
_WHEELED_PLACE = 1.03
_STRAIGHT, _QUARTER, _HALF = 19, 11, 23  # wheel samples of a metre, a quarter and a half turn; one before each stands
_SECOND_START = (0.4, -0.3, 0.8)  # m, m, rad: start of the second repetition
Leg = tuple[tuple[float, float, float], int]  # metres ahead and to the left and rad to the left, in so many samples
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


def synthetic_robots() -> tuple[Robot, ...]:
    """Robots on omni and mecanum wheels, and others on fixed and steered ones."""
    return synthetic_robot(3), synthetic_robot(4), *synthetic_wheeled_robots()


def _on_rollers(robot: Robot) -> bool:
    return all(wheel.kind in ("omni", "mecanum") for wheel in robot.wheels)


def true_robot(robot: Robot) -> Robot:
    """The true robot: radii 3 % below to 4 % above the design, distances 6 % above.

    On fixed and steered wheels: radii 0.8 % below to 1.2 % above the design, distances 3 % above.
    """
    on_rollers, wheels = _on_rollers(robot), []
    for wheel, share in zip(robot.wheels, cycle(_RADII if on_rollers else _WHEELED_RADII), strict=False):
        changed = {"radius": wheel.radius * share}
        if on_rollers:
            changed["distance"] = wheel.lever * _DISTANCE
        else:
            changed["x"], changed["y"] = (_WHEELED_PLACE * value for value in wheel.position)
        wheels.append(wheel.model_copy(update=changed))
    return robot.model_copy(update={"wheels": tuple(wheels)})


def synthetic_trajectories(robot: Robot, integration: Integration = "arc") -> tuple[Trajectory, ...]:
    """Runs of the true robot that is driven by its design; reference poses every 0.8 s, exact.

    Robots on omni and mecanum wheels: twelve of 4 s, four directions, straight and turning either way. Others: two
    repetitions of each motion that they can make; see ``synthetic_motions``.
    """
    model = OdometryModel(robot, true_robot(robot).inverse_kinematic_matrix, integration)
    runs: list[Trajectory] = []
    if _on_rollers(robot):
        for direction, turn in product((0.2, 1.8, 3.3, 4.9), (-0.4, 0.0, 0.4)):
            twist = np.array([_SPEED * math.cos(direction), _SPEED * math.sin(direction), turn])
            rates = np.tile(wheel_equations(robot.wheels) @ twist, (_SAMPLES, 1))
            runs.append(_recorded(model, len(runs) + 1, rates, np.zeros(3)))
        return tuple(runs)
    for command, legs in synthetic_motions(robot).items():
        parts = [_commanded(robot, *leg) for leg in legs]
        rates = np.concatenate([rates for rates, _ in parts])
        steering = None if robot.drive.direct else np.concatenate([angles for _, angles in parts])
        for repetition, start in enumerate((np.zeros(3), np.array(_SECOND_START)), start=1):
            more = {"command": command, "repetition": repetition, "steering": steering}
            runs.append(_recorded(model, len(runs) + 1, rates, start, **more))
    return tuple(runs)


def _recorded(model: OdometryModel, number: int, rates: Array, start: Array, **more: Any) -> Trajectory:
    """The recording of a run with wheel rates (F, N) from a start pose (3,). more: further fields of it."""
    times: Array = PERIOD * np.arange(1, len(rates) + 1)
    stamps = np.append(0.0, times[3::4])
    drive = None if model.robot.drive.direct else model.robot.drive
    log = WheelLog(times, rates, start, stamps, steering=more.get("steering"), drive=drive)
    return Trajectory(f"{number:02d}", "train", times, rates, stamps, model.poses([log])[0], drive=drive, **more)


def synthetic_motions(robot: Robot) -> dict[str, tuple[Leg, ...]]:
    """Legs of every motion that a robot on fixed or steered wheels is driven through, by the motion's name.

    Straight lines both ways and curves; of a robot other than a car also turns on the spot and closed squares of 1 m,
    both ways; of one that can move aside that, too.
    """
    curves = {"curve": 0.6, "tight curve": 1.4}  # rad to a metre
    motions: dict[str, tuple[Leg, ...]] = {
        "forward": (((1.0, 0.0, 0.0), _STRAIGHT),),
        "backward": (((-1.0, 0.0, 0.0), _STRAIGHT),),
    }
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for name, turn in curves.items():
            motions[f"{name} {side}"] = (((1.0, 0.0, sign * turn), _STRAIGHT),)
        if class_of(robot) == "car":
            continue
        motions[f"turn {side}"] = (((0.0, 0.0, sign * math.pi), _HALF),)
        motions[f"square {side}"] = 4 * (((1.0, 0.0, 0.0), _STRAIGHT), ((0.0, 0.0, sign * math.pi / 2), _QUARTER))
        if len(robot.motions) == 3:
            motions[f"aside {side}"] = (((0.0, sign, 0.0), _STRAIGHT),)
    return motions


def _commanded(robot: Robot, motion: tuple[float, float, float], samples: int) -> tuple[Array, Array]:
    """Wheel rates (samples + 1, N) and steering angles (samples + 1, S) of a leg, before which the robot steers."""
    twist = np.array(motion) / (samples * PERIOD)
    rates, steering = robot.drive.commands((robot.signal_equations @ twist)[None])
    if not isinstance(robot.drive, CarDrive):  # a wheel rolls backwards rather than be steered by more than a quarter
        back = np.abs(steering) > math.pi / 2 + 1e-9
        steering = np.where(back, steering - np.copysign(math.pi, steering), steering)
        for wheel, pair in enumerate(robot.drive.pairs):
            rates[:, wheel] *= -1.0 if pair >= 0 and back[0, pair] else 1.0
    standing = np.zeros_like(rates)
    return np.vstack([standing, np.repeat(rates, samples, axis=0)]), np.repeat(steering, samples + 1, axis=0)


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

    def cost(self, candidates: Array) -> Array:
        """Costs (P,) as in every problem; records candidates outside the box and refused calls."""
        vectors = np.array(candidates, dtype=float, ndmin=2)
        if vectors.shape[1:] == self.start.shape:
            self.strays.extend(vectors[np.logical_not(self.inside(vectors))])
        if self.refusals > _PATIENCE:
            raise Runaway
        try:
            return super().cost(vectors)
        except BudgetSpent:
            self.refusals += 1
            raise

    def values(self, candidates: Array) -> Array:
        """Costs (P,) as in every problem; records how many."""
        self.uncounted += len(candidates)
        return super().values(candidates)

    def _costs(self, candidates: Array, evaluator: RunsEvaluator | None) -> Array:
        """Costs (P,) as in every problem, but NaN where the cost is undefined."""
        costs = super()._costs(candidates, evaluator)
        if self._undefined is not None:
            costs[self._undefined(self.to_unit(candidates))] = np.nan
        return costs


def synthetic_problem(
    parameterisation: ParameterisationName = "matrix",
    *,
    robot: Robot | None = None,
    wheels: Literal[3, 4] = 3,
    fixed: bool = False,
    seed: int = 0,
    evaluations: int = 2_000,
    seconds: float = 600.0,
    undefined: Callable[[Array], NDArray[np.bool_]] | None = None,
    trajectories: Sequence[Trajectory] | None = None,
) -> ObservedProblem:
    """The problem of Eq. (6) of Palacin et al. 2023 on the recordings; its least cost is 0, up to rounding.

    robot: default: the synthetic robot on ``wheels`` omni or mecanum wheels.
    fixed: use a box that fixes some elements (zeros of the matrix, or the wheels' angles).
    """
    robot = robot or synthetic_robot(wheels)
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
