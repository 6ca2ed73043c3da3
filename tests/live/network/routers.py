"""A router in its own process, and configs of sessions with it, for tests of security."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import zenoh
from sessions import free_port, until
from timing import PATIENCE

from omnibench.errors import ConfigError
from omnibench.live.network.session import open_session
from omnibench.live.network.session_config import SessionConfig, Tls, User

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
            process.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
    assert process.returncode == 0, router.errors.read_text()


def mutual(keys: Path) -> dict[str, Any]:
    tls = {"ca": str(keys / "ca.pem"), "certificate": str(keys / "node.pem"), "key": str(keys / "node.key")}
    return {"listen": f"tls/127.0.0.1:{free_port()}", "tls": tls, "access": ACCESS}


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
