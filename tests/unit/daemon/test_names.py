"""The name table: groups, parts, bits, companions and aliases, and what each open claims."""

from __future__ import annotations

import pytest

from sioms.daemon.claims import Claims
from sioms.daemon.config import NodeTable
from sioms.daemon.names import BlockInfo, DeviceInfo, NameTable
from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo


def device(name: str, *blocks: BlockInfo, inputs: tuple[str, ...] = ()) -> DeviceInfo:
    return DeviceInfo(name, "d", blocks, 1000.0, inputs, 0.1)


def axes(*names: str) -> BlockInfo:
    channels = tuple(ChannelInfo(name, "m", -1.0, 1.0, 0, 15) for name in names)
    return BlockInfo("", NodeClass.AXIS, channels, True, 64, 16)


def port(name: str, width: int, writable: bool) -> BlockInfo:
    return BlockInfo(name, NodeClass.BINARY, (ChannelInfo(name or "out", width=width),), writable, 64, 0)


def table(**aliases: NodeTable) -> NameTable:
    return NameTable(
        {
            "mod0": device("mod0", axes("x", "y", "z")),
            "io0": device("io0", port("", 4, True), port("in", 4, False)),
        },
        {name.replace("__", "."): alias for name, alias in aliases.items()},
    )


def test_names_of_a_group_its_parts_and_bits() -> None:
    names = set(table().nodes)
    assert names == {
        "mod0", "mod0.readonly", *(f"mod0.{a}{s}" for a in "xyz" for s in ("", ".readonly")),
        "io0", "io0.readonly", *(f"io0.bit{b}{s}" for b in range(4) for s in ("", ".readonly")),
        "io0.in", *(f"io0.in.bit{b}" for b in range(4)),
    }  # fmt: skip


def test_an_input_has_no_companion_and_is_read_only() -> None:
    nodes = table().nodes
    assert nodes["io0.in"].read_only and nodes["io0.in.bit2"].read_only
    assert nodes["mod0.readonly"].read_only and not nodes["mod0"].read_only
    assert nodes["mod0.readonly"].claims() == []


def test_aliases_and_their_parts() -> None:
    names = table(
        mod0__xz=NodeTable("mod0", ["x", "z"]),
        grip=NodeTable("io0.bit2"),
        again=NodeTable("grip"),
        zx=NodeTable("mod0", ["z", "x"]),
    )
    assert names.errors == []
    assert names.nodes["mod0.xz"].channels == (0, 2) and names.nodes["zx"].channels == (2, 0)
    assert names.nodes["mod0.xz.z"].channels == (2,) and "mod0.xz.readonly" in names.nodes
    assert names.nodes["grip"].bit == 2 and names.nodes["again"].bit == 2 and names.nodes["grip.readonly"].read_only


@pytest.mark.parametrize(
    ("alias", "words"),
    [
        (NodeTable("mod1"), "of = mod1, which does not exist; did you mean mod0?"),
        (NodeTable("mod0", ["x", "w"]), "mod0 has no channel w"),
        (NodeTable("mod0", ["x", "x"]), "a channel is named twice"),
    ],
)
def test_wrong_aliases(alias: NodeTable, words: str) -> None:
    names = table(new=alias)
    assert len(names.errors) == 1 and words in names.errors[0] and names.errors[0].startswith("[node.new]")


def test_a_name_taken_twice() -> None:
    names = NameTable({"a": device("a", axes("x", "y"))}, {"a.x": NodeTable("a.y")})
    assert "node name a.x is already taken by device a" in names.errors[0]


def test_an_input_of_a_driver_that_is_not_there() -> None:
    names = NameTable({"a": device("a", axes("x"), inputs=("b.z",))}, {})
    assert "[device.a]: reads node b.z, which does not exist" in names.errors[0]


def test_information_survives_the_wire() -> None:
    names = table()
    info = NodeInfo(names.pack(names.nodes["mod0.y"]))
    assert (info.name, info.node_class, info.read_only, info.number_structs) == (
        "mod0.y",
        NodeClass.AXIS,
        False,
        1,
    )
    assert info.channels[0].name == "y" and info.channels[0].minimum == -1.0 and info.buffer_capacity == 16
    assert info.read_struct_size == 8 * 13 and info.write_struct_size == 144
    bit = NodeInfo(names.pack(names.nodes["io0.bit2"]))
    assert (bit.bit, bit.channels[0].name, bit.channels[0].maximum) == (2, "bit2", 1)


# --- claims ----------------------------------------------------------------------------------------

EXCLUDE = [
    ("mod0", "mod0"), ("mod0", "mod0.x"), ("mod0.x", "mod0"), ("mod0.x", "mod0.xz"), ("mod0.xz", "mod0.z"),
    ("io0", "io0.bit0"), ("io0.bit3", "io0"), ("io0.bit1", "io0.bit1"), ("grip", "io0.bit2"), ("io0", "grip"),
]  # fmt: skip
AGREE = [
    ("mod0.x", "mod0.y"), ("mod0.xz", "mod0.y"), ("io0.bit0", "io0.bit1"), ("mod0", "io0"), ("mod0", "mod0.readonly"),
    ("io0", "io0.in"), ("io0.bit1", "grip"), ("mod0.readonly", "mod0.readonly"),
]  # fmt: skip


@pytest.mark.parametrize(("first", "second", "free"), [(*p, False) for p in EXCLUDE] + [(*p, True) for p in AGREE])
def test_who_excludes_whom(first: str, second: str, free: bool) -> None:
    names = table(mod0__xz=NodeTable("mod0", ["x", "z"]), grip=NodeTable("io0.bit2")).nodes
    claims: Claims[str] = Claims()
    assert claims.holder(names[first]) is None
    claims.take(names[first].claims(), "eva")
    assert claims.holder(names[second]) == (None if free else "eva")
    claims.release(names[first].claims())
    assert claims.holder(names[second]) is None and len(claims) == 0
