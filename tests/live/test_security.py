"""A router with access rules: who gets in, who may write and read what, and what strangers can take."""

import json
import math
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import zenoh
from commands import ENVIRONMENT
from drives import drive
from nodes import Command, peak_memory, sent, wheels_of, write_node
from pydantic import ValidationError
from recordings import random_dataset
from sessions import free_port, until

from omnibench.cli.handbook_topics import find_topic
from omnibench.errors import ConfigError
from omnibench.live.config import read_live_config
from omnibench.live.drive import ReplayConfig, concatenate_runs
from omnibench.live.keys import make_keys
from omnibench.live.network import Access, Right, SessionConfig, Tls, User, open_session, rights_of, zenoh_config
from omnibench.live.node import LiveNode
from omnibench.live.replay import Player
from omnibench.live.topics import GraphNode, KeySpace

MEMBERS = ("node", "apr02", "apr03", "viewer", "operator", "remote", "stranger")
ROBOTS = ("apr02", "apr03")
ROLES = {"robot": "apr02", "viewer": "viewer", "operator": "operator", "node": "remote", "stranger": "stranger"}
ACCESS = {
    "robots": list(ROBOTS),
    "viewers": ["viewer"],
    "operators": ["operator"],
    "nodes": ["remote"],
    "rules": [{"who": list(ROLES.values()), "write": "barrier/**", "read": "barrier/**"}],
}
BLOCK = zenoh.CongestionControl.BLOCK


@dataclass
class Router:
    """A router, and the keys of what was written to robots' inputs there."""

    address: str
    written: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return self.address

    def got(self, key: str) -> int:
        return self.written.count(key)


@contextmanager
def running(config: dict[str, Any]) -> Iterator[Router]:
    """A router that publishes odometry of two robots."""
    router, over = Router(config["listen"]), threading.Event()
    with open_session(SessionConfig.model_validate(config), "router") as session:
        subscribers = [
            session.declare_subscriber(key, lambda sample: router.written.append(str(sample.key_expr)))
            for key in ("*/joint_states", "*/slam_pose")
        ]
        publishers = [session.declare_publisher(f"{robot}/odom") for robot in ROBOTS]

        def publish() -> None:
            while not over.wait(0.02):
                for publisher in publishers:
                    publisher.put(b"odometry")

        publishing = threading.Thread(target=publish)
        publishing.start()
        yield router
        over.set()
        publishing.join()
        del subscribers


def mutual(keys: Path) -> dict[str, Any]:
    tls = {"ca": str(keys / "ca.pem"), "certificate": str(keys / "node.pem"), "key": str(keys / "node.key")}
    return {"listen": f"tls/127.0.0.1:{free_port()}", "tls": tls, "access": ACCESS}


def member(router: Router | str, keys: Path, name: str, ca: Path | None = None) -> SessionConfig:
    """A client of a router or its address, with a certificate."""
    tls = Tls(ca=ca or keys / "ca.pem", certificate=keys / f"{name}.pem", key=keys / f"{name}.key")
    return SessionConfig(mode="client", connect=(str(router),), tls=tls)


def user(router: Router | str, keys: Path, name: str) -> SessionConfig:
    """The same with a password."""
    who = User(name=name, password_file=keys / f"{name}.password")
    return SessionConfig(mode="client", connect=(str(router),), user=who)


def foreign(router: Router, keys: Path) -> SessionConfig:
    """A client with a certificate of another authority."""
    return member(router, keys / "other", "apr02", ca=keys / "ca.pem")


def refusal(config: SessionConfig) -> str:
    with pytest.raises(ConfigError) as caught:
        open_session(config, "intruder")
    return str(caught.value)


def works(session: zenoh.Session, router: Router, robot: str = "apr02") -> None:
    """A robot's wheels arrive at the router, and its odometry comes back."""
    samples: list[zenoh.Sample] = []
    subscriber = session.declare_subscriber(f"{robot}/odom", samples.append)
    publisher = session.declare_publisher(f"{robot}/joint_states")
    before = router.got(f"{robot}/joint_states")

    def both() -> bool:
        publisher.put(b"wheels")
        return bool(samples) and router.got(f"{robot}/joint_states") > before

    until(both, f"messages of {robot}")
    subscriber.undeclare()


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    make_keys(folder, MEMBERS, users=True)
    make_keys(folder / "other", ["apr02"], router="apr02")
    return folder


