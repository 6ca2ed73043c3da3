"""Typed commands: by the shell, or, where it would change no word, by a server that has loaded omnibench beforehand."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import threading
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parents[3]
_LONGEST = 300  # s, of a command


@dataclass(frozen=True)
class Typed:
    """What a typed command printed."""

    status: int
    output: str
    errors: str


def typed(command: str, folder: Path) -> Typed:
    """Type a command into a shell. Its omnibench is this project's."""
    words = shlex.split(command)
    plain = words[:1] == ["omnibench"] and shlex.join(words) == command
    with TemporaryDirectory() as scratch:
        files = [Path(scratch) / name for name in ("output", "errors")]
        status = _served(words[1:], folder, files) if plain else _by_shell(command, folder, files)
        output, errors = (file.read_text(errors="replace") for file in files)
    return Typed(status, output, errors)


def _environment() -> dict[str, str]:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
    return os.environ | {"PATH": path, "PYTHONPATH": str(ROOT), "COLUMNS": "80", "NO_COLOR": "1"}


def _by_shell(command: str, folder: Path, files: list[Path]) -> int:
    with files[0].open("w") as output, files[1].open("w") as errors:
        try:
            return subprocess.run(
                command, shell=True, cwd=folder, env=_environment(), stdout=output, stderr=errors, timeout=_LONGEST
            ).returncode
        except subprocess.TimeoutExpired:
            return -signal.SIGALRM


@cache
def _server(thread: int) -> subprocess.Popen[str]:
    """The server of a thread, whose answers no other thread reads."""
    assert thread
    words = [sys.executable, str(Path(__file__))]
    return subprocess.Popen(words, env=_environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def _served(words: list[str], folder: Path, files: list[Path]) -> int:
    server = _server(threading.get_ident())
    assert server.stdin is not None
    assert server.stdout is not None
    server.stdin.write(json.dumps([words, str(folder), *map(str, files)]) + "\n")
    server.stdin.flush()
    return int(server.stdout.readline())


def serve() -> None:
    """Run each command line of standard input in a child of its own, and print the status with which it ended."""
    import omnibench.check.check
    import omnibench.cli.app
    from omnibench.__main__ import main

    assert omnibench.cli.app
    for line in sys.stdin:
        words, folder, *files = json.loads(line)
        child = os.fork()
        if not child:
            signal.alarm(_LONGEST)
            os.chdir(folder)
            for number, file in enumerate(files, 1):
                os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), number)
            sys.argv = ["omnibench", *words]
            main()
            return
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


if __name__ == "__main__":
    serve()
