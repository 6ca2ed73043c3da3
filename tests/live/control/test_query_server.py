"""What a node answers and which orders it takes, with real sessions, and requests made to exhaust it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from drives import ORIGIN, SECOND, calibration, drive
from nodes import (
    Command,
    ReceivedMessages,
    asked,
    config_of,
    peak_memory,
    running,
    sent,
    sent_one_by_one,
    wheels_of,
    write_node,
)
from sessions import Loopback, free_port, raw_session, until
from timing import PATIENCE

from omnibench.config import to_yaml
from omnibench.errors import DataError
from omnibench.live.control.query_server import (
    MOST_WAITING,
    QueryServer,
    Request,
    RequestQueue,
    source_of,
    swap_calibration,
)
from omnibench.live.estimation.tracker import RobotTracker
from omnibench.live.network.presence import alive_robots
from omnibench.live.wire.messages import JOINT_STATE, ODOMETRY
from omnibench.robot.calibration import write_calibration

EVERY_REPLY = zenoh.QueryConsolidation(zenoh.ConsolidationMode.NONE)


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A node that has taken a drive of a second."""
    path = drive(1.0)
    with running(config_of(tmp_path_factory.mktemp("driven"))) as (node, session):
        wheels = wheels_of(session)
        sent(wheels, path.samples())
        until(lambda: node.health("apr").counts["samples"] == 101, "the samples")
        yield node, session, path


def test_info_health_and_calibration_say_what_runs(driven: Any) -> None:
    info, health, given = (asked(driven[1], f"omnibench/apr/{each}") for each in ("info", "health", "calibration"))
    assert (info["calibration"], info["wheels"]) == ("synthetic 1", ["a", "b", "c"])
    assert info["topics"]["odom"] == "apr/odom"
    assert health["counts"]["samples"] == 101
    assert health["status"] in ("degraded", "stale")
    assert given["matrix"][0] == list(calibration().matrix[0])


