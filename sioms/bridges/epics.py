"""``sioms epics``: nodes as process variables of EPICS PV Access, with alarms and units; stops may be put.

One thread reads the pages and posts what has changed, one asks the daemon; the library's threads serve clients and
carry out puts, so that no client is waited for. Set-points are taken only on request, and under a lease that the writer
renews: docs/decisions/0336 and 0395
"""

from __future__ import annotations

import argparse
import errno
import ipaddress
import math
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeAlias
from zlib import crc32

from p4p.nt import NTScalar
from p4p.server import Server, StaticProvider
from p4p.server.thread import SharedPV
from p4p.util import ThreadedWorkQueue

from sioms.arguments import place, positive
from sioms.bridges.leases import LEASE_S, Leases
from sioms.bridges.prompt import Prompt
from sioms.bridges.putters import Putters
from sioms.client.workcell import Workcell, is_part
from sioms.ending import end_well
from sioms.protocol.flags import READONLY, AnalogStatus, AxisStatus, NodeClass, Severity
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo
from sioms.protocol.text import printable

PLACE = "127.0.0.1:5075"
ASK_S = 0.5
"""How often nodes and alarms are asked for [s]."""
SHOWN_S = 0.5
"""Longest time that a put waits for a look that is under way, before it is answered without being shown [s]."""
GONE = "cannot be read"
QUEUES = 4
"""Of puts, each with a thread, and as many threads for stops."""
Act: TypeAlias = Callable[[float, str, str], None]
_NUMBER, _WHOLE, _TEXT = NTScalar("d", display=True, control=True), NTScalar("l", display=True), NTScalar("s")


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "epics",
        help="serve nodes to EPICS clients, which may stop and move axes",
        description="A bridge to EPICS PV Access: an ordinary client of the daemon that shows axes as motors, with "
        "read-back, set-point, limits, done-moving and alarm, and analog and binary channels. Whoever reaches the port "
        "may read. Programs on this machine of your own user, of root and of --user may stop axes by a put to STOP "
        "and, with --move, move them, each while it renews its lease by puts to LEASE.",
    )
    parser.add_argument(
        "--listen", metavar="HOST:PORT", default=PLACE, help=f"address; default {PLACE}, *:5075 for all interfaces"
    )
    parser.add_argument("--prefix", metavar="TEXT", default="", help="prefix of all variable names")
    parser.add_argument("--rate", metavar="HZ", type=positive, default=10.0, help="polling rate; default 10 Hz")
    parser.add_argument("--move", action="store_true", help="let clients on this machine move axes, under a lease")
    parser.add_argument(
        "--user", metavar="NAME", action="append", default=[], help="who may put from this machine, too; repeatable"
    )
    parser.add_argument("--anybody-stops", action="store_true", help="let whoever reaches the port stop axes")


def run(args: argparse.Namespace) -> int:
    """Serve until told to end."""
    host, port = place(args.listen, PLACE)
    if args.move and not is_loopback(host):
        text = (
            f"listen on {args.listen} with --move: whoever reaches the port could move axes, because PV Access has no"
        )
        raise OSError(errno.EINVAL, f"{text} passwords; want a loopback address, as 127.0.0.1, and a tunnel to it")
    putters = Putters(args.user, anybody_stops=args.anybody_stops)
    prompt = Prompt()
    bridge = Bridge(args.prefix, putters, prompt, Leases(prompt) if args.move else None)
    with serve(bridge.provider, host, port) as server:
        putters.here = (host, int(server.conf()["EPICS_PVAS_SERVER_PORT"]))
        end_well()
        print(f"listening on {args.listen}", file=sys.stderr, flush=True)
        bridge.ask()
        threading.Thread(target=bridge.ask_again, name="nodes and alarms", daemon=True).start()
        while True:
            time.sleep(1.0 / args.rate)
            bridge.look()


