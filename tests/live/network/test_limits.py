"""What peers can take from a node before it knows their rights: memory by large messages, time by idle connections."""

from __future__ import annotations

import socket
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh
from drives import drive
from nodes import Command, peak_memory, sent, write_node
from routers import ACCESS, RouterProcess, member, mutual, running, user, works
from sessions import free_port, until

from omnibench.live.network.session import open_session
from omnibench.live.network.session_config import SessionConfig, User

BLOCK = zenoh.CongestionControl.BLOCK


def test_large_messages_of_a_viewer_cost_a_node_no_memory_and_no_odometry(keys: Path, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    zenoh_config = {"listen": endpoint, "users_file": str(keys / "users.txt"), "access": ACCESS}
    with Command("live", write_node(tmp_path, "apr02", zenoh=zenoh_config)) as node:
        until(lambda: "Ctrl-C ends it" in node.said(), "the node")
        sessions = [
            SessionConfig(
                mode="client", connect=(endpoint,), user=User(name=name, password_file=keys / f"{name}.password")
            )
            for name in ("apr02", "viewer")
        ]
        with open_session(sessions[0], "robot") as robot, open_session(sessions[1], "viewer") as viewer:
            odometry: list[zenoh.Sample] = []
            subscriber = robot.declare_subscriber("apr02/odom", odometry.append)
            publisher = robot.declare_publisher("apr02/joint_states")
            until(lambda: publisher.matching_status.matching, "the node's subscriber")
            samples = drive(1.0).samples()
            sent(publisher, samples[:50])
            until(lambda: odometry, "odometry")
            before = peak_memory(node.process.pid)
            for key in ("apr02/joint_states", "apr02/slam_pose", "omnibench/apr02/set_pose", "notes/large"):
                viewer.put(key, bytes(100_000_000), congestion_control=BLOCK)
            odometry.clear()
            sent(publisher, samples[50:])
            until(lambda: odometry, "odometry after the large messages")
            assert peak_memory(node.process.pid) - before < 50
            subscriber.undeclare()


def test_a_message_beyond_largest_message_is_dropped_and_the_next_arrives(keys: Path, tmp_path: Path) -> None:
    with (
        running(tmp_path / "router", mutual(keys) | {"largest_message": 10_000}) as router,
        open_session(member(router, keys, "apr02"), "apr02") as session,
    ):
        session.put("apr02/slam_pose", bytes(200_000), congestion_control=BLOCK)
        works(session, router)
        assert router.got("apr02/slam_pose") == 0
        session.put("apr02/slam_pose", bytes(9_000), congestion_control=BLOCK)
        until(lambda: router.got("apr02/slam_pose") == 1, "the smaller message")


def test_a_user_logs_in_within_five_seconds_beside_150_idle_connections(users: RouterProcess, keys: Path) -> None:
    port = int(users.address.rsplit(":", 1)[1])
    with ExitStack() as idle:
        for _ in range(150):
            idle.enter_context(socket.create_connection(("127.0.0.1", port)))
        began = time.monotonic()
        with open_session(user(users, keys, "apr02").model_copy(update={"wait": 20.0}), "apr02") as session:
            assert time.monotonic() - began < 5.0
            works(session, users)


@pytest.mark.parametrize("by", ["with a certificate of", "with a password of", "who reaches it"])
def test_a_router_without_access_rules_says_in_one_line_that_no_roles_hold(
    by: str, keys: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config, way = mutual(keys), "give access"
    if by == "with a password of":
        config = {"listen": f"tcp/127.0.0.1:{free_port()}", "users_file": str(keys / "users.txt"), "access": ACCESS}
    configs = [config, {key: value for key, value in config.items() if key != "access"}]
    if by == "who reaches it":
        configs, way = [configs[1] | {"tls": {**config["tls"], "mutual": False}}], "give tls mutual: true, and access"
    for each in configs:
        caplog.clear()
        with open_session(SessionConfig.model_validate(each), "node apr"):
            pass
        lines = [record.getMessage() for record in caplog.records if "no access rules" in record.getMessage()]
        assert len(lines) == ("access" not in each)
    assert f"everybody {by}" in lines[0]
    assert lines[0].endswith(f"may do everything, as swap calibrations; {way}")
