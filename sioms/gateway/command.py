"""``sioms serve`` and ``sioms key``: the gateway, and who may come in by it."""

from __future__ import annotations

import argparse
import errno
import getpass
import ipaddress
import sys
from dataclasses import asdict
from typing import Any

from sioms.arguments import place
from sioms.client.keys import Folder
from sioms.client.places import place_of
from sioms.documents import json_text
from sioms.protocol.socketpath import socket_path

PLACE, ZENOH_PLACE = "127.0.0.1:5770", "127.0.0.1:5780"


def add_parser(subparsers: Any) -> None:
    """Add ``serve`` and ``key`` to the subcommands of ``sioms``."""
    serve = subparsers.add_parser(
        "serve",
        help="gateway for clients on other machines",
        description="A gateway: an ordinary client of the daemon that passes on what the holders of keys ask for, over "
        "ZeroMQ with CURVE, over Zenoh with certificates, or over both.",
    )
    serve.add_argument(
        "--listen", metavar="HOST:PORT", help=f"ZeroMQ address; stops use the next port; default "
        f"{PLACE} unless --zenoh is given, *:5770 for all"
    )  # fmt: skip
    serve.add_argument(
        "--zenoh", metavar="HOST:PORT", help="Zenoh address, *:5780 for all interfaces; needs `sioms cert`"
    )
    serve.add_argument("--socket", metavar="PATH", default="", help="the daemon's socket")
    key = subparsers.add_parser("key", help="create, allow, list and revoke keys of remote clients")
    verbs = key.add_subparsers(dest="verb", required=True, metavar="VERB")
    new = verbs.add_parser("new", help="create your own key")
    new.add_argument("name", nargs="?", default="", help="default: the user's name")
    allow = verbs.add_parser("allow", help="admit the holder of a key at this user's gateway")
    allow.add_argument("name", help="what messages and grants call it")
    allow.add_argument(
        "public",
        metavar="KEY",
        help="the public key, of `sioms key list` on the other machine, or a certificate: cert-NNNN",
    )
    allow.add_argument("--group", action="append", default=[], metavar="NAME", help="a group of grants; again for more")
    trust = verbs.add_parser("trust", help="record the public key of a gateway as trusted")
    trust.add_argument("address", help="zmq://HOST:PORT")
    trust.add_argument("public", metavar="KEY", help="the public key, of `sioms key list` on that machine")
    listing = verbs.add_parser("list", help="list your own public key, the keys admitted, and the gateways trusted")
    listing.add_argument("--json", action="store_true", help="print JSON")
    revoke = verbs.add_parser("revoke", help="stop admitting a key, or trusting a gateway; what it held halts")
    revoke.add_argument("name", help="of a key, or HOST:PORT of a gateway")
    for each in (serve, *verbs.choices.values()):
        each.add_argument(
            "--keys", metavar="FOLDER", default="", help="folder of keys; default $SIOMS_KEYS or the user's own"
        )


def run(args: argparse.Namespace) -> int:
    """Carry out ``serve`` or ``key``."""
    folder = Folder(args.keys)
    if args.command == "serve":
        _serve(args, folder)
        return 0
    match args.verb:
        case "new":
            pair = folder.new(args.name or getpass.getuser())
            print(f"key of {pair.name}: {pair.public}")
            print(f"at the gateway: sioms key allow {pair.name} '{pair.public}'", file=sys.stderr)
        case "allow":
            folder.allow(args.name, args.public, tuple(args.group))
        case "trust":
            scheme, host, port = place_of(args.address)
            if scheme != "zmq":
                raise OSError(
                    errno.EINVAL, f"trust {args.address}: over Zenoh the authority of `sioms cert` is trusted"
                )
            folder.trust(f"{host}:{port}", args.public)
        case "revoke":
            if not folder.distrust(args.name.removeprefix("zmq://")):
                folder.revoke(args.name)
        case "list":
            _list(folder, as_json=args.json)
    return 0


def _list(folder: Folder, *, as_json: bool) -> None:
    own = folder.own()
    if as_json:
        print(
            json_text(
                {
                    "own": {"name": own.name, "public": own.public} if own else None,
                    "allowed": [asdict(one) for one in folder.allowed()],
                    "trusted": [{"gateway": at, "public": key} for at, key in folder.trusted().items()],
                }
            )
        )
        return
    print(f"own      {own.name} {own.public}" if own else "own      none; make one with: sioms key new")
    for one in folder.allowed():
        print(f"allowed  {one.name} {one.public} {','.join(one.groups)}".rstrip())
    for gateway, public in folder.trusted().items():
        print(f"trusted  {gateway} {public}")


def _serve(args: argparse.Namespace, folder: Folder) -> None:
    zenoh = place(args.zenoh, ZENOH_PLACE) if args.zenoh else None
    listen = args.listen or (None if zenoh else PLACE)
    zmq = place(listen, PLACE) if listen else None
    if not folder.allowed():
        hint = f"nobody may come in by the keys in {folder.path}; run: sioms key allow NAME KEY"
        for host, port in filter(None, (zmq, zenoh)):
            if not _is_loopback(host):
                raise OSError(errno.EACCES, f"listen on {host}:{port}: {hint}")
        print(f"sioms serve: {hint}", file=sys.stderr)
    from .serve import serve

    serve(args.socket or socket_path(), folder, zmq=zmq, zenoh=zenoh)


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
