"""The controller of ros2_controllers for a robot, with the parameters that come closest to its calibration.

``controller`` takes the controller of the robot's kind and computes its parameters in closed form; the equations stand
at each. ``warnings_of`` says what the controller cannot hold of the calibration.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from omnibench.errors import ConfigError
from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array, CarDrive, Mount, Robot
from omnibench.robot.paths import legs_of, usual_paths, wheel_log

_STEPS = {"arc": "arcs", "euler": "Euler steps"}
_WRONG_WAY = "ros2_controllers: the matrix does not drive this robot ahead and turn it counter-clockwise; check "
_NO_TURN = "ros2_controllers: the matrix does not turn this robot counter-clockwise; check wheel signs"
_PLACE = "x {:.4f} m, y {:.4f} m of the robot's centre"
_TAKES_END = "the controller takes the steering angle at a sample's end, the calibration in its middle"

# All chosen.
_NEGLIGIBLE = 1e-4  # m: a base frame so near to where it should be is there
_ALONG = math.cos(math.radians(10))  # of the largest angle to the robot's x axis
_ALIKE = 1e-3  # m, by which wheels may stand off where the controller has them
_SPACING_TOLERANCE = math.radians(10)  # rad, largest deviation from equal spacing
_STRAIGHT = math.radians(0.01)  # rad per m, of straight driving
_WORTH_IT = 0.5  # of the heading error in straight driving: an offset that leaves more is not noted

# Of the wheels of mecanum_drive_controller in its order: signs in a, b and c of Eq. (5).
_CORNERS = {
    "front_left": (1, -1, -1),
    "rear_left": (1, 1, -1),
    "rear_right": (1, -1, 1),
    "front_right": (1, 1, 1),
}


@dataclass(frozen=True, eq=False)
class Controller:
    """A controller whose parameters come closest to a matrix.

    values: of the parameters, by their names, numbers and names of joints. matrix (3, M): the inverse kinematic matrix
    by which it computes the twist of its base frame. base: that frame in the robot's. holds: what stands for the
    matrix, in words, and lost: what that costs. joints: parameters that name joints, in words. notes: what else to do
    or to know. integration: how it integrates a twist. topic: of its odometry. lever: True if what is left where the
    robot turns on the spot is the lever arm of a frame that is not at its base.
    """

    name: str
    values: Mapping[str, float | str | Sequence[str]]
    matrix: Array
    holds: str
    joints: str
    lost: str = ""
    notes: tuple[str, ...] = ()
    base: Mount = field(default_factory=Mount)
    integration: str = "arcs"
    topic: str = "odom"
    lever: bool = True


@dataclass(frozen=True)
class RemainingError:
    """Odometry error of a matrix against another, in the worst direction of straight driving and on the spot."""

    straight_position: float  # m per m
    straight_heading: float  # rad per m
    turn_position: float  # m per rad
    turn_heading: float  # rad per rad

    def __str__(self) -> str:
        return (
            f"{1000 * self.straight_position:.1f} mm and {math.degrees(self.straight_heading):.2f} deg a metre, "
            f"{math.degrees(self.turn_heading * 2 * math.pi):.1f} deg and {2000 * math.pi * self.turn_position:.1f} mm "
            "a full turn"
        )


def controller(robot: Robot, matrix: Array) -> Controller:
    """The controller of a robot, closest to a matrix (3, M) of its tracked point. ConfigError: there is none."""
    matrix = of_centre(robot, matrix)
    kinds = {wheel.kind for wheel in robot.measured}
    if isinstance(robot.drive, CarDrive):
        return car(robot, robot.drive, matrix)
    if "steered" in kinds:
        return tricycle(robot, matrix)
    if "fixed" in kinds:
        return diff_drive(robot, matrix)
    return mecanum_drive(robot, matrix) if "mecanum" in kinds else omni_wheel_drive(robot, matrix)


def warnings_of(calibration: Calibration, fitted: Controller, design: Controller) -> tuple[str, ...]:
    """Warnings of what the controller cannot hold. design: the same controller for the design values."""
    robot, base = calibration.robot, fitted.base
    true = base.twist @ of_centre(robot, calibration.matrix_without_effects)
    remaining = remaining_error(robot, fitted.matrix, true, base)
    by_design = remaining_error(robot, design.matrix, true, base)
    warnings = [
        f"{fitted.holds} stand for the whole matrix{fitted.lost}",
        f"that leaves up to {remaining}; with the design values it would be {by_design}",
        *fitted.notes,
        f"{fitted.joints} are made up from the calibration's wheels: put in the joints of your URDF, in this order",
    ]
    integrated = _STEPS[calibration.integration]
    if integrated != fitted.integration:
        warnings.append(f"the matrix was calibrated for {integrated}, the controller integrates {fitted.integration}")
    if calibration.effects:
        # By how much a live node's odometry, which has the effects, differs
        whole = calibration.model
        plain = replace(whole, matrix=calibration.matrix_without_effects, terms=(), fade=None)
        differences, words = [], {"straight 1.0": "a metre ahead", "turn 360": "a turn"}
        for path in usual_paths(robot)[:-1]:  # the square has no motion that is new
            log = wheel_log(calibration, legs_of(path, robot))
            x, y, heading = (whole.poses([log])[0][-1] - plain.poses([log])[0][-1]).tolist()
            way, turn = 1e3 * math.hypot(x, y), math.degrees(abs(heading))
            differences.append(f"{way:.1f} mm and {turn:.2f} deg {words.get(path, path)}")
        fitted_with = "without" if calibration.plain is not None else "with"
        warnings.append(
            f"effects are left out, the matrix was fitted {fitted_with} them: {calibration.effects_in_words}; a live "
            f"node, which has them, differs by {', '.join(differences)}"
        )
    # Frames that are not the robot's centre, and a base frame that would leave less.
    if robot.mount is not None:
        warnings.append("the calibration is of the tracked point, the parameters are of the robot's centre (mount)")
    if max(abs(base.x), abs(base.y)) > _NEGLIGIBLE:
        warnings.append(
            f"base_frame_id has to be a frame at {_PLACE.format(base.x, base.y)}, in the middle of the wheels that do "
            "not steer"
        )
    to_right, ahead, _ = remaining_errors(robot, fitted.matrix, true, base)[:, -1].tolist()
    if fitted.lever and max(abs(ahead), abs(to_right)) > _NEGLIGIBLE:
        place = _PLACE.format(base.x + ahead, base.y - to_right)
        warnings.append(f"the millimetres a full turn are a lever arm: a base_frame_id at {place} would leave none")
    if robot.skid:
        warnings.append("the robot skids: the parameters are those of the floor, the load and the speeds driven")
    if calibration.noise is None:
        warnings.append("covariances are left at the controller's defaults: the calibration has no noise model")
    return tuple(warnings)


def interval_in_words(calibration: Calibration) -> str:
    """The sample period, in ms."""
    return f"{1e3 * calibration.sample_period:g} ms"


def remaining_error(robot: Robot, used: Array, true: Array, base: Mount | None = None) -> RemainingError:
    """The errors of ``remaining_errors`` in the worst direction of straight driving and on the spot."""
    errors = remaining_errors(robot, used, true, base)
    return RemainingError(
        float(np.linalg.norm(errors[:2, :-1], 2)),
        float(np.linalg.norm(errors[2, :-1])),
        float(np.linalg.norm(errors[:2, -1])),
        float(abs(errors[2, -1])),
    )


def remaining_errors(robot: Robot, used: Array, true: Array, base: Mount | None = None) -> Array:
    """Errors (3, D) in x, y and heading of odometry with the matrix L, ``used``, for a robot with K, ``true``.

    With the motions T (3, D) of a robot and its design's signal equations E (M, 3), it drives along the signals
    U = E T (M, D). The matrix K (3, M) makes of them the motions K U, of which P = T^+ takes the D coordinates; so the
    signals U (P K U)^-1 move the robot by one metre ahead, or aside, or by one radian, and L (3, M) in the place of K
    errs by

        (L - K) U (P K U)^-1.                                                                          (1)

    base: the frame of the robot that both matrices are of; default: its centre.
    """
    motions, signals = driven_motions(robot, base)
    return (used - true) @ signals @ np.linalg.inv(np.linalg.pinv(motions.T) @ true @ signals)


def as_read(robot: Robot, matrix: Array, reading: Array) -> Array:
    """The matrix (3, D) that acts on what software reads, for a matrix K (3, M) and the reading A (D, M).

    Software that reads D numbers A u of the signals u sees of K, with U as in Eq. (1), the matrix

        K U (A U)^-1.                                                                                  (2)
    """
    _, signals = driven_motions(robot)
    return matrix @ signals @ np.linalg.inv(reading @ signals)


def driven_motions(robot: Robot, base: Mount | None = None) -> tuple[Array, Array]:
    """Motions (D, 3) of a frame of a robot that it can drive, and the design's signals (M, D) for them.

    Straight by 1 m, aside where it can, too, and a turn by 1 rad: on the spot, or as nearly as it can. base: the frame;
    default: the robot's centre.
    """
    frame = (base or Mount()).twist
    motions = robot.motions @ frame.T
    turn = motions[-1] / motions[-1, 2]
    straight = motions[:-1] - np.outer(motions[:-1, 2], turn)
    straight /= np.linalg.norm(straight, axis=1, keepdims=True)
    motions = np.vstack([straight, turn - straight.T @ (straight @ turn)])
    return motions, robot.signal_equations @ np.linalg.solve(frame, motions.T)


def of_centre(robot: Robot, matrix: Array) -> Array:
    """The matrix (3, M) of a robot's centre from that of its tracked point."""
    return matrix if robot.mount is None else np.linalg.solve(robot.mount.twist, matrix)


