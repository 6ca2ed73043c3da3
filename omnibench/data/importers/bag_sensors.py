"""Sensors of a bag: scans, read on demand, with their scanner's place by tf; fixes, compasses and gyros as references.

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from omnibench.config import Positive, validate
from omnibench.data.importers.bag_messages import (
    FIX,
    TRANSFORMS,
    Bag,
    Clock,
    Topic,
    TopicMessages,
    open_bag,
    possible,
    reader_of,
)
from omnibench.data.recording import ReferenceOptions, ScanReadings, ScanShape, scan_difference
from omnibench.data.references import Reference, ReferenceKind, References
from omnibench.data.runs import WheelSamples, find_rests, measured_as
from omnibench.data.scans import Mount, Ranges, Scanner
from omnibench.data.splits import Names
from omnibench.errors import ConfigError, DataError, nearest
from omnibench.robot.kinematics import Array

_FASTEST = 100.0  # rad/s; no robot turns faster
_SEMI_MAJOR = 6378137.0  # m, a of WGS 84
_FLATTENING = 1 / 298.257223563  # of WGS 84
_ECCENTRICITY_SQUARED = _FLATTENING * (2 - _FLATTENING)
_UNKNOWN = 0  # position_covariance_type: COVARIANCE_TYPE_UNKNOWN
_ON_EARTH = 1.0000001  # of the largest latitude and longitude
_HIGHEST = 1e5  # m; an altitude beyond is garbage
_FIX = ["status.status", "latitude", "longitude", "altitude", "position_covariance_type"]
_FIX += ["position_covariance.0", "position_covariance.4"]
_IMU = ["orientation.x", "orientation.y", "orientation.z", "orientation.w", "angular_velocity.z"]
_IMU += ["orientation_covariance.0", "orientation_covariance.8"]  # the first is -1 where there is no orientation
_LONGEST_GAP = 0.3  # s between messages, across which no angle is counted; chosen
_LEAST_SPAN = 0.05  # s; a turn over less tells nothing


class SensorOptions(ReferenceOptions):
    """Fixes of satellites and inertial sensors, and how exact they are."""

    group: ClassVar[str] = "Fixes, compasses and gyros"

    references: Names = Field((), description="NavSatFix, Imu; default: those there are, without poses and scans")
    imu: Literal["auto", "gyro"] = Field("auto", description="gyro: its rates of turn; auto: its headings, if any")
    fix_sigma: Positive | None = Field(None, description="m, standard deviation of a fix; default: its covariance's")
    heading_sigma_deg: Positive | None = Field(None, description="deg, of an Imu's heading; default: its covariance's")
    gyro_noise_deg: Positive = Field(0.1, description="deg per sqrt(s), by which the angle of a gyro wanders")
    gyro_offset_deg: Positive | None = Field(None, description="deg/s, of a gyro whose robot never rests")
    reference_period: Positive = Field(1.0, description="s; one fix, heading or turn is taken in each")


def east_north(latitudes: Array, longitudes: Array, origin: tuple[float, float], height: float = 0.0) -> Array:
    """East and north (K, 2), m, of latitudes and longitudes (K,), degrees, as seen from an origin, degrees.

    height: m above the ellipsoid, of all points: the robot is on the floor.
    """

    def geocentric(phi: Array, lam: Array) -> Array:  # Eq. (1)
        normal = _SEMI_MAJOR / np.sqrt(1 - _ECCENTRICITY_SQUARED * np.sin(phi) ** 2)
        out = (normal + height) * np.cos(phi)
        up = (normal * (1 - _ECCENTRICITY_SQUARED) + height) * np.sin(phi)
        return np.array([out * np.cos(lam), out * np.sin(lam), up])

    phi, lam = np.radians(origin)
    start = geocentric(np.array([phi]), np.array([lam]))
    dx, dy, dz = geocentric(np.radians(latitudes), np.radians(longitudes)) - start
    east = -np.sin(lam) * dx + np.cos(lam) * dy  # Eq. (2)
    north = -np.sin(phi) * (np.cos(lam) * dx + np.sin(lam) * dy) + np.cos(phi) * dz  # Eq. (3)
    return np.column_stack([east, north])


@dataclass(frozen=True, eq=False)
class SensorReadings:
    """Readings at times (K,), s, by the clock of the wheels: positions, headings, or rates of turn (kind ``turn``).

    values (K, n): m east and north, rad, or rad/s. sigmas (K, n): standard deviations of positions and headings.
    """

    kind: ReferenceKind
    times: Array
    values: Array
    sigmas: Array


def read_sensor(bag: Bag, topic: Topic, options: SensorOptions, seconds: Clock, notes: list[str]) -> SensorReadings:
    """The readings of a topic; what is left out is added to ``notes``. DataError: how exact they are is not known."""
    fields = _FIX if topic.type == FIX else _IMU
    messages = TopicMessages(bag, topic, reader_of(fields))
    table = messages.table(len(fields))
    kind: ReferenceKind = "position" if topic.type == FIX else "heading"
    option, sigma, way = "fix_sigma", options.fix_sigma, "m: --set fix_sigma=1.5"
    if kind == "position":
        messages.keep(table[:, 0] >= 0, "without a fix (status -1)")
        messages.keep(possible(table[:, 1:3] / (90, 360), _ON_EARTH), "without latitude and longitude")
        values, variances = table[:, 1:3], np.where(table[:, 4:5] == _UNKNOWN, np.nan, table[:, 5:])
    elif options.imu == "gyro" or not len(table) or (table[:, 5] == -1).any():
        kind, values, variances = "turn", table[:, 4:5], np.ones((len(table), 1))
        messages.keep(possible(values, _FASTEST), "without a rate of turn")
    else:
        option, sigma = "heading_sigma_deg", options.heading_sigma_deg and math.radians(options.heading_sigma_deg)
        way = "degrees: --set heading_sigma_deg=2, or take its rates of turn: --set imu=gyro"
        values, variances = messages.keep_planar(table[:, :4])[:, None], table[:, 6:]
    variances = np.full_like(variances, sigma**2) if sigma else variances
    exact: NDArray[np.bool_] = np.asarray((np.isfinite(variances) & (variances > 0)).all(axis=1))
    if len(messages.rows) and not exact[messages.rows].any():
        what = f"its {kind}s have no covariance; say how exact they are, a standard deviation in {way}"
        raise DataError(f"{messages.place}: {what}")
    messages.keep(exact, f"without a covariance (set {option})")
    rows = messages.in_order(notes)
    values, sigmas = values[rows], np.sqrt(variances[rows])
    if kind == "position":
        altitude, (latitude, longitude) = float(table[rows[0], 3]), values[0].tolist()
        height = altitude if abs(altitude) < _HIGHEST else 0.0
        values = east_north(values[:, 0], values[:, 1], (latitude, longitude), height)
    times = seconds(topic, messages.stamps[rows])
    times = times + (options.pose_time_offset + options.pose_time_drift * (times - times[0]))
    return SensorReadings(kind, times, values, sigmas)


@dataclass(frozen=True, eq=False)
class BagSensors:
    """Fixes, headings and gyros of a recording. rate_sigma: standard deviation of the gyros' offsets, rad/s."""

    readings: Sequence[SensorReadings]
    options: SensorOptions
    rate_sigma: float = 0.0

    def without_bias(self, samples: WheelSamples, least_rest: float, still: float, place: str) -> BagSensors:
        """The sensors with the gyros' offsets, seen while the wheels rest for ``least_rest`` s (see ``find_rests``).

        White noise of a rate leaves its mean over a rest of T s unknown by the noise over sqrt(T). DataError: there is
        no rest, and ``gyro_offset_deg`` is not given.
        """
        rests = [rest for part in samples.stretches() for rest in find_rests(*samples.edges(part), least_rest, still)]
        readings, offsets = [], [0.0]
        for sensor in self.readings:
            if sensor.kind == "turn":
                within = [(sensor.times >= begin) & (sensor.times <= end) for begin, end in rests]
                resting = np.any(within, axis=0) if rests else np.zeros(len(sensor.times), dtype=bool)
                if resting.any():
                    rested = float(resting.sum() * np.median(np.diff(sensor.times)))
                    offsets.append(math.radians(self.options.gyro_noise_deg) / math.sqrt(rested))
                    sensor = replace(sensor, values=sensor.values - sensor.values[resting].mean())
                elif self.options.gyro_offset_deg is None:
                    raise DataError(
                        f"{place}: the robot never rests, so that nothing tells the gyro's offset; let it stand for "
                        "some seconds, or say how large the offset may be, a standard deviation in deg/s: "
                        "--set gyro_offset_deg=0.5"
                    )
                else:
                    offsets.append(math.radians(self.options.gyro_offset_deg))
            readings.append(sensor)
        return replace(self, readings=readings, rate_sigma=max(offsets))

    def of_run(self, zero: float, end: float, *, start_known: bool) -> References | None:
        """The references of a run from the time ``zero`` on, for ``end`` s; None if there are none.

        start_known: its start pose is known in the frame of fixes and headings.
        """
        references: list[Reference] = []
        for sensor in self.readings:
            times = sensor.times - zero
            if sensor.kind == "turn":
                references += self._turns(times, sensor.values[:, 0], end)
                continue
            # The first reading in each period of the run.
            inside = np.flatnonzero((times >= 0) & (times <= end))
            _, first = np.unique(np.floor(times[inside] / self.options.reference_period), return_index=True)
            references += [
                Reference(sensor.kind, tuple(sensor.values[row]), tuple(sensor.sigmas[row]), float(times[row]))
                for row in inside[first]
            ]
        if not references:
            return None
        measured = References.of(references, end, start_known=start_known, rate_sigma=self.rate_sigma)
        return measured_as(measured, self.options.model_copy(update={"position_unit": "m", "heading_unit": "rad"}))

    def _turns(self, times: Array, rates: Array, end: float) -> list[Reference]:
        """Angles turned in each period; beside the offset's, their errors are independent: a rate's white noise."""
        begin, last = max(0.0, float(times[0])), min(end, float(times[-1]))
        if last - begin < _LEAST_SPAN:
            return []
        edges = np.linspace(begin, last, max(1, round((last - begin) / self.options.reference_period)) + 1)
        angles = np.concatenate([[0.0], np.cumsum((rates[1:] + rates[:-1]) / 2 * np.diff(times))])
        turned = np.diff(np.interp(edges, times, angles))
        sigma = math.radians(self.options.gyro_noise_deg) * math.sqrt((last - begin) / len(turned))
        gaps = np.flatnonzero(np.diff(times) > _LONGEST_GAP)
        return [
            Reference("turn", angle, sigma, t1, t0)
            for angle, t0, t1 in zip(turned.tolist(), edges[:-1].tolist(), edges[1:].tolist(), strict=True)
            if not ((times[gaps] < t1) & (times[gaps + 1] > t0)).any()
        ]


