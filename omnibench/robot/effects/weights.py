"""Weights of learned effects in a calibration file: base64 of little-endian float32 numbers."""

from __future__ import annotations

import base64
import binascii
from typing import Final

import numpy as np

from omnibench.errors import DataError
from omnibench.robot.kinematics import Array

MOST_BYTES: Final = 48 * 1024  # decoded: with the rest of a calibration they fit in a request to the live node
_NUMBER = np.dtype("<f4")


def encode_weights(weights: Array) -> str:
    """Weights (n,) as text. DataError: they would be refused by ``decode_weights``."""
    text = base64.b64encode(np.asarray(weights, dtype=_NUMBER).tobytes()).decode("ascii")
    decode_weights(text)
    return text


def decode_weights(text: str, prefix: str = "weights") -> Array:
    """Weights (n,) of a text, as float64.

    DataError, in one line that begins with ``prefix``: the text is no base64, too long, no whole number of float32, or
    holds NaN or infinity.
    """
    if len(text) > 4 * MOST_BYTES // 3 + 4:
        raise DataError(f"{prefix} are longer than {MOST_BYTES // 1024} KiB; train a smaller network")
    try:
        content = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise DataError(f"{prefix} are not base64; copy them whole, or calibrate again") from None
    if len(content) > MOST_BYTES:
        raise DataError(f"{prefix} are longer than {MOST_BYTES // 1024} KiB; train a smaller network")
    if not content or len(content) % _NUMBER.itemsize:
        raise DataError(f"{prefix} are {len(content)} bytes, which is no whole number of float32; copy them whole")
    weights = np.frombuffer(content, dtype=_NUMBER).astype(float)
    if not np.isfinite(weights).all():
        raise DataError(f"{prefix} hold NaN or infinity; calibrate again")
    return weights
