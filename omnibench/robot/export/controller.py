"""A controller of ros2_controllers with the parameters that come closest to a calibration, and its file's text."""

from __future__ import annotations

from dataclasses import dataclass, field

from omnibench.errors import one_line
from omnibench.robot.calibration import Calibration
from omnibench.robot.export.odometry_noise import interval_in_words, pose_variances, twist_variances
from omnibench.robot.export.remaining import of_centre, remaining_error, remaining_errors
from omnibench.robot.kinematics import Array, Mount, Robot

_STEPS = {"arc": "arcs", "euler": "Euler steps"}
_NEGLIGIBLE = 1e-4  # m: a base frame so near to where it should be is there; chosen


@dataclass(frozen=True)
class Parameter:
    """A parameter of a ROS 2 node: its name, with dots where it is nested, its value, and what stands behind it."""

    name: str
    value: float | str | tuple[str, ...]
    comment: str = ""


@dataclass(frozen=True, eq=False)
class Controller:
    """A controller whose parameters come closest to a matrix.

    matrix (3, M): the inverse kinematic matrix by which it computes the twist of its base frame. base: that frame in
    the robot's. holds: what stands for the matrix, in words, and lost: what that costs. joints: parameters that name
    joints, in words. notes: what else to do or to know. integration: how it integrates a twist. covariances: their
    parameters' names. topic: of its odometry. lever: True if what is left where the robot turns on the
    spot is the lever arm of a frame that is not at its base.
    """

    name: str
    parameters: tuple[Parameter, ...]
    matrix: Array
    holds: str
    joints: str
    lost: str = ""
    notes: tuple[str, ...] = ()
    base: Mount = field(default_factory=Mount)
    integration: str = "arcs"
    covariances: str = "{}_covariance_diagonal"
    topic: str = "odom"
    lever: bool = True

    def seen(self, robot: Robot, matrix: Array) -> Array:
        """The matrix (3, M) of the base frame from that of the tracked point."""
        seen: Array = self.base.twist @ of_centre(robot, matrix)
        return seen


def joint_name(wheel: str) -> str:
    """A made-up name of a wheel's joint."""
    return f"wheel_{wheel}_joint"


def reversed_joints(wheels: list[str], what: str = "") -> tuple[str, ...]:
    """The note on wheels whose joints turn the other way; none for none."""
    return (f"reverse the axes of the {what}joints of {', '.join(wheels)}",) if wheels else ()


def document(calibration: Calibration, fitted: Controller, design: Controller) -> tuple[str, tuple[str, ...]]:
    """The controller's parameters as YAML with comments, and the warnings among these.

    design: the same controller for the design values.
    """
    warnings = _warnings(calibration, fitted, design)
    values = [f"{each.name} {_number(each.value, 6)}" for each in design.parameters if isinstance(each.value, float)]
    lines = [
        f"{fitted.name} (ros2_controllers) for robot {one_line(calibration.robot.name)!r},",
        f"closest to the omnibench calibration {one_line(calibration.name)!r} of {calibration.created:%Y-%m-%d}.",
        *(f"- {warning}" for warning in warnings),
        f"Design values: {', '.join(values)}",
    ]
    parameters = (*fitted.parameters, *covariance_parameters(calibration, fitted))
    return "".join(f"# {line}\n" for line in lines) + to_node(fitted.name, parameters), warnings


def covariance_parameters(calibration: Calibration, controller: Controller) -> tuple[Parameter, ...]:
    """The controller's covariances by the calibration's noise; empty where it is not known."""
    twist = twist_variances(calibration, controller.base)
    if twist is None:
        return ()
    pose = pose_variances(calibration, controller.base)
    assert pose is not None  # the noise is known
    return (
        Parameter(controller.covariances.format("pose"), _diagonal(pose), "m2, rad2: what 1 s adds"),
        Parameter(
            controller.covariances.format("twist"),
            _diagonal(twist),
            f"m2/s2, rad2/s2: of messages every {interval_in_words(calibration)}",
        ),
    )


