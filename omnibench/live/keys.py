"""Certificates: made for tests and small fleets with an authority of their own, and checked before they are used.

By cryptography itself: trustme gives its authorities a fixed validity, and certificates purposes and names of its own.
"""

from __future__ import annotations

import ipaddress
import logging
import re
import secrets
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final, NamedTuple

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from omnibench.errors import ConfigError, DataError
from omnibench.files import read_bytes, read_text, replacing

LOG = logging.getLogger("omnibench.live")

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
_MOST_BYTES: Final = 1 << 20  # of certificates and keys; chosen
_SOON: Final = timedelta(days=14)  # before a certificate expires, from when on a warning is logged; chosen


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
        raise ConfigError(f"the router's name, {chosen!r}, is not among {', '.join(names)}; say --router NAME")
    served = [_general_name(host) for host in dict.fromkeys((*_LOOPBACK, *hosts))]
    until = datetime.now(UTC) + timedelta(days=days)
    made: dict[str, _Pair] = {}
    if overwrite or not (folder / "ca.pem").exists():
        # The number tells two CAs apart.
        made["ca"] = authority = _signed(f"omnibench test CA {secrets.token_hex(4)}", until)
    else:
        certificate = read_certificate(folder / "ca.pem")
        if not (folder / "ca.key").exists():
            raise ConfigError(f"{folder}/ca.key is missing, without which ca.pem cannot sign; choose another folder")
        key = read_key(folder / "ca.key")
        if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
            raise ConfigError(f"{folder}/ca.key is not the key of ca.pem; choose another folder")
        authority = _Pair(certificate, key)
    made |= {name: _signed(name, until, authority, served if name == chosen else ()) for name in names}
    contents: dict[Path, bytes] = {}
    for name, (certificate, key) in made.items():
        contents[folder / f"{name}.pem"] = certificate.public_bytes(Encoding.PEM)
        contents[folder / f"{name}.key"] = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    if users:
        # A password for each name, and the router's file with all; it keeps those that it holds already.
        listed, path = [], folder / "users.txt"
        if path.exists() and not overwrite:
            listed = read_text(path).splitlines()
        for name in names:
            password = secrets.token_urlsafe(18)
            contents[folder / f"{name}.password"] = f"{password}\n".encode()
            listed.append(f"{name}:{password}")
        contents[path] = "".join(f"{line}\n" for line in listed).encode()
    existing = [path for path in contents if path.exists() and path.name != "users.txt"]
    if existing and not overwrite:
        raise ConfigError(f"{existing[0]}: is there already; choose other names, or --force to replace all in {folder}")
    for path, content in contents.items():
        with replacing(path) as partial:
            partial.touch(0o644 if path.suffix == ".pem" else 0o600)
            partial.write_bytes(content)
    return list(contents)


