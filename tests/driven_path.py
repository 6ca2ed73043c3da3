"""The path of one run, as tests take it where the odometry has those of many."""

import numpy as np

from omnibench.robot.kinematics import Array
from omnibench.robot.odometry import Integration, PathBatch, RunSamples


class DrivenPath:
    """The path of one run of F samples.

    times (F,): ends of the samples, s. start (3,): pose at t = 0. moved (F, 3), drift (F, 2): as for ``PathBatch``.
    """

    def __init__(
        self, times: Array, start: Array, moved: Array, integration: Integration, drift: Array | None = None
    ) -> None:
        self._batch = PathBatch(RunSamples.of([times]), np.asarray(start)[None], moved, integration, drift)

    def poses(self, stamps: Array) -> Array:
        """Poses (S, 3) in m, m, rad at stamps (S,) in s, in any order; headings are not wrapped."""
        return self._batch.poses([stamps])[0]
