"""Numbers formatted for readers: decimals, significant digits, per cent, durations, lists and plurals."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from omnibench.data.dataset import Trajectory
from omnibench.report.blocks import LegendItem

if TYPE_CHECKING:
    from omnibench.robot.calibration import Noise
from omnibench.words import plural

NOTHING = "–"
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def fixed(value: float | None, decimals: int, signed: bool = False) -> str:
    """``value`` with ``decimals`` decimals, a typographic minus sign and, if ``signed``, a plus sign."""
    if value is None or math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    text = f"{value:{'+' if signed else ''},.{decimals}f}"
    if float(text.replace(",", "")) == 0:  # no sign on a rounded zero
        text = text.lstrip("+-")
    return text.replace("-", "−")


def significant(value: float | None, digits: int = 3, signed: bool = False) -> str:
    """``value`` to ``digits`` significant digits, with a power of ten below 10⁻⁴ and from 10⁶ on."""
    if value is None or not math.isfinite(value) or value == 0:
        return fixed(value, 0, signed) if value is None or value else "0"
    exponent = math.floor(math.log10(float(f"{abs(value):.{digits - 1}e}")))
    if -4 <= exponent < 6:
        return fixed(value, max(0, digits - 1 - exponent), signed)
    mantissa = fixed(value / 10.0**exponent, digits - 1, signed)
    return f"{mantissa} × 10{str(exponent).translate(_SUPERSCRIPT)}"


def plain(value: float) -> str:
    """A given value, as short as it can be written, with a typographic minus sign."""
    return f"{value:g}".replace("-", "−")


def decimals_for(value: float | None, digits: int = 3) -> int:
    """The decimals (at most 9) that show ``value`` to ``digits`` significant digits, for a column that shares them."""
    if value is None or not math.isfinite(value) or value == 0:
        return digits
    return min(9, max(0, digits - 1 - math.floor(math.log10(abs(value)))))


def percent(share: float | None, decimals: int = 1, signed: bool = False) -> str:
    """A share between 0 and 1 as per cent."""
    text = fixed(None if share is None else 100 * share, decimals, signed)
    return text if text == NOTHING else f"{text} %"


def count(value: float | None) -> str:
    """A whole number, in groups of three digits."""
    return fixed(value, 0)


def seconds(value: float | None) -> str:
    """A duration given in s, as ms or s to about three digits."""
    if value is None or not math.isfinite(value):
        return NOTHING
    if value < 1e-3:
        return "< 1 ms"
    if value < 1:
        return f"{significant(1e3 * value, 2)} ms"
    return f"{significant(value, 3) if value < 100 else fixed(value, 0)} s"


def power_of_ten(exponent: int) -> str:
    """A power of ten as a reader writes it: ``10⁻³``, but ``0.01`` to ``1,000`` in full."""
    plain = {-2: "0.01", -1: "0.1", 0: "1", 1: "10", 2: "100", 3: "1,000"}
    return plain.get(exponent, f"10{str(exponent).translate(_SUPERSCRIPT)}")


def span(low: float, high: float, decimals: int, signed: bool = False) -> str:
    """An interval: ``low to high``."""
    return f"{fixed(low, decimals, signed)} to {fixed(high, decimals, signed)}"


def with_unit(number: str, unit: str) -> str:
    """A number with its unit; the degree sign follows without a space."""
    return f"{number}{unit}" if unit.startswith("°") else f"{number} {unit}".rstrip()


def typeset(sentence: str) -> str:
    """A sentence of the terminal as reports write it, with arrows, minus signs and degree signs."""
    return re.sub(r"(?<=\d) deg\b", "°", re.sub(r"(?<![\w.])-(?=\d)", "−", sentence.replace(" -> ", " → ")))


def noise_in_words(noise: Noise) -> tuple[str, str]:
    """The noise of positions and of headings in words, without components that are zero."""
    shown = []
    for what, factor, unit in (("position", 1e3, " mm"), ("heading", math.degrees(1.0), "°")):
        kinds = (("white", "pose", ""), ("walk", "walk", "/√s"), ("bias of a run", "bias", ""))
        sizes = [(words, factor * getattr(noise, f"{kind}_{what}"), per) for words, kind, per in kinds]
        parts = [f"{words} {significant(size, 2)}{unit}{per}" for words, size, per in sizes if size > 0]
        shown.append(", ".join(parts) or "none")
    return shown[0], shown[1]


def listing(names: list[str], limit: int = 8, last: str = "and") -> str:
    """Names as ``a, b and c``; those beyond ``limit`` are counted."""
    shown = names[:limit] + ([f"{len(names) - limit} more"] if len(names) > limit else [])
    return f" {last} ".join([", ".join(shown[:-1]), shown[-1]] if len(shown) > 1 else shown)


# Colours of motions, from the most negative to the most positive rate of turn.
_COLOURS = ("#0072b2", "#5b6772", "#d97706", "#aa3377", "#4fb0e8", "#7b4b2a", "#8f8f1f")
MOST_MOTIONS = len(_COLOURS)
Motion = tuple[float, float]  # speed, m/s, and rate of turn, rad/s


def motion_of(run: Trajectory) -> Motion:
    """Speed and rate of turn of a command, rounded so that repetitions of a measured command agree."""
    return round(run.v or 0.0, 2), round(run.omega or 0.0, 2)


def direction_of(run: Trajectory) -> float:
    """Commanded direction in the robot's frame, deg, from 0 to 360."""
    return round(math.degrees(run.alpha or 0.0), 3) % 360


