"""A robot as a node has it on Zenoh, for tests of what listens to robots."""

from __future__ import annotations

import json

import zenoh
from sessions import until

from omnibench.live.estimation.counts import Counts
from omnibench.live.wire.topics import GraphNode, KeySpace, Profile


class AnnouncedRobot:
    """A robot's liveliness token, its topics and its answer to queries for its health."""

    def __init__(self, session: zenoh.Session, name: str, profile: Profile = "plain") -> None:
        node = GraphNode(session, KeySpace(profile), f"node_of_{name}")
        self.name = name
        self.odom = node.publisher(name, "odom", lossless=True)
        self.filtered = node.publisher(name, "odometry/filtered", lossless=True)
        self.diagnostics = node.publisher(name, "diagnostics")
        self.token = session.liveliness().declare_token(f"omnibench/{name}/alive")
        self._session = session

    def answer_health(self, status: str, message: str, **counts: int) -> None:
        document = json.dumps(
            {"robot": self.name, "status": status, "message": message, "counts": Counts(**counts).as_dict()}
        )
        self._queryable = self._session.declare_queryable(
            f"omnibench/{self.name}/health", lambda query: query.reply(f"omnibench/{self.name}/health", document)
        )

    def wait_for_subscribers(self) -> None:
        until(lambda: self.odom.matched and self.filtered.matched, "the monitor's subscriptions")
