"""East and north of points by latitude and longitude, in the plane that touches the ellipsoid WGS 84 at an origin.

A point of latitude phi, longitude lambda and height h above the ellipsoid has the geocentric coordinates

    X = (N + h) cos phi cos lambda,  Y = (N + h) cos phi sin lambda,  Z = (N (1 - e^2) + h) sin phi,       (1)
    N = a / sqrt(1 - e^2 sin^2 phi),

and east and north of an origin (phi0, lambda0) are

    east  = -sin lambda0 dX + cos lambda0 dY,                                                             (2)
    north = -sin phi0 cos lambda0 dX - sin phi0 sin lambda0 dY + cos phi0 dZ.                             (3)

Source: NIMA TR8350.2, World Geodetic System 1984. The plane shortens a way at a distance d by d^2 / (2 R^2): 1 mm in a
km at d = 9 km.
"""

from __future__ import annotations

import numpy as np

from omnibench.robot.kinematics import Array

_SEMI_MAJOR = 6378137.0  # m, a of WGS 84
_FLATTENING = 1 / 298.257223563  # of WGS 84
_ECCENTRICITY_SQUARED = _FLATTENING * (2 - _FLATTENING)


def east_north(latitudes: Array, longitudes: Array, origin: tuple[float, float], height: float = 0.0) -> Array:
    """East and north (K, 2), m, of latitudes and longitudes (K,), degrees, as seen from an origin, degrees.

    height: m above the ellipsoid, of all points: the robot is on the floor.
    """
    phi, lam = np.radians(origin)
    start = _geocentric(np.array([phi]), np.array([lam]), height)
    dx, dy, dz = (_geocentric(np.radians(latitudes), np.radians(longitudes), height) - start).T
    east = -np.sin(lam) * dx + np.cos(lam) * dy  # Eq. (2)
    north = -np.sin(phi) * (np.cos(lam) * dx + np.sin(lam) * dy) + np.cos(phi) * dz  # Eq. (3)
    return np.column_stack([east, north])


def _geocentric(phi: Array, lam: Array, height: float) -> Array:
    """Geocentric coordinates (K, 3), m, Eq. (1)."""
    normal = _SEMI_MAJOR / np.sqrt(1 - _ECCENTRICITY_SQUARED * np.sin(phi) ** 2)
    out = (normal + height) * np.cos(phi)
    return np.column_stack(
        [out * np.cos(lam), out * np.sin(lam), (normal * (1 - _ECCENTRICITY_SQUARED) + height) * np.sin(phi)]
    )
