"""What a simulation makes: a data set and, apart from it, what is hidden in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from omnibench.data.dataset import Dataset
from omnibench.data.true_poses import TruePath
from omnibench.robot.kinematics import Array
from omnibench.simulate.chain.floor_plan import FloorPlan
from omnibench.simulate.truth import TruthRecord


@dataclass(frozen=True)
class Simulation:
    """A simulated data set and, apart from it, the truth behind it.

    Of a robot that was simulated from command to SLAM also: paths: where it truly was in each run. plan: its room.
    starts: its true start pose (3,) in the room for each run, m, m, rad.
    """

    dataset: Dataset
    truth: TruthRecord
    paths: Mapping[str, TruePath] = field(default_factory=dict)
    plan: FloorPlan | None = None
    starts: Mapping[str, Array] = field(default_factory=dict)
