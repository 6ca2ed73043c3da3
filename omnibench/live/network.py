"""Opening of Zenoh sessions, by default on loopback and without scouting.

Zenoh only reports that it could not connect: the reason, in one line, is found by trying each step.

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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from threading import Thread
from typing import Any, Final, Literal

import zenoh

from omnibench.errors import ConfigError, DataError, nearest
from omnibench.files import read_text
from omnibench.live.session_config import Access, SessionConfig, Tls, User, address_of, check_files, common_name
from omnibench.live.stopping import Stop, wait_until
from omnibench.live.topics import INPUTS, TOPICS, topic_name

Right = Literal["write", "read", "ask", "put", "subscribe", "serve"]
_MESSAGES: Final[dict[Right, tuple[str, ...]]] = {
    "write": ("put", "delete", "declare_queryable", "reply", "liveliness_token"),
    "read": ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query"),
    "ask": ("query",),
    "put": ("put",),
    "subscribe": ("declare_subscriber",),
    "serve": ("declare_queryable", "reply", "liveliness_token"),
}
_ALL: Final = _MESSAGES["write"] + _MESSAGES["read"]

_ALIVE: Final = "omnibench/{}/alive"
_CLAIM: Final = "omnibench/{}/claim-$*"
_RECEIVED: Final = "omnibench/{}/received/*"  # acknowledgements of what a replay sends
_ANSWERS: Final = tuple("omnibench/{}/" + service for service in ("info", "calibration", "health", "pose"))
_SERVICES: Final = "omnibench/{}/*"
_CALIBRATION: Final = "omnibench/{}/calibration"
# ROS 2's keys of a robot, in any domain: domain, name, type and hash. omnibench's services have fewer parts.
_ROS_KEYS: Final = "*/{}/*/**/*/*"
_ROS_GRAPH: Final = "@ros2_lv/**"  # rmw_zenoh's liveliness tokens: nodes and their topics, no data
_ADVANCED: Final = "/@adv/**"  # below a key: messages between Zenoh's advanced publishers and subscribers

_OUTPUTS: Final = tuple(topic for topic in TOPICS if topic not in INPUTS)

Rights = dict[str, dict[Right, list[str]]]
"""Peer's name -> right -> key expressions."""


def rights_of(access: Access) -> Rights:
    """The key expressions that each peer may write and read. ConfigError: a rule's key expression is not valid."""
    rights: Rights = defaultdict(lambda: defaultdict(list))

    def grant(who: Iterable[str], **keys: Iterable[str]) -> None:
        for name in who:
            for right in _MESSAGES:
                rights[name][right] += keys.get(right, ())

    tokens = [*_services("*", _ALIVE), _ROS_GRAPH]
    for robot, name in access.robots.items():
        own_keys = (f"{robot}/**", *_services(robot, _ROS_KEYS), *_topics(robot, ("tf",)))
        grant([name], write=[*_topics(robot, INPUTS), _ROS_GRAPH], read=[*own_keys, *tokens])
        received = _services(robot, _RECEIVED)
        grant([name], ask=[*_services(robot, *_ANSWERS), *received], subscribe=received)
    everything = [*_topics("*", TOPICS), *tokens]
    answers, services, calibrations = _services("*", *_ANSWERS), _services("*", _SERVICES), _services("*", _CALIBRATION)
    # Nodes answer for their robots and take calibrations; to give orders and calibrations is for operators alone.
    grant(access.nodes, write=[*_topics("*", _OUTPUTS), _ROS_GRAPH], serve=services)
    grant(access.nodes, read=[*everything, *_services("*", _CLAIM)], ask=answers, subscribe=calibrations)
    grant(access.nodes, put=_services("*", _RECEIVED))
    grant(access.viewers, write=[_ROS_GRAPH], read=everything, ask=answers)
    grant(access.operators, write=[_ROS_GRAPH], read=everything, ask=services, put=calibrations)
    for rule in access.rules:
        grant(rule.who, write=rule.write, read=rule.read)
    return {
        who: {right: sorted(_with_advanced(_checked(key) for key in keys)) for right, keys in granted.items()}
        for who, granted in rights.items()
    }