@pytest.fixture(scope="module")
def fleet(keys: Path) -> Iterator[Router]:
    """A router with mutual TLS and access rules."""
    with running(mutual(keys)) as router:
        yield router


@pytest.fixture(scope="module")
def users(keys: Path) -> Iterator[Router]:
    """A router with users and passwords and access rules."""
    address = f"tcp/127.0.0.1:{free_port()}"
    with running({"listen": address, "users_file": str(keys / "users.txt"), "access": ACCESS}) as router:
        yield router


# Access


def test_tokens_of_ros_nodes_pass(fleet: Router, keys: Path) -> None:
    key = "@ros2_lv/0/abc/0/1/MP/%/%/apr02/%apr02%joint_states/sensor_msgs::msg::dds_::JointState_/hash/qos"
    with (
        open_session(member(fleet, keys, "apr02"), "robot") as robot,
        open_session(member(fleet, keys, "viewer"), "viewer") as viewer,
    ):
        token = robot.liveliness().declare_token(key)
        until(lambda: alive(viewer, "@ros2_lv/0/**") == [key], "the token")
        token.undeclare()


def test_advanced_publishers_are_heard(fleet: Router, keys: Path) -> None:
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


@pytest.mark.parametrize("domain", ["0", "232"])
def test_a_robots_keys_in_any_domain_are_not_the_keys_of_its_services(domain: str) -> None:
    rights = rights_of(Access.model_validate({"robots": {"apr02": "robot 2"}}))["robot 2"]

    def may(right: Right, key: str) -> bool:
        return any(zenoh.KeyExpr(each).includes(zenoh.KeyExpr(key)) for each in rights[right])

    assert may("read", f"{domain}/apr02/odom/nav_msgs::msg::dds_::Odometry_/*")
    assert may("read", f"{domain}/apr02/odometry/filtered/nav_msgs::msg::dds_::Odometry_/RIHS01_a13e")
    for service in ("set_pose", "reset", "swap", "calibration", "*", "**"):
        assert not may("read", f"omnibench/apr02/{service}")
        assert may("ask", f"omnibench/apr02/{service}") == (service == "calibration")


def test_a_robot_cannot_have_the_name_that_begins_the_services() -> None:
    with pytest.raises(ValidationError, match="omnibench begins the keys of the services"):
        Access.model_validate({"robots": ["omnibench"]})


def alive(session: zenoh.Session, key: str) -> list[str]:
    return [str(reply.ok.key_expr) for reply in session.liveliness().get(key) if reply.ok is not None]


# Mutual tls


@pytest.mark.parametrize(
    ("who", "reason"),
    [
        ("another authority", "our certificate is not from its authority"),
        ("no certificate", "asks for a certificate"),
        ("no encryption", "asks for TLS"),
        ("another router", "we refuse its certificate"),
        ("a router of another name", "nothing listens there|IP address mismatch"),
    ],
)
def test_an_intruder_or_a_false_router_is_refused(fleet: Router, keys: Path, who: str, reason: str) -> None:
    without = Tls(ca=keys / "ca.pem", mutual=False)
    intruders = {
        "another authority": foreign(fleet, keys),
        "no certificate": SessionConfig(mode="client", connect=(fleet.address,), tls=without),
        "no encryption": SessionConfig(mode="client", connect=(fleet.address.replace("tls", "tcp"),)),
        "another router": member(fleet, keys, "apr02", ca=keys / "other" / "ca.pem"),
        "a router of another name": member(fleet.address.replace("127.0.0.1", "127.0.0.2"), keys, "apr02"),
    }
    assert re.search(reason, refusal(intruders[who]))


def test_a_member_cannot_pose_as_the_router(fleet: Router, keys: Path) -> None:
    config = mutual(keys)
    settings = zenoh_config(SessionConfig.model_validate(config))
    for side in ("listen", "connect"):  # omnibench itself would not start with a client's certificate
        settings.insert_json5(f"transport/link/tls/{side}_certificate", json.dumps(str(keys / "apr02.pem")))
        settings.insert_json5(f"transport/link/tls/{side}_private_key", json.dumps(str(keys / "apr02.key")))
    victim = member(fleet, keys, "apr03").model_copy(update={"connect": (config["listen"],)})
    with zenoh.open(settings):
        for verify_name in (True, False):
            tls = victim.tls.model_copy(update={"verify_name": verify_name})
            text = refusal(victim.model_copy(update={"tls": tls}))
            assert "we refuse its certificate: unsuitable certificate purpose" in text