def pose_variances(calibration: Calibration, base: Mount) -> Array | None:
    """Variances (3,) that a second adds to x, y (m2) and heading (rad2) of a frame; None without a noise model.

    A random walk of s per root second makes the mean velocity over T err by s^2 / T, independently from one interval to
    the next, and the pose by s^2 t after a time t. The tracked point walks alike in x and y; a base frame whose twist
    is F times the tracked point's walks with the covariance F diag(p^2, p^2, h^2) F^T.
    """
    noise = calibration.noise
    if noise is None:
        return None
    frame = _from_tracked(calibration, base)
    return np.diag((frame * np.square([noise.walk_position, noise.walk_position, noise.walk_heading])) @ frame.T)


def matrix_deviations(calibration: Calibration, base: Mount) -> Array | None:
    """Standard deviations (D, 3) of x, y and heading by the matrix's covariance; None where that is not known.

    One row for each of ``driven_motions``: a metre, or a radian. The matrix errs in the same way all the time: a motion
    by the signals u errs by F C(u) F^T, of which C(u)_ij = u^T cov(row i, row j) u, F as in ``pose_variances``.
    """
    if calibration.covariance is None:
        return None
    frame, count = _from_tracked(calibration, base), len(calibration.robot.drive.names)
    blocks = np.array(calibration.covariance)[: 3 * count, : 3 * count].reshape(3, count, 3, count)
    _, signals = driven_motions(calibration.robot, base)
    variances = np.einsum("ai,aj,imjn,md,nd->da", frame, frame, blocks, signals, signals, optimize=True)
    return np.sqrt(np.maximum(variances, 0.0))


