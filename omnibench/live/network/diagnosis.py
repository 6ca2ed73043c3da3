"""Why a session did not open: Zenoh only says that it could not connect, so the way there is tried step by step."""

from __future__ import annotations

import socket
import ssl
from collections.abc import Sequence
from typing import Final

from omnibench.live.network.session_config import SessionConfig, Tls, address_of

_TIMEOUT: Final = 2.0  # s
_ALERTS: Final = {  # what TLS says when the other side refuses us
    "CERTIFICATE_REQUIRED": "it asks for a certificate; give tls: certificate, key and mutual: true",
    "HANDSHAKE_FAILURE": "it asks for a certificate; give tls: certificate, key and mutual: true",
    "CERTIFICATE_EXPIRED": "our certificate has expired there; look at the clocks",
    "UNKNOWN_CA": "our certificate is not from its authority; have it made with its ca.pem",
    "DECRYPT_ERROR": "our certificate is not from its authority; have it made with its ca.pem",
    "BAD_CERTIFICATE": "it takes our certificate for a bad one; have it made with its ca.pem",
}


def why_not_connected(config: SessionConfig) -> str:
    """One line on the endpoints that a session did not reach, or was refused at."""
    return "; ".join(f"{endpoint}: {_why(endpoint, config)}" for endpoint in config.connecting)


def why_not_listening(endpoints: Sequence[str], text: str) -> str | None:
    """One line on an endpoint that cannot be listened at, from Zenoh's ``text``; None when it is not that."""
    place = next((endpoint for endpoint in endpoints if endpoint in text), ", ".join(endpoints))
    for sign, reason in (
        ("Address already in use", "is in use; another omnibench live may run there: stop it, or listen elsewhere"),
        ("Cannot assign requested address", "is no address of this machine; listen at one that is"),
        ("lookup address information", "is no known host; listen at an address of this machine"),
        ("Permission denied", "is not allowed to us; take a port from 1024 on"),
    ):
        if sign in text:
            return f"{place} {reason}"
    return None


def _why(endpoint: str, config: SessionConfig) -> str:
    address = address_of(endpoint)
    if address is None or address[0] not in ("tcp", "tls", "ws"):
        return f"no answer, or we are refused; start omnibench live there, {_elsewhere(config)}"
    protocol, host, port = address
    try:
        with socket.create_connection((host, port), _TIMEOUT) as connection:
            if protocol == "tls" and config.tls is not None:
                return _why_not_tls(connection, host, config.tls) or _refused(config)
            if protocol == "tcp" and _speaks_tls(connection):
                return "asks for TLS; connect to tls/... and give tls"
    except socket.gaierror:
        return f"no host of the name {host} is known"
    except ConnectionRefusedError:
        return f"nothing listens there; start omnibench live, {_elsewhere(config)}"
    except TimeoutError:
        return f"no answer within {_TIMEOUT:.0f} s; look at the address, the network and its firewalls"
    except OSError as error:
        return f"cannot be reached: {error.strerror or error}"
    return _refused(config)


def _elsewhere(config: SessionConfig) -> str:
    return "or --connect to where it runs" if config.mode == "client" else "or connect to where it runs"


def _refused(config: SessionConfig) -> str:
    if config.user is not None:
        return f"refuses user {config.user.name!r}: wrong name or password; compare with the router's users_file"
    return "refuses us: it may ask for a user and password (user: name, password_file), or is no Zenoh router"


def _why_not_tls(connection: socket.socket, host: str, tls: Tls) -> str | None:
    try:
        context = ssl.create_default_context(cafile=str(tls.ca))
        context.check_hostname = tls.verify_name
        if tls.certificate is not None and tls.mutual:
            context.load_cert_chain(tls.certificate, tls.key)
        with context.wrap_socket(connection, server_hostname=host) as encrypted:
            encrypted.settimeout(0.5)  # with TLS 1.3 a refusal comes after the handshake
            encrypted.recv(1)
    except ssl.SSLCertVerificationError as error:
        return f"its certificate is refused: {error.verify_message.rstrip('.')}; look at tls: ca ({tls.ca})"
    except TimeoutError:
        return None
    except ssl.SSLError as error:
        reason = error.reason or str(error)
        found = next((text for sign, text in _ALERTS.items() if reason.endswith(sign)), None)
        return found or f"no TLS can be agreed on: {reason.replace('_', ' ').lower()}"
    except OSError as error:
        return f"no TLS can be agreed on: {error.strerror or error}"
    return None


def _speaks_tls(connection: socket.socket) -> bool:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    connection.settimeout(0.5)
    try:
        context.wrap_socket(connection).close()
    except ssl.SSLError as error:
        return "ALERT" in (error.reason or "")
    except OSError:
        return False
    return True