_BASES = ("base_link", "base_footprint", "base")  # REP-105; with or without the robot's namespace
_LARGEST_TILT = math.radians(20)  # rad; a scanner with a larger tilt does not scan parallel to the floor (chosen)
_SAME_INCREMENT = 0.1  # relative difference of the time between rays, which some drivers measure anew for every scan
Parents = dict[str, tuple[str, Array]]


def _transforms(bag: Bag, topic: Topic) -> Iterator[tuple[str, str, Any]]:
    """Frame, parent and transform from the frame to its parent, of all messages of a topic."""
    for _, _, message in bag.records(topic):
        for each in getattr(message, "transforms", ()):
            yield each.child_frame_id.strip("/"), each.header.frame_id.strip("/"), each.transform


def fixed_transforms(bag: Bag) -> Parents:
    """Parent of every frame of /tf_static, and the transform (4, 4) from the frame to its parent."""
    from scipy.spatial.transform import RigidTransform, Rotation  # slow, and needed by bags with transforms alone

    parents: Parents = {}
    for topic in bag.of_type(TRANSFORMS):
        for child, parent, transform in _transforms(bag, topic) if topic.name.endswith("tf_static") else ():
            turn, place = transform.rotation, transform.translation
            try:
                rotation = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])
            except ValueError:  # all zeros: no rotation, and so no transform
                continue
            matrix = RigidTransform.from_components([place.x, place.y, place.z], rotation).as_matrix()
            if np.isfinite(matrix).all():
                parents[child] = parent, matrix
    return parents


