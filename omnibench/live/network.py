"""Zenoh sessions: their config, who may do what at a router, opening, and why one did not open.

Zenoh's own settings pass through, with defaults of ours: loopback only, no scouting, a largest message. Zenoh only
reports that it could not connect: the reason, in one line, is found by trying each step.

Zenoh's access control is made of a config's access rules: rights by key, message and peer; all else is refused.
Messages from a peer (ingress) are checked. Messages to a peer (egress) are not: a peer only receives what it was
allowed to subscribe to or to query.
"""

from __future__ import annotations

import json
import logging
import math
import os
import re
import socket
import ssl
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future
from pathlib import Path
from threading import Thread
from typing import Annotated, Any, Final, Literal, Self

import zenoh
from pydantic import AfterValidator, BeforeValidator, Field, SecretStr, field_validator, model_validator

from omnibench.config import Model, RelativePath
from omnibench.errors import ConfigError, DataError, nearest
from omnibench.files import read_text
from omnibench.live.keys import check_files, read_certificate
from omnibench.live.stopping import Stop, wait_until
from omnibench.live.topics import INPUTS, TOPICS, topic_name

LOG = logging.getLogger("omnibench.live")

PORT: Final = 7447  # Zenoh's default
_PROTOCOLS: Final = ("tcp", "tls", "quic", "udp", "ws")
_ENCRYPTED: Final = ("tls/", "quic/")
_UNIX: Final = "unixsock-stream/"  # begins the endpoint of a file
_LOOPBACK = re.compile(r"localhost|127(\.\d+){3}|::1")
_NETWORK = re.compile(
    rf"(?P<protocol>{'|'.join(_PROTOCOLS)})/(?P<host>\[[0-9A-Fa-f:.%]+\]|[^\s/:\[\]#?]+):(?P<port>\d{{1,5}})([?#]\S*)?"
)
_FILE = re.compile(_UNIX + r"[^\s#?]+")


def _checked_endpoint(text: str) -> str:
    match = _NETWORK.fullmatch(text)
    if not _FILE.fullmatch(text) and (match is None or int(match["port"]) > 65535):
        known = ", ".join(_PROTOCOLS)
        raise ValueError(f"{text!r} is not an endpoint; write protocol/host:port as tcp/127.0.0.1:{PORT} ({known})")
    return text


_OneOrMore = BeforeValidator(
    lambda value: (value,) if isinstance(value, str) else value, json_schema_input_type=str | tuple[str, ...]
)
Names = Annotated[tuple[str, ...], _OneOrMore]
Endpoints = Annotated[tuple[Annotated[str, AfterValidator(_checked_endpoint)], ...], _OneOrMore]


def _address(endpoint: str) -> tuple[str, str, int]:
    """Protocol, host and port of an endpoint, which are empty if it is a Unix socket's file."""
    match = _NETWORK.fullmatch(endpoint)
    return ("", "", 0) if match is None else (match["protocol"], match["host"].strip("[]"), int(match["port"]))


class User(Model):
    """The user name and password with which we log in at a router."""

    name: str = Field(min_length=1)
    password: SecretStr | None = Field(None, description="in plain text; a file or an environment variable is safer")
    password_file: RelativePath | None = Field(None, description="a file whose first line is the password")
    password_env: str | None = Field(None, description="environment variable that holds the password")

    @model_validator(mode="after")
    def _one_is_given(self) -> Self:
        names = ("password", "password_file", "password_env")
        given = [name for name in names if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"give one of {', '.join(names)} (given: {', '.join(given) or 'none'})")
        return self


class Tls(Model):
    """Certificates in PEM, as ``omnibench keys`` makes them; paths are relative to the config file."""

    ca: RelativePath = Field(description="certificate of the authority (CA) that signed the others")
    certificate: RelativePath | None = Field(None, description="our certificate")
    key: RelativePath | None = Field(None, description="the private key of our certificate")
    mutual: bool = Field(True, description="clients must show a certificate too")
    verify_name: bool = Field(True, description="the router's certificate must name the host that we connect to")

    @model_validator(mode="after")
    def _belong_together(self) -> Self:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("give certificate and key together")
        if self.mutual and self.certificate is None:
            raise ValueError("mutual: give our certificate and key, or mutual: false")
        return self


