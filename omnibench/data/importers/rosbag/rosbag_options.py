"""Options of the importer of ROS recordings."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from omnibench.config import NonNegative, Positive
from omnibench.data.importers.recording_options import RecordingOptions
from omnibench.data.importers.rosbag.message_streams import Use
from omnibench.data.scans import Mount
from omnibench.data.splits import Names
from omnibench.words import plural


class RosbagOptions(RecordingOptions):
    """The robot, topics and joints, how the recording is cut into runs, and which of these train and validate."""

    name: str = Field("rosbag", min_length=1, description="name of the data set")
    wheel_topic: str | None = Field(
        None,
        min_length=1,
        description="sensor_msgs/JointState; default: the only one, or the one ending in joint_states",
    )
    pose_topic: str | None = Field(
        None,
        min_length=1,
        description="PoseWithCovarianceStamped, PoseStamped or Odometry; default: the only one, or the one ending in "
        "slam_pose",
    )
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
    joints: Names = Field((), description="in the robot's wheel order; default: those called like the wheels")
    joint_signs: tuple[Literal[1, -1], ...] = Field((), description="-1 for joints that count the other way round")
    wheel_wrap: Positive | None = Field(None, description="positions start again after this many rad")
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
        wheels = len(self.robot.wheels)
        for key in ("joints", "joint_signs"):
            given = len(getattr(self, key))
            if given not in (0, wheels):
                raise ValueError(f"{key} has {plural(given, 'value')}, expected {wheels}, one for each wheel")
        if not self.scans and (self.scan_topic is not None or self.scanner_mount is not None):
            raise ValueError("scans=false leaves the scans out; leave scan_topic and scanner_mount out, too")
        if len(set(self.joints)) < len(self.joints):
            raise ValueError("joints names one joint twice; name another one for each wheel")
        if self.wheel_wrap is not None and self.use == "velocities":
            raise ValueError("wheel_wrap is for positions; leave it out with use=velocities")
        for key, cut in (("cut_topic", "topic"), ("window", "windows")):
            if (getattr(self, key) is not None) != (self.cut == cut):
                raise ValueError(f"cut={cut} and {key} belong together; give both or none")
        return self

    @property
    def still(self) -> float:
        """Largest angle, rad, by which a resting wheel moves within ``least_rest`` s."""
        return self.rest_rate * self.least_rest
