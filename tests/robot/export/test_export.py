"""Exports of a calibration: parameters of omni_wheel_drive_controller and a C header."""

from __future__ import annotations

import math
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from omnibench.errors import ConfigError
from omnibench.robot.calibration import Calibration, Provenance, matrix_rows
from omnibench.robot.export.formats import EXPORT_FORMATS, Export, export_calibration
from omnibench.robot.export.ros2_controllers import OmniWheelDrive, closest_omni_wheel_drive, remaining_error
from omnibench.robot.kinematics import Array, Robot, Wheel
from omnibench.robot.odometry import Integration, OdometryStream
from omnibench.robot.published_matrices import published_matrix

COMPILER = shutil.which("cc") or shutil.which("gcc")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler (cc or gcc) on this machine")


def robot(*angles_deg: float, radius: float = 0.148, distance: float = 0.195, roller: float = 0.0) -> Robot:
    wheels = (
        Wheel(
            name="abcdefgh"[index],
            radius=radius,
            distance=distance,
            angle=math.radians(angle),
            roller_angle=roller * (-1) ** index,
        )
        for index, angle in enumerate(angles_deg)
    )
    return Robot(name="APR-02", wheels=tuple(wheels))


APR_02 = robot(60, 180, 300)


def calibration(of: Robot = APR_02, matrix: Array | None = None, **fields: Any) -> Calibration:
    chosen = of.inverse_kinematic_matrix if matrix is None else matrix
    defaults: dict[str, Any] = {"name": "apr02", "sample_period": 0.01, "integration": "arc"}
    return Calibration(robot=of, matrix=matrix_rows(chosen), **(defaults | fields))


