"""Intruders against a router in its own process: they are refused and logged, and peers get in."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
import zenoh
from routers import RouterProcess, member, mutual, refusal, running, user, works
from sessions import free_port, until

from omnibench.live.network.access_log import AccessLog
from omnibench.live.network.session import open_session, zenoh_config
from omnibench.live.network.session_config import SessionConfig, Tls, User


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

    def test_a_member_cannot_pose_as_the_router(self, fleet: RouterProcess, keys: Path) -> None:
        config = mutual(keys)
        settings = zenoh_config(SessionConfig.model_validate(config))
        for side in ("listen", "connect"):  # omnibench itself would not start with a client's certificate
            settings.insert_json5(f"transport/link/tls/{side}_certificate", json.dumps(str(keys / "apr02.pem")))
            settings.insert_json5(f"transport/link/tls/{side}_private_key", json.dumps(str(keys / "apr02.key")))
        victim = member(fleet, keys, "apr03").model_copy(update={"connect": (config["listen"],)})
        assert victim.tls is not None
        with zenoh.open(settings):
            for verify_name in (True, False):
                tls = victim.tls.model_copy(update={"verify_name": verify_name})
                text = refusal(victim.model_copy(update={"tls": tls}))
                assert "we refuse its certificate: unsuitable certificate purpose" in text

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

            def refused() -> bool:
                session.put("apr03/joint_states", b"forged")
                return users.has_logged("user 'apr02' at tcp/127.0.0.1:")

            until(refused, "the refusal in the log")
            assert users.has_logged("may not write apr03/joint_states")
            works(session, users)
        assert users.got("apr03/joint_states") == 0


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
        process = subprocess.run([sys.executable, "-c", _PROGRAM, str(config)], capture_output=True, check=False)
        assert (process.returncode, process.stderr) == (0, b"")
        assert sorted(process.stdout.split(b"\n")) == [b"before", b"of a child", b"printed", b"unended"]

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
from omnibench.config import read_model
from omnibench.live.network.access_log import log_refused_access
from omnibench.live.network.session import open_session
from omnibench.live.network.session_config import SessionConfig
config = read_model(SessionConfig, Path(sys.argv[1]))
print("before")
with log_refused_access(config), open_session(config, "router"):
    print("printed")
    subprocess.run(["echo", "of a child"], check=True)
print("unended", end="")
"""
