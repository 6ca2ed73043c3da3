"""Robots' topics shown while they drive: a server for the Foxglove application with a layout for it, and Rerun."""

from __future__ import annotations

import errno
import json
import math
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from string import Template
from threading import Thread
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import zenoh

from omnibench.errors import ConfigError, DataError
from omnibench.live.fusion import innovation_of
from omnibench.live.odometry import RobotCentre
from omnibench.live.record import QueuedListener
from omnibench.live.stopping import Closing, wait_until
from omnibench.live.topics import TOPICS, Arrival, KeySpace, TopicListener
from omnibench.live.wire import DIAGNOSTICS, ODOMETRY, POSE_ESTIMATE, Diagnostics, MessageError, Odometry, PoseEstimate
from omnibench.robot.kinematics import Array, Mount, compose, correction

if TYPE_CHECKING:
    from foxglove import Channel

    from omnibench.live.config import LiveConfig

PORT: Final = 8765  # the application's default
_STOPPING: Final = 5.0  # how long ``close`` waits for its port; without load it is free after some milliseconds


class FoxgloveServer(Closing):
    """Serves the topics given to ``forward`` on ``host`` and ``port`` (0: any free port), until ``close``.

    By default only programs on this machine can connect, because the protocol has no password. A client that is too
    slow loses messages and delays no other.

    ConfigError: foxglove-sdk is not installed, the port is in use, or the host is not an address of this machine.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = PORT) -> None:
        try:
            import foxglove
        except ImportError:
            raise ConfigError('the Foxglove server needs foxglove-sdk: pip install "omnibench[foxglove]"') from None
        if not 0 <= port <= 65535:
            raise ConfigError(f"Foxglove server: port {port}: expected 0 to 65535")
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(name="omnibench", host=host, port=port, context=self._context)
        except (RuntimeError, OSError) as error:
            reason = str(error).removeprefix("FoxgloveError: ")
            raise ConfigError(
                f"Foxglove server on {host}:{port}: {reason}; close what uses it or choose another host or port"
            ) from None
        self._host, self._port = host, int(self._server.port)
        self.address = f"ws://{host}:{self._port}"
        self._channels: dict[str, Channel] = {}
        self._listeners: list[TopicListener] = []

    def forward(
        self, session: zenoh.Session, keys: KeySpace, robots: Sequence[str], topics: Sequence[str] = tuple(TOPICS)
    ) -> None:
        """Serve the robots' topics from now on, payloads unchanged. ConfigError: no such topic."""
        import foxglove

        listener = TopicListener(session, keys, robots, topics, self._forward)
        for name, topic in listener.topics.items():
            kind = TOPICS[topic]
            schema = foxglove.Schema(name=kind.name, encoding="ros2msg", data=kind.definition.encode())
            self._channels[name] = foxglove.Channel(name, schema=schema, message_encoding="cdr", context=self._context)
        self._listeners.append(listener)

    @property
    def missed(self) -> int:
        """Messages that were published and never came here, so that no client got them."""
        return sum(sum(listener.missed.values()) for listener in self._listeners)

    def close(self) -> None:
        """Stop serving, and return when another server can have the port."""
        for listener in self._listeners:
            listener.close()
        self._server.stop()  # asks the server's threads to stop, and does not wait for them
        family = socket.AF_INET6 if ":" in self._host else socket.AF_INET

        def is_free() -> bool:
            try:
                socket.create_server((self._host, self._port), family=family).close()
            except OSError as error:
                return error.errno != errno.EADDRINUSE
            return True

        wait_until(is_free, _STOPPING, period=0.002)

    def _forward(self, arrival: Arrival) -> None:
        if channel := self._channels.get(arrival.name):
            channel.log(arrival.payload, log_time=arrival.time)


def foxglove_layout(config: LiveConfig) -> str:
    """A layout for the Foxglove application, which imports it from a file: JSON with a tab for each robot of a node.

    A tab shows poses with their covariances from above, the paths, the variances, SLAM's poses beside the fused ones
    (their differences are the innovations), and the diagnostics.
    """
    template = Template(Path(__file__).with_name("foxglove_layout.json").read_text(encoding="utf-8"))
    panels: dict[str, Any] = {}
    tabs = []
    for robot in config.robots:
        frames = config.frames_of(robot)
        frame = frames.odom if config.fusion_of(robot) is None else frames.map
        tab = json.loads(template.substitute(robot=robot.name, frame=json.dumps(frame)[1:-1]))
        panels |= tab["configById"]
        tabs.append({"title": robot.name, "layout": tab["layout"]})
    panels["Tab!robots"] = {"activeTabIdx": 0, "tabs": tabs}
    layout = {"configById": panels, "globalVariables": {}, "userNodes": {}, "playbackConfig": {"speed": 1}}
    return json.dumps(layout | {"layout": "Tab!robots"}, indent=1)


