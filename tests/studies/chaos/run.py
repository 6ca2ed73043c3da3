"""The suite: rounds of faults, each ended by healing all and an account of every sample."""

from __future__ import annotations

import json
import re
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Final

import numpy as np

from chaos.audit import Account
from chaos.faults import Faults
from chaos.ledger import ROBOTS, Ledger
from chaos.programs import PATIENCE, Ending
from chaos.robots import STEP, Robot
from chaos.system import System, messages_said, read_recording

_ROUND: Final = 25.0  # s of faults until the next account; chosen
_TICK: Final = 0.05  # s
_SAID: Final = 5.0  # s between two lines of progress; chosen
_WARM_UP: Final = 20.0  # s of a node in which its memory grows; chosen
# MB that a node may grow in its life: three robots, each with 11 MB of published stamps and 10 MB of waiting messages.
_MOST_GROWTH: Final = 65.0


class Chaos:
    """One run. problems: what failed, in words. stop: ends it before its time."""

    def __init__(self, system: System, seed: int, say: Callable[[str], object], stop: threading.Event) -> None:
        self.system = system
        self.ledger = Ledger(system)
        self.problems: list[str] = []
        self.memory: list[tuple[float, int, int]] = []  # s since the beginning, start of the node, bytes
        self.rounds = self.replays = 0
        self.began = time.monotonic()
        self.faults = Faults(system.kinds(), np.random.default_rng(seed))
        self._seed, self._say, self._stop = seed, say, stop
        self._said = 0.0, 0  # time and messages of the last line of progress
        self._endings_checked = 0

    @property
    def elapsed(self) -> float:
        return time.monotonic() - self.began

    def run(self, seconds: float, round_seconds: float) -> None:
        """Rounds until ``seconds`` have passed or ``stop`` is set.

        In the last third the node is not ended, so that its memory shows.
        """
        while (self.elapsed < seconds or not self.rounds) and not self._stop.is_set():
            rest = seconds - self.elapsed
            self.round(min(round_seconds, max(rest, 1.0)), kills=self.elapsed < 2 * seconds / 3)

    def round(self, seconds: float, *, kills: bool) -> None:
        """Faults for ``seconds``, then peace, and the account."""
        self._begin_round()
        end = time.monotonic() + seconds
        said = time.monotonic()
        weights = {} if kills else {"kill node": 0.0, "ask node to end": 0.0}
        while time.monotonic() < end and not self._stop.is_set():
            self.faults.step(self.elapsed, weights)
            self._look_after()
            if time.monotonic() - said > _SAID:
                said = time.monotonic()
                self._report_progress()
            time.sleep(_TICK)
        self.settle()

    def settle(self) -> None:
        """End all faults, wait until everything that is under way has arrived, and take the account."""
        system = self.system
        self.faults.heal()
        if system.replay.running:
            system.endings.append(system.replay.ending())
        self._look_after(restart_only=True)
        self._wait_for(system.numbered)
        self._wait_for(system.plain)
        for problem in self.ledger.close_round():
            self.problem(problem)
        self.rounds += 1

    def problem(self, what: str) -> None:
        line = f"FAILED at {self.elapsed:.1f} s, seed {self._seed}, round {self.rounds + 1}: {what}"
        self.problems.append(line)
        self._say(line)
        for fault in self.faults.recent():
            self._say(f"    before it: {fault}")

    def check_endings(self) -> None:
        """Every process ended in order, unless it was killed."""
        for ending in self.system.endings[self._endings_checked :]:
            self._check_ending(ending)
        self._endings_checked = len(self.system.endings)

    def _check_ending(self, ending: Ending) -> None:
        log = f"see logs/{ending.program}.log"
        for sign in ("Traceback", "panicked", "Exception ignored"):
            if sign in ending.said:
                self.problem(f"{ending.program} says {sign!r}; {log}")
        if ending.asked == signal.SIGKILL:
            return
        asked = "by itself" if ending.asked is None else f"asked by {signal.Signals(ending.asked).name}"
        full = ending.program == "recorder" and ending.code == 2 and "cannot be written" in ending.said
        codes = [0] if ending.asked is not None or ending.program == "replay" else []
        if ending.asked is not None and "interrupted" in ending.said:  # while it was starting
            codes.append(128 + ending.asked)
        if ending.asked is not None and ending.program == "replay":
            codes.append(130)
        unconfirmed = "did not reach" in ending.said and "its node has taken nothing" not in ending.said
        if ending.program == "replay" and unconfirmed:  # it found no node when it began, and its link was lost
            codes.append(1)
        if ending.code not in codes and not full:
            last = ending.said.strip().rpartition("\n")[2]
            self.problem(f"{ending.program} ended {asked} with exit code {ending.code}: {last!r}; {log}")
        if ending.program == "recorder":
            self._check_recording(ending, full)
        if ending.program == "listener":
            damaged = [
                line for line in ending.said.splitlines() if not line.startswith("interrupted") and not _is_status(line)
            ]
            if damaged:
                self.problem(f"listener says {damaged[0]!r}; {log}")

    def _check_recording(self, ending: Ending, full: bool) -> None:
        file = Path(re.findall(r"\S+\.mcap", ending.said)[-1]) if ".mcap" in ending.said else None
        said = messages_said(ending.said)
        if file is None or not file.exists():
            return
        held = read_recording(file)
        if not full and said is not None and said != held:
            self.problem(f"{file.name} holds {held} messages, and its recorder says {said}")

    def _begin_round(self) -> None:
        for robot in (self.system.numbered, self.system.plain):
            robot.driving.set()

    def _look_after(self, *, restart_only: bool = False) -> None:
        """Take the ends of processes that ended by themselves, and start the next ones."""
        system = self.system
        for program in system.programs:
            if not program.running or program.paused or program.name in self.faults.targets:
                continue
            if (ending := program.ended()) is not None:
                system.endings.append(ending)
                if program is not system.replay:
                    program.start()
        # a replay that begins while no node is there confirms nothing
        quiet = not self.faults.targets & {"replay", "node", "router", "links", "link of node", "link of clients"}
        if not restart_only and not system.replay.running and quiet and system.node_in_sight():
            self.replays += 1
            system.start_replay()
        resident = system.node.resident()
        if resident is not None and (not self.memory or self.elapsed - self.memory[-1][0] > 1.0):
            self.memory.append((self.elapsed, system.node.starts, resident))
        self.check_endings()

    def _wait_for(self, robot: Robot) -> None:
        """Let a robot send until its newest sample comes back as odometry, then let it stand."""
        deadline = time.monotonic() + PATIENCE
        while True:
            robot.pause()
            for _ in range(20):
                latest = self.system.witness.latest(robot.name)
                # a stamp that was published before is moved by some ns
                if robot.sent and latest is not None and 0 <= latest - robot.sent[-1][0] < STEP // 2:
                    return
                time.sleep(0.05)
            if time.monotonic() > deadline or robot.failed:
                self.problem(f"no odometry of robot {robot.name} after all faults have ended; {robot.failed}")
                return
            robot.driving.set()
            time.sleep(0.2)

    def _report_progress(self) -> None:
        """One line: time, rates, faults so far."""
        witness, robots = self.system.witness, (self.system.numbered, self.system.plain)
        resident = self.memory[-1][2] / 1e6 if self.memory else 0.0
        self._say(
            f"{self.elapsed:7.1f} s, round {self.rounds + 1}: {sum(robot.total for robot in robots):,} samples "
            f"of robots, {self.replays} replays, {witness.messages:,} odom messages "
            f"({(witness.messages - self._said[1]) / max(self.elapsed - self._said[0], 1e-3):.0f}/s), "
            f"{self.faults.count.total()} faults, node {resident:.0f} MB, {len(self.problems)} problems"
        )
        self._said = self.elapsed, witness.messages

    def growth(self) -> float:
        """Largest growth (MB) of a node's memory from its first 20 s on."""
        grown = [0.0]
        for start in self._node_numbers():
            sizes = [(at, size) for at, number, size in self.memory if number == start]
            settled = [size for at, size in sizes if at > sizes[0][0] + _WARM_UP]
            if settled:
                grown.append((max(settled) - settled[0]) / 1e6)
        return max(grown)

    def _longest_life(self) -> str:
        """The course of memory in the node that lived longest."""
        lives = [[(at, size) for at, number, size in self.memory if number == start] for start in self._node_numbers()]
        life = max(lives, key=lambda life: life[-1][0] - life[0][0])
        sizes = ", ".join(
            f"{life[round(share * (len(life) - 1))][1] / 1e6:.0f}" for share in (0.1, 0.25, 0.5, 0.75, 1.0)
        )
        return f"in the longest, {life[-1][0] - life[0][0]:.0f} s, after 10, 25, 50, 75 and 100 % of it: {sizes} MB"

    def _node_numbers(self) -> set[int]:
        return {number for _, number, _ in self.memory}

    def table(self) -> list[str]:
        """The account of all samples, faults and ends."""
        columns = [item.name for item in fields(Account) if item.name not in ("worst", "problems")]
        rows = [f"{'':>14}" + "".join(f"{name:>12}" for name in ROBOTS)]
        rows += [
            f"{column:>14}" + "".join(f"{getattr(self.ledger.accounts[name], column):>12,}" for name in ROBOTS)
            for column in columns
        ]
        rows.append(f"{'against batch':>14}" + "".join(f"{self.ledger.accounts[n].worst:>12.1e}" for n in ROBOTS))
        rows.append("faults: " + ", ".join(f"{count} {name}" for name, count in sorted(self.faults.count.items())))
        endings = self.system.endings
        killed = sum(ending.asked == signal.SIGKILL for ending in endings)
        rows.append(f"{self.replays} replays; {len(endings)} ends of processes, {killed} of them killed")
        rows.append(f"memory of the node: +{self.growth():.1f} MB at most within one life; {self._longest_life()}")
        rows.append(f"{self.rounds} rounds in {self.elapsed:.0f} s, seed {self._seed}: {len(self.problems)} problems")
        return rows


