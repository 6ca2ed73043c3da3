"""UMBmark: the two systematic errors of a differential drive from closed squares that are driven both ways.

J. Borenstein, L. Feng, "Measurement and correction of systematic odometry errors in mobile robots", IEEE Transactions
on Robotics and Automation 12:869-880 (1996). A robot drives a square of side L from a corner along its x axis,
clockwise (cw) and counter-clockwise (ccw). Let x be the end of the true path less that of the odometry, in the frame of
the start pose, and x_cw, x_ccw (m) its means over the squares of each way. To first order an error of the wheelbase
turns the robot too little by alpha (rad) at each corner, and unequal wheels by beta (rad) along each side:

    alpha = (x_cw + x_ccw) / (-4 L),    beta = (x_cw - x_ccw) / (-4 L).                                 (1)

The true wheelbase b is that of the design, b_0, times

    E_b = (pi/2) / (pi/2 - alpha),    b = E_b b_0,                                                   (2)

and a side that bends by beta is an arc of radius R, from which follows the ratio of the right wheel's diameter to the
left one's,

    R = (L/2) / sin(beta/2),    E_d = (R + b/2) / (R - b/2).                                           (3)

With the mean diameter D kept, which squares do not show, the diameters of the wheels are

    D_right = 2 D / (1 + 1/E_d),    D_left = 2 D / (1 + E_d).                                          (4)

The article itself was not at hand. Formulas (1) to (4) are those that the authors of OptiOdom (J. Intell. Robot. Syst.
105:39, 2022) use for it. Reconstructed here, and not the article's own:

- b in (3) is that of (2), as in OptiOdom; b_0 would change E_d - 1 by the share E_b - 1 of itself;
- the odometry is that of the design matrix on the recorded wheel rates, and L a quarter of the way that it measures;
- where the wheels' design diameters differ, (4) multiplies each of them, and E_d is the ratio of these factors;
- a tracked point off the axle's middle is taken there by its design pose before anything is measured;
- a run counts as a square if its odometry stands at the corners of one after each quarter of its way.

It is for two measured wheels on one axle (m, rad, SI throughout), for runs of one session, and uses the squares among
these. The formulas are of first order: a true E_b of 1.03 with E_d = 0.98 comes out as 1.024 and 0.983.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omnibench.data.dataset import Trajectory
from omnibench.errors import ConfigError, NotApplicableError
from omnibench.fit.calibrator import Calibrator, Solution
from omnibench.fit.problem import CalibrationProblem
from omnibench.registry import calibrators
from omnibench.robot.kinematics import Array, Mount, Robot
from omnibench.robot.model import OdometryModel
from omnibench.robot.planar import compose, interpolated, relative, rotated
from omnibench.robot.robot_class import class_of
from omnibench.words import plural

_OFF_CORNER = 0.15  # share of the side: farthest of a square's odometry from its corners; a circle's is 1 (chosen)
_OFF_TURN = 0.5  # rad by which the odometry's whole turn may be off one (chosen: 7 degrees at each corner)


@dataclass(frozen=True)
class Square:
    """A square that was driven.

    side: m. way: 1 counter-clockwise, -1 clockwise. error (3,): true final pose less the odometry's, m, m, rad.
    """

    side: float
    way: int
    error: Array


@calibrators.register("umbmark")
class Umbmark(Calibrator):
    """UMBmark (Borenstein and Feng 1996): wheelbase and wheels from the ends of squares driven both ways."""

    bounded = False
    as_is = True
    stochastic = False
    per_session = True
    only_for = "differential drives with two measured wheels"

    def applies(self, robot: Robot) -> bool:
        return class_of(robot) == "differential" and len(robot.measured) == 2

    def calibrate(self, problem: CalibrationProblem) -> Solution:
        """Formulas (1) to (4). NotApplicableError: there are no squares, or they were driven one way only."""
        if problem.parameterisation.name != "matrix":
            raise ConfigError("umbmark gives a matrix; say parameterisation: matrix")
        squares = squares_of(problem)
        clockwise = [square for square in squares if square.way < 0]
        counter = [square for square in squares if square.way > 0]
        if not clockwise or not counter:
            count = f"{plural(len(squares), 'square')} among {plural(len(problem.trajectories), 'run')}"
            which = (
                f"{count}, none clockwise" if counter else f"{count}, none counter-clockwise" if clockwise else "none"
            )
            raise NotApplicableError(f"it is for closed squares driven both ways from a corner (found: {which})")
        side = float(np.mean([square.side for square in squares]))
        axle = _axle(problem.robot)
        wheelbase, diameters = errors_of(_mean_x(clockwise), _mean_x(counter), side, axle)
        corrected = corrected_robot(problem.robot, wheelbase, diameters)
        left, right = _left_and_right(corrected)
        return Solution(
            corrected.inverse_kinematic_matrix.ravel(),
            f"wheelbase {1000 * _axle(corrected):.1f} mm (E_b {wheelbase:.4f}), radii {left} and {right} mm "
            f"(E_d {diameters:.4f}), from {len(clockwise)} clockwise and {len(counter)} counter-clockwise squares of "
            f"{side:.2f} m",
        )


def errors_of(x_clockwise: float, x_counter: float, side: float, axle: float) -> tuple[float, float]:
    """E_b and E_d of the mean x errors (m) of squares of a side (m) and the design wheelbase (m)."""
    alpha = (x_clockwise + x_counter) / (-4 * side)  # Eq. (1)
    beta = (x_clockwise - x_counter) / (-4 * side)
    wheelbase = (math.pi / 2) / (math.pi / 2 - alpha)  # Eq. (2)
    bend = wheelbase * axle * math.sin(beta / 2) / side  # b/2 over R, which is infinite where beta is 0
    return wheelbase, (1 + bend) / (1 - bend)  # Eq. (3)


def corrected_robot(robot: Robot, wheelbase: float, diameters: float) -> Robot:
    """The robot with its axle E_b times as long and wheels of the diameter ratio E_d, Eq. (4)."""
    sides = _sides(robot)
    middle = _middle(robot)[:2]
    share = {wheel.name: 2 / (1 + diameters ** np.sign(sides[wheel.name])) for wheel in robot.measured}
    wheels = []
    for wheel in robot.wheels:
        if wheel.name not in share:
            wheels.append(wheel)
            continue
        x, y = (middle + wheelbase * (np.array(wheel.position) - middle)).tolist()
        wheels.append(wheel.model_copy(update={"radius": float(wheel.radius * share[wheel.name]), "x": x, "y": y}))
    return robot.model_copy(update={"wheels": tuple(wheels)})


def squares_of(problem: CalibrationProblem) -> list[Square]:
    """The closed squares among the training runs, by the odometry of the design."""
    runs = [run for run in problem.trajectories if run.has_poses]
    stamps = [np.append(run.times[run.times < run.end], run.end) for run in runs]
    model = OdometryModel.of_design(problem.robot, problem.integration)
    paths = model.poses([run.log(np.append(0.0, times)) for run, times in zip(runs, stamps, strict=True)])
    squares = [_square(problem.robot, run, path) for run, path in zip(runs, paths, strict=True)]
    return [square for square in squares if square is not None]


def _square(robot: Robot, run: Trajectory, path: Array) -> Square | None:
    """A run as a square; None if its odometry (K, 3) from the start to the last reference pose is none."""
    odometry = _of_axle(robot, path)
    odometry = relative(odometry[0], odometry)
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(odometry[:, :2], axis=0).T)))
    side, way = driven[-1] / 4, int(np.sign(odometry[-1, 2]))
    corners = np.array([[1.0, 0.0], [1.0, way], [0.0, way], [0.0, 0.0]])
    off = interpolated(side * np.arange(1, 5), driven, odometry[:, :2]) - side * corners
    if np.hypot(*off.T).max() > _OFF_CORNER * side or abs(abs(odometry[-1, 2]) - 2 * math.pi) > _OFF_TURN:
        return None
    truth = _of_axle(robot, run.poses[[0, -1]])
    return Square(float(side), way, relative(truth[0], truth[1]) - odometry[-1])


def _mean_x(squares: Sequence[Square]) -> float:
    return float(np.mean([square.error[0] for square in squares]))


def _middle(robot: Robot) -> Array:
    """Pose (3,) of the axle's middle in the robot's frame, looking ahead; m, m, rad."""
    ahead = robot.motions[0]
    places = np.mean([wheel.position for wheel in robot.measured], axis=0)
    return np.array([*places, math.atan2(ahead[1], ahead[0])])


def _of_axle(robot: Robot, poses: Array) -> Array:
    """Poses (K, 3) of the axle's middle, from those of the tracked point."""
    mount = robot.mount or Mount()
    return compose(poses, relative(np.array([mount.x, mount.y, mount.yaw]), _middle(robot)))


def _sides(robot: Robot) -> dict[str, float]:
    """Distance of each measured wheel to the left of the axle's middle, m."""
    middle = _middle(robot)
    return {
        wheel.name: float(rotated(np.array(wheel.position) - middle[:2], -middle[2])[1]) for wheel in robot.measured
    }


def _axle(robot: Robot) -> float:
    """Distance of the two wheels, m."""
    return sum(abs(side) for side in _sides(robot).values())


def _left_and_right(robot: Robot) -> tuple[str, str]:
    """Name and radius, mm, of the left wheel and of the right one."""
    sides = _sides(robot)
    left, right = sorted(robot.measured, key=lambda wheel: -sides[wheel.name])
    return f"{left.name} {1000 * left.radius:.3f}", f"{right.name} {1000 * right.radius:.3f}"
