"""Access rules of a router in its own process: who may write and read what."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import zenoh
from pydantic import ValidationError
from routers import RouterProcess, member, works
from sessions import until

from omnibench.live.network.session import Right, open_session, rights_of
from omnibench.live.network.session_config import Access


class TestAccess:
    @pytest.mark.parametrize("declared", [False, True])
    def test_a_robot_writing_anothers_keys_is_refused(self, fleet: RouterProcess, keys: Path, declared: bool) -> None:
        with open_session(member(fleet, keys, "apr02"), "apr02") as session:
            works(session, fleet)
            for key in ("apr03/joint_states", "apr03/slam_pose"):
                publisher = session.declare_publisher(key)
                put = publisher.put if declared else (lambda value, key=key: session.put(key, value))
                for _ in range(100):
                    put(b"forged")
                publisher.undeclare()
            works(session, fleet)
        assert fleet.got("apr03/joint_states") == fleet.got("apr03/slam_pose") == 0

    def test_a_robot_reads_what_is_its_own_only(self, fleet: RouterProcess, keys: Path) -> None:
        with open_session(member(fleet, keys, "apr02"), "apr02") as session:
            received: list[zenoh.Sample] = []
            subscribers = [session.declare_subscriber(key, received.append) for key in ("apr03/odom", "*/odom", "**")]
            works(session, fleet)
            works(session, fleet)  # by then the router has published apr03/odom, too
            assert {str(sample.key_expr).split("/")[0] for sample in received} == {"apr02"}
            for subscriber in subscribers:
                subscriber.undeclare()

    def test_a_certificate_without_rights_can_do_nothing(self, fleet: RouterProcess, keys: Path) -> None:
        with (
            open_session(member(fleet, keys, "stranger"), "stranger") as stranger,
            open_session(member(fleet, keys, "apr02"), "apr02") as session,
        ):
            received: list[zenoh.Sample] = []
            subscriber = stranger.declare_subscriber("*/odom", received.append)
            for _ in range(20):
                stranger.put("apr03/joint_states", b"forged")
                time.sleep(0.005)
            works(session, fleet)
            assert not received
            subscriber.undeclare()
        assert fleet.got("apr03/joint_states") == 0

    def test_nodes_serve_operators_through_the_router(self, fleet: RouterProcess, keys: Path) -> None:
        with (
            open_session(member(fleet, keys, "remote"), "node") as node,
            open_session(member(fleet, keys, "operator"), "operator") as operator,
            open_session(member(fleet, keys, "viewer"), "viewer") as viewer,
        ):
            keys_served = [f"omnibench/apr07/{service}" for service in ("health", "set_pose")]
            served = [
                node.declare_queryable(key, lambda query, key=key: query.reply(key, b"done")) for key in keys_served
            ]
            token = node.liveliness().declare_token("omnibench/apr07/alive")
            for session, key in (
                (operator, "omnibench/apr07/set_pose"),
                (viewer, "omnibench/apr07/health"),
                (viewer, "omnibench/*/health"),
            ):
                until(lambda session=session, key=key: answers(session, key) == [b"done"], f"an answer to {key}")
            until(lambda: alive(viewer, "omnibench/*/alive") == ["omnibench/apr07/alive"], "the token")
            assert fleet.errors.read_text() == ""
            assert answers(viewer, "omnibench/apr07/set_pose") == []
            for each in (*served, token):
                each.undeclare()

    def test_who_holds_the_routers_own_key_may_do_all(self, fleet: RouterProcess, keys: Path) -> None:
        with open_session(member(fleet, keys, "node"), "replay") as session:
            for robot in ("apr02", "apr03"):
                works(session, fleet, robot)
        assert fleet.errors.read_text() == ""

    def test_only_operators_swap_calibrations(self, fleet: RouterProcess, keys: Path) -> None:
        with (
            open_session(member(fleet, keys, "remote"), "node") as node,
            open_session(member(fleet, keys, "operator"), "operator") as operator,
            open_session(member(fleet, keys, "viewer"), "viewer") as viewer,
            open_session(member(fleet, keys, "apr02"), "robot") as robot,
        ):
            received: list[bytes] = []
            subscriber = node.declare_subscriber(
                "omnibench/apr07/calibration", lambda each: received.append(bytes(each.payload))
            )

            def passed(payload: bytes) -> bool:
                operator.put("omnibench/apr07/calibration", payload)
                return payload in received

            until(lambda: passed(b"before"), "the operator's calibration")
            for session in (viewer, robot):
                session.put("omnibench/apr07/calibration", b"forged")
                answers(session, "omnibench/apr07/health")  # the router has had the forgery when this ends
            until(lambda: passed(b"after"), "the operator's calibration")
            assert set(received) == {b"before", b"after"}
            subscriber.undeclare()

    def test_tokens_of_ros_nodes_pass(self, fleet: RouterProcess, keys: Path) -> None:
        key = "@ros2_lv/0/abc/0/1/MP/%/%/apr02/%apr02%joint_states/sensor_msgs::msg::dds_::JointState_/hash/qos"
        with (
            open_session(member(fleet, keys, "apr02"), "robot") as robot,
            open_session(member(fleet, keys, "viewer"), "viewer") as viewer,
        ):
            token = robot.liveliness().declare_token(key)
            until(lambda: alive(viewer, "@ros2_lv/0/**") == [key], "the token")
            token.undeclare()

    def test_advanced_publishers_are_heard(self, fleet: RouterProcess, keys: Path) -> None:
        from zenoh.ext import CacheConfig, HistoryConfig, declare_advanced_publisher, declare_advanced_subscriber

        with (
            open_session(member(fleet, keys, "remote"), "node") as node,
            open_session(member(fleet, keys, "viewer"), "viewer") as viewer,
        ):
            publisher = declare_advanced_publisher(
                node, "apr07/odom", cache=CacheConfig(max_samples=1), publisher_detection=True
            )
            publisher.put(b"before")
            received: list[bytes] = []
            subscriber = declare_advanced_subscriber(
                viewer,
                "apr07/odom",
                lambda each: received.append(bytes(each.payload)),
                history=HistoryConfig(detect_late_publishers=True),
            )
            until(lambda: received, "what was published before")
            assert received == [b"before"]
            subscriber.undeclare()
            publisher.undeclare()

    def test_rights_in_every_profile(self) -> None:
        rights = rights_of(Access.model_validate({"robots": {"apr02": "robot 2"}}))
        writable = [zenoh.KeyExpr(key) for key in rights["robot 2"]["write"]]

        def may_write(key: str) -> bool:
            return any(each.includes(zenoh.KeyExpr(key)) for each in writable)

        rmw = "0/{}/sensor_msgs::msg::dds_::JointState_/RIHS01_a13e"
        assert may_write("apr02/joint_states")
        assert may_write("apr02/slam_pose")
        assert may_write(rmw.format("apr02/joint_states"))
        for key in ("apr03/joint_states", "apr02/odom", "apr02/tf", "omnibench/apr02/calibration", "tf"):
            assert not may_write(key)
            assert not may_write(rmw.format(key))

    @pytest.mark.parametrize("domain", ["0", "232"])
    def test_a_robots_keys_in_any_domain_are_not_the_keys_of_its_services(self, domain: str) -> None:
        rights = rights_of(Access.model_validate({"robots": ["apr02"]}))["apr02"]

        def may(right: Right, key: str) -> bool:
            return any(zenoh.KeyExpr(each).includes(zenoh.KeyExpr(key)) for each in rights[right])

        assert may("read", f"{domain}/apr02/odom/nav_msgs::msg::dds_::Odometry_/*")
        assert may("read", f"{domain}/apr02/odometry/filtered/nav_msgs::msg::dds_::Odometry_/RIHS01_a13e")
        for service in ("set_pose", "reset", "swap", "calibration", "*", "**"):
            assert not may("read", f"omnibench/apr02/{service}")
            assert may("ask", f"omnibench/apr02/{service}") == (service == "calibration")

    def test_a_robot_cannot_have_the_name_that_begins_the_services(self) -> None:
        with pytest.raises(ValidationError, match="omnibench begins the keys of the services"):
            Access.model_validate({"robots": ["omnibench"]})


def answers(session: zenoh.Session, key: str) -> list[bytes]:
    replies = session.get(key, target=zenoh.QueryTarget.ALL, timeout=5.0)
    return [bytes(reply.ok.payload) for reply in replies if reply.ok is not None]


def alive(session: zenoh.Session, key: str) -> list[str]:
    return [str(reply.ok.key_expr) for reply in session.liveliness().get(key) if reply.ok is not None]