def parameters(export: Export) -> dict[str, Any]:
    content: dict[str, Any] = yaml.safe_load(export.text)
    found: dict[str, Any] = content["omni_wheel_drive_controller"]["ros__parameters"]
    return found


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
        values = parameters(export_calibration(calibration(machine), "ros2_controllers"))
        names = [name.removeprefix("wheel_").removesuffix("_joint") for name in values["wheel_names"]]
        rates = np.linalg.pinv(machine.inverse_kinematic_matrix) @ [0.3, -0.2, 0.7]
        by_name = dict(zip(machine.wheel_names, -rates, strict=True))  # its positive rate is clockwise
        twist = controller_twist(values, np.array([by_name[name] for name in names]))
        np.testing.assert_allclose(twist, [0.3, -0.2, 0.7], atol=1e-10)
        assert (values["robot_radius"], values["wheel_radius"]) == pytest.approx((0.195, 0.148), abs=1e-11)

    def test_wheels_are_named_counter_clockwise_from_the_first(self) -> None:
        values = parameters(export_calibration(calibration(robot(60, 300, 180)), "ros2_controllers"))
        assert values["wheel_names"] == ["wheel_a_joint", "wheel_c_joint", "wheel_b_joint"]
        assert values["wheel_offset"] == pytest.approx(math.pi / 3)

    def test_numbers_are_doubles_for_every_yaml_reader(self) -> None:
        text = export_calibration(calibration(robot(0, 120, 240)), "ros2_controllers").text
        assert "wheel_offset: 0.000000000000 " in text or "wheel_offset: -0.000000000000 " in text

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

    def test_the_warning_tells_what_is_lost(self) -> None:
        matrix = published_matrix("palacin2023_eq8")
        export = export_calibration(calibration(matrix=matrix), "ros2_controllers")
        values = parameters(export)
        used = OmniWheelDrive((0, 1, 2), values["robot_radius"], values["wheel_radius"], values["wheel_offset"]).matrix
        first = 100 * (used - matrix)[0, 0] / np.abs(matrix[0]).max()
        assert f"({first:+.2f}, " in export.warnings[0]
        assert "one wheel radius, one distance and equal spacing" in export.warnings[0]
        assert str(remaining_error(used, matrix)).split(" mm")[0] in export.warnings[1]
        assert any("clockwise" in warning for warning in export.warnings)
        assert all(f"# - {warning}" in export.text for warning in export.warnings)

    def test_what_remains_is_less_than_with_the_design_values(self) -> None:
        matrix = published_matrix("palacin2023_eq8")
        fitted = remaining_error(closest_omni_wheel_drive(APR_02, matrix).matrix, matrix)
        design = remaining_error(APR_02.inverse_kinematic_matrix, matrix)
        assert fitted.straight_position < design.straight_position / 2
        assert fitted.turn_heading < design.turn_heading / 10

    def test_euler_steps_and_effects_are_warned_of(self) -> None:
        document = calibration(integration="euler", effects=[{"name": "slip", "parameters": {"k": 0.1}}])
        warnings = export_calibration(document, "ros2_controllers").warnings
        assert any("Euler" in warning for warning in warnings)
        assert any("left out" in warning and "slip" in warning for warning in warnings)

    def test_mecanum_wheels_are_refused(self) -> None:
        mecanum = robot(90, 90, -90, -90, roller=math.pi / 4)
        with pytest.raises(ConfigError, match=r"no slanted rollers \(wheels a, b, c, d have\).*c_header"):
            export_calibration(calibration(mecanum), "ros2_controllers")

    def test_unequal_spacing_is_refused(self) -> None:
        with pytest.raises(
            ConfigError, match=r"needs wheels at equal angles.*30 degrees off \(30, 150, 270, 330 deg\)"
        ):
            export_calibration(calibration(robot(30, 150, 270, 330)), "ros2_controllers")

    def test_a_few_degrees_off_are_fitted(self) -> None:
        values = parameters(export_calibration(calibration(robot(62, 180, 300)), "ros2_controllers"))
        assert math.degrees(values["wheel_offset"]) == pytest.approx(60.7, abs=0.3)

    def test_a_matrix_that_turns_the_wrong_way_is_refused(self) -> None:
        with pytest.raises(ConfigError, match="does not turn this robot counter-clockwise"):
            export_calibration(calibration(matrix=-APR_02.inverse_kinematic_matrix), "ros2_controllers")

    @given(
        offset=st.floats(-3.1, 3.1),
        radius=st.floats(0.01, 0.5),
        distance=st.floats(0.05, 1),
        count=st.integers(3, 8),
    )
    def test_a_matrix_of_the_controller_gives_its_parameters_back(
        self, offset: float, radius: float, distance: float, count: int
    ) -> None:
        angles = math.degrees(offset) + 360 * np.arange(count) / count
        machine = robot(*angles, radius=radius, distance=distance)
        fitted = closest_omni_wheel_drive(machine, machine.inverse_kinematic_matrix)
        assert fitted.order == tuple(range(count))
        assert (fitted.robot_radius, fitted.wheel_radius) == pytest.approx((distance, radius), rel=1e-9)
        assert math.remainder(fitted.wheel_offset - offset, 2 * math.pi) == pytest.approx(0, abs=1e-9)


PROGRAM = """\
#include <stdio.h>
#include "{header}"

int main(void)
{{
    double pose[3] = {{ 1.0, -2.0, 3.0 }};
    double rates[{upper}_WHEELS];
    double duration;
    for (;;) {{
        for (int wheel = 0; wheel < {upper}_WHEELS; ++wheel) {{
            if (scanf("%lf", &rates[wheel]) != 1) {{
                return 0;
            }}
        }}
        if (scanf("%lf", &duration) != 1) {{
            return 1;
        }}
        {stem}_odometry_step(pose, rates, duration);
        printf("%.17g %.17g %.17g\\n", pose[0], pose[1], pose[2]);
    }}
}}
"""


def run_header(export: Export, folder: Path, stem: str, samples: Array) -> Array:
    """Poses (F, 3) that a program with the header computes from rows of rates and duration."""
    assert COMPILER is not None
    (folder / export.file_name).write_text(export.text)
    source, program = folder / "main.c", folder / "main"
    source.write_text(PROGRAM.format(header=export.file_name, stem=stem, upper=stem.upper()))
    flags = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2"]
    subprocess.run([COMPILER, *flags, str(source), "-o", str(program), "-lm"], check=True, capture_output=True)
    text = "\n".join(" ".join(repr(float(value)) for value in row) for row in samples)
    done = subprocess.run([str(program)], input=text, capture_output=True, text=True, check=True)
    return np.array([[float(value) for value in line.split()] for line in done.stdout.splitlines()])


