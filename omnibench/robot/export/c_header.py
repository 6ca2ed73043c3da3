"""Export of a calibration as a self-contained C99 header: the matrix and one step of the odometry."""

from __future__ import annotations

from omnibench.robot.calibration import Calibration
from omnibench.robot.export.c_signals import definitions, functions, literal, middle
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
_HELD = ("steering_gain", "steering_offset")  # effects that the header applies
_COUNTER_CLOCKWISE = "A positive rate drives the robot counter-clockwise."
_ROLLING = "A positive rate drives the robot in the wheel's\n * direction of rolling."
_STEERING = (
    "A positive rate drives the robot in the wheel's\n * direction of rolling. steering: angles (rad, "
    "counter-clockwise) at the sample's end, which state keeps for the next."
)


def c_header(calibration: Calibration, prefix: str) -> tuple[str, tuple[str, ...]]:
    """The header's text, with identifiers that begin with ``prefix``, and a warning for everything left out."""
    upper, robot = prefix.upper(), calibration.robot
    matrix = calibration.matrix_without_effects if _is_plain(calibration) else calibration.matrix_array
    names = ", ".join(f'"{name}"' for name in robot.wheel_names)
    rates = f"const double rates[{upper}_WHEELS]"
    if robot.drive.direct:
        sizes = code = signals = ""
        source, of, per, columns = "rates", "wheel", "wheel", f"{upper}_WHEELS"
        arguments = f"double pose[3], {rates}, double duration"
        signs = _COUNTER_CLOCKWISE if all(wheel.lever > 0 for wheel in robot.measured) else _ROLLING
    else:
        sizes, code = definitions(upper, robot.drive), functions(prefix, robot.drive)
        gain, zero = 1 + _held(calibration, "steering_gain", "g"), _held(calibration, "steering_offset", "c")
        signals = middle(prefix, gain, zero)
        source, of, per, columns = "signals", "signal", "drive signal", f"{upper}_SIGNALS"
        arguments = (
            f"double pose[3], {prefix}_odometry_state *state, {rates},\n{' ' * (len(prefix) + 34)}"
            f"const double steering[{upper}_STEERED], double duration"
        )
        signs = _STEERING
    text = f"""\
/*
{_comment(calibration)}
 */
#ifndef {upper}_ODOMETRY_H
#define {upper}_ODOMETRY_H

#include <math.h>

#define {upper}_WHEELS {len(robot.wheel_names)}
#define {upper}_WHEEL_NAMES {{ {names} }}
{sizes}\
#define {upper}_SAMPLE_PERIOD {literal(calibration.sample_period)} /* s */
#define {upper}_INTEGRATION "{calibration.integration}"

/* Inverse kinematic matrix: rows x, y (m) and heading (rad) per radian of each {per}. */
static const double {prefix}_matrix[3][{columns}] = {{
{_rows(matrix)}
}};

{code}\
/*
 * Advance a pose (x m, y m, heading rad, not wrapped) by one sample: mean rates (rad/s) of the wheels over
 * duration (s). {signs}
 */
static inline void {prefix}_odometry_step({arguments})
{{
{signals}\
    double moved[3] = {{ 0.0, 0.0, 0.0 }};
    for (int row = 0; row < 3; ++row) {{
        for (int {of} = 0; {of} < {columns}; ++{of}) {{
            moved[row] += {prefix}_matrix[row][{of}] * {source}[{of}];
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
    warnings = []
    if left := left_out(calibration):
        warnings.append(
            "it holds the matrix, and a steering's gain and zero; other effects of the calibration are left out: "
            f"{left}; the matrix was fitted with{'out' if _is_plain(calibration) else ''} them"
        )
    elif calibration.plain is not None:
        warnings.append("its effects do not fade beyond what was driven; there, errors may be larger than stated")
    if robot.mount is not None:
        warnings.append("the header's pose is that of the tracked point, which is not the robot's centre (mount)")
    return text, tuple(warnings)


def _held(calibration: Calibration, effect: str, parameter: str) -> float:
    """The value of an effect that the header holds; 0 without it."""
    if _is_plain(calibration):
        return 0
    return sum(term.parameters[parameter] for term in calibration.effects if term.name == effect)


def _is_plain(calibration: Calibration) -> bool:
    """True if the header holds the plain matrix and no effects: some of these it cannot hold."""
    return calibration.plain is not None and any(term.name not in _HELD for term in calibration.effects)


def left_out(calibration: Calibration) -> str:
    """The effects that the header does not hold, in words, and "" if there are none: a live node has them."""
    plain = _is_plain(calibration)
    others = tuple(term for term in calibration.effects if plain or term.name not in _HELD)
    return calibration.model_copy(update={"effects": others}).effects_in_words


def _rows(matrix: Array) -> str:
    return ",\n".join(f"    {{ {', '.join(literal(value) for value in row)} }}" for row in matrix)


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
    if calibration.robot.mount is not None:
        lines.append("the pose is that of the tracked point, which is not the robot's centre (mount)")
    if left := left_out(calibration):
        lines.append(f"left out: effects {left}")
    return "\n".join(f" * {' '.join(line.split())}".replace("*/", "* /") for line in lines)
