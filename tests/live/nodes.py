"""Nodes for tests, in this process or as the command that a user runs, and what comes on keys of a session."""

import json
import os
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import yaml
import zenoh
from commands import COMMAND, ENVIRONMENT
from drives import calibration
from sessions import free_port, raw_session, until
from timing import PATIENCE

from omnibench.live.config import LiveConfig, read_live_config
from omnibench.live.node import LiveNode
from omnibench.live.wire import JOINT_STATE, JointState, Odometry
from omnibench.robot.calibration import write_calibration


def write_node(folder: Path, *robots: str, port: int | None = None, **changes: Any) -> Path:
    """A node's config: robots of the synthetic kind, fusion on, on a free port."""
    write_calibration(calibration(), folder / "calibration.yaml")
    config = {
        "robots": [{"name": name, "calibration": "calibration.yaml"} for name in robots],
        "fusion": "ekf",
        "zenoh": {"listen": f"tcp/127.0.0.1:{port or free_port()}"},
        **changes,
    }
    file = folder / "node.yaml"
    file.write_text(yaml.safe_dump(config), encoding="utf-8")
    return file


def config_of(folder: Path, *robots: str, **changes: Any) -> LiveConfig:
    """The same, read."""
    return read_live_config(write_node(folder, *(robots or ("apr",)), **changes))


@contextmanager
def running(config: LiveConfig) -> Iterator[tuple[LiveNode, zenoh.Session]]:
    """A node and a client of it."""
    with LiveNode(config) as node:
        (endpoint,) = config.zenoh.listening
        session = raw_session("client", connect=[endpoint])
        try:
            yield node, session
        finally:
            session.close()


class Command:
    """``omnibench`` as a process, with what it says on standard error, which can be read while it runs."""

    def __init__(self, *arguments: object, cwd: Path | None = None) -> None:
        self._errors = os.memfd_create("errors")  # a file in memory, which can be read while it is written
        self.process = subprocess.Popen(
            [*COMMAND, *map(str, arguments)],
            cwd=cwd,
            env=ENVIRONMENT,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
        )

    def said(self) -> str:
        """What it has said on standard error."""
        return os.pread(self._errors, os.fstat(self._errors).st_size, 0).decode()

    def kill(self) -> None:
        """As when the machine fails: no farewell."""
        self.process.kill()
        self.process.communicate()

    def stop(self, number: int = signal.SIGINT) -> tuple[str, str]:
        """End it as a user does; what it printed."""
        if self.process.poll() is None:
            os.kill(self.process.pid, number)
        return self.ended()

    def ended(self) -> tuple[str, str]:
        """What it printed, when it has ended."""
        out, _ = self.process.communicate(timeout=PATIENCE)
        return out, self.said()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.kill()
        os.close(self._errors)


def asked(session: zenoh.Session, selector: str, payload: str | bytes | None = None) -> Any:
    """The one answer to a query: its JSON, with ``error`` in it when it was refused.

    Asked again as long as nobody is there to answer: a node's port is open a little before it is ready.
    """
    replies: list[zenoh.Reply] = []

    def answered() -> bool:
        replies.extend(session.get(selector, payload=payload, timeout=PATIENCE))
        return bool(replies)

    until(answered, f"an answer to {selector}")
    (reply,) = replies
    answer = reply.ok if reply.ok is not None else reply.err
    return json.loads(answer.payload.to_bytes())


def sent(publisher: zenoh.Publisher, samples: list[JointState]) -> None:
    for sample in samples:
        publisher.put(JOINT_STATE.encode(sample))


def sent_one_by_one(publisher: zenoh.Publisher, samples: list[JointState], heard: Sequence[Odometry]) -> None:
    """Send samples, each once the odometry of the one before was heard.

    In a burst some could be late on a busy machine, and of late ones only the newest has odometry.
    """
    for sample in samples:
        sent(publisher, [sample])
        until(lambda stamp=sample.stamp: heard and heard[-1].stamp == stamp, "odometry")


def peak_memory(process: int) -> int:
    """The most memory that a process has had, in MB."""
    lines = Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) // 1024 for line in lines if line.startswith("VmHWM"))


def connected(port: int, token: str | None = None) -> zenoh.Session:
    """A client of whoever listens there, once somebody does; token: whose liveliness it waits for, too."""
    sessions: list[zenoh.Session] = []

    def alive() -> bool:
        try:
            session = raw_session("client", connect=[f"tcp/127.0.0.1:{port}"])
        except zenoh.ZError:
            return False
        if token is None or any(reply.ok for reply in session.liveliness().get(token)):
            sessions.append(session)
            return True
        session.close()
        return False

    until(alive, "a router or node")
    return sessions[0]


def wheels_of(session: zenoh.Session, robot: str = "apr", topic: str = "joint_states") -> zenoh.Publisher:
    """A publisher that the node has subscribed to; bursts lose nothing."""
    publisher = session.declare_publisher(f"{robot}/{topic}", congestion_control=zenoh.CongestionControl.BLOCK)
    until(lambda: publisher.matching_status.matching, "the node's subscription")
    return publisher


class ReceivedMessages:
    """Everything that comes on some keys, decoded."""

    def __init__(self, session: zenoh.Session, **kinds: Any) -> None:
        self.messages: dict[str, list[Any]] = {key: [] for key in kinds}
        self._subscribers = [
            session.declare_subscriber(key.replace("__", "/"), self._taker(key, kind)) for key, kind in kinds.items()
        ]

    def _taker(self, key: str, kind: Any) -> Any:
        return lambda sample: self.messages[key].append(kind.decode(sample.payload.to_bytes()))

    def __getitem__(self, key: str) -> list[Any]:
        return self.messages[key]