def _way_up(frame: str, parents: Mapping[str, str], ends: Callable[[str], bool]) -> list[str] | None:
    """Frames from one up to below the first that ``ends`` the way; None if none does."""
    links: list[str] = []
    while not ends(frame):
        if frame not in parents or frame in links:
            return None
        links.append(frame)
        frame = parents[frame]
    return links


def frames_between(bag: Bag, topic: Topic, frames: Sequence[str]) -> tuple[list[str], Parents]:
    """The frames from the second of two to the first, which transforms of a topic or fixed ones place; and the fixed.

    ConfigError: no frames are given, nothing leads from one to the other, or nothing moves on the way.
    """
    fixed = fixed_transforms(bag)
    parents = {child: parent for child, parent, _ in _transforms(bag, topic)}
    parents |= {child: parent for child, (parent, _) in fixed.items()}
    found = f"found: {', '.join(f'{parent} > {child}' for child, parent in parents.items()) or 'none'}"
    place = f"{bag.path}: topic {topic.name}"
    if not frames:
        raise ConfigError(f"{place}: set pose_frames=[world, robot] to the frames of the reference; {found}")
    world, child = (frame.strip("/") for frame in frames)
    links = _way_up(child, parents, lambda frame: frame == world)
    if links is None:
        known = {*parents, *parents.values()}
        hint = nearest(child, known) if child not in known else ""
        raise ConfigError(f"{place}: pose_frames: no transforms lead from {world} to {frames[1]}; {hint}{found}")
    if fixed.keys() >= set(links):
        raise ConfigError(f"{place}: pose_frames: {frames[1]} does not move in {world}; {found}")
    return links, fixed


