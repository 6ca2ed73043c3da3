"""Intruders against a router in its own process: they are refused, and peers get in."""

from __future__ import annotations

import json
import re
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh
from routers import RouterProcess, member, mutual, refusal, running, user, works
from sessions import free_port, until

from omnibench.cli.handbook_topics import find_topic
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

    def test_another_authority_is_refused(self, fleet: RouterProcess, keys: Path) -> None:
        text = refusal(member(fleet, keys / "other", "apr02", ca=keys / "ca.pem"))
        assert "our certificate is not from its authority" in text

    def test_no_certificate_is_refused(self, fleet: RouterProcess, keys: Path) -> None:
        tls = Tls(ca=keys / "ca.pem", mutual=False)
        assert "it asks for a certificate" in refusal(SessionConfig(mode="client", connect=(fleet.address,), tls=tls))

    def test_no_encryption_is_refused(self, fleet: RouterProcess) -> None:
        plain = fleet.address.replace("tls", "tcp")
        assert "asks for TLS" in refusal(SessionConfig(mode="client", connect=(plain,)))

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
                stranger.put("apr03/joint_states", b"forged")
                works(session, fleet)
        assert fleet.got("apr03/joint_states") == 0


class TestUsers:
    def test_rightful_users_work_and_nothing_is_logged(self, users: RouterProcess, keys: Path) -> None:
        with open_session(user(users, keys, "apr02"), "apr02") as session:
            works(session, users)
        assert users.errors.read_text() == ""

    @pytest.mark.parametrize(
        "who",
        ["apr02", "nobody", None],
    )
    def test_wrong_ones_are_refused(self, users: RouterProcess, who: str | None) -> None:
        shown = None if who is None else User.model_validate({"name": who, "password": "guessed"})
        text = refusal(SessionConfig(mode="client", connect=(users.address,), user=shown))
        assert "may ask for a user and password" in text if who is None else f"refuses user '{who}'" in text

    def test_a_users_rights_are_its_own(self, users: RouterProcess, keys: Path) -> None:
        with open_session(user(users, keys, "apr02"), "apr02") as session:
            session.put("apr03/joint_states", b"forged")
            works(session, users)
        assert users.got("apr03/joint_states") == 0


class TestZenohsOwnLog:
    @pytest.mark.parametrize("asked", [True, False])
    def test_it_names_who_was_refused_what_if_the_guides_line_asks_for_it(
        self, keys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: bool
    ) -> None:
        line = re.search(r"RUST_LOG=(\S+)", find_topic("live").text)
        assert line is not None
        with ExitStack() as entered:
            with monkeypatch.context() as environment:  # of the router's process: in this one Zenoh would log for ever
                environment.setenv("RUST_LOG", line[1] if asked else "off")
                router = entered.enter_context(running(tmp_path / "router", mutual(keys)))
            refusal(member(router, keys / "other", "apr02", ca=keys / "ca.pem"))
            with open_session(member(router, keys, "apr02"), "apr02") as session:
                session.put("apr03/joint_states", b"forged")
                works(session, router)
            refused = ("UnknownIssuer", r"CertCommonName\(apr02\).* is unauthorized to Put .* on apr03/joint_states")
            for pattern in refused:
                until(lambda wanted=pattern: bool(re.search(wanted, router.output.read_text())) or not asked, pattern)
                assert bool(re.search(pattern, router.output.read_text())) == asked
