"""The fast evaluator of runs that are read where they are used: one for each part of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnibench.fit.evaluator.driven_frame import DrivenFrame
from omnibench.fit.evaluator.element_box import ElementBox
from omnibench.fit.evaluator.evaluator import PoseEvaluator, make_evaluator
from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, OdometryBatch, WheelLog
from omnibench.robot.stored.odometry_of_stored import together


@dataclass(frozen=True, eq=False)
class PartedEvaluator:
    """Poses at the stamps of many logs, as PoseEvaluator gives them, by the evaluators of parts of the logs."""

    parts: Sequence[PoseEvaluator]

    def covers(self, matrices: Array) -> NDArray[np.bool_]:
        """True (P,) for the matrices (P, 3, N) that lie in the box."""
        return self.parts[0].covers(matrices)

    def poses(self, matrices: Array) -> Array:
        """Poses (P, S, 3) of matrices (P, 3, N) in the box, see PoseEvaluator."""
        return np.concatenate([part.poses(matrices) for part in self.parts], axis=1)


def make_parted_evaluator(
    logs: Sequence[WheelLog], integration: Integration, box: ElementBox, frame: DrivenFrame | None
) -> PartedEvaluator | None:
    """The evaluator of logs for matrices in a box; None where that of a part is None. frame: of the matrices."""
    parts = []
    for part in together(logs):
        seen = part if frame is None else frame.logs(part)
        evaluator = make_evaluator(OdometryBatch(seen, integration), seen, integration, box)
        if evaluator is None:
            return None
        parts.append(evaluator)
    return PartedEvaluator(parts)
