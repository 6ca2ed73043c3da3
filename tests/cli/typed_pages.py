"""Commands of the README and the handbook: parsed, and typed one after the other as a reader types them."""

import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import typer

from omnibench.cli.app import app

LONGEST = 900  # s, of one command
ENOUGH = 8.0  # s: how long a reader watches a command that runs until Ctrl-C, once it works
_STREAMS = ("live", "replay", "listen", "record")  # run until Ctrl-C, or as long as the recording that they play
_SILENT = ("replay",)  # prints nothing into a file until it has ended
_TYPED = re.compile(r"^    ((?:omnibench|cd) (?:.*\\\n)*.*)$", re.MULTILINE)
# ``live`` ends the one before: one node runs a robot. A file is read once ``record`` has ended.
_ENDED_BY = {"live": ("listen", "record", "replay", "live"), "import": ("record",)}


def shell_commands(markdown: str) -> list[str]:
    """The commands of a page's indented blocks, as they stand there; those of pip, git and python are left out."""
    return [re.sub(r"\\\n +", "", command).strip() for command in _TYPED.findall(markdown)]


def _path() -> str:
    """PATH with the programs of this environment before all others, as after its activation."""
    return os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])


@dataclass
class Terminal:
    """A shell in ``folder``, and other terminals for the commands that run until Ctrl-C.

    before: called with every command before it is typed. environment: of the commands.
    """

    folder: Path
    before: Callable[[str, Path], None] = lambda _command, _folder: None
    environment: dict[str, str] = field(default_factory=lambda: os.environ | {"PATH": _path()})
    _running: list[tuple[str, subprocess.Popen[bytes], IO[bytes]]] = field(default_factory=list)

    def type(self, line: str) -> None:
        """Run one line to its end, or, where it runs until Ctrl-C, leave it running. AssertionError: it failed."""
        for command in line.split(" && "):
            self.before(command, self.folder)
            self._type(command)

    def close(self) -> None:
        """Press Ctrl-C in the terminals where something runs still."""
        for verb in reversed(_STREAMS):
            self._end(verb)

    def _type(self, command: str) -> None:
        words = command.split()
        if words[0] == "cd":
            self.folder = self.folder / words[1]
            return None
        for verb in _ENDED_BY.get(words[1], ()):
            self._end(verb)
        screen = tempfile.TemporaryFile("a+b")  # noqa: SIM115 - it stays open as long as the command runs
        process = subprocess.Popen(
            ["bash", "-c", f"exec {command}"],
            cwd=self.folder,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=screen,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        if words[1] not in _STREAMS:
            process.wait(LONGEST)
            return _assert_fine(command, process, _printed(screen))
        self._running.append((words[1], process, screen))
        ends = time.monotonic() + LONGEST
        starts = words[1] not in _SILENT  # on a busy machine the start takes longer than ENOUGH
        while starts and process.poll() is None and time.monotonic() < ends:
            time.sleep(0.1)
            starts = not _works(_printed(screen))
        time.sleep(ENOUGH)
        if process.poll() not in (None, 0):
            _assert_fine(command, process, _printed(screen))
        return None

    def _end(self, verb: str) -> None:
        """Press Ctrl-C where a verb runs. AssertionError: one had failed, or did not end in order."""
        ended = [(process, screen) for name, process, screen in self._running if name == verb]
        self._running = [running for running in self._running if running[0] != verb]
        for process, _ in ended:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for process, screen in ended:
            process.wait(LONGEST)
            text = _printed(screen)
            assert process.returncode in (0, 130), text
            assert "Traceback" not in text, text

    def kill(self) -> None:
        """End whatever runs still, in no order."""
        for _, process, _ in self._running:
            process.kill()


@contextmanager
def terminal(folder: Path, before: Callable[[str, Path], None] | None = None) -> Iterator[Terminal]:
    """A terminal in a folder; whatever runs in it at the end is ended."""
    opened = Terminal(folder, before or (lambda _command, _folder: None))
    try:
        yield opened
        opened.close()
    finally:
        opened.kill()


def _printed(screen: IO[bytes]) -> str:
    """What stands on a command's screen so far."""
    screen.seek(0)
    return screen.read().decode()


def _works(printed: str) -> bool:
    """True once a command has printed more than the line on plug-ins, which comes before all else."""
    return any(not line.startswith("plug-ins") for line in printed.splitlines())


def _assert_fine(command: str, process: subprocess.Popen[bytes], printed: str) -> None:
    assert process.returncode == 0, f"{command}\nexit {process.returncode}\n{printed}"
    assert "Traceback" not in printed, f"{command}\n{printed}"


_APP: Any = typer.main.get_command(app)
_INLINE = re.compile(r"`(omnibench [^`]+)`")


def commands_in(markdown: str) -> list[str]:
    """Every ``omnibench ...`` of the code blocks and of the code within lines."""
    joined = re.sub(r"\\\n +", "", markdown)  # a backslash goes on in the next line
    blocks = [line.strip() for line in joined.splitlines() if line.startswith("    ")]
    typed = [part.strip() for line in [*blocks, *_INLINE.findall(markdown)] for part in line.split("&&")]
    return [line for line in typed if line.startswith("omnibench ")]


def parse(command: str) -> None:
    """Parse a command. Click's UsageError when a command, an option or an argument of it does not exist."""
    _, *arguments = shlex.split(command, comments=True)
    if len(arguments) == 1 and any(arguments[0] in option.opts for option in _APP.params):
        return  # --version
    group, name, context = _APP, "omnibench", None
    while hasattr(group, "commands"):
        context = group.context_class(group, info_name=name, parent=context)
        name, group, arguments = group.resolve_command(context, arguments)
    group.make_context(name, [argument for argument in arguments if argument != "--help"], parent=context)
