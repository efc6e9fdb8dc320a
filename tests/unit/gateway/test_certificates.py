"""An authority, requests and certificates: what is signed for whom, and what is refused."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from sioms.client.certificates import NUMBERS, look_at, own
from sioms.client.keys import Folder
from sioms.gateway import certificates


@pytest.fixture
def authority(tmp_path: Path) -> Folder:
    """One of a fleet."""
    folder = Folder(str(tmp_path / "authority"))
    certificates.new_authority(folder, "fleet", 10)
    return folder


def _certify(authority: Folder, folder: Folder, name: str, hosts: tuple[str, ...] = (), days: int = 5) -> str:
    signed, _ = certificates.sign(authority, certificates.request(folder, name).encode(), hosts, days)
    return certificates.install(folder, signed.encode()).number


def test_numbers_are_given_once_and_the_use_is_that_of_the_hosts(authority: Folder, tmp_path: Path) -> None:
    eva, cell = Folder(str(tmp_path / "eva")), Folder(str(tmp_path / "cell"))
    assert _certify(authority, eva, "eva") == "cert-0000" and _certify(authority, eva, "eva") == "cert-0001"
    assert _certify(authority, cell, "lab2", ("lab2", "192.168.0.7", "::1")) == "cert-0002"
    assert own(eva, "test").name == "eva" and own(cell, "test").hosts == ("lab2", "192.168.0.7", "::1")
    assert [words[:2] for words in certificates.issued(authority)] == [
        ["cert-0000", "eva"], ["cert-0001", "eva"], ["cert-0002", "lab2"],
    ]  # fmt: skip
    for folder, use in ((eva, ExtendedKeyUsageOID.CLIENT_AUTH), (cell, ExtendedKeyUsageOID.SERVER_AUTH)):
        found = x509.load_pem_x509_certificate(Path(folder.file("certificate.pem")).read_bytes())
        assert list(found.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value) == [use]
        assert not found.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        assert stat.S_IMODE(os.stat(folder.file("certificate.key")).st_mode) == 0o600
    assert stat.S_IMODE(os.stat(authority.file("authority.key")).st_mode) == 0o600
    assert not Path(eva.file("authority.key")).exists(), "the authority's key stays where it is"


def test_what_is_no_good_is_refused_with_a_sentence(authority: Folder, tmp_path: Path) -> None:
    eva = Folder(str(tmp_path / "eva"))
    with pytest.raises(OSError, match="sioms cert request"):
        own(eva, "connect")
    with pytest.raises(OSError, match="there is authority"):
        certificates.new_authority(authority, "again", 1)
    with pytest.raises(OSError, match="make an authority"):
        certificates.sign(eva, b"", (), 1)
    asked = certificates.request(eva, "eva").encode()
    for host in ("a b", "", "x/y", "-"):
        with pytest.raises(OSError, match="is no host"):
            certificates.sign(authority, asked, (host,), 1)
    for damaged in (b"", b"nonsense", asked[:-40], asked.replace(b"A", b"B")):
        with pytest.raises(OSError, match="sign a certificate: "):
            certificates.sign(authority, damaged, (), 1)
    signed, _ = certificates.sign(authority, asked, (), 1)
    certificates.request(eva, "eva")
    with pytest.raises(OSError, match="for another key"):
        certificates.install(eva, signed.encode())
    with pytest.raises(OSError, match="want what `sioms cert sign` has written"):
        certificates.install(eva, signed.encode()[: len(signed) // 2])
    assert _certify(authority, eva, "eva", days=0)
    with pytest.raises(OSError, match="has expired on"):
        own(eva, "connect")
    os.chmod(eva.file("certificate.key"), 0o644)
    with pytest.raises(OSError, match="others may use it"):
        own(eva, "connect")


def test_an_authority_has_so_many_numbers(authority: Folder, tmp_path: Path) -> None:
    eva = Folder(str(tmp_path / "eva"))
    authority.write("issued", "".join(f"cert-{i:04d} eva 2030-01-01\n" for i in range(NUMBERS - 1)))
    assert _certify(authority, eva, "eva") == f"cert-{NUMBERS - 1:04d}"
    with pytest.raises(OSError, match="all 1000 numbers"):
        _certify(authority, eva, "eva")
    authority.write("authority.key", "damaged")
    with pytest.raises(OSError, match="is damaged"):
        certificates.sign(authority, b"", (), 1)
    assert look_at(Path(eva.file("certificate.pem")).read_bytes(), "test").number == f"cert-{NUMBERS - 1:04d}"
