"""Effects that must never be the answer: absorbed effects and nuisances; and effects between targets and wheels."""

from __future__ import annotations

import numpy as np

from omnibench.robot.kinematics import Array

from .form import Form, Values
from .motion import Correction, Grid
from .wheel_forms import wear


def _lever_arm(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    arm = np.array([values["x"], values["y"]])
    start = np.array([run.start[2] for run in grid.runs])[grid.stamp_run]

    def reported(poses: Array) -> Array:
        moved = _turned(arm, poses[:, 2]) - _turned(arm, start)
        return np.column_stack([poses[:, :2] + moved, poses[:, 2]])

    return Correction(reported=reported)


def _turned(vector: Array, angle: Array) -> Array:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.column_stack([cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1]])


def _yaw(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    body = np.zeros((len(grid.run), 3))
    body[:, :2] = _turned_each(grid.twist[:, :2], values["beta"]) - grid.twist[:, :2]
    return Correction(body=body)


def _turned_each(vectors: Array, angle: float) -> Array:
    cosine, sine = np.cos(angle), np.sin(angle)
    return vectors @ np.array([[cosine, sine], [-sine, cosine]])


def _scale(_: Grid, values: Values, __: np.random.Generator) -> Correction:
    def reported(poses: Array) -> Array:
        return poses * [1 + values["s"], 1 + values["s"], 1.0]

    return Correction(reported=reported)


def _period(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return Correction(wheel=values["s"] * grid.rates)


def _clock_drift(grid: Grid, values: Values, rng: np.random.Generator) -> Correction:
    """Another offset and another slope in every run."""
    offsets = values["offset"] * rng.standard_normal(len(grid.runs))
    slopes = values["slope"] * rng.standard_normal(len(grid.runs))
    return Correction(delay=(offsets[grid.stamp_run] + slopes[grid.stamp_run] * grid.stamps))


def _lag(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return Correction(asked=values["tau"] * grid.angular_accelerations)


def _band(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return Correction(asked=values["band"] * np.sign(grid.rates))


def _gain(grid: Grid, values: Values, _: np.random.Generator) -> Correction:
    return Correction(asked=grid.rates * (1 / (1 + values["gain"]) - 1))


ABSORBED: dict[str, Form] = {
    "lidar_lever_arm": Form(_lever_arm, _lever_arm, _lever_arm, {"x": 0.05, "y": 0.05}),
    "lidar_yaw": Form(_yaw, _yaw, _yaw, {"beta": np.radians(2)}),
    "reference_scale": Form(_scale, _scale, _scale, {"s": 0.01}),
    "sample_period_scale": Form(_period, _period, _period, {"s": 0.01}),
    "tyre_wear": Form(wear, wear, wear, {"radius_s2": 0.01}),  # between training and validation, each of one session
}
NUISANCES: dict[str, Form] = {
    "reference_clock_drift": Form(_clock_drift, _clock_drift, _clock_drift, {"offset": 0.03, "slope": 0.003}),
}
ACTUATORS: dict[str, Form] = {
    "motor_lag": Form(_lag, _lag, _lag, {"tau": 0.08}, one_sided=True),
    "motor_dead_band": Form(_band, _band, _band, {"band": 0.05}, one_sided=True),
    "motor_gain": Form(_gain, _gain, _gain, {"gain": 0.03}),
}
