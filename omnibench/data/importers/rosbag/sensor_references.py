"""References that the sensors of a recording give each of its runs.

An inertial sensor (sensor_msgs/Imu) gives headings, by its orientation where it tells one, else by its rate of turn. A
receiver of satellites (sensor_msgs/NavSatFix) gives positions, east and north of the first fix, in the plane that
touches the ellipsoid WGS 84 there. A point of latitude phi, longitude lambda and height h above the ellipsoid has the
geocentric coordinates

    X = (N + h) cos phi cos lambda,  Y = (N + h) cos phi sin lambda,  Z = (N (1 - e^2) + h) sin phi,       (1)
    N = a / sqrt(1 - e^2 sin^2 phi),

and east and north of an origin (phi0, lambda0) are

    east  = -sin lambda0 dX + cos lambda0 dY,                                                             (2)
    north = -sin phi0 cos lambda0 dX - sin phi0 sin lambda0 dY + cos phi0 dZ.                             (3)

Source: NIMA TR8350.2, World Geodetic System 1984. The plane shortens a way at a distance d by d^2 / (2 R^2): 1 mm in a
km at d = 9 km.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from omnibench.data.importers.rosbag.bag import FIX, Bag, RosbagOptions, Topic
from omnibench.data.importers.rosbag.message_streams import MessageFilter, Stamps, planar_headings, possible
from omnibench.data.importers.runs.recording_runs import find_rests, measured_as
from omnibench.data.importers.wheel_samples import WheelSamples
from omnibench.data.references import Reference, References
from omnibench.errors import DataError
from omnibench.robot.kinematics import Array

_FASTEST = 100.0  # rad/s; no robot turns faster


@dataclass(frozen=True, eq=False)
class Inertial:
    """Messages at stamps (K,), ns: rates of turn (K,), rad/s, and headings and their sigmas (K,), rad, or None."""

    stamps: Stamps
    rates: Array
    headings: Array | None
    sigmas: Array | None


def read_inertial(bag: Bag, topic: Topic, sigma: float | None, gyro: bool, warnings: list[str]) -> Inertial:
    """The messages of a topic; what is left out is added to ``warnings``.

    sigma: rad, of all headings; None: by their covariances. gyro: leave the orientations out. DataError: the headings'
    covariances are not known, or too few messages are left.
    """
    messages = MessageFilter(bag, topic)
    rows, number, times = messages.collected(_reading)
    table = np.array(rows, dtype=float).reshape(-1, 7)
    oriented = not gyro and len(table) > 0 and bool((table[:, 5] != -1).all())
    if oriented:
        headings = planar_headings(table[:, :4])
        good = messages.keep(~headings.flawed, number, "with a wrong orientation, or tilted by over 20 degrees")
    else:
        good = messages.keep(possible(table[:, 4:5], _FASTEST), number, "without a rate of turn")
    good = good[messages.in_order(times[good], number[good])]
    messages.require(len(good))
    warnings.extend(messages.warnings())
    rates = np.where(np.isfinite(table[good, 4]), table[good, 4], 0.0)
    if not oriented:
        return Inertial(times[good], rates, None, None)
    variances = table[good, 6]
    if sigma is None and not (np.isfinite(variances) & (variances > 0)).all():
        raise DataError(
            f"{bag.path}: topic {topic.name}: its orientations have no covariance; say how exact they are, a standard "
            "deviation in degrees: --set heading_sigma_deg=2, or take its rates of turn: --set imu=gyro"
        )
    sigmas = np.sqrt(variances) if sigma is None else np.full(len(good), sigma)
    return Inertial(times[good], rates, headings.headings[good], sigmas)


def _reading(message: Any) -> tuple[float, ...]:
    """Orientation, rate of turn, the first of the orientation's covariances (-1: there is none) and that of its yaw."""
    turn, covariance = message.orientation, np.asarray(message.orientation_covariance, dtype=float)
    return tuple(
        float(value)
        for value in (turn.x, turn.y, turn.z, turn.w, message.angular_velocity.z, covariance[0], covariance[8])
    )


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


_UNKNOWN = 0  # position_covariance_type: COVARIANCE_TYPE_UNKNOWN
_HIGHEST = 1e5  # m; an altitude beyond is garbage


