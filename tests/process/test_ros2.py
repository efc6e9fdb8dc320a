"""The bridge to ROS 2 beside a router of Zenoh: what a subscriber of rmw_zenoh sees."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
import zenoh
from daemon_rig import Daemon, wait_for
from rosbags.typesys import Stores, get_typestore
from zenoh.handlers import Callback

import sioms
from sioms.bridges import ros2_messages as ros
from sioms.bridges.ros2 import connect
from sioms.check.remote import free_ports
from sioms.children import Process

STORE = get_typestore(Stores.ROS2_JAZZY)


@pytest.fixture
def router() -> Iterator[tuple[str, zenoh.Session]]:
    """A router on loopback."""
    place = f"tcp/127.0.0.1:{free_ports()}"
    table = {"mode": "router", "listen": {"endpoints": [place]}, "scouting": {"multicast": {"enabled": False}}}
    session = zenoh.open(zenoh.Config.from_json5(json.dumps(table)))
    yield place, session
    session.close()


def test_topics_are_as_rmw_zenoh_writes_them(
    daemon: Daemon, cell: sioms.Workcell, router: tuple[str, zenoh.Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    place, session = router
    monkeypatch.setenv("SIOMS_SOCKET", daemon.socket)
    came: dict[str, list[Any]] = {}
    got = Callback(lambda sample: came.setdefault(str(sample.key_expr), []).append(sample), indirect=False)
    lives: dict[str, int] = {}
    seen = Callback(lambda sample: lives.update({str(sample.key_expr): sample.kind}), indirect=False)
    subscribers = [
        session.declare_subscriber("7/**", got),
        session.liveliness().declare_subscriber("@ros2_lv/7/**", seen, history=True),
    ]
    bridge = Process(["sioms.tools.front", "ros2", "--router", place, "--domain", "7"], "publishing below", errors=True)
    try:
        keys = {
            "sensor_msgs/msg/JointState": ros.topic_key(7, "/test/mod0/joint_states", ros.JOINT_STATE),
            "geometry_msgs/msg/WrenchStamped": ros.topic_key(7, "/test/force0/wrench", ros.WRENCH),
            "diagnostic_msgs/msg/DiagnosticArray": ros.topic_key(7, "/diagnostics", ros.DIAGNOSTICS),
        }
        wait_for(lambda: all(len(came.get(key, ())) > 1 for key in keys.values()), "messages of all kinds")
        found = {name: STORE.deserialize_cdr(came[key][-1].payload.to_bytes(), name) for name, key in keys.items()}
        joints, wrench, diagnostics = found.values()
        assert joints.name == ["xaxis", "yaxis"] and len(joints.position) == len(joints.effort) == 2
        assert [wrench.wrench.force.x, wrench.wrench.torque.z] == pytest.approx([1.0, 0.3])
        assert {status.name for status in diagnostics.status} >= {"sioms: test", "sioms: test: mod0"}
        numbers = [
            int.from_bytes(s.attachment.to_bytes()[:8], "little") for s in came[keys["sensor_msgs/msg/JointState"]]
        ]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert any(key.endswith("/NN/%/%/sioms") for key in lives)
        assert sum("/MP/" in key for key in lives) >= 4
    finally:
        bridge.end()
    wait_for(lambda: all(kind == zenoh.SampleKind.DELETE for kind in lives.values()), "the end of all tokens")
    del subscribers


def test_nobody_at_the_router_is_told() -> None:
    with pytest.raises(OSError, match="start `ros2 run rmw_zenoh_cpp rmw_zenohd`"):
        connect("tcp/127.0.0.1:9")
