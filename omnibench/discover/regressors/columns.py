"""Groups of columns: the slopes of the poses by all parameters of an effect, or by all functions of a basis."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import BufferedRandom
from itertools import accumulate, pairwise
from typing import Literal, overload

import numpy as np
from numpy.typing import NDArray

from omnibench.discover.regressors.covariate_bases import Basis
from omnibench.robot.effects.effect import Effect, Forms, Parameter
from omnibench.robot.kinematics import Array

Kind = Literal["matrix", "effect", "covariate"]


@dataclass(frozen=True, eq=False)
class Group:
    """Columns that belong together; ``index`` says which of all columns they are.

    A group of an effect has its linear parameters in the columns' order, the values of its shapes, and the number of
    shapes that are tried; ``forms`` are the columns of the parameters by which its form can differ from the textbook's,
    ``family`` these parameters. A group of a generic basis has ``basis``.
    """

    kind: Kind
    name: str
    index: tuple[int, ...]
    effect: Effect | None = None
    parameters: tuple[Parameter, ...] = ()
    shapes: Mapping[str, float] = field(default_factory=dict)
    tries: int = 1
    forms: tuple[int, ...] = ()
    family: Forms | None = None
    basis: Basis | None = None


def best_shapes(groups: Sequence[Group], chi_square: Sequence[float]) -> list[int]:
    """Indices of the groups with the largest chi-square difference, one a name, in the order of the names."""
    best: dict[str, int] = {}
    for index, group in enumerate(groups):
        if chi_square[index] > chi_square[best.setdefault(group.name, index)]:
            best[group.name] = index
    return list(best.values())


_IN_MEMORY = 64_000_000  # bytes; what is beyond goes to a temporary file (chosen: two stores are open at a time)


@dataclass(frozen=True, eq=False)
class _Block:
    """Some of the runs. edges: of their rows. values: their rows, None if these are in the file, from ``offset`` on."""

    edges: tuple[int, ...]
    shape: tuple[int, ...]
    values: NDArray[np.float32] | None
    offset: int


class ColumnStore(Sequence[Array]):
    """Columns (K, ..., p) of each run, rounded to 32 bits; runs are read one after another, in the order of storing."""

    def __init__(self) -> None:
        self._blocks: list[_Block] = []
        self._file: BufferedRandom | None = None
        self._held = self._written = 0  # bytes

    def append(self, columns: Array, counts: Sequence[int]) -> None:
        """Add the columns (rows, ..., p) of some runs, of which each has so many of the rows."""
        values = np.ascontiguousarray(columns, dtype=np.float32)
        edges = tuple(accumulate(counts, initial=0))
        if self._held + values.nbytes > _IN_MEMORY and self._write(values):
            self._blocks.append(_Block(edges, values.shape, None, self._written - values.nbytes))
        else:
            self._held += values.nbytes
            self._blocks.append(_Block(edges, values.shape, values, 0))

    def _write(self, values: NDArray[np.float32]) -> bool:
        """Write to the file; False where there is no room for it."""
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the store
            self._file.seek(self._written)
            self._file.write(values.data)
        except OSError:
            return False
        self._written += values.nbytes
        return True

    def blocks(self) -> Iterator[tuple[slice, list[Array]]]:
        """Runs that are stored together, and the columns of each."""
        first = 0
        for block in self._blocks:
            values, last = self._read(block), first + len(block.edges) - 1
            yield slice(first, last), [values[low:high] for low, high in pairwise(block.edges)]
            first = last

    def _read(self, block: _Block) -> NDArray[np.float32]:
        if block.values is not None:
            return block.values
        assert self._file is not None  # the block is in it
        values = np.empty(block.shape, dtype=np.float32)
        self._file.seek(block.offset)
        self._file.readinto(values.data)
        return values

    @property
    def rows(self) -> int:
        """The number of rows of all runs."""
        return sum(block.shape[0] for block in self._blocks)

    def __iter__(self) -> Iterator[Array]:
        for _, of_runs in self.blocks():
            yield from of_runs

    def __len__(self) -> int:
        return sum(len(block.edges) - 1 for block in self._blocks)

    @overload
    def __getitem__(self, run: int) -> Array: ...
    @overload
    def __getitem__(self, run: slice) -> Sequence[Array]: ...
    def __getitem__(self, run: int | slice) -> Array | Sequence[Array]:
        if isinstance(run, slice):
            return list(self)[run]
        for runs, columns in self.blocks():
            if run < runs.stop:
                return columns[run - runs.start]
        raise IndexError(run)
