"""The problem that a run of a comparison is given."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from omnibench.compare.config import CalibratorEntry, CompareConfig
from omnibench.data.dataset import Trajectory
from omnibench.fit.parameterisation import ParameterisationName
from omnibench.fit.problem import CalibrationProblem, make_parameterisation
from omnibench.registry import costs
from omnibench.robot.kinematics import Robot


def make_problem(
    config: CompareConfig,
    entry: CalibratorEntry,
    robot: Robot,
    trajectories: Sequence[Trajectory],
    parameterisation: ParameterisationName,
    seed: int = 0,
    watch: Callable[[int, float], None] | None = None,
) -> CalibrationProblem:
    """The config's cost, box and budget on some trajectories, as an entry is to see them."""
    box = entry.box or config.box
    searched = make_parameterisation(
        parameterisation, robot, trajectories, box=box, limits=entry.limits, unidentified=config.unidentified
    )
    return CalibrationProblem(
        robot,
        trajectories,
        costs.create(config.cost.name, config.cost.options),
        searched,
        integration=config.integration,
        budget=config.budget,
        seed=seed,
        watch=watch,
    )
