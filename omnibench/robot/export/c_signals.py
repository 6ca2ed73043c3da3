"""C99 code for the drive signals of robots with steered wheels, as wheels/drive.py computes them."""

from __future__ import annotations

import numpy as np

from omnibench.robot.wheels.drive import CarDrive, Drive


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


def middle(prefix: str, gain: float, zero: float) -> str:
    """The part of a step that takes the steering angles in the middle of the sample and makes the signals.

    gain: true angles for measured ones, to which zero, rad, is added.
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
    {prefix}_drive_signals(signals, rates, middle);
"""


def literal(value: float) -> str:
    """A C literal that is read as exactly the same double."""
    text = f"{float(value):.17g}"
    return text if any(mark in text for mark in ".e") else f"{text}.0"


def _signals(drive: Drive) -> list[str]:
    if isinstance(drive, CarDrive):
        return _of_car(drive)
    lines, count = [], 0
    for wheel, pair in enumerate(drive.pairs):
        factors = [""] if pair < 0 else [f" * cos(steering[{pair}])", f" * sin(steering[{pair}])"]
        for factor in factors:
            lines.append(f"signals[{count}] = rates[{wheel}]{factor}; /* {drive.names[count]} */")
            count += 1
    return lines


def _of_car(drive: CarDrive) -> list[str]:
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
