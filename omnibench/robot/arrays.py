"""Types of arrays of floats."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import PlainSerializer, PlainValidator

Array = NDArray[np.floating[Any]]


def _as_lists(array: Array) -> list[Any]:
    """Nested lists; of texts where JSON has no number for an element."""
    return (array if np.isfinite(array).all() else array.astype(str)).tolist()


# An array as a field that pydantic writes as nested lists and reads back to the last bit.
JsonArray = Annotated[
    Array, PlainValidator(lambda values: np.array(values, dtype=float)), PlainSerializer(_as_lists, list[Any])
]
