"""Hidden effects of the wheels: radius, dead zone and creep, wheel angle, wear, load."""

from __future__ import annotations

import numpy as np

from omnibench.robot.kinematics import Array

from .experiment import ROBOT
from .form import WHEELS, Values, of_wheels
from .motion import Correction, Grid

RADII = np.array([wheel.radius for wheel in ROBOT.wheels])
AXLES = np.array([wheel.angle for wheel in ROBOT.wheels])
OUTWARDS = np.column_stack([np.cos(AXLES), np.sin(AXLES)])
SOFT = 0.05  # rad/s, of a wheel that hardly turns


def _sign(rates: Array) -> Array:
    return np.tanh(rates / SOFT)


def _saturating(values: Array, limit: float) -> Array:
    """Values that never exceed the limit, and are as they were while small."""
    return values / (1 + np.abs(values) / limit)


def speed_dependent(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return Correction(wheel=values["k"] * grid.rates * np.abs(grid.rates))


def speed_dependent_saturating(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    knee = rng.uniform(2.5, 5)  # rad/s
    return Correction(wheel=values["k"] * grid.rates * knee * np.tanh(np.abs(grid.rates) / knee))


def direction_dependent(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return Correction(wheel=of_wheels(values, "k") * np.abs(grid.rates))


def direction_dependent_soft(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    rates, power, knee = np.abs(grid.rates), rng.uniform(0.85, 1.1), rng.uniform(0.05, 0.15)
    return Correction(wheel=of_wheels(values, "k") * rates * np.tanh(rates / knee) * (rates + knee) ** (power - 1))


def dead_zone(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return Correction(wheel=values["c"] * _sign(grid.rates))


def dead_zone_soft_knee(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A soft knee, and Stribeck's fall of friction with the rate."""
    knee, share = rng.uniform(0.08, 0.2), rng.uniform(0.05, 0.2)
    rates = grid.rates
    stribeck = 1 - share + share * np.exp(-np.abs(rates) / 0.7)
    return Correction(wheel=values["c"] * rates / np.hypot(rates, knee) * stribeck)


def creep(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return Correction(wheel=values["c"] * _sign(grid.rates) * grid.speed[:, None] / RADII)


def creep_saturating(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    limit, knee = rng.uniform(0.6, 1.2), rng.uniform(0.05, 0.15)
    rates = grid.rates
    speed = limit * np.tanh(grid.speed / limit)
    return Correction(wheel=values["c"] * rates / np.hypot(rates, knee) * speed[:, None] / RADII)


def eccentricity(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    angles = grid.angles
    share = of_wheels(values, "a") * np.cos(angles) + of_wheels(values, "b") * np.sin(angles)
    return Correction(wheel=grid.rates * share)


def eccentricity_of_two_harmonics(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Out of centre and out of round."""
    share, phase = rng.uniform(0.15, 0.4), rng.uniform(-np.pi, np.pi, len(WHEELS))
    a, b = of_wheels(values, "a"), of_wheels(values, "b")
    oval = share * np.hypot(a, b) * np.cos(2 * grid.angles + phase)
    return Correction(wheel=grid.rates * (a * np.cos(grid.angles) + b * np.sin(grid.angles) + oval))


def ripple(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    angles = values["rollers"] * grid.angles
    share = of_wheels(values, "a") * np.cos(angles) + of_wheels(values, "b") * np.sin(angles)
    return Correction(wheel=grid.rates * share)


def ripple_with_edges(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """The gap between two rollers comes suddenly: the wave leans and has overtones."""
    a, b = of_wheels(values, "a"), of_wheels(values, "b")
    angles, lean = values["rollers"] * grid.angles + np.arctan2(a, b), rng.uniform(0.2, 0.5)
    return Correction(wheel=grid.rates * np.hypot(a, b) * np.sin(angles + lean * np.sin(angles)))


def thermal(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return Correction(wheel=grid.rates * (values["k"] * grid.session_time)[:, None])


def thermal_exponential(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    constant = rng.uniform(900, 2500)  # s
    warm = -np.expm1(-grid.session_time / constant)
    return Correction(wheel=grid.rates * (values["k"] * constant * warm)[:, None])


def wear(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    share = grid.of_run([values.get(f"radius_{run.session}", 0.0) for run in grid.runs])
    return Correction(wheel=grid.rates * share[:, None])


def wear_uneven(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Wheels wear a little differently, and go on wearing within a session."""
    uneven = 1 + 0.15 * rng.standard_normal(len(WHEELS))
    within = rng.uniform(-0.1, 0.1) * (grid.session_time / 1500 - 0.5)
    share = grid.of_run([values.get(f"radius_{run.session}", 0.0) for run in grid.runs]) * (1 + within)
    return Correction(wheel=grid.rates * share[:, None] * uneven)


def load_transfer(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    load = (grid.acceleration + grid.centripetal) @ OUTWARDS.T
    return Correction(wheel=-values["k"] * grid.rates * load)


def load_transfer_saturating(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A tyre stiffens as it is pressed."""
    load = (grid.acceleration + grid.centripetal) @ OUTWARDS.T
    return Correction(wheel=-values["k"] * grid.rates * _saturating(load, rng.uniform(1.5, 3)))
