"""Groups of columns: the slopes of the poses by all parameters of an effect, or by all functions of a basis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from omnibench.discover.regressors.covariate_bases import Basis
from omnibench.robot.effects.effect import Effect, Forms, Parameter

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
