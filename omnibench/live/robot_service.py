"""One robot on Zenoh: its inputs, its outputs, and the token that says that it is alive."""

from __future__ import annotations

import logging
import threading
import time

import zenoh

from omnibench.live.estimation.health import Health, diagnostic
from omnibench.live.estimation.tracker import RobotTracker, Update
from omnibench.live.network.rate_limiter import RateLimiter
from omnibench.live.wire.messages import Diagnostics
from omnibench.live.wire.robot_messages import OdometryEncoder, TransformsEncoder
from omnibench.live.wire.topics import GraphNode

LOG = logging.getLogger("omnibench.live")


class RobotService:
    """Subscribes to a robot's wheels and SLAM and publishes what its tracker makes of them.

    Messages are taken in Zenoh's own threads, as they come; one that fails is counted, told and forgotten.
    """

    def __init__(self, graph: GraphNode, tracker: RobotTracker) -> None:
        name = tracker.name
        self.tracker = tracker
        self._rate_limiter = RateLimiter()
        self._closed = False
        self._anomalies: dict[str, int] = {}
        self._status = ""
        self._order = threading.Lock()  # wheel samples may come over several links: one after another goes out
        self._odometry = graph.publisher(name, "odom")
        frames = tracker.frames
        self._encode_odometry = OdometryEncoder(frames.odom, frames.base).encode
        self._encode_filtered = OdometryEncoder(frames.map, frames.base).encode
        self._encode_transforms = TransformsEncoder(((frames.map, frames.odom), (frames.odom, frames.base))).encode
        self._filtered = graph.publisher(name, "odometry/filtered") if tracker.fusing else None
        self._transforms = graph.publisher(name, "tf") if tracker.fusing else None
        self._diagnostics = graph.publisher(name, "diagnostics")
        self._inputs = [graph.subscribe(name, "joint_states", self._take_wheels)]
        if tracker.fusing:
            self._inputs.append(graph.subscribe(name, "slam_pose", self._take_pose))
        self._token = graph.session.liveliness().declare_token(f"omnibench/{name}/alive")

    def publish_diagnostics(self) -> None:
        """Publish the diagnostics and log what has changed; called once a second."""
        health = self.tracker.health(time.monotonic())
        status = diagnostic(health, hardware=self.tracker.calibration.robot.name)
        self._diagnostics.put(Diagnostics(time.time_ns(), (status,)))
        self._log(health)

    def close(self) -> None:
        """Take nothing more and leave."""
        for subscriber in self._inputs:
            subscriber.undeclare()
        with self._order:
            self._closed = True
            self._token.undeclare()
            self.tracker.close()

    def _take_wheels(self, sample: zenoh.Sample) -> None:
        arrival = time.monotonic()
        try:
            with self._order:
                if self._closed:  # a callback that was on its way
                    return
                for update in self.tracker.take_wheels(sample.payload.to_bytes(), arrival):
                    self._publish(update)
        except Exception as error:  # Zenoh would print it; the stream has to go on
            self._failed("wheels", error)

    def _take_pose(self, sample: zenoh.Sample) -> None:
        try:
            self.tracker.take_pose(sample.payload.to_bytes(), time.monotonic())
        except Exception as error:
            self._failed("pose", error)

    def _publish(self, update: Update) -> None:
        self._odometry.put_encoded(self._encode_odometry(update.odometry))
        if self._filtered is not None and self._transforms is not None and update.filtered is not None:
            self._filtered.put_encoded(self._encode_filtered(update.filtered))
            self._transforms.put_encoded(self._encode_transforms(update.transforms))

    def _failed(self, what: str, error: Exception) -> None:
        self.tracker.count_failure()
        if self._rate_limiter.allows(what):
            LOG.error("%s: a %s message failed: %s: %s", self.tracker.name, what, type(error).__name__, error)

    def _log(self, health: Health) -> None:
        if health.status != self._status:
            self._status = health.status
            LOG.info("%s: %s (%s)", health.robot, health.status, health.message)
        anomalies = self.tracker.counts.anomalies()
        new = {kind: count - self._anomalies.get(kind, 0) for kind, count in anomalies.items()}
        told = ", ".join(f"{count} {kind}" for kind, count in new.items() if count)
        if told and self._rate_limiter.allows("anomalies"):
            self._anomalies = anomalies
            last = f"; the last: {health.last_refusal}" if health.last_refusal else ""
            LOG.warning("%s: %s%s", health.robot, told, last)
