"""Listening to robots: the table, plain lines and JSON, from real sessions."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from dataclasses import replace
from io import StringIO
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest
import zenoh
from rich.console import Console
from samples import odometry
from sessions import Loopback, until

from omnibench.cli.terminal.robot_table import listen, plain, state, view
from omnibench.errors import ConfigError, DataError
from omnibench.live.estimation.counts import Counts
from omnibench.live.robot_monitor import HealthSummary, OdometryStatus, RobotMonitor, RobotStatus
from omnibench.live.wire.messages import Diagnostic, Diagnostics, Odometry
from omnibench.live.wire.topics import GraphNode, KeySpace, Profile

KEYS = KeySpace()


class Robot:
    """A robot as a node has it: token, topics and the answer to questions for its health."""

    def __init__(self, session: zenoh.Session, name: str, profile: Profile = "plain") -> None:
        node = GraphNode(session, KeySpace(profile), f"node_of_{name}")
        self.name = name
        self.odom = node.publisher(name, "odom")
        self.filtered = node.publisher(name, "odometry/filtered")
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


@pytest.fixture
def apr02(loopback: Loopback) -> Robot:
    return Robot(loopback.router, "apr02")


@pytest.fixture
def monitor(loopback: Loopback) -> Iterator[RobotMonitor]:
    with RobotMonitor(loopback.client(), KEYS, None) as opened:
        yield opened


def news_of(monitor: RobotMonitor, robot: str) -> RobotStatus | None:
    return next((each for each in monitor.status() if each.robot == robot), None)


def until_news(monitor: RobotMonitor, robot: str, what: str, **expected: Any) -> RobotStatus:
    """The news of a robot as soon as its fields are as expected (... : anything but None)."""
    found: list[RobotStatus] = []

    def arrived() -> bool:
        news = news_of(monitor, robot)
        if news is None:
            return False
        found.append(news)
        return all(
            getattr(news, name) is not None if value is ... else getattr(news, name) == value
            for name, value in expected.items()
        )

    until(arrived, what)
    return found[-1]


def until_matched(robot: Robot) -> None:
    until(lambda: robot.odom.matched and robot.filtered.matched, "the watcher's subscriptions")


def listened(loopback: Loopback, robot: str | None, *, terminal: bool = False, width: int = 100, **options: Any) -> str:
    """What ``listen`` prints in one look."""
    text = StringIO()
    console = Console(file=text, width=width, force_terminal=terminal, color_system=None)
    listen(robot, loopback.client(), KEYS, console, Event(), **{"seconds": 0.05, "patience": 0.5, **options})
    return text.getvalue()


def test_the_newest_odometry_of_both_topics_is_known(monitor: RobotMonitor, apr02: Robot) -> None:
    until_matched(apr02)
    for k in range(20):
        apr02.odom.put(odometry(k))
        apr02.filtered.put(odometry(k, "map"))
    until(
        lambda: (news := news_of(monitor, "apr02")) and news.odom and news.odom.message.stamp == odometry(19).stamp,
        "19",
    )
    news = until_news(monitor, "apr02", "fused odometry", filtered=..., presence="alive")
    assert news.odom is not None
    assert news.filtered is not None
    np.testing.assert_allclose(news.odom.message.pose, odometry(19).pose, atol=1e-15)
    assert news.filtered.message.frame == "map"


def test_the_rate_is_that_of_arrival(monitor: RobotMonitor, apr02: Robot) -> None:
    until_matched(apr02)
    began = time.monotonic()
    rates = []
    for k in range(50):
        apr02.odom.put(odometry(k))
        time.sleep(max(began + (k + 1) * 0.01 - time.monotonic(), 0.0))
        news = news_of(monitor, "apr02")
        rates.append(news.odom.rate if news and news.odom else None)
    took = time.monotonic() - began
    assert rates[-1] == pytest.approx(50 / took, rel=0.1)


def test_the_age_by_the_stamp_is_told_where_the_clocks_agree(monitor: RobotMonitor, apr02: Robot) -> None:
    until_matched(apr02)
    apr02.odom.put(replace(odometry(), stamp=time.time_ns() - 200_000_000))
    news = until_news(monitor, "apr02", "odometry", odom=...)
    assert news.odom is not None
    assert news.odom.stamp_age is not None
    assert 0.2 <= news.odom.stamp_age < 0.2 + 1.0
    assert 0.0 <= news.odom.age < news.odom.stamp_age


def test_the_age_by_the_stamp_is_left_out_where_the_clocks_differ(monitor: RobotMonitor, apr02: Robot) -> None:
    until_matched(apr02)
    apr02.odom.put(odometry())  # of 2023
    news = until_news(monitor, "apr02", "odometry", odom=...)
    assert news.odom is not None
    assert news.odom.stamp_age is None


def test_a_robot_that_goes_has_left(monitor: RobotMonitor, apr02: Robot) -> None:
    until_news(monitor, "apr02", "the token", presence="alive")
    apr02.token.undeclare()
    news = until_news(monitor, "apr02", "the token to go", presence="left")
    assert state(news).startswith("left")


def test_a_robot_without_omnibench_is_seen_by_its_odometry(loopback: Loopback, monitor: RobotMonitor) -> None:
    publisher = GraphNode(loopback.router, KEYS, "bridge").publisher("other", "odom")
    until(lambda: publisher.matched, "the watcher's subscription")
    publisher.put(odometry())
    assert until_news(monitor, "other", "odometry", odom=...).presence == "no token"


def test_health_is_asked_for_and_tells_the_counters_that_are_not_zero(monitor: RobotMonitor, apr02: Robot) -> None:
    apr02.answer_health("degraded", "poses are refused", samples=100, late=3, pose_rejected=2)
    news = until_news(monitor, "apr02", "an answer", health=...)
    assert news.health == HealthSummary("degraded", "poses are refused", {"late": 3, "pose_rejected": 2})
    assert "degraded: poses are refused, late 3, pose_rejected 2" in state(news)


def test_a_robot_that_does_not_answer_tells_its_health_by_diagnostics(monitor: RobotMonitor, apr02: Robot) -> None:
    until(lambda: apr02.diagnostics.matched, "the watcher's subscription")
    values = (("rate_hz", "99.8"), ("samples", "500"), ("late", "7"))
    apr02.diagnostics.put(Diagnostics(1, (Diagnostic("odometry", 1, "late samples", "apr02", values),)))
    news = until_news(monitor, "apr02", "diagnostics", health=...)
    assert news.health == HealthSummary("warning", "late samples", {"late": 7})


def test_an_answer_that_is_no_health_is_passed_over(loopback: Loopback, monitor: RobotMonitor, apr02: Robot) -> None:
    asked = Event()

    def nonsense(query: zenoh.Query) -> None:
        for document in (b"\xff{", b"[1, 2]", b'{"status": "ok", "message": "", "counts": {"late": "?"}}'):
            query.reply(f"omnibench/{apr02.name}/health", document)
        asked.set()

    _queryable = loopback.router.declare_queryable("omnibench/apr02/health", nonsense)
    until(lambda: news_of(monitor, "apr02") and asked.is_set(), "a question")
    assert until_news(monitor, "apr02", "the robot", presence="alive").health is None


def test_odometry_that_cannot_be_decoded_is_counted_and_the_last_stays(monitor: RobotMonitor, apr02: Robot) -> None:
    until_matched(apr02)
    apr02.odom.put(odometry())
    until_news(monitor, "apr02", "odometry", odom=...)
    apr02.odom.put_encoded(b"garbage")
    until(lambda: (news := news_of(monitor, "apr02")) and news.odom and news.odom.undecodable == 1, "the count")
    news = news_of(monitor, "apr02")
    assert news is not None
    assert "undecodable odometry 1" in state(news)


@pytest.mark.parametrize("profile", ["plain", "rmw", "humble"])
def test_robots_of_every_profile_are_named_by_their_keys(loopback: Loopback, profile: Profile) -> None:
    robot = Robot(loopback.router, "apr07", profile)
    with RobotMonitor(loopback.client(), KeySpace(profile), None) as monitor:
        until_matched(robot)
        robot.odom.put(odometry())
        until_news(monitor, "apr07", "odometry", odom=...)


def test_only_the_robot_that_was_asked_for_is_shown(loopback: Loopback, apr02: Robot) -> None:
    other = Robot(loopback.router, "apr03")
    with RobotMonitor(loopback.client(), KEYS, "apr02") as monitor:
        until_matched(apr02)
        other.odom.put(odometry())
        apr02.odom.put(odometry())
        until_news(monitor, "apr02", "odometry", odom=...)
        assert [news.robot for news in monitor.status()] == ["apr02"]
        assert monitor.alive == ("apr02", "apr03")


def test_a_robot_that_is_not_there_is_one_line_with_the_nearest_that_is(loopback: Loopback, apr02: Robot) -> None:
    assert apr02.token
    with pytest.raises(
        DataError, match=r"'apr2': nothing was heard of it in 0\.5 s; did you mean 'apr02'\? alive: apr02"
    ):
        listened(loopback, "apr2")


def test_when_nobody_is_there_the_line_says_so(loopback: Loopback) -> None:
    with pytest.raises(DataError, match="no robot is alive; is its node running"):
        listened(loopback, "apr02")


def test_a_name_that_no_robot_can_have_is_refused(loopback: Loopback) -> None:
    with pytest.raises(ConfigError, match="a robot's name is one word"):
        listened(loopback, "apr02/odom")


def test_listening_to_all_goes_on_while_nobody_is_there(loopback: Loopback) -> None:
    assert listened(loopback, None) == "no robot is heard yet\n"


def test_a_piped_listener_prints_plain_lines(loopback: Loopback, apr02: Robot) -> None:
    apr02.answer_health("ok", "calibrated")
    lines = listened(loopback, "apr02", seconds=1.2).splitlines()
    assert len(lines) == 2
    assert lines[1].startswith("apr02: no odometry yet, ok: calibrated")


def test_json_is_one_document_a_line_without_nan(loopback: Loopback, apr02: Robot) -> None:
    with RobotMonitor(loopback.client(), KEYS, None):
        until_matched(apr02)
    stop = Event()
    bad = replace(odometry(), twist=np.array([math.nan, 0.0, math.inf]), stamp=time.time_ns())

    class Feeder(StringIO):
        """Hears of every line that is printed."""

        def write(self, text: str) -> int:
            if '"odom": {' in text:
                stop.set()
            apr02.odom.put(bad)
            return super().write(text)

    text = Feeder()
    listen("apr02", loopback.client(), KEYS, Console(file=text, width=80), stop, seconds=10.0, as_json=True)
    document = json.loads(text.getvalue().splitlines()[-1], parse_constant=pytest.fail)  # NaN, Infinity
    assert document["robot"] == "apr02"
    assert document["odom"]["pose"] == pytest.approx(odometry().pose.tolist())
    assert document["odom"]["twist"] == [None, 0.0, None]


def test_a_terminal_gets_a_table(loopback: Loopback, apr02: Robot) -> None:
    text = listened(loopback, apr02.name, terminal=True)
    assert "deg/s" in text
    assert "no odometry yet" in text


def test_listening_ends_at_once_when_told_to(loopback: Loopback) -> None:
    stop = Event()
    listener = Thread(target=listen, args=(None, loopback.client(), KEYS, Console(file=StringIO()), stop))
    listener.start()
    stop.set()
    listener.join(5)
    assert not listener.is_alive()


def seen(
    message: Odometry | None = None, rate: float = 100.0, age: float = 0.004, stamp_age: float | None = 0.012
) -> OdometryStatus:
    return OdometryStatus(message or odometry(), rate, age, stamp_age, 0)


HEALTHY = HealthSummary("ok", "calibrated odometry", {})


def shown(news: list[RobotStatus], width: int) -> list[str]:
    text = StringIO()
    console = Console(file=text, width=width)
    console.print(view(news, console))
    return text.getvalue().splitlines()


@pytest.mark.parametrize("width", [80, 120, 160])
def test_the_table_fits_the_terminal_with_every_figure_whole(width: int) -> None:
    far = replace(odometry(), pose=np.array([-123.4567, -98.7654, -3.1]), twist=np.array([-1.5, -0.25, -3.1]))
    robots = [
        RobotStatus("apr02", "alive", seen(), seen(odometry(0, "map")), HEALTHY),
        RobotStatus("apr03", "alive", seen(far, rate=1000.0), None, HealthSummary("degraded", "late", {"late": 12})),
    ]
    lines = shown(robots, width)
    text = "\n".join(lines)
    assert max(map(len, lines)) <= width
    assert "…" not in text
    for figure in ("1.250", "-2.500", "40.1", "0.025", "2.29", "0.31", "-0.12", "25.8", "-123.46", "-177.6", "1000"):
        assert figure in text
    assert "ok: calibrated odometry" in text
    assert "degraded: late, late 12" in " ".join(text.split())


def test_a_silent_robot_has_no_rate_and_says_for_how_long() -> None:
    news = RobotStatus("apr02", "alive", seen(age=3.21), None, HEALTHY)
    assert "no news for 3.2 s" in state(news)
    assert " 100 " not in "\n".join(shown([news], 80))


def test_the_plain_line_gives_pose_twist_sigma_rate_and_age_with_units() -> None:
    assert plain(RobotStatus("apr02", "alive", seen(), None, HEALTHY)) == (
        "apr02: ok: calibrated odometry; odom x 1.250 m y -2.500 m heading 40.1 deg (1 sigma 0.025 m 2.29 deg)"
        " vx 0.310 m/s vy -0.120 m/s w 25.8 deg/s, 100.0 Hz, age 4 ms (12 ms by its stamp)"
    )
