"""What a config says of Zenoh: where to listen and connect, who we are, and who may do what."""

from __future__ import annotations

import ipaddress
import re
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import AfterValidator, Field, SecretStr, field_validator, model_validator

from omnibench.config import Model, read_model

Mode = Literal["router", "peer", "client"]

PORT: Final = 7447  # Zenoh's own
_PROTOCOLS: Final = ("tcp", "tls", "quic", "udp", "ws")
_ENCRYPTED: Final = ("tls", "quic")
_NETWORK = re.compile(
    rf"(?P<protocol>{'|'.join(_PROTOCOLS)})/(?P<host>\[[0-9A-Fa-f:.%]+\]|[^\s/:\[\]#?]+):(?P<port>\d{{1,5}})([?#]\S*)?"
)
_FILE = re.compile(r"unixsock-stream/[^\s#?]+")


def _checked_endpoint(text: str) -> str:
    found = _NETWORK.fullmatch(text)
    if not _FILE.fullmatch(text) and (found is None or int(found["port"]) > 65535):
        raise ValueError(
            f"{text!r} is no endpoint; write protocol/host:port as tcp/127.0.0.1:{PORT} (protocols: "
            f"{', '.join(_PROTOCOLS)})"
        )
    return text


Endpoint = Annotated[str, AfterValidator(_checked_endpoint)]


def address_of(endpoint: str) -> tuple[str, str, int] | None:
    """Protocol, host and port of an endpoint; None of one that is a file."""
    found = _NETWORK.fullmatch(endpoint)
    return None if found is None else (found["protocol"], found["host"].strip("[]"), int(found["port"]))


def is_loopback(endpoint: str) -> bool:
    """Whether an endpoint can be reached from this machine only."""
    address = address_of(endpoint)
    if address is None or address[1] == "localhost":
        return True
    try:
        return ipaddress.ip_address(address[1]).is_loopback
    except ValueError:
        return False


class User(Model):
    """The user name and password that we show to a router."""

    name: str = Field(min_length=1)
    password: SecretStr | None = Field(None, description="in plain text; better one of the following")
    password_file: Path | None = Field(None, description="its first line; relative to the config file")
    password_env: str | None = Field(None, description="environment variable")

    @model_validator(mode="after")
    def _one_is_given(self) -> Self:
        names = ("password", "password_file", "password_env")
        given = [name for name in names if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"give one of {', '.join(names)} (given: {', '.join(given) or 'none'})")
        return self


class Tls(Model):
    """Certificates, all in PEM; paths are relative to the config file. ``omnibench keys`` makes some."""

    ca: Path = Field(description="certificate of the authority that signed the others'")
    certificate: Path | None = Field(None, description="ours")
    key: Path | None = Field(None, description="the private key of our certificate")
    mutual: bool = Field(True, description="clients must show a certificate, too")
    verify_name: bool = Field(True, description="the router's certificate must name the host that we connect to")

    @model_validator(mode="after")
    def _belong_together(self) -> Self:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("give certificate and key together")
        if self.mutual and self.certificate is None:
            raise ValueError("mutual: give our certificate and key, or mutual: false")
        return self


class AccessRule(Model):
    """What somebody may do. Keys are key expressions; ``**`` does not match ``@ros2_lv``, which must be named."""

    who: tuple[str, ...] = Field(min_length=1, description="common names of certificates, else user names")
    write: tuple[str, ...] = Field((), description="keys to put, delete, be alive on, and answer questions to")
    read: tuple[str, ...] = Field((), description="keys to subscribe to, look for the living on, and ask questions of")

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
    """Who may do what at a router; all else is refused. A name is a certificate's common name or a user's.

    The router itself may do all, and so may whoever shows its own certificate, or is the user it names.
    """

    robots: dict[Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")], str] = Field(
        {}, description="robot: its name. May write its own joint_states and slam_pose, and read what is its own"
    )
    nodes: tuple[str, ...] = Field((), description="omnibench nodes elsewhere: read robots' inputs, write all outputs")
    viewers: tuple[str, ...] = Field((), description="read all topics; ask for info, health and pose")
    operators: tuple[str, ...] = Field((), description="viewers that may set poses, reset and swap calibrations")
    rules: tuple[AccessRule, ...] = Field((), description="more rights")

    @field_validator("robots", mode="before", json_schema_input_type=dict[str, str] | tuple[str, ...])
    @classmethod
    def _named_like_the_robot(cls, value: Any) -> Any:
        if isinstance(value, list | tuple) and all(isinstance(each, str) for each in value):
            return {each: each for each in value}
        return value

    @model_validator(mode="after")
    def _names_somebody(self) -> Self:
        if not any((self.robots, self.nodes, self.viewers, self.operators, self.rules)):
            raise ValueError("nobody is named, so nobody could do anything; name robots, or leave access out")
        return self


