"""A log of refused access, read from Zenoh's own log: Zenoh has no other way to report whom it refuses.

Zenoh writes its log to file descriptor 1 only, and logs refused messages only together with all allowed ones.
Therefore descriptor 1 is a pipe while access is logged: a thread reads it, picks the refusals and passes on all else.
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
from typing import Final, TextIO

import zenoh

from omnibench.errors import one_line
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
_PIPE_SIZE: Final = 1 << 20
_READ_PERIOD: Final = 0.02  # s between two reads of the pipe; many lines at a time cost less than one by one
_REPEAT_PERIOD: Final = 10.0  # s in which the same refusal is logged once; chosen
_MOST_LINES: Final = 20  # refusals logged in that time; chosen
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
            _start_log(_FILTER + (_ACCESS_FILTER if config.access is not None else ""))
            yield access_log
    finally:
        _one_at_a_time.release()


class AccessLog:
    """Picks refusals from the lines of Zenoh's log and calls ``warn`` with each. count: refusals, repeated ones too."""

    def __init__(self, warn: Callable[[str], None]) -> None:
        self.count = 0
        self._warn = warn
        self._logged: set[str] = set()  # since _period_start
        self._suppressed = 0  # since _period_start
        self._period_start = 0.0
        self._decisions: dict[str, re.Match[str]] = {}  # thread -> the last refusal that it logged
        self._addresses: dict[str, str] = {}  # thread, or Zenoh's id of a peer -> the peer's address
        self._names: dict[str, str] = {}  # Zenoh's id of a peer -> its certificate or user

    def read(self, line: str) -> bool:
        """True if the line is one of Zenoh's log; a refusal in it is logged."""
        parts = _LINE.fullmatch(line)
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
        now = time.monotonic()
        if now - self._period_start > _REPEAT_PERIOD:
            if self._suppressed:
                self._warn(f"refused: {self._suppressed} more in the last {now - self._period_start:.0f} s")
            self._logged, self._period_start, self._suppressed = set(), now, 0
        without_port = re.sub(r":\d+\b", "", text)  # each connection of a peer has another port
        if without_port in self._logged or len(self._logged) >= _MOST_LINES:
            self._suppressed += 1
            return
        self._logged.add(without_port)
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


def _start_log(directives: str) -> None:
    """Start Zenoh's log without colours."""
    before = os.environ.get("NO_COLOR")
    os.environ["NO_COLOR"] = "1"
    try:
        zenoh.init_log_from_env_or(directives)
    finally:
        if before is None:
            del os.environ["NO_COLOR"]
        else:
            os.environ["NO_COLOR"] = before


@contextmanager
def _descriptor_1_read_by(take: Callable[[str], bool]) -> Iterator[None]:
    """Give ``take`` each line that is written to descriptor 1, and pass on those for which it returns False.

    Python's own output bypasses the pipe.
    """
    sys.stdout.flush()
    outside, (reading, writing) = os.dup(1), os.pipe()
    with suppress(OSError, AttributeError):
        fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, _PIPE_SIZE)
    stdout, replaced = sys.stdout, _is_descriptor_1(sys.stdout)
    if replaced:
        sys.stdout = os.fdopen(
            os.dup(outside), "w", encoding=stdout.encoding, errors=stdout.errors, buffering=1 if stdout.isatty() else -1
        )
    os.dup2(writing, 1)
    os.close(writing)
    thread = threading.Thread(target=_read, args=(reading, outside, take), name="zenoh log", daemon=True)
    thread.start()
    try:
        yield
    finally:
        if replaced:
            sys.stdout.flush()
            sys.stdout.close()
            sys.stdout = stdout
        else:
            sys.stdout.flush()
        os.dup2(outside, 1)  # closes the pipe's last writer, which ends the thread
        thread.join(timeout=1.0)
        os.close(outside)


def _is_descriptor_1(stream: TextIO) -> bool:
    try:
        return stream.fileno() == 1
    except (OSError, ValueError):  # a stream without a file
        return False


def _read(reading: int, outside: int, take: Callable[[str], bool]) -> None:
    rest = b""
    while chunk := os.read(reading, _PIPE_SIZE):
        *lines, rest = (rest + chunk).split(b"\n")
        for line in lines:
            if b" is authorized to " in line:  # most lines, skipped cheaply
                continue
            try:
                is_zenohs = take(line.decode(errors="replace"))
            except Exception:  # reading must go on, whatever the line is: a full pipe would stop Zenoh
                LOG.exception("a line of Zenoh's log could not be read")
                continue
            if not is_zenohs:
                with suppress(OSError):  # nobody reads the program's output any more
                    os.write(outside, line + b"\n")
        time.sleep(_READ_PERIOD)
    os.close(reading)
    if rest:
        with suppress(OSError):
            os.write(outside, rest)
