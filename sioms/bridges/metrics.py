"""``sioms metrics``: the state of the workcell for Prometheus, over HTTP.

A scrape asks the daemon and reads the pages; between two scrapes nothing is done. Requests are answered in threads of
their own, at most ``MOST_SCRAPERS`` at a time and each for ``SCRAPE_S`` at most; of a request only its line and headers
are read.
"""

from __future__ import annotations

import argparse
import errno
import socket
import sys
import threading
from collections.abc import Iterable, Iterator
from http.server import ThreadingHTTPServer
from time import monotonic
from typing import Any

from prometheus_client import CollectorRegistry, MetricsHandler
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric, SummaryMetricFamily

from sioms.arguments import place
from sioms.client.workcell import NodeEntry, Workcell, is_part
from sioms.ending import end_well
from sioms.protocol.flags import READONLY, AnalogStatus, AxisStatus, NodeClass, Severity
from sioms.protocol.nodeinfo import NodeInfo

PLACE = "127.0.0.1:9578"
MOST_SCRAPERS = 8
SCRAPE_S = 10.0
"""Longest that a scrape may take until it is cut off [s]; Prometheus waits 10 s unless told otherwise."""
KEPT_S = 0.1
"""How long an answer holds for further scrapes [s]."""
LAST_TICKS = 64
"""Ticks over which the lateness of a driver is told; each costs the driver a microsecond a scrape."""
_AXIS = ("position", "velocity", "force", "commanded_position", "following_error", "in_motion", "buffered")
_PER = {"velocity": "/s"}


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "metrics",
        help="serve values, states and alarms to Prometheus",
        description="An exporter: an ordinary client of the daemon that serves values, states, faults, alarms, stops, "
        "late ticks and deaths of drivers to Prometheus, at http://HOST:PORT/metrics. It only reads. Whoever reaches "
        "the port may read, so that anything but loopback wants a firewall.",
    )
    parser.add_argument(
        "--listen", metavar="HOST:PORT", default=PLACE, help=f"address; default {PLACE}, *:9578 for all interfaces"
    )


