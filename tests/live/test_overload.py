"""A node that cannot keep up: no sample is lost to the path, the newest pose is published, and it is said."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import zenoh
from drives import drive
from nodes import config_of, running
from received_messages import ReceivedMessages
from sessions import until

from omnibench.live.estimation.health import Health
from omnibench.live.wire.messages import JOINT_STATE, ODOMETRY, Odometry, packed

SAMPLES = 60


def sent_while_the_intake_waits(
    tmp_path: Path, attachments: list[bytes | None], period: float
) -> tuple[list[Odometry], Health, Health]:
    """Odometry of samples, one for each attachment, all but the first of which wait for the last.

    And the health, while they wait and afterwards.
    """
    path = drive(2.0)
    with running(config_of(tmp_path)) as (node, session):
        heard = ReceivedMessages(session, apr__odom=ODOMETRY)
        service = node._services[0]
        wheels = session.declare_publisher("apr/joint_states", congestion_control=zenoh.CongestionControl.BLOCK)
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        samples, last = path.samples(), len(attachments) - 1
        wheels.put(JOINT_STATE.encode(samples[0]), attachment=attachments[0])
        until(lambda: heard["apr__odom"], "the first odometry")
        with service._working:  # as if the machine had no time for it
            for sample, attachment in zip(samples[1:], attachments[1:], strict=False):
                wheels.put(JOINT_STATE.encode(sample), attachment=attachment)
                time.sleep(period)
            until(lambda: len(service._waiting) == last, "all samples in the queue")
            time.sleep(0.15)  # all of them are late now
            meanwhile = node.health("apr")
        until(lambda: heard["apr__odom"][-1].stamp == path.stamps[last], "the newest odometry")
        health = node.health("apr")
        np.testing.assert_allclose(heard["apr__odom"][-1].pose, path.poses[last], atol=1e-9)
        return list(heard["apr__odom"]), meanwhile, health


def test_late_samples_are_all_integrated_and_only_the_newest_pose_is_published(tmp_path: Path) -> None:
    odometry, meanwhile, health = sent_while_the_intake_waits(tmp_path, [None] * SAMPLES, 0.01)
    assert len(odometry) < SAMPLES / 2
    assert health.counts["samples"] == SAMPLES
    assert health.counts["unpublished"] == SAMPLES - len(odometry)
    for each in (meanwhile, health):  # not "stale" while samples wait
        assert each.status == "degraded"
        assert each.message.startswith("behind by ")
        assert each.behind_s > 0.7


def test_samples_of_a_replay_are_all_published_however_late(tmp_path: Path) -> None:
    odometry, _, health = sent_while_the_intake_waits(tmp_path, [None] * SAMPLES * 3, 0.0)
    assert len(odometry) == 3 * SAMPLES
    assert health.counts["unpublished"] == 0


def test_samples_whose_sender_waits_are_all_published_and_are_no_backlog(tmp_path: Path) -> None:
    flow = [packed(number + 1, bytes(16), (1, number, 0, False)) for number in range(SAMPLES)]
    odometry, _, health = sent_while_the_intake_waits(tmp_path, flow, 0.01)
    assert len(odometry) == SAMPLES
    assert (health.counts["unpublished"], health.behind_s) == (0, 0.0)


def test_what_came_when_too_many_waited_is_counted(tmp_path: Path) -> None:
    path = drive(210.0, period=0.01)
    payloads = path.payloads()
    with running(config_of(tmp_path)) as (node, session):
        service = node._services[0]
        wheels = session.declare_publisher("apr/joint_states", congestion_control=zenoh.CongestionControl.BLOCK)
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        with service._working:
            for payload in payloads[:20_100]:
                wheels.put(payload)
            until(lambda: node.health("apr").counts["overflow"] == 100, "the samples that had no place")
        until(lambda: node.health("apr").counts["samples"] == 20_000, "the others")


def test_large_messages_that_wait_are_bounded_by_their_bytes(tmp_path: Path) -> None:
    half_megabyte = bytes(500_000)
    with running(config_of(tmp_path)) as (node, session):
        service = node._services[0]
        wheels = session.declare_publisher("apr/joint_states", congestion_control=zenoh.CongestionControl.BLOCK)
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        with service._working:
            for _ in range(100):
                wheels.put(half_megabyte)
            until(lambda: node.health("apr").counts["overflow"] == 36, "the messages that had no place")
        until(lambda: node.health("apr").counts["undecodable"] == 64, "the messages that had")
        wheels.put(JOINT_STATE.encode(drive(1.0).samples()[0]))  # and there is room again
        until(lambda: node.health("apr").counts["samples"] == 1, "a sample")
