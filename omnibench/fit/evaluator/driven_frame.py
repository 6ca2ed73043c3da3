"""Recordings and matrices in the coordinates of the directions that the recordings drive.

Along directions that a calibration keeps at the design K0, matrices do not differ. With orthonormal rows Q (r, M) of
the others, a matrix K moves the robot by

    K u = (K Q') (Q u) + K0 (u - Q'Q u),                                                          (1)

so that it is a matrix of r + 3 columns, K Q' and the identity, for the signals Q u and the design's twist by the rest.
The evaluator's expansion grows fast with the number of columns whose row 3 varies, which are then r in the place of M:
three for a mecanum base that does not slip, and for a swerve base whose modules are steered as they should be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from omnibench.fit.parameterisation import MatrixElements, ParameterisationName
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import WheelLog


@dataclass(frozen=True, eq=False)
class DrivenFrame:
    """The coordinates: ``driven`` Q (r, M), and the design K0 (3, M) of Eq. (1)."""

    searched: MatrixElements
    driven: Array
    design: Array

    @classmethod
    def of(cls, searched: MatrixElements) -> DrivenFrame:
        """The frame of the directions along which a parameterisation does not keep the design."""
        signals = searched.null.shape[1]
        _, _, directions = np.linalg.svd(np.vstack([searched.null, np.zeros((signals, signals))]))
        return cls(searched, directions[len(searched.null) :], searched.robot.inverse_kinematic_matrix)

    @property
    def name(self) -> ParameterisationName:
        return self.searched.name

    def matrices(self, vectors: Array) -> Array:
        """Matrices (P, 3, r + 3) of vectors (P, n)."""
        return self.seen(self.searched.matrices(vectors))

    def seen(self, matrices: Array) -> Array:
        """Matrices (P, 3, M) in the frame, (P, 3, r + 3)."""
        rest = np.broadcast_to(np.eye(3), (len(matrices), 3, 3))
        return np.concatenate([matrices @ self.driven.T, rest], axis=2)

    def logs(self, logs: Sequence[WheelLog]) -> list[WheelLog]:
        """Logs whose signals are those of the frame."""
        moved = []
        for log in logs:
            along = log.signals @ self.driven.T
            rest = (log.signals - along @ self.driven) @ self.design.T
            moved.append(replace(log, rates=np.hstack([along, rest]), wheel_angles=None, steering=None, drive=None))
        return moved