def _from_tracked(calibration: Calibration, base: Mount) -> Array:
    """F (3, 3): the twist of a frame of the robot from that of the tracked point."""
    mount = calibration.robot.mount
    return base.twist if mount is None else base.twist @ np.linalg.inv(mount.twist)


def joint_name(wheel: str) -> str:
    """A made-up name of a wheel's joint."""
    return f"wheel_{wheel}_joint"


def joint_notes(backwards: list[str], unread: list[str], kind: str = "") -> tuple[str, ...]:
    """Notes on wheels whose joints turn the other way, and on those that the controller does not read."""
    notes = [f"reverse the axes of the {kind}joints of {', '.join(backwards)}"] if backwards else []
    if unread:
        notes.append(f"the controller does not read {', '.join(unread)}")
    return tuple(notes)


def diff_drive(robot: Robot, matrix: Array) -> Controller:
    """The diff_drive_controller closest to a matrix (3, N) of the robot's centre. ConfigError: none can describe it.

    With the mean rates l and r of the left and the right wheels the controller computes, at the middle between them,

        v = (R_l l + R_r r) / 2,    w = (R_r r - R_l l) / B,                                           (3)

    with R_l = left_wheel_radius_multiplier wheel_radius, R_r alike, and B = wheel_separation_multiplier
    wheel_separation (odometry.cpp and diff_drive_controller.cpp of the package, 2020 to 2026). By column k_l of a
    matrix the left wheel alone turns the robot about a point k_1l / k_3l to the left of the frame, for Eq. (3) at -B /
    2, and the right one about one k_1r / k_3r to the left, at B / 2. So B = k_1r / k_3r - k_1l / k_3l, R_l = -B k_3l
    and R_r = B k_3r hold distances and headings of rows 1 and 3 exactly, for a frame in the middle between these
    points. What is left is its lever arm, which displaces the robot where it turns and does not add up.
    """
    # The fixed wheels on the left and on the right of their middle
    fixed = np.array([index for index, wheel in enumerate(robot.measured) if wheel.kind == "fixed"])
    askew = [robot.wheel_names[index] for index in fixed if abs(math.cos(robot.measured[index].rolling)) < _ALONG]
    if askew:
        raise ConfigError(
            f"ros2_controllers: diff_drive_controller needs wheels that roll along x, and {', '.join(askew)} do not; "
            "turn the robot's frame, or use c_header"
        )
    places = np.array([wheel.position for wheel in robot.measured])
    across = places[fixed, 1]
    on_left = across > (across.max() + across.min()) / 2
    left, right = fixed[on_left], fixed[~on_left]
    if not len(left) or len(left) != len(right):
        raise ConfigError(
            "ros2_controllers: diff_drive_controller needs as many measured wheels on the left as on the right, found "
            f"{len(left)} and {len(right)}; use c_header"
        )
    forward = np.array([math.copysign(1.0, math.cos(wheel.rolling)) for wheel in robot.measured])
    reading = np.zeros((2, len(robot.measured)))
    reading[0, left], reading[1, right] = forward[left] / len(left), forward[right] / len(right)
    middles = np.array([places[left].mean(axis=0), places[right].mean(axis=0)])
    base, apart = Mount(x=middles[:, 0].mean(), y=middles[:, 1].mean()), float(middles[0, 1] - middles[1, 1])
    ahead, _, turning = base.twist @ as_read(robot, matrix, reading)
    separation = float(np.diff(ahead / turning)[0]) if turning[0] < 0 < turning[1] else 0.0
    if separation <= 0:
        raise ConfigError(f"{_WRONG_WAY}wheel signs and which wheels are on the left")
    radii = separation * turning * (-1, 1)
    by_side = np.array([[radii[0] / 2, radii[1] / 2], [0.0, 0.0], [-radii[0] / separation, radii[1] / separation]])
    read = [*left, *right]
    radius = float(robot.radii[read].mean())
    backwards = [name for index, name in enumerate(robot.wheel_names) if index in read and forward[index] < 0]
    unread = [name for index, name in enumerate(robot.wheel_names) if index not in read]
    return Controller(
        "diff_drive_controller",
        {
            "left_wheel_names": [joint_name(robot.wheel_names[index]) for index in left],
            "right_wheel_names": [joint_name(robot.wheel_names[index]) for index in right],
            "wheel_separation": apart,
            "wheel_radius": radius,
            "wheel_separation_multiplier": separation / apart,
            "left_wheel_radius_multiplier": float(radii[0] / radius),
            "right_wheel_radius_multiplier": float(radii[1] / radius),
        },
        by_side @ reading,
        "two wheel radii and one separation",
        "left_wheel_names and right_wheel_names",
        notes=joint_notes(backwards, unread),
        base=base,
    )