class AccessRule(Model):
    """Rights of some peers. Keys are key expressions; ``**`` does not match ``@ros2_lv``, which must be named.

    Tokens are Zenoh's liveliness tokens, which tell who is there.
    """

    who: Names = Field(min_length=1, description="common names of certificates or, without certificates, user names")
    write: Names = Field((), description="keys to put and delete, to answer queries on and to declare tokens of")
    read: Names = Field((), description="keys to subscribe to, to query and to look for tokens of")

    @model_validator(mode="after")
    def _grants_something(self) -> Self:
        if not self.write and not self.read:
            raise ValueError("give keys to write or to read")
        return self


class Access(Model):
    """Access rights at a router; all else is refused. Names are common names of certificates or user names.

    The router itself may do everything, and so may a peer with the router's own certificate or user name.
    """

    robots: dict[Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")], str] = Field(
        {}, description="robot: its peer's name. May write its joint_states and slam_pose and read all its topics"
    )
    nodes: tuple[str, ...] = Field((), description="nodes elsewhere: may read robots' inputs and write all outputs")
    viewers: tuple[str, ...] = Field((), description="may read all topics and query info, health and pose")
    operators: tuple[str, ...] = Field((), description="viewers that may also set poses, reset and swap calibrations")
    rules: tuple[AccessRule, ...] = Field((), description="more rights")

    @field_validator("robots", mode="before", json_schema_input_type=dict[str, str] | tuple[str, ...])
    @classmethod
    def _named_like_the_robot(cls, value: Any) -> Any:
        if isinstance(value, list | tuple) and all(isinstance(name, str) for name in value):
            return {name: name for name in value}
        return value

    @model_validator(mode="after")
    def _names_somebody(self) -> Self:
        if "omnibench" in self.robots:  # its topics would be the services of all robots
            raise ValueError("robots: omnibench begins the keys of the services; give the robot another name")
        if not any((self.robots, self.nodes, self.viewers, self.operators, self.rules)):
            raise ValueError("it names nobody, so that all would be refused; name robots, or leave access out")
        return self


class SessionConfig(Model):
    """A Zenoh session. By default a router that listens on loopback only, without scouting."""

    mode: Literal["router", "peer", "client"] = Field(
        "router", description="router: others connect to it, without zenohd; client: connects to a router"
    )
    listen: Endpoints | None = Field(
        None, description=f"default: for a router tcp/127.0.0.1:{PORT} (tls/ with tls), for a peer any port of loopback"
    )
    connect: Endpoints = Field((), description=f"default: for a client tcp/127.0.0.1:{PORT} (tls/ with tls)")
    wait: float = Field(0.0, ge=0, le=86400, description="how long to wait for a router that is not running yet, s")
    scouting: bool = Field(False, description="find other sessions by multicast and gossip")
    user: User | None = Field(None, description="our name and password at a router that asks for users")
    users_file: RelativePath | None = Field(None, description="users that may connect to us: lines of user:password")
    tls: Tls | None = None
    access: Access | None = Field(None, description="access rights at this router; default: all may do everything")
    largest_message: int = Field(1_000_000, ge=1000, description="bytes; larger ones are dropped, whoever sends them")
    extra: dict[str, Any] = Field({}, description="settings of Zenoh itself, as transport/link/tx/lease: 3000")

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.mode == "client":
            for name in ("listen", "users_file", "access"):
                if getattr(self, name):
                    raise ValueError(f"{name}: nobody connects to a client; give it in the router's config")
        if self.mode == "peer" and self.connect and (self.user or self.tls):
            raise ValueError("mode: a peer that is refused retries for ever without a message; use client")
        if self.access and not (self.users_file or (self.tls and self.tls.mutual)):
            raise ValueError("access: peers cannot be identified; give users_file, or tls with mutual: true")
        if self.tls and self.listening and self.tls.certificate is None:
            raise ValueError("tls: a session that listens needs a certificate and its key")
        for endpoint in (*(self.listen or ()), *self.connect):
            if endpoint.startswith(_ENCRYPTED) and not self.tls:
                raise ValueError(f"{endpoint}: give tls: {{ca: ..., certificate: ..., key: ...}}")
            if self.tls and not endpoint.startswith((*_ENCRYPTED, _UNIX)):
                raise ValueError(f"{endpoint}: is not encrypted although tls is given; write tls/...")
        return self

    @property
    def listening(self) -> tuple[str, ...]:
        """The endpoints on which the session listens, defaults included."""
        if self.listen is not None or self.mode == "client":
            return self.listen or ()
        return (f"{'tls' if self.tls else 'tcp'}/127.0.0.1:{PORT if self.mode == 'router' else 0}",)

    @property
    def connecting(self) -> tuple[str, ...]:
        """The endpoints to which the session connects, defaults included."""
        if self.connect or self.mode != "client" or self.scouting:
            return self.connect
        return (f"{'tls' if self.tls else 'tcp'}/127.0.0.1:{PORT}",)

    @property
    def unprotected(self) -> tuple[str, ...]:
        """The endpoints to which anybody on the network may connect without a password or a certificate."""
        if self.users_file or (self.tls and self.tls.mutual):
            return ()
        on_network = [endpoint for endpoint in self.listening if not endpoint.startswith(_UNIX)]
        return tuple(endpoint for endpoint in on_network if not _LOOPBACK.fullmatch(_address(endpoint)[1]))


