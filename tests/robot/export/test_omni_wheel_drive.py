"""Export formats, and parameters of omni_wheel_drive_controller."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from export_samples import calibration, parameters
from hypothesis import given
from hypothesis import strategies as st
from sample_robots import APR_02
from scipy.optimize import minimize

from omnibench.errors import ConfigError
from omnibench.robot.export.formats import Export, export_calibration
from omnibench.robot.export.ros2_controllers import OmniWheelDrive, closest_omni_wheel_drive
from omnibench.robot.kinematics import Array, Robot, Wheel, published_matrix


def robot(*angles_deg: float, radius: float = 0.148, distance: float = 0.195) -> Robot:
    wheels = (
        Wheel(name="abcdefgh"[index], radius=radius, distance=distance, angle=math.radians(angle))
        for index, angle in enumerate(angles_deg)
    )
    return Robot(name="APR-02", wheels=tuple(wheels))


NODE = "omni_wheel_drive_controller"


def exported(machine: Robot) -> Export:
    return export_calibration(calibration(machine), "ros2_controllers")


def controller_twist(values: dict[str, Any], velocities: Array) -> Array:
    """The twist that omni_wheel_drive_controller computes from joint velocities (Odometry::compute_robot_velocity)."""
    count = len(velocities)
    theta = values["wheel_offset"] + 2 * math.pi * np.arange(count) / count
    system = np.column_stack([np.sin(theta), -np.cos(theta), np.full(count, -values["robot_radius"])])
    twist: Array = np.linalg.lstsq(system, velocities * values["wheel_radius"], rcond=None)[0]
    return twist


class TestRos2Controllers:
    @pytest.mark.parametrize(
        "angles",
        [(60, 180, 300), (300, 60, 180), (60, 300, 180), (-60, 60, 180), (0, 90, 180, 270), (45, 315, 225, 135)],
    )
    def test_the_controller_drives_a_design_robot_exactly(self, angles: tuple[float, ...]) -> None:
        machine = robot(*angles)
        values = parameters(exported(machine), NODE)
        names = [name.removeprefix("wheel_").removesuffix("_joint") for name in values["wheel_names"]]
        rates = np.linalg.pinv(machine.inverse_kinematic_matrix) @ [0.3, -0.2, 0.7]
        by_name = dict(zip(machine.wheel_names, -rates, strict=True))  # its positive rate is clockwise
        twist = controller_twist(values, np.array([by_name[name] for name in names]))
        np.testing.assert_allclose(twist, [0.3, -0.2, 0.7], atol=1e-10)
        assert (values["robot_radius"], values["wheel_radius"]) == pytest.approx((0.195, 0.148), abs=1e-11)

    def test_no_other_parameters_are_closer_to_a_calibrated_matrix(self) -> None:
        matrix = published_matrix("palacin2023_eq8")
        fitted = closest_omni_wheel_drive(APR_02, matrix)

        def distance(vector: Array) -> float:
            return float(np.square(OmniWheelDrive(fitted.order, *vector).matrix - matrix).sum())

        start = (0.195, 0.148, math.pi / 3)
        search = minimize(distance, start, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-18})
        found = (fitted.robot_radius, fitted.wheel_radius, fitted.wheel_offset)
        np.testing.assert_allclose(found, search.x, atol=1e-6)
        assert distance(np.array(found)) <= search.fun + 1e-15

    def test_unequal_spacing_is_refused(self) -> None:
        with pytest.raises(ConfigError, match=r"30 degrees off \(30, 150, 270, 330 deg\)"):
            exported(robot(30, 150, 270, 330))

    def test_a_few_degrees_off_are_fitted(self) -> None:
        values = parameters(exported(robot(62, 180, 300)), NODE)
        assert math.degrees(values["wheel_offset"]) == pytest.approx(60.7, abs=0.3)

    def test_a_wheel_that_turns_the_robot_clockwise_keeps_its_sign(self) -> None:
        inward = [wheel.model_copy(update={"angle": wheel.axle + math.pi}) for wheel in APR_02.wheels]
        places = [wheel.position for wheel in APR_02.wheels]
        b = Wheel(name="b", radius=0.148, type="omni", angle=inward[1].angle, x=places[1][0], y=places[1][1])
        machine = Robot(name="r", wheels=(APR_02.wheels[0], b, APR_02.wheels[2]))
        export = exported(machine)
        assert parameters(export, NODE) == parameters(exported(APR_02), NODE)
        assert "reverse the joints' axes, but not of b" in " | ".join(export.warnings)
        matrix = machine.inverse_kinematic_matrix
        np.testing.assert_allclose(closest_omni_wheel_drive(machine, matrix).matrix, matrix, atol=1e-12)

    @given(
        offset=st.floats(-3.1, 3.1), radius=st.floats(0.01, 0.5), distance=st.floats(0.05, 1), count=st.integers(3, 8)
    )
    def test_a_matrix_gives_parameters_back(self, offset: float, radius: float, distance: float, count: int) -> None:
        angles = math.degrees(offset) + 360 * np.arange(count) / count
        machine = robot(*angles, radius=radius, distance=distance)
        fitted = closest_omni_wheel_drive(machine, machine.inverse_kinematic_matrix)
        assert fitted.order == tuple(range(count))
        assert (fitted.robot_radius, fitted.wheel_radius) == pytest.approx((distance, radius), rel=1e-9)
        assert math.remainder(fitted.wheel_offset - offset, 2 * math.pi) == pytest.approx(0, abs=1e-9)


def test_an_unknown_format_is_refused_with_the_nearest_and_all() -> None:
    known = "c_header, robot_localization, ros2_controllers"
    with pytest.raises(ConfigError, match=rf"'c_heder'; did you mean 'c_header'\? known: {known}"):
        export_calibration(calibration(APR_02), "c_heder")
