"""The reason why a session did not open, found by trying each step: Zenoh only reports that it could not connect."""

from __future__ import annotations

import socket
import ssl
from collections.abc import Sequence
from typing import Final

from omnibench.live.network.session_config import SessionConfig, Tls, address_of

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
