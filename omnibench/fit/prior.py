"""Prior knowledge of a matrix: its design, and by how much robots of a class are off theirs before they were driven.

With independent normal numbers of mean 0 the matrix is K0 + D with

    D_ij = K0_ij (c_j + g_i) + s_i e_ij + (rotations and shifts below).                             (1)

c_j: the radius of the wheel of column j, which stretches all of the column. g_i: what shortens a whole motion, such as
rollers that slip (rows 1 and 2) or tyres that scrub in a turn (row 3). s_i e_ij, s_i being the row's largest element:
all else. A driven wheel that is steered
by a measured angle has two columns, (omega cos phi, omega sin phi), which share its radius and which the offset a of
the angle turns into each other:

    D = a K0 [0 -1; 1 0] on these two.                                                              (2)

Where the tracked point of a robot is not known, it stands at (x, y) from where the robot says, and looks
into the direction b: the rows of x and y change by

    D_1 = -y K0_3 + b K0_2,    D_2 = x K0_3 - b K0_1.                                               (3)

A skid-steered base turns about a point (x, y) that is not its middle and is shifted by load and ground: Eq. (3) with
b = 0. Every wheel that turns loses the rate -d (effect ``wheel_dead_zone``), d being normal, too.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from omnibench.robot.kinematics import Array, Robot, RobotClass, class_of
from omnibench.robot.physical import STEERING_ZERO, TRACKED_POINT, TRACKED_YAW, TURNING_CENTRE, PhysicalTolerance
from omnibench.robot.physical import physical_tolerance as physical_tolerance

MountChoice = Literal["known", "fit"]
_NUMBERS_EACH = 2  # measured ones for each that is fitted; chosen
# The tracked point of these stands in front of the rear axle, which is the robot's centre, and is seldom known as well
# as the middle of a body is.
_UNKNOWN_MOUNTS: frozenset[RobotClass] = frozenset({"tricycle", "car"})


def changes_by_centre(robot: Robot) -> Array:
    """Derivatives (2, 3, M) of the matrix by the x and the y of the point that turns on the spot, 1/m: Eq. (3)."""
    turning = robot.inverse_kinematic_matrix[2]
    still = np.zeros_like(turning)
    return np.array([[still, turning, still], [-turning, still, still]])


def default_cost(robot: Robot, runs: int) -> Literal["final_pose", "trajectory"]:
    """The cost where none is given: Eq. (6); the whole trajectory for robots whose wheels say their types, of few runs.

    A final pose is three numbers. A fit of nearly as many passes through them, and through the slip of single runs.
    """
    rows = 3 if robot.slides or default_mount(robot) == "fit" else len(robot.motions)
    few = 3 * runs < _NUMBERS_EACH * rows * len(robot.drive.names)
    # Files did not say the types of wheels before omnibench knew others than omni.
    return "trajectory" if few and any(wheel.type is not None for wheel in robot.wheels) else "final_pose"


def default_mount(robot: Robot) -> MountChoice:
    """Default treatment of the tracked point: fitted on a tricycle and on a car, else where the robot says."""
    return "fit" if class_of(robot) in _UNKNOWN_MOUNTS else "known"


def off_centre(robot: Robot) -> bool:
    """True if the prior lets the tracked point stand off the centre both ways; a skid-steered base's centre wanders."""
    return robot.slides and not robot.skid


def mount_is_fitted(robot: Robot, mount: MountChoice | None, *, by_prior: bool) -> bool:
    """True if the place of the tracked point is among what a fit tells: as asked for, or as is usual for the robot.

    by_prior: the fit weighs the class's own prior, see ``off_centre``.
    """
    usual = "fit" if by_prior and off_centre(robot) else default_mount(robot)
    return (mount or usual) == "fit"


def physical_prior_root(robot: Robot, tolerance: PhysicalTolerance, mount: MountChoice | None = None) -> Array:
    """A root (3M, k) of the covariance of the matrix elements, row by row, about the design: Eq. (1) to (3).

    mount: whether the tracked point may stand elsewhere. None: it may, but of a robot that its fixed wheels keep from
    sliding to the side alone (a point ahead of the axle would slide), unless ``default_mount`` fits it.
    """
    design, scales = robot.inverse_kinematic_matrix, robot.row_scales
    # The wheel (M,) whose radius stretches each column; a car's mean, tangent and difference share one.
    if robot.drive.direct:
        columns = np.arange(design.shape[1])
    else:
        of_pairs = [wheel for wheel, pair in enumerate(robot.drive.pairs) for _ in range(1 if pair < 0 else 2)]
        columns = np.array(of_pairs if len(of_pairs) == design.shape[1] else [0] * design.shape[1])
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
    if robot.skid:
        roots += [*(TURNING_CENTRE * changes_by_centre(robot))]
    ahead, aside = TRACKED_POINT * changes_by_centre(robot)
    fitted = (mount or default_mount(robot)) == "fit"
    if fitted or (mount is None and off_centre(robot)):
        roots += [ahead, aside]
    elif mount is None and not robot.skid:
        roots += [aside]
    if fitted and not robot.slides:
        x, y, still = design[0], design[1], np.zeros(design.shape[1])
        roots += [TRACKED_YAW * np.array([y, -x, still])]
    return np.array([root.ravel() for root in roots]).T
