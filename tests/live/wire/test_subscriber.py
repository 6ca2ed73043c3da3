"""``subscribe``: odometry in somebody's program."""

from __future__ import annotations

import logging
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from samples import PERIOD, STAMP, odometry, sample
from sessions import Loopback, free_port, until
from timing import PATIENCE

from omnibench.errors import ConfigError
from omnibench.live.wire.messages import JOINT_STATE, Odometry
from omnibench.live.wire.subscriber import Subscription, subscribe
from omnibench.live.wire.topics import GraphNode, KeySpace, Profile, Publisher


def odom_publisher(loopback: Loopback, topic: str = "odom", profile: Profile = "plain") -> Publisher[Odometry]:
    return GraphNode(loopback.router, KeySpace(profile), "node").publisher("apr02", topic)


@pytest.fixture
def odom(loopback: Loopback) -> Publisher[Odometry]:
    return odom_publisher(loopback)


@pytest.fixture
def subscription(loopback: Loopback, odom: Publisher[Odometry]) -> Iterator[Subscription]:
    with subscribe("apr02", connect=loopback.address) as opened:
        until(lambda: odom.matched, "the subscription")
        yield opened


@pytest.fixture
def lossless(loopback: Loopback, odom: Publisher[Odometry]) -> Iterator[Subscription]:
    with subscribe("apr02", connect=loopback.address, lossless=True) as opened:
        until(lambda: odom.matched, "the subscription")
        yield opened


def taken(subscription: Subscription, count: int) -> list[Odometry]:
    """The next messages, fewer when they do not come in 10 s: the subscription is closed then."""
    watchdog = threading.Timer(10.0, subscription.close)
    watchdog.start()
    try:
        return [message for _, message in zip(range(count), subscription, strict=False)]
    finally:
        watchdog.cancel()


def next_of(subscription: Subscription) -> Odometry:
    (message,) = taken(subscription, 1)
    return message


def test_messages_come_as_typed_odometry(subscription: Subscription, odom: Publisher[Odometry]) -> None:
    odom.put(odometry(5))
    message = next_of(subscription)
    assert (message.stamp, message.frame, message.child_frame) == (STAMP + 5 * PERIOD, "odom", "base_link")
    np.testing.assert_allclose(message.pose, odometry(5).pose, atol=1e-15)
    np.testing.assert_array_equal(message.pose_covariance, odometry(5).pose_covariance)
    np.testing.assert_array_equal(message.twist, odometry(5).twist)


def test_a_slow_reader_gets_the_newest_message(loopback: Loopback, odom: Publisher[Odometry]) -> None:
    session = loopback.client()
    with subscribe("apr02", session=session) as ring, subscribe("apr02", session=session, lossless=True) as every:
        until(lambda: odom.matched, "the subscriptions")
        for k in range(51):
            odom.put(odometry(k))
        assert len(taken(every, 51)) == 51  # then the ring has had 50 of them at least
        assert next_of(ring).stamp >= odometry(49).stamp
        assert ring.received == 1


def test_a_lossless_reader_gets_every_message_in_order_however_slow(loopback: Loopback, lossless: Subscription) -> None:
    sender = GraphNode(loopback.router, KeySpace(), "burst").publisher("apr02", "odom", lossless=True)
    for k in range(2000):  # at once; a node's own publishers would rather drop some than wait
        sender.put(odometry(k))
    assert [message.stamp for message in taken(lossless, 2000)] == [odometry(k).stamp for k in range(2000)]


def test_a_buffer_keeps_as_many_of_the_newest(loopback: Loopback, odom: Publisher[Odometry]) -> None:
    session = loopback.client()
    with (
        subscribe("apr02", session=session, buffer=3) as ring,
        subscribe("apr02", session=session, lossless=True) as every,
    ):
        until(lambda: odom.matched, "the subscriptions")
        for k in range(11):
            odom.put(odometry(k))
        assert len(taken(every, 11)) == 11
        first = next_of(ring).stamp
    assert odometry(7).stamp <= first <= odometry(8).stamp


