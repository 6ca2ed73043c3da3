"""Networks and calibrations with a learned effect that tests share."""

from typing import Any

import numpy as np

from omnibench.robot.calibration import Calibration, EffectTerm, ModelExtension, covariance_rows, matrix_rows
from omnibench.robot.corrections import GROWTH
from omnibench.robot.effects.effect import encode_weights
from omnibench.robot.effects.learned import Network
from omnibench.robot.kinematics import Robot


def a_network(robot: Robot, *, alone: bool = False, sizes: tuple[int, ...] = (16,), seed: int = 0) -> Network:
    """A network of random weights, whose twist is about a tenth of the robot's."""
    rng, count = np.random.default_rng(seed), len(robot.drive.names)
    inputs = [count, *sizes[:-1]]
    layers = tuple(
        (rng.normal(size=(size, before)), rng.normal(size=size)) for size, before in zip(sizes, inputs, strict=True)
    )
    last = rng.normal(size=(3, sizes[-1])) / np.sqrt(sizes[-1])
    return Network(alone, rng.uniform(3, 6, count), np.array([0.02, 0.02, 0.1]), layers, last)


def a_weighted_term(robot: Robot, share: float = 1.0, **given: Any) -> EffectTerm:
    weights = encode_weights(a_network(robot, **given).packed())
    return EffectTerm(name="learned", parameters={"share": share}, weights=weights)


def an_extension(robot: Robot, driven: list[list[float]], share: float = 1.0, **given: Any) -> ModelExtension:
    """A learned effect that is gone one width from the driven motions."""
    matrix = robot.inverse_kinematic_matrix
    covariance = np.zeros((matrix.size + 1, matrix.size + 1))
    covariance[-1, -1] = share**2 / GROWTH
    return ModelExtension(
        effects=(a_weighted_term(robot, share, **given),),
        driven=tuple((x, y, turn) for x, y, turn in driven),
        plain=matrix_rows(matrix),
        covariance=covariance_rows(covariance),
    )


def a_learned_calibration(robot: Robot, driven: list[list[float]], period: float, **given: Any) -> Calibration:
    return Calibration(
        name="learned",
        robot=robot,
        sample_period=period,
        matrix=matrix_rows(robot.inverse_kinematic_matrix),
        integration="arc",
        **dict(an_extension(robot, driven, **given)),
    )
