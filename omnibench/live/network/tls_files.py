"""Files of certificates and keys, checked before Zenoh gets them: it would only report that it could not connect."""

from __future__ import annotations

import logging
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from omnibench.errors import ConfigError, DataError
from omnibench.files import read_bytes
from omnibench.live.network.session_config import Tls

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
    _check_issuer(certificate, authority, tls)


def _may_serve(certificate: x509.Certificate) -> bool:
    """True unless the certificate's extended key usage leaves out that of a server (RFC 5280, section 4.2.1.12)."""
    try:
        usages = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    except (x509.ExtensionNotFound, ValueError):
        return True
    return ExtendedKeyUsageOID.SERVER_AUTH in usages or ExtendedKeyUsageOID.ANY_EXTENDED_KEY_USAGE in usages


def _check_issuer(certificate: x509.Certificate, authority: x509.Certificate, tls: Tls) -> None:
    """Log a warning if the authority did not issue the certificate; chains of several certificates are not checked."""
    chains = (x509.load_pem_x509_certificates(_content(path)) for path in (tls.ca, tls.certificate) if path is not None)
    if any(len(chain) > 1 for chain in chains):
        return
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        LOG.warning(
            "tls: %s was not issued by %s; peers that trust only that authority refuse us", tls.certificate, tls.ca
        )


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
