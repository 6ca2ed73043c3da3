"""Fine structure outside the catalogue: high harmonics of heading and wheel angle, joints and edges of the floor.

By another author than ``outside.py``. Where a kind has variants, a data set draws one.
"""

from __future__ import annotations

import numpy as np

from omnibench.robot.kinematics import Array

from .form import WHEELS, Values
from .motion import Correction, Grid
from .outside import Unheard

_LINES = 64  # joints each way from the start that can be reached, with much to spare
_ARM = 0.195  # m: a rate of turn moves the wheels by this much


def _heading_harmonic(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Yaw that goes wrong n times a turn of the heading: while turning, or by the way that the wheels roll."""
    times, phase = rng.integers(2, 9), rng.uniform(-np.pi, np.pi)
    turning = grid.twist[:, 2] if rng.random() < 0.5 else _rolling(grid)
    return _yaw(values["size"] * turning * np.cos(times * grid.heading + phase))


def _wheel_harmonic(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """The radius of one wheel, or of all, n times a turn of the wheel."""
    times, phase = rng.integers(2, 9), rng.uniform(-np.pi, np.pi, len(WHEELS))
    wheels = np.ones(len(WHEELS)) if rng.random() < 0.5 else np.eye(len(WHEELS))[rng.integers(len(WHEELS))]
    return Correction(wheel=values["size"] * wheels * np.cos(times * grid.angles + phase) * grid.rates)


def _name_of_wheel_harmonic(rng: np.random.Generator) -> tuple[str, ...]:
    """A radius that changes n times a turn is the catalogue's roller ripple of n rollers, from three on."""
    return ("roller_ripple",) if rng.integers(2, 9) >= 3 else ()


def _tiles(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Joints of square tiles that slow the robot within centimetres, or jolt its heading, each by its own height."""
    pitch, angle, width = rng.uniform(0.2, 0.5), rng.uniform(0, np.pi / 2), rng.uniform(0.008, 0.02)  # m, rad, m
    offset, jolting = rng.uniform(0, pitch, 2), rng.random() < 0.5
    heights = rng.uniform(0.4, 1.6, (2, 2 * _LINES)) * (rng.choice([-1.0, 1.0], (2, 2 * _LINES)) if jolting else 1.0)
    struck = np.zeros(len(grid.run))
    for family, turned in enumerate((angle, angle + np.pi / 2)):
        across = (grid.place @ [np.cos(turned), np.sin(turned)] + offset[family]) / pitch
        line = np.round(across).astype(int)
        bump = np.exp(-0.5 * ((across - line) * pitch / width) ** 2)
        struck += heights[family, line + _LINES] * bump
    if jolting:
        return _yaw(values["size"] * struck * _rolling(grid) / _ARM)
    return Correction(body=-values["size"] * struck[:, None] * grid.twist)


def _carpet_edge(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Beyond a line near the start lies a carpet: wheels slip on it, or its pile pushes the robot."""
    side, distance, edge = rng.uniform(-np.pi, np.pi), rng.uniform(-0.25, 0.25), rng.uniform(0.003, 0.02)  # rad, m, m
    pile, pushes = rng.uniform(-np.pi, np.pi), rng.random() < 0.5
    beyond = grid.place @ [np.cos(side), np.sin(side)] - distance
    on_carpet = values["size"] * 0.5 * (1 + np.tanh(beyond / edge))
    if pushes:
        return Correction(world=np.outer(on_carpet * grid.speed, [np.cos(pile), np.sin(pile)]))
    return Correction(body=-on_carpet[:, None] * grid.twist)


def _shimmy(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """The heading swings from the start of every run, as a loose wheel mount does, and dies out in seconds."""
    rate, phase, constant = rng.uniform(0.5, 1.6), rng.uniform(-np.pi, np.pi), rng.uniform(1.5, 4.0)  # Hz, rad, s
    swing = np.cos(2 * np.pi * rate * grid.elapsed + phase) * np.exp(-grid.elapsed / constant)
    return _yaw(values["size"] * swing)


def _rolling(grid: Grid) -> Array:
    """How fast the wheels roll over the floor (n,), m/s."""
    return np.hypot(grid.speed, _ARM * grid.twist[:, 2])


def _yaw(rates: Array) -> Correction:
    """A correction of the rate of turn (n,), rad/s."""
    return Correction(body=np.column_stack([np.zeros((len(rates), 2)), rates]))


FINE: dict[str, Unheard] = {
    "heading_harmonic": Unheard(_heading_harmonic, ("heading",), 0.05),
    "wheel_harmonic": Unheard(_wheel_harmonic, ("wheel angle",), 0.05, "precise", _name_of_wheel_harmonic),
    "tiles": Unheard(_tiles, ("place",), 0.1),
    "carpet_edge": Unheard(_carpet_edge, ("place",), 0.05),
    "shimmy": Unheard(_shimmy, ("elapsed time",), 0.05),
}
