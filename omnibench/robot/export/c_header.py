"""Export of a calibration as a self-contained C99 header: the matrix and one step of the odometry.

Drive signals of robots with steered wheels are computed as in robot/kinematics.py.
"""

from __future__ import annotations

import numpy as np

from omnibench.robot.calibration import Calibration
from omnibench.robot.effects.wheels import KNEE
from omnibench.robot.kinematics import CarDrive, Drive

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
_HELD = ("steering_gain", "steering_offset", "wheel_dead_zone")  # effects that the header applies
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
    rows = ",\n".join(f"    {{ {', '.join(literal(value) for value in row)} }}" for row in matrix)
    rates = f"const double rates[{upper}_WHEELS]"
    lost = _held(calibration, "wheel_dead_zone", "c")
    turning = _turning(upper, lost) if lost else ""
    if robot.drive.direct:
        sizes = code = ""
        signals, source = turning, "turning" if lost else "rates"
        of, per, columns = "wheel", "wheel", f"{upper}_WHEELS"
        arguments = f"double pose[3], {rates}, double duration"
        signs = _COUNTER_CLOCKWISE if all(wheel.lever > 0 for wheel in robot.measured) else _ROLLING
    else:
        sizes, code = definitions(upper, robot.drive), functions(prefix, robot.drive)
        gain, zero = 1 + _held(calibration, "steering_gain", "g"), _held(calibration, "steering_offset", "c")
        signals = turning + middle(prefix, gain, zero, "turning" if lost else "rates")
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
#define {upper}_WHEEL_NAMES {{ {_quoted(robot.wheel_names)} }}
{sizes}\
#define {upper}_SAMPLE_PERIOD {literal(calibration.sample_period)} /* s */
#define {upper}_INTEGRATION "{calibration.integration}"

/* Inverse kinematic matrix: rows x, y (m) and heading (rad) per radian of each {per}. */
static const double {prefix}_matrix[3][{columns}] = {{
{rows}
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
    if omitted := left_out(calibration):
        warnings.append(
            "it holds the matrix, a steering's gain and zero, and lost rates; other effects are left out: "
            f"{omitted}; the matrix was fitted with{'out' if _is_plain(calibration) else ''} them"
        )
    elif calibration.plain is not None and calibration.driven is not None:
        warnings.append("its effects do not fade beyond what was driven; there, errors may be larger than stated")
    if robot.mount is not None:
        warnings.append("the header's pose is that of the tracked point, which is not the robot's centre (mount)")
    return text, tuple(warnings)


def definitions(upper: str, drive: Drive) -> str:
    """Names and numbers of the steered wheels and of the signals, beginning with a prefix in capitals."""
    return f"""\
#define {upper}_STEERED {len(drive.steered)}
#define {upper}_STEERED_NAMES {{ {_quoted(drive.steered)} }}
#define {upper}_SIGNALS {len(drive.names)}
#define {upper}_SIGNAL_NAMES {{ {_quoted(drive.names)} }}
"""


def functions(prefix: str, drive: Drive) -> str:
    """The state that keeps steering angles, the signals, and those in the middle of a sample."""
    upper = prefix.upper()
    lines = "\n".join(f"    {line}" for line in _signals(drive))
    return f"""\
/* Steering angles (rad) at the end of the sample before. Begin with {{ {{ 0.0 }}, 0 }}. */
typedef struct {{
    double steering[{upper}_STEERED];
    int known;
}} {prefix}_odometry_state;

/* Drive signals (rad/s) of rates (rad/s) of the wheels at steering angles (rad, counter-clockwise). */
static inline void {prefix}_drive_signals(double signals[{upper}_SIGNALS], const double rates[{upper}_WHEELS],
{" " * (len(prefix) + 34)}const double steering[{upper}_STEERED])
{{
{lines}
}}

"""


def _turning(upper: str, lost: float) -> str:
    """The part of a step that adds to each wheel's rate what it gains while it turns, rad/s, by wheel_dead_zone."""
    return f"""\
    double turning[{upper}_WHEELS];
    for (int wheel = 0; wheel < {upper}_WHEELS; ++wheel) {{
        turning[wheel] = rates[wheel] + {literal(lost)} * tanh(rates[wheel] / {literal(KNEE)});
    }}
"""


def middle(prefix: str, gain: float, zero: float, rates: str = "rates") -> str:
    """The part of a step that takes the steering angles in the middle of the sample and makes the signals.

    gain: true angles for measured ones, to which zero, rad, is added. rates: name of the array of the wheels' rates.
    """
    upper = prefix.upper()
    turned = f"        middle[wheel] = {literal(gain)} * middle[wheel] + {literal(zero)};\n"
    true = "" if (gain, zero) == (1, 0) else turned
    return f"""\
    double middle[{upper}_STEERED];
    double signals[{upper}_SIGNALS];
    for (int wheel = 0; wheel < {upper}_STEERED; ++wheel) {{
        middle[wheel] = state->known ? 0.5 * (state->steering[wheel] + steering[wheel]) : steering[wheel];
        state->steering[wheel] = steering[wheel];
{true}\
    }}
    state->known = 1;
    {prefix}_drive_signals(signals, {rates}, middle);
"""


def literal(value: float) -> str:
    """A C literal that is read as exactly the same double."""
    text = f"{float(value):.17g}"
    return text if any(mark in text for mark in ".e") else f"{text}.0"


def _signals(drive: Drive) -> list[str]:
    """Statements in C that compute the drive signals."""
    if isinstance(drive, CarDrive):
        return _signals_of_car(drive)
    lines, count = [], 0
    for wheel, pair in enumerate(drive.pairs):
        factors = [""] if pair < 0 else [f" * cos(steering[{pair}])", f" * sin(steering[{pair}])"]
        for factor in factors:
            lines.append(f"signals[{count}] = rates[{wheel}]{factor}; /* {drive.names[count]} */")
            count += 1
    return lines


def _signals_of_car(drive: CarDrive) -> list[str]:
    wheels, ahead = len(drive.wheels), float(np.mean([along for along, _ in drive.ahead]))
    tangents = [
        f"{literal(ahead)} * tan(steering[{index}]) / ({literal(along)} + {literal(left)} * tan(steering[{index}]))"
        for index, (along, left) in enumerate(drive.ahead)
    ]
    total = " + ".join(f"rates[{wheel}]" for wheel in range(wheels))
    lines = [
        f"const double mean = ({total}) / {wheels}.0;",
        "double tangent = 0.0; /* of a wheel on the middle line */",
        *(f"tangent += {tangent};" for tangent in tangents),
        f"tangent /= {len(tangents)}.0;",
        "signals[0] = mean; /* mean */",
        "signals[1] = mean * tangent; /* mean_tan */",
    ]
    return [*lines, "signals[2] = rates[1] - rates[0]; /* difference */"] if wheels == 2 else lines


def _quoted(names: tuple[str, ...]) -> str:
    return ", ".join(f'"{name}"' for name in names)


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
    if omitted := left_out(calibration):
        lines.append(f"left out: effects {omitted}")
    return "\n".join(f" * {' '.join(line.split())}".replace("*/", "* /") for line in lines)
