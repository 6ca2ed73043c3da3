"""Monitoring robots: what is known of them from real sessions."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from threading import Event
from typing import Any

import numpy as np
import pytest
import zenoh
from announced_robot import AnnouncedRobot
from samples import odometry
from sessions import Loopback, until

from omnibench.live.robot_monitor import HealthSummary, RobotMonitor, RobotStatus
from omnibench.live.wire.messages import Diagnostic, Diagnostics
from omnibench.live.wire.topics import GraphNode, KeySpace, Profile

KEYS = KeySpace()


@pytest.fixture
def apr02(loopback: Loopback) -> AnnouncedRobot:
    return AnnouncedRobot(loopback.router, "apr02")


@pytest.fixture
def monitor(loopback: Loopback) -> Iterator[RobotMonitor]:
    with RobotMonitor(loopback.client(), KEYS, None) as opened:
        yield opened


def status_of(monitor: RobotMonitor, robot: str) -> RobotStatus | None:
    return next((each for each in monitor.statuses() if each.robot == robot), None)


def until_status(monitor: RobotMonitor, robot: str, what: str, **expected: Any) -> RobotStatus:
    """The status of a robot as soon as its fields are as expected (... : anything but None)."""
    statuses: list[RobotStatus] = []

    def arrived() -> bool:
        status = status_of(monitor, robot)
        if status is None:
            return False
        statuses.append(status)
        return all(
            getattr(status, name) is not None if value is ... else getattr(status, name) == value
            for name, value in expected.items()
        )

    until(arrived, what)
    return statuses[-1]


def test_the_newest_odometry_of_both_topics_is_known(monitor: RobotMonitor, apr02: AnnouncedRobot) -> None:
    apr02.wait_for_subscribers()
    for k in range(20):
        apr02.odom.put(odometry(k))
        apr02.filtered.put(odometry(k, "map"))
    until(
        lambda: (
            (status := status_of(monitor, "apr02")) and status.odom and status.odom.message.stamp == odometry(19).stamp
        ),
        "19",
    )
    status = until_status(monitor, "apr02", "fused odometry", filtered=..., presence="alive")
    assert status.odom is not None
    assert status.filtered is not None
    np.testing.assert_allclose(status.odom.message.pose, odometry(19).pose, atol=1e-15)
    assert status.filtered.message.frame == "map"


def test_the_rate_is_that_of_arrival(monitor: RobotMonitor, apr02: AnnouncedRobot) -> None:
    apr02.wait_for_subscribers()
    before_first = time.monotonic()
    apr02.odom.put(odometry(0))
    until_status(monitor, "apr02", "odometry", odom=...)
    after_first = time.monotonic()
    for k in range(1, 50):
        apr02.odom.put(odometry(k))
        time.sleep(0.005)
    before_last = time.monotonic()
    apr02.odom.put(odometry(50))
    rates: list[float | None] = []

    def last_came() -> bool:
        status = status_of(monitor, "apr02")
        assert status is not None
        assert status.odom is not None
        rates.append(status.odom.rate)
        return status.odom.message.stamp == odometry(50).stamp

    until(last_came, "the last message")
    slowest, fastest = 50 / (time.monotonic() - before_first), 50 / (before_last - after_first)
    assert rates[-1] is not None
    assert slowest <= rates[-1] <= fastest


def test_the_age_by_the_stamp_is_told_where_the_clocks_agree(monitor: RobotMonitor, apr02: AnnouncedRobot) -> None:
    apr02.wait_for_subscribers()
    stamped = time.time_ns() - 200_000_000
    apr02.odom.put(replace(odometry(), stamp=stamped))
    status = until_status(monitor, "apr02", "odometry", odom=...)
    assert status.odom is not None
    assert status.odom.stamp_age is not None
    assert 0.2 <= status.odom.stamp_age <= (time.time_ns() - stamped) / 1e9
    assert 0.0 <= status.odom.age < status.odom.stamp_age


def test_the_age_by_the_stamp_is_left_out_where_the_clocks_differ(monitor: RobotMonitor, apr02: AnnouncedRobot) -> None:
    apr02.wait_for_subscribers()
    apr02.odom.put(odometry())  # of 2023
    status = until_status(monitor, "apr02", "odometry", odom=...)
    assert status.odom is not None
    assert status.odom.stamp_age is None


def test_a_robot_that_goes_has_left(monitor: RobotMonitor, apr02: AnnouncedRobot) -> None:
    until_status(monitor, "apr02", "the token", presence="alive")
    apr02.token.undeclare()
    until_status(monitor, "apr02", "the token to go", presence="left")


def test_a_robot_without_omnibench_is_seen_by_its_odometry(loopback: Loopback, monitor: RobotMonitor) -> None:
    publisher = GraphNode(loopback.router, KEYS, "bridge").publisher("other", "odom")
    until(lambda: publisher.matched, "the monitor's subscription")
    publisher.put(odometry())
    assert until_status(monitor, "other", "odometry", odom=...).presence == "no token"


def test_health_is_asked_for_and_tells_the_counters_that_are_not_zero(
    monitor: RobotMonitor, apr02: AnnouncedRobot
) -> None:
    apr02.answer_health("degraded", "poses are refused", samples=100, late=3, pose_rejected=2)
    status = until_status(monitor, "apr02", "an answer", health=...)
    assert status.health == HealthSummary("degraded", "poses are refused", {"late": 3, "pose_rejected": 2})


def test_a_robot_that_does_not_answer_tells_its_health_by_diagnostics(
    monitor: RobotMonitor, apr02: AnnouncedRobot
) -> None:
    until(lambda: apr02.diagnostics.matched, "the monitor's subscription")
    values = (("rate_hz", "99.8"), ("samples", "500"), ("late", "7"))
    apr02.diagnostics.put(Diagnostics(1, (Diagnostic("odometry", 1, "late samples", "apr02", values),)))
    status = until_status(monitor, "apr02", "diagnostics", health=...)
    assert status.health == HealthSummary("warning", "late samples", {"late": 7})


def test_an_answer_that_is_no_health_is_passed_over(
    loopback: Loopback, monitor: RobotMonitor, apr02: AnnouncedRobot
) -> None:
    asked = Event()

    def nonsense(query: zenoh.Query) -> None:
        for document in (b"\xff{", b"[1, 2]", b'{"status": "ok", "message": "", "counts": {"late": "?"}}'):
            query.reply(f"omnibench/{apr02.name}/health", document)
        asked.set()

    _queryable = loopback.router.declare_queryable("omnibench/apr02/health", nonsense)
    until(lambda: status_of(monitor, "apr02") and asked.is_set(), "a question")
    assert until_status(monitor, "apr02", "the robot", presence="alive").health is None


def test_odometry_that_cannot_be_decoded_is_counted_and_the_last_stays(
    monitor: RobotMonitor, apr02: AnnouncedRobot
) -> None:
    apr02.wait_for_subscribers()
    apr02.odom.put(odometry())
    until_status(monitor, "apr02", "odometry", odom=...)
    apr02.odom.put_encoded(b"garbage")
    until(lambda: (status := status_of(monitor, "apr02")) and status.odom and status.odom.undecodable == 1, "the count")
    status = status_of(monitor, "apr02")
    assert status is not None
    assert status.odom is not None
    np.testing.assert_array_equal(status.odom.message.pose, odometry().pose)


@pytest.mark.parametrize("profile", ["plain", "rmw", "humble"])
def test_robots_of_every_profile_are_named_by_their_keys(loopback: Loopback, profile: Profile) -> None:
    robot = AnnouncedRobot(loopback.router, "apr07", profile)
    with RobotMonitor(loopback.client(), KeySpace(profile), None) as monitor:
        robot.wait_for_subscribers()
        robot.odom.put(odometry())
        until_status(monitor, "apr07", "odometry", odom=...)


def test_only_the_robot_that_was_asked_for_is_shown(loopback: Loopback, apr02: AnnouncedRobot) -> None:
    other = AnnouncedRobot(loopback.router, "apr03")
    with RobotMonitor(loopback.client(), KEYS, "apr02") as monitor:
        apr02.wait_for_subscribers()
        other.odom.put(odometry())
        apr02.odom.put(odometry())
        until_status(monitor, "apr02", "odometry", odom=...)
        assert [status.robot for status in monitor.statuses()] == ["apr02"]
        assert monitor.alive == ("apr02", "apr03")


def test_messages_that_never_came_are_counted(monitor: RobotMonitor, apr02: AnnouncedRobot) -> None:
    apr02.wait_for_subscribers()
    apr02.odom.put(odometry(0))
    for _ in range(5):
        apr02.odom.next_number()  # of a message that is lost
    apr02.odom.put(odometry(6))
    until(lambda: (status := status_of(monitor, "apr02")) and status.odom and status.odom.missed == 5, "the count")
