"""One robot on Zenoh: its inputs, its outputs, and the token that shows that it is alive."""

from __future__ import annotations

import logging
import time

import zenoh

from omnibench.live.estimation.counts import anomalies_in_words
from omnibench.live.estimation.health import Health, diagnostic
from omnibench.live.estimation.tracker import RobotTracker
from omnibench.live.estimation.update import Update
from omnibench.live.network.rate_limiter import RateLimiter
from omnibench.live.wire.messages import Diagnostics
from omnibench.live.wire.outputs import OUTPUTS
from omnibench.live.wire.topics import GraphNode

LOG = logging.getLogger("omnibench.live")


class RobotService:
    """Subscribes to a robot's wheels and SLAM, hands them to its tracker, and publishes the updates.

    Messages are taken in Zenoh's own threads, as they come. One that fails is counted and logged.
    """

    def __init__(self, graph: GraphNode, tracker: RobotTracker) -> None:
        name = tracker.name
        self.tracker = tracker
        self._rate_limiter = RateLimiter()
        self._logged_anomalies: dict[str, int] = {}
        self._logged_status = ""
        self._outputs = [
            (graph.publisher(name, output.topic), output.encoding(tracker.frames))
            for output in OUTPUTS
            if tracker.fusing or not output.fused
        ]
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
        self._log_changes(health)

    def close(self) -> None:
        """Take nothing more and leave."""
        for subscriber in self._inputs:
            subscriber.undeclare()
        self.tracker.close()
        self._token.undeclare()

    def _take_wheels(self, sample: zenoh.Sample) -> None:
        try:
            self.tracker.take_wheels(sample.payload.to_bytes(), time.monotonic(), self._publish)
        except Exception as error:  # Zenoh would print it; the stream has to go on
            self._failed("wheels", error)

    def _take_pose(self, sample: zenoh.Sample) -> None:
        try:
            self.tracker.take_pose(sample.payload.to_bytes(), time.monotonic())
        except Exception as error:
            self._failed("pose", error)

    def _publish(self, update: Update) -> None:
        for publisher, encoded in self._outputs:
            publisher.put_encoded(encoded(update))

    def _failed(self, input_name: str, error: Exception) -> None:
        self.tracker.count_failure()
        if self._rate_limiter.allows(input_name):
            LOG.error("%s: a %s message failed: %s: %s", self.tracker.name, input_name, type(error).__name__, error)

    def _log_changes(self, health: Health) -> None:
        """Log a new status, and anomalies that were counted since they were last logged."""
        if health.status != self._logged_status:
            self._logged_status = health.status
            LOG.info("%s: %s (%s)", health.robot, health.status, health.message)
        anomalies = self.tracker.counts.anomalies()
        new = {kind: count - self._logged_anomalies.get(kind, 0) for kind, count in anomalies.items()}
        in_words = anomalies_in_words({kind: count for kind, count in new.items() if count})
        if in_words and self._rate_limiter.allows("anomalies"):
            self._logged_anomalies = anomalies
            last = f"; the last: {health.last_refusal}" if health.last_refusal else ""
            LOG.warning("%s: %s%s", health.robot, in_words, last)
