"""A log of refused access, read from Zenoh's own log: Zenoh has no other way to report whom it refuses.

eclipse-zenoh 1.10 writes its log to file descriptor 1 only (the callback for log records of Zenoh's Rust and C
interfaces is missing in Python; events of transports and links tell of accepted connections alone), and logs refused
messages only together with all allowed ones. Therefore descriptor 1 is a pipe while access is logged: a thread reads
it, picks the refusals and passes on all else.
"""

from __future__ import annotations

import fcntl
import logging
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Final

import zenoh

from omnibench.errors import one_line
from omnibench.live.network.rate_limiter import RateLimiter
from omnibench.live.network.session_config import SessionConfig

LOG = logging.getLogger("omnibench.live")

_FILTER: Final = "error,zenoh_link_tls=warn,zenoh_link_quic=warn,zenoh_transport::unicast::establishment::accept=trace"
_ACCESS_FILTER: Final = ",zenoh::net::routing::interceptor=trace"
_LINE = re.compile(r"\d{4}-\S+Z +(?P<level>[A-Z]+) (?P<thread>.*?ThreadId\(\d+\)) (?P<target>[\w:]+): (?P<text>.*)")
_DECISION = re.compile(
    r"(?:Using cached result: )?(?P<zid>[0-9a-f]+)(?: on (?P<subject>.*?))? is unauthorized to (?P<action>.*?)"
    r" \((?P<flow>ingress|egress)\) on (?P<key>.*)"
)
_HANDSHAKE = re.compile(r"Establishment Accept \w+: \S+ => (?P<address>\S+)\. ")
_ACCEPTED = re.compile(r"New transport link accepted from (?P<zid>[0-9a-f]+) .*? dst: (?P<address>\S+?),")
_REASONS: Final = (  # Zenoh's words when a user is refused, and their meaning
    ("Invalid password", "wrong password"),
    ("Invalid user", "unknown user"),
    ("Expected extension", "no user and password given"),
)
_CONSEQUENCES: Final = ("Unknown subscriber", "Unknown queryable", "Unknown token")
"""Errors that follow a refusal: the peer undeclares something that was refused when it was declared."""
_IDENTITIES: Final = (("CertCommonName", "certificate"), ("Username", "user"))
_PORT = re.compile(r":\d+\b")  # each connection of a peer has another one
_COLOUR = re.compile(r"\x1b\[[\d;]*m")
_PIPE_SIZE: Final = 1 << 20
_READ_PERIOD: Final = 0.02  # s between two reads of the pipe; many lines at a time cost less than one by one
_MOST_LINES: Final = 20  # refusals logged in the period of the rate limiter; chosen
_MOST_PEERS: Final = 10_000  # peers whose addresses and names are kept; a node runs for long

_one_at_a_time = threading.Lock()


@contextmanager
def log_refused_access(config: SessionConfig) -> Iterator[AccessLog]:
    """Log a warning for every peer that this process's sessions refuse, with what it asked for.

    For the main program of a node, around ``open_session``; no other session may be open. Does nothing if the config
    refuses nobody, or if RUST_LOG is set: Zenoh's own log is then printed unchanged.
    """
    access_log = AccessLog(LOG.warning)
    guarded = config.users_file is not None or (config.tls is not None and bool(config.listening))
    if "RUST_LOG" in os.environ:
        zenoh.try_init_log_from_env()
        guarded = False
    if not guarded or sys.stdout is None or not _one_at_a_time.acquire(blocking=False):
        yield access_log
        return
    try:
        with _descriptor_1_read_by(access_log.read):
            zenoh.init_log_from_env_or(_FILTER + (_ACCESS_FILTER if config.access is not None else ""))
            yield access_log
    finally:
        _one_at_a_time.release()


