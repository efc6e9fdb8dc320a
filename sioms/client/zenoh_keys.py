"""What clients and gateways over Zenoh have in common: key expressions and the settings of a session.

    sioms/up/NUMBER/SESSION       frames of a client whose certificate has that number
    sioms/stop/NUMBER/SESSION     its stops
    sioms/down/NUMBER/SESSION     frames for it
    sioms/alive/NUMBER/SESSION    liveliness of the client
    sioms/gateway                 liveliness of the gateway

The gateway's access control lets a client put to, subscribe to and declare only what has the number of the certificate
that its connection was made with.
"""

from __future__ import annotations

import json
import os
from typing import Any

import zenoh

from sioms.protocol.link import MAX_FROM_GATEWAY

from .certificates import AUTHORITY, CERTIFICATE, CERTIFICATE_KEY
from .keys import Folder

UP, STOP, DOWN, ALIVE, GATEWAY = "sioms/up", "sioms/stop", "sioms/down", "sioms/alive", "sioms/gateway"
LEASE_MS = 3000
"""A connection on which nothing comes for so long has ended; leases of nodes are far shorter, and ours [ms]."""
BLOCKED_US = 5000
"""How long a frame may wait for a connection that takes none before that is closed: others wait meanwhile [us]."""
MOST = MAX_FROM_GATEWAY + 4096
"""Bytes of a message."""
QUEUES = {"control": 4, "real_time": 2, "interactive_high": 16, "interactive_low": 1, "data_high": 1, "data": 1,
          "data_low": 1, "background": 1}  # fmt: skip
"""Frames are sent with priority ``interactive_high``, stops with ``real_time``, which overtakes them."""

_RUNTIME = "ZENOH_RUNTIME"
_ONE_THREAD = "(acc: (handover: app), rx: (handover: app), tx: (handover: app), app: (worker_threads: 1))"
"""A frame changes threads once and not three times."""


def open_session(how: zenoh.Config) -> zenoh.Session:
    """Open a session whose library works in one thread, unless the environment or an earlier session says otherwise.

    Zenoh reads that from the environment when a process opens its first session; what the process starts must not
    inherit it.

    Raises:
        zenoh.ZError: there is no way to the other end.
    """
    if _RUNTIME in os.environ:
        return zenoh.open(how)
    os.environ[_RUNTIME] = _ONE_THREAD
    try:
        return zenoh.open(how)
    finally:
        os.environ.pop(_RUNTIME, None)


def config(folder: Folder, role: str, blocked_us: int = BLOCKED_US, **more: Any) -> zenoh.Config:
    """Return the settings of a session: TLS with certificates of both ends, and nothing by itself.

    Args:
        folder: with the certificate.
        role: ``listen`` or ``connect``.
        blocked_us: how long a frame may wait for a connection that takes none [us].
        more: tables of Zenoh's configuration.
    """
    tls = {
        "root_ca_certificate": folder.file(AUTHORITY),
        f"{role}_certificate": folder.file(CERTIFICATE),
        f"{role}_private_key": folder.file(CERTIFICATE_KEY),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    queue = {"size": QUEUES, "congestion_control": {"block": {"wait_before_close": blocked_us}}}
    table = {
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "adminspace": {"enabled": False},
        "transport": {
            "unicast": {"open_timeout": 2000, "accept_timeout": 2000, "max_sessions": 512, "max_links": 1},
            "shared_memory": {"enabled": False},
            "link": {
                "protocols": ["tls"],
                "tls": tls,
                "tx": {"lease": LEASE_MS, "queue": queue},
                "rx": {"max_message_size": MOST},
            },
        },
        **more,
    }
    return zenoh.Config.from_json5(json.dumps(table))


def endpoint(host: str, port: int) -> str:
    """Return Zenoh's name of a place."""
    return f"tls/[{host}]:{port}" if ":" in host else f"tls/{host}:{port}"
