"""Error that remains of a calibrated matrix in software that cannot hold it, on the motions that the robot can drive.

With the motions T (3, D) of a robot and its design's signal equations E (M, 3), it drives along the signals U = E T
(M, D). The true matrix K makes of them the motions K U, of which P = T^+ takes the D coordinates; so the signals
U (P K U)^-1 move the robot by one metre ahead, or aside, or by one radian, and a matrix L in the place of K errs by

    (L - K) U (P K U)^-1                                                                                   (1)

in x, y and heading. Software that reads Q = D numbers A u of the signals u sees of K the matrix K U (A U)^-1.  (2)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from omnibench.robot.kinematics import Array, Mount, Robot


@dataclass(frozen=True)
class RemainingError:
    """Odometry error of a matrix against another, in the worst direction of straight driving and on the spot."""

    straight_position: float  # m per m
    straight_heading: float  # rad per m
    turn_position: float  # m per rad
    turn_heading: float  # rad per rad

    def __str__(self) -> str:
        return (
            f"{1000 * self.straight_position:.1f} mm and {math.degrees(self.straight_heading):.2f} deg a metre, "
            f"{math.degrees(self.turn_heading * 2 * math.pi):.1f} deg and {2000 * math.pi * self.turn_position:.1f} mm "
            "a full turn"
        )


def remaining_errors(robot: Robot, used: Array, true: Array, base: Mount | None = None) -> Array:
    """Errors (3, D), Eq. (1), of odometry with the matrix ``used`` (3, M) on a robot whose matrix is ``true`` (3, M).

    base: the frame of the robot that both matrices are of; default: its centre.
    """
    motions, signals = driven_motions(robot, base)
    errors: Array = (used - true) @ signals @ np.linalg.inv(np.linalg.pinv(motions.T) @ true @ signals)
    return errors


def remaining_error(robot: Robot, used: Array, true: Array, base: Mount | None = None) -> RemainingError:
    """The errors of ``remaining_errors`` in the worst direction of straight driving and on the spot."""
    errors = remaining_errors(robot, used, true, base)
    return RemainingError(
        float(np.linalg.norm(errors[:2, :-1], 2)),
        float(np.linalg.norm(errors[2, :-1])),
        float(np.linalg.norm(errors[:2, -1])),
        float(abs(errors[2, -1])),
    )


def driven_motions(robot: Robot, base: Mount | None = None) -> tuple[Array, Array]:
    """Motions (D, 3) of a frame of a robot that it can drive, and the design's signals (M, D) for them.

    Straight by 1 m, aside where it can, too, and a turn by 1 rad: on the spot, or as nearly as it can. base: the frame;
    default: the robot's centre.
    """
    frame = (base or Mount()).twist
    motions = robot.motions @ frame.T
    turn = motions[-1] / motions[-1, 2]
    straight = motions[:-1] - np.outer(motions[:-1, 2], turn)
    straight /= np.linalg.norm(straight, axis=1, keepdims=True)
    motions = np.vstack([straight, turn - straight.T @ (straight @ turn)])
    return motions, robot.signal_equations @ np.linalg.solve(frame, motions.T)


def as_read(robot: Robot, matrix: Array, reading: Array) -> Array:
    """The matrix (3, D) that acts on what software reads, Eq. (2), for a matrix (3, M) and the reading A (D, M)."""
    _, signals = driven_motions(robot)
    seen: Array = matrix @ signals @ np.linalg.inv(reading @ signals)
    return seen


def of_centre(robot: Robot, matrix: Array) -> Array:
    """The matrix (3, M) of a robot's centre from that of its tracked point."""
    centre: Array = matrix if robot.mount is None else np.linalg.solve(robot.mount.twist, matrix)
    return centre
