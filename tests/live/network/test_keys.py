from __future__ import annotations

import ipaddress
import stat
import subprocess
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
from cryptography.hazmat.primitives.serialization import Encoding

from omnibench.errors import ConfigError
from omnibench.live.network.keys import make_keys
from omnibench.live.network.session_config import Tls, check_files, read_certificate, read_key


def tls(folder: Path, name: str, key: str | None = None) -> Tls:
    return Tls(ca=folder / "ca.pem", certificate=folder / f"{name}.pem", key=folder / (key or f"{name}.key"))


def test_it_writes_an_authority_and_a_certificate_and_key_for_every_name(tmp_path: Path) -> None:
    written = make_keys(tmp_path / "keys", ["node", "apr02"])
    names = ["ca.pem", "ca.key", "node.pem", "node.key", "apr02.pem", "apr02.key"]
    assert written == [tmp_path / "keys" / name for name in names]
    assert sorted(path.name for path in (tmp_path / "keys").iterdir()) == sorted(names)
    for name in ("node", "apr02"):
        check_files(tls(tmp_path / "keys", name))


def test_the_certificates_verify_by_openssl(tmp_path: Path) -> None:
    make_keys(tmp_path, ["node"])
    for purpose in ("sslserver", "sslclient"):
        command = ["openssl", "verify", "-x509_strict", "-purpose", purpose, "-CAfile", "ca.pem", "node.pem"]
        assert subprocess.run(command, cwd=tmp_path, capture_output=True, check=True).stdout == b"node.pem: OK\n"


def test_a_certificate_carries_its_name_and_its_hosts(tmp_path: Path) -> None:
    make_keys(tmp_path, ["node"], hosts=["base.local", "192.168.0.2"])
    certificate = read_certificate(tmp_path / "node.pem")
    assert certificate.subject.rfc4514_string() == "CN=node"
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["localhost", "base.local"]
    addresses = [ipaddress.ip_address(text) for text in ("127.0.0.1", "::1", "192.168.0.2")]
    assert names.get_values_for_type(x509.IPAddress) == addresses


def purposes(folder: Path, name: str) -> list[str]:
    """What OpenSSL lets a certificate be used for."""
    command = ["openssl", "verify", "-x509_strict", "-CAfile", "ca.pem", "-purpose"]
    return [
        purpose
        for purpose in ("sslserver", "sslclient")
        if subprocess.run([*command, purpose, f"{name}.pem"], cwd=folder, capture_output=True, check=False).returncode
        == 0
    ]


@pytest.mark.parametrize(
    ("names", "router", "server"),
    [(["node", "apr02"], None, "node"), (["base", "node"], "base", "base"), (["apr02", "screen"], None, None)],
)
def test_only_the_routers_certificate_may_serve_and_carries_hosts(
    tmp_path: Path, names: list[str], router: str | None, server: str | None
) -> None:
    make_keys(tmp_path, names, router=router)
    for name in names:
        assert purposes(tmp_path, name) == (["sslserver", "sslclient"] if name == server else ["sslclient"])
        extensions = read_certificate(tmp_path / f"{name}.pem").extensions
        hosts = [each for each in extensions if isinstance(each.value, x509.SubjectAlternativeName)]
        assert bool(hosts) == (name == server)


@pytest.mark.parametrize("hosts", [["base.local"], []])
def test_a_router_that_is_not_named_is_refused(tmp_path: Path, hosts: list[str]) -> None:
    with pytest.raises(ConfigError, match="is not among apr02, apr03; say --router NAME"):
        make_keys(tmp_path, ["apr02", "apr03"], hosts=hosts, router=None if hosts else "node")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "host",
    ["", "a b", "tls/base.local:7447", "base.local:7447", "-base", "192.168.0.256", "1.2.3", "ä.local", "x" * 64],
)
def test_what_is_no_host_is_refused(tmp_path: Path, host: str) -> None:
    with pytest.raises(ConfigError, match="is neither a host's name nor an address"):
        make_keys(tmp_path, ["node"], hosts=[host])
    assert not list(tmp_path.iterdir())


def test_what_is_secret_is_for_its_owner_only(tmp_path: Path) -> None:
    for path in make_keys(tmp_path, ["apr02"], users=True):
        mode = stat.S_IMODE(path.stat().st_mode)
        assert mode & 0o077 == (0o044 if path.suffix == ".pem" else 0), path
        assert mode & 0o600 == 0o600


def test_names_are_added_under_the_authority_that_is_there(tmp_path: Path) -> None:
    make_keys(tmp_path, ["node"], users=True)
    before = (tmp_path / "ca.pem").read_bytes()
    written = make_keys(tmp_path, ["apr03"], users=True)
    assert (tmp_path / "ca.pem").read_bytes() == before
    assert sorted(path.name for path in written) == ["apr03.key", "apr03.password", "apr03.pem", "users.txt"]
    read_certificate(tmp_path / "apr03.pem").verify_directly_issued_by(read_certificate(tmp_path / "ca.pem"))
    users = dict(line.split(":") for line in (tmp_path / "users.txt").read_text().splitlines())
    assert users == {name: (tmp_path / f"{name}.password").read_text().strip() for name in ("node", "apr03")}


