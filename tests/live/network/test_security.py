"""Intruders against a router in its own process: they are refused and logged, and peers with rights work."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import zenoh
from sessions import free_port, until

from omnibench.errors import ConfigError
from omnibench.live.network.access import rights_of
from omnibench.live.network.access_log import AccessLog
from omnibench.live.network.keys import make_keys
from omnibench.live.network.session import open_session, zenoh_config
from omnibench.live.network.session_config import Access, SessionConfig, Tls, User

MEMBERS = ("node", "apr02", "apr03", "viewer", "operator", "remote", "stranger")
ACCESS = {
    "robots": ["apr02", "apr03"],
    "viewers": ["viewer"],
    "operators": ["operator"],
    "nodes": ["remote"],
    "rules": [{"who": "viewer", "write": "notes/**"}],
}


@dataclass
class RouterProcess:
    """A router that runs ``router_process.py``."""

    address: str
    output: Path
    errors: Path

    def got(self, key: str) -> int:
        return self.output.read_text().split("\n").count(f"got {key}")

    def has_logged(self, text: str) -> bool:
        return text in self.errors.read_text()

    def until_logged(self, text: str) -> None:
        until(lambda: self.has_logged(text), f"{text!r} in {self.errors.read_text()!r}")


@contextmanager
def running(folder: Path, config: dict[str, Any]) -> Iterator[RouterProcess]:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "router.yaml"
    path.write_text(json.dumps(config))
    router = RouterProcess(config["listen"], folder / "output", folder / "errors")
    script = Path(__file__).with_name("router_process.py")
    with router.output.open("wb") as output, router.errors.open("wb") as errors:
        process = subprocess.Popen(
            [sys.executable, str(script), str(path)], stdin=subprocess.PIPE, stdout=output, stderr=errors
        )
    try:
        until(lambda: "ready\n" in router.output.read_text() or process.poll() is not None, "the router")
        assert process.poll() is None, router.errors.read_text()
        yield router
    finally:
        try:
            process.communicate(timeout=60)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
    assert process.returncode == 0, router.errors.read_text()


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    make_keys(folder, MEMBERS, users=True)
    make_keys(folder / "other", ["apr02"])
    return folder


def mutual(keys: Path) -> dict[str, Any]:
    tls = {"ca": str(keys / "ca.pem"), "certificate": str(keys / "node.pem"), "key": str(keys / "node.key")}
    return {"listen": f"tls/127.0.0.1:{free_port()}", "tls": tls, "access": ACCESS}


@pytest.fixture
def fleet(keys: Path, tmp_path: Path) -> Iterator[RouterProcess]:
    """A router with mutual TLS and access rules."""
    with running(tmp_path / "router", mutual(keys)) as router:
        yield router


@pytest.fixture
def users(keys: Path, tmp_path: Path) -> Iterator[RouterProcess]:
    """A router with users and passwords and access rules."""
    address = f"tcp/127.0.0.1:{free_port()}"
    config = {"listen": address, "users_file": str(keys / "users.txt"), "access": ACCESS}
    with running(tmp_path / "router", config) as router:
        yield router


def member(router: RouterProcess, keys: Path, name: str, ca: Path | None = None) -> SessionConfig:
    tls = Tls(ca=ca or keys / "ca.pem", certificate=keys / f"{name}.pem", key=keys / f"{name}.key")
    return SessionConfig(mode="client", connect=(router.address,), tls=tls)


def user(router: RouterProcess, keys: Path, name: str) -> SessionConfig:
    who = User(name=name, password_file=keys / f"{name}.password")
    return SessionConfig(mode="client", connect=(router.address,), user=who)


def refusal(config: SessionConfig) -> str:
    with pytest.raises(ConfigError) as caught:
        open_session(config, "intruder")
    return str(caught.value)


def works(session: zenoh.Session, router: RouterProcess, robot: str = "apr02") -> None:
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


class TestMutualTls:
    def test_rightful_members_work_and_nothing_is_logged(self, fleet: RouterProcess, keys: Path) -> None:
        for robot in ("apr02", "apr03"):
            with open_session(member(fleet, keys, robot), robot) as session:
                works(session, fleet, robot)
        assert fleet.errors.read_text() == ""
        assert set(fleet.output.read_text().split("\n")) <= {
            *("ready", "got apr02/joint_states", "got apr03/joint_states", "")
        }

    def test_another_authority_is_refused_and_logged(self, fleet: RouterProcess, keys: Path) -> None:
        text = refusal(member(fleet, keys / "other", "apr02", ca=keys / "ca.pem"))
        assert "our certificate is not from its authority" in text
        fleet.until_logged("refused: a connection: invalid peer certificate: UnknownIssuer")

    def test_no_certificate_is_refused_and_logged(self, fleet: RouterProcess, keys: Path) -> None:
        tls = Tls(ca=keys / "ca.pem", mutual=False)
        assert "it asks for a certificate" in refusal(SessionConfig(mode="client", connect=(fleet.address,), tls=tls))
        fleet.until_logged("refused: a connection: peer sent no certificates")

    def test_no_encryption_is_refused_and_logged(self, fleet: RouterProcess) -> None:
        plain = fleet.address.replace("tls", "tcp")
        assert "asks for TLS" in refusal(SessionConfig(mode="client", connect=(plain,)))
        fleet.until_logged("refused: a connection: received corrupt message")

    def test_a_router_of_another_authority_is_refused_by_its_client(self, fleet: RouterProcess, keys: Path) -> None:
        text = refusal(member(fleet, keys, "apr02", ca=keys / "other" / "ca.pem"))
        assert "we refuse its certificate" in text

    def test_a_router_of_another_name_is_refused_by_its_client(self, fleet: RouterProcess, keys: Path) -> None:
        port = fleet.address.rsplit(":", 1)[1]
        elsewhere = member(fleet, keys, "apr02").model_copy(update={"connect": (f"tls/127.0.0.2:{port}",)})
        text = refusal(elsewhere)
        assert "nothing listens there" in text or "IP address mismatch" in text

    def test_a_refused_peer_opens_but_nothing_of_it_passes(self, fleet: RouterProcess, keys: Path) -> None:
        settings = zenoh_config(member(fleet, keys / "other", "apr02", ca=keys / "ca.pem"))
        settings.insert_json5("mode", '"peer"')
        settings.insert_json5("connect/timeout_ms", "-1")
        with zenoh.open(settings) as session:
            publisher = session.declare_publisher("apr02/joint_states")
            for _ in range(20):
                publisher.put(b"forged")
                time.sleep(0.005)
            fleet.until_logged("refused: a connection: invalid peer certificate: UnknownIssuer")
            assert not session.info.routers_zid()
        assert fleet.got("apr02/joint_states") == 0

    def test_a_router_that_is_refused_elsewhere_does_not_open(
        self, fleet: RouterProcess, keys: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("omnibench.live.network.session._CONNECT_TIMEOUT", 0.5)
        refused = member(fleet, keys / "other", "apr02", ca=keys / "ca.pem")
        upstream = SessionConfig(listen=(f"tls/127.0.0.1:{free_port()}",), connect=refused.connect, tls=refused.tls)
        assert "our certificate is not from its authority" in refusal(upstream)

    def test_rightful_members_work_beside_intruders(self, fleet: RouterProcess, keys: Path) -> None:
        with open_session(member(fleet, keys, "apr02"), "apr02") as session:
            works(session, fleet)
            refusal(member(fleet, keys / "other", "apr02", ca=keys / "ca.pem"))
            with open_session(member(fleet, keys, "stranger"), "stranger") as stranger:
                stranger.put("apr02/joint_states", b"forged")
                fleet.until_logged("certificate 'stranger'")
                works(session, fleet)


class TestUsers:
    def test_rightful_users_work_and_nothing_is_logged(self, users: RouterProcess, keys: Path) -> None:
        with open_session(user(users, keys, "apr02"), "apr02") as session:
            works(session, users)
        assert users.errors.read_text() == ""

    @pytest.mark.parametrize(
        ("who", "reason"),
        [("apr02", "wrong password"), ("nobody", "unknown user"), (None, "no user and password given")],
    )
    def test_wrong_ones_are_refused_and_logged(self, users: RouterProcess, who: str | None, reason: str) -> None:
        shown = None if who is None else User.model_validate({"name": who, "password": "guessed"})
        text = refusal(SessionConfig(mode="client", connect=(users.address,), user=shown))
        assert "may ask for a user and password" in text if who is None else f"refuses user '{who}'" in text
        users.until_logged(f": {reason}\n")
        assert users.has_logged("refused: tcp/127.0.0.1:")

    def test_a_users_rights_are_its_own(self, users: RouterProcess, keys: Path) -> None:
        with open_session(user(users, keys, "apr02"), "apr02") as session:
            session.put("apr03/joint_states", b"forged")
            users.until_logged("user 'apr02' at tcp/127.0.0.1:")
            assert users.has_logged("may not write apr03/joint_states")
            works(session, users)
        assert users.got("apr03/joint_states") == 0


class TestAccess:
    @pytest.mark.parametrize("declared", [False, True])
    def test_a_robot_writing_anothers_keys_is_refused_and_logged(
        self, fleet: RouterProcess, keys: Path, declared: bool
    ) -> None:
        with open_session(member(fleet, keys, "apr02"), "apr02") as session:
            works(session, fleet)
            for key in ("apr03/joint_states", "apr03/slam_pose"):
                publisher = session.declare_publisher(key)
                put = publisher.put if declared else (lambda value, key=key: session.put(key, value))
                for _ in range(100):
                    put(b"forged")
                fleet.until_logged(f"may not write {key}\n")
                publisher.undeclare()
            works(session, fleet)
        assert fleet.got("apr03/joint_states") == fleet.got("apr03/slam_pose") == 0
        lines = fleet.errors.read_text().splitlines()
        assert [line for line in lines if "may not write apr03/joint_states" in line] == lines[:1]  # logged once
        assert lines[0].startswith("refused: certificate 'apr02' at tls/127.0.0.1:")

    def test_a_robot_reads_what_is_its_own_only(self, fleet: RouterProcess, keys: Path) -> None:
        with open_session(member(fleet, keys, "apr02"), "apr02") as session:
            received: list[zenoh.Sample] = []
            subscribers = [session.declare_subscriber(key, received.append) for key in ("apr03/odom", "*/odom", "**")]
            works(session, fleet)
            for key in ("apr03/odom", "*/odom", "**"):
                fleet.until_logged(f"may not declare subscriber {key}\n")
            assert {str(sample.key_expr).split("/")[0] for sample in received} == {"apr02"}
            for subscriber in subscribers:
                subscriber.undeclare()

    def test_a_certificate_without_rights_can_do_nothing(self, fleet: RouterProcess, keys: Path) -> None:
        with open_session(member(fleet, keys, "stranger"), "stranger") as session:
            received: list[zenoh.Sample] = []
            subscriber = session.declare_subscriber("apr02/odom", received.append)
            for _ in range(20):
                session.put("apr02/joint_states", b"forged")
                time.sleep(0.005)
            fleet.until_logged("may not declare subscriber apr02/odom")
            fleet.until_logged("may not write apr02/joint_states")
            assert not received
            subscriber.undeclare()
        assert fleet.got("apr02/joint_states") == 0

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
            fleet.until_logged("certificate 'viewer' at")
            assert fleet.has_logged("may not ask omnibench/apr07/set_pose")
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

            def again() -> bool:
                operator.put("omnibench/apr07/calibration", b"operator")
                return b"operator" in received

            until(again, "the operator's calibration")
            for session in (viewer, robot):
                session.put("omnibench/apr07/calibration", b"forged")
            fleet.until_logged("certificate 'viewer' at")
            fleet.until_logged("certificate 'apr02' at")
            assert set(received) == {b"operator"}
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

    def test_a_flood_of_forgeries_is_logged_in_a_few_lines(self, fleet: RouterProcess, keys: Path) -> None:
        with open_session(member(fleet, keys, "apr02"), "apr02") as session:
            for number in range(2000):
                session.put(f"apr03/forged_{number}", b"x", congestion_control=zenoh.CongestionControl.BLOCK)
            works(session, fleet)
        assert 0 < len(fleet.errors.read_text().splitlines()) <= 25

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


def answers(session: zenoh.Session, key: str) -> list[bytes]:
    replies = session.get(key, target=zenoh.QueryTarget.ALL, timeout=5.0)
    return [bytes(reply.ok.payload) for reply in replies if reply.ok is not None]


def alive(session: zenoh.Session, key: str) -> list[str]:
    return [str(reply.ok.key_expr) for reply in session.liveliness().get(key) if reply.ok is not None]


class TestLog:
    def test_lines_that_are_not_zenohs_are_left_alone(self) -> None:
        warnings: list[str] = []
        access_log = AccessLog(warnings.append)
        assert not access_log.read("a table of the program, with words as unauthorized to Put in it")
        assert not warnings

    def test_what_is_only_looked_up_is_not_logged(self) -> None:
        warnings: list[str] = []
        access_log = AccessLog(warnings.append)
        head = "2026-11-21T08:51:04.100951Z TRACE  rx-1 ThreadId(10) zenoh::net::routing::interceptor"
        subject = "Interface(lo)+CertCommonName(apr02)+Transport(Tls)+3f"
        assert access_log.read(
            f"{head}::access_control: 3f on {subject} is unauthorized to Put (ingress) on apr03/odom"
        )
        assert not warnings
        assert access_log.read(f"{head}: Msg intercepted!")
        assert warnings == ["refused: certificate 'apr02' at an unknown address: may not write apr03/odom"]
        assert access_log.count == 1

    def test_the_programs_own_output_comes_out_as_it_was_written(self, keys: Path, tmp_path: Path) -> None:
        config = tmp_path / "router.yaml"
        config.write_text(json.dumps(mutual(keys)))
        process = subprocess.run([sys.executable, "-c", _PROGRAM, str(config)], capture_output=True, check=True)
        assert sorted(process.stdout.split(b"\n")) == [b"before", b"of a child", b"printed", b"unended"]
        assert process.stderr == b""

    @pytest.mark.parametrize(("variable", "logged"), [("off", False), ("zenoh_link_tls=warn", True)])
    def test_rust_log_asks_for_zenohs_own_log(
        self, keys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str, logged: bool
    ) -> None:
        monkeypatch.setenv("RUST_LOG", variable)
        with running(tmp_path / "router", mutual(keys)) as router:
            refusal(member(router, keys / "other", "apr02", ca=keys / "ca.pem"))
            until(lambda: not logged or "UnknownIssuer" in router.output.read_text(), "Zenoh's own log")
            assert not router.has_logged("UnknownIssuer")


_PROGRAM = """
import os, subprocess, sys
from pathlib import Path
from omnibench.live.network.access_log import log_refused_access
from omnibench.live.network.session import open_session
from omnibench.live.network.session_config import read_session_config
config = read_session_config(Path(sys.argv[1]))
print("before")
with log_refused_access(config), open_session(config, "router"):
    print("printed")
    subprocess.run(["echo", "of a child"], check=True)
print("unended", end="")
"""
