"""``sioms ros2``: axes, wrenches and diagnostics as ROS 2 topics, on keys of Zenoh that rmw_zenoh understands.

An ordinary client of the daemon, which only reads: it is connected to a router of Zenoh, as ``rmw_zenohd`` is one, and
puts messages there. docs/decisions/0523-ros-2-messages-on-zenoh-keys.md

Concurrency: one thread; Zenoh has others.
"""

from __future__ import annotations

import argparse
import errno
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import zenoh

from sioms.arguments import positive, whole
from sioms.client.node import Node
from sioms.client.workcell import NodeEntry, Workcell, is_part
from sioms.ending import end_well
from sioms.protocol.flags import READONLY, NodeClass
from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.text import printable

from . import ros2_messages as ros

ROUTER = "tcp/localhost:7447"
ASK_S = 1.0
"""How often nodes and diagnostics are asked for [s]."""
WRENCH_UNITS = ("N", "N", "N", "N*m", "N*m", "N*m")
GOOD, WARNING, ERROR, STALE = range(4)
LEVEL = {"up": GOOD, "starting": WARNING, "restarting": WARNING, "fault": ERROR}


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "ros2",
        help="publish axes, wrenches and diagnostics as ROS 2 topics over Zenoh",
        description="A bridge to ROS 2 with rmw_zenoh: an ordinary client of the daemon that publishes JointState of "
        "each axis node, WrenchStamped of each force/torque sensor, and DiagnosticArray of the devices. It only reads.",
    )
    parser.add_argument(
        "--router", metavar="LOCATOR", default=ROUTER, help=f"Zenoh router; default {ROUTER}, that of rmw_zenohd"
    )
    parser.add_argument("--rate", metavar="HZ", type=positive, default=100.0, help="message rate; default 100 Hz")
    parser.add_argument("--domain", metavar="NUMBER", type=whole(), default=0, help="ROS_DOMAIN_ID; default 0")
    parser.add_argument(
        "--prefix", metavar="NAME", default="", help="prefix of topics; default: the name of the workcell"
    )


def run(args: argparse.Namespace) -> int:
    """Publish until told to end."""
    session = connect(args.router)
    try:
        with Workcell(name="sioms ros2") as cell:
            bridge = Bridge(session, cell, args.domain, ros.part(args.prefix or cell.name))
            print(f"publishing below /{bridge.prefix} to {args.router}", file=sys.stderr, flush=True)
            end_well()
            due_s = time.monotonic()
            while True:
                bridge.look()
                due_s = max(due_s + 1.0 / args.rate, time.monotonic() - 1.0)
                time.sleep(max(0.0, due_s - time.monotonic()))
    finally:
        session.close()  # type: ignore[no-untyped-call]


def connect(router: str) -> zenoh.Session:
    """Open a session with a router, and with nobody else.

    Raises:
        OSError: nobody there.
    """
    table = {
        "mode": "client",
        "connect": {"endpoints": [router], "timeout_ms": 3000, "exit_on_failure": True},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(table)))
    except zenoh.ZError as error:
        why = str(error).partition(" at /")[0]  # behind it is where in the library's code
        text = (
            f"connect to the router of Zenoh at {printable(router)}: {why}; start `ros2 run rmw_zenoh_cpp rmw_zenohd`"
        )
        raise OSError(errno.ECONNREFUSED, text) from None


class Topic:
    """A publisher as rmw_zenoh has them: a key, a liveliness token and numbered messages.

    Args:
        session: of Zenoh.
        domain: of ROS.
        number: of the publisher in its session.
        name: of the topic; of: its type.
    """

    def __init__(self, session: zenoh.Session, domain: int, number: int, name: str, of: ros.Type) -> None:
        token = ros.publisher_token(domain, str(session.zid()), number, "sioms", name, of)
        self._publisher = session.declare_publisher(ros.topic_key(domain, name, of))
        self._token = session.liveliness().declare_token(token)
        self._identity, self._number = ros.identity(token), 0

    def publish(self, message: bytes) -> None:
        """Put a message."""
        self._number += 1
        self._publisher.put(message, attachment=ros.attachment(self._number, time.time_ns(), self._identity))

    def close(self) -> None:
        """Take it away."""
        self._token.undeclare()  # type: ignore[no-untyped-call]
        self._publisher.undeclare()  # type: ignore[no-untyped-call]


