from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from sessions import free_port, until

from omnibench.config import read_model, to_yaml, validate
from omnibench.errors import ConfigError
from omnibench.live.network.session import open_session, zenoh_config
from omnibench.live.network.session_config import SessionConfig, User


@pytest.fixture
def address() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


def router(address: str, **others: Any) -> SessionConfig:
    return SessionConfig(listen=(address,), **others)


def client(address: str, **others: Any) -> SessionConfig:
    return SessionConfig(mode="client", connect=(address,), **others)


def config(**data: Any) -> SessionConfig:
    return validate(SessionConfig, data, "live.yaml")


def sockets_of_this_process() -> set[tuple[str, str, str]]:
    """Protocol, local address and state of every network socket, from /proc; a listening TCP socket's state is 0A."""
    inodes = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        try:
            target = os.readlink(descriptor)
        except FileNotFoundError:  # the descriptor of the listing itself
            continue
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    found = set()
    for protocol in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/self/net/{protocol}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[9] in inodes:
                found.add((protocol, fields[1], fields[3]))
    return found


@contextmanager
def received(session: zenoh.Session, key: str) -> Iterator[list[zenoh.Sample]]:
    samples: list[zenoh.Sample] = []
    subscriber = session.declare_subscriber(key, samples.append)
    yield samples
    subscriber.undeclare()


def publish_until(session: zenoh.Session, key: str, condition: Callable[[], object]) -> None:
    def again() -> object:
        session.put(key, b"again")
        return condition()

    until(again, f"a message on {key}")


@pytest.mark.skipif(not Path("/proc/self/net").exists(), reason="needs /proc")
class TestNetwork:
    def test_router_listens_on_loopback_only_and_does_not_scout(self, address: str) -> None:
        before = sockets_of_this_process()
        with open_session(router(address), "test"):
            opened = sockets_of_this_process() - before
        port = int(address.rsplit(":", 1)[1])
        assert opened == {("tcp", f"0100007F:{port:04X}", "0A")}

    def test_default_peer_listens_on_loopback_only_and_does_not_scout(self) -> None:
        before = sockets_of_this_process()
        with open_session(SessionConfig(mode="peer"), "test"):
            opened = sockets_of_this_process() - before
        assert [(protocol, local.split(":")[0], state) for protocol, local, state in opened] == [
            ("tcp", "0100007F", "0A")
        ]

    def test_scouting_opens_udp_sockets_when_the_config_says_so(self, address: str) -> None:
        before = sockets_of_this_process()
        with open_session(router(address, scouting=True), "test"):
            opened = sockets_of_this_process() - before
        assert any(protocol.startswith("udp") for protocol, _, _ in opened)

    def test_clients_listen_nowhere(self, address: str) -> None:
        with open_session(router(address), "router"):
            before = sockets_of_this_process()
            with open_session(client(address), "client"):
                opened = sockets_of_this_process() - before
        assert opened
        assert not [each for each in opened if each[2] == "0A"]


def test_defaults_are_zenohs_port_on_loopback() -> None:
    assert SessionConfig().listening == ("tcp/127.0.0.1:7447",)
    assert SessionConfig().connecting == ()
    assert SessionConfig(mode="client").connecting == ("tcp/127.0.0.1:7447",)
    assert SessionConfig(mode="client").listening == ()


def test_a_python_router_serves_two_clients(address: str) -> None:
    with (
        open_session(router(address), "router"),
        open_session(client(address), "one") as one,
        open_session(client(address), "two") as two,
        received(one, "to/one") as to_one,
        received(two, "to/two") as to_two,
    ):
        publish_until(two, "to/one", lambda: to_one)
        publish_until(one, "to/two", lambda: to_two)


def test_messages_carry_times(address: str) -> None:
    with open_session(router(address), "r"), open_session(client(address), "c") as one, received(one, "key") as samples:
        publish_until(one, "key", lambda: samples)
    assert samples[0].timestamp is not None


def test_clients_come_back_soon_after_the_router_was_gone(address: str) -> None:
    first = open_session(router(address), "router")
    with (
        open_session(client(address), "one") as one,
        open_session(client(address), "two") as two,
        received(two, "key") as samples,
    ):
        publish_until(one, "key", lambda: samples)
        first.close()
        until(lambda: not (one.info.routers_zid() or two.info.routers_zid()), "the clients to notice")
        with open_session(router(address), "router"):
            count_before = len(samples)
            publish_until(one, "key", lambda: len(samples) > count_before)


def test_a_client_tries_to_connect_twice_a_second(address: str) -> None:
    settings = json.loads(str(zenoh_config(client(address))))
    assert settings["connect"]["retry"]["period_max_ms"] == 500  # Zenoh's own is 4 s