def test_nothing_is_replaced_unless_asked(tmp_path: Path) -> None:
    make_keys(tmp_path, ["node", "apr02"])
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ConfigError, match=r"apr02\.pem: is there already"):
        make_keys(tmp_path, ["apr03", "apr02"])
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    make_keys(tmp_path, ["node", "apr02"], overwrite=True)
    assert all(path.read_bytes() != content for path, content in before.items())


def test_a_certificate_does_not_outlive_its_authority(tmp_path: Path) -> None:
    make_keys(tmp_path, ["node"], days=30)
    make_keys(tmp_path, ["apr02"], days=300)
    ends = [read_certificate(tmp_path / f"{name}.pem").not_valid_after_utc for name in ("ca", "node", "apr02")]
    assert ends[0] == ends[1] == ends[2]
    assert abs(ends[0] - datetime.now(UTC) - timedelta(days=30)) < timedelta(minutes=5)


@pytest.mark.parametrize("names", [["../up"], [""], ["ca"], ["users"], ["a b"], ["x" * 65], ["a", "a"]])
def test_names_that_cannot_be_are_refused(tmp_path: Path, names: list[str]) -> None:
    with pytest.raises(ConfigError):
        make_keys(tmp_path, names)
    assert not list(tmp_path.iterdir())


def test_an_authority_without_its_key_can_sign_nobody(tmp_path: Path) -> None:
    make_keys(tmp_path, ["node"])
    (tmp_path / "ca.key").unlink()
    with pytest.raises(ConfigError, match=r"ca\.key is missing"):
        make_keys(tmp_path, ["apr02"])


class TestCheckedFiles:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        make_keys(tmp_path, ["node", "apr02"])
        return tmp_path

    def refusal(self, files: Tls) -> str:
        with pytest.raises(ConfigError) as caught:
            check_files(files)
        return str(caught.value)

    def test_a_clients_certificate_cannot_listen(self, folder: Path) -> None:
        with pytest.raises(ConfigError, match=r"apr02\.pem is a client's, .* listen with the router's"):
            check_files(tls(folder, "apr02"), listening=True)
        check_files(tls(folder, "node"), listening=True)

    def test_missing_file(self, folder: Path) -> None:
        (folder / "node.pem").unlink()
        assert f"{folder}/node.pem: no such file; omnibench keys" in self.refusal(tls(folder, "node"))

    def test_folder_in_place_of_a_file(self, folder: Path) -> None:
        files = Tls(ca=folder, certificate=folder / "node.pem", key=folder / "node.key")
        assert f"{folder}: is a folder" in self.refusal(files)

    def test_no_certificate_in_the_file(self, folder: Path) -> None:
        (folder / "node.pem").write_text("garbage")
        assert "node.pem holds no certificate in PEM" in self.refusal(tls(folder, "node"))

    def test_no_key_in_the_file(self, folder: Path) -> None:
        assert "node.pem holds no private key in PEM" in self.refusal(tls(folder, "node", "node.pem"))

    def test_key_of_another_certificate(self, folder: Path) -> None:
        assert f"{folder}/apr02.key is not the key of" in self.refusal(tls(folder, "node", "apr02.key"))

    def test_encrypted_key(self, folder: Path) -> None:
        command = ["openssl", "pkey", "-in", "node.key", "-aes256", "-passout", "pass:secret", "-out", "locked.key"]
        subprocess.run(command, cwd=folder, check=True)
        assert "locked.key is encrypted" in self.refusal(tls(folder, "node", "locked.key"))

    def test_expired_certificate(self, folder: Path) -> None:
        expire(folder, "node", datetime(2020, 1, 1, tzinfo=UTC))
        assert "node.pem expired on 2020-01-02" in self.refusal(tls(folder, "node"))

    def test_certificate_of_the_future(self, folder: Path) -> None:
        expire(folder, "node", datetime.now(UTC) + timedelta(days=2))
        assert "set the clock" in self.refusal(tls(folder, "node"))

    def test_one_that_expires_soon_is_logged(self, folder: Path, caplog: pytest.LogCaptureFixture) -> None:
        expire(folder, "node", datetime.now(UTC) - timedelta(hours=12))
        check_files(tls(folder, "node"))
        assert "node.pem expires on" in caplog.text


def expire(folder: Path, name: str, start: datetime) -> None:
    """Make a name's certificate anew, valid for the day from ``start``."""

    old, authority = read_certificate(folder / f"{name}.pem"), read_certificate(folder / "ca.pem")
    builder = (
        x509.CertificateBuilder(extensions=list(old.extensions))
        .subject_name(old.subject)
        .issuer_name(authority.subject)
        .public_key(old.public_key())
        .serial_number(old.serial_number)
        .not_valid_before(start)
        .not_valid_after(start + timedelta(days=1))
    )
    key = read_key(folder / "ca.key")
    assert isinstance(key, EllipticCurvePrivateKey)
    signed = builder.sign(key, hashes.SHA256())
    (folder / f"{name}.pem").write_bytes(signed.public_bytes(Encoding.PEM))