class AccessLog:
    """Picks refusals from the lines of Zenoh's log and calls ``warn`` with each. count: refusals, repeated ones too."""

    def __init__(self, warn: Callable[[str], None]) -> None:
        self.count = 0
        self._warn = warn
        self._limiter = RateLimiter(most=_MOST_LINES)
        self._suppressed = 0  # refusals that were not logged, since the last line that counts them
        self._decisions: dict[str, re.Match[str]] = {}  # thread -> the last refusal that it logged
        self._addresses: dict[str, str] = {}  # thread, or Zenoh's id of a peer -> the peer's address
        self._names: dict[str, str] = {}  # Zenoh's id of a peer -> its certificate or user

    def read(self, line: str) -> bool:
        """True if the line is one of Zenoh's log; a refusal in it is logged."""
        parts = _LINE.fullmatch(_COLOUR.sub("", line))
        if parts is None:
            return False
        target, thread, text = parts["target"], parts["thread"], parts["text"]
        if target.startswith("zenoh::net::routing::interceptor"):
            self._take_decision(thread, text)
        elif target.endswith("::accept"):
            self._take_handshake(thread, text)
        elif target.startswith("zenoh_link"):
            self._refuse(f"a connection: {text.split('. Hint:')[0]}")
        elif parts["level"] == "ERROR" and not text.startswith(_CONSEQUENCES):
            self._refuse(f"zenoh: {text}", refused=False)
        return True

    def _take_decision(self, thread: str, text: str) -> None:
        if (decision := _DECISION.fullmatch(text)) is not None:
            self._decisions[thread] = decision
            if decision["subject"]:
                _remember(self._names, decision["zid"], _identity(decision["subject"]))
        elif text == "Msg intercepted!" and (decision := self._decisions.pop(thread, None)) is not None:
            # A decision that no intercepted message follows was only looked up in advance.
            zid = decision["zid"]
            who = f"{self._names.get(zid, 'somebody')} at {self._addresses.get(zid, 'an unknown address')}"
            self._refuse(f"{who}: may not {_described(decision)} {decision['key']}")

    def _take_handshake(self, thread: str, text: str) -> None:
        if (handshake := _HANDSHAKE.match(text)) is not None:
            _remember(self._addresses, thread, handshake["address"])
        elif (accepted := _ACCEPTED.match(text)) is not None:
            _remember(self._addresses, accepted["zid"], accepted["address"])
        elif "UsrPwd" in text:
            reason = next((meaning for sign, meaning in _REASONS if sign in text), text)
            self._refuse(f"{self._addresses.get(thread, 'a connection')}: {reason}")

    def _refuse(self, text: str, *, refused: bool = True) -> None:
        self.count += refused
        if not self._limiter.allows(_PORT.sub("", text)):
            self._suppressed += 1
            return
        if self._suppressed and self._limiter.allows("more"):
            self._warn(f"refused: {self._suppressed} more like those before")
            self._suppressed = 0
        self._warn(one_line(f"refused: {text}" if refused else text))


def _remember(known: dict[str, str], key: str, value: str) -> None:
    known[key] = value
    if len(known) > _MOST_PEERS:
        del known[next(iter(known))]


def _identity(subject: str) -> str:
    for name, kind in _IDENTITIES:
        if (match := re.search(rf"{name}\((.*?)\)(?:\+|$)", subject)) is not None:
            return f"{kind} {match[1]!r}"
    return "somebody without certificate or user"


def _described(decision: re.Match[str]) -> str:
    action = decision["action"]
    if decision["flow"] == "egress":
        return "receive declarations of" if "Declare" in action or "Liveliness" in action else "receive"
    return {"Put": "write", "Delete": "delete", "Query": "ask", "Reply": "answer for"}.get(action, action.lower())


@contextmanager
def _descriptor_1_read_by(take: Callable[[str], bool]) -> Iterator[None]:
    """Give ``take`` each line that is written to descriptor 1, and pass on those for which it returns False.

    Python's own output bypasses the pipe.
    """
    stdout, outside, (reading, writing) = sys.stdout, os.dup(1), os.pipe()
    stdout.flush()
    with suppress(OSError, AttributeError):
        fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, _PIPE_SIZE)
    with suppress(OSError, ValueError):  # a stream without a file stays as it is
        if stdout.fileno() == 1:
            lines = 1 if stdout.isatty() else -1
            sys.stdout = os.fdopen(os.dup(outside), "w", lines, stdout.encoding, stdout.errors)
    os.dup2(writing, 1)
    os.close(writing)
    thread = threading.Thread(target=_read, args=(reading, outside, take), name="zenoh log", daemon=True)
    thread.start()
    try:
        yield
    finally:
        sys.stdout.flush()
        if sys.stdout is not stdout:
            sys.stdout.close()  # whoever keeps it finds it closed, and not another file
        sys.stdout = stdout
        os.dup2(outside, 1)  # closes the pipe's last writer, which ends the thread
        thread.join(timeout=1.0)
        os.close(outside)


def _read(reading: int, outside: int, take: Callable[[str], bool]) -> None:
    rest = b""
    while chunk := os.read(reading, _PIPE_SIZE):
        *lines, rest = (rest + chunk).split(b"\n")
        _pass_on(b"".join(line + b"\n" for line in lines if not _taken(line, take)), outside)
        time.sleep(_READ_PERIOD)
    os.close(reading)
    _pass_on(rest, outside)


def _taken(line: bytes, take: Callable[[str], bool]) -> bool:
    """True if a line is one of Zenoh's log. Reading goes on whatever the line is: a full pipe would stop Zenoh."""
    if b" is authorized to " in line:  # most lines, skipped cheaply
        return True
    try:
        return take(line.decode(errors="replace"))
    except Exception:
        LOG.exception("a line of Zenoh's log could not be read")
        return True


def _pass_on(content: bytes, outside: int) -> None:
    with suppress(OSError):  # nobody reads the program's output any more
        os.write(outside, content)
