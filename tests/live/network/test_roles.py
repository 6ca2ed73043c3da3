"""Every role's rights on every topic and service, over real TLS sessions with a real node, as the handbook's table."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import zenoh
from nodes import Command, write_node
from recordings import random_dataset
from sessions import free_port, until

from omnibench.cli.handbook_topics import find_topic
from omnibench.live.network.session import open_session
from omnibench.live.network.session_config import SessionConfig, Tls
from omnibench.live.replay.concatenated_drive import ReplayConfig, concatenate_runs
from omnibench.live.replay.replay_player import Player
from omnibench.live.wire.topics import GraphNode, KeySpace

ROBOTS = ("apr02", "apr03")
ROLES = {"robot": "apr02", "viewer": "viewer", "operator": "operator", "node": "remote", "stranger": "stranger"}
ACCESS = {
    "robots": ["apr02", "apr03"],
    "viewers": ["viewer"],
    "operators": ["operator"],
    "nodes": ["remote"],
    "rules": [{"who": list(ROLES.values()), "write": "barrier/**", "read": "barrier/**"}],
}
TOPICS = ("joint_states", "slam_pose", "odom", "odometry/filtered", "diagnostics", "tf")
SERVICES = ("info", "health", "pose", "calibration", "set_pose", "reset", "swap")
BLOCK = zenoh.CongestionControl.BLOCK
Right = tuple[str, str, str]  # verb, robot, topic or service


def rights_in_the_handbook(role: str) -> set[Right]:
    """The rights of a role by the table of the handbook's page about the live node."""
    rights: set[Right] = set()
    rows = [line.strip("|").split("|") for line in find_topic("live").text.splitlines() if line.startswith("|")]
    columns: list[str] = []
    for name, *cells in rows:
        if "robot" in (heads := [cell.strip() for cell in cells]):
            columns = heads
        elif role in columns and len(cells) == len(columns):
            cell = cells[columns.index(role)]
            robots = ROBOTS[:1] if "its own" in cell else ROBOTS
            for verb in re.findall("writes|reads|asks|answers|puts|takes|sees|declares", cell):
                rights |= {(verb, robot, key) for key in re.findall("`(.*?)`", name) for robot in robots}
    return rights


def keys_of(robot: str, topic: str) -> list[str]:
    """A topic's key for plain Zenoh, and as rmw_zenoh has it."""
    name = topic if topic == "tf" else f"{robot}/{topic}"
    return [name, f"0/{name}/a::msg::dds_::Type_/RIHS01_0"]


