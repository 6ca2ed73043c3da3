"""A WebSocket server of the robots' topics for the Foxglove application (foxglove-sdk, the extra ``foxglove``)."""

from __future__ import annotations

import errno
import socket
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import zenoh

from omnibench.errors import ConfigError
from omnibench.live.stopping import Closing
from omnibench.live.wire.topics import TOPICS, Arrival, KeySpace, TopicListener

if TYPE_CHECKING:
    from foxglove import Channel

PORT: Final = 8765  # the application's default
STOPPING_S: Final = 5.0  # how long ``close`` waits for its port; without load it is free after some milliseconds


class FoxgloveServer(Closing):
    """Serves the topics given to ``forward`` on ``host`` and ``port`` (0: any free port), until ``close``.

    By default only programs on this machine can connect, because the protocol has no password. A client that is too
    slow loses messages and delays no other.

    ConfigError: foxglove-sdk is not installed, the port is in use, or the host is not an address of this machine.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = PORT) -> None:
        try:
            import foxglove
        except ImportError:
            raise ConfigError(
                'the Foxglove server needs the package foxglove-sdk: pip install "foxglove-sdk"'
            ) from None
        if not 0 <= port <= 65535:
            raise ConfigError(f"Foxglove server: port {port}: expected 0 to 65535")
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(name="omnibench", host=host, port=port, context=self._context)
        except (RuntimeError, OSError) as error:
            reason = str(error).removeprefix("FoxgloveError: ")
            raise ConfigError(
                f"Foxglove server on {host}:{port}: {reason}; close what uses it or choose another host or port"
            ) from None
        self._host, self._port = host, int(self._server.port)
        self.address = f"ws://{host}:{self._port}"
        self._channels: dict[str, Channel] = {}
        self._listeners: list[TopicListener] = []

    def forward(
        self, session: zenoh.Session, keys: KeySpace, robots: Sequence[str], topics: Sequence[str] = tuple(TOPICS)
    ) -> None:
        """Serve the robots' topics from now on, payloads unchanged. ConfigError: no such topic."""
        import foxglove

        listener = TopicListener(session, keys, robots, topics, self._forward)
        for name, topic in listener.topics.items():
            kind = TOPICS[topic]
            schema = foxglove.Schema(name=kind.name, encoding="ros2msg", data=kind.definition.encode())
            self._channels[name] = foxglove.Channel(name, schema=schema, message_encoding="cdr", context=self._context)
        self._listeners.append(listener)

    @property
    def missed(self) -> int:
        """Messages that were published and never came here, so that no client got them."""
        return sum(sum(listener.missed.values()) for listener in self._listeners)

    def close(self) -> None:
        """Stop serving, and return when another server can have the port."""
        for listener in self._listeners:
            listener.close()
        self._server.stop()  # asks the server's threads to stop, and does not wait for them
        end = time.monotonic() + STOPPING_S
        while _in_use(self._host, self._port) and time.monotonic() < end:
            time.sleep(0.002)

    def _forward(self, arrival: Arrival) -> None:
        channel = self._channels.get(arrival.name)
        if channel is not None:
            channel.log(arrival.payload, log_time=arrival.time)


def _in_use(host: str, port: int) -> bool:
    """True if a program listens there, whatever the state of the connections that it had."""
    try:
        socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except OSError as error:
        return error.errno == errno.EADDRINUSE
    return False
