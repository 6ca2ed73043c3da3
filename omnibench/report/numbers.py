"""Numbers as a person reads them."""

from __future__ import annotations

import math

NOTHING = "–"
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def fixed(value: float | None, decimals: int, signed: bool = False) -> str:
    """``value`` with so many decimals, a true minus sign and, if ``signed``, a plus."""
    if value is None or math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    text = f"{value:{'+' if signed else ''},.{decimals}f}"
    if float(text.replace(",", "")) == 0:  # no sign on a rounded zero
        text = text.lstrip("+-")
    return text.replace("-", "−")


def significant(value: float | None, digits: int = 3, signed: bool = False) -> str:
    """``value`` to so many significant digits; powers of ten where zeros would have to be counted."""
    if value is None or not math.isfinite(value) or value == 0:
        return fixed(value, 0, signed) if value is None or value else "0"
    exponent = math.floor(math.log10(float(f"{abs(value):.{digits - 1}e}")))
    if -4 <= exponent < 6:
        return fixed(value, max(0, digits - 1 - exponent), signed)
    mantissa = fixed(value / 10.0**exponent, digits - 1, signed)
    return f"{mantissa} × 10{str(exponent).translate(_SUPERSCRIPT)}"


def decimals_for(value: float | None, digits: int = 3) -> int:
    """Decimals that show ``value`` to so many significant digits, for a column that shares them; at most 9."""
    if value is None or not math.isfinite(value) or value == 0:
        return digits
    return min(9, max(0, digits - 1 - math.floor(math.log10(abs(value)))))


def percent(share: float | None, decimals: int = 1, signed: bool = False) -> str:
    """A share as per cent."""
    text = fixed(None if share is None else 100 * share, decimals, signed)
    return text if text == NOTHING else f"{text} %"


def count(value: float | None) -> str:
    """A number of things, in groups of three digits."""
    return fixed(value, 0)


def seconds(value: float | None) -> str:
    """A duration, to about three digits."""
    if value is None or not math.isfinite(value):
        return NOTHING
    if value < 1e-3:
        return "< 1 ms"
    if value < 1:
        return f"{significant(1e3 * value, 2)} ms"
    return f"{significant(value, 3) if value < 100 else fixed(value, 0)} s"


def power_of_ten(exponent: int) -> str:
    """``10⁻³``; small whole powers as they are."""
    plain = {-2: "0.01", -1: "0.1", 0: "1", 1: "10", 2: "100", 3: "1,000"}
    return plain.get(exponent, f"10{str(exponent).translate(_SUPERSCRIPT)}")


def span(low: float, high: float, decimals: int, signed: bool = False) -> str:
    """An interval's two ends."""
    return f"{fixed(low, decimals, signed)} to {fixed(high, decimals, signed)}"


def listing(names: list[str], limit: int = 8) -> str:
    """Names as ``a, b and c``; beyond ``limit`` their number."""
    shown = names[:limit] + ([f"{len(names) - limit} more"] if len(names) > limit else [])
    return " and ".join([", ".join(shown[:-1]), shown[-1]] if len(shown) > 1 else shown)


def plural(number: int, noun: str) -> str:
    """``1 run``, ``2 runs``."""
    irregular = {"entry": "entries", "trajectory": "trajectories", "repetition": "repetitions"}
    return f"{count(number)} {noun if number == 1 else irregular.get(noun, noun + 's')}"
