"""A simulated planar LIDAR: ranges from the robot's true poses to the nearest walls, ray by ray as the mirror turns."""

from __future__ import annotations

import math

import numpy as np
import shapely
from pydantic import Field, FiniteFloat, model_validator

from omnibench.config import Model, NonNegative, Positive
from omnibench.data.scans import Mount, Scanner, TrajectoryScans
from omnibench.data.true_poses import TruePath
from omnibench.errors import DataError
from omnibench.robot.compiled import compiled
from omnibench.robot.kinematics import Array, compose
from omnibench.simulate.floor_plan import FloorPlan

_SHORTEST_PERIOD = 0.001  # s between scans; a shorter one is a mistake of units


class LidarMount(Model):
    """Pose of the LIDAR in the robot's frame, or in that of its tracked point where it has a ``mount``."""

    x: FiniteFloat = Field(0.1, description="m, forward")
    y: FiniteFloat = Field(0.0, description="m, left")
    yaw_deg: FiniteFloat = Field(0.0, description="degrees, counter-clockwise")
    pitch_deg: float = Field(0.0, ge=-60, le=60, description="degrees, tilted down ahead: rays may meet the floor")
    height: Positive = Field(0.5, description="m above the floor; without effect on a horizontal scanner")

    @property
    def in_radians(self) -> Mount:
        """The mount as data sets describe it; a horizontal scanner's height is left out."""
        height = self.height if self.pitch_deg else 0.0
        yaw, pitch = math.radians(self.yaw_deg), math.radians(self.pitch_deg)
        return Mount(x=self.x, y=self.y, yaw=yaw, pitch=pitch, height=height)


class Lidar(Model):
    """A planar LIDAR; the defaults are those of the Hokuyo UTM-30LX of the paper's robot.

    Its data sheet (Hokuyo Automatic, UTM-30LX specification): 0.1 to 30 m, 270 degrees in steps of 1/1440 of a turn,
    25 ms a turn, sigma of a range below 10 mm up to 10 m and below 30 mm beyond; its protocol gives whole mm. It has
    1081 ranges from -135 to 135 degrees; the paper's Table 1 keeps 1080.
    """

    name: str = "Hokuyo UTM-30LX"
    rays: int = Field(1080, gt=0, le=100_000, description="ranges of a scan")
    field_of_view_deg: float = Field(
        270.0, gt=0, le=360, description="degrees, ahead in the middle; rays are field_of_view_deg / rays apart"
    )
    turn_time: float = Field(0.025, ge=0, le=10, description="s for a whole turn of the mirror")
    range_min: NonNegative = Field(0.1, description="m; nearer walls are not seen")
    range_max: Positive = Field(30.0, description="m; walls farther off are not seen")
    noise: float = Field(0.01, ge=0, le=10, description="standard deviation of a range, m")
    far_noise: float = Field(0.03, ge=0, le=10, description="standard deviation of ranges beyond far, m")
    far: Positive = Field(10.0, description="m")
    resolution: float = Field(0.001, ge=1e-6, le=1, description="step of the ranges, m")
    mount: LidarMount = LidarMount()
    period: tuple[float, float] = Field((0.2, 0.3), description="shortest and longest time between scans, s")
    latency: float = Field(0.0, ge=0, le=1, description="from a scan's first ray to its stamp, s")
    dropouts: float = Field(0.001, ge=0, lt=1, description="probability that a ray returns nothing")
    distortion: bool = Field(
        True, description="rays are measured one after another while the robot moves; false: all at once"
    )

    @model_validator(mode="after")
    def _scans_follow_each_other(self) -> Lidar:
        if self.range_min >= self.range_max:
            raise ValueError(f"range_min {self.range_min:g} m is not below range_max {self.range_max:g} m")
        low, high = self.period
        if not (_SHORTEST_PERIOD <= low <= high < math.inf):
            raise ValueError(
                f"period: expected the shortest and the longest time between scans, from {_SHORTEST_PERIOD:g} s on "
                f"(given: {low:g}, {high:g})"
            )
        if low < self.sweep:
            raise ValueError(f"period: {low:g} s; a scan takes {self.sweep:g} s, give more or a shorter turn_time")
        return self

    @property
    def sweep(self) -> float:
        """Duration of a scan, s."""
        return self.turn_time * self.field_of_view_deg / 360 if self.distortion else 0.0

    @property
    def scanner(self) -> Scanner:
        """Description of the scanner in the data set."""
        increment = math.radians(self.field_of_view_deg) / self.rays
        rounding = self.resolution / math.sqrt(12)
        return Scanner(
            name=self.name,
            rays=self.rays,
            angle_min=-math.radians(self.field_of_view_deg) / 2,
            angle_increment=increment,
            time_increment=self.sweep / self.rays,
            range_min=self.range_min,
            range_max=self.range_max,
            noise=max(self.noise, rounding),
            far_noise=max(self.far_noise, rounding),
            far=self.far,
            mount=self.mount.in_radians,
        )


def scan_stamps(lidar: Lidar, end: float, rng: np.random.Generator) -> Array:
    """Stamps (S,) of scans, s, from 0 on at random intervals; the last scan is complete by ``end``.

    DataError in one line: there is no time for a single scan.
    """
    last = end - max(lidar.sweep - lidar.latency, 0.0)
    if last < 0:
        raise DataError(f"the run ends at {end:g} s, before the LIDAR's first scan; drive longer or let it rest")
    low, high = lidar.period
    between = rng.uniform(low, high, size=math.ceil(last / low))
    stamps = np.concatenate([[0.0], np.cumsum(between)])
    return stamps[stamps <= last]