@dataclass(frozen=True, eq=False)
class Fixes:
    """Fixes at stamps (K,), ns: positions (K, 2), east and north of the first, m; sigmas (K, 2), m."""

    stamps: Stamps
    positions: Array
    sigmas: Array


def read_fixes(bag: Bag, topic: Topic, sigma: float | None, warnings: list[str]) -> Fixes:
    """The fixes of a topic; those without a position are left out, and added to ``warnings``.

    sigma: m, of all fixes; None: by their covariances. DataError: these are not known, or too few fixes are left.
    """
    messages = MessageFilter(bag, topic)
    rows, number, times = messages.collected(_fix)
    table = np.array(rows, dtype=float).reshape(-1, 6)
    good = messages.keep(table[:, 0] >= 0, number, "without a fix (status -1)")
    possible = (np.abs(table[:, 1]) <= 90) & (np.abs(table[:, 2]) <= 360)
    good = good[messages.keep(possible[good], number[good], "without latitude and longitude")]
    if sigma is None:
        known = (np.isfinite(table[:, 4:]) & (table[:, 4:] > 0)).all(axis=1)
        if not known[good].any() and len(good):
            raise DataError(
                f"{bag.path}: topic {topic.name}: its fixes have no covariance; say how exact they are, a standard "
                "deviation in m: --set fix_sigma=1.5"
            )
        good = good[messages.keep(known[good], number[good], "without a covariance (set fix_sigma)")]
    good = good[messages.in_order(times[good], number[good])]
    messages.require(len(good))
    warnings.extend(messages.warnings())
    chosen = table[good]
    height = float(chosen[0, 3]) if abs(chosen[0, 3]) < _HIGHEST else 0.0
    positions = east_north(chosen[:, 1], chosen[:, 2], (float(chosen[0, 1]), float(chosen[0, 2])), height)
    sigmas = np.sqrt(chosen[:, 4:]) if sigma is None else np.full_like(positions, sigma)
    return Fixes(times[good], positions, sigmas)


def _fix(message: Any) -> tuple[float, ...]:
    """Status, latitude, longitude, altitude, and the variances of east and north, NaN where they are not known."""
    covariance = np.asarray(message.position_covariance, dtype=float).reshape(3, 3)
    unknown = int(message.position_covariance_type) == _UNKNOWN
    variances = (np.nan, np.nan) if unknown else (covariance[0, 0], covariance[1, 1])
    place = (message.latitude, message.longitude, message.altitude)
    return tuple(float(value) for value in (message.status.status, *place, *variances))


_LONGEST_GAP = 0.3  # s between messages, across which no angle is counted; chosen
_LEAST_SPAN = 0.05  # s; a turn over less tells nothing