def _is_status(line: str) -> bool:
    """True if a line is the state of a robot in JSON."""
    try:
        return {"robot", "presence", "odom", "health"} <= json.loads(line).keys()
    except (ValueError, AttributeError):
        return False


def run(
    seconds: float,
    seed: int,
    say: Callable[[str], object] = print,
    round_seconds: float = _ROUND,
    stop: threading.Event | None = None,
) -> bool:
    """Run the suite for about so long; True if every check held. The folder with its logs stays where one failed.

    stop: ends the faults when it is set; the account of the round is taken all the same.
    """
    folder = Path(tempfile.mkdtemp(prefix="chaos-"))
    system = System(folder, seed)
    try:
        system.start()
    except BaseException:
        system.abandon()
        raise
    chaos = Chaos(system, seed, say, stop or threading.Event())
    try:
        chaos.run(seconds, round_seconds)
    finally:
        chaos.faults.heal()
        system.end()
    chaos.check_endings()
    if chaos.growth() > _MOST_GROWTH:
        chaos.problem(f"the node's memory grew by {chaos.growth():.0f} MB within one life")
    for row in chaos.table():
        say(row)
    if chaos.problems:
        for problem in chaos.problems:
            say(problem)
        say(f"logs and files: {folder}")
    else:
        shutil.rmtree(folder)
    return not chaos.problems