Right = Literal["write", "read", "ask", "put", "subscribe", "serve"]
_MESSAGES: Final[dict[Right, tuple[str, ...]]] = {
    "write": ("put", "delete", "declare_queryable", "reply", "liveliness_token"),
    "read": ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query"),
    "ask": ("query",),
    "put": ("put",),
    "subscribe": ("declare_subscriber",),
    "serve": ("declare_queryable", "reply", "liveliness_token"),
}
_OUTPUTS: Final = tuple(topic for topic in TOPICS if topic not in INPUTS)
_ANSWERS: Final = ("info", "calibration", "health", "pose")  # services that change nothing
_ROS_GRAPH: Final = "@ros2_lv/**"  # rmw_zenoh's liveliness tokens: nodes and their topics, no data
_ADVANCED: Final = "/@adv/**"  # below a key: messages between Zenoh's advanced publishers and subscribers


def rights_of(access: Access) -> dict[str, dict[Right, list[str]]]:
    """Peer's name -> right -> key expressions. ConfigError: a rule's key expression is not valid."""
    rights: dict[str, dict[Right, list[str]]] = defaultdict(lambda: {right: [] for right in _MESSAGES})

    def grant(who: Iterable[str], **keys: Iterable[str]) -> None:
        for name in who:
            for right in _MESSAGES:
                rights[name][right] += keys.get(right, ())

    def services(robot: str, *names: str) -> list[str]:
        return [f"omnibench/{robot}/{name}" for name in names]

    tokens = [*services("*", "alive"), _ROS_GRAPH]
    for robot, name in access.robots.items():
        # ROS 2's keys of the robot, in any domain, have domain, name, type and hash: more parts than its services.
        its_own = [f"{robot}/**", f"*/{robot}/*/**/*/*", *_topics(robot, ["tf"])]
        received = services(robot, "received/*")  # acknowledgements of what a replay sends
        grant([name], write=[*_topics(robot, INPUTS), _ROS_GRAPH], read=[*its_own, *tokens], subscribe=received)
        grant([name], ask=[*services(robot, *_ANSWERS), *received])
    everything, answers = [*_topics("*", TOPICS), *tokens], services("*", *_ANSWERS)
    # Nodes answer for their robots and take calibrations; to give orders and calibrations is for operators alone.
    grant(access.nodes, write=[*_topics("*", _OUTPUTS), _ROS_GRAPH], read=[*everything, *services("*", "claim-$*")])
    grant(access.nodes, serve=services("*", "*"), ask=answers, subscribe=services("*", "calibration"))
    grant(access.nodes, put=services("*", "received/*"))
    grant(access.viewers, write=[_ROS_GRAPH], read=everything, ask=answers)
    grant(access.operators, write=[_ROS_GRAPH], read=everything, ask=services("*", "*"))
    grant(access.operators, put=services("*", "calibration"))
    for rule in access.rules:
        grant(rule.who, write=rule.write, read=rule.read)
    for granted in rights.values():
        for right, keys in granted.items():
            granted[right] = sorted(_with_advanced(map(_canonical, keys)))
    return rights