@dataclass(slots=True)
class _Shown:
    """A node that is published.

    Attributes:
        node: opened to be read; topic: its topic.
        message: makes a message of a snapshot.
        last: number of the snapshot that was published last.
    """

    node: Node[Any]
    topic: Topic
    message: Callable[[Any], bytes]
    last: int = field(default=-1)


def _joints(info: NodeInfo) -> Callable[[Any], bytes]:
    names = [ros.part(channel.name) for channel in info.channels]
    return lambda s: ros.joint_state(s.utc.ns, "", names, s.position, s.velocity, s.force)


def _wrench(info: NodeInfo) -> Callable[[Any], bytes]:
    frame = ros.part(info.name)
    return lambda s: ros.wrench(s.utc.ns, frame, s.known)


class Bridge:
    """What is published.

    Args:
        session: of Zenoh.
        cell: the workcell.
        domain: of ROS.
        prefix: of topics.
    """

    def __init__(self, session: zenoh.Session, cell: Workcell, domain: int, prefix: str) -> None:
        self._session, self._cell, self._domain = session, cell, domain
        self.prefix = prefix
        self._shown: dict[str, _Shown] = {}
        self._numbers = 0
        self._token = session.liveliness().declare_token(ros.node_token(domain, str(session.zid()), "sioms"))
        self._diagnostics = self._topic("/diagnostics", ros.DIAGNOSTICS)
        self._ask_s = 0.0

    def _topic(self, name: str, of: ros.Type) -> Topic:
        self._numbers += 1
        return Topic(self._session, self._domain, self._numbers, name, of)

    def look(self) -> None:
        """Publish what is new."""
        if time.monotonic() >= self._ask_s:
            self._ask_s = time.monotonic() + ASK_S
            self._ask()
        for name, shown in list(self._shown.items()):
            try:
                snapshot = shown.node.read()
            except OSError:
                self._hide(name)  # its topic ends; the diagnostics say why
                continue
            if snapshot.number != shown.last:
                shown.last = snapshot.number
                shown.topic.publish(shown.message(snapshot))

    def _ask(self) -> None:
        status = self._cell.status()
        entries = self._cell.nodes()
        up = {device["name"] for device in status["devices"] if device["state"] == "up"}
        wanted = {each.name: each for each in entries if each.device in up and not is_part(each, entries)}
        for name in [each for each in self._shown if each not in wanted]:
            self._hide(name)
        for name, entry in wanted.items():
            if name not in self._shown:
                self._show(entry)
        stopped = f"emergency stop by {status['stop_source']}" if status["stopped_ns"] else ""
        self._diagnostics.publish(ros.diagnostics(time.time_ns(), statuses(status, self._cell.name, stopped)))

    def _show(self, entry: NodeEntry) -> None:
        info = self._cell.info(entry.name)
        name = f"/{self.prefix}/{ros.part(entry.name)}"
        if entry.node_class is NodeClass.AXIS:
            kind, of, message = "joint_states", ros.JOINT_STATE, _joints(info)
        elif entry.node_class is NodeClass.ANALOG and tuple(c.unit for c in info.channels) == WRENCH_UNITS:
            kind, of, message = "wrench", ros.WRENCH, _wrench(info)
        else:
            return
        try:
            node = self._cell.open(entry.name if entry.read_only else entry.name + READONLY)
        except OSError:
            return  # another time
        self._shown[entry.name] = _Shown(node, self._topic(f"{name}/{kind}", of), message)

    def _hide(self, name: str) -> None:
        shown = self._shown.pop(name)
        shown.topic.close()
        shown.node.close()


def statuses(status: dict[str, Any], cell: str, stopped: str) -> list[ros.Status]:
    """Return the diagnostics of a workcell: of itself, and of each device."""
    found = [ros.Status(ERROR if stopped else GOOD, f"sioms: {cell}", stopped or "good", cell)]
    for device in status["devices"]:
        level = LEVEL.get(device["state"], STALE)
        text = str(device["reason"] or device["trouble"] or device["state"])
        if level == GOOD and device["trouble"]:
            level = WARNING
        values = (("state", str(device["state"])), ("deaths", str(device["deaths"])))
        found.append(ros.Status(level, f"sioms: {cell}: {device['name']}", text, cell, values))
    return found