def car(robot: Robot, drive: CarDrive, matrix: Array) -> Controller:
    """The steering controller closest to a matrix (3, M) of a car's centre. ConfigError: none can describe it.

    With the rates l and r of the wheels that do not steer, wheel_radius R, wheelbase L, the track widths B of these
    wheels and D of the steered ones, the controllers compute, in the middle of the rear axle,

        tan phi of each steered wheel's  L tan phi_j / (L +- (D / 2) tan phi_j),  + on the left, and phi their mean,
        v = (R / 2) (l / (1 - q) + r / (1 + q)),  q = B tan phi / (2 L),    w = v tan phi / L          (4)

    (steering_kinematics.cpp of steering_controllers_library, 2025 and 2026). If the wheels roll as designed, q is what
    the rates differ by, and v = R m, w = (R / L) m tan phi with their mean m: on the signals of a car the matrix has
    the elements R and R / L and else zeros, which are the closest parameters. The calibration takes tan phi by the
    design's wheelbase L_0; the track widths of the design times L / L_0 make the controller's the same at every angle.
    """
    # The wheels of the rear axle and those that steer, from the right.
    across = [wheel.position[1] for wheel in robot.measured]
    along, beside = np.array(drive.ahead).T
    rear = [name for _, name in sorted(zip(across, drive.wheels, strict=True))]
    front = [name for _, name in sorted(zip(beside.tolist(), drive.steered, strict=True))]
    name = {
        (2, 2): "ackermann_steering_controller",
        (2, 1): "tricycle_steering_controller",
        (1, 1): "bicycle_steering_controller",
    }.get((len(rear), len(front)))
    if name is None or np.ptp(along) > _ALIKE or abs(beside.sum()) > _ALIKE:
        raise ConfigError(
            f"ros2_controllers: no controller holds a car that steers by {', '.join(drive.steered)} and measures "
            f"{', '.join(drive.wheels)} there; it needs as many on the left as on the right of them, or one and one in "
            "the middle; use c_header"
        )
    ahead = float(np.mean(along))
    x, y = np.mean([wheel.position for wheel in robot.measured], axis=0).tolist()
    base = Mount(x=x, y=y)
    reading = np.eye(2, len(drive.names)) * [[1.0], [math.copysign(1.0, ahead)]]
    seen = base.twist @ as_read(robot, matrix, reading)
    radius, turn = float(seen[0, 0]), float(seen[2, 1])
    if radius <= 0 or turn <= 0:
        raise ConfigError(f"{_WRONG_WAY}the signs of the wheels and of the steering angles")
    wheelbase = radius / turn
    share = wheelbase / abs(ahead)
    widths = {"traction_track_width": float(np.ptp(across)), "steering_track_width": float(np.ptp(beside))}
    return Controller(
        name,
        {
            "traction_joints_names": [joint_name(wheel) for wheel in rear],
            "steering_joints_names": [f"steering_{wheel}_joint" for wheel in front],
            "wheelbase": wheelbase,
            **{name: width * share for name, width in widths.items() if width},
            "traction_wheel_radius" if len(rear) == 1 else "traction_wheels_radius": radius,
        },
        np.diag([radius, 0.0, turn])[:, [0, 2]] @ reading,
        "one wheel radius and one wheelbase",
        "traction_joints_names and steering_joints_names",
        notes=(
            *joint_notes(list(drive.steered) if ahead < 0 else [], [], "steering "),
            "the parameters' names are those of ROS 2 Jazzy and later; the wheels are taken to roll as designed",
            _TAKES_END,
        ),
        base=base,
        topic="odometry",
    )