def _topics(robot: str, topics: Iterable[str]) -> list[str]:
    """The keys of a robot's topics in all profiles: the name alone, and with domain, type and hash around it."""
    names = [topic_name(robot, topic) for topic in topics]
    return [*names, *(f"*/{name}/*/*" for name in names)]


def _with_advanced(keys: Iterable[str]) -> set[str]:
    keys = set(keys)
    return keys | {key + _ADVANCED for key in keys if "@" not in key}


def _canonical(key: str) -> str:
    try:
        return str(zenoh.KeyExpr.autocanonize(key))
    except zenoh.ZError as error:
        raise ConfigError(f"access: {key!r} is not a key expression: {str(error).split(': ', 1)[-1]}") from None


def _access_control(access: Access, *, by_certificate: bool, own_name: str | None) -> dict[str, Any]:
    """Zenoh's setting ``access_control``.

    by_certificate: the rules' names are common names of certificates, else user names. own_name: the router's name;
    a peer that has it holds the router's key or password, as other programs on its machine do, and may do everything.
    """
    rights = rights_of(access)
    if own_name is not None:
        rights[own_name] = dict.fromkeys(("write", "read"), sorted(_with_advanced(["**", _ROS_GRAPH])))
    allowed = [(who, right, keys) for who, granted in rights.items() for right, keys in granted.items() if keys]
    outgoing = {"**", "**" + _ADVANCED, *(key for _, _, keys in allowed for key in keys if "@" in key)}
    every_message = _MESSAGES["write"] + _MESSAGES["read"]

    def rule(name: str, permission: str, flow: str, messages: tuple[str, ...], keys: list[str]) -> dict[str, Any]:
        return {"id": name, "permission": permission, "flows": [flow], "messages": messages, "key_exprs": keys}

    rules = [
        # Peers without a rule are a subject too, or Zenoh would not log that they are refused.
        rule("nothing", "deny", "ingress", every_message, ["**"]),
        rule("outgoing", "allow", "egress", every_message, sorted(outgoing)),
        *(rule(f"{right} of {who}", "allow", "ingress", _MESSAGES[right], keys) for who, right, keys in allowed),
    ]
    subjects: list[dict[str, Any]] = [{"id": "anyone"}]
    policies = [{"id": "anyone", "subjects": ["anyone"], "rules": ["nothing"]}]
    for who in rights:
        peer, names = f"peer {who}", [f"{right} of {who}" for name, right, _ in allowed if name == who]
        subjects.append({"id": peer, "cert_common_names" if by_certificate else "usernames": [who]})
        policies.append({"id": peer, "subjects": [peer], "rules": ["outgoing", *names]})
    lists = {"rules": rules, "subjects": subjects, "policies": policies}
    return {"enabled": True, "default_permission": "deny"} | lists