def test_latest_waits_for_a_message_and_hands_it_out_once(
    subscription: Subscription, odom: Publisher[Odometry]
) -> None:
    threading.Timer(0.1, odom.put, [odometry(3)]).start()
    message = subscription.latest(60.0)
    assert message is not None
    assert message.stamp == odometry(3).stamp
    assert subscription.latest(0.0) is None


def test_latest_gives_up_when_nothing_comes(subscription: Subscription) -> None:
    began = time.monotonic()
    assert subscription.latest(0.1) is None
    assert time.monotonic() - began >= 0.1


def test_the_fused_odometry_is_another_topic(loopback: Loopback) -> None:
    odom, fused = odom_publisher(loopback), odom_publisher(loopback, "odometry/filtered")
    with subscribe("apr02", topic="odometry/filtered", connect=loopback.address) as subscription:
        until(lambda: fused.matched, "the subscription")
        odom.put(odometry(1))
        fused.put(odometry(2, "map"))
        message = next_of(subscription)
    assert (message.frame, message.stamp) == ("map", odometry(2).stamp)


@pytest.mark.parametrize("profile", ["plain", "rmw", "humble"])
def test_every_profile_is_heard(loopback: Loopback, profile: Profile) -> None:
    odom = odom_publisher(loopback, profile=profile)
    with subscribe("apr02", connect=loopback.address, profile=profile) as subscription:
        until(lambda: odom.matched, "the subscription")
        odom.put(odometry(4))
        assert next_of(subscription).stamp == odometry(4).stamp


def test_a_message_that_cannot_be_decoded_is_counted_and_passed_over(
    lossless: Subscription, odom: Publisher[Odometry]
) -> None:
    joints = JOINT_STATE.encode(sample("joint_states"))
    for payload in (b"", b"garbage", joints):
        odom.put_encoded(payload)
    odom.put(odometry(1))
    assert next_of(lossless).stamp == odometry(1).stamp
    assert (lossless.received, lossless.undecodable) == (1, 3)


def test_a_callback_gets_every_message(loopback: Loopback, odom: Publisher[Odometry]) -> None:
    received: list[int] = []
    with subscribe(
        "apr02", connect=loopback.address, lossless=True, callback=lambda message: received.append(message.stamp)
    ) as subscription:
        until(lambda: odom.matched, "the subscription")
        for k in range(20):
            odom.put(odometry(k))
        until(lambda: len(received) == 20, "all messages")
        assert subscription.received == 20
    assert received == [odometry(k).stamp for k in range(20)]


def test_a_callback_that_raises_is_counted_logged_once_a_kind_and_goes_on(
    loopback: Loopback, odom: Publisher[Odometry], caplog: pytest.LogCaptureFixture
) -> None:
    calls: list[Odometry] = []

    def callback(message: Odometry) -> None:
        calls.append(message)
        raise KeyError("x") if len(calls) % 2 else ZeroDivisionError("y")

    with (
        caplog.at_level(logging.ERROR),
        subscribe("apr02", connect=loopback.address, lossless=True, callback=callback) as subscription,
    ):
        until(lambda: odom.matched, "the subscription")
        for k in range(10):
            odom.put(odometry(k))
        until(lambda: subscription.callback_errors == 10, "all messages")
    assert [record.getMessage() for record in caplog.records] == [
        "the callback raised; further KeyError are only counted",
        "the callback raised; further ZeroDivisionError are only counted",
    ]


def test_a_subscription_with_a_callback_is_not_iterated(loopback: Loopback) -> None:
    with (
        subscribe("apr02", connect=loopback.address, callback=lambda _: None) as subscription,
        pytest.raises(ConfigError, match="iterate over one without"),
    ):
        iter(subscription)


def test_closing_from_another_thread_ends_a_reader_that_waits(subscription: Subscription) -> None:
    threading.Timer(0.1, subscription.close).start()
    assert list(subscription) == []


