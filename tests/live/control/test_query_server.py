"""What a node answers and which orders it takes, with real sessions."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from drives import ORIGIN, SECOND, calibration, drive
from nodes import Command, as_text, asked, config_of, running, sent, sent_one_by_one, write_node
from received_messages import ReceivedMessages
from sessions import Loopback, raw_session, until
from timing import PATIENCE

from omnibench.errors import DataError
from omnibench.live.control.query_server import QueryServer
from omnibench.live.control.request_queue import MOST_WAITING, Request, RequestQueue, source_of
from omnibench.live.control.swap import swap_calibration
from omnibench.live.estimation.tracker import RobotTracker
from omnibench.live.network.presence import alive_robots
from omnibench.live.wire.messages import ODOMETRY
from omnibench.robot.calibration import write_calibration

EVERY_REPLY = zenoh.QueryConsolidation(zenoh.ConsolidationMode.NONE)


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A node that has taken a drive of a second."""
    path = drive(1.0)
    with running(config_of(tmp_path_factory.mktemp("driven"))) as (node, session):
        wheels = session.declare_publisher("apr/joint_states")
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        sent(wheels, path.samples())
        until(lambda: node.health("apr").counts["samples"] == 101, "the samples")
        yield node, session, path


def test_info_says_what_runs_and_where_its_topics_are(driven: Any) -> None:
    answer = asked(driven[1], "omnibench/apr/info")
    assert answer["calibration"] == "synthetic 1"
    assert answer["topics"]["odom"] == "apr/odom"
    assert answer["wheels"] == ["a", "b", "c"]


def test_health_tells_the_counters(driven: Any) -> None:
    answer = asked(driven[1], "omnibench/apr/health")
    assert answer["counts"]["samples"] == 101
    assert answer["status"] in ("degraded", "stale")


def test_the_calibration_is_given_as_it_runs(driven: Any) -> None:
    assert asked(driven[1], "omnibench/apr/calibration")["matrix"][0] == list(calibration().matrix[0])


