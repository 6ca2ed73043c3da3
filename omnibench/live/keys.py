"""Making a certificate authority for tests and small fleets, and certificates signed by it.

By cryptography itself: trustme gives its authorities a fixed validity, and certificates purposes and names of its own.
"""

from __future__ import annotations

import ipaddress
import os
import re
import secrets
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final, NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from omnibench.errors import ConfigError
from omnibench.files import read_text, replacing
from omnibench.live.session_config import read_certificate, read_key

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_RESERVED: Final = ("ca", "users")
_ROUTER: Final = "node"  # whose certificate is the router's unless another is named
_HOST = re.compile(r"{0}(\.{0})*".format(r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?"))  # RFC 1123, section 2.1
_LONGEST_HOST: Final = 253  # characters; RFC 1035, section 2.3.4
_LOOPBACK: Final = ("localhost", "127.0.0.1", "::1")
_CLOCK_TOLERANCE: Final = timedelta(hours=1)  # certificates are valid since so long ago, as clocks differ; chosen
_KEY_USAGES: Final = (
    *("digital_signature", "content_commitment", "key_encipherment", "data_encipherment", "key_agreement"),
    *("key_cert_sign", "crl_sign", "encipher_only", "decipher_only"),
)


class _Pair(NamedTuple):
    """A certificate and its private key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def make_keys(
    folder: Path,
    names: Sequence[str],
    *,
    router: str | None = None,
    hosts: Sequence[str] = (),
    days: int = 365,
    users: bool = False,
    overwrite: bool = False,
) -> list[Path]:
    """Write a certificate (``<name>.pem``) and its private key (``<name>.key``, for its owner only) for every name.

    The authority (``ca.pem``, ``ca.key``) is made if it is missing; else it signs the new certificates, which adds
    robots to a fleet. router: whose certificate may serve, the only one that carries host names; by default ``node``,
    if it is among the names. The others' are for clients, so that none of them can pose as the router. hosts: the
    router's host names and addresses besides loopback. days: validity. users: write passwords too
    (``<name>.password``, and ``users.txt`` for the router). overwrite: replace existing files, the authority's too.

    Returns the files written. ConfigError: a name or a host is not valid, hosts are given and no router, or a file
    exists already; DataError: a file cannot be written.
    """
    for name in names:
        if not _NAME.fullmatch(name) or name in _RESERVED:
            raise ConfigError(f"{name!r} cannot name a certificate; use letters, digits, _ . and - as in apr02")
    if len(set(names)) < len(names):
        raise ConfigError(f"a name is given twice: {', '.join(names)}")
    if not 1 <= days <= 36500:
        raise ConfigError(f"{days} days: a certificate is valid for 1 to 36500 days")
    # The router's certificate: the named one, or that of ``node`` if there is one.
    chosen = router or _ROUTER
    if chosen not in names and (router is not None or hosts):
        raise ConfigError(
            f"{chosen!r}, whose certificate would be the router's, is not among {', '.join(names)}; say --router NAME"
        )
    served = [_general_name(host) for host in dict.fromkeys((*_LOOPBACK, *hosts))]
    until = datetime.now(UTC) + timedelta(days=days)
    made: dict[str, _Pair] = {}
    if overwrite or not (folder / "ca.pem").exists():
        extensions = (
            (x509.BasicConstraints(ca=True, path_length=0), True),
            (_key_usage("key_cert_sign", "crl_sign"), True),
        )
        # The number tells two CAs apart.
        made["ca"] = authority = _signed(f"omnibench test CA {secrets.token_hex(4)}", until, extensions)
    else:
        certificate = read_certificate(folder / "ca.pem")
        if not (folder / "ca.key").exists():
            raise ConfigError(f"{folder}/ca.key is missing, without which ca.pem cannot sign; choose another folder")
        key = read_key(folder / "ca.key")
        if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
            raise ConfigError(f"{folder}/ca.key is not the key of ca.pem; choose another folder")
        authority = _Pair(certificate, key)
    made |= {name: _member(name, served if name == chosen else (), until, authority) for name in names}
    contents: dict[Path, bytes] = {}
    for name, (certificate, key) in made.items():
        contents[folder / f"{name}.pem"] = certificate.public_bytes(Encoding.PEM)
        contents[folder / f"{name}.key"] = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    if users:
        contents |= _passwords(folder, names, keep=not overwrite)
    existing = [path for path in contents if path.exists() and path.name != "users.txt"]
    if existing and not overwrite:
        raise ConfigError(f"{existing[0]}: is there already; choose other names, or --force to replace all in {folder}")
    for path, content in contents.items():
        with replacing(path) as partial:
            descriptor = os.open(
                partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644 if path.suffix == ".pem" else 0o600
            )
            with os.fdopen(descriptor, "wb") as file:
                file.write(content)
    return list(contents)


def _passwords(folder: Path, names: Sequence[str], *, keep: bool) -> dict[Path, bytes]:
    """Files with a password for each name, and the router's file with all; ``keep`` the passwords it holds already."""
    path = folder / "users.txt"
    passwords = {name: secrets.token_urlsafe(18) for name in names}
    lines = read_text(path).splitlines() if keep and path.exists() else []
    lines += [f"{name}:{password}" for name, password in passwords.items()]
    files = {folder / f"{name}.password": f"{password}\n".encode() for name, password in passwords.items()}
    return files | {path: "".join(f"{line}\n" for line in lines).encode()}


def _member(name: str, served: Sequence[x509.GeneralName], until: datetime, authority: _Pair) -> _Pair:
    """A client's certificate, and a server's too for the hosts ``served``."""
    server = [ExtendedKeyUsageOID.SERVER_AUTH] if served else []
    extensions: list[tuple[x509.ExtensionType, bool]] = [
        (x509.BasicConstraints(ca=False, path_length=None), True),
        (_key_usage("digital_signature"), True),
        (x509.ExtendedKeyUsage([*server, ExtendedKeyUsageOID.CLIENT_AUTH]), False),
        (x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key()), False),
    ]
    if served:
        extensions.append((x509.SubjectAlternativeName(served), False))
    return _signed(name, min(until, authority.certificate.not_valid_after_utc), extensions, authority)


def _signed(
    name: str, until: datetime, extensions: Sequence[tuple[x509.ExtensionType, bool]], authority: _Pair | None = None
) -> _Pair:
    """A new key and its certificate, signed by the authority or by itself. extensions: with their being critical."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(authority.certificate.subject if authority else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(datetime.now(UTC) - _CLOCK_TOLERANCE)
        .not_valid_after(until)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )
    for extension, critical in extensions:
        builder = builder.add_extension(extension, critical)
    return _Pair(builder.sign(authority.key if authority else key, hashes.SHA256()), key)


def _key_usage(*granted: str) -> x509.KeyUsage:
    return x509.KeyUsage(**{name: name in granted for name in _KEY_USAGES})


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    # A name of digits and points alone is an address that was mistyped.
    if len(host) > _LONGEST_HOST or not _HOST.fullmatch(host) or host.replace(".", "").isdigit():
        raise ConfigError(f"--host: {host!r} is neither a host's name nor an address; write base.local or 192.168.0.2")
    return x509.DNSName(host)