def run(args: argparse.Namespace) -> int:
    """Serve until told to end."""
    host, port = place(args.listen, PLACE)
    registry = CollectorRegistry(auto_describe=False)
    registry.register(Exporter())
    try:
        server = Server(host, port, registry)
    except (OSError, OverflowError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise OSError(getattr(error, "errno", None) or errno.EINVAL, f"listen on {args.listen}: {why}") from None
    end_well()
    print(f"listening on http://{args.listen}/metrics", file=sys.stderr, flush=True)
    with server:
        server.serve_forever()
    return 0


class Server(ThreadingHTTPServer):
    """HTTP, bounded: so many requests at a time, each for so long."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, host: str, port: int, registry: CollectorRegistry) -> None:
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._until_s: dict[socket.socket, float] = {}
        self._lock = threading.Lock()
        super().__init__(("" if host == "*" else host, port), MetricsHandler.factory(registry))

    def server_bind(self) -> None:
        """Bind, without asking a name server who we are."""
        socket.socket.bind(self.socket, self.server_address)
        self.server_name, self.server_port = str(self.server_address[0]), self.socket.getsockname()[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread, or hang up where too many are being answered."""
        with self._lock:
            if len(self._until_s) < MOST_SCRAPERS:
                self._until_s[request] = monotonic() + SCRAPE_S
        if request in self._until_s:
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def shutdown_request(self, request: Any) -> None:
        """Hang up."""
        with self._lock:
            self._until_s.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Cut off who takes too long (called twice a second)."""
        with self._lock:
            for request, until_s in self._until_s.items():
                if monotonic() > until_s:
                    try:
                        request.shutdown(socket.SHUT_RDWR)
                    except OSError:
                        continue  # has gone by itself

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a scraper that has gone; whatever else goes wrong is a fault of ours."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class Exporter:
    """Collects the metrics of a workcell, for as many scrapes as come.

    Concurrency: any number of threads; one asks, the others wait for its answer.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._cell: Workcell | None = None
        self._nodes: dict[str, Any] = {}
        self._told: list[Metric] = []
        self._told_s = -KEPT_S

    def collect(self) -> Iterable[Metric]:
        """Return the metrics as they are now; without a daemon only that there is none."""
        with self._lock:
            if monotonic() > self._told_s + KEPT_S:
                try:
                    self._told = [*self._ask()]
                except OSError:
                    self._let_go()
                    self._told = [_one("sioms_up", "whether the daemon answers", 0)]
                self._told_s = monotonic()
            return self._told

    def _let_go(self) -> None:
        self._nodes = {}
        if self._cell is not None:
            self._cell.close()
            self._cell = None

    def _ask(self) -> Iterator[Metric]:
        cell = self._cell = self._cell or Workcell(name="sioms metrics")
        entries = cell.nodes()
        entries = [entry for entry in entries if not is_part(entry, entries)]
        status, alarms = cell.status(), cell.alarms()
        for name in self._nodes.keys() - {entry.name for entry in entries}:
            self._nodes.pop(name).close()
        readings: dict[str, tuple[NodeInfo, Any]] = {}
        statistics: dict[str, dict[str, Any]] = {}
        for entry in entries:
            try:
                node, reading = self._read(cell, entry)
                readings[entry.name] = node.info, reading
                if entry.device not in statistics:
                    statistics[entry.device] = node.statistics(LAST_TICKS)
            except OSError:
                continue  # its driver is down
        yield _one("sioms_up", "whether the daemon answers", 1)
        yield from of_cell(status, alarms)
        yield from of_devices(status["devices"], statistics)
        yield from of_nodes([entry.name for entry in entries], readings)

    def _read(self, cell: Workcell, entry: NodeEntry) -> tuple[Any, Any]:
        """Read a node, opened anew where its driver is another process than the last time."""
        if (node := self._nodes.pop(entry.name, None)) is not None:
            try:
                reading = node.read()
            except OSError:
                node.close()
            else:
                self._nodes[entry.name] = node
                return node, reading
        node = self._nodes[entry.name] = cell.open(entry.name if entry.read_only else entry.name + READONLY)
        return node, node.read()


def of_cell(status: dict[str, Any], alarms: Iterable[dict[str, Any]]) -> Iterator[Metric]:
    """Return what is told of the whole workcell: stops and alarms."""
    yield _one("sioms_stopped", "whether the emergency stop of the workcell is latched", bool(status["stopped_ns"]))
    yield _one("sioms_sessions", "sessions of clients with the daemon", len(status["sessions"]))
    stops = GaugeMetricFamily("sioms_node_stopped", "1 for each node whose stop is latched", labels=["node"])
    for name, *_ in status["node_stops"]:
        stops.add_metric([name], 1)
    yield stops
    raised = GaugeMetricFamily(
        "sioms_alarm",
        "severity of each alarm that is active or not acknowledged: 0 returned to normal, 1 minor, 2 major, 3 invalid",
        labels=["node", "device", "what", "state", "worst"],
    )
    for a in alarms:
        words = [a["node"], a["device"], a["what"], a["state"], Severity(a["worst"]).name.lower()]
        raised.add_metric(words, a["severity"])
    yield raised


def of_devices(devices: Iterable[dict[str, Any]], statistics: dict[str, dict[str, Any]]) -> Iterator[Metric]:
    """Return what is told of drivers: states, deaths, ticks."""
    per = ["device"]
    state = GaugeMetricFamily("sioms_device_state", "1 for the state the driver is in", labels=["device", "state"])
    link = GaugeMetricFamily("sioms_device_link_good", "whether the link to the device is good", labels=per)
    deaths = CounterMetricFamily("sioms_device_deaths", "deaths of the driver since the daemon started", labels=per)
    ticks = CounterMetricFamily("sioms_device_ticks", "ticks of the driver process", labels=per)
    skipped = CounterMetricFamily("sioms_device_ticks_skipped", "ticks that came too late to be done", labels=per)
    late = SummaryMetricFamily("sioms_device_tick_late_seconds", f"lateness of the last {LAST_TICKS} ticks", labels=per)
    for device in devices:
        name = device["name"]
        state.add_metric([name, device["state"]], 1)
        link.add_metric([name], device["link"] == "good")
        deaths.add_metric([name], device["deaths"])
        if found := statistics.get(name):
            ticks.add_metric([name], found["ticks"])
            skipped.add_metric([name], found["skipped"])
            for percent, ns in found["late_ns"].items():
                quantile = f"{float(percent) / 100:g}"
                late.add_sample("sioms_device_tick_late_seconds", {"device": name, "quantile": quantile}, ns / 1e9)
    yield from (state, link, deaths, ticks, skipped, late)


def of_nodes(names: Iterable[str], readings: dict[str, tuple[NodeInfo, Any]]) -> Iterator[Metric]:
    """Return what is told of nodes: whether they can be read, publications, and the values of all channels."""
    readable = GaugeMetricFamily("sioms_node_readable", "whether the node can be read", labels=["node"])
    published = CounterMetricFamily("sioms_node_publications", "snapshots of the driver process", labels=["node"])
    channel, unit = ["node", "channel"], ["node", "channel", "unit"]
    axes = {name: GaugeMetricFamily(f"sioms_axis_{name}", f"{name} of the axis", labels=unit) for name in _AXIS}
    flags = GaugeMetricFamily("sioms_axis_status", "flags of the status of the axis", labels=[*channel, "flag"])
    analog = GaugeMetricFamily("sioms_analog_value", "value of the channel in its unit", labels=unit)
    binary = GaugeMetricFamily("sioms_binary_value", "bits of the port as a number", labels=channel)
    edges = CounterMetricFamily("sioms_binary_edges", "edges of the port since the driver started", labels=channel)
    severity = GaugeMetricFamily(
        "sioms_severity", "of the status of a channel: 0 good, 1 minor, 2 major", labels=channel
    )
    for name in names:
        readable.add_metric([name], name in readings)
    for name, (info, snapshot) in readings.items():
        published.add_metric([name], snapshot.number)
        for i, (each, reading) in enumerate(zip(info.channels, snapshot, strict=True)):
            where = [name, each.name]
            match info.node_class:
                case NodeClass.AXIS:
                    status = AxisStatus(reading.status)
                    force = "N*m" if each.unit == "rad" else "N"
                    for column, family in axes.items():
                        plain = "" if column in ("in_motion", "buffered") else each.unit + _PER.get(column, "")
                        family.add_metric([*where, force if column == "force" else plain], getattr(reading, column))
                    for flag in AxisStatus:
                        flags.add_metric([*where, str(flag.name).lower()], bool(status & flag))
                    severity.add_metric(where, status.severity)
                case NodeClass.ANALOG:
                    analog.add_metric([*where, each.unit], snapshot.known[i])
                    severity.add_metric(where, AnalogStatus(reading.flags).severity)
                case NodeClass.BINARY:
                    binary.add_metric(where, reading.data)
                    edges.add_metric(where, reading.edges)
    yield from (readable, published, *axes.values(), flags, analog, binary, edges, severity)


def _one(name: str, text: str, value: float) -> Metric:
    return GaugeMetricFamily(name, text, value=value)
