"""Types of arrays of floats, and arrays of what a user gives."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import PlainSerializer, PlainValidator

from omnibench.errors import DataError

Array = NDArray[np.floating[Any]]


def _as_lists(array: Array) -> list[Any]:
    """Nested lists; of texts where JSON has no number for an element."""
    return (array if np.isfinite(array).all() else array.astype(str)).tolist()


# An array as a field that pydantic writes as nested lists and reads back to the last bit.
JsonArray = Annotated[
    Array, PlainValidator(lambda values: np.array(values, dtype=float)), PlainSerializer(_as_lists, list[Any])
]


def finite_array(name: str, values: ArrayLike, dimensions: int) -> Array:
    """An array of finite numbers. DataError names it, and the row (1 is the first) of what is wrong."""
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise DataError(f"{name}: expected numbers, in rows of one length") from None
    if array.ndim != dimensions or not array.size:
        axes = "(rows,)" if dimensions == 1 else "(rows, columns)"
        raise DataError(f"{name} has shape {array.shape}, expected {axes}")
    for row in np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))[:1]:
        raise DataError(f"{name}, row {row + 1}: it holds a value that is missing or infinite")
    return array
