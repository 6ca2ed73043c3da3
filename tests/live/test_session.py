"""Sessions: where they listen and connect, keys and certificates, and what is said of those that cannot be."""

import ipaddress
import json
import os
import re
import socket
import stat
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
from cryptography.hazmat.primitives.serialization import Encoding
from sessions import free_port, until

from omnibench.config import read_model, to_yaml, validate
from omnibench.errors import ConfigError
from omnibench.live.keys import check_files, make_keys, read_certificate, read_key
from omnibench.live.network import SessionConfig, User, open_session, zenoh_config


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
    @pytest.mark.parametrize("mode", ["router", "peer"])
    def test_it_listens_on_loopback_only_and_does_not_scout(self, address: str, mode: str) -> None:
        before = sockets_of_this_process()
        with open_session(router(address) if mode == "router" else SessionConfig(mode="peer"), "test"):
            opened = sockets_of_this_process() - before
        ((protocol, local, state),) = opened
        host, port = local.split(":")
        assert (protocol, host, state) == ("tcp", "0100007F", "0A")
        assert mode == "peer" or port == f"{int(address.rsplit(':', 1)[1]):04X}"

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


def test_defaults_are_zenohs_port_on_loopback_and_other_endpoints_are_taken() -> None:
    assert SessionConfig().listening == ("tcp/127.0.0.1:7447",)
    assert SessionConfig().connecting == ()
    assert SessionConfig(mode="client").connecting == ("tcp/127.0.0.1:7447",)
    assert SessionConfig(mode="client").listening == ()
    for endpoint in ("tcp/[::1]:7447", "udp/10.0.0.1:7447?rel=0", "ws/localhost:0#iface=lo"):
        assert config(listen=endpoint).listening == (endpoint,)


def test_a_python_router_serves_two_clients_whose_messages_carry_times(address: str) -> None:
    with (
        open_session(router(address), "router"),
        open_session(client(address), "one") as one,
        open_session(client(address), "two") as two,
        received(one, "to/one") as to_one,
        received(two, "to/two") as to_two,
    ):
        publish_until(two, "to/one", lambda: to_one)
        publish_until(one, "to/two", lambda: to_two)
    assert to_one[0].timestamp is not None
    settings = json.loads(str(zenoh_config(client(address))))
    assert settings["connect"]["retry"]["period_max_ms"] == 500  # Zenoh's own is 4 s


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


