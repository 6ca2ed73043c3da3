"""Effects of the place: a floor on which the wheels grip differently from region to region.

The map is a spline over the place in the reference's frame. With B the cubic B-spline of unit knots (de Boor 1978)
and nine points of a grid of spacing h about a centre, the share of the motion that is gained at (x, y) is

    g(x, y) = sum over i, j = -1, 0, 1 of g_ij B(x / h - i) B(y / h - j) / B(0)^2,                              (F1)

x, y counted from the centre. It fades to zero at three spacings from there.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from omnibench.registry import effects
from omnibench.robot.effects.effect import Parameter, Values
from omnibench.robot.effects.smooth import direction, scale, shared
from omnibench.robot.effects.textbook import BodyEffect
from omnibench.robot.kinematics import Array
from omnibench.robot.signals import Signals, needed

_PEAK = 2 / 3  # B(0)
_MODES = ("along", "rotation")
_POINTS = tuple(f"{x}{y}" for x, y in product(range(3), repeat=2))


def _cubic_spline(away: Array) -> Array:
    """The cubic B-spline B of unit knots, centred at 0, at distances of any shape."""
    distance = np.abs(away)
    near = 2 / 3 - np.square(distance) * (1 - distance / 2)
    return np.where(distance < 1, near, np.maximum(2 - distance, 0.0) ** 3 / 6)


@effects.register("floor_map")
class FloorMap(BodyEffect):
    """Wheels slip by a share that depends on the place: (vx, vy) (1 + along(x, y)), w (1 + rotation(x, y)), Eq. (F1).

    The grid's points are called 00 to 22, by their steps along x and along y of the reference.
    """

    physics = "Regions of the floor differ: carpet beside tiles, dust, a wet patch; each has its own slip."
    source = (
        "A. Angelova, L. Matthies, D. Helmick and P. Perona, Learning and prediction of slip from visual information, "
        "2007; C. de Boor, A practical guide to splines, 1978"
    )
    shows_in = "place"
    needs = frozenset({"poses"})
    # Not tried by discover, which cannot shape a map by the area that was driven: on the slippery patch of the foreign
    # study 9100 it changed no answer, and made 54 more columns and 570 s of 72.
    in_catalogue = False
    form_covariates = ()
    fixed_parameters = (
        *shared(_MODES, _POINTS, "grid points of the floor"),
        scale("centre_x", "m", -1e6, 1e6, 0.0, "middle of the map"),
        scale("centre_y", "m", -1e6, 1e6, 0.0, "middle of the map"),
        Parameter("spacing", "m", 1e-3, 1e6, "between the grid's points", (0.4, 1.0, 2.5)),
    )

    def correction(self, signals: Signals, values: Values) -> Array:
        places = (needed(signals.poses)[:, :2] - [values["centre_x"], values["centre_y"]]) / values["spacing"]
        along_x, along_y = (_cubic_spline(places[:, [axis]] - [-1, 0, 1]) / _PEAK for axis in (0, 1))
        functions = (along_x[:, :, None] * along_y[:, None]).reshape(len(places), -1)
        added = np.zeros(signals.twists.shape)
        for mode in _MODES:
            heights = np.array([values[f"{mode}_{point}"] for point in _POINTS])
            added += (functions @ heights)[:, None] * direction(mode, signals)  # Eq. (F1)
        return added
