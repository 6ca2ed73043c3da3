"""Effects outside the catalogue, and the covariates on which they show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from omnibench.robot.kinematics import Array

from .form import Make, Values
from .motion import Correction, Grid


@dataclass(frozen=True)
class Unheard:
    """An effect without a name. covariates: where a locator should see it; one of them is enough.

    plausible: what size "amplitude" = 1 is scaled from. design: where it can be seen. called: the names that the
    catalogue has for what is drawn from a generator after all.
    """

    make: Make
    covariates: tuple[str, ...]
    plausible: float
    design: str = "rich"
    called: Callable[[np.random.Generator], tuple[str, ...]] = lambda _: ()


def _turn(rates: Array) -> Correction:
    return Correction(body=np.column_stack([np.zeros((len(rates), 2)), rates]))


def _slow_wave(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """The radius swings over the session, as with the sun on the floor."""
    end = grid.session_time.max()
    wave = np.sin(2 * np.pi * rng.uniform(2, 3) * grid.session_time / end + rng.uniform(-np.pi, np.pi))
    return Correction(wheel=values["size"] * grid.rates * wave[:, None])


def _wet_patch(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A round patch where the robot slips, beside the start."""
    angle = rng.uniform(-np.pi, np.pi)
    centre = rng.uniform(0.3, 0.6) * np.array([np.cos(angle), np.sin(angle)])
    distance = np.linalg.norm(grid.place - centre, axis=1)
    slip = values["size"] / (1 + np.exp((distance - 0.3) / 0.03))
    return Correction(body=np.column_stack([-slip[:, None] * grid.twist[:, :2], np.zeros(len(slip))]))


def _warped_map(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A map of SLAM that is bent: positions are reported a little beside, smoothly over the floor."""
    waves, phases = rng.normal(0, 3, (2, 2)), rng.uniform(-np.pi, np.pi, 2)
    starts = np.array([run.start[:2] for run in grid.runs])[grid.stamp_run]

    def beside(place: Array) -> Array:
        return values["size"] * np.sin(place @ waves + phases)

    def reported(poses: Array) -> Array:
        return np.column_stack([poses[:, :2] + beside(poses[:, :2]) - beside(starts), poses[:, 2]])

    return Correction(reported=reported)


def _turning_by_heading(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A grooved floor: it turns a robot that drives across the grooves."""
    wave = np.sin(2 * grid.heading + rng.uniform(-np.pi, np.pi))
    return _turn(values["size"] * wave * (grid.speed + 0.2 * np.abs(grid.twist[:, 2])))


def _resonance(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Slip at one wheel rate, where something rattles."""
    bump = np.exp(-(((np.abs(grid.rates) - rng.uniform(0.7, 1.3)) / 0.15) ** 2))
    return Correction(wheel=values["size"] * grid.rates * bump)


def _oval_wheel(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """One wheel that is oval, on centre."""
    wheel = int(rng.integers(grid.rates.shape[1]))
    wave = np.cos(2 * grid.angles[:, wheel] + rng.uniform(-np.pi, np.pi))
    return _one_wheel(grid, wheel, values["size"] * wave)


def _belt(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A belt twice as long as the wheel's rim: half a turn of the belt is a turn of the wheel."""
    wheel = int(rng.integers(grid.rates.shape[1]))
    return _one_wheel(grid, wheel, values["size"] * np.cos(0.5 * grid.angles[:, wheel] + rng.uniform(-np.pi, np.pi)))


def _one_wheel(grid: Grid, wheel: int, share: Array) -> Correction:
    correction = np.zeros_like(grid.rates)
    correction[:, wheel] = grid.rates[:, wheel] * share
    return Correction(wheel=correction)


def _swinging_heading(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """The robot wags: a rate of turn that swings with the time since the start."""
    period = rng.uniform(2.0, 3.5)
    return _turn(values["size"] * np.cos(2 * np.pi * grid.elapsed / period + rng.uniform(-np.pi, np.pi)))


def _odd_command(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """One command whose runs go wrong, as a cable that is caught."""
    driven = sorted({run.command_number for run in grid.runs if run.command.speed})
    odd = int(rng.choice(driven))
    caught = grid.of_run([float(run.command_number == odd) for run in grid.runs])
    share = values["size"] * caught
    push = rng.uniform(0.1, 0.3) * rng.choice([-1.0, 1.0])
    return Correction(body=np.column_stack([-share[:, None] * grid.twist[:, :2], push * share * grid.speed]))


def _kick(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    """Whatever the direction, the robot turns to the same side as it starts and stops."""
    return _turn(values["size"] * np.linalg.norm(grid.acceleration, axis=1))


def _alternating_latency(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    """Two buffers: every other pose is late, the one between early."""
    number = np.arange(len(grid.stamps)) - grid.stamp_first[grid.stamp_run]
    return Correction(delay=values["size"] * np.where(number % 2, 1.0, -1.0))


def _coarse_stamps(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    """A clock that ticks coarsely: poses are from before their stamps, by a saw tooth of the stamp."""
    tick = 0.7  # s: a beat with the period of the poses
    return Correction(delay=values["size"] * (np.mod(grid.stamps, tick) / tick - 0.5))


OUTSIDE: dict[str, Unheard] = {
    "slow_wave": Unheard(_slow_wave, ("order of runs",), 0.01),
    "wet_patch": Unheard(_wet_patch, ("place",), 0.05),
    "warped_map": Unheard(_warped_map, ("place",), 0.01),
    "turning_by_heading": Unheard(_turning_by_heading, ("heading",), 0.02),
    "resonance": Unheard(_resonance, ("wheel rate",), 0.02),
    "oval_wheel": Unheard(_oval_wheel, ("wheel angle",), 0.02),
    "belt": Unheard(_belt, ("wheel angle",), 0.02),
    "swinging_heading": Unheard(_swinging_heading, ("elapsed time",), 0.01),
    "odd_command": Unheard(_odd_command, ("command",), 0.1),
    "kick": Unheard(_kick, ("acceleration",), 0.02),
    "alternating_latency": Unheard(_alternating_latency, ("stamps",), 0.05),
    "coarse_stamps": Unheard(_coarse_stamps, ("stamps", "elapsed time"), 0.2),
}