def test_a_refused_peer_opens_but_nothing_of_it_passes(fleet: Router, keys: Path) -> None:
    settings = zenoh_config(foreign(fleet, keys))
    settings.insert_json5("mode", '"peer"')
    settings.insert_json5("connect/timeout_ms", "-1")
    with zenoh.open(settings) as session:
        publisher = session.declare_publisher("apr03/joint_states")
        for _ in range(20):
            publisher.put(b"forged")
            time.sleep(0.005)
            assert not session.info.routers_zid()
    assert fleet.got("apr03/joint_states") == 0


def test_a_refused_router_does_not_open(fleet: Router, keys: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("omnibench.live.network._CONNECT_TIMEOUT", 0.5)
    refused = foreign(fleet, keys)
    upstream = SessionConfig(listen=(f"tls/127.0.0.1:{free_port()}",), connect=refused.connect, tls=refused.tls)
    assert "our certificate is not from its authority" in refusal(upstream)


@pytest.mark.parametrize("declared", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_member_works_beside_intruders_without_forging(fleet: Router, keys: Path, declared: bool) -> None:
    with open_session(member(fleet, keys, "apr02"), "apr02") as session:
        works(session, fleet)
        refusal(foreign(fleet, keys))
        with open_session(member(fleet, keys, "stranger"), "stranger") as stranger:
            for forger, key in product((session, stranger), ("apr03/joint_states", "apr03/slam_pose")):
                publisher = forger.declare_publisher(key)
                for _ in range(100):
                    publisher.put(b"forged") if declared else forger.put(key, b"forged")
                publisher.undeclare()
            works(session, fleet)
    assert fleet.got("apr03/joint_states") == fleet.got("apr03/slam_pose") == 0


# Users


def test_a_user_has_no_others_rights(users: Router, keys: Path, caplog: pytest.LogCaptureFixture) -> None:
    with open_session(user(users, keys, "apr02"), "apr02") as session:
        session.put("apr03/joint_states", b"forged")
        works(session, users)
    assert users.got("apr03/joint_states") == 0
    assert not caplog.messages


@pytest.mark.parametrize("who", ["apr02", pytest.param("nobody", marks=pytest.mark.slow), None])
def test_wrong_users_and_passwords_are_refused(users: Router, who: str | None) -> None:
    shown = None if who is None else User.model_validate({"name": who, "password": "guessed"})
    text = refusal(SessionConfig(mode="client", connect=(users.address,), user=shown))
    assert "may ask for a user and password" in text if who is None else f"refuses user '{who}'" in text


@pytest.mark.slow
@pytest.mark.parametrize("asked", [True, False])
def test_zenohs_log_names_the_refused(keys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: bool) -> None:
    line = re.search(r"RUST_LOG=(\S+)", find_topic("live").text)
    monkeypatch.setitem(ENVIRONMENT, "RUST_LOG", line[1] if asked else "off")  # here Zenoh would log for ever
    config = mutual(keys)
    with Command("live", write_node(tmp_path, *ROBOTS, zenoh=config)) as node:
        until(lambda: "Ctrl-C ends it" in node.said(), "the node")
        refusal(foreign(config["listen"], keys))
        with session_of("apr02", config["listen"], keys) as session:
            session.put("apr03/joint_states", b"forged")
            until(lambda: list(session.get("omnibench/apr02/calibration")), "an answer, after the forgery")
        said = "".join(node.stop())
    for pattern in ("UnknownIssuer", r"CertCommonName\(apr02\).* is unauthorized to Put .* on apr03/joint_states"):
        assert bool(re.search(pattern, said)) == asked


@pytest.mark.slow
def test_large_messages_of_a_viewer_cost_a_node_no_memory_and_no_odometry(keys: Path, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    zenoh_config = {"listen": endpoint, "users_file": str(keys / "users.txt"), "access": ACCESS}
    with Command("live", write_node(tmp_path, "apr02", zenoh=zenoh_config)) as node:
        until(lambda: "Ctrl-C ends it" in node.said(), "the node")
        robot, viewer = (open_session(user(endpoint, keys, name), name) for name in ("apr02", "viewer"))
        with robot, viewer:
            odometry: list[zenoh.Sample] = []
            subscriber = robot.declare_subscriber("apr02/odom", odometry.append)
            publisher = wheels_of(robot, "apr02")
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


def test_a_message_beyond_largest_message_is_dropped_and_the_next_arrives(keys: Path) -> None:
    with (
        running(mutual(keys) | {"largest_message": 10_000}) as router,
        open_session(member(router, keys, "apr02"), "apr02") as session,
    ):
        session.put("apr02/slam_pose", bytes(200_000), congestion_control=BLOCK)
        works(session, router)
        assert router.got("apr02/slam_pose") == 0
        session.put("apr02/slam_pose", bytes(9_000), congestion_control=BLOCK)
        until(lambda: router.got("apr02/slam_pose") == 1, "the smaller message")


def test_a_user_logs_in_soon_beside_150_idle_connections(users: Router, keys: Path) -> None:
    port = int(users.address.rsplit(":", 1)[1])
    with ExitStack() as idle:
        for _ in range(150):
            idle.enter_context(socket.create_connection(("127.0.0.1", port)))
        began = time.monotonic()
        with open_session(user(users, keys, "apr02").model_copy(update={"wait": 60.0}), "apr02") as session:
            assert time.monotonic() - began < 15.0  # s on a busy machine; one after another they would take minutes
            works(session, users)


@pytest.mark.parametrize("by", ["with a certificate of", "with a password of", "who reaches it"])
def test_a_router_without_access_rules_says_so(by: str, keys: Path, caplog: pytest.LogCaptureFixture) -> None:
    config = mutual(keys)
    if by == "with a password of":
        config = {"listen": f"tcp/127.0.0.1:{free_port()}", "users_file": str(keys / "users.txt"), "access": ACCESS}
    configs = [config, {key: value for key, value in config.items() if key != "access"}]
    if by == "who reaches it":
        configs = [configs[1] | {"tls": {**config["tls"], "mutual": False}}]
    for each in configs:
        caplog.clear()
        with open_session(SessionConfig.model_validate(each), "node apr"):
            pass
        lines = [record.getMessage() for record in caplog.records if "no access rules" in record.getMessage()]
        assert len(lines) == ("access" not in each)
    assert f"everybody {by}" in lines[0]


TOPICS = ("joint_states", "slam_pose", "odom", "odometry/filtered", "diagnostics", "tf")
SERVICES = ("info", "health", "pose", "calibration", "set_pose", "reset", "swap")
Granted = tuple[str, str, str]  # verb, robot, topic or service


def rights_in_the_handbook(role: str) -> set[Granted]:
    """The rights of a role by the table of the handbook's page about the live node."""
    rights: set[Granted] = set()
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
    """The endpoint of a node with two robots and the fleet's rules."""
    config = mutual(keys)
    with LiveNode(read_live_config(write_node(tmp_path_factory.mktemp("fleet"), *ROBOTS, zenoh=config))):
        yield config["listen"]


def session_of(name: str, router: str, keys: Path) -> zenoh.Session:
    return open_session(member(router, keys, name), name)


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
    rights: set[Granted] = set()
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


@pytest.mark.slow
def test_replays_by_a_robot_and_to_a_node_elsewhere_are_acknowledged(router: str, keys: Path, tmp_path: Path) -> None:
    drive = concatenate_runs(random_dataset(1))
    tls = {"ca": str(keys / "ca.pem"), "certificate": str(keys / "remote.pem"), "key": str(keys / "remote.key")}
    elsewhere = {"mode": "client", "connect": router, "tls": tls}
    with Command("live", write_node(tmp_path, "apr04", zenoh=elsewhere)) as node:
        until(lambda: "Ctrl-C ends it" in node.said(), "the node")
        for who, robot in (("apr02", "apr02"), ("node", "apr04")):
            with session_of(who, router, keys) as session:
                graph = GraphNode(session, KeySpace(), "replay")
                report = Player(graph, robot, drive, ReplayConfig(speed=math.inf)).play()
            assert report.taken == report.total
    _, said = Command("live", write_node(tmp_path, "apr03", zenoh=elsewhere)).ended()
    assert "error: robot 'apr03'" in said
