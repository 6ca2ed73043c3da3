"""Export of a calibration as a C header, compiled and compared with the stream."""

from __future__ import annotations

import math
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from export_samples import CAR, DIFF, ORIGIN, SWERVE, TRICYCLE, calibration, disturbed, in_brief, mounted
from sample_robots import APR_02
from syrupy.assertion import SnapshotAssertion

from omnibench.robot.calibration import Provenance, matrix_rows
from omnibench.robot.export.formats import Export, export_calibration
from omnibench.robot.kinematics import Array, Robot, Wheel, published_matrix
from omnibench.robot.odometry import Integration, OdometryStream

COMPILER = shutil.which("cc") or shutil.which("gcc")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler (cc or gcc) on this machine")
START = np.array([1.0, -2.0, 3.0])


PROGRAM = """\
#include <stdio.h>
#include "{header}"

int main(void)
{{
    double pose[3] = {{ 1.0, -2.0, 3.0 }};
    double inputs[{count}];
{state}\
    for (;;) {{
        for (int input = 0; input < {count}; ++input) {{
            if (scanf("%lf", &inputs[input]) != 1) {{
                return input;
            }}
        }}
        {stem}_odometry_step(pose, {arguments}, inputs[{count} - 1]);
        printf("%.17g %.17g %.17g\\n", pose[0], pose[1], pose[2]);
    }}
}}
"""


def run_header(export: Export, folder: Path, stem: str, samples: Array, wheels: int) -> Array:
    """Poses (F, 3) that a program with the header computes from rows of rates, steering angles and duration."""
    steers = samples.shape[1] > wheels + 1
    text = PROGRAM.format(
        header=export.file_name,
        count=samples.shape[1],
        stem=stem,
        state=f"    {stem}_odometry_state state = {{ {{ 0.0 }}, 0 }};\n" if steers else "",
        arguments=f"&state, inputs, inputs + {wheels}" if steers else "inputs",
    )
    (folder / export.file_name).write_text(export.text)
    source, program = folder / "main.c", folder / "main"
    source.write_text(text)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2"]
    subprocess.run([COMPILER, *flags, str(source), "-o", str(program), "-lm"], check=True, capture_output=True)
    lines = "\n".join(" ".join(repr(float(value)) for value in row) for row in samples)
    done = subprocess.run([str(program)], input=lines, capture_output=True, text=True, check=True)
    return np.array([[float(value) for value in line.split()] for line in done.stdout.splitlines()])


def by_lever_arm(index: int) -> Wheel:
    """A mecanum wheel as in the paper: distance and angle of the axle."""
    angle, roller = math.copysign(math.pi / 2, 1.5 - index), math.pi / 4 * (-1) ** index
    return Wheel(name="abcd"[index], radius=0.148, distance=0.195, angle=angle, roller_angle=roller)


@needs_compiler
@pytest.mark.parametrize("integration", ["euler", "arc"])
def test_the_compiled_step_equals_the_stream(tmp_path: Path, integration: Integration) -> None:
    matrix = published_matrix("palacin2023_eq8")
    rng = np.random.default_rng(1)
    samples = np.column_stack([rng.normal(0, 4, (1000, 3)), rng.uniform(0.005, 0.02, 1000)])
    samples[100:200, :3] = 0  # standing still
    samples[200:300, :3] = [-1e-3, 0, 1e-3]  # hardly turning
    export = export_calibration(calibration(APR_02, matrix, integration=integration), "c_header")
    poses = run_header(export, tmp_path, "apr_02", samples, 3)
    stream = OdometryStream(matrix, integration, START)
    expected = np.array([stream.drive(row[:3] * row[3]) for row in samples])
    np.testing.assert_allclose(poses, expected, rtol=0, atol=1e-12)


STEERING = [{"name": "steering_gain", "parameters": {"g": 4.8}}, {"name": "steering_offset", "parameters": {"c": 0.02}}]


