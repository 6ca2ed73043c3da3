"""Export of a calibration as a self-contained C99 header: the matrix and one step of the odometry."""

from __future__ import annotations

from omnibench.robot.calibration import Calibration
from omnibench.robot.kinematics import Array

_ARC = """\
    /* the exact arc at constant twist */
    const double half = 0.5 * moved[2];
    const double stretch = fabs(half) < 1e-4 ? 1.0 - half * half / 6.0 : sin(half) / half;
    const double direction = pose[2] + half;
"""
_EULER = """\
    /* Euler step: straight, in the direction at its start */
    const double stretch = 1.0;
    const double direction = pose[2];
"""


def c_header(calibration: Calibration, prefix: str) -> tuple[str, tuple[str, ...]]:
    """The header's text, with identifiers that begin with ``prefix``, and a warning for everything left out."""
    upper = prefix.upper()
    wheels = calibration.robot.wheel_names
    names = ", ".join(f'"{name}"' for name in wheels)
    text = f"""\
/*
{_comment(calibration)}
 */
#ifndef {upper}_ODOMETRY_H
#define {upper}_ODOMETRY_H

#include <math.h>

#define {upper}_WHEELS {len(wheels)}
#define {upper}_WHEEL_NAMES {{ {names} }}
#define {upper}_SAMPLE_PERIOD {_literal(calibration.sample_period)} /* s */
#define {upper}_INTEGRATION "{calibration.integration}"

/* Inverse kinematic matrix: rows x, y (m) and heading (rad) per radian of each wheel. */
static const double {prefix}_matrix[3][{upper}_WHEELS] = {{
{_rows(calibration.matrix_array)}
}};

/*
 * Advance a pose (x m, y m, heading rad, not wrapped) by one sample: mean rates (rad/s) of the wheels over
 * duration (s). A positive rate drives the robot counter-clockwise.
 */
static inline void {prefix}_odometry_step(double pose[3], const double rates[{upper}_WHEELS], double duration)
{{
    double moved[3] = {{ 0.0, 0.0, 0.0 }};
    for (int row = 0; row < 3; ++row) {{
        for (int wheel = 0; wheel < {upper}_WHEELS; ++wheel) {{
            moved[row] += {prefix}_matrix[row][wheel] * rates[wheel];
        }}
        moved[row] *= duration;
    }}
{_ARC if calibration.integration == "arc" else _EULER}\
    const double c = stretch * cos(direction);
    const double s = stretch * sin(direction);
    pose[0] += c * moved[0] - s * moved[1];
    pose[1] += s * moved[0] + c * moved[1];
    pose[2] += moved[2];
}}

#endif /* {upper}_ODOMETRY_H */
"""
    if not calibration.effects:
        return text, ()
    left_out = ", ".join(term.name for term in calibration.effects)
    return text, (f"the header holds the matrix only; effects of the calibration are left out: {left_out}",)


def _rows(matrix: Array) -> str:
    return ",\n".join(f"    {{ {', '.join(_literal(value) for value in row)} }}" for row in matrix)


def _literal(value: float) -> str:
    """A C literal that is read as exactly the same double."""
    text = f"{float(value):.17g}"
    return text if any(mark in text for mark in ".e") else f"{text}.0"


def _comment(calibration: Calibration) -> str:
    lines = [
        f"Odometry of {calibration.robot.name}, written by omnibench from the calibration {calibration.name}",
        f"created {calibration.created.isoformat()}; wheels in this order: {', '.join(calibration.robot.wheel_names)}",
    ]
    origin = calibration.provenance
    if origin is None:
        lines.append("provenance: not recorded")
    else:
        lines += [
            f"dataset {origin.dataset}{' (simulated)' if origin.simulated else ''}, hash {origin.dataset_hash}",
            f"calibrator {origin.calibrator}, seed {origin.seed}, cost {origin.cost}, box {origin.box}",
            f"outcome {origin.outcome} {origin.reason}",
        ]
        costs = (("training", origin.training_cost), ("validation", origin.validation_cost))
        lines += [f"{name} cost {cost:.6g}" for name, cost in costs if cost is not None]
    if calibration.effects:
        lines.append(f"left out: effects {', '.join(term.name for term in calibration.effects)}")
    return "\n".join(f" * {' '.join(line.split())}".replace("*/", "* /") for line in lines)