def test_a_client_waits_for_its_router_when_asked_to(address: str) -> None:
    opened: list[zenoh.Session] = []
    late = threading.Timer(0.3, lambda: opened.append(open_session(router(address), "router")))
    late.start()
    with open_session(client(address, wait=60.0), "client") as session:
        assert session.info.routers_zid()
    late.join()
    opened[0].close()


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
            assert f"{address} is in use" in self.refusal(router(address))

    @pytest.mark.parametrize(
        ("config", "named"),
        [
            (router("tcp/192.0.2.1:7447"), "192.0.2.1:7447 is not an address of this machine"),
            (client("tcp/127.0.0.1:1"), "tcp/127.0.0.1:1: nothing listens there"),
            (client("tcp/nowhere.invalid:7447"), "nowhere.invalid"),
            (client("tcp/127.0.0.1:1", user=User(name="apr02", password_file=Path("secret"))), "secret: no such file"),
            (client("tcp/127.0.0.1:1", user=User(name="apr02", password_env="NOT_SET_ANYWHERE")), "NOT_SET_ANYWHERE"),
            (router("tcp/127.0.0.1:0", extra={"transport/link/tx/leese": 1000}), "'transport/link/tx/lease'"),
            (router("tcp/127.0.0.1:0", extra={"transport/link/tx/lease": "long"}), "extra: transport/link/tx/lease: "),
        ],
        ids=["another machine", "nobody", "unknown host", "no file", "no variable", "unknown setting", "wrong setting"],
    )
    def test_what_cannot_be_opened_is_named(self, config: SessionConfig, named: str) -> None:
        assert named in self.refusal(config)

    def test_nothing_listens_where_a_router_connects_to(self, address: str, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("omnibench.live.network._CONNECT_TIMEOUT", 0.1)
        elsewhere = f"tcp/127.0.0.1:{free_port()}"
        assert "nothing listens there" in self.refusal(router(address, connect=(elsewhere,)))
        with socket.create_server(("127.0.0.1", int(address.rsplit(":", 1)[1]))):
            pass  # the session that failed does not listen any more

    def test_something_else_listens(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as server:
            soon = {"transport/unicast/open_timeout": 300}
            text = self.refusal(client(f"tcp/127.0.0.1:{server.getsockname()[1]}", extra=soon))
        assert "is not a Zenoh router" in text

    @pytest.mark.parametrize(
        ("content", "reason"), [("", "holds no user"), ("\n\n", "holds no user"), ("a:b\napr02\n", "line 2")]
    )
    def test_users_file_that_is_none(self, address: str, tmp_path: Path, content: str, reason: str) -> None:
        users = tmp_path / "users.txt"
        users.write_text(content)
        assert reason in self.refusal(router(address, users_file=users))

    def test_a_key_expression_that_is_none(self, address: str, tmp_path: Path) -> None:
        users = tmp_path / "users.txt"
        users.write_text("me:secret\n")
        rules = config(listen=address, users_file=users, access={"rules": [{"who": "me", "read": "a//b"}]})
        with pytest.raises(ConfigError, match="'a//b'"):
            open_session(rules, "node")


def test_settings_of_zenoh_reach_it(address: str) -> None:
    with (
        open_session(router(address), "router"),
        open_session(client(address, extra={"namespace": "hall"}), "inside") as inside,
        open_session(client(address), "outside") as outside,
        received(outside, "hall/key") as samples,
    ):
        publish_until(inside, "key", lambda: samples)


@pytest.mark.parametrize(
    ("data", "named"),
    [
        ({"listen": "127.0.0.1:7447"}, "'127.0.0.1:7447' is not an endpoint"),
        ({"listen": ["tcp/127.0.0.1"]}, "endpoint"),
        ({"connect": "tcp/127.0.0.1:70000"}, "endpoint"),
        ({"connect": "http/127.0.0.1:80"}, "endpoint"),
        ({"listne": "tcp/127.0.0.1:7447"}, "'listen'"),
        ({"mode": "broker"}, "mode"),
        ({"mode": "client", "listen": "tcp/127.0.0.1:1"}, "listen"),
        ({"mode": "client", "users_file": "users.txt"}, "users_file"),
        ({"listen": "tls/127.0.0.1:7447"}, "tls"),
        ({"tls": {"ca": "ca.pem", "mutual": False}}, "certificate and its key"),
        ({"tls": {"ca": "ca.pem"}}, "mutual: false"),
        ({"tls": {"ca": "a", "certificate": "b"}}, "certificate and key together"),
        ({"tls": {"ca": "a", "certificate": "b", "key": "c"}, "listen": "tcp/127.0.0.1:1"}, "not encrypted"),
        ({"access": {"robots": ["apr02"]}}, "access"),
        ({"users_file": "u", "access": {}}, "names nobody"),
        ({"users_file": "u", "access": {"rules": [{"who": "me"}]}}, "write or to read"),
        ({"user": {"name": "me"}}, "password, password_file, password_env"),
        ({"mode": "peer", "connect": "tcp/h:1", "user": {"name": "a", "password": "b"}}, "client"),
    ],
)
def test_configs_that_cannot_be_are_refused(data: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(named)):
        config(**data)


def test_paths_start_from_the_config_files_folder_and_no_password_is_written_out(tmp_path: Path) -> None:
    files = {"ca": "keys/ca.pem", "certificate": "/etc/node.pem", "key": "keys/node.key"}
    given = {"tls": files, "users_file": "users.txt", "user": {"name": "me", "password_file": "me.password"}}
    (tmp_path / "session.yaml").write_text(json.dumps(given))
    there = read_model(SessionConfig, tmp_path / "session.yaml")
    assert (there.tls.ca, there.tls.certificate) == (tmp_path / "keys/ca.pem", Path("/etc/node.pem"))
    assert (there.users_file, there.user.password_file) == (tmp_path / "users.txt", tmp_path / "me.password")
    assert "tops3cret" not in to_yaml(config(user={"name": "me", "password": "tops3cret"}))


def test_listening_to_a_network_without_any_protection_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    endpoint = f"tcp/0.0.0.0:{free_port()}"
    assert config(listen=endpoint).unprotected == (endpoint,)
    assert config(listen=endpoint, users_file="users.txt").unprotected == ()
    assert config(listen="tcp/127.0.0.1:7447").unprotected == ()
    with open_session(config(listen=endpoint), "node apr"):
        assert f"node apr listens at {endpoint}, where anybody on the network may connect" in caplog.text


def files(folder: Path, name: str, key: str | None = None) -> tuple[Path, Path, Path]:
    """The authority's certificate, a name's, and its key."""
    return folder / "ca.pem", folder / f"{name}.pem", folder / (key or f"{name}.key")


def test_a_certificate_carries_its_name_and_its_hosts(tmp_path: Path) -> None:
    make_keys(tmp_path, ["node"], hosts=["base.local", "192.168.0.2"])
    certificate = read_certificate(tmp_path / "node.pem")
    assert certificate.subject.rfc4514_string() == "CN=node"
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["localhost", "base.local"]
    addresses = [ipaddress.ip_address(text) for text in ("127.0.0.1", "::1", "192.168.0.2")]
    assert names.get_values_for_type(x509.IPAddress) == addresses


@pytest.mark.parametrize(
    ("names", "router", "server"),
    [(["node", "apr02"], None, "node"), (["base", "node"], "base", "base"), (["apr02", "screen"], None, None)],
)
def test_only_the_router_may_serve(tmp_path: Path, names: list[str], router: str | None, server: str | None) -> None:
    make_keys(tmp_path, names, router=router)
    verify = ["openssl", "verify", "-x509_strict", "-CAfile", "ca.pem", "-purpose"]
    for name in names:
        for purpose in ("sslserver", "sslclient"):
            done = subprocess.run([*verify, purpose, f"{name}.pem"], cwd=tmp_path, check=False)
            assert (done.returncode == 0) == (purpose == "sslclient" or name == server)
        extensions = read_certificate(tmp_path / f"{name}.pem").extensions
        hosts = [each for each in extensions if isinstance(each.value, x509.SubjectAlternativeName)]
        assert bool(hosts) == (name == server)


def test_what_is_secret_is_for_its_owner_only(tmp_path: Path) -> None:
    for path in make_keys(tmp_path, ["apr02"], users=True):
        mode = stat.S_IMODE(path.stat().st_mode)
        assert mode & 0o077 == (0o044 if path.suffix == ".pem" else 0), path
        assert mode & 0o600 == 0o600


def test_names_are_added_under_the_authority_that_is_there(tmp_path: Path) -> None:
    make_keys(tmp_path, ["node"], users=True)
    before = (tmp_path / "ca.pem").read_bytes()
    written = make_keys(tmp_path, ["apr03"], users=True)
    assert (tmp_path / "ca.pem").read_bytes() == before
    assert sorted(path.name for path in written) == ["apr03.key", "apr03.password", "apr03.pem", "users.txt"]
    read_certificate(tmp_path / "apr03.pem").verify_directly_issued_by(read_certificate(tmp_path / "ca.pem"))
    users = dict(line.split(":") for line in (tmp_path / "users.txt").read_text().splitlines())
    assert users == {name: (tmp_path / f"{name}.password").read_text().strip() for name in ("node", "apr03")}


def test_nothing_is_replaced_unless_asked(tmp_path: Path) -> None:
    make_keys(tmp_path, ["node", "apr02"])
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ConfigError, match=r"apr02\.pem: is there already"):
        make_keys(tmp_path, ["apr03", "apr02"])
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    make_keys(tmp_path, ["node", "apr02"], overwrite=True)
    assert all(path.read_bytes() != content for path, content in before.items())


def test_a_certificate_does_not_outlive_its_authority(tmp_path: Path) -> None:
    make_keys(tmp_path, ["node"], days=30)
    make_keys(tmp_path, ["apr02"], days=300)
    ends = [read_certificate(tmp_path / f"{name}.pem").not_valid_after_utc for name in ("ca", "node", "apr02")]
    assert ends[0] == ends[1] == ends[2]
    assert abs(ends[0] - datetime.now(UTC) - timedelta(days=30)) < timedelta(minutes=5)


@pytest.mark.parametrize(
    ("names", "options", "named"),
    [
        *(([*names], {}, "") for names in (("../up",), ("",), ("ca",), ("users",), ("a b",), ("x" * 65,), ("a", "a"))),
        (["apr02", "apr03"], {"router": "node"}, "apr02, apr03"),
        (["apr02", "apr03"], {"hosts": ["base.local"]}, "--router"),
        *(
            (["node"], {"hosts": [host]}, host)
            for host in ("", "a b", "tls/base.local:7447", "base.local:7447", "-base", "192.168.0.256", "1.2.3")
        ),
        (["node"], {"hosts": ["ä.local"]}, ""),
        (["node"], {"hosts": ["x" * 64]}, ""),
    ],
)
def test_impossible_names_are_refused(tmp_path: Path, names: list[str], options: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(named) or None):
        make_keys(tmp_path, names, **options)
    assert not list(tmp_path.iterdir())


def test_an_authority_without_its_key_can_sign_nobody(tmp_path: Path) -> None:
    make_keys(tmp_path, ["node"])
    (tmp_path / "ca.key").unlink()
    with pytest.raises(ConfigError, match=r"ca\.key is missing"):
        make_keys(tmp_path, ["apr02"])


def encrypt(folder: Path) -> None:
    command = ["openssl", "pkey", "-in", "node.key", "-aes256", "-passout", "pass:secret", "-out", "locked.key"]
    subprocess.run(command, cwd=folder, check=True)


@pytest.mark.parametrize(
    ("change", "key", "named"),
    [
        (lambda folder: (folder / "node.pem").unlink(), None, "node.pem: no such file"),
        (lambda folder: (folder / "ca.pem").unlink() or (folder / "ca.pem").mkdir(), None, "is a folder"),
        (lambda folder: (folder / "node.pem").write_text("garbage"), None, "node.pem holds no certificate"),
        (Path.resolve, "node.pem", "node.pem holds no private key"),
        (Path.resolve, "apr02.key", "apr02.key is not the key of"),
        (encrypt, "locked.key", "locked.key is encrypted"),
        (lambda folder: expire(folder, "node", datetime(2020, 1, 1, tzinfo=UTC)), None, "node.pem expired on 2020"),
        (lambda folder: expire(folder, "node", datetime.now(UTC) + timedelta(days=2)), None, "clock"),
    ],
    ids=["missing", "a folder", "garbage", "no key", "another's key", "encrypted", "expired", "of the future"],
)
def test_files_that_cannot_be_used_are_named(tmp_path: Path, change: Any, key: str | None, named: str) -> None:
    make_keys(tmp_path, ["node", "apr02"])
    change(tmp_path)
    with pytest.raises(ConfigError, match=named):
        check_files(*files(tmp_path, "node", key))


def test_a_clients_certificate_and_one_that_expires_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    make_keys(tmp_path, ["node", "apr02"])
    check_files(*files(tmp_path, "node"), listening=True)
    with pytest.raises(ConfigError, match=r"apr02\.pem is a client's"):
        check_files(*files(tmp_path, "apr02"), listening=True)
    assert not caplog.text
    expire(tmp_path, "node", datetime.now(UTC) - timedelta(hours=12))
    check_files(*files(tmp_path, "node"))
    assert "node.pem expires on" in caplog.text


def expire(folder: Path, name: str, start: datetime) -> None:
    """Make a name's certificate anew, valid for the day from ``start``."""

    old, authority = read_certificate(folder / f"{name}.pem"), read_certificate(folder / "ca.pem")
    builder = (
        x509.CertificateBuilder(extensions=list(old.extensions))
        .subject_name(old.subject)
        .issuer_name(authority.subject)
        .public_key(old.public_key())
        .serial_number(old.serial_number)
        .not_valid_before(start)
        .not_valid_after(start + timedelta(days=1))
    )
    key = read_key(folder / "ca.key")
    assert isinstance(key, EllipticCurvePrivateKey)
    signed = builder.sign(key, hashes.SHA256())
    (folder / f"{name}.pem").write_bytes(signed.public_bytes(Encoding.PEM))