@pytest.mark.parametrize("form", ["{0}.505", "{0}505000000"])
def test_the_pose_at_a_time_is_interpolated(driven: Any, form: str) -> None:
    _, session, path = driven
    answer = asked(session, "omnibench/apr/pose?at=" + form.format(ORIGIN // SECOND))
    assert answer["at_ns"] == ORIGIN + 505_000_000
    assert answer["odom"]["theta"] == pytest.approx(path.poses[50:52, 2].mean(), abs=1e-9)


@pytest.mark.parametrize(
    ("selector", "payload", "named"),
    [
        ("pose?at=yesterday", None, "'yesterday' is not a time"),
        *((f"pose?at={number}", None, "is not a time") for number in ("1e400", "1e3000000", "1e19", "-1e19")),
        *((f"pose?at={number}", None, "is not a time") for number in ("nan", "snan", "-inf", "")),
        ("pose?at=" + "7" * 5000, None, "777...' is not a time"),
        ("pose?at=12", None, "at: 12.000000 s"),
        ("set_pose", '{"x": 1}', "'y' and 'theta'"),
        ("set_pose", '{"x": 1, "y": 2, "theta": 3, "z": 4}', "'z'"),
        ("set_pose", b"\xff\xfe", "not text"),
        ("calibration", "format: something", "omnibench/apr/swap"),
        ("swap", "format: something", "'omnibench-calibration/1'"),
        ("swap", "{", "not valid YAML"),
        ("swap", b"\xff\xfe", "UTF-8"),
        ("swap", "[" * 50_000, "nesting"),
        ("swap", "- " * 30_000, "nested too deeply"),
        ("swap", "a: [" + "1, " * 20_000 + "1]", "5000 values"),
        ("swap", "a: &a [1, 1]\nb: &b [*a, *a]\nc: [*b, *b]", "*a"),
        ("swap", to_yaml(calibration()).replace("session: null", r'session: "\ud800"'), "Unicode"),
        ("swap", "#" * 140_000, "140000 bytes"),
        ("swap", "#" * 10_000_000, "10000000 bytes"),
        ("health?" + "x" * 140_000, None, "140000 bytes"),
    ],
)
def test_a_bad_order_is_refused_with_the_reason(driven: Any, selector: str, payload: Any, named: str) -> None:
    assert named in asked(driven[1], f"omnibench/apr/{selector}", payload)["error"]


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


def test_each_robot_and_service_that_a_question_is_for_answers_it_once(tmp_path: Path) -> None:
    names = [f"r{number}" for number in range(10)]
    answers = {"*/health": 10, "*/*": 40, "**": 40, "r1/*": 4, "r1/info": 1, "*/reset": 0}
    with running(config_of(tmp_path, *names, fusion="none")) as (_, session):
        for selector, expected in answers.items():
            replies = list(session.get(f"omnibench/{selector}", consolidation=EVERY_REPLY, timeout=PATIENCE))
            keys = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
            assert len(replies) == expected, selector
            assert len(set(keys)) == len(keys)


def test_a_failure_of_its_own_is_one_line_and_logged(loopback: Loopback, caplog: pytest.LogCaptureFixture) -> None:
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
        wheels = wheels_of(session, "bob")
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


@pytest.mark.slow
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
    with pytest.raises(DataError, match="10,000,000 bytes"):
        swap_calibration(loopback.client(), "apr", file)


def test_a_swap_that_nobody_answers_names_access_rights_as_a_possible_cause(loopback: Loopback, tmp_path: Path) -> None:
    token = loopback.router.liveliness().declare_token("omnibench/apr/alive")
    queryable = loopback.router.declare_queryable("omnibench/apr/swap", lambda _: None)
    write_calibration(calibration(), tmp_path / "calibration.yaml")
    session = loopback.client()
    until(lambda: alive_robots(session) == ("apr",), "the token")
    with pytest.raises(DataError, match="`access`"):
        swap_calibration(session, "apr", tmp_path / "calibration.yaml", timeout=0.2)
    queryable.undeclare()
    token.undeclare()


def test_a_calibration_that_is_put_runs(tmp_path: Path) -> None:
    with running(config_of(tmp_path)) as (node, session):
        session.put("omnibench/apr/calibration", to_yaml(calibration(scale=1.2)))
        until(lambda: node.health("apr").counts["swaps"] == 1, "the swap")
        assert asked(session, "omnibench/apr/info")["calibration"] == "synthetic 1.2"


@pytest.mark.parametrize(
    ("put", "named"),
    [
        (to_yaml(calibration(wheels=4)), "fl, fr, rl, rr"),
        ("#" * 140_000, "140000 bytes"),
        ("format: something", "format"),
    ],
    ids=["another robot", "too long", "no calibration"],
)
def test_refused_swaps_stand_in_health(tmp_path: Path, caplog: pytest.LogCaptureFixture, put: str, named: str) -> None:
    with running(config_of(tmp_path)) as (node, session):
        for _ in range(10):
            session.put("omnibench/apr/calibration", put)
        until(lambda: node.health("apr").counts["swaps_refused"] == 10, "the refusals")
        swap = asked(session, "omnibench/apr/health")["last_swap"]
        assert not swap["accepted"]
        assert named in swap["reason"]
        assert asked(session, "omnibench/apr/info")["calibration"] == "synthetic 1"
    assert len([each for each in caplog.messages if "refused" in each]) == 1


@pytest.mark.parametrize(("state", "named"), [("state", "apr.calibration.yaml"), (None, "no `state`")])
def test_a_lost_swap_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture, state: str | None, named: str) -> None:
    with running(config_of(tmp_path, state=state)) as (node, session):
        (tmp_path / "state" / "apr.calibration.yaml").mkdir(parents=True)
        answer = asked(session, "omnibench/apr/swap", to_yaml(calibration(scale=1.1)))
        assert node.trackers["apr"].calibration.name == "synthetic 1.1"
    assert (answer["accepted"], answer["kept"]) == (True, False)
    assert named in answer["reason"]
    assert ("'synthetic 1.1' runs, but not after a restart" in caplog.text) == (state is not None)


# Eight levels of aliases, nine values each, stand for 10^8; libyaml does not take this directive, Python's parser did.
_LEVELS = " ".join(f"&a{level} [{', '.join([f'*a{level - 1}'] * 9)}]," for level in range(1, 9))
BOMB = f"%YAML 1.3\n---\nx: [&a0 [1, 1, 1, 1, 1, 1, 1, 1, 1], {_LEVELS}]\ny: 0\ntheta: 0\n"
_SECONDS = 1.0  # on a busy machine; such a request took 22 s and more


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[int, zenoh.Session, list[float]]]:
    """The process of a node that takes samples at 100 Hz, a client's session, and when its odometry arrived."""
    port, arrivals, over = free_port(), list[float](), threading.Event()
    file = write_node(tmp_path_factory.mktemp("node"), "apr", port=port)
    with Command("live", file) as command:
        until(lambda: "apr" in command.said(), "the node's start")
        session = raw_session("client", connect=[f"tcp/127.0.0.1:{port}"])
        asked(session, "omnibench/apr/info")
        subscriber = session.declare_subscriber("apr/odom", lambda _: arrivals.append(time.monotonic()))
        publisher = session.declare_publisher("apr/joint_states")

        def drives() -> None:
            for sample in drive(60.0).samples():
                publisher.put(JOINT_STATE.encode(sample))
                if over.wait(0.01):
                    return

        driving = threading.Thread(target=drives)
        driving.start()
        until(lambda: len(arrivals) > 50, "odometry")
        yield command.process.pid, session, arrivals
        over.set()
        driving.join()
        subscriber.undeclare()
        session.close()


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="memory is read from /proc")
@pytest.mark.parametrize("service", ["set_pose", "swap"])
@pytest.mark.parametrize("payload", [BOMB, BOMB.partition("---\n")[2]], ids=["with a directive", "plain"])
def test_a_node_refuses_a_bomb_and_goes_on(node: Any, service: str, payload: str) -> None:
    process, session, arrivals = node
    memory, count, began = peak_memory(process), len(arrivals), time.monotonic()
    answer = asked(session, f"omnibench/apr/{service}", payload)
    refused = time.monotonic()
    until(lambda: len(arrivals) > count + 50, "odometry after the request")
    assert "not valid YAML" in answer["error"]
    assert refused - began < _SECONDS
    gaps = np.diff(arrivals[count - 1 :])
    assert max(gaps) < _SECONDS
    assert peak_memory(process) - memory < 20