def test_a_client_waits_for_its_router_when_asked_to(address: str) -> None:
    opened: list[zenoh.Session] = []
    late = threading.Timer(0.3, lambda: opened.append(open_session(router(address), "router")))
    late.start()
    with open_session(client(address, wait=60.0), "client") as session:
        assert session.info.routers_zid()
    late.join()
    opened[0].close()


_FROZEN = """
import sys
from omnibench.live.network.session import open_session
from omnibench.live.network.session_config import SessionConfig
session = open_session(SessionConfig(mode="client", connect=(sys.argv[1],)), "frozen")
subscriber = session.declare_subscriber("key", lambda _: None)
print("ready", flush=True)
sys.stdin.read()
"""


@contextmanager
def frozen_subscriber(address: str) -> Iterator[None]:
    """Another process that subscribes to ``key`` and reads nothing."""
    process = subprocess.Popen([sys.executable, "-c", _FROZEN, address], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        process.send_signal(signal.SIGSTOP)
        yield
    finally:
        process.kill()
        process.communicate()


def test_a_frozen_subscriber_holds_up_nobody(address: str) -> None:
    payload, count = bytes(1000), 10_000  # more than all socket buffers hold
    durations = []
    with (
        open_session(router(address), "router") as session,
        open_session(client(address), "healthy") as healthy,
        received(healthy, "key") as samples,
        frozen_subscriber(address),
    ):
        publisher = session.declare_publisher("key", congestion_control=zenoh.CongestionControl.DROP)
        for sent in range(count):
            began = time.perf_counter()
            publisher.put(payload)
            durations.append(time.perf_counter() - began)
            if sent % 5 == 4:
                time.sleep(0.001)
        until(lambda: len(samples) == count, "messages at the healthy subscriber")
    assert max(durations) < 2.5  # s; blocking would take 5 s once, and then drop the frozen one


class TestOneClearLine:
    def refusal(self, config: SessionConfig) -> str:
        with pytest.raises(ConfigError) as caught:
            open_session(config, "node apr")
        text = str(caught.value)
        assert text.startswith("node apr: ")
        assert ".rs:" not in text  # no line of Zenoh's source
        return text

    def test_address_in_use(self, address: str) -> None:
        with open_session(router(address), "router"):
            assert f"{address} is in use; another omnibench live" in self.refusal(router(address))

    def test_address_of_another_machine(self) -> None:
        assert "is not an address of this machine" in self.refusal(router("tcp/192.0.2.1:7447"))

    def test_nothing_listens(self, address: str) -> None:
        text = self.refusal(client(address))
        assert f"{address}: nothing listens there; start omnibench live, or --connect" in text

    def test_nothing_listens_where_a_router_connects_to(self, address: str, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("omnibench.live.network.session._CONNECT_TIMEOUT", 0.1)
        elsewhere = f"tcp/127.0.0.1:{free_port()}"
        assert "nothing listens there" in self.refusal(router(address, connect=(elsewhere,)))
        with socket.create_server(("127.0.0.1", int(address.rsplit(":", 1)[1]))):
            pass  # the session that failed does not listen any more

    def test_unknown_host(self) -> None:
        assert "there is no host called nowhere.invalid" in self.refusal(client("tcp/nowhere.invalid:7447"))

    def test_something_else_listens(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as server:
            text = self.refusal(client(f"tcp/127.0.0.1:{server.getsockname()[1]}", extra=_SOON))
        assert "is not a Zenoh router" in text

    def test_missing_password_file(self, address: str, tmp_path: Path) -> None:
        user = User(name="apr02", password_file=tmp_path / "secret")
        assert f"{tmp_path}/secret: no such file" in self.refusal(client(address, user=user))

    def test_missing_environment_variable(self, address: str) -> None:
        user = User(name="apr02", password_env="NOT_SET_ANYWHERE")
        assert "NOT_SET_ANYWHERE is not set" in self.refusal(client(address, user=user))

    @pytest.mark.parametrize(
        ("content", "reason"),
        [("", "holds no user"), ("\n\n", "holds no user"), ("a:b\napr02\n", "line 2: expected user:password")],
    )
    def test_users_file_that_is_none(self, address: str, tmp_path: Path, content: str, reason: str) -> None:
        users = tmp_path / "users.txt"
        users.write_text(content)
        assert reason in self.refusal(router(address, users_file=users))

    def test_unknown_setting_of_zenoh(self, address: str) -> None:
        text = self.refusal(router(address, extra={"transport/link/tx/leese": 1000}))
        assert "did you mean 'transport/link/tx/lease'?" in text

    def test_wrong_value_of_a_setting_of_zenoh(self, address: str) -> None:
        text = self.refusal(router(address, extra={"transport/link/tx/lease": "long"}))
        assert "extra: transport/link/tx/lease: " in text


_SOON = {"transport/unicast/open_timeout": 300}


def test_settings_of_zenoh_reach_it(address: str) -> None:
    with (
        open_session(router(address), "router"),
        open_session(client(address, extra={"namespace": "hall"}), "inside") as inside,
        open_session(client(address), "outside") as outside,
        received(outside, "hall/key") as samples,
    ):
        publish_until(inside, "key", lambda: samples)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        ({"listen": "127.0.0.1:7447"}, "'127.0.0.1:7447' is not an endpoint; write protocol/host:port"),
        ({"listen": "tcp:127.0.0.1:7447"}, "is not an endpoint"),
        ({"listen": ["tcp/127.0.0.1"]}, "is not an endpoint"),
        ({"connect": "tcp/127.0.0.1:70000"}, "is not an endpoint"),
        ({"connect": "http/127.0.0.1:80"}, "is not an endpoint"),
        ({"listne": "tcp/127.0.0.1:7447"}, "unknown key 'listne'; did you mean 'listen'?"),
        ({"mode": "broker"}, "mode"),
        ({"mode": "client", "listen": "tcp/127.0.0.1:1"}, "nobody connects to a client"),
        ({"mode": "client", "users_file": "users.txt"}, "users_file: nobody connects to a client"),
        ({"listen": "tls/127.0.0.1:7447"}, "give tls"),
        ({"tls": {"ca": "ca.pem", "mutual": False}}, "a session that listens needs a certificate and its key"),
        ({"tls": {"ca": "ca.pem"}}, "give our certificate and key, or mutual: false"),
        ({"tls": {"ca": "a", "certificate": "b"}}, "give certificate and key together"),
        ({"tls": {"ca": "a", "certificate": "b", "key": "c"}, "listen": "tcp/127.0.0.1:1"}, "is not encrypted"),
        ({"access": {"robots": ["apr02"]}}, "peers cannot be identified"),
        ({"users_file": "u", "access": {}}, "it names nobody"),
        ({"users_file": "u", "access": {"rules": [{"who": "me"}]}}, "give keys to write or to read"),
        ({"user": {"name": "me"}}, "give one of password, password_file, password_env (given: none)"),
        ({"mode": "peer", "connect": "tcp/h:1", "user": {"name": "a", "password": "b"}}, "use client"),
    ],
)
def test_configs_that_cannot_be_are_refused(data: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError) as caught:
        config(**data)
    assert reason in str(caught.value)


@pytest.mark.parametrize("endpoint", ["tcp/[::1]:7447", "udp/10.0.0.1:7447?rel=0", "ws/localhost:0#iface=lo"])
def test_endpoints_of_zenoh_are_taken(endpoint: str) -> None:
    assert config(listen=endpoint).listening == (endpoint,)


def test_a_key_expression_that_is_none_is_refused(address: str, tmp_path: Path) -> None:
    users = tmp_path / "users.txt"
    users.write_text("me:secret\n")
    rules = config(listen=address, users_file=users, access={"rules": [{"who": "me", "read": "a//b"}]})
    with pytest.raises(ConfigError, match="'a//b' is not a key expression"):
        open_session(rules, "node")


def test_paths_start_from_the_config_files_folder(tmp_path: Path) -> None:
    files = {"ca": "keys/ca.pem", "certificate": "/etc/node.pem", "key": "keys/node.key"}
    given = {"tls": files, "users_file": "users.txt", "user": {"name": "me", "password_file": "me.password"}}
    (tmp_path / "session.yaml").write_text(json.dumps(given))
    there = read_model(SessionConfig, tmp_path / "session.yaml")
    assert there.tls is not None
    assert there.user is not None
    assert there.tls.ca == tmp_path / "keys/ca.pem"
    assert there.tls.certificate == Path("/etc/node.pem")
    assert there.users_file == tmp_path / "users.txt"
    assert there.user.password_file == tmp_path / "me.password"


def test_a_password_is_not_written_into_an_effective_config() -> None:
    assert "tops3cret" not in to_yaml(config(user={"name": "me", "password": "tops3cret"}))


def test_listening_to_a_network_without_any_protection_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    endpoint = f"tcp/0.0.0.0:{free_port()}"
    assert config(listen=endpoint).unprotected == (endpoint,)
    assert config(listen=endpoint, users_file="users.txt").unprotected == ()
    assert config(listen="tcp/127.0.0.1:7447").unprotected == ()
    with open_session(config(listen=endpoint), "node apr"):
        assert f"node apr listens at {endpoint}, where anybody on the network may connect" in caplog.text
