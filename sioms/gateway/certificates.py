"""An authority of one's own: it signs the certificates of the gateways and the clients of a fleet.

A certificate of a client lets nobody in by itself: each gateway lists those that may come in (``sioms key allow``), as
it does with keys. One that has hosts may serve, any other may only connect, so that a client cannot pass for a gateway.
"""

from __future__ import annotations

import errno
import ipaddress
import os
import re
from datetime import UTC, datetime, timedelta

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from sioms.client.certificates import (
    AUTHORITY,
    AUTHORITY_KEY,
    CERTIFICATE,
    CERTIFICATE_KEY,
    NUMBERS,
    Certificate,
    look_at,
    read,
)
from sioms.client.keys import Folder, checked_name

ISSUED = "issued"
"""File of the authority: number, name and end of each certificate that it has signed."""
EARLIER = timedelta(minutes=5)
"""How much earlier a certificate begins to hold than it was signed: clocks differ a little."""
_HOST = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,252}[A-Za-z0-9])?")


def _subject(number: str, name: str) -> x509.Name:
    words = [(NameOID.COMMON_NAME, number), (NameOID.ORGANIZATIONAL_UNIT_NAME, name)]
    return x509.Name([x509.NameAttribute(oid, word) for oid, word in words])


def _new_key(folder: Folder, name: str) -> ec.EllipticCurvePrivateKey:
    key = ec.generate_private_key(ec.SECP256R1())
    folder.write(name, key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()).decode())
    return key


def _key(folder: Folder, name: str, what: str, hint: str) -> ec.EllipticCurvePrivateKey:
    try:
        folder.check_secret(name)
        key = load_pem_private_key(read(folder.file(name)), None)
    except FileNotFoundError:
        raise OSError(errno.ENOENT, f"{what}: no {name} in {folder.path}; {hint}") from None
    except (ValueError, TypeError) as error:
        raise OSError(errno.EINVAL, f"{what}: {folder.file(name)} is damaged: {error}") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise OSError(errno.EINVAL, f"{what}: {folder.file(name)} is not an elliptic-curve key")
    return key


def _builder(
    subject: x509.Name, issuer: x509.Name, public: ec.EllipticCurvePublicKey, days: int
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - EARLIER)
        .not_valid_after(now + timedelta(days=days))
    )


