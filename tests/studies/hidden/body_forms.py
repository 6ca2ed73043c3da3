"""Hidden effects of the body, the floor and the reference."""

from __future__ import annotations

import numpy as np

from omnibench.robot.kinematics import Array

from .form import Values
from .motion import Correction, Grid


def _saturating_vectors(vectors: Array, limit: float) -> Array:
    return vectors / (1 + np.linalg.norm(vectors, axis=1, keepdims=True) / limit)


def _body(grid: Grid, velocity: Array | None = None, turn: Array | None = None) -> Correction:
    body = np.zeros((len(grid.run), 3))
    if velocity is not None:
        body[:, :2] = velocity
    if turn is not None:
        body[:, 2] = turn
    return Correction(body=body)


def acceleration_slip(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return _body(grid, -values["k"] * grid.acceleration)


def acceleration_slip_saturating(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    return _body(grid, -values["k"] * _saturating_vectors(grid.acceleration, rng.uniform(1, 3)))


def centripetal_slip(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return _body(grid, values["k"] * grid.centripetal)


def centripetal_slip_saturating(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    return _body(grid, values["k"] * _saturating_vectors(grid.centripetal, rng.uniform(0.15, 0.4)))


def coupling(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    vx, vy, w = grid.twist.T
    return _body(grid, turn=w * (values["kx"] * vx + values["ky"] * vy))


def coupling_saturating(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    vx, vy, w = grid.twist.T
    limit = rng.uniform(0.8, 1.6)
    return _body(grid, turn=limit * np.tanh(w / limit) * (values["kx"] * vx + values["ky"] * vy))


def rotation_slip(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    w = grid.twist[:, 2]
    return _body(grid, turn=-values["k"] * w * np.abs(w))


def rotation_slip_saturating(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    w, limit = grid.twist[:, 2], rng.uniform(1.2, 2.5)
    return _body(grid, turn=-values["k"] * w * limit * np.tanh(np.abs(w) / limit))


def heading_drift(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return _body(grid, turn=np.full(len(grid.run), values["b"]))


def heading_drift_that_varies(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A gyroscope's bias, or a floor, that changes slowly over the session."""
    period, phase = rng.uniform(1500, 4000), rng.uniform(-np.pi, np.pi)
    return _body(grid, turn=values["b"] * (1 + 0.2 * np.sin(2 * np.pi * grid.session_time / period + phase)))


def velocity_bias(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return _body(grid, np.tile([values["bx"], values["by"]], (len(grid.run), 1)))


def velocity_bias_that_varies(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    period, phase = rng.uniform(1500, 4000), rng.uniform(-np.pi, np.pi)
    waves = 1 + 0.2 * np.sin(2 * np.pi * grid.session_time / period + phase)
    return _body(grid, waves[:, None] * [values["bx"], values["by"]])


def transient(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    share = values["k"] * np.exp(-grid.travelled / values["length"])
    return _body(grid, -share[:, None] * grid.twist[:, :2])


def transient_linear(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    """Rollers that settle bit by bit, and then are settled."""
    share = values["k"] * np.maximum(0.0, 1 - grid.travelled / (2 * values["length"]))
    return _body(grid, -share[:, None] * grid.twist[:, :2])


def floor_drift(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return Correction(world=grid.speed[:, None] * [values["dx"], values["dy"]])


def floor_drift_uneven(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Carpet pile that is not everywhere the same."""
    wave = 0.25 * np.sin(grid.place @ rng.normal(0, 2, 2) + rng.uniform(-np.pi, np.pi))
    return Correction(world=(grid.speed * (1 + wave))[:, None] * [values["dx"], values["dy"]])


def time_offset(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return Correction(delay=np.full(len(grid.stamps), values["tau"]))


def time_offset_with_jitter(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """A queue: each pose waits its own time."""
    jitter = Correction(delay=values["tau"] * _waiting(grid, rng))
    return Correction(delay=np.full(len(grid.stamps), values["tau"]), chance=jitter)


def _waiting(grid: Grid, rng: np.random.Generator) -> Array:
    """Shares (s,) of a delay by which each pose is later than their mean: most a little earlier, few a lot later."""
    return 0.25 * (rng.exponential(size=len(grid.stamps)) - 1)


def heading_latency(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return Correction(heading_delay=np.full(len(grid.stamps), values["tau"]))


def heading_latency_with_jitter(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    jitter = Correction(heading_delay=values["tau"] * _waiting(grid, rng))
    return Correction(heading_delay=np.full(len(grid.stamps), values["tau"]), chance=jitter)
