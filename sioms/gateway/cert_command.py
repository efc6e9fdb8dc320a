"""``sioms cert``: an authority of one's own, and certificates of gateways and clients over Zenoh."""

from __future__ import annotations

import argparse
import errno
import getpass
import os
import sys
from typing import Any

from sioms.arguments import whole
from sioms.client.keys import Folder
from sioms.documents import json_text

LONGEST_DAYS = 36_500
"""Of a certificate: a hundred years."""


def add_parser(subparsers: Any) -> None:
    """Add ``cert`` to the subcommands of ``sioms``."""
    cert = subparsers.add_parser(
        "cert",
        help="create an authority, and certificates for gateways and clients over Zenoh",
        description="One machine has the authority. Every gateway and every client requests a certificate from it; "
        "secret keys never leave their machines. Each gateway lists the certificates it admits, by `sioms key allow`.",
    )
    verbs = cert.add_subparsers(dest="verb", required=True, metavar="VERB")
    authority = verbs.add_parser("authority", help="create the authority of a fleet on this machine")
    authority.add_argument("name", nargs="?", default="fleet", help="default: fleet")
    authority.add_argument("--days", type=whole(1, LONGEST_DAYS), default=3650, help="how long it holds; default 3650")
    request = verbs.add_parser("request", help="create your own key, and print a certificate request")
    request.add_argument("name", nargs="?", default="", help="default: the user's name; of a gateway that of the cell")
    sign = verbs.add_parser("sign", help="sign a request, and print the certificate")
    sign.add_argument("file", help="what `sioms cert request` has printed; - for standard input")
    sign.add_argument(
        "--host", action="append", default=[], help="a gateway's: name or address it is reached by; again for more"
    )
    sign.add_argument("--days", type=whole(1, LONGEST_DAYS), default=365, help="how long it holds; default 365")
    install = verbs.add_parser("install", help="install your own signed certificate")
    install.add_argument("file", help="what `sioms cert sign` has printed; - for standard input")
    listing = verbs.add_parser("list", help="list your own certificate, and those signed by this machine's authority")
    listing.add_argument("--json", action="store_true", help="print JSON")
    for each in verbs.choices.values():
        each.add_argument(
            "--keys", metavar="FOLDER", default="", help="folder of keys; default $SIOMS_KEYS or the user's own"
        )


def _read(path: str) -> bytes:
    from sioms.client.certificates import MOST_BYTES, read

    if path != "-":
        return read(path)
    data = sys.stdin.buffer.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise OSError(errno.EFBIG, f"read standard input: more than {MOST_BYTES} bytes; that is no certificate")
    return data


def run(args: argparse.Namespace) -> int:
    """Carry out ``cert``."""
    from . import certificates

    folder = Folder(args.keys)
    match args.verb:
        case "authority":
            certificates.new_authority(folder, args.name, args.days)
            print(f"authority {args.name} in {folder.path}", file=sys.stderr)
        case "request":
            print(certificates.request(folder, args.name or getpass.getuser()), end="")
        case "sign":
            text, made = certificates.sign(folder, _read(args.file), tuple(args.host), args.days)
            print(text, end="")
            if not made.hosts:
                print(f"at the gateways: sioms key allow {made.name} {made.number}", file=sys.stderr)
        case "install":
            made = certificates.install(folder, _read(args.file))
            print(f"certificate {made.number} of {made.name}, until {made.ends:%Y-%m-%d}", file=sys.stderr)
        case "list":
            _list(folder, as_json=args.json)
    return 0


def _list(folder: Folder, *, as_json: bool) -> None:
    from sioms.client.certificates import CERTIFICATE, look_at, read

    from .certificates import issued

    path = folder.file(CERTIFICATE)
    own = look_at(read(path), f"read {path}") if os.path.exists(path) else None
    if as_json:
        mine = own and {"number": own.number, "name": own.name, "ends": f"{own.ends:%Y-%m-%d}", "hosts": own.hosts}
        signed = [dict(zip(("number", "name", "ends"), words, strict=False)) for words in issued(folder)]
        print(json_text({"own": mine, "signed": signed}))
        return
    if own:
        print(f"own     {own.number} {own.name} {own.ends:%Y-%m-%d} {','.join(own.hosts)}".rstrip())
    else:
        print("own     none; request one with: sioms cert request")
    for words in issued(folder):
        print(f"signed  {' '.join(words)}")
