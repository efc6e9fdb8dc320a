"""The gateway over Zenoh: TLS with certificates of both ends, and an access control that binds each key expression to
the certificate of the connection by which it comes.

Nothing is found by itself: no multicast, no gossip, no routers in between, whose certificates would stand for those of
clients. What a peer without a certificate of the authority sends ends in the handshake of TLS.

Concurrency: frames come on threads of Zenoh and are queued; the loop takes them. Stops have a thread of their own.
"""

from __future__ import annotations

import errno
import os
import re
import socket
import threading
import time
import traceback
from collections import Counter, deque
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import zenoh
from zenoh.handlers import Callback

from sioms.client.certificates import NUMBERS, own
from sioms.client.keys import Folder
from sioms.client.zenoh_keys import ALIVE, DOWN, GATEWAY, STOP, UP, config, endpoint, open_session
from sioms.prompt import BoundedPrompt, be_prompt
from sioms.protocol import link
from sioms.protocol.link import Down, MalformedFrame
from sioms.protocol.messages import MalformedMessage

from .stop_queue import Stop, StopQueue
from .ways import Ways

if TYPE_CHECKING:
    from .transport import Loop

HANDSHAKE_MS = 2000
TURN = 200
"""Frames of clients that are taken before others have their turn."""
MOST_QUEUED = 1000
"""Frames of the holder of a certificate that wait to be taken; what comes above is dropped, which ends its session."""
MOMENT_S = 0.004
"""How long after the drivers the daemon is told of a stop [s], so that it does not hold up those of other workcells on
this machine.
"""
_NAME = re.compile(r"sioms/[a-z]+/(cert-0[0-9]{3})/([0-9a-f]{16})")


def access() -> dict[str, Any]:
    """Return the access control: of all numbers, so that none of them needs another start."""
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = [{"id": "all"}]
    policies: list[dict[str, Any]] = [{"rules": ["ours", "seen"], "subjects": ["all"]}]

    def rule(name: str, messages: list[str], flows: list[str], keys: list[str]) -> str:
        rules.append({"id": name, "messages": messages, "flows": flows, "permission": "allow", "key_exprs": keys})
        return name

    rule("ours", ["declare_subscriber"], ["egress"], [f"{UP}/**", f"{STOP}/**"])
    rule("seen", ["liveliness_token", "declare_liveliness_subscriber"], ["ingress", "egress"], [GATEWAY])
    for number in (f"cert-{i:04d}" for i in range(NUMBERS)):
        subjects.append({"id": number, "cert_common_names": [number]})
        names = [
            rule(f"{number}-up", ["put"], ["ingress"], [f"{UP}/{number}/*", f"{STOP}/{number}/*"]),
            rule(f"{number}-down", ["put"], ["egress"], [f"{DOWN}/{number}/*"]),
            rule(f"{number}-hear", ["declare_subscriber"], ["ingress"], [f"{DOWN}/{number}/*"]),
            rule(f"{number}-live", ["liveliness_token"], ["ingress"], [f"{ALIVE}/{number}/*"]),
        ]
        policies.append({"rules": names, "subjects": [number]})
    return {
        "enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies,
    }  # fmt: skip