def _signed(
    name: str, until: datetime, authority: _Pair | None = None, served: Sequence[x509.GeneralName] = ()
) -> _Pair:
    """A new key and its certificate: of a client, and a server too for the hosts ``served``, or of an authority."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    usages = ("digital_signature",) if authority else ("key_cert_sign", "crl_sign")
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(authority.certificate.subject if authority else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(datetime.now(UTC) - _CLOCK_TOLERANCE)
        .not_valid_after(min(until, authority.certificate.not_valid_after_utc) if authority else until)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(x509.BasicConstraints(ca=not authority, path_length=None if authority else 0), critical=True)
        .add_extension(x509.KeyUsage(**{usage: usage in usages for usage in _KEY_USAGES}), critical=True)
    )
    if authority:
        purposes = [*([ExtendedKeyUsageOID.SERVER_AUTH] if served else []), ExtendedKeyUsageOID.CLIENT_AUTH]
        builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key())
        builder = builder.add_extension(issuer, critical=False)
    if served:
        builder = builder.add_extension(x509.SubjectAlternativeName(served), critical=False)
    return _Pair(builder.sign(authority.key if authority else key, hashes.SHA256()), key)


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    # A name of digits and points alone is an address that was mistyped.
    if len(host) > _LONGEST_HOST or not _HOST.fullmatch(host) or host.replace(".", "").isdigit():
        raise ConfigError(f"--host: {host!r} is neither a host's name nor an address; write base.local or 192.168.0.2")
    return x509.DNSName(host)


def check_files(ca: Path, certificate_file: Path, key_file: Path, *, listening: bool = False) -> str | None:
    """Check a certificate, and return the common name in it, which access rules use.

    listening: the certificate must be a server's, or all that connect would refuse us. ConfigError in one line: a file
    is missing, unreadable or expired, or the key is not the certificate's.
    """
    authorities, certificates = _certificates(ca), _certificates(certificate_file)
    certificate = certificates[0]
    if read_key(key_file).public_key() != certificate.public_key():
        raise ConfigError(f"tls: {key_file} is not the key of {certificate_file}; give the two that belong together")
    try:
        purposes = list(certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)
    except (x509.ExtensionNotFound, ValueError):  # RFC 5280, section 4.2.1.12: it is for any purpose
        purposes = [ExtendedKeyUsageOID.ANY_EXTENDED_KEY_USAGE]
    if listening and not {ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.ANY_EXTENDED_KEY_USAGE} & set(purposes):
        way = "listen with the router's, which omnibench keys DIR NAME --router NAME makes"
        raise ConfigError(f"tls: {certificate_file} is a client's, and all that connect would refuse us; {way}")
    # A certificate that the authority did not issue is a warning; chains of several certificates are not checked.
    if len(authorities) == len(certificates) == 1:
        try:
            certificate.verify_directly_issued_by(authorities[0])
        except (ValueError, TypeError, InvalidSignature):
            said = "tls: %s was not issued by %s; peers that trust only that authority refuse us"
            LOG.warning(said, certificate_file, ca)
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else None


def read_certificate(path: Path) -> x509.Certificate:
    """The first certificate of a PEM file. ConfigError: there is none, or it is not valid now."""
    return _certificates(path)[0]


def _certificates(path: Path) -> list[x509.Certificate]:
    """The certificates of a PEM file, of which the first is valid now. ConfigError: there is none, or it is not."""
    try:
        certificates = x509.load_pem_x509_certificates(_content(path))
    except ValueError:
        raise ConfigError(f"tls: {path} holds no certificate in PEM; omnibench keys DIR makes some") from None
    now, begin, end = datetime.now(UTC), certificates[0].not_valid_before_utc, certificates[0].not_valid_after_utc
    if now < begin:
        validity = f"{path} is valid from {begin:%Y-%m-%d %H:%M} UTC on only, and it is {now:%Y-%m-%d %H:%M}"
        raise ConfigError(f"tls: {validity}; set the clock, or make a new one")
    if now > end:
        raise ConfigError(f"tls: {path} expired on {end:%Y-%m-%d}; make a new one")
    if now > end - _SOON:
        LOG.warning("tls: %s expires on %s", path, f"{end:%Y-%m-%d}")
    return certificates


def read_key(path: Path) -> PrivateKeyTypes:
    """The private key of a PEM file. ConfigError: there is none, or it is encrypted."""
    try:
        return load_pem_private_key(_content(path), password=None)
    except TypeError:
        raise ConfigError(f"tls: {path} is encrypted, and Zenoh cannot ask for its password; decrypt it") from None
    except (ValueError, UnsupportedAlgorithm):
        raise ConfigError(f"tls: {path} holds no private key in PEM; omnibench keys DIR makes some") from None


def _content(path: Path) -> bytes:
    try:
        return read_bytes(path, _MOST_BYTES)
    except DataError as error:
        raise ConfigError(f"tls: {error}; omnibench keys DIR makes certificates and keys") from None