def mecanum_drive(robot: Robot, matrix: Array) -> Controller:
    """The mecanum_drive_controller closest to a matrix (3, N) of the robot's centre. ConfigError: none can describe it.

    With the rates f, g, h and j of the front left, rear left, rear right and front right wheel, and

        a = (f + g + h + j) / 4,    b = (-f + g - h + j) / 4,    c = (-f - g + h + j) / 4,             (5)

    the controller has the twist (r a, r b, (r / k) c) of the wheels' centre, r = kinematics.wheels_radius and k =
    kinematics.sum_of_robot_center_projection_on_X_Y_axis, and makes of it that of its base frame, whose pose in the
    wheels' centre is kinematics.base_frame_offset (x, y, theta) (odometry.cpp of the package, 2023 to 2026). As x + iy,
    the columns of a, b and c in rows 1 and 2 of its matrix are r e^(-i theta), i r e^(-i theta) and
    i e^(-i theta) (x + iy) r / k, and row 3 is (0, 0, r / k): so the closest parameters in the sum of squares are found
    in closed form.
    """
    # The wheel in each corner of the controller, and the sign (N,) of each wheel's rate driving forward
    equations = robot.signal_equations
    signs, found = np.sign(equations[:, 0]), dict[str, int]()
    for index, (sign, row) in enumerate(zip(signs, equations, strict=True)):
        corner = next((name for name, pattern in _CORNERS.items() if (sign * np.sign(row) == pattern).all()), None)
        if corner is not None and robot.measured[index].kind == "mecanum":
            found[corner] = index
    if len(found) < 4 or len(robot.measured) > 4:
        raise ConfigError(
            "ros2_controllers: mecanum_drive_controller needs one mecanum wheel in each corner, with rollers that form "
            f"an X or an O seen from above; {', '.join(robot.wheel_names)} do not; check roller angles, or use c_header"
        )
    wheels = {corner: found[corner] for corner in _CORNERS}
    reading = np.zeros((3, len(robot.measured)))
    for corner, index in wheels.items():
        reading[:, index] = signs[index] * np.array(_CORNERS[corner]) / 4
    seen = as_read(robot, matrix, reading)
    a, b, c = (seen[0] + 1j * seen[1]).tolist()
    along, turn = (a - 1j * b) / 2, float(seen[2, 2])
    if turn <= 0 or not along:
        raise ConfigError(_NO_TURN)
    radius, theta = abs(along), -cmath.phase(along)
    offset = c / (1j * cmath.exp(-1j * theta) * turn)
    twist = Mount(x=offset.real, y=offset.imag, yaw=theta).twist
    notes = joint_notes([name for name, sign in zip(robot.wheel_names, signs, strict=True) if sign < 0], [])
    # Wheels that do not stand where the controller's names say.
    elsewhere = []
    for corner, index in wheels.items():
        wheel = robot.measured[index]
        x, y = wheel.position
        if wheel.x is not None and (x > 0, y > 0) != (corner.startswith("front"), corner.endswith("left")):
            elsewhere.append(f"{corner} is {wheel.name}")
    if elsewhere:
        notes += (f"the rollers form an O seen from above, so that {', '.join(elsewhere)}",)
    return Controller(
        "mecanum_drive_controller",
        {
            **{corner: joint_name(robot.wheel_names[index]) for corner, index in wheels.items()},
            "kinematics.base_frame_offset.x": offset.real,
            "kinematics.base_frame_offset.y": offset.imag,
            "kinematics.base_frame_offset.theta": theta,
            "kinematics.wheels_radius": radius,
            "kinematics.sum_of_robot_center_projection_on_X_Y_axis": radius / turn,
        },
        twist @ np.diag([radius, radius, turn]) @ reading,
        "one wheel radius, one sum of distances and one pose of the base frame",
        "joint names",
        notes=notes,
        integration="every step along the heading at its end",
        topic="odometry",
    )


