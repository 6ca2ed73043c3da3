"""The system under test: a router, a node, clients and robots, and the proxy that all their links go through."""

from __future__ import annotations

import json
import random
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from mcap.stream_reader import StreamReader

from chaos import proxy
from chaos.faults import Fault, hog
from chaos.programs import COMMAND, PATIENCE, Ending, Program
from chaos.robots import ORIGIN, RECORDING, NumberingRobot, PlainRobot, calibrations, write_recording
from chaos.witness import Witness
from omnibench.config import to_yaml
from omnibench.live.network import SessionConfig, open_session
from omnibench.live.presence import alive_robots
from omnibench.live.topics import GraphNode, KeySpace
from omnibench.robot.calibration import write_calibration

PLAYED, NUMBERED, PLAIN = "played", "numbered", "plain"
NODE_LINK, CLIENT_LINK, ROBOT_LINK = range(3)
_WAIT: Final = 300.0  # s that clients and replays wait for a router or a node; chosen
_ROOM: Final = 50_000  # bytes until a full disk takes no more; chosen
_FLOOD: Final = 1500  # questions at once; chosen


def free_port(rng: random.Random) -> int:
    """A port of 127.0.0.1 below those of the tests, and those that Linux gives to outgoing connections."""
    while True:
        port = rng.randrange(12_000, 20_000)
        with suppress(OSError), socket.socket() as probe:
            probe.bind(("127.0.0.1", port))
            return port


@dataclass(frozen=True)
class Replay:
    """One replay. origin: stamp of its first sample, ns; since: when it was started, s, monotonic."""

    origin: int
    speed: str
    since: float