class TestCHeader:
    @needs_compiler
    @pytest.mark.parametrize("integration", ["euler", "arc"])
    def test_the_compiled_step_equals_the_stream(self, tmp_path: Path, integration: Integration) -> None:
        matrix = published_matrix("palacin2023_eq8")
        rng = np.random.default_rng(1)
        samples = np.column_stack([rng.normal(0, 4, (1000, 3)), rng.uniform(0.005, 0.02, 1000)])
        samples[100:200, :3] = 0  # standing still
        samples[200:300, :3] = [-1e-3, 0, 1e-3]  # hardly turning
        export = export_calibration(calibration(matrix=matrix, integration=integration), "c_header")
        poses = run_header(export, tmp_path, "apr02", samples)
        stream = OdometryStream(matrix, integration, np.array([1.0, -2.0, 3.0]))
        expected = np.array([stream.drive(row[:3] * row[3]) for row in samples])
        np.testing.assert_allclose(poses, expected, rtol=0, atol=1e-12)

    @needs_compiler
    def test_any_number_of_wheels_and_any_name_compiles(self, tmp_path: Path) -> None:
        mecanum = robot(90, 90, -90, -90, roller=math.pi / 4)
        origin = Provenance(
            dataset="a */ b",
            dataset_hash="f00",
            calibrator="crs",
            seed=1,
            cost="final_pose",
            box="row",
            outcome="budget",
        )
        document = calibration(mecanum, name="4-wheeler: *Größe* */ #1", sample_period=1.0, provenance=origin)
        export = export_calibration(document, "c_header")
        assert export.file_name == "robot_4_wheeler_gr_e_1_odometry.h"
        poses = run_header(export, tmp_path, "robot_4_wheeler_gr_e_1", np.array([[1.0, 2, 3, 4, 0.5]]))
        stream = OdometryStream(mecanum.inverse_kinematic_matrix, "arc", np.array([1.0, -2.0, 3.0]))
        np.testing.assert_allclose(poses[0], stream.drive(np.array([0.5, 1, 1.5, 2])), rtol=0, atol=1e-12)

    def test_the_matrix_reads_back_to_the_bit(self) -> None:
        matrix = published_matrix("palacin2023_eq8")
        text = export_calibration(calibration(matrix=matrix), "c_header").text
        rows = text.split("= {\n")[1].split("\n};")[0].splitlines()
        read = [[float(value) for value in row.strip(" {},").split(", ")] for row in rows]
        assert read == matrix.tolist()

    def test_provenance_wheels_and_period_are_told(self) -> None:
        origin = Provenance(
            dataset="flower",
            dataset_hash="f00",
            simulated=True,
            calibrator="closed_form",
            seed=7,
            cost="final_pose",
            box="row",
            training_cost=0.0215,
            outcome="converged",
        )
        text = export_calibration(calibration(provenance=origin), "c_header").text
        for part in ("flower (simulated)", "f00", "closed_form", "seed 7", "training cost 0.0215", "converged"):
            assert part in text
        assert '#define APR02_WHEEL_NAMES { "a", "b", "c" }' in text
        assert "#define APR02_SAMPLE_PERIOD 0.01 /* s */" in text

    def test_effects_are_warned_of(self) -> None:
        document = calibration(effects=[{"name": "slip", "parameters": {"k": 0.1}}])
        export = export_calibration(document, "c_header")
        assert "slip" in export.warnings[0]
        assert "left out: effects slip" in export.text

    def test_a_bare_matrix_has_no_warnings(self) -> None:
        assert export_calibration(calibration(), "c_header").warnings == ()


def test_an_unknown_format_is_refused_with_the_nearest_and_all() -> None:
    message = r"unknown export format 'c_heder'; did you mean 'c_header'\? known: c_header, ros2_controllers"
    with pytest.raises(ConfigError, match=message):
        export_calibration(calibration(), "c_heder")


@pytest.mark.parametrize("name", sorted(EXPORT_FORMATS))
def test_every_format_suggests_a_file_name(name: str) -> None:
    assert export_calibration(calibration(), name).file_name.startswith("apr02_")
