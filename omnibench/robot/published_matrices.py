"""Matrices published for the APR-02 robot, for comparison and simulation."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from omnibench.errors import UnknownNameError
from omnibench.robot.kinematics import Array

_ROWS: Mapping[str, tuple[tuple[float, float, float], ...]] = MappingProxyType(
    {
        # Eq. (8): the parametric calibration of the authors' earlier work.
        "palacin2023_eq8": (
            (-0.0892930568372762, -0.0005606566978203, 0.0867466159313470),
            (0.0520955668635434, -0.1010213675626970, 0.0533117820461363),
            (0.2364093797047320, 0.2341358647406650, 0.2353792947863630),
        ),
        # Eq. (9): the genetic, non-parametric calibration of the article.
        "palacin2023_eq9": (
            (-0.0883286476963123, 0.0000000000000000, 0.0873330402667908),
            (0.0522829495809178, -0.1008246738469390, 0.0536189007203205),
            (0.2357044251338890, 0.2338948216993490, 0.2348793373133590),
        ),
    }
)
PUBLISHED = tuple(_ROWS)


def published_matrix(name: str) -> Array:
    """A published inverse kinematic matrix (3, 3) of the APR-02. UnknownNameError lists the names."""
    if name not in _ROWS:
        raise UnknownNameError("published matrix", name, _ROWS)
    return np.array(_ROWS[name])