def omni_wheel_matrix(
    order: Sequence[int], robot_radius: float, wheel_radius: float, wheel_offset: float, clockwise: Sequence[bool] = ()
) -> Array:
    """The inverse kinematic matrix (3, N) of omni_wheel_drive_controller, columns in the robot's order.

    The controller solves, by least squares over its wheels i = 0 .. N-1, counted counter-clockwise,

        wheel_radius * omega_i = sin(t_i) vx - cos(t_i) vy - robot_radius w,    t_i = wheel_offset + 2 pi i / N     (6)

    (odometry.cpp of the package, 2025), which with omega_i negated is the wheel equation of omnibench: its positive
    rate turns the robot clockwise. order: indices of the wheels. Radii in m, offset in rad. clockwise (N,): True for a
    wheel whose positive rate turns the robot clockwise, as the controller has it; default: none.
    """
    count = len(order)
    angles = wheel_offset + 2 * np.pi * np.arange(count) / count
    matrix = np.empty((3, count))
    matrix[0, order] = -2 * wheel_radius / count * np.sin(angles)
    matrix[1, order] = 2 * wheel_radius / count * np.cos(angles)
    matrix[2, order] = wheel_radius / (count * robot_radius)
    return np.where(clockwise, -matrix, matrix) if clockwise else matrix


