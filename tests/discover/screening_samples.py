"""Screenings of a few columns of which everything is known: the information of the columns, and what each explains.

There are 20 runs of five rows. A column is the same vector over sqrt(20) in each run, so that the information of all
columns is the Gram matrix of the vectors. The noise of each row is +1 or -1 and adds up to nothing over the runs: the
residuals have exactly the chi-square along each row that they are made for, and chance makes 1 of each column.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from omnibench.discover.covariates import Basis
from omnibench.discover.screening import Groups, Screening
from omnibench.discover.significance import ColumnStore, Group
from omnibench.fit.trajectory_fit import Whitened
from omnibench.registry import effects
from omnibench.robot.effects.effect import Parameter

RUNS = 20
MATRIX, FIRST, SECOND, THIRD, FOURTH = np.eye(5)
PARAMETER = Parameter("k", "1", -0.1, 0.1, "size")
POSITIVE = Parameter("k", "1", 0.0, 0.1, "size, never negative")


def screening(
    named: Mapping[str, Sequence[float]],
    bases: Mapping[str, Sequence[float]],
    gains: Sequence[float],
    *,
    parameter: Parameter = PARAMETER,
    tries: Mapping[str, int] | None = None,
) -> Screening:
    """A screening of one column for the matrix, each effect and each basis, by its vector (5,).

    named: effects of the catalogue by name. gains (5,): roots of the chi-square along each row.
    """
    vectors = np.column_stack([MATRIX, *named.values(), *bases.values()])
    columns = tuple(vectors / np.sqrt(RUNS) for _ in range(RUNS))
    residuals = tuple(np.array(gains) / np.sqrt(RUNS) + signs for signs in _balanced())
    groups = [
        Group("effect", name, (index,), effects.create(name), (parameter,), tries=(tries or {}).get(name, 1))
        for index, name in enumerate(named, 1)
    ]
    generic = [
        Group("covariate", name, (index,), basis=Basis(name, "body", f"the {name}"))
        for index, name in enumerate(bases, 1 + len(named))
    ]
    data = Whitened(
        residuals,
        columns,
        vectors.T @ vectors,
        np.array([of_run.T @ values for of_run, values in zip(columns, residuals, strict=True)]),
    )
    every = Groups(Group("matrix", "matrix", (0,)), tuple(groups), tuple(generic), ColumnStore(), ())
    return Screening(every, data, np.arange(RUNS) % 5)


def _balanced() -> np.ndarray:
    """Signs (20, 5) that add up to 0 over the runs, as do the products of any two columns.

    They are columns of a Hadamard matrix of order 20, by Paley's construction from the squares modulo 19.
    """
    squares = {number * number % 19 for number in range(1, 19)}
    character = np.array([0 if number == 0 else 1 if number in squares else -1 for number in range(19)])
    differences = (np.arange(19)[:, None] - np.arange(19)) % 19
    skew = np.block([[np.zeros((1, 1)), np.ones((1, 19))], [-np.ones((19, 1)), character[differences]]])
    hadamard = np.eye(20) + skew
    signs: np.ndarray = (hadamard * hadamard[:, :1])[:, 1:6]
    return signs
