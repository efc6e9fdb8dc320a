"""The exporter for Prometheus: what it tells, read by the parser of Prometheus' own client, and whom it waits for."""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import threading
import urllib.request
from collections.abc import Iterator
from typing import Any

import pytest

prometheus_client = pytest.importorskip("prometheus_client", reason="needs the extra metrics")

from prometheus_client.parser import text_string_to_metric_families  # noqa: E402

from sioms.bridges import metrics  # noqa: E402
from sioms.client.snapshot import SNAPSHOT, Layout  # noqa: E402
from sioms.protocol.flags import AxisStatus, NodeClass  # noqa: E402
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo  # noqa: E402
from sioms.protocol.records import READ  # noqa: E402

HOSTILE = 'a"}\\\n 1'
STATUS = {
    "stopped_ns": 5,
    "sessions": [1, 2],
    "node_stops": [["mod0", "someone"]],
    "devices": [{"name": "mod0", "state": "fault", "link": "lost", "deaths": 3}],
}
ALARMS = [{"node": HOSTILE, "device": "mod0", "what": "position", "state": "unacknowledged", "severity": 1, "worst": 2}]
STATISTICS = {"mod0": {"ticks": 1000, "skipped": 7, "late_ns": {"50.0": 1000, "100.0": 2_000_000}}}


def reading(name: str, node_class: NodeClass, unit: str, **values: float) -> tuple[NodeInfo, Any]:
    """Return a node of one channel and what it reads."""
    info = NodeInfo([name, int(node_class), False, [ChannelInfo("c0", unit).pack()], -1, 1e3, 16, "mod0", "sim", 2])
    columns = READ[node_class].items()
    raw = struct.pack("<QQQQ", 42, 7, 9, 0)
    raw += b"".join(struct.pack("<" + column.code, values.get(key, 0)) for key, column in columns)
    return info, SNAPSHOT[node_class](raw, Layout(node_class, 1, [0], -1, ["c0"]))


READINGS = {
    "mod0": reading("mod0", NodeClass.AXIS, "rad", position=0.25, force=-1.5, status=int(AxisStatus.FAULT)),
    "force0": reading("force0", NodeClass.ANALOG, "N", data=7.0, flags=2),
    "io0": reading("io0", NodeClass.BINARY, "", data=5, edges=11),
}


class Told:
    """What an exporter without a daemon tells."""

    def collect(self) -> Iterator[Any]:
        yield from metrics.of_cell(STATUS, ALARMS)
        yield from metrics.of_devices(STATUS["devices"], STATISTICS)  # type: ignore[arg-type]
        yield from metrics.of_nodes(["mod0", "force0", "io0", "gone"], READINGS)


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Where a server of these is."""
    monkeypatch.setattr(metrics, "SCRAPE_S", 0.3)
    registry = prometheus_client.CollectorRegistry(auto_describe=False)
    registry.register(Told())
    with metrics.Server("127.0.0.1", 0, registry) as server:
        threading.Thread(target=server.serve_forever, args=[0.05], daemon=True).start()
        yield server.server_port
        server.shutdown()


def scrape(port: int) -> dict[tuple[Any, ...], float]:
    """Return the samples by name and labels."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5.0) as answer:
        families = text_string_to_metric_families(answer.read().decode())
        return {(s.name, *sorted(s.labels.values())): s.value for each in families for s in each.samples}


def test_everything_is_told_with_units(port: int) -> None:
    found = scrape(port)
    assert found["sioms_stopped",] == 1 and found["sioms_node_stopped", "mod0"] == 1
    assert found["sioms_alarm", *sorted([HOSTILE, "mod0", "position", "unacknowledged", "major"])] == 1
    assert found["sioms_device_state", "fault", "mod0"] == 1 and found["sioms_device_link_good", "mod0"] == 0
    assert found["sioms_device_deaths_total", "mod0"] == 3
    assert found["sioms_device_ticks_skipped_total", "mod0"] == 7
    assert found["sioms_device_tick_late_seconds", "1", "mod0"] == 0.002
    assert found["sioms_axis_position", "c0", "mod0", "rad"] == 0.25
    assert found["sioms_axis_force", "N*m", "c0", "mod0"] == -1.5
    assert found["sioms_axis_velocity", "c0", "mod0", "rad/s"] == 0
    assert found["sioms_axis_status", "c0", "fault", "mod0"] == 1
    assert found["sioms_axis_status", "c0", "mod0", "moving"] == 0
    assert math.isnan(found["sioms_analog_value", "N", "c0", "force0"])
    assert found["sioms_severity", "c0", "force0"] == 2 and found["sioms_severity", "c0", "mod0"] == 2
    assert found["sioms_binary_value", "c0", "io0"] == 5 and found["sioms_binary_edges_total", "c0", "io0"] == 11
    assert found["sioms_node_readable", "gone"] == 0 and found["sioms_node_publications_total", "mod0"] == 42


def test_scrapers_that_hang_are_cut_off_and_no_more_are_taken_than_can_be_served(port: int) -> None:
    hung = [socket.create_connection(("127.0.0.1", port), 5.0) for _ in range(metrics.MOST_SCRAPERS + 3)]
    for each in hung:
        each.sendall(b"GET /metrics HTTP/1.1\r\nX: ")
    for each in reversed(hung):
        with contextlib.suppress(ConnectionResetError):
            assert each.recv(1) == b""
        each.close()
    assert scrape(port)["sioms_stopped",] == 1


def test_without_a_daemon_that_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(**_: str) -> None:
        raise OSError("no daemon")

    monkeypatch.setattr(metrics, "Workcell", none)
    (up,) = metrics.Exporter().collect()
    assert [(s.name, s.value) for s in up.samples] == [("sioms_up", 0)]
