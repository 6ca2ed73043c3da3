"""Export formats of calibrations: parameters of ROS 2 controllers and of robot_localization, or a C header."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from omnibench.errors import UnknownNameError, require_type
from omnibench.robot.calibration import Calibration
from omnibench.robot.export.c_header import c_header
from omnibench.robot.export.robot_localization import robot_localization
from omnibench.robot.export.ros2_controllers import ros2_controllers
from omnibench.views import Brief


@dataclass(frozen=True, repr=False)
class Export(Brief):
    """The text of an exported file, a warning for everything left out, and a name for the file."""

    text: str
    warnings: tuple[str, ...]
    file_name: str


def _ros2_controllers(calibration: Calibration) -> Export:
    text, warnings, controller = ros2_controllers(calibration)
    return Export(text, warnings, f"{_stem(calibration.name)}_{controller.removesuffix('_controller')}.yaml")


def _robot_localization(calibration: Calibration) -> Export:
    text, warnings = robot_localization(calibration)
    return Export(text, warnings, f"{_stem(calibration.name)}_robot_localization.yaml")


def _c_header(calibration: Calibration) -> Export:
    stem = _stem(calibration.name)
    text, warnings = c_header(calibration, stem)
    return Export(text, warnings, f"{stem}_odometry.h")


EXPORT_FORMATS: Mapping[str, Callable[[Calibration], Export]] = MappingProxyType(
    {"c_header": _c_header, "robot_localization": _robot_localization, "ros2_controllers": _ros2_controllers}
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