def read_scans(bag: Bag, topic: Topic, mount: Mount | None, seconds: Clock, notes: list[str]) -> ScanReadings:
    """Check every scan of a topic; what is left out is added to ``notes``. DataError, or ConfigError: it is no scanner.

    mount: of the scanner; None: by /tf_static. The stamp of a scan is that of its first ray.
    """
    messages = TopicMessages(bag, topic, _laser_scan)
    place, scans = messages.place, messages.contents
    shape = scans[0][0] if scans else ScanShape(0, 0, 0, 0, 0)
    for number, (other, *_) in zip(messages.numbers, scans, strict=True):
        if difference := scan_difference(shape, other):
            raise DataError(
                f"{place}, message {number}: {difference} as in the messages before; all scans must be of one scanner, "
                "of one number of rays"
            )
    empty = f"without a range from {shape.range_min:g} to {shape.range_max:g} m"
    messages.keep(np.array([seen for _, seen, *_ in scans], dtype=bool), empty)
    rows = messages.in_order(notes)
    _, _, frame, _, scan_time = scans[0]
    # The scanner's time between rays, s: the median of its scans.
    increments = np.array([increment for _, _, _, increment, _ in scans])
    increment = float(np.median(increments))
    if np.abs(increments - increment).max() > _SAME_INCREMENT * abs(increment):
        varies = f"time_increment varies from {increments.min():.3g} to {increments.max():.3g} s"
        notes.append(f"{place}: {varies}; its median, {increment:.3g} s, is taken")
    if increment == 0 and scan_time > 0:
        instant = "time_increment is 0, so that each scan counts as taken at one instant"
        notes.append(f"{place}: {instant}, though scan_time is {scan_time:.3g} s")
    mount, sense = (mount, 1) if mount else _mounting(bag, frame, place, notes)
    angles = {"angle_min": sense * shape.angle_min, "angle_increment": sense * shape.angle_increment}
    content = {"name": topic.name, "time_increment": increment, "mount": mount, **shape._asdict(), **angles}
    scanner = validate(Scanner, content, place)
    stamps, logged = messages.stamps[rows], messages.logged[rows]

    def read(chosen: NDArray[np.intp]) -> Ranges:
        """The ranges of some scans. DataError: the bag has changed since it was opened."""
        keys = zip(logged[chosen].tolist(), stamps[chosen].tolist(), strict=True)
        places = {key: index for index, key in enumerate(keys)}
        ranges = np.empty((len(chosen), scanner.rays), np.float32)
        with open_bag(bag.path, [topic.name] if topic.recorded else [], bag.definitions) as again:
            first, last = int(logged[chosen].min()), int(logged[chosen].max())
            for _, when, message in again.records(again.topic(topic.name, "scan_topic"), first, last):
                index = places.pop((when, topic.stamp(message, when)), None)
                if index is not None and len(message.ranges) == scanner.rays:
                    ranges[index] = _measured(message)
        if places:
            raise DataError(f"{place}: the bag has changed since it was opened; import it again")
        return ranges

    return ScanReadings(scanner, place, seconds(topic, stamps), read)


