"""Learned kinematics: a network from drive signals to twist, beside the matrix or in its place."""

from __future__ import annotations

import numpy as np

from omnibench.errors import DataError
from omnibench.registry import Options, effects
from omnibench.robot.effects.effect import MotionEffect, Parameter, Values
from omnibench.robot.effects.learned.network import Network, unpacked
from omnibench.robot.kinematics import Array, Robot
from omnibench.robot.signals import Signals
from omnibench.robot.wheels.drive import Drive


@effects.register("learned")
class Learned(MotionEffect):
    """Learned kinematics: a network's twist is added to the matrix's or, if the network stands alone, replaces it."""

    stage = "body"
    physics = "None: a network that was trained on recordings, for what no matrix can do, whatever its cause."
    source = "Palacin et al. 2023, reference [37] and future work; trained by the calibrators learned, learned_alone"
    shows_in = "wheel rate"
    in_catalogue = False
    weighted = True
    form_covariates = ()
    fixed_parameters = (Parameter("share", "1", 0.0, 1.0, "of the network's correction that is used"),)

    def __init__(
        self, options: Options | None = None, network: Network | None = None, drive: Drive | None = None
    ) -> None:
        super().__init__(options)
        self._network, self._drive = network, drive

    def with_weights(self, weights: Array, robot: Robot, prefix: str) -> Learned:
        drive = robot.drive  # looked up once, since that takes as long as the network
        return Learned(self.options, unpacked(weights, len(drive.names), prefix), drive)

    def trial_weights(self, robot: Robot) -> Array:
        rng, signals = np.random.default_rng(0), len(robot.drive.names)
        layers = ((rng.normal(size=(3, signals)), rng.normal(size=3)),)
        return Network(False, np.full(signals, 5.0), np.full(3, 0.1), layers, rng.normal(size=(3, 3))).packed()

    def correction(self, signals: Signals, values: Values) -> Array:
        """Correction (F, 3): share (net(u) - alone K u), m/s, m/s, rad/s. DataError: the effect has no weights."""
        if self._network is None or self._drive is None:
            raise DataError("effect 'learned' has no weights; take it from the calibration file that holds them")
        twists = self._network.twists(self._drive.signals(signals.rates, signals.steering))
        return values["share"] * (twists - signals.twists if self._network.alone else twists)
