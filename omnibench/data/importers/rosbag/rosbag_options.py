"""Options of the importer of ROS recordings."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field, model_validator

from omnibench.config import NonNegative, Positive
from omnibench.data.importers.wheel_samples import EncoderOptions, Signs, WheelUnit
from omnibench.data.scans import Mount
from omnibench.data.splits import Names
from omnibench.words import plural

Use = Literal["auto", "positions", "velocities"]


class RosbagOptions(EncoderOptions):
    """The robot, topics and joints, how the recording is cut into runs, and which of these train and validate."""

    group: ClassVar[str] = "Topics, joints and cuts"

    name: str = Field("rosbag", min_length=1, description="name of the data set")
    wheel_unit: WheelUnit = Field(
        "rad",
        description="of positions and (per second) velocities: rad, deg, rev, ticks; rpm; or increments rad/sample",
    )
    wheel_topic: Names = Field(
        (),
        description="sensor_msgs/JointState or std_msgs numbers, of all wheels or a list of one each; default: the "
        "only JointState, or the one ending in joint_states",
    )
    steering_topic: Names = Field((), description="of all steering angles, or a list of one each; default: the wheels'")
    pose_topic: str | None = Field(
        None,
        min_length=1,
        description="PoseWithCovarianceStamped, PoseStamped or TransformStamped, default: the only one, or the one "
        "ending in slam_pose; or, if independent of the wheels, Odometry or tf",
    )
    pose_frames: Names = Field((), description="with a tf pose_topic: frame of the reference, and the tracked one")
    pose_sigma: tuple[Positive, Positive] | None = Field(
        None,
        description="m and deg, standard deviations of poses whose covariance is unknown (0, negative, NaN, huge); "
        "default: if one is, no pose's counts",
    )
    references: Names = Field(
        (),
        description="sensor_msgs/NavSatFix and Imu that are references, as [/fix,/imu]; default: those that there are, "
        "where there are neither poses nor scans",
    )
    imu: Literal["auto", "gyro"] = Field(
        "auto", description="gyro: its rates of turn; auto: its headings, where it tells them (orientation)"
    )
    fix_sigma: Positive | None = Field(None, description="m, standard deviation of a fix; default: its covariance's")
    heading_sigma_deg: Positive | None = Field(
        None, description="deg, standard deviation of an Imu's heading; default: its covariance's"
    )
    gyro_noise_deg: Positive = Field(
        0.1, description="deg per sqrt(s), by which the angle of a gyro wanders; its offset at rest is taken off"
    )
    gyro_offset_deg: Positive | None = Field(
        None, description="deg/s, standard deviation of a gyro's offset where the robot never rests; else by its rests"
    )
    reference_period: Positive = Field(1.0, description="s; one fix, heading or turn is taken in each")
    scan_topic: str | None = Field(
        None, min_length=1, description="sensor_msgs/LaserScan; default: the only one, or the one ending in /scan"
    )
    scans: bool = Field(True, description="false: leave the scans out")
    scanner_mount: Mount | None = Field(
        None,
        description="x, y (m), yaw (rad) of the scanner on the robot; default: by /tf_static, else the robot's middle",
    )
    slam: dict[str, Any] = Field(
        {}, description="options of omnibench slam, for bags whose reference poses are made from their scans"
    )
    joints: Names = Field(
        (),
        description="in the robot's wheel order, or numbers of elements from 0; default: those called like the wheels",
    )
    joint_signs: Signs = Field((), description="-1 for joints that count the other way round")
    steering_joints: Names = Field((), description="in the order of the wheels that steer; default: by their names")
    recorded_stamps: Names = Field(
        (), description="topics whose header stamps are missing or by another clock: the times of recording count"
    )
    use: Use = Field("auto", description="positions or velocities of the joints; auto: positions, if they are there")
    cut: Literal["rests", "topic", "windows", "none"] = Field(
        "rests", description="where one run ends and another begins"
    )
    least_rest: Positive = Field(0.5, description="s; shorter rests do not cut")
    rest_rate: Positive = Field(0.05, description="rad/s; wheels that turn slower, over least_rest, rest")
    least_run: NonNegative = Field(1.0, description="s; shorter drives are left out")
    cut_topic: str | None = Field(
        None, min_length=1, description="each message begins a run; a std_msgs/String names its command"
    )
    window: Positive | None = Field(None, description="s; length of the runs of cut: windows")

    @model_validator(mode="after")
    def _fits_together(self) -> RosbagOptions:
        self.require_one_each("joints", "joint_signs", "steering_joints")
        self.require_one_each("wheel_topic", "steering_topic", or_one=True)
        if not self.scans and (self.scan_topic is not None or self.scanner_mount is not None):
            raise ValueError("scans=false leaves the scans out; leave scan_topic and scanner_mount out, too")
        if len(set(self.joints)) < len(self.joints):
            raise ValueError("joints names one joint twice; name another one for each wheel")
        if isinstance(self.wraps_at, float) and self.use == "velocities":
            raise ValueError("wraps_at is for positions; leave it out with use=velocities")
        if self.quantity == {"positions": "rates", "velocities": "increments"}.get(self.use):
            raise ValueError(f"wheel_unit {self.wheel_unit} is not one of {self.use}; leave use out")
        if len(self.pose_frames) not in (0, 2):
            raise ValueError(f"pose_frames has {plural(len(self.pose_frames), 'value')}, expected 2: [world, robot]")
        for key, cut in (("cut_topic", "topic"), ("window", "windows")):
            if (getattr(self, key) is not None) != (self.cut == cut):
                raise ValueError(f"cut={cut} and {key} belong together; give both or none")
        return self

    @property
    def signs(self) -> Signs:
        return self.joint_signs

    @property
    def still(self) -> float:
        """Largest angle, rad, by which a resting wheel moves within ``least_rest`` s."""
        return self.rest_rate * self.least_rest
