"""ROS 2 messages against the decoder of rosbags, which knows the definitions; keys as rmw_zenoh writes them."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from sioms.bridges import ros2_messages as ros

STORES = [get_typestore(each) for each in (Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED)]
NUMBERS = st.lists(st.floats(allow_nan=False), max_size=8)
WORDS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20)


def _decoded(message: bytes, name: str) -> Any:
    return STORES[1].deserialize_cdr(message, name)


@pytest.mark.parametrize("kind", [ros.JOINT_STATE, ros.WRENCH, ros.DIAGNOSTICS])
def test_hashes_are_those_of_the_definitions(kind: ros.Type) -> None:
    package, _, name = kind.name.removesuffix("_").replace("::dds_", "").replace("::", "/").partition("/msg/")
    for store in STORES:
        assert store.hash_rihs01(f"{package}/msg/{name}") == kind.hash


@given(st.integers(0, 2**31 * 10**9 - 1), WORDS, st.lists(WORDS, max_size=6), st.tuples(NUMBERS, NUMBERS, NUMBERS))
def test_joint_states(
    stamp_ns: int, frame: str, names: list[str], values: tuple[list[float], list[float], list[float]]
) -> None:
    found = _decoded(ros.joint_state(stamp_ns, frame, names, *values), "sensor_msgs/msg/JointState")
    assert found.header.stamp.sec * 10**9 + found.header.stamp.nanosec == stamp_ns
    assert found.header.frame_id == frame and found.name == names
    assert [list(found.position), list(found.velocity), list(found.effort)] == list(values)
    again = STORES[1].serialize_cdr(found, "sensor_msgs/msg/JointState")
    assert bytes(again) == ros.joint_state(stamp_ns, frame, names, *values), "byte for byte"


@given(st.lists(st.floats(allow_nan=False), min_size=6, max_size=6), WORDS)
def test_wrenches(values: list[float], frame: str) -> None:
    found = _decoded(ros.wrench(5, frame, values), "geometry_msgs/msg/WrenchStamped")
    parts = (found.wrench.force, found.wrench.torque)
    assert [v for part in parts for v in (part.x, part.y, part.z)] == values and found.header.frame_id == frame
    with pytest.raises(ValueError, match="want 6"):
        ros.wrench(5, frame, values[1:])


@given(
    st.lists(
        st.tuples(st.integers(0, 3), WORDS, WORDS, WORDS, st.lists(st.tuples(WORDS, WORDS), max_size=3)), max_size=4
    )
)
def test_diagnostics(raw: list[tuple[int, str, str, str, list[tuple[str, str]]]]) -> None:
    statuses = [ros.Status(level, name, text, unit, tuple(values)) for level, name, text, unit, values in raw]
    found = _decoded(ros.diagnostics(7, statuses), "diagnostic_msgs/msg/DiagnosticArray")
    assert [
        (s.level, s.name, s.message, s.hardware_id, [(v.key, v.value) for v in s.values]) for s in found.status
    ] == raw


def test_keys() -> None:
    key = ros.topic_key(2, "/cell/mod0/joint_states", ros.JOINT_STATE)
    assert key == f"2/cell/mod0/joint_states/sensor_msgs::msg::dds_::JointState_/{ros.JOINT_STATE.hash}"
    assert ros.node_token(2, "aac3178e", "sioms") == "@ros2_lv/2/aac3178e/0/0/NN/%/%/sioms"
    token = ros.publisher_token(2, "aac3178e", 3, "sioms", "/cell/mod0/joint_states", ros.JOINT_STATE)
    assert token == (
        "@ros2_lv/2/aac3178e/0/3/MP/%/%/sioms/%cell%mod0%joint_states/sensor_msgs::msg::dds_::JointState_/"
        f"{ros.JOINT_STATE.hash}/::,10:,:,:,,"
    )
    assert ros.part("mod-0.x") == "mod_0_x" and ros.part("0a") == "_0a" and ros.part("") == "_"
    data = ros.attachment(3, 5, ros.identity(token))
    assert len(data) == 33 and struct.unpack("<qqB", data[:17]) == (3, 5, 16)