_MOST_BYTES: Final = 1 << 20  # of files of users and passwords; chosen
_QUEUES: Final = "transport/link/tx/queue/size"
_SETTINGS: Final[dict[str, Any]] = {
    "timestamping/enabled": True,  # advanced publishers need it
    # A client reconnects within 0.5 s after its router has returned; with Zenoh's defaults it takes 1 s to 4 s.
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
    # A message to a subscriber that does not read is dropped soon, so that it delays no other.
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 200,  # us
    # 100 connections that say nothing keep others from logging in until they are given up, with Zenoh's default 10 s.
    "transport/unicast/accept_timeout": 3000,  # ms
}
_BATCHES: Final = 16  # of each priority; chosen
_SCOUTING_DELAY: Final = 500  # ms; Zenoh's default
_CONNECT_TIMEOUT: Final = 3.0  # s for a router or peer to reach an endpoint it connects to; chosen
_GRACE: Final = 0.5  # s after a signal for a session that is about to be open; chosen
_SOURCE = re.compile(r"\s+at /\S+\.rs:\d+\.?")  # the place in Zenoh's source at the end of its errors


def zenoh_config(config: SessionConfig) -> zenoh.Config:
    """Zenoh's settings for a session's config. ConfigError: a file or a setting is wrong."""
    given: dict[str, Any] = _SETTINGS | {
        "mode": config.mode,
        "transport/link/rx/max_message_size": config.largest_message,
        "listen/endpoints": config.listening,
        "connect/endpoints": config.connecting,
        "scouting/multicast/enabled": config.scouting,
        "scouting/gossip/enabled": config.scouting,
        "scouting/delay": _SCOUTING_DELAY if config.scouting or config.connecting else 0,
    }
    if config.mode == "client":
        given["connect/timeout_ms"] = round(config.wait * 1000)
    if config.users_file is not None:
        # Zenoh would refuse everybody with an empty file, and names no wrong line.
        lines = _lines(config.users_file, "users_file")
        if not any(lines):
            raise ConfigError(f"users_file: {config.users_file} holds no user; write lines of user:password")
        for number, line in enumerate(lines, 1):
            user, _, password = line.partition(":")
            if line and not (user and password):
                raise ConfigError(f"users_file: {config.users_file}, line {number}: expected user:password")
        given["transport/auth/usrpwd/dictionary_file"] = str(config.users_file)
    if config.user is not None:
        given["transport/auth/usrpwd/user"] = config.user.name
        given["transport/auth/usrpwd/password"] = _password(config.user)
    own_name = config.user.name if config.user else None
    if (tls := config.tls) is not None:
        given["transport/link/tls"] = certificates = {
            "root_ca_certificate": str(tls.ca),
            "enable_mtls": tls.mutual,
            "verify_name_on_connect": tls.verify_name,
            "close_link_on_expiration": True,
        }
        if tls.certificate is None or tls.key is None:
            read_certificate(tls.ca)
        else:
            name = check_files(tls.ca, tls.certificate, tls.key, listening=bool(config.listening))
            own_name = name if tls.mutual else own_name
            for side in ("listen", "connect"):
                certificates |= {f"{side}_certificate": str(tls.certificate), f"{side}_private_key": str(tls.key)}
    if config.access is not None:
        by_certificate = tls is not None and tls.mutual
        given["access_control"] = _access_control(config.access, by_certificate=by_certificate, own_name=own_name)
    settings = zenoh.Config()
    # Room for bursts: with Zenoh's default of 2 batches a healthy subscriber loses samples at 1 kHz.
    given[_QUEUES] = dict.fromkeys(json.loads(settings.get_json(_QUEUES)), _BATCHES)
    for key, value in given.items():
        settings.insert_json5(key, json.dumps(value))
    for key, value in config.extra.items():
        try:
            settings.insert_json5(key, json.dumps(value))
        except (zenoh.ZError, TypeError, ValueError) as error:
            text = _SOURCE.sub("", str(error)).strip()
            if "unknown key" not in text:
                raise ConfigError(f"extra: {key}: {text}") from None
            near = nearest(key, _keys(json.loads(str(zenoh.Config()))))
            raise ConfigError(f"extra: Zenoh has no setting {key!r}; {near}see its DEFAULT_CONFIG.json5") from None
    return settings


def _keys(tree: Mapping[str, Any], above: str = "") -> Iterator[str]:
    for name, value in tree.items():
        yield above + name
        if isinstance(value, dict):
            yield from _keys(value, f"{above}{name}/")


