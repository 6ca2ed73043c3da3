"""Types of arrays of floats, and arrays and tables of what a user gives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import PlainSerializer, PlainValidator

from omnibench.errors import DataError

if TYPE_CHECKING:
    import polars as pl

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


def frame_of(name: str, content: Any) -> pl.DataFrame:
    """A data frame or a dict of columns as a Polars frame. DataError names the table and the column that is unfit."""
    import polars as pl  # takes longer than all that imports this module

    if isinstance(content, pl.DataFrame):
        return content
    names = content if isinstance(content, Mapping) else getattr(content, "columns", None)  # as pandas has them
    if names is None:
        raise DataError(f"{name}: expected a data frame or a dict of arrays, found {type(content).__name__}")
    arrays = {str(column): np.atleast_1d(np.asarray(content[column])) for column in names}
    for column, array in arrays.items():
        first = next(iter(arrays))
        if array.ndim != 1:
            raise DataError(f"{name}: column {column!r} has shape {array.shape}; give a column for each wheel or axis")
        if len(array) != len(arrays[first]):
            raise DataError(f"{name}: column {column!r} has {len(array)} rows, {first!r} has {len(arrays[first])}")
    return pl.DataFrame(
        {column: array.tolist() if array.dtype == object else array for column, array in arrays.items()}, strict=False
    )
