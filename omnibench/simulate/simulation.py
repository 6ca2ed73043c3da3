"""Result of a simulation: a data set and, apart from it, the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from omnibench.data.dataset import Dataset
from omnibench.data.true_poses import TruePath
from omnibench.robot.kinematics import Array
from omnibench.simulate.floor_plan import FloorPlan
from omnibench.simulate.truth import TruthRecord
from omnibench.views import Brief


@dataclass(frozen=True, repr=False)
class Simulation(Brief):
    """A simulated data set and, apart from it, the truth behind it.

    The robot simulator also gives paths: the true path of each run. plan: the room. starts: the true start pose (3,) in
    the room of each run, m, m, rad.
    """

    dataset: Dataset
    truth: TruthRecord
    paths: Mapping[str, TruePath] = field(default_factory=dict)
    plan: FloorPlan | None = None
    starts: Mapping[str, Array] = field(default_factory=dict)