def _password(user: User) -> str:
    if user.password is not None:
        return user.password.get_secret_value()
    if user.password_env is not None:
        try:
            return os.environ[user.password_env]
        except KeyError:
            raise ConfigError(f"user: the environment variable {user.password_env} is not set") from None
    assert user.password_file is not None  # User has checked it
    lines = _lines(user.password_file, "user")
    if not lines or not lines[0]:
        raise ConfigError(f"user: {user.password_file} is empty; its first line is the password")
    return lines[0]


def _lines(path: Path, what: str) -> list[str]:
    try:
        return read_text(path, _MOST_BYTES).splitlines()
    except DataError as error:
        raise ConfigError(f"{what}: {error}") from None


def open_session(config: SessionConfig, purpose: str, stop: Stop | None = None) -> zenoh.Session:
    """Open a session. purpose: who opens it or what for; an error's message begins with it. stop: ends the waiting.

    A client reconnects by itself after its router was away. Zenoh logs to standard output what RUST_LOG says.
    ConfigError in one line: a file is missing or wrong, the address is in use, nothing listens at the endpoint to
    connect to, or it refuses us.
    """
    zenoh.try_init_log_from_env()
    try:
        session = _opened(zenoh_config(config), stop)
    except ConfigError as error:
        raise ConfigError(f"{purpose}: {error}") from None
    except zenoh.ZError as error:
        raise ConfigError(f"{purpose}: {_why_not_open(config, _SOURCE.sub('', str(error)).strip())}") from None
    # Zenoh opens a router or peer even if it is refused, and retries for ever.
    patience = 0.0 if config.mode == "client" else max(_CONNECT_TIMEOUT, config.wait)
    if config.connecting and not wait_until(lambda: is_connected(session), patience):
        close_session(session)
        raise ConfigError(f"{purpose}: {_why_not_connected(config)}")
    exposed, tls, users = ", ".join(config.unprotected), config.tls, config.users_file
    if exposed:
        way = "where anybody on the network may connect; give users_file, or tls and access"
        LOG.warning("%s listens at %s, %s", purpose, exposed, way)
    elif config.listening and config.access is None and (tls or users):
        who, way = f"with a password of {users}", "give access"
        if tls and not users:
            who = f"with a certificate of {tls.ca}"
            if not tls.mutual:
                who, way = "who reaches it", "give tls mutual: true, and access"
        said = "%s has no access rules, so that everybody %s may do everything, as swap calibrations; %s"
        LOG.warning(said, purpose, who, way)
    return session


def _opened(settings: zenoh.Config, stop: Stop | None) -> zenoh.Session:
    """Zenoh's session, opened in a thread, so that a signal ends the wait for a router that stands still."""
    opened: Future[zenoh.Session] = Future()

    def run() -> None:
        try:
            opened.set_result(zenoh.open(settings))
        except Exception as error:
            opened.set_exception(error)

    Thread(target=run, name="open session", daemon=True).start()
    # in steps: Zenoh's own handler of SIGINT wakes no waiting thread
    if not wait_until(opened.done, math.inf, stop) and not wait_until(opened.done, _GRACE) and stop is not None:
        stop.interrupt()
    return opened.result()


def close_session(session: zenoh.Session) -> None:
    """Close a session. Where another does not read, Zenoh gives its farewell up after some 10 s, as a warning tells."""
    try:
        session.close()
    except zenoh.ZError as error:
        LOG.warning("the session ended without a farewell to all: %s", _SOURCE.sub("", str(error)))


def is_connected(session: zenoh.Session) -> bool:
    """True while the session has a link to a router or a peer."""
    return bool(session.info.routers_zid() or session.info.peers_zid())


