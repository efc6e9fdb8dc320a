"""The certificates in a folder of keys, as far as who connects or listens needs them.

    authority.pem     the certificate of the authority that signs those of all gateways and clients of a fleet
    authority.key     its secret key, mode 0600, on the authority's machine alone
    certificate.pem   one's own certificate
    certificate.key   its secret key, mode 0600, which never leaves the machine

A certificate has a number as its common name, ``cert-0007``, by which gateways know who holds it: their access control
is fixed when they start, for all numbers, so that letting somebody in needs no new start.
"""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass
from datetime import UTC, datetime

from .keys import Folder

NUMBERS = 1000
"""Certificates that an authority can sign: ``cert-0000`` to ``cert-0999``; a number is never given twice."""
AUTHORITY, AUTHORITY_KEY = "authority.pem", "authority.key"
CERTIFICATE, CERTIFICATE_KEY = "certificate.pem", "certificate.key"
MOST_BYTES = 64 << 10


@dataclass(frozen=True, slots=True)
class Certificate:
    """What is told of a certificate.

    Attributes:
        number: its common name; name: of its holder.
        begins, ends: when it holds.
        hosts: for which it may serve, none: it is a client's.
    """

    number: str
    name: str
    begins: datetime
    ends: datetime
    hosts: tuple[str, ...] = ()

    def check(self, what: str, path: str) -> None:
        """Raise OSError unless it holds now."""
        now = datetime.now(UTC)
        if now > self.ends:
            raise OSError(
                errno.EKEYEXPIRED, f"{what}: the certificate {path} has expired on {self.ends:%Y-%m-%d %H:%M} UTC; "
                "have another one signed: sioms cert request"
            )  # fmt: skip
        if now < self.begins:
            raise OSError(
                errno.EKEYREJECTED, f"{what}: the certificate {path} holds from {self.begins:%Y-%m-%d %H:%M} UTC on, "
                f"and the clock of this machine shows {now:%Y-%m-%d %H:%M}; is it right?"
            )  # fmt: skip


def read(path: str) -> bytes:
    """Read a file of certificates; raises OSError, also for one that is too large to be any."""
    with open(path, "rb") as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise OSError(errno.EFBIG, f"read {path}: more than {MOST_BYTES} bytes; that is no certificate")
    return data


def look_at(data: bytes, what: str) -> Certificate:
    """Return what a certificate in PEM tells.

    Raises:
        OSError: EINVAL, it is none of a fleet.
    """
    from cryptography import x509
    from cryptography.x509.oid import NameOID

    try:
        found = x509.load_pem_x509_certificate(data)
        number = str(found.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
        name = str(found.subject.get_attributes_for_oid(NameOID.ORGANIZATIONAL_UNIT_NAME)[0].value)
        try:
            names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
            hosts = (*names.get_values_for_type(x509.DNSName), *map(str, names.get_values_for_type(x509.IPAddress)))
        except x509.ExtensionNotFound:
            hosts = ()
    except (ValueError, IndexError) as error:
        raise OSError(errno.EINVAL, f"{what}: no certificate of a fleet: {error}") from None
    return Certificate(number, name, found.not_valid_before_utc, found.not_valid_after_utc, hosts)


def own(folder: Folder, what: str) -> Certificate:
    """Return one's own certificate, which is there with its key and that of the authority, and holds now.

    Raises:
        OSError: it is not, with a sentence that says what to do.
    """
    for name in (AUTHORITY, CERTIFICATE, CERTIFICATE_KEY):
        if not os.path.exists(folder.file(name)):
            raise OSError(
                errno.EACCES, f"{what}: no {name} in {folder.path}; have a certificate signed: sioms cert request"
            )
    folder.check_secret(CERTIFICATE_KEY)
    path = folder.file(CERTIFICATE)
    found = look_at(read(path), f"read {path}")
    found.check(what, path)
    return found
