"""A simulated tricycle that is driven and steered by its front wheel; it shares nothing with omnibench."""

import math
from collections.abc import Mapping

import numpy as np
from sample_robots import fixed, make_robot, steered

from omnibench.robot.kinematics import Array

TRICYCLE = make_robot(
    "tricycle",
    steered("front", 1.2, 0, radius=0.1),
    *(fixed(name, 0, y, radius=0.1, measured=False) for name, y in (("left", 0.3), ("right", -0.3))),
).model_dump(mode="json")
PERIOD = 0.05  # s


def tricycle_drive() -> Mapping[str, Array]:
    """A simulated tricycle: times, the front wheel's angle and steering angle, x, y and heading of its rear axle."""
    times = 100 + PERIOD * np.arange(401)
    phi = 0.7 * np.sin(np.arange(401) / 30)
    rates = 8 + 3 * np.cos(np.arange(400) / 20)
    middle = (phi[1:] + phi[:-1]) / 2
    middle[0] = phi[1]  # as the first sample of a recording is read
    ahead, turned = (0.1 * rates * PERIOD * each for each in (np.cos(middle), np.sin(middle) / 1.2))
    theta = np.append(0.4, 0.4 + np.cumsum(turned))
    chord = ahead * np.sinc(turned / 2 / math.pi)
    x, y = (np.append(0, np.cumsum(chord * each(theta[:-1] + turned / 2))) for each in (np.cos, np.sin))
    return {"t": times, "angle": np.append(0, np.cumsum(rates * PERIOD)), "phi": phi, "x": x, "y": y, "theta": theta}