class System:
    """All programs and robots; ``start`` begins, ``end`` ends them in order."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder = folder
        self.rng = np.random.default_rng(seed)
        self.calibrations = calibrations()
        self.endings: list[Ending] = []
        self.replays: list[Replay] = []  # of this round
        self.recordings: list[Path] = []
        self.disk_was_full = False  # of the node, since the round began
        self.swaps = 0  # calibrations that were sent since the round began
        self.times, self.played_path = write_recording(folder / "data", self.rng, self.calibrations[0])
        self._write_configs()
        logs = folder / "logs"
        logs.mkdir()
        self.router = Program("router", lambda: (*COMMAND, "live", folder / "router.yaml"), logs)
        self.node = Program("node", lambda: (*COMMAND, "live", folder / "node.yaml"), logs)
        client = ("--config", folder / "client.yaml")
        self.listener = Program("listener", lambda: (*COMMAND, "listen", "--json", *client), logs)
        self.recorder = Program("recorder", lambda: (*COMMAND, "record", *self._record(), *client), logs)
        self.replay = Program("replay", lambda: (*COMMAND, "replay", *self._replay(), *client), logs)
        self.programs = (self.router, self.node, self.listener, self.recorder, self.replay)
        self._links: subprocess.Popen[str] | None = None

    def start(self) -> None:
        ports = self._ports
        self._start_links()
        for program in (self.router, self.node, self.listener, self.recorder):
            program.start()
        self.witness = Witness(ports["node"])
        robots = SessionConfig(mode="client", connect=(f"tcp/127.0.0.1:{ports['to_robots']}",), wait=_WAIT)
        self._robots = open_session(robots, "chaos")
        self.numbered = NumberingRobot(NUMBERED, 1, GraphNode(self._robots, KeySpace(), "robot"))
        self.plain = PlainRobot(PLAIN, 2, self.witness.session)
        self._flood = open_session(
            SessionConfig(mode="client", connect=(f"tcp/127.0.0.1:{ports['node']}",), wait=_WAIT), "chaos"
        )
        for robot in (self.numbered, self.plain):
            robot.start()

    def _start_links(self) -> None:
        """Start the proxy, all links open."""
        ports = self._ports
        links = (f"127.0.0.1:{ports[port]}:{ports['router']}" for port in ("to_node", "to_clients", "to_robots"))
        self._links = subprocess.Popen(
            [sys.executable, proxy.__file__, *links],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        assert self._links.stdout is not None
        self._links.stdout.readline()

    def end(self) -> None:
        """Ask every program to end, take its end, and leave."""
        for robot in (self.numbered, self.plain):
            robot.close()
        for session in (self._robots, self._flood):
            session.close()
        self.witness.close()
        for program in (self.replay, self.listener, self.recorder, self.node, self.router):
            if program.running:
                self.endings.append(program.end(int(self.rng.choice([signal.SIGINT, signal.SIGTERM]))))
        assert self._links is not None
        assert self._links.stdin is not None
        self._links.stdin.close()
        self._links.wait(PATIENCE)

    def abandon(self) -> None:
        """Kill all that was started, where it could not be started whole."""
        for program in self.programs:
            if program.running:
                program.kill()
        if self._links is not None:
            self._links.kill()
            self._links.wait()

    def link(self, number: int, state: str, rate: float | None = None) -> None:
        """Change a link of the proxy."""
        assert self._links is not None
        assert self._links.stdin is not None
        with suppress(BrokenPipeError):  # it was killed; the next one begins with open links
            self._links.stdin.write(json.dumps({"link": number, "state": state, "rate": rate}) + "\n")
            self._links.stdin.flush()

    def node_in_sight(self) -> bool:
        """True if the network beyond the router knows of the node's robots."""
        return PLAYED in alive_robots(self._robots)

    def start_replay(self) -> None:
        """Play the recording once more, with stamps after those of all before it."""
        speed = str(self.rng.choice(["max", "20", "8"]))
        origin = ORIGIN + (self.replay.starts + 1) * round(1e9 * (RECORDING + 10))
        self.replays.append(Replay(origin, speed, time.monotonic()))
        self.replay.start()

    def kinds(self) -> list[Fault]:
        """The faults that can befall it."""
        faults = []
        for program in self.programs:
            name = program.name
            faults.append(Fault(f"stop {name}", name, lambda p=program: self._pause(p), 0.2, 6.0))
            faults.append(Fault(f"kill {name}", name, lambda p=program: self._kill(p), 0.0, 3.0, 0.5))
            faults.append(Fault(f"ask {name} to end", name, lambda p=program: self._ask(p), 0.0, 1.0, 0.3))
        faults.append(Fault("stop proxy", "links", self._pause_links, 0.2, 6.0, 0.5))
        faults.append(Fault("kill proxy", "links", self._kill_links, 0.0, 3.0, 0.5))
        faults.append(Fault("stop node for long", "node", lambda: self._pause(self.node), 11.0, 15.0, 0.1))
        for number, name in enumerate(("node", "clients", "robots")):
            target = f"link of {name}"
            faults += [
                Fault(f"cut {target}", target, lambda n=number: self._change(n, "cut"), 0.1, 5.0),
                Fault(f"stall {target}", target, lambda n=number: self._change(n, "stalled"), 0.1, 5.0),
                Fault(f"slow {target}", target, lambda n=number: self._change(n, "slow", 2e5), 1.0, 6.0),
            ]
        faults += [
            Fault("processor hog", "", hog, 1.0, 10.0, 2.0),
            Fault("disk of node full", "disk of node", self._fill_nodes_disk, 1.0, 8.0),
            Fault("disk of recorder full", "disk of recorder", self._fill_recorders_disk, 1.0, 8.0, 0.5),
            Fault("radio loses", "radio", lambda: self._lose(float(self.rng.choice([0.02, 0.2, 0.5]))), 1.0, 6.0),
            Fault("stamps jump", "", lambda: self.plain.jump(float(self.rng.choice([-30.0, -0.5, 0.5, 2.0, 3600.0])))),
            Fault("junk", "", lambda: self.plain.send_junk(int(self.rng.integers(1, 200)))),
            Fault("flood of queries", "", self._ask_much),
            Fault("swap", "", self._swap, weight=2.0),
            Fault("swap of nonsense", "", self._swap_nonsense),
        ]
        return faults

    def _write_configs(self) -> None:
        rng = random.Random(time.time_ns())
        names = ("router", "node", "to_node", "to_clients", "to_robots")
        self._ports = ports = {name: free_port(rng) for name in names}
        write_calibration(self.calibrations[0], self.folder / "calibration.yaml")
        own: dict[str, Any] = {"mode": "router", "listen": f"tcp/127.0.0.1:{ports['node']}"}
        fusions = {PLAYED: "ekf", NUMBERED: "none", PLAIN: "ekf"}
        robots = [
            {"name": name, "calibration": "calibration.yaml", "fusion": fusion} for name, fusion in fusions.items()
        ]
        configs: dict[str, Any] = {
            "router": {"name": "hub", "zenoh": {"mode": "router", "listen": f"tcp/127.0.0.1:{ports['router']}"}},
            "node": {
                "robots": robots,
                "state": "state",
                "zenoh": own | {"connect": f"tcp/127.0.0.1:{ports['to_node']}", "wait": _WAIT},
            },
            "client": {
                "zenoh": {"mode": "client", "connect": f"tcp/127.0.0.1:{ports['to_clients']}", "wait": _WAIT},
            },
        }
        for name, config in configs.items():
            (self.folder / f"{name}.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")

    def _record(self) -> tuple[object, ...]:
        self.recordings.append(self.folder / f"recording-{len(self.recordings)}.mcap")
        return PLAYED, NUMBERED, "-o", self.recordings[-1]

    def _replay(self) -> tuple[object, ...]:
        replay = self.replays[-1]
        settings = ("--set", f"stamp_origin={replay.origin}", "--set", f"wait={_WAIT:g}")
        return self.folder / "data", "--robot", PLAYED, "--speed", replay.speed, *settings

    def _pause(self, program: Program) -> Callable[[], object] | None:
        if not program.running:
            return None
        program.pause()
        return program.resume

    def _kill(self, program: Program) -> Callable[[], object] | None:
        if not program.running:
            return None
        self.endings.append(program.kill())
        return None if program is self.replay else program.start

    def _pause_links(self) -> Callable[[], object]:
        links = self._links
        assert links is not None
        links.send_signal(signal.SIGSTOP)
        return lambda: links.send_signal(signal.SIGCONT)

    def _kill_links(self) -> Callable[[], object]:
        assert self._links is not None
        self._links.kill()
        self._links.wait()
        return self._start_links

    def _ask(self, program: Program) -> Callable[[], object] | None:
        """Ask a program to end, which it must, and start it again."""
        if not program.running or not program.can_end:
            return None
        program.ask(int(self.rng.choice([signal.SIGINT, signal.SIGTERM])))

        def take_end() -> None:
            self.endings.append(program.ending())
            if program is not self.replay:
                program.start()

        return take_end

    def _change(self, number: int, state: str, rate: float | None = None) -> Callable[[], object]:
        self.link(number, state, rate)
        return lambda: self.link(number, "open")

    def _fill_disk(self, program: Program, size: int) -> Callable[[], object]:
        program.limit_files(size)
        return lambda: program.limit_files(None)

    # Only once a process has its session: Zenoh needs room for shared memory when it opens one.
    def _fill_nodes_disk(self) -> Callable[[], object] | None:
        if not self.witness.alive():
            return None
        self.disk_was_full = True
        return self._fill_disk(self.node, 0)

    def _fill_recorders_disk(self) -> Callable[[], object] | None:
        file = self.recordings[-1]
        return self._fill_disk(self.recorder, file.stat().st_size + _ROOM) if file.exists() else None

    def _lose(self, share: float) -> Callable[[], object]:
        self.numbered.losing = share
        return lambda: setattr(self.numbered, "losing", 0.0)

    def _ask_much(self) -> None:
        for _ in range(_FLOOD):
            self._flood.get("omnibench/*/health", lambda _: None, timeout=1.0)

    def _swap(self) -> None:
        self.swaps += 1
        chosen = self.calibrations[int(self.rng.integers(2))]
        self._flood.put(f"omnibench/{NUMBERED}/calibration", to_yaml(chosen).encode())

    def _swap_nonsense(self) -> None:
        nonsense = [b"junk: [", b"x" * 10_000_000, to_yaml(self.calibrations[0]).replace("a", "z").encode()]
        self._flood.put(f"omnibench/{NUMBERED}/calibration", nonsense[int(self.rng.integers(3))])


def read_recording(file: Path) -> int:
    """Messages in an MCAP file, however its writer ended. Exceptions of the reader: it is damaged."""
    with file.open("rb") as stream:
        return sum(
            type(record).__name__ == "Message" for record in StreamReader(stream, record_size_limit=None).records
        )


def messages_said(said: str) -> int | None:
    """The number of messages that a recorder says it has written; None: it did not say it."""
    found = re.findall(r"([\d,]+) messages?, [\d.]+ MB", said)
    return int(found[-1].replace(",", "")) if found else None
