"""Small flower experiments with hidden effects, and what is discovered in them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from sample_robots import APR02
from shared_results import made_once

from omnibench.data.dataset import Dataset, Trajectory
from omnibench.discover import result
from omnibench.discover.discover import discover_effects
from omnibench.discover.fit import Fit, fit_matrix
from omnibench.fit.trajectory_fit import usable_runs
from omnibench.simulate.config import FlowerConfig
from omnibench.simulate.source import simulate_dataset

Effects = tuple[dict[str, Any], ...]
COUPLING: Effects = ({"name": "rotation_translation_coupling", "parameters": {"kx": 0.3, "ky": -0.2}},)
ECCENTRICITY: Effects = ({"name": "wheel_eccentricity", "parameters": {"a_a": 0.02, "b_a": 0.0}},)
DEAD_ZONE: Effects = ({"name": "wheel_dead_zone", "parameters": {"c": 0.03}},)
SMALL = {"directions_deg": [0, 120, 240], "turn_rates": [-0.35, 0.35], "ramp": 0.3}  # commands, of which few runs come
DELAY: Effects = ({"name": "reference_time_offset", "parameters": {"tau": 0.06}},)


def flower(effects: Effects = COUPLING, **changes: Any) -> dict[str, Any]:
    """A small flower experiment: what a config's ``simulate`` says."""
    return {
        "robot": APR02,
        "sample_period": 0.04,
        "commands": {"directions_deg": [0, 60, 120, 180, 240, 300], "turn_rates": [-0.35, 0, 0.35], "ramp": 0.3},
        "repetitions": 2,
        "truth": {"published": "palacin2023_eq8", "effects": list(effects)},
        "noise": {"encoder": 0.01, "pose_position": 0.004, "pose_heading": 0.004, "bias_position": 0.002},
        "train": {"seed": 1, "distance": 1.2},
        "validation": {"seed": 2, "distance": 1.2},
        **changes,
    }


def simulated(effects: Effects = COUPLING, **changes: Any) -> Dataset:
    """A simulated data set with hidden effects."""
    return simulate_dataset(FlowerConfig.model_validate(flower(effects, **changes))).dataset


def plain_fit(dataset: Dataset, runs: Sequence[Trajectory] | None = None) -> Fit:
    """The plain matrix fitted to runs of a data set, by default to those that train."""
    fitted = usable_runs(dataset.split("train") if runs is None else runs)
    return fit_matrix(fitted, dataset.robot, dataset.sample_period, dataset.robot.inverse_kinematic_matrix)


def shorn(dataset: Dataset, **values: Any) -> Dataset:
    """A data set whose runs lack something, or have it otherwise."""
    return replace(dataset, trajectories=tuple(replace(run, **values) for run in dataset.trajectories))


@made_once
def named() -> result.Discovery:
    """A strong effect that the catalogue has."""
    return discover_effects(simulated())


@made_once
def repeated() -> result.Discovery:
    """The same effect in twice as many repetitions."""
    return discover_effects(simulated(repetitions=4))


@made_once
def nothing() -> result.Discovery:
    """Noise alone."""
    return discover_effects(simulated(()))


@made_once
def nameless() -> result.Discovery:
    """A strong effect that is left out of the catalogue."""
    return discover_effects(simulated(), without=("rotation_translation_coupling",))


@made_once
def lagging() -> result.Discovery:
    """Motors that lag behind their targets by 0.15 s."""
    return discover_effects(simulated(({"name": "motor_lag", "parameters": {"tau": 0.15}},)))


@made_once
def look_alike() -> result.Discovery:
    """Wheels that lose a constant rate: at one speed they look like wheels that creep."""
    return discover_effects(simulated(DEAD_ZONE, validation=None))


def incomplete() -> result.Discovery:
    """Named, with more of whatever a discovery may hold than these data give rise to."""
    found = named()
    description = "what is left depends on how fast the wheels turn"
    dependence = result.CovariateDependence("wheel rate", "wheel", 2e-11, 90.0, 24, description)
    return replace(
        found,
        verdict="incomplete",
        left=(dependence,),
        extrapolations=(EXTRAPOLATION,),
        experiments=(EXPERIMENT,),
        classes=(("acceleration_slip", "reference_time_offset"),),
        outliers=12,
    )


def poor(found: result.Discovery) -> result.Discovery:
    """The discovery as of recordings that lack wheel angles, order, commands and held-out runs."""
    dataset = shorn(
        found.dataset, angles=None, session=None, started_at=None, command=None, v=None, alpha=None, omega=None,
        distance=None, duration=None, repetition=None, targets=None,
    )  # fmt: skip
    return replace(found, dataset=dataset, held_out=())


def held_out(found: result.Discovery, data: str) -> result.HeldOut:
    """Its figures on one kind of held-out runs."""
    return next(each for each in found.held_out if each.data == data)


EXTRAPOLATION = result.Extrapolation(
    "v0.4_a90_w1", "turns at 1.0 rad/s, where training had at most 0.35 rad/s", 0.041, 0.152
)
EXPERIMENT = result.Experiment(
    ("acceleration_slip", "reference_time_offset"),
    "Drive 4 runs, 1.8 minutes with 15 s before each to place the robot.",
    "generator: flower\ncommands: {speeds: [0.0], directions_deg: [0], turn_rates: [-1.0, 1.0]}\n",
    (result.ExperimentCommand("turning left on the spot at 1 rad/s", 4, 12.5),),
    runs=4,
    minutes=1.83,
    chance=0.97,
    chance_recorded=0.02,
)