def motion_in_words(name: str, speed: float | None, direction: float | None, turn_rate: float | None) -> str:
    """A command as ``0.2 m/s at 30°, −0.35 rad/s``; its name if speed, m/s, direction, rad, or rate are not known."""
    if speed is None or direction is None or turn_rate is None:
        return name
    turn = f"{turn_rate:.3g} rad/s".replace("-", "−")
    if speed == 0:
        return f"on the spot, {turn}"
    return f"{speed:.3g} m/s at {fixed(math.degrees(direction) % 360, 0)}°, {turn if turn_rate else 'straight'}"


_WAYS = {0.0: "forward", 90.0: "sideways to the left", 180.0: "backward", 270.0: "sideways to the right"}  # deg


def drive_in_words(
    name: str, speed: float | None, direction: float | None, rate: float | None, seconds: float, metres: float
) -> str:
    """A command as a person drives it: ``forward 2 m at 0.5 m/s, turning left by 90° with radius 1.2 m``.

    Its name if speed, m/s, direction, rad, or rate of turn, rad/s, are not known.
    """
    if speed is None or direction is None or rate is None:
        return name
    turned = math.degrees(abs(rate) * (metres / speed if speed else seconds))
    turns = plural(round(turned / 360), "full turn") if turned > 359 else f"{fixed(turned, 0)}°"
    side = "left" if rate > 0 else "right"
    if not speed:
        return f"on the spot {turns} to the {side} at {significant(abs(rate), 2)} rad/s"
    degrees = round(math.degrees(direction), 3) % 360
    aside = f"at {fixed(min(degrees, 360 - degrees), 0)}° to the {'left' if degrees < 180 else 'right'} of forward,"
    length = f"{significant(metres, 2)} m at {significant(speed, 2)} m/s"
    turning = f", turning {side} by {turns} with radius {significant(speed / abs(rate), 2)} m" if rate else ""
    return f"{_WAYS.get(degrees, aside)} {length}{turning}"


def moves(run: Trajectory) -> bool:
    """True unless the command is known to turn the robot on the spot."""
    return run.v is None or run.v > 0


def motion_items(motions: Sequence[Motion]) -> list[LegendItem]:
    """The legend of at most seven motions; it gives speeds where they differ."""
    several = len({speed for speed, _ in motions}) > 1
    names = [
        f"ω = {fixed(rate, 2)} rad/s" + (f", v = {fixed(speed, 2)} m/s" if several else "") for speed, rate in motions
    ]
    return [
        LegendItem(f"turn-{i}", name, colour) for i, (name, colour) in enumerate(zip(names, _COLOURS, strict=False))
    ]
