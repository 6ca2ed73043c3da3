"""Real Zenoh sessions on loopback for tests, and waiting for what they bring about."""

import json
import socket
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from zlib import crc32

import zenoh
from shared_results import shared_folder
from timing import until as until


def free_port() -> int:
    """A TCP port of 127.0.0.1 that nobody listens on; each is given out once a run of the suite.

    Linux gives ports from 32768 on to outgoing connections, one of which could take a port before its listener does.
    """
    for port in count(20_000 + crc32(str(shared_folder()).encode()) % 10_000):  # another run begins elsewhere
        with suppress(OSError), socket.socket() as probe:
            # Before the probe: to bind a port that was given out could be just when its listener does.
            (shared_folder() / f"port-{port}").touch(exist_ok=False)
            probe.bind(("127.0.0.1", port))
            return port
    raise AssertionError


def raw_session(mode: str, *, listen: Sequence[str] = (), connect: Sequence[str] = ()) -> zenoh.Session:
    """A session by zenoh's own settings, without scouting."""
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5("listen/endpoints", json.dumps(list(listen)))
    config.insert_json5("connect/endpoints", json.dumps(list(connect)))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    config.insert_json5("scouting/delay", "0")  # or a router waits 0.5 s for nobody
    return zenoh.open(config)


@dataclass
class Loopback:
    """A router on a free port, and clients of it; ``close`` closes all."""

    port: int
    router: zenoh.Session
    _clients: list[zenoh.Session] = field(default_factory=list)

    @property
    def address(self) -> str:
        return f"tcp/127.0.0.1:{self.port}"

    def client(self) -> zenoh.Session:
        """Another session, connected to the router."""
        session = raw_session("client", connect=[self.address])
        self._clients.append(session)
        return session

    def close(self) -> None:
        for session in (*self._clients, self.router):
            if not session.is_closed():
                session.close()


def open_loopback() -> Loopback:
    """A router on a free port."""
    port = free_port()
    return Loopback(port, raw_session("router", listen=[f"tcp/127.0.0.1:{port}"]))
