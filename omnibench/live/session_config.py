"""The config of a Zenoh session: endpoints, our user and certificates, and access rights."""

from __future__ import annotations

import ipaddress
import logging
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from pydantic import AfterValidator, Field, SecretStr, field_validator, model_validator

from omnibench.config import Model, RelativePath
from omnibench.errors import ConfigError, DataError
from omnibench.files import read_bytes

Mode = Literal["router", "peer", "client"]

PORT: Final = 7447  # Zenoh's default
_PROTOCOLS: Final = ("tcp", "tls", "quic", "udp", "ws")
_ENCRYPTED: Final = ("tls", "quic")
_NETWORK = re.compile(
    rf"(?P<protocol>{'|'.join(_PROTOCOLS)})/(?P<host>\[[0-9A-Fa-f:.%]+\]|[^\s/:\[\]#?]+):(?P<port>\d{{1,5}})([?#]\S*)?"
)
_FILE = re.compile(r"unixsock-stream/[^\s#?]+")


def _checked_endpoint(text: str) -> str:
    match = _NETWORK.fullmatch(text)
    if not _FILE.fullmatch(text) and (match is None or int(match["port"]) > 65535):
        raise ValueError(
            f"{text!r} is not an endpoint; write protocol/host:port as tcp/127.0.0.1:{PORT} (protocols: "
            f"{', '.join(_PROTOCOLS)})"
        )
    return text


Endpoint = Annotated[str, AfterValidator(_checked_endpoint)]


def address_of(endpoint: str) -> tuple[str, str, int] | None:
    """Protocol, host and port of an endpoint; None if it is a Unix socket's file."""
    match = _NETWORK.fullmatch(endpoint)
    return None if match is None else (match["protocol"], match["host"].strip("[]"), int(match["port"]))


def is_loopback(endpoint: str) -> bool:
    """True if an endpoint can be reached from this machine only."""
    address = address_of(endpoint)
    if address is None or address[1] == "localhost":
        return True
    try:
        return ipaddress.ip_address(address[1]).is_loopback
    except ValueError:
        return False


class User(Model):
    """The user name and password with which we log in at a router."""

    name: str = Field(min_length=1)
    password: SecretStr | None = Field(None, description="in plain text; a file or an environment variable is safer")
    password_file: RelativePath | None = Field(
        None, description="its first line is the password; relative to the config file"
    )
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
    """Rights of some peers. Keys are key expressions; ``**`` does not match ``@ros2_lv``, which must be named."""

    who: tuple[str, ...] = Field(
        min_length=1, description="common names of certificates or, without certificates, user names"
    )
    write: tuple[str, ...] = Field(
        (), description="keys to put and delete, to answer queries on and to declare liveliness tokens"
    )
    read: tuple[str, ...] = Field((), description="keys to subscribe to, to query and to look for liveliness tokens")

    @field_validator("who", "write", "read", mode="before", json_schema_input_type=str | tuple[str, ...])
    @classmethod
    def _one_stands_for_a_list(cls, value: Any) -> Any:
        return (value,) if isinstance(value, str) else value

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
        {},
        description="robot: its peer's name. May write its joint_states and slam_pose and read all its topics",
    )
    nodes: tuple[str, ...] = Field(
        (), description="omnibench nodes elsewhere: may read robots' inputs and write all outputs"
    )
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

    mode: Mode = Field(
        "router", description="router: others connect to it, without zenohd; client: connects to a router"
    )
    listen: tuple[Endpoint, ...] | None = Field(
        None, description=f"default: for a router tcp/127.0.0.1:{PORT} (tls/ with tls), for a peer any port of loopback"
    )
    connect: tuple[Endpoint, ...] = Field((), description=f"default: for a client tcp/127.0.0.1:{PORT} (tls/ with tls)")
    wait: float = Field(0.0, ge=0, le=86400, description="how long to wait for a router that is not running yet, s")
    scouting: bool = Field(False, description="find other sessions by multicast and gossip")
    user: User | None = Field(None, description="our name and password at a router that asks for users")
    users_file: RelativePath | None = Field(None, description="users that may connect to us: lines of user:password")
    tls: Tls | None = None
    access: Access | None = Field(None, description="access rights at this router; default: all may do everything")
    largest_message: int = Field(
        1_000_000, ge=1000, description="bytes; larger messages are dropped before anybody's rights are looked at"
    )
    extra: dict[str, Any] = Field({}, description="settings of Zenoh itself, as transport/link/tx/lease: 3000")

    @field_validator("listen", "connect", mode="before", json_schema_input_type=str | tuple[str, ...])
    @classmethod
    def _one_stands_for_a_list(cls, value: Any) -> Any:
        return (value,) if isinstance(value, str) else value

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
            address = address_of(endpoint)
            if address is None:
                continue
            encrypted = address[0] in _ENCRYPTED
            if encrypted and not self.tls:
                raise ValueError(f"{endpoint}: give tls: {{ca: ..., certificate: ..., key: ...}}")
            if self.tls and not encrypted:
                raise ValueError(f"{endpoint}: is not encrypted although tls is given; write tls/...")
        return self

    @property
    def listening(self) -> tuple[str, ...]:
        """The endpoints on which the session listens, defaults included."""
        if self.listen is not None or self.mode == "client":
            return self.listen or ()
        return (f"{self._protocol}/127.0.0.1:{PORT if self.mode == 'router' else 0}",)

    @property
    def connecting(self) -> tuple[str, ...]:
        """The endpoints to which the session connects, defaults included."""
        if self.connect or self.mode != "client" or self.scouting:
            return self.connect
        return (f"{self._protocol}/127.0.0.1:{PORT}",)

    @property
    def unprotected(self) -> tuple[str, ...]:
        """The endpoints to which anybody on the network may connect without a password or a certificate."""
        if self.users_file or (self.tls and self.tls.mutual):
            return ()
        return tuple(endpoint for endpoint in self.listening if not is_loopback(endpoint))

    @property
    def _protocol(self) -> str:
        return "tls" if self.tls else "tcp"


