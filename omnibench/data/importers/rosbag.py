"""Importer of ROS recordings (MCAP files, rosbag2 folders and ROS 1 bags): its options, and which topics it reads.

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
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from omnibench.config import Positive
from omnibench.data.dataset import Dataset
from omnibench.data.importer import Importer
from omnibench.data.importers import bags
from omnibench.data.importers.bags import Bag, Stamps, Topic, TopicMessages
from omnibench.data.recording import Event, Notes, PoseReadings, Recording, RunAttributes, WheelReadings
from omnibench.data.recording_options import ReferenceOptions, Signs, WheelUnit, words_of
from omnibench.data.references import Reference, ReferenceKind, References
from omnibench.data.runs import WheelSamples, dataset_of, find_rests, measured_as
from omnibench.data.scans import Mount
from omnibench.data.splits import Names
from omnibench.data.spoiled_references import follows_the_wheels
from omnibench.errors import ConfigError, DataError, nearest, one_line
from omnibench.registry import importers
from omnibench.robot.joint_choice import JointChoice
from omnibench.robot.kinematics import Array, compose, interpolated, pose_covariance, usable_covariances
from omnibench.words import plural, some

JOINT_STATE, ODOMETRY = "sensor_msgs/msg/JointState", "nav_msgs/msg/Odometry"
POSE_TYPES = tuple(f"geometry_msgs/msg/{name}Stamped" for name in ("PoseWithCovariance", "Pose", "Transform"))
_TWISTS = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")
_NUMBERS = re.compile(r"std_msgs/msg/(U?Int(8|16|32|64)|Float(32|64))(MultiArray)?")  # types
_REFERENCES = "poses, sensor_msgs/LaserScan, NavSatFix or Imu"
_OWN_POSES = re.compile(r"(?<![a-z])odom(etry)?(?![a-z])")  # in the name of a topic
_NO_WHEELS = {"geometry_msgs", "nav_msgs", "sensor_msgs", "tf2_msgs", "rcl_interfaces", "rosgraph_msgs"}  # packages
_COUNTED = {"data", "tick", "encoder", "count", "position", "angle", "wheel"}  # words of what wheels count
# A longer gap while the robot drives ends a stretch, since a constant twist does not describe it (chosen):
_LONGEST_GAP = 0.5  # s, and
_LONGEST_GAP_PERIODS = 10  # sample periods
_LARGEST_COUNT = 2.0**64  # of a joint, in any unit; a larger value is garbage
# Types of poses in messages, and their fields with x and y, and with the quaternion.
_POSES = {
    "geometry_msgs/msg/Pose": ("position", "orientation"),
    "geometry_msgs/msg/Transform": ("translation", "rotation"),
}
_COVARIANCE = [f"covariance.{6 * row + column}" for row in (0, 1, 5) for column in (0, 1, 5)]  # of x, y and yaw

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
_GYRO_GAP = 0.3  # s between messages, across which no angle is counted; chosen
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


class RosbagOptions(SensorOptions):
    """The robot, topics and joints, and how the recording is cut into runs."""

    group: ClassVar[str] = "Topics, joints and cuts"

    name: str = Field("rosbag", min_length=1, description="name of the data set")
    wheel_unit: WheelUnit = Field("rad", description="of positions and, per s, velocities; or rpm; or rad/sample, ...")
    wheel_topic: Names = Field((), description="of all wheels, or a list of one each; default: a JointState")
    steering_topic: Names = Field((), description="of all steering angles, or a list of one each; default: the wheels'")
    joints: Names = Field((), description="in the robot's order: joints, elements (from 0) or fields; default: by name")
    steering_joints: Names = Field((), description="in the order of the wheels that steer; default: by the names")
    joint_signs: Signs = Field((), description="another name of wheel_signs")
    use: Literal["auto", "positions", "velocities"] = Field("auto", description="auto: positions, if they are there")
    pose_topic: str | None = Field(
        None, min_length=1, description="default: the only one, or */slam_pose, no odometry or tf"
    )
    pose_columns: Names = Field((), description="fields of pose_topic: of x, y and heading, or of a geometry pose")
    pose_frames: Names = Field((), description="with a tf pose_topic: frame of the reference, and the tracked one")
    pose_sigma: tuple[Positive, Positive] | None = Field(None, description="m, deg, where poses have no covariance")
    scan_topic: str | None = Field(None, min_length=1, description="LaserScan; default: the only one, or /scan")
    scans: bool = Field(True, description="false: leave the scans out")
    scanner_mount: Mount | None = Field(None, description="of the scanner, m, rad; default: by /tf_static, else 0")
    slam: dict[str, Any] = Field({}, description="options of omnibench slam, for bags with scans and without poses")
    recorded_stamps: Names = Field((), description="topics of which the times of recording count, not the headers'")
    message_definitions: Names = Field((), description=".msg files, or folders, of types that bags lack")
    cut: Literal["rests", "topic", "windows", "none"] = Field("rests", description="where runs end and begin")
    cut_topic: str | None = Field(None, min_length=1, description="its messages begin runs; a String names the command")

    @model_validator(mode="before")
    @classmethod
    def _signs_have_one_name(cls, content: Any) -> Any:
        signs = content.get("joint_signs") if isinstance(content, Mapping) else None
        if signs and content.get("wheel_signs"):
            raise ValueError("joint_signs is another name of wheel_signs; leave one out")
        return {**content, "wheel_signs": signs} if signs else content

    @model_validator(mode="after")
    def _topics_fit_together(self) -> RosbagOptions:
        self.require_one_each("joints", "steering_joints")
        self.require_one_each("wheel_topic", "steering_topic", or_one=True)
        if not self.scans and (self.scan_topic is not None or self.scanner_mount is not None):
            raise ValueError("scans=false leaves the scans out; leave scan_topic and scanner_mount out, too")
        if len(self.wheel_topic) < 2 and len(set(self.joints)) < len(self.joints):
            raise ValueError("joints names one joint twice; name another one for each wheel")
        if isinstance(self.wraps_at, float) and self.use == "velocities":
            raise ValueError("wraps_at is for positions; leave it out with use=velocities")
        if self.quantity == {"positions": "rates", "velocities": "increments"}.get(self.use):
            raise ValueError(f"wheel_unit {self.wheel_unit} is not one of {self.use}; leave use out")
        if len(self.pose_frames) not in (0, 2):
            raise ValueError(f"pose_frames has {plural(len(self.pose_frames), 'value')}, expected 2: [world, robot]")
        if len(self.pose_columns) not in (0, 1, 3) or (self.pose_columns and not self.pose_topic):
            raise ValueError("pose_columns needs pose_topic, and is [X,Y,HEADING] or [POSE], paths in its messages")
        for key, cut in (("cut_topic", "topic"), ("window", "windows")):
            if (getattr(self, key) is not None) != (self.cut == cut):
                raise ValueError(f"cut={cut} and {key} belong together; give both or none")
        if self.wheel_time_unit != "s" or self.pose_time_unit not in (None, "s"):
            raise ValueError("stamps of bags are in s; leave wheel_time_unit and pose_time_unit out")
        return self


def wheel_topics(bag: Bag, options: RosbagOptions) -> list[Topic]:
    """The topics of the wheels: those named, else the only JointState, or the only one that ends in joint_states.

    DataError: the wheels are in messages of another type, and what to type then.
    """
    if options.wheel_topic:
        return [bag.topic(name, "wheel_topic") for name in options.wheel_topic]
    if topics := _only(bag, "wheel_topic", bag.of_type(JOINT_STATE), "joint_states"):
        return topics
    others = [topic for topic in bag.topics if topic.messages and topic.type.split("/")[0] not in _NO_WHEELS]
    way = wheels_typed(bag, options.robot.wheel_names, others)
    raise DataError(f"{bag.path}: no messages of type {JOINT_STATE}; topics found: {_listed(bag.topics)}{way}")


def wheels_typed(bag: Bag, wheels: Sequence[str], topics: Sequence[Topic]) -> str:
    """What to type for wheels that are numbers on one of the topics, by the words in the names of topics and fields."""
    numbers = {topic: fields for topic in topics if (fields := bag.numbers(topic))}
    if not numbers:
        return ""

    def words(name: str) -> set[str]:
        return {word.rstrip("s") for word in words_of(name)}

    def of_wheels(names: Sequence[str]) -> list[str]:
        """The one of the names that says each wheel; empty unless every wheel has one."""
        alike = [[name for name in names if words(wheel) <= words(name)] for wheel in wheels]
        return [names[0] for names in alike] if all(len(names) == 1 for names in alike) else []

    best = max(numbers, key=lambda topic: sum(len(words(name) & _COUNTED) for name in (topic.name, *numbers[topic])))
    fields = sorted(numbers[best], key=lambda path: not words(path) & _COUNTED)  # the likely ones first
    joints, topic = of_wheels(fields), best.name
    if not joints and (places := of_wheels([topic.name for topic in numbers if topic.type == best.type])):
        joints, topic = fields[:1] * len(wheels), f"[{','.join(places)}]"
    typed = f"--set wheel_topic={topic}"
    if not _NUMBERS.fullmatch(best.type):
        typed += f' --set "joints=[{",".join(joints or fields[: len(wheels)])}]"'
    return f"; are the wheels in {typed}? {best.type} holds {some(numbers[best], 24)}"


def pose_topics(bag: Bag, options: RosbagOptions, wheels: Topic, *, others: bool) -> list[Topic]:
    """The topic of the reference poses: the one named, the only one, or the only one that ends in slam_pose.

    Odometry and transforms are never taken unasked: a calibration against the robot's own odometry would find nothing
    wrong. Empty: there is none, but there are ``others``, scans or sensors.
    """
    types = (*POSE_TYPES, ODOMETRY, bags.TRANSFORMS)
    if options.pose_topic is not None and options.pose_columns:
        topic = bag.topic(options.pose_topic, "pose_topic")
        bag.require_fields(topic, options.pose_columns, "pose_columns")
        return [topic]
    if options.pose_topic is not None:
        return _named(bag, "pose_topic", [options.pose_topic], types)
    independent = [topic for topic in bag.of_type(*POSE_TYPES) if not _OWN_POSES.search(topic.name.lower())]
    topics = _only(bag, "pose_topic", independent, "slam_pose", wheels)
    if topics or others:
        return topics
    if doubtful := [topic for topic in bag.of_type(*types) if not topic.name.endswith("tf_static")]:
        own = "by name or type the robot's own odometry; if one is independent of the wheels, set pose_topic to it"
        raise ConfigError(f"{bag.path}: the only poses are {_listed(doubtful)}, {own}, or record {_REFERENCES}")
    way = "poses in other messages: --set pose_topic=NAME --set pose_columns=[X,Y,HEADING]"
    what = f"no messages of type {' or '.join(POSE_TYPES)}, nor another reference ({_REFERENCES})"
    raise DataError(f"{bag.path}: {what}; topics found: {_listed(bag.topics)}; {way}")


def _named(bag: Bag, key: str, names: Sequence[str], types: Sequence[str]) -> list[Topic]:
    """The topics that an option names. ConfigError: one of them is not of these types."""
    topics = [bag.topic(name, key) for name in names]
    for topic in topics:
        if topic.type not in types:
            fields = ", ".join(bag.fields(topic.type)) or "what .msg files define (message_definitions)"
            way = f", or --set pose_columns=[X,Y,HEADING] or [POSE] of {fields}" if key == "pose_topic" else ""
            what = f"{topic.name} is {topic.type}, expected {' or '.join(types)}{way}"
            raise ConfigError(f"{bag.path}: {key}: {what}; found: {_listed(bag.of_type(*types))}")
    return topics


def _only(bag: Bag, key: str, topics: Sequence[Topic], ending: str = "", wheels: Topic | None = None) -> list[Topic]:
    """The only one of some topics, or the only one with an ending, among these the one in the wheels' namespace.

    Empty: there are none. ConfigError: there are several, one of which the option ``key`` is to name.
    """
    ended = [topic for topic in topics if topic.name.endswith(ending)]
    beside = [topic for topic in ended if wheels is not None and topic.namespace == wheels.namespace]
    choice = next((choice for choice in (beside, topics, ended) if len(choice) == 1), ())
    if topics and not choice:
        raise ConfigError(f"{bag.path}: several topics could be the {key}; --set {key}=NAME, one of: {_listed(topics)}")
    return list(choice)


def _listed(topics: Sequence[Topic]) -> str:
    return ", ".join(map(str, topics)) or "none"


def read_bag(path: Path, name: str, options: RosbagOptions, notes: Notes) -> Recording:
    """The recording of a bag; what is left out is added to ``notes``. DataError, ConfigError."""
    with bags.open_bag(path, notes, options.recorded_stamps, [*map(Path, options.message_definitions)]) as bag:
        topics = wheel_topics(bag, options)
        steering: list[Topic] = []
        if options.robot.drive.steered:
            steering = [bag.topic(name, "steering_topic") for name in options.steering_topic] or topics
            if len(topics) > 1 and not options.steering_topic:
                raise ConfigError(f"{path}: every wheel has its own topic; --set steering_topic=[...], too")
        scans: list[Topic] = []
        if options.scans:
            scans = _named(bag, "scan_topic", [options.scan_topic] if options.scan_topic else [], (bags.SCAN,))
            scans = scans or _only(bag, "scan_topic", bag.of_type(bags.SCAN), "/scan", topics[0])
        others = bool(scans or options.references or bag.of_type(bags.FIX, bags.IMU))
        references = pose_topics(bag, options, topics[0], others=others)
        # Sensors count where they are named, or where nothing else tells how the robot moved.
        sensors = _named(bag, "references", options.references, (bags.FIX, bags.IMU))
        if not (references or scans or sensors):
            sensors = [topic for kind in (bags.FIX, bags.IMU) for topic in _only(bag, "references", bag.of_type(kind))]
        twists = [topic for topic in bag.of_type(*_TWISTS) if topic.name.endswith("cmd_vel")]
        beside = [topic for topic in twists if topic.namespace == topics[0].namespace]
        sent = next((each[0] for each in (twists, beside) if len(each) == 1), None)
        cutting = bag.topic(options.cut_topic, "cut_topic") if options.cut_topic else None
        wheels = read_wheels(bag, topics, steering, options)
        readings = [read_sensor(bag, topic, options) for topic in sensors]
        try:
            seen = bags.read_scans(bag, scans[0], options.scanner_mount) if scans else None
        except (ConfigError, DataError) as error:
            raise DataError(f"{error}; scans=false leaves the scans out") from None
        place, sensed = f"{path}: topic {topics[0].name}", BagSensors(readings, options) if readings else None
        poses = read_poses(bag, references[0], options) if references else None
        # Messages at which runs begin, with the text of a String as the command.
        texts, begins = cutting and cutting.type == "std_msgs/msg/String", bag.timed(cutting) if cutting else ()
        shown = [(time, str(message.data if texts and message else "")) for time, message in begins]
        events = tuple(Event(time, one_line(text) or None) for time, text in shown)
        said = RunAttributes(sent=_sent_twists(bag, sent) if sent else None)
        return Recording(name, place, wheels, poses, None, events, said, seen, sensed, numbered=True)


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


def read_sensor(bag: Bag, topic: Topic, options: SensorOptions) -> SensorReadings:
    """The readings of a topic. DataError: how exact they are is not known."""
    fields = _FIX if topic.type == bags.FIX else _IMU
    messages = TopicMessages(bag, topic, bags.reader_of(fields))
    table = messages.table(len(fields))
    kind: ReferenceKind = "position" if topic.type == bags.FIX else "heading"
    option, sigma, way = "fix_sigma", options.fix_sigma, "m: --set fix_sigma=1.5"
    if kind == "position":
        messages.keep(table[:, 0] >= 0, "without a fix (status -1)")
        messages.keep(bags.possible(table[:, 1:3] / (90, 360), _ON_EARTH), "without latitude and longitude")
        values, variances = table[:, 1:3], np.where(table[:, 4:5] == _UNKNOWN, np.nan, table[:, 5:])
    elif options.imu == "gyro" or not len(table) or (table[:, 5] == -1).any():
        kind, values, variances = "turn", table[:, 4:5], np.ones((len(table), 1))
        messages.keep(bags.possible(values, _FASTEST), "without a rate of turn")
    else:
        option, sigma = "heading_sigma_deg", options.heading_sigma_deg and math.radians(options.heading_sigma_deg)
        way = "degrees: --set heading_sigma_deg=2, or take its rates of turn: --set imu=gyro"
        values, variances = messages.keep_planar(table[:, :4])[:, None], table[:, 6:]
    variances = np.full_like(variances, sigma**2) if sigma else variances
    exact: NDArray[np.bool_] = np.asarray((np.isfinite(variances) & (variances > 0)).all(axis=1))
    if len(messages.rows) and not exact[messages.rows].any():
        raise DataError(f"{messages.place}: its {kind}s have no covariance; say their standard deviation in {way}")
    messages.keep(exact, f"without a covariance (set {option})")
    rows = messages.in_order()
    values, sigmas = values[rows], np.sqrt(variances[rows])
    if kind == "position":
        altitude, (latitude, longitude) = float(table[rows[0], 3]), values[0].tolist()
        height = altitude if abs(altitude) < _HIGHEST else 0.0
        values = east_north(values[:, 0], values[:, 1], (latitude, longitude), height)
    times = bag.seconds(messages.stamps[rows], topic)
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
                resting = np.zeros(len(sensor.times), dtype=bool)
                for begin, end in rests:
                    resting |= (sensor.times >= begin) & (sensor.times <= end)
                offset = math.radians(self.options.gyro_offset_deg or 0.0)
                if resting.any():
                    rested = float(resting.sum() * np.median(np.diff(sensor.times)))
                    offset = math.radians(self.options.gyro_noise_deg) / math.sqrt(rested)
                    sensor = replace(sensor, values=sensor.values - sensor.values[resting].mean())
                elif not offset:
                    way = "let it stand some seconds, or give a standard deviation (deg/s), --set gyro_offset_deg=0.5"
                    raise DataError(f"{place}: the robot never rests, so that nothing tells the gyro's offset; {way}")
                offsets.append(offset)
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
        gaps = np.flatnonzero(np.diff(times) > _GYRO_GAP)
        return [
            Reference("turn", angle, sigma, t1, t0)
            for angle, t0, t1 in zip(turned.tolist(), edges[:-1].tolist(), edges[1:].tolist(), strict=True)
            if not ((times[gaps] < t1) & (times[gaps + 1] > t0)).any()
        ]


@dataclass(frozen=True, eq=False)
class _Joints:
    """Messages of some joints. stamps, logged (F,): ns. values (F, n), in ``unit``. names: of the joints."""

    stamps: Stamps
    logged: Stamps
    values: Array
    unit: str
    names: tuple[str, ...]

    @property
    def longest_gap(self) -> float:
        """The longest time, s, between messages of a robot that drives."""
        return max(_LONGEST_GAP, _LONGEST_GAP_PERIODS * float(np.median(np.diff(self.stamps))) / bags.SECOND)

    def covers(self, stamps: Stamps) -> NDArray[np.bool_]:
        """True for stamps (F,) at which there is a message, or one before and one after without a gap."""
        after, last = np.searchsorted(self.stamps, stamps), len(self.stamps) - 1
        before = np.searchsorted(self.stamps, stamps, side="right") - 1
        spans = self.stamps[np.minimum(after, last)] - self.stamps[before]
        return np.asarray((before >= 0) & (after <= last) & (spans <= self.longest_gap * bags.SECOND))


def read_wheels(bag: Bag, wheels: Sequence[Topic], steering: Sequence[Topic], options: RosbagOptions) -> WheelReadings:
    """Wheels and steering angles in the robot's order; the bag gets the clock of their messages.

    Where they come by several topics, the messages of the others that are nearest to those of the first count, with the
    times that they have; where the others have gaps, messages of the first are left out. DataError, ConfigError.
    """
    streams: list[list[_Joints]] = []
    for steers, topics, names, asked in (
        (False, wheels, options.robot.wheel_names, options.joints),
        (True, steering, options.robot.drive.steered, options.steering_joints),
    ):
        choices = [JointChoice((wheel,), asked[row : row + 1], steers, True) for row, wheel in enumerate(names)]
        if len(topics) == 1:
            choices = [JointChoice(names, asked, steers, only=set(wheels).isdisjoint(steering))]
        streams.append([read_joints(bag, *pair, options) for pair in zip(topics, choices, strict=True)])
    turning, steered = streams
    first, several = turning[0], len(turning + steered) > 1
    if len({stream.unit for stream in turning}) > 1:
        raise DataError(f"{bag.path}: some wheel topics hold positions and some velocities; --set use=velocities")
    covered = np.logical_and.reduce([stream.covers(first.stamps) for stream in turning + steered])
    if covered.sum() < 2:
        shown = ", ".join(topic.name for topic in dict.fromkeys((*wheels, *steering)))
        way = "all must be stamped by one clock, or be named in recorded_stamps"
        raise DataError(f"{bag.path}: topics {shown} hold no messages of one time; {way}")
    bag.clock_topic, bag.clock_stamps, bag.clock_logged = wheels[0].name, first.stamps[covered], first.logged[covered]
    times, values, read_at = bag.seconds(bag.clock_stamps), [], []
    for stream in turning + steered:
        stamps, numbers = bag.seconds(stream.stamps), stream.values
        if several and stream.unit.endswith("/sample"):  # there may be several between two messages of the first
            numbers = np.cumsum(numbers, axis=0)
        nearest = np.searchsorted((stamps[1:] + stamps[:-1]) / 2, times)
        values.append(numbers[nearest])
        read_at.append(np.tile(stamps[nearest][:, None], len(stream.names)))
    unit = first.unit.removesuffix("/sample") if several else first.unit
    counted, angles = np.hstack(values[: len(turning)]), np.hstack(values[len(turning) :]) if steered else None
    columns, axles = (tuple(chain(*(stream.names for stream in part))) for part in streams)
    gap, read = first.longest_gap, np.hstack(read_at) if several else None
    return WheelReadings(times, counted, unit, angles, columns, axles, longest_gap=gap, read_at=read)


def read_joints(bag: Bag, topic: Topic, choice: JointChoice, options: RosbagOptions) -> _Joints:
    """The joints of some wheels that come by one topic. DataError, ConfigError."""
    role, unit = ("steering", options.steering_unit) if choice.steering else ("wheel", str(options.wheel_unit))
    key, whose = ("steering_joints", "joint that steers") if choice.steering else ("joints", "wheel")
    quantity, use = ("positions", "positions") if choice.steering else (options.quantity, options.use)
    paths, fields = choice.asked, None
    numbers = _NUMBERS.fullmatch(topic.type) and all(path.isdecimal() for path in paths)
    if topic.type != JOINT_STATE and not numbers:
        if not paths:
            way = wheels_typed(bag, choice.wheels, [topic])
            raise ConfigError(f"{bag.path}: {role}_topic: {topic.name} is {topic.type}, expected {JOINT_STATE}{way}")
        bag.require_fields(topic, paths, key)
        fields, choice = bags.reader_of(paths), replace(choice, asked=())
    places: dict[tuple[str, ...], tuple[int, ...] | None] = {}

    def read(message: Any) -> Array | None:
        """Positions and velocities (2, n) of the joints, NaN where there are none; None of a message of others."""
        if topic.type == JOINT_STATE:
            names, values = tuple(message.name), [message.position, message.velocity]
        else:
            shown = np.ravel(np.asarray(fields(message) if fields else message.data, dtype=float))
            names, values = tuple(map(str, range(len(shown)))), [[], shown] if quantity == "rates" else [shown, []]
        if names not in places:
            places[names] = choice.places(names)
        if (chosen := places[names]) is None:
            return None
        missing = [np.nan] * len(names)
        return np.array([row if len(row) == len(names) else missing for row in values], dtype=float)[:, list(chosen)]

    messages, joints = TopicMessages(bag, topic, read), list(dict.fromkeys(chain(*places)))
    if places and not any(places.values()):
        raise choice.not_found(messages.place, joints)
    count = len(choice.wheels)
    positions, velocities = messages.table(2 * count).reshape(-1, 2, count).swapaxes(0, 1)
    counted, measured = bags.possible(positions, _LARGEST_COUNT), bags.possible(velocities, _LARGEST_COUNT)
    take_positions = quantity == "increments" or (quantity == "positions" and use == "positions")
    if quantity == "positions" and use == "auto":
        # Positions that tell what velocities do, and are not zeros that a driver fills in.
        stands = bool((positions[counted] == positions[counted][:1]).all())
        filled_in = stands and measured.any() and bool(velocities[measured].any())
        take_positions = measured.sum() <= 2 * counted.sum() and not filled_in
    values, good, kind = (positions, counted, "position") if take_positions else (velocities, measured, "velocity")
    messages.keep(good, f"without a finite {kind} of every {whose}")
    way = f"set {key} or {role}_topic to those that are measured (joints found: {', '.join(joints)})"
    rows = messages.in_order(way if options.use == "auto" else f"leave use={options.use} out, or {way}")
    names = paths or next(tuple(names[place] for place in chosen) for names, chosen in places.items() if chosen)
    unit = f"{unit}/s" if quantity == "positions" and not take_positions else unit
    return _Joints(messages.stamps[rows], messages.logged[rows], values[rows], unit, names)


def read_poses(bag: Bag, topic: Topic, options: RosbagOptions) -> PoseReadings:
    """The poses of a topic. DataError, ConfigError."""
    covariances, columns = None, options.pose_columns
    if topic.type == bags.TRANSFORMS and not columns:
        stamps, poses = _by_transforms(bag, topic, options.pose_frames)
    else:
        paths = list(columns) if len(columns) == 3 else _pose_paths(bag, topic, columns)
        messages = TopicMessages(bag, topic, bags.reader_of(paths))
        table = messages.table(len(paths))
        rows, poses = _planar(messages, table[:, :6])
        stamps = messages.stamps[rows]
        # Covariances (K, 3, 3): unless ``pose_sigma`` says one, a pose's that is unknown lets none count.
        stated = len(paths) > 6
        covariances = table[rows, 6:].reshape(-1, 3, 3) if stated else np.zeros((len(rows), 3, 3))
        usable = usable_covariances(covariances)
        unknown = f"{messages.place}: {(~usable).sum():,} of {plural(len(rows), 'pose')} have no usable covariance"
        if not usable.all() and options.pose_sigma is not None:
            metres, degrees = options.pose_sigma
            bag.notes.append(f"{unknown}: {metres:g} m and {degrees:g} deg count for them (pose_sigma)")
            covariances[~usable] = pose_covariance(metres, degrees)
        elif not usable.all():
            covariances = None
            if stated:
                bag.notes.append(f"{unknown}, so that poses have none; set pose_sigma=[m,deg] to give them")
    apart = options.clocks == "match" or options.pose_time_offset
    times = bag.seconds(stamps, None if apart else topic)
    return PoseReadings(times, poses, covariances, len(columns) < 3, "" if topic.type in POSE_TYPES else topic.name)


def _pose_paths(bag: Bag, topic: Topic, columns: Sequence[str]) -> list[str]:
    """Paths of x, y and the quaternion of the pose in a message, or at a path in it, and of its covariance if any."""
    fields, within = bag.fields(topic.type), "".join(f"{column}." for column in columns)
    pose = next((path for path, kind in fields.items() if kind in _POSES and f"{path}.".startswith(within)), None)
    if pose is None:
        raise ConfigError(f"{bag.path}: pose_columns: {within[:-1]} of {topic.name} ({topic.type}) is no geometry pose")
    holder = pose.rpartition(".")[0]
    covariance = _COVARIANCE if f"{holder}.covariance.0" in fields else []
    return [*_pose_parts(fields[pose], pose), *(f"{holder}.{part}" for part in covariance)]


def _pose_parts(kind: str, path: str) -> list[str]:
    """Paths of x, y and the quaternion of a pose of some type at a path."""
    place, turn = _POSES[kind]
    return [f"{path}.{place}.{axis}" for axis in "xy"] + [f"{path}.{turn}.{axis}" for axis in "xyzw"]


def _planar(messages: TopicMessages, table: Array) -> tuple[NDArray[np.intp], Array]:
    """Rows of x, y and heading (K, 3), or of x, y and a quaternion (K, 6), on the floor, and their poses (n, 3)."""
    messages.keep(bags.possible(table[:, :2]), "without a finite position")
    headings = messages.keep_planar(table[:, 2:]) if table.shape[1] > 3 else table[:, 2]
    messages.keep(bags.possible(headings[:, None]), "without a finite heading")
    rows = messages.in_order()
    return rows, np.column_stack([table[:, :2], headings])[rows]


def _by_transforms(bag: Bag, topic: Topic, frames: Sequence[str]) -> tuple[Stamps, Array]:
    """Stamps and poses (K, 3) of the second of two frames in the first, when the rarest transform between them comes.

    Transforms between are composed in the plane. ConfigError: no frames are given, nothing leads from one to the other,
    or nothing moves on the way.
    """
    fixed, place = bag.fixed_transforms(), f"{bag.path}: topic {topic.name}"
    parents = {child: parent for child, parent, _ in bag.transforms(topic)}
    parents |= {child: parent for child, (parent, _) in fixed.items()}
    found = f"found: {', '.join(f'{parent} > {child}' for child, parent in parents.items()) or 'none'}"
    if not frames:
        raise ConfigError(f"{place}: set pose_frames=[world, robot] to the frames of the reference; {found}")
    world, child = (frame.strip("/") for frame in frames)
    links = bags.way_up(child, parents, lambda frame: frame == world)
    if links is None:
        known = {*parents, *parents.values()}
        hint = nearest(child, known) if child not in known else ""
        raise ConfigError(f"{place}: pose_frames: no transforms lead from {world} to {frames[1]}; {hint}{found}")
    if fixed.keys() >= set(links):
        raise ConfigError(f"{place}: pose_frames: {frames[1]} does not move in {world}; {found}")
    read, streams = bags.reader_of(_pose_parts("geometry_msgs/msg/Transform", "transform")), {}
    for link in [link for link in links if link not in fixed]:

        def placed(message: Any, link: str = link) -> list[Any]:
            return [part for part in message.transforms if part.child_frame_id.strip("/") == link]

        messages = TopicMessages(bag, topic, read, placed)
        rows, poses = _planar(messages, messages.table(6))
        streams[link] = messages.stamps[rows], np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])])
    stamps = min((stamps for stamps, _ in streams.values()), key=len)
    begin, end = max(stamps[0] for stamps, _ in streams.values()), min(stamps[-1] for stamps, _ in streams.values())
    stamps = stamps[(stamps >= begin) & (stamps <= end)]
    whole: Array = np.zeros((len(stamps), 3))
    for link in reversed(links):
        if link in streams:
            times, poses = streams[link]
            step = interpolated((stamps - times[0]) / bags.SECOND, (times - times[0]) / bags.SECOND, poses)
        else:
            matrix = fixed[link][1]
            step = np.broadcast_to([*matrix[:2, 3], np.arctan2(matrix[1, 0], matrix[0, 0])], whole.shape)
        whole = compose(whole, step)
    return stamps, whole


def _sent_twists(bag: Bag, topic: Topic) -> Array | None:
    """The twists that were sent (C, 5), each valid until another one came; None without any."""
    read = bags.reader_of(("linear.x", "linear.y", "angular.z"))
    messages = [(time, message) for time, message in bag.timed(topic) if message]
    table = np.array([(time, *read(getattr(message, "twist", message))) for time, message in messages]).reshape(-1, 4)
    times, x, y, turn = table[np.isfinite(table).all(axis=1)].T
    twists = np.column_stack([times, np.hypot(x, y), np.arctan2(y, x), turn])
    twists = twists[np.diff(twists[:, 1:], axis=0, prepend=np.inf).any(axis=1)]  # of equal ones the first
    if not len(twists):
        return None
    end = max(float(bag.seconds(bag.clock_stamps[-1:])[0]), twists[-1, 0])
    return np.column_stack([twists, np.diff(twists[:, 0], append=end)])


@importers.register("rosbag")
class Rosbag(Importer):
    """ROS recordings: MCAP, rosbag2 (sqlite3 and mcap) and ROS 1, with wheels and reference poses or laser scans.

    The source is a bag, or a folder of bags; ``robot`` (a YAML file or a mapping) is the only option that must be
    given. Wheels are a sensor_msgs/JointState, poses a geometry_msgs/PoseWithCovarianceStamped, PoseStamped or
    TransformStamped. A bag with several of them lists them, and ``wheel_topic`` and ``pose_topic`` choose. Joints are
    those called like the wheels (``a``, ``wheel_a``, ``a_wheel_joint``), or ``joints`` names them in the robot's order;
    those that steer have "steer" in their names, too, or ``steering_joints`` names them. ``wheel_signs: [-1, 1, 1]``
    turns a wheel round; the sense of a positive rate is in ``omnibench guide conventions``.

    Other messages: a named topic may hold std_msgs numbers, of all wheels in an array, or any other type, of which
    ``joints: [left_encoder, right_encoder]`` are fields, or paths such as ``status.wheels.0.angle``. Each wheel may
    have its own topic, ``wheel_topic: [/left, /right]`` (``joints: [data, data]``); these are interpolated at the
    stamps of the first, as steering angles of another topic are. Poses are at paths, too: ``pose_columns: [pose.x,
    pose.y, pose.theta]``, or ``[state.pose]`` of any geometry pose. Bags before ROS 2 Iron do not say what is in such
    messages; ``message_definitions`` names their .msg files. A nav_msgs/Odometry or a tf (``pose_frames: [world,
    robot]``) is a reference only when named, and refused where it is made of the wheels.

    references: a sensor_msgs/NavSatFix gives positions, east and north of its first fix, an Imu headings (orientation)
    or turned angles (its rates about z, without their mean at rest), one each ``reference_period``. They are taken
    where a bag has neither poses nor scans, or where ``references`` names them.

    scans: those of a sensor_msgs/LaserScan (``scan_topic``; ``scans: false`` leaves them out) go into the data set.
    Where the scanner is mounted comes from /tf_static or from ``scanner_mount: {x, y, yaw}`` (m, rad). A bag with scans
    and without reference poses (odometry does not count as one) gets them from its scans by SLAM, with the options in
    ``slam``; each run then begins at (0, 0, 0).

    times: the stamps of the headers, of all topics by one clock; when a message was recorded matters for the topics in
    ``recorded_stamps`` only. Messages recorded late are sorted; those without a stamp, with a stamp that was there or
    with values that are not finite are left out, and warnings say how many. Messages without a header have the times of
    recording. Positions are preferred: their differences are exact however many samples were lost. Velocities count as
    the mean since the message before. Covariances of poses that mean "unknown" (0, negative, NaN, huge) are left out.

    cut: at ``rests`` (each run keeps a little of the rest at both ends, and begins and ends at a reference pose there);
    by a ``topic`` (a message of ``cut_topic`` begins a run, and a String says which command is driven); in ``windows``
    of ``window`` s; or ``none``. Where samples are missing while the wheels turn, or the positions begin anew, a run
    ends in any case, and another session begins. Poses are as recorded; t = 0 is a run's first pose. The command of a
    run between rests is the twist that was sent most of the time on a topic that ends in cmd_vel (``v0.3_w0.6``).

    Splits: ``train`` and ``validation`` are patterns of run names (``00*``, ``*-forward``); with one of them all other
    runs go to the other side, with both the runs in neither are left out, with none every second run of a command
    validates. A run is called by its number, before it the bag (``day1/003``) if there are several, and after it the
    command of ``cut_topic`` (``003-forward``) if there is one.
    """

    Options = RosbagOptions
    options: RosbagOptions

    def read(self, source: Path) -> Dataset:
        """All bags at or below ``source``; DataError names the bag, the topic and the message of what is wrong."""
        notes = list[str]()
        recordings = self.recordings(source, notes)
        dataset = dataset_of(recordings, self.options, notes)
        doubtful = sorted({each.poses.doubtful for each in recordings if each.poses and each.poses.doubtful})
        if doubtful and (residual := follows_the_wheels(dataset.trajectories)) is not None:
            own = f"some matrix makes its headings of the wheels to {residual:.1g} rad a second, and no error can show"
            way = "--set pose_topic=NAME of an independent reference (motion capture, SLAM), or record one"
            raise DataError(f"{source}: {', '.join(doubtful)} is the robot's own odometry: {own}; {way}")
        return dataset

    def recordings(self, source: Path, notes: Notes) -> list[Recording]:
        """The bags at or below ``source`` as they were recorded."""
        recordings = [read_bag(path, name, self.options, notes) for name, path in bags.find_bags(source).items()]
        bare = [recording.place for recording in recordings if not recording.referenced]
        if 0 < len(bare) < len(recordings):
            what = "no topic holds reference poses, as it does in other bags"
            raise DataError(f"{bare[0]}: {what}; import the bags without reference poses apart")
        return recordings