@dataclass(frozen=True, eq=False)
class SensorReferences:
    """Fixes and inertial messages of a recording, with the stamp, ns, that its times count from.

    bias: rate of turn, rad/s, that each gyro shows at rest. bias_sigma: largest standard deviation of these, rad/s.
    """

    fixes: Sequence[Fixes]
    inertial: Sequence[Inertial]
    origin: int
    options: RosbagOptions
    bias: Sequence[float]
    bias_sigma: float = 0.0

    @property
    def stamps(self) -> list[Stamps]:
        """Stamps of the messages of each topic, ns."""
        return [*(fixes.stamps for fixes in self.fixes), *(inertial.stamps for inertial in self.inertial)]

    def without_bias(self, samples: WheelSamples, least_rest: float, still: float, place: str) -> SensorReferences:
        """The sensors with the gyros' offsets, seen while the wheels rest for ``least_rest`` s (see ``find_rests``).

        White noise of a rate leaves its mean over a rest of T s unknown by the noise over sqrt(T). DataError: there is
        no rest, and ``gyro_offset_deg`` is not given.
        """
        rests = [rest for part in samples.stretches() for rest in find_rests(*samples.edges(part), least_rest, still)]
        offsets, sigmas = [], [0.0]
        for inertial in self.inertial:
            times = self._times(inertial.stamps)
            resting = np.zeros(len(times), dtype=bool)
            for begin, end in rests:
                resting |= (times >= begin) & (times <= end)
            if inertial.headings is None:
                sigmas.append(self._bias_sigma(float(resting.sum() * np.median(np.diff(times))), place))
            offsets.append(float(inertial.rates[resting].mean()) if resting.any() else 0.0)
        return replace(self, bias=offsets, bias_sigma=max(sigmas))

    def _bias_sigma(self, rested: float, place: str) -> float:
        """Standard deviation, rad/s, of a gyro's offset that was seen for some time, s."""
        if rested > 0:
            return math.radians(self.options.gyro_noise_deg) / math.sqrt(rested)
        if self.options.gyro_offset_deg is None:
            raise DataError(
                f"{place}: the robot never rests, so that nothing tells the gyro's offset; let it stand for some "
                "seconds, or say how large the offset may be, a standard deviation in deg/s: --set gyro_offset_deg=0.5"
            )
        return math.radians(self.options.gyro_offset_deg)

    def of_run(self, zero: float, end: float, *, start_known: bool) -> References | None:
        """The references of a run from the time ``zero`` on, for ``end`` s; None if there are none.

        start_known: its start pose is known in the frame of fixes and headings.
        """
        found: list[Reference] = []
        for fixes in self.fixes:
            times = self._times(fixes.stamps) - zero
            found += [
                Reference("position", _pair(fixes.positions[row]), _pair(fixes.sigmas[row]), float(times[row]))
                for row in self._one_a_period(times, end)
            ]
        for inertial, bias in zip(self.inertial, self.bias, strict=True):
            times = self._times(inertial.stamps) - zero
            if inertial.headings is not None and inertial.sigmas is not None:
                found += [
                    Reference("heading", float(inertial.headings[row]), float(inertial.sigmas[row]), float(times[row]))
                    for row in self._one_a_period(times, end)
                ]
            else:
                found += self._turns(times, inertial.rates - bias, end)
        if not found:
            return None
        references = References.of(found, end, start_known=start_known, rate_sigma=self.bias_sigma)
        metres = self.options.model_copy(update={"position_unit": "m"})
        return measured_as(references, metres, 1.0)

    def _times(self, stamps: Stamps) -> Array:
        """Times (K,) of stamps, s, by the clock of the wheels as the options say."""
        times: Array = (stamps - self.origin) / 1e9
        return times + (self.options.pose_time_offset + self.options.pose_time_drift * (times - times[0]))

    def _one_a_period(self, times: Array, end: float) -> list[int]:
        """Indices of the first of the times in each period of a run."""
        inside = np.flatnonzero((times >= 0) & (times <= end))
        _, first = np.unique(np.floor(times[inside] / self.options.reference_period), return_index=True)
        return [int(row) for row in inside[first]]

    def _turns(self, times: Array, rates: Array, end: float) -> list[Reference]:
        """Angles turned in each period; beside the offset's, their errors are independent: a rate's white noise."""
        angles = np.concatenate([[0.0], np.cumsum((rates[1:] + rates[:-1]) / 2 * np.diff(times))])
        begin, last = max(0.0, float(times[0])), min(end, float(times[-1]))
        if last - begin < _LEAST_SPAN:
            return []
        count = max(1, round((last - begin) / self.options.reference_period))
        edges = np.linspace(begin, last, count + 1)
        at = np.interp(edges, times, angles)
        sigma = math.radians(self.options.gyro_noise_deg) * math.sqrt((last - begin) / count)
        gaps = np.flatnonzero(np.diff(times) > _LONGEST_GAP)
        seen = [not ((times[gaps] < edges[row + 1]) & (times[gaps + 1] > edges[row])).any() for row in range(count)]
        return [
            Reference("turn", float(at[row + 1] - at[row]), sigma, float(edges[row + 1]), float(edges[row]))
            for row in np.flatnonzero(seen).tolist()
        ]


def read_sensors(
    bag: Bag, topics: Sequence[Topic], origin: int, options: RosbagOptions, warnings: list[str]
) -> SensorReferences | None:
    """The sensors of some topics; None without any. What is left out is added to ``warnings``. DataError."""
    if not topics:
        return None
    sigma = None if options.heading_sigma_deg is None else math.radians(options.heading_sigma_deg)
    fixes = [read_fixes(bag, topic, options.fix_sigma, warnings) for topic in topics if topic.type == FIX]
    inertial = [
        read_inertial(bag, topic, sigma, options.imu == "gyro", warnings) for topic in topics if topic.type != FIX
    ]
    return SensorReferences(fixes, inertial, origin, options, [0.0] * len(inertial))


def _pair(values: Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])