def is_loopback(host: str) -> bool:
    """Tell whether a host, by name or address, is reached from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def serve(provider: StaticProvider, host: str, port: int) -> Server:
    """Return a server of the variables at one place; port 0 for any, and searches by broadcast only where it is seen.

    Raises:
        OSError: EINVAL, one cannot listen there; EADDRINUSE, somebody else does.
    """
    seen = host == "*"
    conf = {
        "EPICS_PVAS_INTF_ADDR_LIST": "0.0.0.0" if seen else host,
        "EPICS_PVAS_SERVER_PORT": str(port),
        "EPICS_PVAS_BROADCAST_PORT": str(port + 1 if port else 0),
        "EPICS_PVAS_AUTO_BEACON_ADDR_LIST": "YES" if seen else "NO",
        "EPICS_PVAS_BEACON_ADDR_LIST": "" if seen else host,
    }
    try:
        server = Server(providers=[provider], conf=conf, useenv=False)
    except RuntimeError as error:
        ports = f"{port}, and {port + 1} for searches" if port else "any port"
        raise OSError(errno.EINVAL, f"listen on {host}:{port}: want {ports}: {error}") from None
    if port and int(server.conf()["EPICS_PVAS_SERVER_PORT"]) != port:  # the library has silently taken another one
        server.stop()
        raise OSError(errno.EADDRINUSE, f"listen on {host}:{port}: another program does; choose another port")
    return server


class Puts:
    """A queue for puts, as the library wants one: what waits there behind a put to a driver that hangs came before.

    Args:
        prompt: tells when a put has come.
        workers: threads; with one, puts are done in their order.
    """

    def __init__(self, prompt: Prompt, workers: int = 1) -> None:
        self._prompt = prompt
        self._queue = ThreadedWorkQueue("puts", workers, daemon=True, maxsize=0).start()

    def push(self, put: Callable[[], None]) -> None:
        """Have a put done that has come now (called in a thread of the library)."""
        came_ns = self._prompt.came_ns()

        def done() -> None:
            with self._prompt.word(came_ns):
                put()

        self._queue.push(done)


class Shown:
    """One process variable.

    Args:
        kind: type of its value.
        channel: whose units, limits and description clients see.
        puts: where they wait.
        act: what a put does, with the value, and account and address of the client; None: nothing can be put.
    """

    def __init__(self, kind: NTScalar, channel: ChannelInfo, puts: Puts, act: Act | None = None) -> None:
        self._kind, self._channel, self._act = kind, channel, act
        self._last: tuple[str, int, str] | None = None
        self.pv = SharedPV(nt=kind, handler=self, queue=puts)

    def put(self, pv: SharedPV, op: Any) -> None:
        """Carry out a put of a client (called in a thread of the library)."""
        if self._act is None:
            op.done(error=f"put to {op.name()}: it is shown only; only STOP can be put, and with --move LEASE and VAL")
            return
        try:
            self._act(float(op.value()), op.account(), op.peer())
        except (OSError, ValueError, TypeError) as error:
            op.done(error=f"put to {op.name()}: {getattr(error, 'strerror', None) or error}")
        else:
            op.done()

    def post(self, value: Any, severity: int, message: str, stamp_s: float | None) -> None:
        """Show a value where it, or its alarm, is another one; None: the last one."""
        now = (str(value), severity, message)
        if now == self._last or (value is None and self._last and now[1:] == self._last[1:]):
            return
        words: dict[str, Any] = {"severity": severity, "message": message}
        if stamp_s is not None:
            words["timestamp"] = stamp_s
        if self._last is None:
            self.pv.open(self._described(value), **words)
        else:
            self.pv.post({} if value is None else {"value": value}, **words)
        self._last = now

    def _described(self, value: Any) -> dict[str, Any]:
        told: dict[str, Any] = {"value": value}
        if self._kind is not _TEXT:
            told["display"] = {"description": self._channel.description}
        if self._kind is _NUMBER:
            low, high = bounds(self._channel)
            limits = {"limitLow": low, "limitHigh": high}
            told["display"] |= {"units": self._channel.unit, **limits}
            told["control"] = limits
        return told


def bounds(channel: ChannelInfo) -> tuple[float, float]:
    """Return the lowest and highest value; both 0 for none, as EPICS has it, and an infinity for one that is not."""
    low, high = channel.minimum, channel.maximum
    if low is None and high is None:
        return 0.0, 0.0
    return -math.inf if low is None else low, math.inf if high is None else high


def values(info: NodeInfo, channel: ChannelInfo, reading: Any) -> Iterator[tuple[str, NTScalar, Any]]:
    """Return what is shown of a channel: what follows its name, type and value."""
    match info.node_class:
        case NodeClass.AXIS:
            moving, (low, high) = bool(reading.in_motion), bounds(channel)
            for field in ("", ".VAL"):
                yield field, _NUMBER, reading.commanded_position
            yield ".RBV", _NUMBER, reading.position
            yield ".VELO", _NUMBER, channel.limits.get("velocity", 0.0)
            yield ".DIFF", _NUMBER, reading.following_error
            yield ".LLM", _NUMBER, low
            yield ".HLM", _NUMBER, high
            yield ".DMOV", _WHOLE, int(not moving)
            yield ".MOVN", _WHOLE, int(moving)
            yield ".MSTA", _WHOLE, reading.status
            yield ".EGU", _TEXT, channel.unit
            yield ".DESC", _TEXT, channel.description
        case NodeClass.ANALOG | NodeClass.BINARY:
            yield "", _NUMBER if info.node_class is NodeClass.ANALOG else _WHOLE, reading.data


def severity_of(node_class: NodeClass, reading: Any) -> tuple[int, str]:
    """Return how bad a reading is by its own status, and why in words."""
    if node_class is NodeClass.BINARY:
        return 0, ""
    status = AxisStatus(reading.status) if node_class is NodeClass.AXIS else AnalogStatus(reading.flags)
    bad = [str(flag.name) for flag in type(status) if status & flag and flag.severity]
    is_invalid = node_class is NodeClass.ANALOG and bool(status & AnalogStatus.INVALID)
    return int(Severity.INVALID) if is_invalid else status.severity, ", ".join(bad)


def worst(alarms: Iterable[dict[str, Any]], node: str, device: str, channel: str) -> tuple[int, str]:
    """Return the severity and the sentence of the worst alarm on a channel, its node or its device; 0, '' for none."""
    names = {f"{node}.{channel}", node, device}
    found = [(a["severity"], a["text"]) for a in alarms if a["severity"] and a["node"] in names]
    return max(found, default=(0, ""), key=lambda one: one[0])


class Bridge:
    """Shows what is in a workcell.

    Attributes:
        provider: of the process variables.

    Args:
        prefix: what the names of all variables begin with.
        putters: judges who may put.
        prompt: tells how old a put may be.
        leases: by which clients hold nodes; None: they move nothing.

    Concurrency: ``look`` in one thread, ``ask`` in another; puts in any.
    """

    def __init__(self, prefix: str, putters: Putters, prompt: Prompt, leases: Leases | None = None) -> None:
        self._leases, self._putters = leases, putters
        self._puts, self._stop_puts = [Puts(prompt) for _ in range(QUEUES)], Puts(prompt, QUEUES)
        self.provider = StaticProvider("sioms")
        self._prefix = prefix
        self._shown: dict[str, Shown] = {}
        self._of_node: dict[str, set[str]] = {}
        self._made_of: dict[str, object] = {}
        self._cell: Workcell | None = None
        self._nodes: dict[str, Any] = {}
        self._names: dict[str, str] = {}
        self._alarms: list[dict[str, Any]] = []
        self._lock = threading.Lock()
        """Of all that is shown: who has put something sees what came of it."""

    def look(self) -> None:
        """Post what has changed; what cannot be read is INVALID."""
        with self._lock:
            self._look()

    def _look(self) -> None:
        if self._leases is not None:
            self._leases.sweep()
        for name in self._names.keys() | self._of_node.keys():
            try:
                self._show(name)
            except OSError as error:
                if (node := self._nodes.pop(name, None)) is not None:
                    node.release()
                for shown in self._of_node.get(name, ()):
                    self._shown[shown].post(None, int(Severity.INVALID), error.strerror or GONE, None)

    def ask(self) -> None:
        """Ask for nodes and alarms; a daemon that hangs keeps nobody from seeing what drivers publish meanwhile."""
        try:
            cell = self._cell = self._cell or Workcell(name="sioms epics")
            entries, alarms = cell.nodes(), cell.alarms()
        except OSError:
            with self._lock:
                if self._cell is not None:
                    self._cell.close()
                self._cell, self._nodes, self._names = None, {}, {}
            return
        names = {e.name: e.name if e.read_only else e.name + READONLY for e in entries if not is_part(e, entries)}
        with self._lock:
            self._alarms, self._names = alarms, names
            for gone in self._of_node.keys() - names.keys():
                self._remove(gone)

    def ask_again(self) -> None:
        """Ask again and again."""
        while True:
            time.sleep(ASK_S)
            self.ask()

    def _remove(self, node: str) -> None:
        """Take the variables of a node away: it is not in the workcell any more, or is another one."""
        if (opened := self._nodes.pop(node, None)) is not None:
            opened.release()
        for name in self._of_node.pop(node, ()):
            self.provider.remove(name)
            self._shown.pop(name).pv.close(destroy=True)

    def _node(self, name: str) -> Any:
        if name not in self._names or self._cell is None:
            raise OSError(errno.EIO, GONE)
        if name not in self._nodes:
            opened = self._cell.open(self._names[name])
            made_of = [(c.name, c.unit, c.minimum, c.maximum, c.description) for c in opened.info.channels]
            if self._made_of.get(name, made_of) != made_of:
                self._remove(name)  # a reload has changed what clients are told once
            self._nodes[name], self._made_of[name] = opened, made_of
        return self._nodes[name]

    def _show(self, name: str) -> None:
        node = self._node(name)
        snapshot, info = node.read(), node.info
        stamp_s = snapshot.utc.ns / 1e9
        for channel, reading in zip(info.channels, snapshot, strict=True):
            alarm = max(severity_of(info.node_class, reading), worst(self._alarms, name, info.device, channel.name))
            for field, kind, value in values(info, channel, reading):
                moves = field in ("", ".VAL") and info.node_class is NodeClass.AXIS
                act = self._mover(name, channel.name) if moves else None
                self._post(name, f":{channel.name}{field}", kind, channel, act).post(value, *alarm, stamp_s)
            if info.node_class is NodeClass.AXIS:
                act = self._judged(name, lambda on, _: self._stop(name, on), stops=True)
                stop = self._post(name, f":{channel.name}.STOP", _WHOLE, channel, act)
                stop.post(0, 0, "", stamp_s)
        if self._leases is not None and info.node_class is NodeClass.AXIS:
            of = ChannelInfo("", "s", *LEASE_S, description="put again in time by who moves the node; 0: let go")
            leases = self._leases
            act = self._judged(name, lambda seconds, who: leases.put(name, who, seconds))
            lease = self._post(name, ".LEASE", _NUMBER, of, act)
            lease.post(*leases.shown(name), stamp_s)

    def _mover(self, node: str, channel: str) -> Act | None:
        if (leases := self._leases) is None:
            return None
        return self._judged(node, lambda position, who: leases.move(node, who, channel, position))

    def _judged(self, node: str, act: Callable[[float, str], None], *, stops: bool = False) -> Act:
        """Return a put that is judged before it is done, and shown before it is answered; ``act`` takes the value, and
        the client in words.
        """

        def judged(value: float, account: str, peer: str) -> None:
            self._putters.judge(peer, stops=stops)
            act(value, f"{printable(account, 32)}@{peer}")
            if self._lock.acquire(timeout=SHOWN_S):
                try:
                    self._show(node)
                except OSError:
                    pass  # the next look says that it cannot be read
                finally:
                    self._lock.release()

        return judged

    def _post(self, node: str, what: str, kind: NTScalar, channel: ChannelInfo, act: Act | None = None) -> Shown:
        """Return the variable of a name, made where there is none yet; no move is before a stop in its queue."""
        name = f"{self._prefix}{node}{what}"
        if name not in self._shown:
            puts = self._stop_puts if what.endswith(".STOP") else self._puts[crc32(node.encode()) % QUEUES]
            self._shown[name] = Shown(kind, channel, puts, act)
            self._of_node.setdefault(node, set()).add(name)
            self.provider.add(name, self._shown[name].pv)
        return self._shown[name]

    def _stop(self, name: str, on: float) -> None:
        """Stop a node, also one whose readings are lost for now, unless 0 is put."""
        cell, node = self._cell, self._nodes.get(name)
        if on == 0:
            return
        if node is not None:
            node.stop()
        elif cell is None or name not in self._names:
            raise OSError(errno.EIO, f"{name}: {GONE}")
        else:
            with cell.open(self._names[name]) as opened:
                opened.stop()