def omni_wheel_drive(robot: Robot, matrix: Array) -> Controller:
    """The controller whose matrix is closest to ``matrix`` (3, N) of the robot's centre in the sum of squares of rows.

    The matrix of Eq. (6) is, in columns,

        m1 + i m2 = (2 r / N) i exp(i t_i),    m3 = r / (N R),                                         (7)

    so the closest one is found in closed form: r exp(i wheel_offset) from rows 1 and 2, then R from the mean of row 3.

    Raises ConfigError for a robot that the controller cannot describe: fewer than three wheels, wheels farther than 10
    degrees from equal spacing, or a matrix that turns the robot clockwise.
    """
    wheels = robot.measured
    count = len(wheels)
    if count < 3:
        raise ConfigError("ros2_controllers: omni_wheel_drive_controller needs three wheels or more; use c_header")
    # Order counter-clockwise from the first wheel on.
    clockwise = [wheel.lever < 0 for wheel in wheels]
    angles = np.array([wheel.axle if wheel.lever > 0 else wheel.axle + math.pi for wheel in wheels])
    turned = np.mod(angles - angles[0], 2 * np.pi)
    # By rounding, the first wheel or one at the same angle may be a full turn away.
    turned[np.isclose(turned, 2 * np.pi)] = 0.0
    order = np.argsort(turned, kind="stable")
    away = turned[order] - 2 * np.pi * np.arange(count) / count
    away -= (away.max() + away.min()) / 2
    if np.abs(away).max() > _SPACING_TOLERANCE:
        raise ConfigError(
            f"ros2_controllers: omni_wheel_drive_controller needs wheels at equal angles, and these are up to "
            f"{math.degrees(np.abs(away).max()):.0f} degrees off "
            f"({', '.join(f'{value:.4g}' for value in np.degrees(angles))} deg); use c_header"
        )
    columns = np.where(clockwise, -matrix, matrix)[:, order]
    slots = np.exp(-2j * np.pi * np.arange(count) / count) / 1j
    scaled = complex(((columns[0] + 1j * columns[1]) * slots).sum() / 2)
    turn = float(columns[2].mean())
    if turn <= 0 or abs(scaled) == 0:
        raise ConfigError(_NO_TURN)
    values = {
        "wheel_offset": float(np.angle(scaled)),
        "robot_radius": abs(scaled) / (count * turn),
        "wheel_radius": abs(scaled),
    }
    closest = omni_wheel_matrix(order.tolist(), **values, clockwise=clockwise)
    off = 100 * (closest - matrix) / np.abs(matrix).max(axis=1, keepdims=True)
    rows = "; ".join(", ".join(f"{value:+.2f}" for value in row) for row in off)
    sign = (
        "a positive joint velocity turns the robot clockwise for this controller, counter-clockwise for the "
        "calibration: reverse the joints' axes"
    )
    if any(clockwise):
        as_they_are = [name for name, turns in zip(robot.wheel_names, clockwise, strict=True) if turns]
        sign += f", but not of {', '.join(as_they_are)}"
    return Controller(
        "omni_wheel_drive_controller",
        {"wheel_names": [joint_name(robot.wheel_names[index]) for index in order], **values},
        closest,
        "one wheel radius, one distance and equal spacing",
        "wheel_names",
        f": its elements are off by ({rows}) % of their row's largest, rows x; y; heading, wheels "
        f"{', '.join(robot.wheel_names)}",
        (sign,),
    )