@needs_compiler
@pytest.mark.parametrize(
    ("robot", "effects"), [(TRICYCLE, []), (CAR, []), (SWERVE, []), (CAR, STEERING)], ids=lambda value: str(value)[:16]
)
@pytest.mark.parametrize("integration", ["euler", "arc"])
def test_steered_wheels_drive_as_in_the_stream(
    tmp_path: Path, robot: Robot, effects: list[dict[str, Any]], integration: Integration
) -> None:
    """A fitted gain and zero of the steering are in the header, too."""
    document = calibration(robot, disturbed(robot), integration=integration, effects=effects)
    rng, drive = np.random.default_rng(2), robot.drive
    rates = rng.normal(0, 4, (300, len(drive.wheels)))
    steering = np.cumsum(rng.normal(0, 0.02 / (1 + 5 * bool(effects)), (300, len(drive.steered))), axis=0)
    durations = rng.uniform(0.005, 0.05, 300)
    export = export_calibration(document, "c_header")
    poses = run_header(export, tmp_path, robot.name, np.column_stack([rates, steering, durations]), len(drive.wheels))
    stream = document.model.stream(START)
    expected = [stream.drive(a * d, d, steering=s) for a, s, d in zip(rates, steering, durations, strict=True)]
    np.testing.assert_allclose(poses, expected, rtol=0, atol=1e-12)
    assert all(f"/* {name} */" in export.text for name in drive.names)
    assert "left out" not in " ".join((export.text, *export.warnings))


def test_a_header_says_where_its_matrix_comes_from_and_what_it_leaves_out(snapshot: SnapshotAssertion) -> None:
    origin = Provenance(**ORIGIN | {"dataset_hash": "f00", "training_cost": 0.0215}, simulated=True)
    slip = [{"name": "slip", "parameters": {"k": 0.1}}]
    exported = (
        calibration(APR_02, published_matrix("palacin2023_eq8"), provenance=origin, effects=slip),
        calibration(mounted(DIFF)),
    )
    assert "\n".join(in_brief(export_calibration(each, "c_header")) for each in exported) == snapshot
    assert export_calibration(calibration(APR_02), "c_header").warnings == ()


@needs_compiler
def test_any_number_of_wheels_and_any_name_compiles(tmp_path: Path) -> None:
    mecanum = Robot(name="m", wheels=tuple(map(by_lever_arm, range(4))))
    origin = Provenance(**ORIGIN | {"dataset": "a */ b"})
    document = calibration(mecanum, name="4-wheeler: *Größe* */ #1", sample_period=1.0, provenance=origin)
    export = export_calibration(document, "c_header")
    assert export.file_name == "robot_4_wheeler_gr_e_1_odometry.h"
    poses = run_header(export, tmp_path, "robot_4_wheeler_gr_e_1", np.array([[1.0, 2, 3, 4, 0.5]]), 4)
    stream = OdometryStream(mecanum.inverse_kinematic_matrix, "arc", START)
    np.testing.assert_allclose(poses[0], stream.drive(np.array([0.5, 1, 1.5, 2])), rtol=0, atol=1e-12)


def test_without_its_effects_the_matrix_is_the_one_that_was_fitted_without_them() -> None:
    plain, slip = APR_02.inverse_kinematic_matrix, {"name": "centripetal_slip", "parameters": {"k": 0.1}}
    spread = {"covariance": np.eye(10).tolist(), "driven": [[0.1, 0.0, 0.0]], "plain": matrix_rows(plain)}
    document = calibration(APR_02, 1.1 * plain, effects=[slip], **spread)
    export, of_plain = export_calibration(document, "c_header"), export_calibration(calibration(APR_02), "c_header")
    table = of_plain.text[of_plain.text.index("_matrix[3]") : of_plain.text.index("};")]
    assert table in export.text
    assert "the matrix was fitted without them" in export.warnings[0]
