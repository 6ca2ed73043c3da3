"""How far a matrix that was fitted freely lies from a robot's design, in what designs, tyres and floors may be off.

With k the elements of a fitted matrix K (3, M) and k0 the design's, the distance is

    d^2 = (k - k0)^T (V + S)^-1 (k - k0),                                                        (1)

V being the covariance of the fit and S that of real robots about their designs: a radius and a gain of every row, the
yaw and place of the tracked point, and small errors of all elements. Directions that are not driven have a huge V and
add nothing, so that no mistake is claimed of what the recording does not show.

Over OptiOdom's four robots, a Robotino and simulated ones d^2 is at most 3.9, in whole sets and single sessions.
"""

from __future__ import annotations

import numpy as np

from omnibench.data.checks.motion_fit import FreeFit
from omnibench.robot.kinematics import Array, Robot

# Standard deviations by which robots differ from their designs, as shares (chosen; OptiOdom's tricycle is 7 % off in
# row 3, omni3's rows 1 and 2 by 10 %): radius of each wheel, gains of rows x, y and heading, each element.
_RADIUS, _GAINS, _ELEMENT = 0.06, (0.05, 0.05, 0.12), 0.02
_LATERAL = 0.2  # the gain of row y of mecanum wheels, which slip sideways; chosen
_SKID = 0.5  # the gain of row 3 of a skid-steered robot, which turns 20 to 50 % less than its design
_YAW = 0.035  # rad of the tracked point's heading; chosen, 2 degrees
_PLACE = 0.1  # of the tracked point, in robot sizes; chosen


class DesignDistance:
    """Distances of fits from the design of one robot, Eq. (1)."""

    def __init__(self, robot: Robot) -> None:
        self.design = robot.inverse_kinematic_matrix
        scales = robot.row_scales
        self._outside = beyond_twists(robot)
        self._units = np.repeat(1 / scales, self.design.shape[1])
        self._allowed = _allowed(robot, scales) * np.outer(self._units, self._units)

    def squared(self, matrices: Array, covariances: Array) -> Array:
        """d^2 (P,) of matrices (P, 3, M) whose rows have covariances (P, 3, M, M)."""
        count, _, columns = matrices.shape
        whole = np.zeros((count, 3 * columns, 3 * columns))
        for row in range(3):
            block = slice(row * columns, (row + 1) * columns)
            whole[:, block, block] = covariances[:, row]
        off = (matrices - self.design).reshape(count, -1) * self._units
        whole = whole * np.outer(self._units, self._units) + self._allowed
        squared: Array = np.einsum("pi,pi->p", off, np.linalg.solve(whole, off[..., None])[..., 0])
        return squared

    def of(self, fit: FreeFit) -> float:
        """d^2 of one fit."""
        return float(self.squared(fit.matrix[None], fit.covariance[None])[0])

    def contradictions(self, gram: Array, columns: Array) -> Array:
        """Shares (P,) of the signals that no motion of the robot gives, by which its wheels contradict each other.

        gram (M, M): sum of products of the signals as recorded. columns (P, M, M): from those meant to those recorded.
        """
        meant = np.linalg.inv(columns)
        grams = meant @ gram @ np.swapaxes(meant, 1, 2)
        whole = np.maximum(np.trace(grams, axis1=1, axis2=2), 1e-300)
        outside = np.einsum("ij,pjk,ik->p", self._outside, grams, self._outside)
        shares: Array = np.sqrt(np.maximum(outside, 0.0) / whole)
        return shares


def beyond_twists(robot: Robot) -> Array:
    """The projection (M, M) that takes from drive signals those that a twist of the robot gives."""
    equations = robot.signal_equations @ robot.allowed_basis
    within, strengths, _ = np.linalg.svd(equations, full_matrices=False)
    within = within[:, strengths > 1e-9 * strengths[0]]
    outside: Array = np.eye(len(equations)) - within @ within.T
    return np.where(np.abs(outside) < 1e-12, 0.0, outside)


def _allowed(robot: Robot, scales: Array) -> Array:
    """S (3M, 3M)."""
    design = robot.inverse_kinematic_matrix
    lateral = _LATERAL if any(wheel.kind == "mecanum" for wheel in robot.wheels) else _GAINS[1]
    gains = (_GAINS[0], lateral, _SKID if robot.skid else _GAINS[2])
    columns = range(design.shape[1])
    changes = [_RADIUS * design * (np.arange(design.shape[1]) == column) for column in columns]
    changes += [gain * design * (np.arange(3) == row)[:, None] for row, gain in enumerate(gains)]
    changes.append(_YAW * np.array([-design[1], design[0], 0 * design[2]]))
    zero = np.zeros_like(design[0])
    changes += [_PLACE * robot.reach * np.array(rows) for rows in ([design[2], zero, zero], [zero, design[2], zero])]
    flat = np.array(changes).reshape(len(changes), -1)
    elements = np.repeat((_ELEMENT * scales) ** 2, design.shape[1])
    allowed: Array = flat.T @ flat + np.diag(elements)
    return allowed


def transformed(fit: FreeFit, rows: Array, columns: Array) -> tuple[Array, Array]:
    """Matrices (P, 3, M) and covariances (P, 3, M, M) of a fit for other readings of what was recorded.

    rows (P, 3, 3): from a twist as recorded to the one meant. columns (P, M, M): from the signals that are meant to
    those recorded.
    """
    matrices = rows @ fit.matrix @ columns
    turned = np.einsum("pij,jkl->pikl", rows**2, fit.covariance)
    covariances: Array = np.swapaxes(columns, 1, 2)[:, None] @ turned @ columns[:, None]
    return matrices, covariances