def tricycle(robot: Robot, matrix: Array) -> Controller:
    """The tricycle_controller closest to a matrix (3, M) of the robot's centre. ConfigError: none can describe it.

    With the rate omega and the angle alpha of its one driven and steered wheel the controller computes, in the middle
    of the axle of the wheels that do not steer,

        v = r omega cos alpha,    w = r omega sin alpha / L,    r = wheel_radius, L = wheelbase        (8)

    (odometry.cpp of the package, 2022 to 2026). On the signals (omega cos alpha, omega sin alpha) its matrix has the
    elements r and r / L and else zeros, which are the closest parameters.
    """
    steered = [wheel for wheel in robot.measured if wheel.has_steering]
    if len(robot.motions) == 3 or len(steered) > 1:
        names = ", ".join(wheel.name for wheel in steered)
        raise ConfigError(
            "ros2_controllers: no released controller of ros2_controllers holds this robot, which drives by the "
            f"steered wheels {names}; c_header does"
        )
    # The base frame in the middle of the axle, and the steered wheel's distance ahead of it.
    name, (x, y) = steered[0].name, steered[0].position
    motions, _ = driven_motions(robot)
    base = Mount(x=-float(motions[-1, 1]), y=y)
    wheelbase = x - base.x
    forward = math.copysign(1.0, wheelbase)
    signals = robot.drive.names
    reading = np.zeros((2, len(signals)))
    reading[0, signals.index(f"{name}_cos")], reading[1, signals.index(f"{name}_sin")] = 1.0, forward
    seen = base.twist @ as_read(robot, matrix, reading)
    radius, turn = float(seen[0, 0]), float(seen[2, 1])
    if radius <= 0 or turn <= 0:
        raise ConfigError(f"{_WRONG_WAY}the signs of the wheel and of its steering angle")
    offset = _steering_offset(robot, seen, reading, base, abs(wheelbase))
    return Controller(
        "tricycle_controller",
        {
            "traction_joint_name": joint_name(name),
            "steering_joint_name": f"steering_{name}_joint",
            "wheelbase": radius / turn,
            "wheel_radius": radius,
        },
        _tricycle_matrix(radius, turn, 0.0) @ reading,
        "one wheel radius and one wheelbase",
        "traction_joint_name and steering_joint_name",
        notes=(
            *joint_notes([name] if forward < 0 else [], [], "steering "),
            *offset,
            *joint_notes([], [wheel for wheel in robot.wheel_names if wheel != name]),
            _TAKES_END,
        ),
        base=base,
        lever=not offset,
    )


def _tricycle_matrix(radius: float, turn: float, offset: float) -> Array:
    """The controller's matrix (3, 2), Eq. (8), if the wheel's angle is larger by an offset, rad. turn: r / L."""
    cosine, sine = math.cos(offset), math.sin(offset)
    return np.array([[radius * cosine, -radius * sine], [0.0, 0.0], [turn * sine, turn * cosine]])


def _steering_offset(robot: Robot, seen: Array, reading: Array, base: Mount, wheelbase: float) -> tuple[str, ...]:
    """The note on an offset of the steering angle that would leave less; none for none.

    tricycle_controller has no such offset: if the wheel stands at alpha + beta, the columns of row 1 are
    r (cos beta, -sin beta) and those of row 3 (r / L) (sin beta, cos beta), so that z1 = k_11 - i k_12 and
    z3 = k_32 + i k_31 have the phase beta. Where the joint's zero can be turned, the offset comes closest that makes
    largest

        (Re z1 e^(-i beta))^2 + (L Re z3 e^(-i beta))^2.                                               (9)
    """
    ahead, turning = complex(seen[0, 0], -seen[0, 1]), complex(seen[2, 1], seen[2, 0])
    offset = cmath.phase(ahead**2 + (wheelbase * turning) ** 2) / 2
    back = cmath.exp(-1j * offset)
    radius, turn = (ahead * back).real, (turning * back).real
    before, after = (
        remaining_error(robot, matrix @ reading, seen @ reading, base)
        for matrix in (_tricycle_matrix(seen[0, 0], seen[2, 1], 0.0), _tricycle_matrix(radius, turn, offset))
    )
    if before.straight_heading < _STRAIGHT or after.straight_heading > _WORTH_IT * before.straight_heading:
        return ()
    return (
        f"with {math.degrees(offset):+.3f} deg added to the angle of the steering joint (its zero in the driver), "
        f"wheelbase {radius / turn:.6f} and wheel_radius {radius:.6f} would leave {after}",
    )