def new_authority(folder: Folder, name: str, days: int) -> None:
    """Make an authority.

    Raises:
        OSError: EEXIST, the folder has one.
    """
    if os.path.exists(folder.file(AUTHORITY)):
        raise OSError(
            errno.EEXIST, f"make an authority in {folder.path}: there is {AUTHORITY} already; a fleet has one authority"
        )
    subject = _subject("authority", checked_name("make an authority", name))
    key = _new_key(folder, AUTHORITY_KEY)
    use = x509.KeyUsage(False, False, False, False, False, True, True, False, False)
    found = (
        _builder(subject, subject, key.public_key(), days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(use, critical=True)
        .sign(key, hashes.SHA256())
    )
    folder.write(AUTHORITY, found.public_bytes(Encoding.PEM).decode(), 0o644)


def request(folder: Folder, name: str) -> str:
    """Make a new key of one's own; return the request to the authority to sign its certificate, PEM.

    The key takes the place of the one before, whose certificate is of no use any more.
    """
    checked_name("request a certificate", name)
    key = _new_key(folder, CERTIFICATE_KEY)
    asked = x509.CertificateSigningRequestBuilder().subject_name(_subject("request", name)).sign(key, hashes.SHA256())
    return asked.public_bytes(Encoding.PEM).decode()


def _named(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        if not _HOST.fullmatch(host):
            raise OSError(errno.EINVAL, f"sign a certificate: {host!r} is no host; want a name or an address") from None
        return x509.DNSName(host)


def sign(folder: Folder, asked: bytes, hosts: tuple[str, ...], days: int) -> tuple[str, Certificate]:
    """Sign a certificate.

    Args:
        folder: of the authority.
        asked: the request, PEM.
        hosts: for which it may serve; none: a client's.
        days: how long it holds.

    Returns:
        The certificate and that of the authority, PEM, and what it tells.

    Raises:
        OSError: no authority, no request, no number left.
    """
    what = "sign a certificate"
    signer = _key(folder, AUTHORITY_KEY, what, "make an authority: sioms cert authority")
    authority = x509.load_pem_x509_certificate(read(folder.file(AUTHORITY)))
    try:
        wish = x509.load_pem_x509_csr(asked)
        name = str(wish.subject.get_attributes_for_oid(NameOID.ORGANIZATIONAL_UNIT_NAME)[0].value)
        public = wish.public_key()
        good = wish.is_signature_valid and isinstance(public, ec.EllipticCurvePublicKey)
    except (ValueError, IndexError) as error:
        raise OSError(errno.EINVAL, f"{what}: no request of `sioms cert request`: {error}") from None
    if not good or not isinstance(public, ec.EllipticCurvePublicKey):
        raise OSError(errno.EINVAL, f"{what}: the request is not signed by the key that it is for")
    names = [_named(host) for host in hosts]
    number = _next(folder, checked_name(what, name), days)
    use = ExtendedKeyUsageOID.SERVER_AUTH if hosts else ExtendedKeyUsageOID.CLIENT_AUTH
    builder = (
        _builder(_subject(number, name), authority.subject, public, days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([use]), critical=True)
    )
    if names:
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    made = builder.sign(signer, hashes.SHA256()).public_bytes(Encoding.PEM)
    return (made + authority.public_bytes(Encoding.PEM)).decode(), look_at(made, what)


def issued(folder: Folder) -> list[list[str]]:
    """Return number, name and end of the certificates that this authority has signed."""
    try:
        return [line.split() for line in read(folder.file(ISSUED)).decode("utf-8", "replace").splitlines()]
    except FileNotFoundError:
        return []


def _next(folder: Folder, name: str, days: int) -> str:
    before = issued(folder)
    if len(before) >= NUMBERS:
        raise OSError(
            errno.ENOSPC, f"sign a certificate: all {NUMBERS} numbers of this authority are given; make another one"
        )
    number = f"cert-{len(before):04d}"
    end = datetime.now(UTC) + timedelta(days=days)
    lines = [*before, [number, name, f"{end:%Y-%m-%d}"]]
    folder.write(ISSUED, "".join(f"{' '.join(line)}\n" for line in lines))
    return number


def install(folder: Folder, signed: bytes) -> Certificate:
    """Take a certificate for one's own, and that of its authority.

    Raises:
        OSError: EINVAL, it is of another key, or of another authority than the one that is trusted here.
    """
    what = "install a certificate"
    try:
        mine, authority = x509.load_pem_x509_certificates(signed)
        mine.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise OSError(errno.EINVAL, f"{what}: want what `sioms cert sign` has written: {error}") from None
    key = _key(folder, CERTIFICATE_KEY, what, "request it from this machine: sioms cert request")
    if mine.public_key() != key.public_key():
        raise OSError(
            errno.EINVAL, f"{what}: it is for another key than {folder.file(CERTIFICATE_KEY)}; request it anew"
        )
    pem = authority.public_bytes(Encoding.PEM).decode()
    path = folder.file(AUTHORITY)
    if os.path.exists(path) and read(path).decode() != pem:
        raise OSError(
            errno.EINVAL, f"{what}: another authority has signed it than the one in {path}; remove that file if the "
            "new one is to be trusted"
        )  # fmt: skip
    own = mine.public_bytes(Encoding.PEM)
    found = look_at(own, what)
    folder.write(AUTHORITY, pem, 0o644)
    folder.write(CERTIFICATE, own.decode(), 0o644)
    return found
