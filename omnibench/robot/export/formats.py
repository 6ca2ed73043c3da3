"""Export formats of calibrations: parameters of ROS 2 controllers and of robot_localization, or a C header.

robot_localization gets covariances from the noise of a calibration. The filter takes the velocities of odometry as
measurements, with the covariance that comes in the message (its preparing_sensor_data.rst and
configuring_robot_localization.rst, 2015 to 2020). If each message's velocity errs independently by the variance
s^2 / T, T apart, the variance of the filter's pose grows by s^2 a second whatever the process noise q of the velocity
is: with the measurement noise s^2 and in continuous time P_vv = sqrt(q) s and P_xv = s^2, so that P_xx' = 2 P_xv -
P_xv^2 / s^2 + q_x = s^2 + q_x. So x, y and yaw have no process noise here: that of the filter's defaults (0.05 m2/s,
0.06 rad2/s, params/ekf.yaml) would add to it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from omnibench.errors import ConfigError, UnknownNameError, one_line, require_type
from omnibench.robot.calibration import Calibration
from omnibench.robot.effects.textbook import KNEE
from omnibench.robot.export import ros2_controllers
from omnibench.robot.export.ros2_controllers import Controller, RemainingError, interval_in_words
from omnibench.robot.kinematics import Mount
from omnibench.views import Brief

if TYPE_CHECKING:
    from jinja2 import Environment

# m2/s and rad2/s, then as often per s2 and s4: x, y, z, roll, pitch, yaw, their velocities, accelerations. The
# package's defaults (params/ekf.yaml), but for x, y and yaw.
_PROCESS_NOISE = (0.0, 0.0, 0.06, 0.03, 0.03, 0.0, 0.025, 0.025, 0.04, 0.01, 0.01, 0.02, 0.01, 0.01, 0.015)
_FUSED = (6, 7, 11)  # of these: velocities along x and y, and of yaw
_IN_HEADER = {"steering_gain": "g", "steering_offset": "c", "wheel_dead_zone": "c"}  # effects that the C header applies


@dataclass(frozen=True, repr=False)
class Export(Brief):
    """The text of an exported file, a warning for everything left out, and a name for the file."""

    text: str
    warnings: tuple[str, ...]
    file_name: str


def _environment() -> Environment:
    """The templates of the exported files, which stand beside this module."""
    from jinja2 import Environment, PackageLoader, StrictUndefined  # slow to import

    templates = Environment(
        loader=PackageLoader(__package__, "."),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    templates.filters |= {
        "literal": _c_literal,
        "strings": lambda names: ", ".join(f'"{name}"' for name in names),
        "in_comment": lambda text: " ".join(text.split()).replace("*/", "* /"),
        "quoted": lambda name: repr(one_line(name)),
        "number": lambda value: f"{round(value, 12) + 0.0:.12f}",  # no -0
        "exponent": lambda value: f"{value:.6e}",
        "listed": lambda names: f"[{', '.join(names)}]",
    }
    return templates


def _nodes(calibration: Calibration, fitted: Controller | None, base: Mount, **content: Any) -> str:
    """Parameters of nodes, made of the template node_parameters.yaml.j2. fitted: the controller, None if none holds it.

    content: what the template needs beside the controller and its covariances.
    """
    pose = ros2_controllers.pose_variances(calibration, base)
    template = _environment().get_template("node_parameters.yaml.j2")
    return template.render(
        calibration=calibration,
        controller=fitted,
        pose_variances=pose,
        twist_variances=None if pose is None else pose / calibration.sample_period,
        interval=interval_in_words(calibration),
        **content,
    )


def _ros2_controllers(calibration: Calibration) -> Export:
    """The controller's parameters as YAML with comments. ConfigError: no controller can describe this robot."""
    fitted = ros2_controllers.controller(calibration.robot, calibration.matrix_without_effects)
    design = ros2_controllers.controller(calibration.robot, calibration.robot.inverse_kinematic_matrix)
    warnings = ros2_controllers.warnings_of(calibration, fitted, design)
    numbers = {name: value for name, value in design.values.items() if isinstance(value, float)}
    text = _nodes(
        calibration,
        fitted,
        fitted.base,
        what=f"{fitted.name} (ros2_controllers)",
        relation="closest to",
        warnings=warnings,
        last=f"Design values: {', '.join(f'{name} {round(value, 6) + 0.0:.6f}' for name, value in numbers.items())}",
    )
    stem = f"{_stem(calibration.name)}_{fitted.name.removesuffix('_controller')}"
    return Export(text, warnings, f"{stem}.yaml")