@pytest.mark.parametrize("form", ["{0}.505", "{0}505000000"])
def test_the_pose_at_a_time_is_interpolated(driven: Any, form: str) -> None:
    _, session, path = driven
    answer = asked(session, "omnibench/apr/pose?at=" + form.format(ORIGIN // SECOND))
    assert answer["at_ns"] == ORIGIN + 505_000_000
    assert answer["odom"]["theta"] == pytest.approx(path.poses[50:52, 2].mean(), abs=1e-9)


@pytest.mark.parametrize(
    ("selector", "payload", "message"),
    [
        ("pose?at=yesterday", None, "at: 'yesterday' is not a time"),
        *((f"pose?at={number}", None, "is not a time") for number in ("1e400", "1e3000000", "1e19", "-1e19")),
        *((f"pose?at={number}", None, "is not a time") for number in ("nan", "snan", "-inf", "")),
        ("pose?at=" + "7" * 5000, None, "777...' is not a time"),
        ("pose?at=12", None, "at: 12.000000 s is not within"),
        ("set_pose", '{"x": 1}', "set_pose: keys 'y' and 'theta' are missing"),
        ("set_pose", '{"x": 1, "y": 2, "theta": 3, "z": 4}', "set_pose: unknown key 'z'"),
        ("set_pose", b"\xff\xfe", "the payload is not text"),
        ("calibration", "format: something", "put it there, or ask omnibench/apr/swap"),
        ("swap", "format: something", "format is 'something', expected 'omnibench-calibration/1'"),
        ("swap", "{", "not valid YAML"),
        ("swap", b"\xff\xfe", "not a text in UTF-8"),
        ("swap", "[" * 50_000, "exceeded maximum nesting depth"),
        ("swap", "- " * 30_000, "nested too deeply"),
        ("swap", "a: [" + "1, " * 20_000 + "1]", "more than 5000 values"),
        ("swap", "a: &a [1, 1]\nb: &b [*a, *a]\nc: [*b, *b]", "write out what *a stands for"),
        ("swap", as_text(calibration()).replace("session: null", r'session: "\ud800"'), "invalid Unicode character"),
        ("swap", "#" * 140_000, "140000 bytes are more than a request may have, 131072"),
        ("swap", "#" * 10_000_000, "10000000 bytes are more than a request may have, 131072"),
        ("health?" + "x" * 140_000, None, "140000 bytes are more than a request may have"),
    ],
)
def test_a_bad_order_is_refused_with_the_reason(driven: Any, selector: str, payload: Any, message: str) -> None:
    answer = asked(driven[1], f"omnibench/apr/{selector}", payload)
    assert message in answer["error"]


def test_a_pose_can_be_set_and_reset(driven: Any) -> None:
    _, session, _ = driven
    assert asked(session, "omnibench/apr/set_pose", json.dumps({"x": 3, "y": 4, "theta": 1}))["done"] == "set_pose"
    answer = asked(session, "omnibench/apr/pose")
    assert (answer["map"]["x"], answer["map"]["y"], answer["map"]["theta"]) == (3, 4, 1)
    assert asked(session, "omnibench/apr/reset")["done"] == "reset"
    assert not asked(session, "omnibench/apr/health")["fusion"]["located"]


@pytest.mark.parametrize("order", ["reset", "swap", "set_pose"])
@pytest.mark.parametrize("robot", ["*", "a$*", "**"])
def test_a_wildcard_orders_nobody(driven: Any, robot: str, order: str) -> None:
    node, session, _ = driven
    before = node.health("apr").counts
    assert list(session.get(f"omnibench/{robot}/{order}", payload="{x: 1, y: 2, theta: 3}", timeout=2.0)) == []
    assert node.health("apr").counts == before


@pytest.mark.parametrize(
    ("selector", "answers"), [("*/health", 10), ("*/*", 40), ("**", 40), ("r1/*", 4), ("r1/info", 1), ("*/reset", 0)]
)
def test_each_robot_and_service_that_a_question_is_for_answers_it_once(
    tmp_path: Path, selector: str, answers: int
) -> None:
    names = [f"r{number}" for number in range(10)]
    with running(config_of(tmp_path, *names, fusion="none")) as (_, session):
        replies = list(session.get(f"omnibench/{selector}", consolidation=EVERY_REPLY, timeout=PATIENCE))
    assert len(replies) == answers
    keys = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
    assert len(set(keys)) == len(keys)


def test_a_failure_of_its_own_is_answered_in_one_line_and_logged(
    loopback: Loopback, caplog: pytest.LogCaptureFixture
) -> None:
    def failing(_: RobotTracker) -> dict[str, Any]:
        raise RuntimeError("a bug\nof two lines")

    query_server = QueryServer(loopback.client(), {"apr": RobotTracker("apr", calibration())}, failing, {})
    session = loopback.client()
    until(lambda: list(session.get("omnibench/apr/health", timeout=1.0)), "the query server")
    answer = asked(session, "omnibench/apr/info")
    again = asked(session, "omnibench/apr/health")
    query_server.close()
    assert answer["error"] == "omnibench/apr/info: RuntimeError: a bug of two lines"
    assert again["status"] == "waiting"
    assert "a request failed: RuntimeError: a bug of two lines" in caplog.text


def test_more_requests_than_the_server_holds_are_refused_and_the_stream_goes_on(tmp_path: Path) -> None:
    path = drive(1.0)
    with running(config_of(tmp_path, "apr", "bob")) as (node, session):
        received = ReceivedMessages(session, bob__odom=ODOMETRY)
        wheels = session.declare_publisher("bob/joint_states")
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        with node.trackers["apr"]._state_lock:  # the query server is held up by the first
            waiting = [session.get("omnibench/apr/health", timeout=PATIENCE) for _ in range(200)]
            sent_one_by_one(wheels, path.samples(), received["bob__odom"])
        replies = [reply for each in waiting for reply in each]
    refused = [json.loads(reply.err.payload.to_bytes())["error"] for reply in replies if reply.err is not None]
    assert len(replies) == 200
    assert 200 - 2 * 64 <= len(refused) < 200 - 64  # 64 wait, and as many may be under way
    assert set(refused) == {"omnibench/apr/health: 64 requests are waiting; ask again later"}


_FLOODER = """
import sys, zenoh
from sessions import raw_session
session, replies = raw_session("client", connect=[sys.argv[1]]), []
def take(reply):
    if reply.ok is not None and not replies:
        replies.append(reply)
        print("answered", flush=True)
while True:
    session.get("omnibench/apr/" + sys.argv[2], zenoh.handlers.Callback(take, indirect=False), timeout=5.0)
"""


@pytest.mark.parametrize("flooded", ["health", "info"])
def test_a_flood_of_questions_gets_its_share_and_others_get_answers_meanwhile(tmp_path: Path, flooded: str) -> None:
    with Command("live", write_node(tmp_path, "apr", "bob")) as node:
        until(lambda: "Ctrl-C ends it" in node.said(), "the node")
        endpoint = next(word for word in node.said().split() if word.startswith("tcp/")).rstrip(";")
        flooder = subprocess.Popen(
            [sys.executable, "-c", _FLOODER, endpoint, flooded],
            env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
            stdout=subprocess.PIPE,
            text=True,
        )
        session = raw_session("client", connect=[endpoint])
        try:
            assert flooder.stdout is not None
            assert flooder.stdout.readline() == "answered\n"
            until(lambda: "requests refused so far" in node.said(), "so many questions that some are refused")
            for _ in range(30):
                # one who says who asks has a turn of its own; who does not has it for other robots and services
                named = list(session.get(f"omnibench/apr/{flooded}", timeout=PATIENCE, source_info=source_of(session)))
                assert [reply.ok is not None for reply in named] == [True]
                assert asked(session, "omnibench/bob/health")["status"] == "waiting"
            assert flooder.poll() is None
        finally:
            flooder.kill()
            flooder.communicate()
            session.close()


def request(client: str, refused: list[str]) -> Request:
    return Request(client, lambda: None, lambda _: refused.append(client))


def test_clients_are_served_in_turn_and_who_has_most_requests_waiting_gives_way() -> None:
    requests = RequestQueue()
    flood = [request("flooder", []) for _ in range(MOST_WAITING)]
    assert [requests.put(each) for each in flood] == [None] * MOST_WAITING
    assert requests.put(late := request("flooder", [])) is late
    assert requests.put(other := request("other", [])) is flood[-1]
    assert requests.put(second := request("other", [])) is flood[-2]
    taken = requests.take()
    assert taken[:4] == [flood[0], other, flood[1], second]
    assert len(taken) == MOST_WAITING


def test_strangers_with_a_new_name_each_time_take_nobodys_place() -> None:
    requests = RequestQueue()
    honest = request("honest", [])
    requests.put(honest)
    refused = [requests.put(request(f"name {number}", [])) for number in range(2 * MOST_WAITING)]
    assert honest not in refused
    assert honest in requests.take()


def test_a_closed_queue_gives_out_what_waits_and_takes_no_more() -> None:
    requests = RequestQueue()
    requests.put(before := request("a", []))
    requests.close()
    assert requests.put(late := request("a", [])) is late
    assert requests.take() == [before]
    assert requests.take() == []


def test_a_file_that_is_no_calibration_by_its_size_is_not_sent(loopback: Loopback, tmp_path: Path) -> None:
    file = tmp_path / "recording.yaml"
    file.write_bytes(b"- 1\n" * 2_500_000)
    with pytest.raises(DataError, match="has 10,000,000 bytes, more than the 131,072 that"):
        swap_calibration(loopback.client(), "apr", file)


def test_a_swap_that_nobody_answers_names_access_rights_as_a_possible_cause(loopback: Loopback, tmp_path: Path) -> None:
    token = loopback.router.liveliness().declare_token("omnibench/apr/alive")
    queryable = loopback.router.declare_queryable("omnibench/apr/swap", lambda _: None)
    write_calibration(calibration(), tmp_path / "calibration.yaml")
    session = loopback.client()
    until(lambda: alive_robots(session) == ("apr",), "the token")
    with pytest.raises(DataError, match="the `access` of its router may not let us swap, which only operators may"):
        swap_calibration(session, "apr", tmp_path / "calibration.yaml", timeout=0.2)
    queryable.undeclare()
    token.undeclare()


def test_a_calibration_that_is_put_runs_from_the_next_sample_on_and_odom_does_not_jump(tmp_path: Path) -> None:
    path, other = drive(1.0), calibration(scale=1.2)
    with running(config_of(tmp_path)) as (node, session):
        received = ReceivedMessages(session, apr__odom=ODOMETRY)
        wheels = session.declare_publisher("apr/joint_states")
        until(lambda: wheels.matching_status.matching, "the node's subscription")
        sent_one_by_one(wheels, path.samples()[:51], received["apr__odom"])
        session.put("omnibench/apr/calibration", as_text(other))
        until(lambda: node.health("apr").counts["swaps"] == 1, "the swap")
        sent_one_by_one(wheels, path.samples()[51:], received["apr__odom"])
    poses = np.array([each.pose for each in received["apr__odom"]])
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    before = np.linalg.norm(np.diff(path.poses[:, :2], axis=0), axis=1)
    np.testing.assert_allclose(steps[:50], before[:50], atol=1e-9)
    np.testing.assert_allclose(steps[50:], 1.2 * before[50:], rtol=1e-3)


def test_a_bad_calibration_that_is_put_is_refused_and_stands_in_health(tmp_path: Path) -> None:
    with running(config_of(tmp_path)) as (node, session):
        session.put("omnibench/apr/calibration", as_text(calibration(wheels=4)))
        until(lambda: node.health("apr").counts["swaps_refused"] == 1, "the refusal")
        swap = asked(session, "omnibench/apr/health")["last_swap"]
        assert not swap["accepted"]
        assert "is for wheels fl, fr, rl, rr, this robot has a, b, c" in swap["reason"]
        assert asked(session, "omnibench/apr/info")["calibration"] == "synthetic 1"


def test_a_flood_of_bad_calibrations_does_not_flood_the_log(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with running(config_of(tmp_path)) as (node, session):
        for _ in range(20):
            session.put("omnibench/apr/calibration", "format: something")
        until(lambda: node.health("apr").counts["swaps_refused"] == 20, "the refusals")
    assert caplog.text.count("apr: calibration refused, synthetic 1 runs on: ") == 1


def test_a_calibration_too_long_to_be_put_is_refused_and_stands_in_health(tmp_path: Path) -> None:
    with running(config_of(tmp_path)) as (node, session):
        session.put("omnibench/apr/calibration", "#" * 140_000)
        until(lambda: node.health("apr").counts["swaps_refused"] == 1, "the refusal")
        swap = node.health("apr").last_swap
    assert swap is not None
    assert swap.reason == "omnibench/apr/calibration: 140000 bytes are more than a request may have, 131072"


def test_a_swap_is_kept_although_the_configs_file_went_elsewhere(tmp_path: Path) -> None:
    config = config_of(tmp_path, state="state")
    file = tmp_path / "calibration.yaml"
    with running(config) as (_, session):
        file.rename(tmp_path / "old.yaml")
        answer = asked(session, "omnibench/apr/swap", as_text(calibration(scale=1.1)))
        assert answer == {"robot": "apr", "accepted": True, "calibration": "synthetic 1.1", "kept": True}
    (tmp_path / "old.yaml").rename(file)
    with running(config) as (_, session):
        assert asked(session, "omnibench/apr/info")["calibration"] == "synthetic 1.1"


def test_a_swap_that_the_disk_refuses_runs_and_says_that_it_is_not_kept(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with running(config_of(tmp_path, state="state")) as (node, session):
        (tmp_path / "state" / "apr.calibration.yaml").mkdir()
        answer = asked(session, "omnibench/apr/swap", as_text(calibration(scale=1.1)))
        assert node.trackers["apr"].calibration.name == "synthetic 1.1"
    assert answer["accepted"]
    assert not answer["kept"]
    assert "apr.calibration.yaml: cannot be written: is a folder" in answer["reason"]
    assert "apr: calibration 'synthetic 1.1' runs, but not after a restart: " in caplog.text


def test_without_a_state_a_swap_says_that_it_is_not_kept(tmp_path: Path) -> None:
    with running(config_of(tmp_path)) as (_, session):
        answer = asked(session, "omnibench/apr/swap", as_text(calibration(scale=1.1)))
    assert answer["accepted"]
    assert not answer["kept"]
    assert "the node has no `state`" in answer["reason"]