def to_node(name: str, parameters: tuple[Parameter, ...]) -> str:
    """Parameters of a node as YAML."""
    lines, opened = [f"{name}:", "  ros__parameters:"], list[str]()
    for parameter in parameters:
        *path, key = parameter.name.split(".")
        shared = next((at for at, (a, b) in enumerate(zip(path, opened, strict=False)) if a != b), len(opened))
        lines.extend(f"{'  ' * (depth + 2)}{path[depth]}:" for depth in range(min(shared, len(path)), len(path)))
        opened = path
        comment = f"  # {parameter.comment}" if parameter.comment else ""
        lines.append(f"{'  ' * (len(path) + 2)}{key}: {_value(parameter.value)}{comment}")
    return "\n".join(lines) + "\n"


def _value(value: float | str | tuple[str, ...]) -> str:
    if isinstance(value, float):
        return _number(value, 12)
    return value if isinstance(value, str) else f"[{', '.join(value)}]"


def _number(value: float, decimals: int) -> str:
    return f"{round(value, decimals) + 0.0:.{decimals}f}"  # no -0


def _diagonal(variances: Array) -> tuple[str, ...]:
    """Variances (3,) of x, y and heading as the diagonal of ROS: x, y, z, roll, pitch, yaw."""
    x, y, heading = (f"{value:.6e}" for value in variances.tolist())
    return (x, y, "0.0", "0.0", "0.0", heading)


def _warnings(calibration: Calibration, fitted: Controller, design: Controller) -> tuple[str, ...]:
    robot, true = calibration.robot, fitted.seen(calibration.robot, calibration.matrix_without_effects)
    left = remaining_error(robot, fitted.matrix, true, fitted.base)
    by_design = remaining_error(robot, design.matrix, true, fitted.base)
    warnings = [
        f"{fitted.holds} stand for the whole matrix{fitted.lost}",
        f"that leaves up to {left}; with the design values it would be {by_design}",
        *fitted.notes,
        f"{fitted.joints} are made up from the calibration's wheels: put in the joints of your URDF, in this order",
    ]
    integrated = _STEPS[calibration.integration]
    if integrated != fitted.integration:
        warnings.append(f"the matrix was calibrated for {integrated}, the controller integrates {fitted.integration}")
    if calibration.effects:
        warnings.append(
            "effects of the calibration are left out, the controller has none, and what that costs is not counted "
            f"above: {calibration.effects_in_words}"
        )
    return (*warnings, *_frames(robot, fitted, true), *_doubts(calibration))


def _frames(robot: Robot, fitted: Controller, true: Array) -> list[str]:
    """Warnings of frames that are not the robot's centre, and of a base frame that would leave less."""
    warnings, base = [], fitted.base
    if robot.mount is not None:
        warnings.append("the calibration is of the tracked point, the parameters are of the robot's centre (mount)")
    if max(abs(base.x), abs(base.y)) > _NEGLIGIBLE:
        warnings.append(
            f"base_frame_id has to be a frame at {_place(base.x, base.y)}, in the middle of the wheels that do not "
            "steer"
        )
    to_right, ahead, _ = remaining_errors(robot, fitted.matrix, true, base)[:, -1].tolist()
    if fitted.lever and max(abs(ahead), abs(to_right)) > _NEGLIGIBLE:
        place = _place(base.x + ahead, base.y - to_right)
        warnings.append(f"the millimetres a full turn are a lever arm: a base_frame_id at {place} would leave none")
    return warnings


def _place(x: float, y: float) -> str:
    return f"x {x:.4f} m, y {y:.4f} m of the robot's centre"


def _doubts(calibration: Calibration) -> list[str]:
    """Warnings of what the parameters say nothing of."""
    warnings = []
    if calibration.robot.skid:
        warnings.append("the robot skids: the parameters are those of the floor, the load and the speeds driven")
    if calibration.noise is None:
        warnings.append("covariances are left at the controller's defaults: the calibration has no noise model")
    return warnings