@pytest.fixture(scope="module")
def router(keys: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The endpoint of ``omnibench live`` with two robots and the fleet's rules."""
    endpoint = f"tls/127.0.0.1:{free_port()}"
    tls = {"ca": str(keys / "ca.pem"), "certificate": str(keys / "node.pem"), "key": str(keys / "node.key")}
    zenoh_config = {"listen": endpoint, "tls": tls, "access": ACCESS}
    config = write_node(tmp_path_factory.mktemp("fleet"), *ROBOTS, zenoh=zenoh_config)
    with Command("live", config) as node:
        until(lambda: "Ctrl-C ends it" in node.said(), "the node")
        yield endpoint


def session_of(name: str, router: str, keys: Path) -> zenoh.Session:
    tls = Tls(ca=keys / "ca.pem", certificate=keys / f"{name}.pem", key=keys / f"{name}.key")
    return open_session(SessionConfig(mode="client", connect=(router,), tls=tls), name)


class Heard:
    """What a session receives by subscription, by key."""

    def __init__(self, session: zenoh.Session, *keys: str) -> None:
        self.payloads: dict[str, set[bytes]] = {key: set() for key in keys}
        self._subscribers = [session.declare_subscriber(key, self._callback(key)) for key in keys]

    def _callback(self, key: str) -> Any:
        return zenoh.handlers.Callback(lambda sample: self.payloads[key].add(bytes(sample.payload)), indirect=False)


def answers_to(session: zenoh.Session, selector: str, replies: list[bytes]) -> None:
    """Ask all who answer, and add their answers and refusals to ``replies``."""

    def take(reply: zenoh.Reply) -> None:
        answer = reply.ok if reply.ok is not None else reply.err
        if answer is not None:
            replies.append(bytes(answer.payload))

    session.get(
        selector,
        zenoh.handlers.Callback(take, indirect=False),
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.QueryConsolidation(zenoh.ConsolidationMode.NONE),
        payload=b"[",
        timeout=60.0,
    )


@pytest.mark.parametrize("role", ROLES)
def test_every_role_has_the_rights_that_the_handbook_says_and_no_others(role: str, router: str, keys: Path) -> None:
    rights: set[Right] = set()
    topics = [(robot, topic, key) for robot in ROBOTS for topic in TOPICS for key in keys_of(robot, topic)]
    topics += [(robot, "received", f"omnibench/{robot}/received/0") for robot in ROBOTS]
    services = [(robot, name, f"omnibench/{robot}/{name}") for robot in ROBOTS for name in SERVICES]
    tokens = [(robot, "alive", f"omnibench/{robot}/alive") for robot in ROBOTS]
    calibrations = [each for each in services if each[1] == "calibration"]
    both = [key for _, _, key in topics + calibrations]
    name = ROLES[role]
    with ExitStack() as stack:
        witness = stack.enter_context(session_of("node", router, keys))  # who has the router's key may do everything
        member = stack.enter_context(session_of(name, router, keys))
        seen, barrier = Heard(witness, *both), Heard(witness, "barrier/to_witness")
        heard, echo = Heard(member, *both), Heard(member, "barrier/to_member")

        def passed(sender: zenoh.Session, key: str, receiver: Heard) -> None:
            """Wait until all that ``sender`` has sent before has come to the router, and from there to the other."""
            before = f"{len(receiver.payloads[key])}".encode()
            until(lambda: sender.put(key, before, congestion_control=BLOCK) or before in receiver.payloads[key], key)

        passed(witness, "barrier/to_member", echo)
        passed(member, "barrier/to_witness", barrier)
        # the member tries everything
        asked: dict[str, list[bytes]] = {key: [] for _, _, key in services}
        for _, _, key in services:
            answers_to(member, key, asked[key])
        for key in both:
            member.put(key, b"member", congestion_control=BLOCK)
        alive: dict[str, list[bytes]] = {key: [] for _, _, key in tokens}
        for _, _, key in tokens:
            take = zenoh.handlers.Callback(lambda _, key=key: alive[key].append(b"alive"), indirect=False)
            member.liveliness().get(key, take, timeout=60.0)
        passed(member, "barrier/to_witness", barrier)
        forger = stack.enter_context(session_of(name, router, keys))  # its answers are not to come back to the member
        for _, _, key in services:
            forger.declare_queryable(key, lambda query: query.reply(query.key_expr, b"member"))
        forged = [forger.liveliness().declare_token(f"omnibench/{robot}_of_{role}/alive") for robot in ROBOTS]
        passed(forger, "barrier/to_witness", barrier)
        # the witness looks what came of it
        for key in both:
            witness.put(key, b"witness", congestion_control=BLOCK)
        answers: dict[str, list[bytes]] = {key: [] for _, _, key in services}
        for _, _, key in services:
            answers_to(witness, key, answers[key])
        until(lambda: all(any(b"robot" in each for each in found) for found in answers.values()), "the node's answers")
        present = {str(reply.ok.key_expr) for reply in witness.liveliness().get("omnibench/*/alive") if reply.ok}
        passed(forger, "barrier/to_witness", barrier)  # the forger's answers have come, too
        passed(witness, "barrier/to_member", echo)
        del forged
    for robot, topic, key in topics:
        rights |= {("reads", robot, topic)} if b"witness" in heard.payloads[key] else set()
        rights |= {("writes", robot, topic)} if b"member" in seen.payloads[key] else set()
    for robot, service, key in services:
        rights |= {("asks", robot, service)} if asked[key] else set()
        rights |= {("answers", robot, service)} if b"member" in answers[key] else set()
    for robot, service, key in calibrations:
        rights |= {("takes", robot, service)} if b"witness" in heard.payloads[key] else set()
        rights |= {("puts", robot, service)} if b"member" in seen.payloads[key] else set()
    for robot, token, key in tokens:
        rights |= {("sees", robot, token)} if alive[key] else set()
        rights |= {("declares", robot, token)} if f"omnibench/{robot}_of_{role}/alive" in present else set()
    expected = rights_in_the_handbook(role)
    assert rights == expected
    assert bool(expected) == (role != "stranger")


def test_a_replay_with_the_robots_own_certificate_is_acknowledged(router: str, keys: Path) -> None:
    drive = concatenate_runs(random_dataset(1))
    with session_of("apr02", router, keys) as session:
        report = Player(GraphNode(session, KeySpace(), "replay"), "apr02", drive, ReplayConfig(speed=math.inf)).play()
    assert report.taken == report.total


def test_a_node_elsewhere_claims_its_robots_and_acknowledges_a_replay(router: str, keys: Path, tmp_path: Path) -> None:
    drive = concatenate_runs(random_dataset(1))
    tls = {"ca": str(keys / "ca.pem"), "certificate": str(keys / "remote.pem"), "key": str(keys / "remote.key")}
    elsewhere = {"mode": "client", "connect": router, "tls": tls}
    with Command("live", write_node(tmp_path, "apr04", zenoh=elsewhere)) as node:
        until(lambda: "Ctrl-C ends it" in node.said(), "the node")
        with session_of("node", router, keys) as session:
            graph = GraphNode(session, KeySpace(), "replay")
            report = Player(graph, "apr04", drive, ReplayConfig(speed=math.inf)).play()
    assert report.taken == report.total
    again = Command("live", write_node(tmp_path, "apr03", zenoh=elsewhere))
    _, said = again.ended()
    assert "error: robot 'apr03' is run by another node already" in said
