"""A small network from drive signals to a twist, evaluated by NumPy in float64.

With u the drive signals (M,), s their scales and t the scales of the twist, the activations are counted from those of a
standing robot, so that a robot that stands has the twist 0 exactly:

    h_1 = tanh(W_1 (u / s) + b_1) - tanh(b_1),
    h_l = tanh(W_l h_(l-1) + b_l) - tanh(b_l),    l = 2 ... L,                                                    (1)
    twist = t W_(L+1) h_L.                                                                                        (2)

(Multilayer perceptron: Rumelhart, Hinton and Williams, Nature 323:533, 1986.) The weights in a calibration file are one
row of numbers: version, 1 if the network stands alone and 0 if it adds to the matrix, L, M, the sizes of the L layers,
s (M,), t (3,), and then W_1 row by row, b_1, ..., W_L, b_L, W_(L+1).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from omnibench.errors import DataError
from omnibench.registry import Options, effects
from omnibench.robot.effects.effect import MotionEffect, Parameter, Values
from omnibench.robot.kinematics import Array, Drive, Robot
from omnibench.robot.signals import Signals

_VERSION = 1
_MOST_LAYERS = 4
_LARGEST_LAYER = 512
_BEGIN = 4  # numbers before the sizes of the layers


@dataclass(frozen=True, eq=False)
class Network:
    """A network of Eq. (1) and (2).

    alone: it takes the matrix's place, else it adds to it. inputs (M,): scales of the drive signals, rad/s. outputs
    (3,): scales of the twist, m/s, m/s, rad/s. layers: W (width, inputs of the layer) and b (width,) of each hidden
    layer. last (3, width): W_(L+1).
    """

    alone: bool
    inputs: Array
    outputs: Array
    layers: tuple[tuple[Array, Array], ...]
    last: Array

    def twists(self, signals: Array) -> Array:
        """Twists (F, 3), m/s, m/s, rad/s, of drive signals (F, M), rad/s."""
        active = signals
        for weights, biases, rest in self._prepared:
            active = np.tanh(active @ weights + biases) - rest  # Eq. (1)
        return active @ self._to_twist  # Eq. (2)

    @cached_property
    def _prepared(self) -> list[tuple[Array, Array, Array]]:
        """The layers with the scales of the drive signals in the first one's weights, and activations at rest."""
        scales = [self.inputs, *(np.ones(weights.shape[1]) for weights, _ in self.layers[1:])]
        return [
            (np.ascontiguousarray((weights / scale).T), biases, np.tanh(biases))
            for (weights, biases), scale in zip(self.layers, scales, strict=True)
        ]

    @cached_property
    def _to_twist(self) -> Array:
        return np.ascontiguousarray((self.outputs[:, None] * self.last).T)

    def packed(self) -> Array:
        """All numbers (n,) in the order of a calibration file."""
        sizes = [len(biases) for _, biases in self.layers]
        parts = [part.ravel() for layer in self.layers for part in layer]
        head = [_VERSION, float(self.alone), len(sizes), len(self.inputs), *sizes]
        return np.concatenate([head, self.inputs, self.outputs, *parts, self.last.ravel()])


def unpacked(weights: Array, signals: int, prefix: str) -> Network:
    """The network of numbers (n,) for so many drive signals. DataError, which begins with ``prefix``: they are none."""
    if len(weights) < _BEGIN or weights[0] != _VERSION or weights[1] not in (0.0, 1.0):
        raise DataError(f"{prefix}: weights do not begin as those of a network, version {_VERSION}; calibrate again")
    depth, trained_signals = weights[2], weights[3]
    if trained_signals != signals:
        raise DataError(f"{prefix}: weights are for {trained_signals:g} drive signals, the robot has {signals}")
    sizes = weights[_BEGIN : _BEGIN + int(min(max(depth, 0), _MOST_LAYERS))]
    if depth not in range(1, _MOST_LAYERS + 1) or not all(size in range(1, _LARGEST_LAYER + 1) for size in sizes):
        raise DataError(f"{prefix}: weights have no layers of a network; calibrate again")
    widths = [int(size) for size in sizes]
    shapes: list[tuple[int, ...]] = [(signals,), (3,)]
    for before, width in zip([signals, *widths], widths, strict=False):
        shapes += [(width, before), (width,)]
    shapes.append((3, widths[-1]))
    counts = [int(np.prod(shape)) for shape in shapes]
    begin = _BEGIN + len(widths)
    if len(weights) != begin + sum(counts):
        raise DataError(f"{prefix}: weights are {len(weights)} numbers, its layers need {begin + sum(counts)}")
    cuts = np.split(weights[begin:], np.cumsum(counts)[:-1])
    inputs, outputs, *rest = (part.reshape(shape) for part, shape in zip(cuts, shapes, strict=True))
    if not (inputs > 0).all() or not (outputs > 0).all():
        raise DataError(f"{prefix}: weights have scales that are not above 0; calibrate again")
    layers = tuple(zip(rest[:-1:2], rest[1:-1:2], strict=True))
    return Network(bool(weights[1]), inputs, outputs, layers, rest[-1])


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