def measure_scans(
    plan: FloorPlan, lidar: Lidar, track: TruePath, stamps: Array, rng: np.random.Generator
) -> TrajectoryScans:
    """Scans of a room at stamps (S,), s, which include the latency.

    Each ray starts at the scanner's pose when it is measured. Walls and obstacles are as high as the rays of a tilted
    scanner reach; its rays end on the floor where that is nearer. DataError in one line: the scanner is inside a wall,
    or a scan sees nothing.
    """
    scanner = lidar.scanner
    measured = stamps - lidar.latency
    x, y, _ = compose(track.at(measured), scanner.mount.pose).T
    for row in np.flatnonzero(~shapely.contains_xy(plan.free, x, y))[:1]:
        place = plan.place_of(np.array([x[row], y[row]]))
        raise DataError(
            f"the LIDAR at ({x[row]:.2f}, {y[row]:.2f}) m is {place} of the room {plan.name} at {measured[row]:g} s; "
            "check lidar.mount, the robot's radius and the way it drives"
        )
    to_walls = cast_rays(plan.segments, scanner, track.times, track.poses, measured) / scanner.level_shares
    true = np.minimum(to_walls, scanner.floor_ranges)
    ranges = true + rng.standard_normal(true.shape) * np.where(true > lidar.far, lidar.far_noise, lidar.noise)
    ranges = lidar.resolution * np.round(ranges / lidar.resolution)
    seen = (true <= lidar.range_max) & (ranges <= lidar.range_max) & (ranges >= lidar.range_min)
    seen &= rng.uniform(size=true.shape) >= lidar.dropouts
    for row in np.flatnonzero(~seen.any(axis=1))[:1]:
        x, y, _ = track.at(measured[row])
        raise DataError(
            f"the LIDAR sees nothing at {stamps[row]:g} s, the robot at ({x:.2f}, {y:.2f}) m: no wall from "
            f"{lidar.range_min:g} to {lidar.range_max:g} m; choose a smaller room, or more range or fewer dropouts"
        )
    return TrajectoryScans(stamps, np.where(seen, ranges, np.inf).astype(np.float32))


def cast_rays(segments: Array, scanner: Scanner, track_times: Array, track_poses: Array, times: Array) -> Array:
    """True distances (S, R) over the floor, m, from a moving scanner to the nearest wall along its rays; inf: none.

    segments (W, 4): x, y of both ends of each wall, m. track_poses (M, 3): the robot's poses at track_times
    (M,), interpolated linearly, constant outside. times (S,): times of the scans' first rays, s.
    """
    mount = scanner.mount
    segments, track_times, track_poses, times = (
        np.ascontiguousarray(array, dtype=float) for array in (segments, track_times, track_poses, times)
    )
    x, y = float(mount.x), float(mount.y)
    return _cast(segments, track_times, track_poses, times, scanner.delays, scanner.bearings, x, y)


@compiled
def _cast(
    segments: Array, track_times: Array, track_poses: Array, times: Array, delays: Array, angles: Array,
    mount_x: float, mount_y: float,
) -> Array:  # fmt: skip
    distances = np.empty((len(times), len(angles)))
    for scan in range(len(times)):
        after = np.searchsorted(track_times, times[scan])
        for ray in range(len(angles)):
            time = times[scan] + delays[ray]
            while after < len(track_times) and track_times[after] < time:
                after += 1
            x, y, heading = _pose(track_times, track_poses, after, time)
            cosine, sine = math.cos(heading), math.sin(heading)
            x, y = x + cosine * mount_x - sine * mount_y, y + sine * mount_x + cosine * mount_y
            turned = heading + angles[ray]
            distances[scan, ray] = _nearest(segments, x, y, math.cos(turned), math.sin(turned))
    return distances


@compiled
def _pose(track_times: Array, track_poses: Array, after: int, time: float) -> tuple[float, float, float]:
    """The pose at a time. after: index of the first pose of the track that is not earlier."""
    before = max(after - 1, 0)
    after = min(after, len(track_times) - 1)
    share = (time - track_times[before]) / (track_times[after] - track_times[before]) if after > before else 0.0
    first, second = track_poses[before], track_poses[after]
    return (
        first[0] + share * (second[0] - first[0]),
        first[1] + share * (second[1] - first[1]),
        first[2] + share * (second[2] - first[2]),
    )


@compiled
def _nearest(segments: Array, x: float, y: float, along_x: float, along_y: float) -> float:
    """Distance from (x, y) to the nearest wall in a direction of length 1.

    A wall is hit if its ends are on either side of the ray. No ray slips through where two walls meet: for both, the
    corner is on the same side.
    """
    nearest = np.inf
    for wall in range(len(segments)):
        first_x, first_y = segments[wall, 0] - x, segments[wall, 1] - y
        second_x, second_y = segments[wall, 2] - x, segments[wall, 3] - y
        first_left = along_x * first_y - along_y * first_x
        second_left = along_x * second_y - along_y * second_x
        if (first_left < 0.0) != (second_left < 0.0):
            share = first_left / (first_left - second_left)
            first_ahead = along_x * first_x + along_y * first_y
            second_ahead = along_x * second_x + along_y * second_y
            distance = first_ahead + share * (second_ahead - first_ahead)
            if 0.0 <= distance < nearest:
                nearest = distance
    return nearest