def _laser_scan(message: Any) -> tuple[ScanShape, bool, str, float, float]:
    """Shape of a scan, whether any range is a measurement, its frame, time between its rays (s), its duration (s)."""
    range_max = float(message.range_max)
    if not np.isfinite(range_max):  # some drivers give no limit
        range_max = float(np.finfo(np.float32).max)
    angles = float(message.angle_min), float(message.angle_increment)
    shape = ScanShape(len(message.ranges), *angles, float(message.range_min), range_max)
    seen = bool(np.isfinite(_measured(message)).any())
    return shape, seen, message.header.frame_id, float(message.time_increment), float(message.scan_time)


def _measured(message: Any) -> Ranges:
    """The ranges of a scan (R,), m; inf for NaN, 0 and values out of the scanner's range, which are no measurements."""
    ranges = np.asarray(message.ranges, dtype=np.float32)
    good = (ranges >= message.range_min) & (ranges <= message.range_max) & (ranges > 0)  # False for NaN
    return np.where(good, ranges, np.float32(np.inf))


def _mounting(bag: Bag, frame: str, place: str, notes: list[str]) -> tuple[Mount, int]:
    """The mount of a scanner by /tf_static, or the robot's middle; and -1 if it hangs upside down, else 1.

    Counter-clockwise rays of one that hangs upside down run clockwise in the robot's frame. DataError: it is tilted.
    """
    fixed, whole = fixed_transforms(bag), np.eye(4)
    parents = {child: parent for child, (parent, _) in fixed.items()}
    links = _way_up(frame.strip("/"), parents, lambda child: child.rpartition("/")[2] in _BASES)
    if links is None:
        notes.append(
            f"{place}: it is unknown where the scanner ({frame or 'a frame without a name'}) is mounted (no /tf_static "
            "from base_link); the robot's middle is taken; --set 'scanner_mount={x: 0.1, y: 0, yaw: 0}' (m, rad)"
        )
        return Mount(), 1
    for link in links:
        whole = fixed[link][1] @ whole
    tilt = math.acos(np.clip(whole[2, 2], -1.0, 1.0))
    if min(tilt, math.pi - tilt) > _LARGEST_TILT:
        raise DataError(
            f"{bag.path}: the scanner's frame {frame} is tilted by {math.degrees(tilt):.0f} degrees, so that it does "
            "not scan the plane of the floor; if it does, set scanner_mount"
        )
    yaw = math.atan2(whole[1, 0], whole[0, 0])
    return Mount(x=float(whole[0, 3]), y=float(whole[1, 3]), yaw=yaw), -1 if tilt > math.pi / 2 else 1