_PERIOD: Final = 200_000_000  # ns of the stamps between two poses that Rerun gets, each of which takes it 1 ms; chosen
_ELLIPSES: Final = 5_000_000_000  # ns between two ellipses along a path; chosen
_HISTORY: Final = 1000  # fused poses with which SLAM's can be compared, 10 s at 100 Hz; chosen
_UNKNOWN: Final = 50.0  # m: a filter that SLAM has not located yet has a standard deviation of 100 m
_CIRCLE: Final = np.linspace(0.0, 2 * np.pi, 33)  # angles of the points of an ellipse, rad
_WITHIN: Final = math.sqrt(5.991)  # standard deviations that hold 95 % in the plane (chi-square, 2 degrees of freedom)
_VIEWER_PORT: Final = 9876  # Rerun's default
_START: Final = 1.0  # s in which a viewer without a screen has failed; chosen
_LEVELS: Final = ("INFO", "WARN", "ERROR", "WARN")  # Rerun's, of the levels of DiagnosticStatus


class RerunView(Closing):
    """Shows robots in Rerun: in its viewer, which opens on this machine, or in a file (.rrd) for it.

    Paths of odom and filtered with ellipses that hold 95 % of the positions, SLAM's poses, standard deviations,
    innovations (SLAM's pose minus the fused one that was published for its stamp), health and all diagnostics, below
    each robot's name. The path of odom is laid on the fused one where that begins.

    mounts: of each robot the point whose poses SLAM tells; None: its centre. file: None for the viewer.
    ConfigError: rerun-sdk is not installed, or the viewer does not open. DataError: the file cannot be written.
    """

    def __init__(
        self, session: zenoh.Session, keys: KeySpace, mounts: Mapping[str, Mount | None], file: Path | None
    ) -> None:
        try:
            import rerun
            from rerun import blueprint
        except ImportError:
            raise ConfigError('Rerun needs rerun-sdk: pip install "omnibench[rerun]"') from None
        self._rerun, self._stream = rerun, rerun.RecordingStream("omnibench")
        if file is None:
            self._open_viewer()
        else:
            try:
                file.parent.mkdir(parents=True, exist_ok=True)
                self._stream.save(file)
            except (OSError, RuntimeError) as error:
                raise DataError(f"{file}: cannot be written: {error}; choose another folder") from None

        def view(kind: str, name: str, *places: str, **settings: Any) -> Any:
            contents = [f"/{robot}/{place}/**" for robot in mounts for place in places]
            return getattr(blueprint, kind)(name=name, contents=contents, **settings)

        edge = blueprint.TimeRangeBoundary
        past = blueprint.VisibleTimeRanges(timeline="stamp", start=edge.infinite(), end=edge.cursor_relative())
        views = blueprint.Horizontal(
            view("Spatial3DView", "paths", "odom", "filtered", "slam_pose", time_ranges=past),
            blueprint.Grid(
                view("TimeSeriesView", "standard deviation, m", "sigma/position"),
                view("TimeSeriesView", "standard deviation, deg", "sigma/heading"),
                view("TimeSeriesView", "innovation, m", "innovation/position"),
                view("TimeSeriesView", "innovation, deg", "innovation/heading"),
                view("TextDocumentView", "health", "health"),
                view("TextLogView", "diagnostics", "diagnostics"),
            ),
        )
        self._stream.send_blueprint(blueprint.Blueprint(views))
        self._stream.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._mounts = mounts
        self._shown: dict[str, int] = {}  # entity -> stamp at which it was shown last
        self._newest: dict[str, Odometry] = {}  # entity -> odometry that was shown last
        self._laid: set[str] = set()  # robots whose odom lies on the fused path
        self._fused: dict[str, deque[Odometry]] = {robot: deque(maxlen=_HISTORY) for robot in mounts}
        topics = ("odom", "odometry/filtered", "slam_pose", "diagnostics")
        self._listener = QueuedListener(session, keys, list(mounts), topics)
        self._thread = Thread(target=self._run, name="omnibench-rerun", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Show what has arrived, and complete the file; the viewer stays open."""
        self._listener.close()
        self._thread.join()
        self._stream.disconnect()

    def _open_viewer(self) -> None:
        address = "127.0.0.1"  # Rerun itself would listen on all interfaces
        command = [sys.executable, "-m", "rerun", "--bind", address, "--port", str(_VIEWER_PORT)]
        viewer = subprocess.Popen(  # in a session of its own: Ctrl-C is for the node alone
            command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        with suppress(subprocess.TimeoutExpired):  # it runs, or hands over to one that is open already
            if viewer.wait(_START):
                raise ConfigError("Rerun's viewer does not open: is there a screen? `rerun: FILE.rrd` needs none")
        self._stream.connect_grpc(f"rerun+http://{address}:{_VIEWER_PORT}/proxy")

    def _run(self) -> None:
        for arrival in self._listener:
            if arrival is None:
                continue
            robot, topic = arrival.name.split("/")[1], arrival.topic
            with suppress(MessageError, np.linalg.LinAlgError):  # who records or fuses such a message counts it
                if topic == "slam_pose":
                    self._show_pose(robot, POSE_ESTIMATE.decode(arrival.payload))
                elif topic == "diagnostics":
                    self._show_diagnostics(robot, DIAGNOSTICS.decode(arrival.payload))
                else:
                    self._show_odometry(robot, topic.rpartition("/")[2], ODOMETRY.decode(arrival.payload))

    def _is_due(self, entity: str, stamp: int, period: int) -> bool:
        """True if it was shown a period ago by the stamps, or the clock was set; what is logged then has the stamp."""
        if abs(stamp - self._shown.get(entity, -period)) < period:
            return False
        self._shown[entity] = stamp
        self._stream.set_time("stamp", timestamp=np.datetime64(stamp, "ns"))
        return True

    def _show_odometry(self, robot: str, name: str, message: Odometry) -> None:
        """Show odom or filtered."""
        rerun, log, entity = self._rerun, self._stream.log, f"{robot}/{name}"
        if name == "filtered":
            if message.position_sigma > _UNKNOWN:
                return
            self._fused[robot].append(message)
        if not self._is_due(entity, message.stamp, _PERIOD):
            return
        before = self._newest.get(entity, message)
        self._newest[entity] = message
        odom = self._newest.get(f"{robot}/odom", message)
        if robot not in self._laid and odom is not message and odom.stamp == message.stamp:
            self._laid.add(robot)
            x, y, heading = correction(message.pose, odom.pose).tolist()
            turn = rerun.RotationAxisAngle(axis=[0, 0, 1], radians=heading)
            log(f"{robot}/odom", rerun.Transform3D(translation=[x, y, 0], rotation=turn), static=True)
        log(entity, rerun.LineStrips3D([_at_floor(np.stack([before.pose, message.pose])[:, :2])]))
        log(f"{robot}/sigma/position/{name}", rerun.Scalars(message.position_sigma))
        log(f"{robot}/sigma/heading/{name}", rerun.Scalars(math.degrees(message.heading_sigma)))
        if self._is_due(f"{entity}/ellipse", message.stamp, _ELLIPSES):
            variances, axes = np.linalg.eigh(message.pose_covariance[:2, :2])
            unit = np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)], axis=-1)
            points = message.pose[:2] + _WITHIN * unit * np.sqrt(np.maximum(variances, 0.0)) @ axes.T
            log(f"{entity}/ellipse", rerun.LineStrips3D([_at_floor(points)]))

    def _show_pose(self, robot: str, message: PoseEstimate) -> None:
        rerun, log, mount = self._rerun, self._stream.log, self._mounts[robot]
        if not self._is_due(f"{robot}/slam_pose", message.stamp, _PERIOD):
            return
        pose = message.pose if mount is None else RobotCentre(mount).pose(message.pose)
        log(f"{robot}/slam_pose", rerun.Points3D(_at_floor(pose[None, :2])))
        before = [fused for fused in self._fused[robot] if fused.stamp <= message.stamp]
        if before:  # carried on to the pose's stamp by its twist
            expected = compose(before[-1].pose, before[-1].twist * ((message.stamp - before[-1].stamp) / 1e9))
            x, y, heading = innovation_of(pose, expected).tolist()
            log(f"{robot}/innovation/position/x", rerun.Scalars(x))
            log(f"{robot}/innovation/position/y", rerun.Scalars(y))
            log(f"{robot}/innovation/heading", rerun.Scalars(math.degrees(heading)))

    def _show_diagnostics(self, robot: str, message: Diagnostics) -> None:
        """At the stamp that was shown last, for the clock of diagnostics is another one where a recording is played."""
        rows = [f"| {key} | {value} |" for status in message.statuses for key, value in status.values]
        table = "\n".join(["| | |", "|---|---|", *rows])
        self._stream.log(f"{robot}/health", self._rerun.TextDocument(table, media_type="text/markdown"))
        for status in message.statuses:
            entry = self._rerun.TextLog(status.message, level=_LEVELS[min(status.level, len(_LEVELS) - 1)])
            self._stream.log([robot, "diagnostics", status.name], entry)


def _at_floor(points: Array) -> Array:
    """Points (N, 3) of the floor, from x and y (N, 2), m."""
    return np.pad(points, ((0, 0), (0, 1)))