def robot_localization(calibration: Calibration) -> Export:
    """Parameters of ekf_filter_node and of the controller that publishes the odometry as YAML, and warnings.

    ConfigError: the calibration has no noise model.
    """
    try:
        publisher = ros2_controllers.controller(calibration.robot, calibration.matrix_without_effects)
    except ConfigError:
        publisher = None
    base = Mount() if publisher is None else publisher.base
    noise, growth = calibration.noise, ros2_controllers.pose_variances(calibration, base)
    if noise is None or growth is None:
        raise ConfigError(
            f"robot_localization: calibration {calibration.name!r} has no noise model, of which covariances are made; "
            "calibrate once more with closed_form, which estimates it"
        )
    interval = interval_in_words(calibration)
    warnings = [
        f"twist variances are of messages every {interval}; for another interval T multiply them by {interval} / T",
        "white noise and bias of the calibration's noise are the reference's, and not used",
    ]
    unseen = [name for name, walk in (("position", noise.walk_position), ("heading", noise.walk_heading)) if not walk]
    if unseen:
        warnings.append(
            f"the recordings show no random walk of {' and '.join(unseen)}: its variance is 0 here, which the filter "
            "takes as 1e-9; put in a larger one"
        )
    deviations = ros2_controllers.matrix_deviations(calibration, base)
    if deviations is None:
        warnings.append("the calibration has no covariance of its matrix: how far that may be off is not known")
    else:
        # Standard deviations in the worst direction of straight driving and on the spot.
        positions = np.hypot(deviations[:, 0], deviations[:, 1]).tolist()
        headings = deviations[:, 2].tolist()
        sigma = RemainingError(max(positions[:-1]), max(headings[:-1]), positions[-1], headings[-1])
        warnings.append(
            f"the matrix may be off by {sigma} (1 sigma); that is the same in every message, so that no variance of a "
            "message stands for it, and is left out"
        )
        if calibration.provenance is not None and calibration.provenance.on_bounds:
            names = ", ".join(calibration.provenance.on_bounds)
            warnings.append(f"of {names}, on a bound of the box, no variance is known and none is counted")
    along_x, along_y, heading = np.sqrt(growth).tolist()
    text = _nodes(
        calibration,
        publisher,
        base,
        what="robot_localization",
        relation="from",
        warnings=warnings,
        last=f"Random walk of the odometry: {1e3 * along_x:.3g} mm in x, {1e3 * along_y:.3g} mm in y, "
        f"{np.degrees(heading):.3g} deg per root second; the filter's pose grows by that.",
        fused=["true" if index in _FUSED else "false" for index in range(len(_PROCESS_NOISE))],
        process_noise=np.diag(_PROCESS_NOISE).tolist(),
    )
    return Export(text, tuple(warnings), f"{_stem(calibration.name)}_robot_localization.yaml")


def _c_header(calibration: Calibration) -> Export:
    """A self-contained C99 header: the matrix and one step of the odometry, made of the template odometry.h.j2."""
    robot, prefix = calibration.robot, _stem(calibration.name)
    plain = _header_is_plain(calibration)
    held = {
        name: 0 if plain else sum(term.parameters[parameter] for term in calibration.effects if term.name == name)
        for name, parameter in _IN_HEADER.items()
    }
    template = _environment().get_template("odometry.h.j2")
    text = template.render(
        calibration=calibration,
        left_out=left_out(calibration),
        prefix=prefix,
        matrix=(calibration.matrix_without_effects if plain else calibration.matrix_array).tolist(),
        lost=held["wheel_dead_zone"],
        knee=KNEE,
        gain=1 + held["steering_gain"],
        zero=held["steering_offset"],
    )
    warnings = []
    if omitted := left_out(calibration):
        warnings.append(
            "it holds the matrix, a steering's gain and zero, and lost rates; other effects are left out: "
            f"{omitted}; the matrix was fitted with{'out' if plain else ''} them"
        )
    elif calibration.plain is not None and calibration.driven is not None:
        warnings.append("its effects do not fade beyond what was driven; there, errors may be larger than stated")
    if robot.mount is not None:
        warnings.append("the header's pose is that of the tracked point, which is not the robot's centre (mount)")
    return Export(text, tuple(warnings), f"{prefix}_odometry.h")


def _c_literal(value: float) -> str:
    """A C literal that is read as exactly the same double."""
    text = f"{value:.17g}"
    return text if "." in text or "e" in text else f"{text}.0"


def _header_is_plain(calibration: Calibration) -> bool:
    """True if the C header holds the plain matrix and no effects: some of these it cannot hold."""
    return calibration.plain is not None and any(term.name not in _IN_HEADER for term in calibration.effects)


def left_out(calibration: Calibration) -> str:
    """The effects that the C header does not hold, in words, and "" if there are none: a live node has them."""
    plain = _header_is_plain(calibration)
    others = tuple(term for term in calibration.effects if plain or term.name not in _IN_HEADER)
    return calibration.model_copy(update={"effects": others}).effects_in_words


EXPORT_FORMATS: Mapping[str, Callable[[Calibration], Export]] = MappingProxyType(
    {"c_header": _c_header, "robot_localization": robot_localization, "ros2_controllers": _ros2_controllers}
)


def export_calibration(calibration: Calibration, format: str) -> Export:  # noqa: A002 (the command's own word)
    """A calibration in another format: ``ros2_controllers``, ``robot_localization`` or ``c_header``.

    Raises UnknownNameError for another format and ConfigError when the format cannot describe this robot at all.
    """
    require_type(calibration, Calibration, "read_calibration")
    if format not in EXPORT_FORMATS:
        raise UnknownNameError("export format", format, EXPORT_FORMATS)
    export = EXPORT_FORMATS[format](calibration)
    if calibration.provenance is None or not calibration.provenance.simulated:
        return export
    words = "simulated: no robot drove the runs that this was calibrated on"
    comment = f"/* {words} */" if format == "c_header" else f"# {words}"
    return replace(export, text=f"{comment}\n{export.text}", warnings=(words, *export.warnings))


def _stem(name: str) -> str:
    """The calibration's name as a C identifier and a file name."""
    stem = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    return stem if stem and not stem[0].isdigit() else f"robot_{stem}".rstrip("_")