_TIMEOUT: Final = 2.0  # s to wait for a TCP connection, and for a word of TLS; chosen
_ALERTS: Final = {  # ends of OpenSSL's reasons when the other side refuses our certificate, and what to do
    "CERTIFICATE_REQUIRED": "it asks for a certificate; give tls: certificate, key and mutual: true",
    "HANDSHAKE_FAILURE": "it asks for a certificate; give tls: certificate, key and mutual: true",
    "CERTIFICATE_EXPIRED": "it says that our certificate has expired; check the clocks",
    "UNKNOWN_CA": "our certificate is not from its authority; make one with its ca.pem",
    "DECRYPT_ERROR": "our certificate is not from its authority; make one with its ca.pem",
    "BAD_CERTIFICATE": "it rejects our certificate as bad; make one with its ca.pem",
}
_NOT_LISTENING: Final = {  # parts of Zenoh's errors where an endpoint cannot be listened on, and what that means
    "Address already in use": "is in use; another omnibench live may run there: stop it, or listen elsewhere",
    "Cannot assign requested address": "is not an address of this machine; listen on one that is",
    "lookup address information": "is not a known host; listen on an address of this machine",
    "Permission denied": "is not permitted; take a port from 1024 on",
}
_ELSEWHERE: Final = "start omnibench live there, or connect (--connect) to where it runs"


def _why_not_open(config: SessionConfig, text: str) -> str:
    """One line with the reason for Zenoh's error ``text``."""
    if "Unable to connect" in text and config.connecting:
        return _why_not_connected(config)
    for sign, reason in _NOT_LISTENING.items():
        if sign in text:
            named = [endpoint for endpoint in config.listening if endpoint in text]
            return f"{', '.join(named or config.listening)} {reason}"
    if config.mode == "client" and config.scouting:
        return f"no router was found by scouting; start omnibench live, or give connect ({text})"
    return text


def _why_not_connected(config: SessionConfig) -> str:
    """One line with the reason for each endpoint that a session did not reach or that refused it."""
    return "; ".join(f"{endpoint}: {_why(endpoint, config)}" for endpoint in config.connecting)


def _why(endpoint: str, config: SessionConfig) -> str:
    """The reason why an endpoint was not reached, or that it refuses us, after a connection like Zenoh's."""
    protocol, host, port = _address(endpoint)
    if protocol not in ("tcp", "tls", "ws"):
        return f"no answer, or it refuses us; {_ELSEWHERE}"
    connected, tls, asks_for_tls = False, config.tls, "asks for TLS; connect to tls/... and give tls"
    try:
        with socket.create_connection((host, port), _TIMEOUT) as connection:
            connected = True
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
            context.check_hostname = tls is not None and tls.verify_name
            if tls is None:
                context.verify_mode = ssl.CERT_NONE
            else:
                context.load_verify_locations(tls.ca)
                if tls.certificate is not None and tls.mutual:
                    context.load_cert_chain(tls.certificate, tls.key)
            if protocol != "ws":
                with context.wrap_socket(connection, server_hostname=host) as encrypted:
                    if tls is None:
                        return asks_for_tls
                    encrypted.recv(1)  # with TLS 1.3 a refusal comes after the handshake
    except ssl.SSLCertVerificationError as error:
        return f"we refuse its certificate: {error.verify_message.rstrip('.')}; check tls: ca ({tls and tls.ca})"
    except OSError as error:
        reason = getattr(error, "reason", None) or error.strerror or str(error)
        if not connected:
            reasons: dict[type[OSError], str] = {
                socket.gaierror: f"there is no host called {host}",
                ConnectionRefusedError: f"nothing listens there; {_ELSEWHERE}",
                TimeoutError: f"no answer within {_TIMEOUT:.0f} s; check the address, the network and its firewalls",
            }
            return reasons.get(type(error), f"cannot be reached: {reason}")
        if tls is None and "ALERT" in reason:
            return asks_for_tls
        if tls is not None and not isinstance(error, TimeoutError):
            explanation = next((text for sign, text in _ALERTS.items() if reason.endswith(sign)), None)
            return explanation or f"the TLS handshake fails: {reason.replace('_', ' ').lower()}"
    if config.user is not None:
        return f"refuses user {config.user.name!r}: wrong name or password; compare with the router's users_file"
    return "refuses us, or does not answer: it may ask for a user and password (user), or it is not a Zenoh router"
