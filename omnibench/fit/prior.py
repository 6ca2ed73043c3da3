"""Prior knowledge of a matrix: its design, and by how much robots of a class are off theirs.

With the design K0 and the largest element s_i of its row i, the elements of a robot's matrix are

    k_ij = k0_ij (1 + g_i) + s_i e_ij                                                             (1)

with independent normal e_ij, for wheels that are not as drawn, and g_i, for what shortens a whole motion: rollers that
slip, tyres that skid in a turn. A skid-steered base turns about a point (x, y) that is not its middle: by its rates of
turn, in row 3, the rows of x and y change by

    D_1 = -y K0_3,    D_2 = x K0_3.                                                               (2)

The physical prior of a matrix, and of the rate that its wheels lose, is what is known of a robot before it has been
driven. With independent normal numbers of mean 0 the matrix is K0 + D with

    D_ij = K0_ij (c_j + g_i) + s_i e_ij + (rotations and shifts below).                             (3)

c_j: the radius of the wheel of column j, which stretches all of the column. g_i: what shortens a whole motion, such as
rollers that slip (rows 1 and 2) or tyres that scrub in a turn (row 3). e_ij: all else. A driven wheel that is steered
by a measured angle has two columns, (omega cos phi, omega sin phi), which share its radius and which the offset a of
the angle turns into each other:

    D = a K0 [0 -1; 1 0] on these two.                                                              (4)

Where the tracked point of a robot is not known, it stands at (x, y) from where the robot says, and looks
into the direction b: the rows of x and y change by

    D_1 = -y K0_3 + b K0_2,    D_2 = x K0_3 - b K0_1.                                               (5)

Every wheel that turns loses the rate -d (effect ``wheel_dead_zone``), d being normal, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from omnibench.robot.geometry import STEERING_ZERO, TRACKED_POINT, TRACKED_YAW, PhysicalTolerance
from omnibench.robot.geometry import physical_tolerance as physical_tolerance
from omnibench.robot.kinematics import Array, Robot, RobotClass, class_of

MountChoice = Literal["known", "fit"]
_NUMBERS_EACH = 2  # measured ones for each that is fitted; chosen
# The tracked point of these stands in front of the rear axle, which is the robot's centre, and is seldom known as well
# as the middle of a body is.
_UNKNOWN_MOUNTS: frozenset[RobotClass] = frozenset({"tricycle", "car"})


@dataclass(frozen=True)
class Tolerance:
    """Standard deviations: of every element (e, share of the row's largest) and of each row's factor (g), Eq. (1).

    centre: of the x and y of the centre of turning, m, Eq. (2).
    """

    elements: float
    rows: tuple[float, float, float] = (0.0, 0.0, 0.0)
    centre: float = 0.0


# Radius and place of a wheel are known to 1 or 2 %. What all wheels share is known less well: the load on tyres, which
# changes their radii, and the track on which they turn (Borenstein and Feng, IEEE T-RA 12:869, 1996, sections 2 and 3).
# Rollers lose or gain some per cent of a motion, 8 on the mecanum base of OptiOdom; a skid-steered base turns by 0.5 to
# 0.8 of what its track says (Mandow et al., IROS 2007), about a centre that load and ground shift by some cm. If
# the centre is taken for known, only 80 % of the 95 % intervals of a skid base's turn hold the truth
# (tests/studies/shrink_coverage.py). tests/studies/shrink_study.py fits with half and twice these tolerances.
_USUAL = Tolerance(0.02, (0.05, 0.05, 0.05))
TOLERANCES: Mapping[RobotClass, Tolerance] = MappingProxyType(
    {
        "differential": _USUAL,
        "tricycle": _USUAL,
        "car": _USUAL,
        "swerve": _USUAL,
        "omni": _USUAL,
        "mecanum": Tolerance(0.02, (0.06, 0.06, 0.06)),
        "skid": Tolerance(0.02, (0.05, 0.05, 0.2), centre=0.05),
        "mixed": _USUAL,
    }
)


def tolerance_of(robot: Robot, elements: float | None = None) -> Tolerance:
    """The tolerance of a robot's class; elements: another share for the elements, and nothing else is off."""
    return TOLERANCES[class_of(robot)] if elements is None else Tolerance(elements)


def prior_root(robot: Robot, tolerance: Tolerance) -> Array:
    """A root (3M, k) of the covariance of the matrix elements, row by row, about the design: Eq. (1) and (2)."""
    design = robot.inverse_kinematic_matrix
    elements = np.diag(np.repeat(tolerance.elements * robot.row_scales, design.shape[1]))
    rows = [share * (np.eye(3)[:, [row]] * design).ravel() for row, share in enumerate(tolerance.rows)]
    centre = tolerance.centre * changes_by_centre(robot).reshape(2, -1)
    return np.column_stack([elements, *rows, *centre])


def changes_by_centre(robot: Robot) -> Array:
    """Derivatives (2, 3, M) of the matrix by the x and the y of the point that turns on the spot, 1/m: Eq. (2)."""
    turning = robot.inverse_kinematic_matrix[2]
    still = np.zeros_like(turning)
    return np.array([[still, turning, still], [-turning, still, still]])


def default_unidentified(robot: Robot) -> Literal["keep", "shrink"]:
    """The treatment of what data hardly drive: shrunk for robots whose wheels say their types, else kept as ever.

    On omni wheels all is kept: a matrix fitted to the circles of OptiOdom's omni3 and shrunk errs by 0.20 m on its
    squares, in the place of 0.10 m (tests/studies/shrink_study.py). Its runs differ by more than the matrix can say,
    and what they say of one row hangs on the others.
    """
    return "shrink" if says_types(robot) and class_of(robot) != "omni" else "keep"


def says_types(robot: Robot) -> bool:
    """True if a wheel of the robot says its type, as files did not before wheels had types."""
    return any(wheel.type is not None for wheel in robot.wheels)


def default_cost(robot: Robot, runs: int) -> Literal["final_pose", "trajectory"]:
    """The cost where none is given: Eq. (6); the whole trajectory for robots whose wheels say their types, of few runs.

    A final pose is three numbers. A fit of nearly as many passes through them, and through the slip of single runs.
    """
    rows = 3 if robot.slides or default_mount(robot) == "fit" else len(robot.motions)
    few = 3 * runs < _NUMBERS_EACH * rows * len(robot.drive.names)
    return "trajectory" if few and says_types(robot) else "final_pose"


def default_mount(robot: Robot) -> MountChoice:
    """Default treatment of the tracked point: fitted on a tricycle and on a car, else where the robot says."""
    return "fit" if class_of(robot) in _UNKNOWN_MOUNTS else "known"


def physical_prior_root(robot: Robot, tolerance: PhysicalTolerance) -> Array:
    """A root (3M, k) of the covariance of the matrix elements, row by row, about the design: Eq. (3) to (5).

    Rows that no wheel drives (the sideways one of a robot that cannot slide) move with the tracked point alone.
    """
    design, scales = robot.inverse_kinematic_matrix, robot.row_scales
    columns = _wheels_of_columns(robot)
    roots = [design * np.isin(columns, wheel) * tolerance.radius for wheel in np.unique(columns)]
    roots += [design * np.eye(3)[:, [row]] * share for row, share in enumerate(tolerance.rows)]
    for row in np.flatnonzero(np.abs(design).sum(axis=1) > 0):
        for column in range(design.shape[1]):
            root = np.zeros_like(design)
            root[row, column] = scales[row] * tolerance.elements
            roots.append(root)
    for wheel in np.unique(columns) if class_of(robot) != "car" else ():
        pair = np.flatnonzero(columns == wheel)
        if len(pair) == 2:  # the wheel steers: an offset of 1 rad turns its columns
            turned = np.zeros_like(design)
            turned[:, pair] = design[:, pair] @ np.array([[0.0, -1.0], [1.0, 0.0]])
            roots.append(turned * STEERING_ZERO)
    if default_mount(robot) == "fit" and not robot.slides:
        x, y, _ = design
        roots += [*(TRACKED_POINT * changes_by_centre(robot)), TRACKED_YAW * np.array([y, -x, np.zeros_like(x)])]
    return np.array([root.ravel() for root in roots]).T


def _wheels_of_columns(robot: Robot) -> NDArray[np.intp]:
    """The wheel (M,) whose radius stretches each column; a car's columns share one."""
    drive = robot.drive
    if drive.direct:
        return np.arange(len(drive.names), dtype=np.intp)
    if len(drive.names) != sum(1 if pair < 0 else 2 for pair in drive.pairs):  # a car's mean, tangent and difference
        return np.zeros(len(drive.names), dtype=np.intp)
    wheels = [wheel for wheel, pair in enumerate(drive.pairs) for _ in range(1 if pair < 0 else 2)]
    return np.array(wheels, dtype=np.intp)
