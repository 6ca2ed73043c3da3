"""Config of a node: its robots, fusion, topics, Zenoh session, recording and replay."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag, ValidationInfo, field_validator, model_validator

from omnibench.config import Model, Positive, RelativePath, read_model, read_yaml, validate
from omnibench.errors import ConfigError, require_choice
from omnibench.live.drive import ReplayConfig
from omnibench.live.fusion import FusionSettings
from omnibench.live.network import SessionConfig
from omnibench.live.topics import Frames, Profile
from omnibench.live.wheels import WheelSettings

# The form of a choice, a name or settings, so that a mistake in one is not explained as one in the other.
_Form = Discriminator(lambda value: "settings" if isinstance(value, Mapping | Model) else "name")
FusionChoice = Annotated[
    Annotated[Literal["none", "ekf"], Tag("name")] | Annotated[FusionSettings, Tag("settings")], _Form
]
FramesChoice = Annotated[Annotated[Literal["prefixed"], Tag("name")] | Annotated[Frames, Tag("settings")], _Form]


class RobotConfig(Model):
    """One robot of a node."""

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,199}$", description="begins its topics: <name>/odom")
    calibration: RelativePath = Field(description="calibration file")
    wheels: WheelSettings = WheelSettings()
    fusion: FusionChoice | None = Field(None, description="default: the node's")
    frames: FramesChoice | None = Field(
        None,
        description="default: map, odom, base_link (REP-105); of several robots in a node map, <name>/odom, "
        "<name>/base_link. All robots of a network share tf: prefixed gives a single robot such names too, as robots "
        "of several nodes need them",
    )


class ReplaySource(ReplayConfig):
    """Recording that ``--replay`` plays unless another one is named, and how it is played."""

    dataset: RelativePath | None = Field(
        None, description="a data set folder, or a comparison's config with a simulated one"
    )
    robot: str | None = Field(None, description="whose messages are played; default: the first robot")


class LiveConfig(Model):
    """A node."""

    name: str = Field(
        "omnibench", pattern=r"^[A-Za-z][A-Za-z0-9_]{0,199}$", description="the node's name in the ROS graph"
    )
    description: str = ""
    robots: tuple[RobotConfig, ...] = Field((), description="may be empty for a router")
    fusion: FusionChoice = Field("none", description="of SLAM poses: none, ekf, or its settings")
    guard: bool | Literal["swap"] = Field(
        True,
        description="on: watch for changes of the robot where poses are fused; swap: drive with the accepted ones, "
        "until they turn out worse",
    )
    stale_after: Positive = Field(0.5, description="no wheel sample for so long makes the health stale, s")
    profile: Profile = Field("plain", description="plain: plain Zenoh and the DDS bridge; rmw, humble: rmw_zenoh")
    domain: int = Field(0, ge=0, le=232, description="ROS_DOMAIN_ID, for rmw and humble")
    zenoh: SessionConfig = SessionConfig()
    plugins: tuple[RelativePath, ...] = Field((), description="folders of effects that calibrations name")
    state: RelativePath | None = Field(None, description="folder in which pose and calibration outlive the node")
    record: RelativePath | None = Field(None, description="MCAP file to record to")
    foxglove: bool | int = Field(False, description="serve Foxglove's WebSocket on loopback; a number is the port")
    rerun: bool | RelativePath = Field(False, description="show in Rerun's viewer (true), or record for it (FILE.rrd)")
    replay: ReplaySource = ReplaySource()

    @field_validator("record", "rerun")
    @classmethod
    def _has_suffix(cls, file: Path | bool | None, info: ValidationInfo) -> Path | bool | None:
        suffix = ".mcap" if info.field_name == "record" else ".rrd"
        if isinstance(file, Path) and file.suffix != suffix:
            raise ValueError(f"{str(file)!r}: name a file that ends in {suffix}")
        return file

    @model_validator(mode="after")
    def _robots_differ(self) -> LiveConfig:
        names = [robot.name for robot in self.robots]
        if len(set(names)) < len(names):
            raise ValueError(f"robots: names must differ: {', '.join(names)}")
        if not names and self.zenoh.mode != "router":
            raise ValueError(
                "robots: none is given; without robots a node can only be a router (zenoh: {mode: router})"
            )
        return self

    def fusion_of(self, robot: RobotConfig) -> FusionSettings | None:
        """Settings with which a robot's SLAM poses are fused; None: they are not."""
        chosen = self.fusion if robot.fusion is None else robot.fusion
        if isinstance(chosen, FusionSettings):
            return chosen
        return FusionSettings() if chosen == "ekf" else None

    def frames_of(self, robot: RobotConfig) -> Frames:
        """A robot's frames; those of several robots carry the robots' names, because all share tf."""
        if isinstance(robot.frames, Frames):
            return robot.frames
        if robot.frames is None and len(self.robots) == 1:
            return Frames()
        return Frames(odom=f"{robot.name}/odom", base=f"{robot.name}/base_link")

    def on_common_frames(self) -> list[str]:
        """Robots that publish tf between frames of the default names, which another node's robot may have too."""
        common, fusing = Frames(), (robot for robot in self.robots if self.fusion_of(robot) is not None)
        framed = ((robot.name, self.frames_of(robot)) for robot in fusing)
        return [name for name, frames in framed if frames.odom == common.odom or frames.base == common.base]


def read_live_config(path: Path | str) -> LiveConfig:
    """Read a node's config; paths in it start from its folder. ConfigError in one line."""
    return read_model(LiveConfig, Path(path))


class ClientConfig(Model):
    """Config of a program that reaches a node, as ``--config`` of listen, replay and record takes it."""

    zenoh: SessionConfig = SessionConfig(mode="client")
    profile: Profile = "plain"
    domain: int = Field(0, ge=0, le=232)


def read_client_config(path: Path | str) -> ClientConfig:
    """Read a client's config, or make it from the node's own. ConfigError in one line."""
    path = Path(path)
    content = read_yaml(path)
    if isinstance(content, dict) and "robots" in content:
        node = read_live_config(path)
        return ClientConfig(zenoh=client_session(node.zenoh), profile=node.profile, domain=node.domain)
    return validate(ClientConfig, content, str(path), path.resolve().parent)


def client_session(node: SessionConfig) -> SessionConfig:
    """Session settings of a client on the node's machine, with the node's user and keys."""
    if node.mode == "client":
        return node
    local = [address.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:") for address in node.listening]
    return SessionConfig(mode="client", connect=tuple(local) or node.connecting, user=node.user, tls=node.tls)


def robot_called(config: LiveConfig, name: str | None) -> RobotConfig:
    """The robot of that name, or the first one. UnknownNameError, or ConfigError when there is none."""
    robots = {robot.name: robot for robot in config.robots}
    if not robots:
        raise ConfigError("the config has no robot")
    if name is not None:
        require_choice("robot", name, robots)
    return robots[name or next(iter(robots))]