LOG = logging.getLogger("omnibench.live")
_MOST_BYTES: Final = 1 << 20  # of certificates and keys; chosen
_SOON: Final = timedelta(days=14)  # before a certificate expires, from when on a warning is logged; chosen


def check_files(tls: Tls, *, listening: bool = False) -> None:
    """ConfigError in one line: a file is missing, unreadable or expired, or the key is not the certificate's.

    listening: the certificate must be a server's, or all that connect would refuse us.
    """
    authority = read_certificate(tls.ca)
    if tls.certificate is None or tls.key is None:
        return
    certificate, key = read_certificate(tls.certificate), read_key(tls.key)
    key_bytes, certificate_bytes = (
        public_key.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
        for public_key in (key.public_key(), certificate.public_key())
    )
    if key_bytes != certificate_bytes:
        raise ConfigError(f"tls: {tls.key} is not the key of {tls.certificate}; give the two that belong together")
    if listening and not _may_serve(certificate):
        raise ConfigError(
            f"tls: {tls.certificate} is a client's, and all that connect would refuse us; listen with the router's, "
            "which omnibench keys DIR NAME --router NAME makes"
        )
    # A certificate that the authority did not issue is a warning; chains of several certificates are not checked.
    chains = (x509.load_pem_x509_certificates(_content(path)) for path in (tls.ca, tls.certificate))
    if any(len(chain) > 1 for chain in chains):
        return
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        LOG.warning(
            "tls: %s was not issued by %s; peers that trust only that authority refuse us", tls.certificate, tls.ca
        )


def _may_serve(certificate: x509.Certificate) -> bool:
    """True unless the certificate's extended key usage leaves out that of a server (RFC 5280, section 4.2.1.12)."""
    try:
        usages = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    except (x509.ExtensionNotFound, ValueError):
        return True
    return ExtendedKeyUsageOID.SERVER_AUTH in usages or ExtendedKeyUsageOID.ANY_EXTENDED_KEY_USAGE in usages


def common_name(path: Path) -> str | None:
    """The common name in a certificate, used in access rules, or None. ConfigError as ``read_certificate``."""
    names = read_certificate(path).subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else None


def read_certificate(path: Path) -> x509.Certificate:
    """The first certificate of a PEM file. ConfigError: there is none, or it is not valid now."""
    try:
        certificate = x509.load_pem_x509_certificates(_content(path))[0]
    except ValueError:
        raise ConfigError(f"tls: {path} holds no certificate in PEM; omnibench keys DIR makes some") from None
    now = datetime.now(UTC)
    if now < certificate.not_valid_before_utc:
        raise ConfigError(
            f"tls: {path} is valid from {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC on only, and it is "
            f"{now:%Y-%m-%d %H:%M}; set the clock, or make a new one"
        )
    if now > certificate.not_valid_after_utc:
        raise ConfigError(f"tls: {path} expired on {certificate.not_valid_after_utc:%Y-%m-%d}; make a new one")
    if now > certificate.not_valid_after_utc - _SOON:
        LOG.warning("tls: %s expires on %s", path, f"{certificate.not_valid_after_utc:%Y-%m-%d}")
    return certificate


def read_key(path: Path) -> PrivateKeyTypes:
    """The private key of a PEM file. ConfigError: there is none, or it is encrypted."""
    try:
        return load_pem_private_key(_content(path), password=None)
    except TypeError:
        raise ConfigError(f"tls: {path} is encrypted, and Zenoh cannot ask for its password; decrypt it") from None
    except (ValueError, UnsupportedAlgorithm):
        raise ConfigError(f"tls: {path} holds no private key in PEM; omnibench keys DIR makes some") from None


def _content(path: Path) -> bytes:
    if not path.exists():
        raise ConfigError(f"tls: {path}: no such file; omnibench keys DIR makes certificates and keys")
    try:
        return read_bytes(path, _MOST_BYTES)
    except DataError as error:
        raise ConfigError(f"tls: {error}") from None
