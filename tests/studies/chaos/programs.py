"""Programs under test as processes: what they say, how much memory they hold, how they are stopped and how they end."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

COMMAND = (sys.executable, "-m", "omnibench")
_ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1", "OMNIBENCH_PLUGINS": "none"}
PATIENCE = 300.0  # s: who waits longer for an event waits in vain, however busy the machine is (chosen)


@dataclass(frozen=True)
class Ending:
    """How a process ended. asked: by which signal, None: it ended by itself; code: its exit code."""

    program: str
    asked: int | None
    code: int
    said: str


class Program:
    """A command that is started, and started again, with the same role.

    command: makes the arguments of each start. logs: folder for what it says.
    """

    def __init__(self, name: str, command: Callable[[], tuple[object, ...]], logs: Path) -> None:
        self.name = name
        self.paused = False
        self.starts = 0
        self.started_at = 0.0  # s, monotonic
        self._command = command
        self._logs = logs
        self._process: subprocess.Popen[str] | None = None
        self._asked: int | None = None
        self._lines: list[str] = []
        self._readers: list[threading.Thread] = []

    @property
    def running(self) -> bool:
        """True from ``start`` until its end was taken by ``ended``."""
        return self._process is not None

    def start(self) -> None:
        self._asked, self._lines = None, []
        self._process = subprocess.Popen(
            [*map(str, self._command())],
            env=_ENVIRONMENT,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C is for the suite, which ends them in order
        )
        self.starts += 1
        self.started_at = time.monotonic()
        self._readers = []
        for stream in (self._process.stdout, self._process.stderr):
            assert stream is not None
            reader = threading.Thread(target=self._read, args=(stream, self._lines), daemon=True)
            reader.start()
            self._readers.append(reader)

    def pause(self) -> None:
        """SIGSTOP."""
        self._signal(signal.SIGSTOP)
        self.paused = True

    def resume(self) -> None:
        """SIGCONT."""
        self._signal(signal.SIGCONT)
        self.paused = False

    def kill(self) -> Ending:
        """SIGKILL, and its end."""
        self._signal(signal.SIGKILL)
        return self._wait(signal.SIGKILL)

    def end(self, number: int) -> Ending:
        """Ask it to end by a signal, and its end; one that does not end is killed, as its exit code tells."""
        self.ask(number)
        return self.ending()

    def ending(self) -> Ending:
        """Its end, of a program that was asked to, or has to by itself; one that does not end is killed."""
        ending = self.ended(PATIENCE)
        if ending is None:
            self._signal(signal.SIGKILL)
            ending = self._wait(self._asked)
        return ending

    def ask(self, number: int) -> None:
        """Ask it to end by a signal, once it has set up how it ends, before which signals act as usual."""
        deadline = time.monotonic() + PATIENCE
        while not self.can_end and self._process and self._process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        self._asked = number
        self._signal(number)

    def ended(self, patience: float = 0.0) -> Ending | None:
        """How it ended; None: it runs still after ``patience`` s."""
        assert self._process is not None
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            return None
        return self._wait(self._asked)

    def limit_files(self, size: int | None) -> None:
        """A disk that takes no file of the process larger than ``size`` bytes; None: any."""
        if self._process is not None and self._process.poll() is None:
            _, hard = resource.prlimit(self._process.pid, resource.RLIMIT_FSIZE)
            resource.prlimit(self._process.pid, resource.RLIMIT_FSIZE, (hard if size is None else size, hard))

    @property
    def can_end(self) -> bool:
        """True once the process has set up how it ends at a signal: while Python starts, signals act as usual."""
        try:
            status = Path(f"/proc/{self._process.pid}/status").read_text() if self._process else ""
        except OSError:
            return False
        caught = next((int(line.split()[1], 16) for line in status.splitlines() if line.startswith("SigCgt")), 0)
        return bool(caught >> (signal.SIGTERM - 1) & 1)

    def resident(self) -> int | None:
        """Bytes in memory; None: it does not run."""
        try:
            pages = int(Path(f"/proc/{self._process.pid}/statm").read_text().split()[1]) if self._process else 0
        except (OSError, IndexError):
            return None
        return pages * os.sysconf("SC_PAGE_SIZE") or None

    def _signal(self, number: int) -> None:
        if self._process is not None and self._process.poll() is None:
            os.kill(self._process.pid, number)

    def _wait(self, asked: int | None) -> Ending:
        assert self._process is not None
        code = self._process.wait(PATIENCE)
        for reader in self._readers:
            reader.join(PATIENCE)
        said = "".join(self._lines)
        with (self._logs / f"{self.name}.log").open("a", encoding="utf-8") as log:
            log.write(f"--- start {self.starts}, asked {asked}, exit code {code}\n{said}")
        self._process, self.paused = None, False
        return Ending(self.name, asked, code, said)

    @staticmethod
    def _read(stream: TextIO, lines: list[str]) -> None:
        lines.extend(stream)  # line by line, as they come
