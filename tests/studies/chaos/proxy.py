"""A TCP proxy whose links can be cut, stalled and slowed, as a process of its own.

    python proxy.py 127.0.0.1:21001:21000 ...

Each argument is a link: address, port to listen on, port to pass on to. Lines of JSON on standard input change a link:
``{"link": 0, "state": "cut"}``, with the states open, cut (connections are reset, new ones refused), stalled (nothing
passes, nothing is closed) and slow (``rate`` bytes a second). It ends with its standard input.
"""

from __future__ import annotations

import asyncio
import json
import sys

_CHUNK = 65_536  # bytes that are passed on at once


class Link:
    """One port, passed on to another."""

    def __init__(self, host: str, port: int, target: int) -> None:
        self._host, self._port, self._target = host, port, target
        self._passing = asyncio.Event()
        self._passing.set()
        self._cut = False
        self._rate: float | None = None  # bytes/s; None: as fast as it goes
        self._writers: set[asyncio.StreamWriter] = set()

    async def listen(self) -> None:
        await asyncio.start_server(self._connected, self._host, self._port)

    def change(self, state: str, rate: float | None) -> None:
        self._cut, self._rate = state == "cut", rate if state == "slow" else None
        if state == "stalled":
            self._passing.clear()
        else:
            self._passing.set()
        if self._cut:
            for writer in list(self._writers):
                writer.transport.abort()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._cut:
            writer.transport.abort()
            return
        try:
            there, back = await asyncio.open_connection(self._host, self._target)
        except OSError:
            writer.transport.abort()
            return
        both = {writer, back}
        self._writers |= both
        await asyncio.gather(self._pass(reader, back), self._pass(there, writer))
        self._writers -= both

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(_CHUNK):
                await self._passing.wait()
                if self._rate is not None:
                    await asyncio.sleep(len(data) / self._rate)
                writer.write(data)
                await writer.drain()
        except OSError:
            pass
        finally:
            writer.close()


async def main(arguments: list[str]) -> None:
    links = []
    for argument in arguments:
        host, port, target = argument.split(":")
        links.append(Link(host, int(port), int(target)))
        await links[-1].listen()
    orders = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(orders), sys.stdin)
    print("ready", flush=True)
    while line := await orders.readline():
        order = json.loads(line)
        links[order["link"]].change(order["state"], order.get("rate"))


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1:]))