def test_several_threads_may_close_at_once(loopback: Loopback) -> None:
    for _ in range(20):
        subscription = subscribe("apr02", connect=loopback.address)
        barrier = threading.Barrier(4)

        def close(subscription: Subscription = subscription, barrier: threading.Barrier = barrier) -> None:
            barrier.wait()
            subscription.close()

        with ThreadPoolExecutor(4) as threads:
            for done in [threads.submit(close) for _ in range(4)]:
                done.result(PATIENCE)


def test_closing_ends_who_waits_for_the_latest(subscription: Subscription) -> None:
    threading.Timer(0.1, subscription.close).start()
    began = time.monotonic()
    assert subscription.latest(120.0) is None
    assert time.monotonic() - began < 120.0


def test_a_callback_may_close_its_subscription(loopback: Loopback, odom: Publisher[Odometry]) -> None:
    closed = threading.Event()

    def callback(_: Odometry) -> None:
        own.close()
        closed.set()

    own = subscribe("apr02", connect=loopback.address, callback=callback)
    until(lambda: odom.matched, "the subscription")
    odom.put(odometry())
    assert closed.wait(PATIENCE)
    until(lambda: not odom.matched, "the subscription to go")
    own.close()


def test_a_session_that_was_handed_in_stays_open(loopback: Loopback) -> None:
    session = loopback.client()
    with subscribe("apr02", session=session):
        pass
    assert not session.is_closed()


def test_a_session_of_its_own_closes_with_it(loopback: Loopback, odom: Publisher[Odometry]) -> None:
    subscription = subscribe("apr02", connect=loopback.address)
    until(lambda: odom.matched, "the subscription")
    subscription.close()
    until(lambda: not odom.matched, "the subscription to go")
    assert subscription._session is not None
    assert subscription._session.is_closed()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"topic": "odm"}, "unknown odometry topic 'odm'; did you mean 'odom'"),
        ({"topic": "joint_states"}, "unknown odometry topic 'joint_states'"),
        ({"profile": "rmv"}, "unknown profile 'rmv'; did you mean 'rmw'"),
        ({"buffer": 0}, "buffer: expected a number of messages of at least 1"),
        ({"connect": "127.0.0.1:7447"}, "subscribing to apr02: connect.*protocol/host:port"),
    ],
)
def test_an_argument_that_cannot_be_is_one_line(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as refused:
        subscribe("apr02", **options)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("robot", ["", "apr02/odom", "*", "apr 02"])
def test_a_name_that_no_robot_can_have_is_one_line(robot: str) -> None:
    with pytest.raises(ConfigError, match="a robot's name is one word"):
        subscribe(robot)


def test_when_nothing_listens_there_the_line_says_so() -> None:
    port = free_port()
    with pytest.raises(ConfigError, match=str(port)):
        subscribe("apr02", connect=f"tcp/127.0.0.1:{port}")


WAITING_PROCESS = """
import sys
from omnibench.live.wire.subscriber import subscribe
with subscribe("apr02", connect=sys.argv[1]) as subscription:
    try:
        print("waits", flush=True)
        for message in subscription:
            pass
    except KeyboardInterrupt:
        print("interrupted", flush=True)
"""


def test_ctrl_c_ends_a_reader_that_waits_at_once(loopback: Loopback) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", WAITING_PROCESS, loopback.address], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "waits\n"
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=PATIENCE)[0] == "interrupted\n"
        assert process.returncode == 0
    finally:
        process.kill()
        process.communicate()


def test_messages_that_never_came_are_counted_and_told(
    lossless: Subscription, odom: Publisher[Odometry], caplog: pytest.LogCaptureFixture
) -> None:
    odom.put(odometry(0))
    odom.next_number()  # of a message that is lost
    odom.put(odometry(2))
    assert [message.stamp for message in taken(lossless, 2)] == [odometry(k).stamp for k in (0, 2)]
    assert lossless.missed == 1
    assert "1 message of apr02/odom lost on the way" in caplog.text