class SessionConfig(Model):
    """How a session reaches others. By default: a router on loopback only, without scouting."""

    mode: Mode = Field("router", description="router: serves the others, no zenohd needed; client: of a router")
    listen: tuple[Endpoint, ...] | None = Field(
        None, description=f"default: of a router tcp/127.0.0.1:{PORT} (tls/ with tls), of a peer any port of loopback"
    )
    connect: tuple[Endpoint, ...] = Field((), description=f"default: of a client tcp/127.0.0.1:{PORT} (tls/ with tls)")
    wait: float = Field(0.0, ge=0, le=86400, description="for a router that is not up yet, s")
    scouting: bool = Field(False, description="look for others by multicast, and tell them of others")
    user: User | None = Field(None, description="who we are at a router that asks for users")
    users_file: Path | None = Field(None, description="users that may connect to us: lines of user:password")
    tls: Tls | None = None
    access: Access | None = Field(None, description="who may do what at this router; default: all may do all")
    extra: dict[str, Any] = Field({}, description="Zenoh's own settings: transport/link/tx/lease: 3000")

    @field_validator("listen", "connect", mode="before", json_schema_input_type=str | tuple[str, ...])
    @classmethod
    def _one_stands_for_a_list(cls, value: Any) -> Any:
        return (value,) if isinstance(value, str) else value

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.mode == "client":
            for name in ("listen", "users_file", "access"):
                if getattr(self, name):
                    raise ValueError(f"{name}: nobody connects to a client; that is the router's part")
        if self.mode == "peer" and self.connect and (self.user or self.tls):
            raise ValueError("mode: a peer that is refused tries for ever and says nothing; use client")
        if self.access and not (self.users_file or (self.tls and self.tls.mutual)):
            raise ValueError("access: nobody can be told apart; give users_file, or tls with mutual: true")
        if self.tls and self.listening and self.tls.certificate is None:
            raise ValueError("tls: who listens needs a certificate and its key")
        for endpoint in (*(self.listen or ()), *self.connect):
            self._check_protocol(endpoint)
        return self

    def _check_protocol(self, endpoint: str) -> None:
        address = address_of(endpoint)
        if address is None:
            return
        encrypted = address[0] in _ENCRYPTED
        if encrypted and not self.tls:
            raise ValueError(f"{endpoint}: give tls: {{ca: ..., certificate: ..., key: ...}}")
        if self.tls and not encrypted:
            raise ValueError(f"{endpoint}: is not encrypted, though tls is given; write tls/...")

    @property
    def listening(self) -> tuple[str, ...]:
        """Where the session listens, defaults included."""
        if self.listen is not None or self.mode == "client":
            return self.listen or ()
        return (f"{self._protocol}/127.0.0.1:{PORT if self.mode == 'router' else 0}",)

    @property
    def connecting(self) -> tuple[str, ...]:
        """Where the session connects to, defaults included."""
        if self.connect or self.mode != "client" or self.scouting:
            return self.connect
        return (f"{self._protocol}/127.0.0.1:{PORT}",)

    @property
    def unprotected(self) -> tuple[str, ...]:
        """The endpoints at which anybody on the network may connect, without a password or a certificate."""
        if self.users_file or (self.tls and self.tls.mutual):
            return ()
        return tuple(endpoint for endpoint in self.listening if not is_loopback(endpoint))

    @property
    def _protocol(self) -> str:
        return "tls" if self.tls else "tcp"

    def relative_to(self, folder: Path) -> SessionConfig:
        """The same with its paths, which start from ``folder``, made absolute."""
        changes: dict[str, Any] = {}
        if self.users_file:
            changes["users_file"] = folder / self.users_file
        if self.user and self.user.password_file:
            changes["user"] = self.user.model_copy(update={"password_file": folder / self.user.password_file})
        if self.tls:
            files = {name: getattr(self.tls, name) for name in ("ca", "certificate", "key")}
            changes["tls"] = self.tls.model_copy(
                update={name: folder / file for name, file in files.items() if file is not None}
            )
        return self.model_copy(update=changes)


def read_session_config(path: Path) -> SessionConfig:
    """A session's config from a file of its own; paths in it are relative to it. ConfigError in one line."""
    return read_model(SessionConfig, path).relative_to(path.resolve().parent)
