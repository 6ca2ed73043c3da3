"""Parsing the content of requests to a robot: a pose, a time, a calibration."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from typing import Final

from pydantic import Field, FiniteFloat

from omnibench.config import Model, parse_yaml, validate
from omnibench.errors import ConfigError, DataError
from omnibench.robot.calibration import Calibration, parse_calibration

LONGEST: Final = 1 << 17  # bytes of a request: 48 KiB of weights, in base64, and 60 KB of driven motions beside them
_NANOSECONDS: Final = 10**14  # values of ``at`` from this on are ns: as s they would be 3 million years from now
_LAST: Final = 2**63 - 1  # ns, the last time in 64 bits
_LONGEST_NUMBER: Final = 40  # characters of a time; chosen
_MAX_CALIBRATION_VALUES: Final = 5_000  # enough for 20 wheels; parsing more would delay samples (chosen)
_MAX_POSE_VALUES: Final = 20  # a mapping with all five keys and their values counts as eleven


class PoseOrder(Model):
    """The content of a ``set_pose`` request: m and rad in the map."""

    x: FiniteFloat = Field(ge=-1e7, le=1e7)
    y: FiniteFloat = Field(ge=-1e7, le=1e7)
    theta: FiniteFloat = Field(ge=-100.0, le=100.0)
    position_sigma: FiniteFloat = Field(0.05, ge=1e-6, le=1e4, description="standard deviation, m")
    heading_sigma: FiniteFloat = Field(0.05, ge=1e-6, le=10.0, description="standard deviation, rad")


def read_pose(payload: bytes, parameters: dict[str, str]) -> PoseOrder:
    """A pose from a payload in JSON or YAML or, without one, from the parameters. ConfigError in one line."""
    where = "set_pose"
    if not payload:
        return validate(PoseOrder, parameters, where)
    try:
        text = payload.decode()
    except UnicodeDecodeError:
        raise ConfigError(f"{where}: the payload is not text; send x, y (m) and theta (rad) in JSON") from None
    return validate(PoseOrder, parse_yaml(text, where, _MAX_POSE_VALUES), where)  # JSON is a part of YAML


def read_time(text: str) -> int:
    """A time in s, or in ns if it is 10^14 or more, as ns. ConfigError in one line.

    It is read as a decimal number, because a float of today's time in s is only exact to 0.2 us.
    """
    try:
        number = Decimal(text if len(text) <= _LONGEST_NUMBER else "too long")
        if number.is_finite() and number.adjusted() < 20:  # digits before the point; more would be costly to multiply
            nanoseconds = int(number) if abs(number) >= _NANOSECONDS else int((number * 10**9).to_integral_value())
            if abs(nanoseconds) <= _LAST:
                return nanoseconds
    except InvalidOperation:
        pass
    shown = text if len(text) <= _LONGEST_NUMBER else f"{text[:_LONGEST_NUMBER]}..."
    raise ConfigError(f"at: {shown!r} is not a time; give s since 1970, as 1800000000.25")


def read_sent_calibration(payload: bytes, where: str) -> Calibration:
    """Parse a calibration that came over the network. DataError begins with ``where`` and says what is wrong."""
    try:
        text = payload.decode()
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: not a text in UTF-8: {error}") from None
    return parse_calibration(text, where, _MAX_CALIBRATION_VALUES)