def access_control(access: Access, *, by_certificate: bool, own_name: str | None = None) -> dict[str, Any]:
    """Zenoh's setting ``access_control``.

    by_certificate: the rules' names are common names of certificates, else user names. own_name: the router's name;
    a peer that has it holds the router's key or password, as other programs on its machine do, and may do everything.
    """
    property_name = "cert_common_names" if by_certificate else "usernames"
    rights = rights_of(access)
    if own_name is not None:
        all_keys = sorted(_with_advanced(["**", _ROS_GRAPH]))
        rights[own_name] = {"write": all_keys, "read": all_keys}
    named = {key for granted in rights.values() for keys in granted.values() for key in keys if "@" in key}
    rules = [
        # Peers without a rule are a subject too, or Zenoh would not log that they are refused.
        _rule("nothing", "deny", "ingress", _ALL, ["**"]),
        _rule("outgoing", "allow", "egress", _ALL, sorted({"**", "**" + _ADVANCED, *named})),
    ]
    policies = [{"id": "anyone", "subjects": ["anyone"], "rules": ["nothing"]}]
    subjects: list[dict[str, Any]] = [{"id": "anyone"}]
    for number, (who, granted) in enumerate(rights.items()):
        peer_rules = [
            _rule(f"{number} {right}", "allow", "ingress", _MESSAGES[right], keys)
            for right, keys in granted.items()
            if keys
        ]
        rules += peer_rules
        names = [rule["id"] for rule in peer_rules]
        subjects.append({"id": f"{number}", property_name: [who]})
        policies.append({"id": f"{number}", "subjects": [f"{number}"], "rules": ["outgoing", *names]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rule(name: str, permission: str, flow: str, messages: tuple[str, ...], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": permission, "flows": [flow], "messages": [*messages], "key_exprs": keys}


def _topics(robot: str, topics: Iterable[str]) -> list[str]:
    """The keys of a robot's topics in all profiles: the name alone, and with domain, type and hash around it."""
    names = [topic_name(robot, topic) for topic in topics]
    return [*names, *(f"*/{name}/*/*" for name in names)]


def _services(robot: str, *patterns: str) -> list[str]:
    return [pattern.format(robot) for pattern in patterns]


def _with_advanced(keys: Iterable[str]) -> set[str]:
    keys = set(keys)
    return keys | {key + _ADVANCED for key in keys if "@" not in key}


def _checked(key: str) -> str:
    try:
        return str(zenoh.KeyExpr.autocanonize(key))
    except zenoh.ZError as error:
        raise ConfigError(f"access: {key!r} is not a key expression: {str(error).split(': ', 1)[-1]}") from None


_TIMEOUT: Final = 2.0  # s to wait for a TCP connection, and for a word of TLS; chosen
_ALERTS: Final = {  # ends of OpenSSL's reasons when the other side refuses our certificate, and what to do
    "CERTIFICATE_REQUIRED": "it asks for a certificate; give tls: certificate, key and mutual: true",
    "HANDSHAKE_FAILURE": "it asks for a certificate; give tls: certificate, key and mutual: true",
    "CERTIFICATE_EXPIRED": "it says that our certificate has expired; check the clocks",
    "UNKNOWN_CA": "our certificate is not from its authority; make one with its ca.pem",
    "DECRYPT_ERROR": "our certificate is not from its authority; make one with its ca.pem",
    "BAD_CERTIFICATE": "it rejects our certificate as bad; make one with its ca.pem",
}


def why_not_connected(config: SessionConfig) -> str:
    """One line with the reason for each endpoint that a session did not reach or that refused it."""
    return "; ".join(f"{endpoint}: {_why(endpoint, config)}" for endpoint in config.connecting)


def why_not_listening(endpoints: Sequence[str], text: str) -> str | None:
    """One line with the reason why an endpoint cannot be listened on, from Zenoh's error ``text``; None if unknown."""
    place = next((endpoint for endpoint in endpoints if endpoint in text), ", ".join(endpoints))
    for sign, reason in (
        (
            "Address already in use",
            "is in use; another omnibench live may run there: stop it, or listen elsewhere",
        ),
        ("Cannot assign requested address", "is not an address of this machine; listen on one that is"),
        ("lookup address information", "is not a known host; listen on an address of this machine"),
        ("Permission denied", "is not permitted; take a port from 1024 on"),
    ):
        if sign in text:
            return f"{place} {reason}"
    return None


def _why(endpoint: str, config: SessionConfig) -> str:
    address = address_of(endpoint)
    if address is None or address[0] not in ("tcp", "tls", "ws"):
        return f"no answer, or it refuses us; start omnibench live there, {_elsewhere(config)}"
    protocol, host, port = address
    try:
        with socket.create_connection((host, port), _TIMEOUT) as connection:
            if protocol == "tls" and config.tls is not None:
                return _why_not_tls(connection, host, config.tls) or _refused(config)
            if protocol == "tcp" and _speaks_tls(connection):
                return "asks for TLS; connect to tls/... and give tls"
    except socket.gaierror:
        return f"there is no host called {host}"
    except ConnectionRefusedError:
        return f"nothing listens there; start omnibench live, {_elsewhere(config)}"
    except TimeoutError:
        return f"no answer within {_TIMEOUT:.0f} s; check the address, the network and its firewalls"
    except OSError as error:
        return f"cannot be reached: {error.strerror or error}"
    return _refused(config)


def _elsewhere(config: SessionConfig) -> str:
    return "or --connect to where it runs" if config.mode == "client" else "or connect to where it runs"


def _refused(config: SessionConfig) -> str:
    if config.user is not None:
        return f"refuses user {config.user.name!r}: wrong name or password; compare with the router's users_file"
    return (
        "refuses us, or does not answer: it may ask for a user and password (user: name, password_file), it stands "
        "still, or it is not a Zenoh router"
    )


def _why_not_tls(connection: socket.socket, host: str, tls: Tls) -> str | None:
    try:
        context = ssl.create_default_context(cafile=str(tls.ca))
        context.check_hostname = tls.verify_name
        if tls.certificate is not None and tls.mutual:
            context.load_cert_chain(tls.certificate, tls.key)
        with context.wrap_socket(connection, server_hostname=host) as encrypted:
            encrypted.settimeout(_TIMEOUT)  # with TLS 1.3 a refusal comes after the handshake
            encrypted.recv(1)
    except ssl.SSLCertVerificationError as error:
        return f"we refuse its certificate: {error.verify_message.rstrip('.')}; check tls: ca ({tls.ca})"
    except TimeoutError:
        return None
    except ssl.SSLError as error:
        reason = error.reason or str(error)
        explanation = next((text for sign, text in _ALERTS.items() if reason.endswith(sign)), None)
        return explanation or f"the TLS handshake fails: {reason.replace('_', ' ').lower()}"
    except OSError as error:
        return f"the TLS handshake fails: {error.strerror or error}"
    return None


def _speaks_tls(connection: socket.socket) -> bool:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    connection.settimeout(_TIMEOUT)
    try:
        context.wrap_socket(connection).close()
    except ssl.SSLError as error:
        return "ALERT" in (error.reason or "")
    except OSError:
        return False
    return True


LOG = logging.getLogger("omnibench.live")

_MOST_BYTES: Final = 1 << 20  # of files of users and passwords; chosen
_PRIORITIES: Final = (
    *("control", "real_time", "interactive_high", "interactive_low"),
    *("data_high", "data", "data_low", "background"),
)
_SETTINGS: Final[dict[str, Any]] = {
    "timestamping/enabled": True,  # advanced publishers need it
    # A client reconnects within 0.5 s after its router has returned; with Zenoh's defaults it takes 1 s to 4 s.
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
    # Room for bursts: with Zenoh's default of 2 batches a healthy subscriber loses samples at 1 kHz. A message to a
    # subscriber that does not read is dropped soon, so that it delays no other.
    "transport/link/tx/queue/size": dict.fromkeys(_PRIORITIES, 16),
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 200,  # us
    # 100 connections that say nothing keep others from logging in until they are given up, with Zenoh's default 10 s.
    "transport/unicast/accept_timeout": 3000,  # ms
}
_SCOUTING_DELAY: Final = 500  # ms; Zenoh's default
_CONNECT_TIMEOUT: Final = 3.0  # s for a router or peer to reach an endpoint it connects to; chosen
_GRACE: Final = 0.5  # s after a signal for a session that is about to be open; chosen
_SOURCE = re.compile(r"\s+at /\S+\.rs:\d+\.?")  # the place in Zenoh's source at the end of its errors


def open_session(config: SessionConfig, purpose: str, stop: Stop | None = None) -> zenoh.Session:
    """Open a session. purpose: who opens it or what for; an error's message begins with it. stop: ends the waiting.

    A client reconnects by itself after its router was away. Zenoh logs to standard output what RUST_LOG says.
    ConfigError in one line: a file is missing or wrong, the address is in use, nothing listens at the endpoint to
    connect to, or it refuses us.
    """
    zenoh.try_init_log_from_env()
    try:
        settings = zenoh_config(config)
        try:
            session = _opened(settings, stop)
        except zenoh.ZError as error:
            raise ConfigError(_why_not_open(config, error)) from None
        try:
            # Zenoh opens a router or peer even if it is refused, and retries for ever.
            patience = 0.0 if config.mode == "client" else max(_CONNECT_TIMEOUT, config.wait)
            if config.connecting and not wait_until(lambda: is_connected(session), patience):
                raise ConfigError(why_not_connected(config))
        except BaseException:
            close_session(session)
            raise
    except ConfigError as error:
        raise ConfigError(f"{purpose}: {error}") from None
    if config.unprotected:
        LOG.warning(
            "%s listens at %s, where anybody on the network may connect; give users_file, or tls and access",
            purpose,
            ", ".join(config.unprotected),
        )
    elif config.listening and config.access is None and (config.tls or config.users_file):
        who, way = f"with a password of {config.users_file}", "give access"
        if config.tls and not config.users_file:
            who = f"with a certificate of {config.tls.ca}"
            if not config.tls.mutual:
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


def zenoh_config(config: SessionConfig) -> zenoh.Config:
    """Zenoh's settings for a session's config. ConfigError: a file or a setting is wrong."""
    settings = zenoh.Config()
    for key, value in _settings(config):
        settings.insert_json5(key, json.dumps(value))
    for key, value in config.extra.items():
        try:
            settings.insert_json5(key, json.dumps(value))
        except (zenoh.ZError, TypeError, ValueError) as error:
            text = _SOURCE.sub("", str(error)).strip()
            if "unknown key" not in text:
                raise ConfigError(f"extra: {key}: {text}") from None
            near = nearest(key, list(_keys(json.loads(str(zenoh.Config())))))
            raise ConfigError(f"extra: Zenoh has no setting {key!r}; {near}see its DEFAULT_CONFIG.json5") from None
    return settings


def _settings(config: SessionConfig) -> Iterator[tuple[str, Any]]:
    yield from _SETTINGS.items()
    yield "mode", config.mode
    yield "transport/link/rx/max_message_size", config.largest_message
    yield "listen/endpoints", list(config.listening)
    yield "connect/endpoints", list(config.connecting)
    yield "scouting/multicast/enabled", config.scouting
    yield "scouting/gossip/enabled", config.scouting
    yield "scouting/delay", _SCOUTING_DELAY if config.scouting or config.connecting else 0
    if config.mode == "client":
        yield "connect/timeout_ms", round(config.wait * 1000)
    if config.users_file is not None:
        # Zenoh would refuse everybody with an empty file, and names no wrong line.
        lines = _lines(config.users_file, "users_file")
        if not any(lines):
            raise ConfigError(f"users_file: {config.users_file} holds no user; write lines of user:password")
        for number, line in enumerate(lines, 1):
            user, _, password = line.partition(":")
            if line and not (user and password):
                raise ConfigError(f"users_file: {config.users_file}, line {number}: expected user:password")
        yield "transport/auth/usrpwd/dictionary_file", str(config.users_file)
    if config.user is not None:
        yield "transport/auth/usrpwd/user", config.user.name
        yield "transport/auth/usrpwd/password", _password(config.user)
    if (tls := config.tls) is not None:
        check_files(tls, listening=bool(config.listening))
        settings: dict[str, Any] = {
            "root_ca_certificate": str(tls.ca),
            "enable_mtls": tls.mutual,
            "verify_name_on_connect": tls.verify_name,
            "close_link_on_expiration": True,
        }
        if tls.certificate is not None:
            for side in ("listen", "connect"):
                settings[f"{side}_certificate"], settings[f"{side}_private_key"] = str(tls.certificate), str(tls.key)
        yield "transport/link/tls", settings
    if config.access is not None:
        certificate = config.tls.certificate if config.tls is not None and config.tls.mutual else None
        login = config.user.name if config.user else None
        own_name = login if certificate is None else common_name(certificate)
        yield "access_control", access_control(config.access, by_certificate=certificate is not None, own_name=own_name)


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


def is_connected(session: zenoh.Session) -> bool:
    """True while the session has a link to a router or a peer."""
    return bool(session.info.routers_zid() or session.info.peers_zid())


def _why_not_open(config: SessionConfig, error: zenoh.ZError) -> str:
    text = _SOURCE.sub("", str(error)).strip()
    if "Unable to connect" in text and config.connecting:
        return why_not_connected(config)
    reason = why_not_listening(config.listening, text)
    if reason is None and config.mode == "client" and config.scouting:
        return f"no router was found by scouting; start omnibench live, or give connect ({text})"
    return reason or text


def _keys(tree: Mapping[str, Any], above: str = "") -> Iterator[str]:
    for name, value in tree.items():
        yield above + name
        if isinstance(value, dict):
            yield from _keys(value, f"{above}{name}/")