def _free(host: str, port: int) -> None:
    """Raise OSError unless one can listen at a place; Zenoh's own words do not say why."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family) as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind((host, port))
    except OSError as error:
        hint = {
            errno.EADDRINUSE: "another program listens there; stop it, or choose another port",
            errno.EADDRNOTAVAIL: "no address of this machine; want one of `ip address`, or * for all",
            errno.EACCES: "no right to that port; choose one above 1023",
        }.get(error.errno or 0, str(error.strerror or error).lower())
        raise OSError(error.errno or errno.EINVAL, f"listen on {host}:{port}: {hint}") from None


class Zenoh:
    """See ``transport.Transport``.

    Args:
        loop: the loop it lives in.
        path: the daemon's socket.
        host, port: where to listen.
        folder: with the gateway's certificate.

    Raises:
        OSError: no certificate, or one that does not serve; the port is taken, or no such address is ours.
    """

    def __init__(self, loop: Loop, path: str, host: str, port: int, folder: Folder) -> None:
        self._loop, self._gateway = loop, loop.gateway
        what = f"listen on {host}:{port}"
        mine = own(folder, what)
        if not mine.hosts:
            raise OSError(
                errno.EACCES, f"{what}: the certificate in {folder.path} is a client's; have one signed with its "
                "hosts: sioms cert sign --host HOST"
            )  # fmt: skip
        host = "0.0.0.0" if host == "*" else host
        _free(host, port)
        self.about = {"address": f"zenoh://{host}:{port}", "certificate": mine.number, "hosts": ",".join(mine.hosts)}
        self._frames: deque[tuple[str, str, bytes | None]] = deque()
        self._waiting: Counter[str] = Counter()
        self._counting = threading.Lock()
        self._publishers: dict[bytes, zenoh.Publisher] = {}
        self._came = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        loop.add(self._came, self._heard)
        self._prompt = BoundedPrompt()
        self._stops = StopQueue()
        self._ways = Ways(path)
        self._thread = threading.Thread(target=self._run_stops, name="stops over Zenoh", daemon=True)
        limit = {
            "flows": ["ingress"], "messages": ["put"], "key_exprs": ["**"], "size_limit": link.MAX_TO_GATEWAY
        }  # fmt: skip
        at = f"{endpoint(host, port)}#tls_handshake_timeout_ms={HANDSHAKE_MS}"
        try:
            self._session = open_session(
                config(
                    folder, "listen", mode="router", listen={"endpoints": [at]},
                    low_pass_filter=[limit], access_control=access(),
                )
            )  # fmt: skip
        except zenoh.ZError as error:
            raise OSError(errno.EIO, f"{what}: {error}") from None

    def start(self) -> None:
        """Begin to take frames."""
        self._thread.start()
        session = self._session
        self._declared = [
            session.declare_subscriber(f"{UP}/*/*", Callback(self._frame, indirect=False)),
            session.declare_subscriber(f"{STOP}/*/*", Callback(self._stop, indirect=False)),
            session.liveliness().declare_subscriber(f"{ALIVE}/*/*", Callback(self._alive, indirect=False)),
            session.liveliness().declare_token(GATEWAY),
        ]

    def owns(self, peer: bytes) -> bool:
        """Tell whether a peer is one of this transport: the number of a certificate, and of its session."""
        return peer[:5] == b"cert-"

    # --- threads of Zenoh ------------------------------------------------------------------------

    def _queue(self, sample: zenoh.Sample, frame: bytes | None) -> None:
        found = _NAME.fullmatch(str(sample.key_expr))
        if found is None:
            return
        with self._counting:
            if self._waiting[found[1]] >= MOST_QUEUED and frame is not None:
                return  # its next frame is none that follows, and ends its session
            self._waiting[found[1]] += 1
        self._frames.append((found[1], found[2], frame))
        os.eventfd_write(self._came, 1)

    def _frame(self, sample: zenoh.Sample) -> None:
        self._prompt.enter()
        if sample.kind == zenoh.SampleKind.PUT:
            self._queue(sample, sample.payload.to_bytes())

    def _alive(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            self._queue(sample, None)

    def _stop(self, sample: zenoh.Sample) -> None:
        """Have the drivers brake, and leave all else to the thread of stops."""
        self._prompt.enter()
        found = _NAME.fullmatch(str(sample.key_expr))
        if found and sample.kind == zenoh.SampleKind.PUT and self._stops.has_room(found[1]):
            frame = sample.payload.to_bytes()
            begun = self._ways.begin(self._loop.principal(found[1]), frame)
            self._stops.put(found[1], Stop(found[2], frame, begun, time.monotonic_ns()))

    # --- the loop --------------------------------------------------------------------------------

    def _heard(self) -> None:
        with suppress(BlockingIOError):
            os.eventfd_read(self._came)

    @property
    def pending(self) -> bool:
        """Whether frames wait."""
        return bool(self._frames)

    def take(self) -> bool:
        """Take frames of clients; return whether there are more."""
        for _ in range(min(TURN, len(self._frames))):
            number, name, frame = self._frames.popleft()
            with self._counting:
                self._waiting[number] -= 1
            peer = f"{number}/{name}".encode()
            who = self._loop.principal(number)
            if frame is None:
                self._gateway.gone(peer)
            elif who is None and peer not in self._gateway.sessions:
                self._turn_away(peer, number)
            else:
                host = self._host(number) if peer not in self._gateway.sessions else ""
                self._gateway.frame(peer, who, host, frame)
        return bool(self._frames)

    def _turn_away(self, peer: bytes, number: str) -> None:
        """Tell the holder of a certificate that is not listed here so, whatever it has sent."""
        text = f"the gateway does not let your certificate in; on its machine run `sioms key allow NAME {number}`"
        self.send(peer, link.pack(Down.END, errno.EACCES, body=text.encode()))

    def _host(self, number: str) -> str:
        """Return where the holder of a certificate is connected from."""
        links = self._session.info.links()
        hosts = {each.dst.partition("/")[2].rpartition(":")[0] for each in links if each.auth_identifier == number}
        return "|".join(sorted(hosts)[:3]) or "unknown"

    def send(self, peer: bytes, frame: bytes) -> bool:
        """Send a frame to a client; False when it has gone. A connection that takes none for BLOCKED_US is closed."""
        try:
            publisher = self._publishers.get(peer)
            if publisher is None:
                publisher = self._publishers[peer] = self._publisher(f"{DOWN}/{peer.decode()}")
            publisher.put(frame)
        except zenoh.ZError:
            return False
        return True

    def _publisher(self, key: str, priority: zenoh.Priority = zenoh.Priority.INTERACTIVE_HIGH) -> zenoh.Publisher:
        return self._session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.BLOCK, priority=priority, express=True
        )

    def look(self) -> None:
        """Forget sessions that have ended, and let nobody keep a processor busy ahead of ordinary processes."""
        self._prompt.look()
        for peer in [each for each in self._publishers if each not in self._gateway.sessions]:
            self._publishers.pop(peer).undeclare()  # type: ignore[no-untyped-call]

    # --- stops -----------------------------------------------------------------------------------

    def _run_stops(self) -> None:
        be_prompt()
        for number, stop in self._stops:
            try:
                if stop.begun is not None:
                    time.sleep(max(0.0, MOMENT_S - 1e-9 * (time.monotonic_ns() - stop.came_ns)))
                who = self._loop.principal(number)
                answer = self._ways.answer(who, self._host(number), stop.frame, stop.begun) if who else None
                if answer:
                    self._session.put(
                        f"{DOWN}/{number}/{stop.name}", answer, congestion_control=zenoh.CongestionControl.BLOCK,
                        priority=zenoh.Priority.REAL_TIME, express=True,
                    )  # fmt: skip
            except (zenoh.ZError, MalformedFrame, MalformedMessage):
                continue
            except Exception as error:  # a mistake of ours costs this stop, not the next one
                trace = "".join(traceback.format_exception(error)[-3:])
                self._loop.log("error", "internal error", trace=trace)
        self._ways.close()

    def close(self) -> None:
        """Let go of everything. Zenoh first: when its session has ended no thread of it is in ours, or comes again."""
        self._session.close()  # type: ignore[no-untyped-call]
        self._stops.close()
        if self._thread.ident is not None:
            self._thread.join(2.0)
        self._loop.remove(self._came)
        os.close(self._came)
